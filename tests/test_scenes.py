"""Scenes: the values of a table, overrides from plain dicts, and errors."""

from __future__ import annotations

import dataclasses
import json
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from rbl_gym.geometry import regions
from rbl_gym.geometry.regions import Box, Shell, Walls
from rbl_gym.measurements import ranging
from rbl_gym.measurements.ranging import LinkModel, RangeNoise, SquaredRangeNoise
from rbl_gym.motion import ProcessNoise
from rbl_gym.worlds import scenes
from rbl_gym.worlds.scene import Scene

every_scene = pytest.mark.parametrize("name", scenes.SCENES)

# The figures of the scenes, written a second time. Process noise of one step, and initial
# uncertainty, in (m, degrees). `camsap2013` and `icassp2013` are from papers, the others our own.
TABLE: dict[str, dict[str, Any]] = {
    "uwb_room": {
        "volume": Box((1, 1, 0.5), (9, 7, 2.2)), "anchor_region": Walls((0, 0, 0.3), (10, 8, 3)),
        "n_anchors": 6, "noise": RangeNoise(0.10, 0.0), "body": ("octahedron", 0.8), "dt": 0.1,
        "anchor_speed_m_s": 0.0, "speed_m_s": 1.0, "spin_rad_s": 0.29, "process": (0.03, 1.5),
        "initial": (0.5, 10), "steps": 100, "trajectory": "waypoints", "prior": "drawn",
    },
    "drone_yard": {
        "volume": Box((-50, -50, 5), (50, 50, 40)),
        "anchor_region": Box((-60, -60, 0), (60, 60, 6)),
        "n_anchors": 6, "noise": RangeNoise(0.10, 0.001), "body": ("octahedron", 1), "dt": 0.1,
        "anchor_speed_m_s": 0.0, "speed_m_s": 5.0, "spin_rad_s": 0.29, "process": (0.1, 1.5),
        "initial": (1.0, 10), "steps": 100, "trajectory": "waypoints", "prior": "drawn",
    },
    "auv_buoys": {
        "volume": Box((-150, -150, -80), (150, 150, -20)),
        "anchor_region": Box((-200, -200, 0), (200, 200, 0)),
        "n_anchors": 4, "noise": RangeNoise(0.05, 0.001), "body": ("pyramid", 2), "dt": 1.0,
        "anchor_speed_m_s": 4.0, "speed_m_s": 1.5, "spin_rad_s": 0.03, "process": (0.3, 2.0),
        "initial": (3.0, 10), "steps": 100, "trajectory": "waypoints", "prior": "drawn",
    },
    "satellite": {
        "volume": Box((-5, -5, -5), (5, 5, 5)), "anchor_region": Shell(50, 300),
        "n_anchors": 5, "noise": RangeNoise(0.02, 0.0002), "body": ("octahedron", 2), "dt": 1.0,
        "anchor_speed_m_s": 1.0, "speed_m_s": 0.05, "spin_rad_s": 0.012, "process": (0.02, 1.0),
        "initial": (0.5, 5), "steps": 100, "trajectory": "waypoints", "prior": "drawn",
    },
    "auv_craft": {
        "volume": Box((-150, -150, -80), (150, 150, -20)),
        "start_volume": Box((-100, -100, -80), (100, 100, -20)), "anchor_start_m": 150.0,
        "n_anchors": 3, "noise": RangeNoise(0.05, 0.002), "body": ("pyramid", 2), "dt": 2.0,
        "anchor_speed_m_s": 4.0, "speed_m_s": 1.5, "spin_rad_s": 0.03, "process": (0.3, 2.0),
        "initial": (3.0, 10), "steps": 100, "trajectory": "waypoints", "prior": "drawn",
    },
    "hall": {
        "volume": Box((-17, -8, 0.5), (17, 8, 3)),
        "anchor_region": Walls((-20, -10, 0), (20, 10, 6)), "n_anchors": 12,
        "noise": RangeNoise(0.10, 0.005), "body": ("octahedron", 0.8), "dt": 0.2,
        "anchor_speed_m_s": 0.0, "speed_m_s": 2.0, "spin_rad_s": 0.2, "process": (0.05, 2.0),
        "initial": (0.5, 10), "steps": 100, "trajectory": "waypoints", "prior": "drawn",
        "blocked_information": 0.02,
    },
    "camsap2013": {
        "anchor_region": Box((-1000, -1000, -1000), (1000, 1000, 1000)), "n_anchors": 4,
        "noise": SquaredRangeNoise(0.0316), "body": ("pyramid", 1), "dt": 1.0, "steps": 20,
        "anchor_speed_m_s": 0.0, "process": (1.0, 0.1), "trajectory": "constant", "prior": "start",
        # P0 = 100 I12 is pose information .02 and .01, that is variances 50 and 100.
        "initial": (10.0, np.rad2deg(50**0.5)),
    },
    "icassp2013": {
        "anchor_region": Box((0, 0, 0), (100, 100, 100)), "n_anchors": 10, "anchors": None,
        "noise": RangeNoise(0.0, 1e-4, reference_tag=0), "anchor_speed_m_s": 0.0,
        "process": (0.0, 0.0), "trajectory": "constant", "twist": (0,) * 6,
        "start_translation": (5, 5, 5), "speed_m_s": 0.0, "spin_rad_s": 0.0,
    },
}  # fmt: skip
# Distances between the tags of a body of size 1, smallest and largest, and how many tags.
SOLIDS = {"octahedron": (0.5**0.5, 1.0, 6), "pyramid": (1.0, 2**0.5, 5)}


def test_table_speaks_of_every_scene():
    assert set(TABLE) == set(scenes.SCENES)


@every_scene
def test_scene_has_the_figures_of_the_table(name):
    scene = scenes.get(name)
    want = dict(TABLE[name])
    metres, degrees = want.pop("process")
    step = np.sqrt(np.diagonal(scene.process.covariance(np.zeros(6), scene.dt)))
    np.testing.assert_allclose(step, [np.deg2rad(degrees)] * 3 + [metres] * 3, rtol=1e-12)
    if "initial" in want:
        metres, degrees = want.pop("initial")
        std = np.array([np.deg2rad(degrees)] * 3 + [metres] * 3)
        np.testing.assert_allclose(scene.prior_covariance, np.diag(std**2), rtol=1e-12)
    if "body" in want:
        solid, size = want.pop("body")
        smallest, largest, count = SOLIDS[solid]
        assert len(scene.tags) == count
        np.testing.assert_allclose(np.mean(scene.tags, axis=0), 0, atol=1e-15)
        np.testing.assert_allclose(pdist(scene.tags).min(), smallest * size)
        np.testing.assert_allclose(pdist(scene.tags).max(), largest * size)
    assert {key: getattr(scene, key) for key in want} == want


def test_papers_worlds():
    tracking, static = scenes.get("camsap2013"), scenes.get("icassp2013")
    np.testing.assert_allclose(tracking.twist, [np.deg2rad(1)] * 3 + [1] * 3)
    np.testing.assert_array_equal(tracking.start_rotation, np.eye(3))
    assert tracking.start_translation == (0, 0, 0)
    # Q = Rz(10) Ry(-25) Rx(20), written out by hand.
    (cz, cy, cx), (sz, sy, sx) = (f(np.deg2rad([10, -25, 20])) for f in (np.cos, np.sin))
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    Ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    Rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    assert static.start_rotation is not None
    np.testing.assert_allclose(static.start_rotation, Rz @ Ry @ Rx, atol=1e-15)
    np.testing.assert_array_equal(static.tags[-1], [2.5, 2.5, 5])


@every_scene
def test_anchors_stand_where_they_may(name):
    scene = scenes.get(name)
    if scene.anchors is not None:
        anchors = np.array(scene.anchors)
        assert len(anchors) == scene.n_anchors
        np.testing.assert_allclose(scene.anchor_region.project(anchors), anchors, atol=1e-9)


@every_scene
def test_scenes_are_hashable_immutable_and_pickle(name):
    scene = scenes.get(name)
    assert scene.name == name
    assert scenes.get(scene) is scene
    assert hash(scene) == hash(scenes.get({"name": name}))
    assert pickle.loads(pickle.dumps(scene)) == scene
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.dt = 1.0  # pyrefly: ignore[read-only]


# --- overrides --------------------------------------------------------------------------------

KINDS: dict[type, str] = {
    Box: "box",
    Walls: "walls",
    Shell: "shell",
    **{law: kind for kind, law in ranging.NOISE_LAWS.items()},
}


def as_overrides(scene: Scene) -> dict[str, Any]:
    """The fields of a scene as JSON-able overrides; regions and noises with their kind.

    Without prisms, which files alone have.
    """

    def plain(value: Any) -> Any:
        if not dataclasses.is_dataclass(value) or isinstance(value, type):
            return value
        kind = {"kind": KINDS[type(value)]} if type(value) in KINDS else {}
        return kind | dataclasses.asdict(value)

    names = (entry.name for entry in dataclasses.fields(scene) if entry.name != "prisms")
    return {name: plain(getattr(scene, name)) for name in names}


@every_scene
def test_scene_survives_json(name):
    scene = scenes.get(name)
    again = scenes.get(json.loads(json.dumps(as_overrides(scene))))
    assert again == scene
    assert hash(again) == hash(scene)


@every_scene
def test_any_scene_may_become_any_other(name):
    overrides = as_overrides(scenes.get(name)) | {"name": "uwb_room"}
    got = scenes.get(json.loads(json.dumps(overrides)))
    assert dataclasses.replace(got, name=name) == scenes.get(name)


@pytest.mark.parametrize(
    ("overrides", "want"),
    [
        ({"steps": 7, "dt": 0.5}, {"steps": 7, "dt": 0.5}),
        ({"noise": {"floor_m": 0.2}}, {"noise": RangeNoise(0.2)}),
        ({"noise": {"kind": "squared-range"}}, {"noise": SquaredRangeNoise(0.0316)}),
        ({"noise": {"kind": "range", "reference_tag": 1}}, {"noise": RangeNoise(reference_tag=1)}),
        ({"links": {"reach_m": 9.0}}, {"links": LinkModel(reach_m=9.0)}),
        ({"anchor_region": {"low": [0, 0, 1]}}, {"anchor_region": Walls((0, 0, 1), (10, 8, 3))}),
        (
            {"anchor_region": {"kind": "shell", "inner_m": 2, "outer_m": 3}},
            {"anchor_region": Shell(2, 3)},
        ),
        (
            {"process": {"rotation_rad": [0, 0, 0.1], "translation_m": 0.0}},
            {"process": ProcessNoise((0.0, 0.0, 0.1), 0.0)},
        ),
        ({"noise": SquaredRangeNoise(0.5)}, {"noise": SquaredRangeNoise(0.5)}),
        ({"anchors": [[1, 2, 3], [4, 5, 6]]}, {"anchors": ((1, 2, 3), (4, 5, 6)), "n_anchors": 2}),
        ({"n_anchors": 9}, {"n_anchors": 9, "anchors": None}),
        ({"anchors": None}, {"n_anchors": 6, "anchors": None}),
        (
            {"start_rotation": np.eye(3).tolist()},
            {"start_rotation": ((1, 0, 0), (0, 1, 0), (0, 0, 1))},
        ),
    ],
)
def test_overrides_change_what_they_name_and_nothing_else(overrides, want):
    base, got = scenes.get("uwb_room"), scenes.get({"name": "uwb_room", **overrides})
    for entry in dataclasses.fields(base):
        expected = want.get(entry.name, getattr(base, entry.name))
        assert getattr(got, entry.name) == expected, entry.name
    hash(got)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ("attic", "scene must be one of 'uwb_room', "),
        ({"steps": 3}, "scene must be a name or a dict with the key 'name', got {'steps': 3}"),
        (None, "scene must be a name or a dict with the key 'name', got None"),
        ({"name": ["uwb_room"]}, "scene must be one of"),
    ],
)
def test_unknown_scene_is_refused(scene, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        scenes.get(scene)


BOX = {"kind": "box", "low": [0, 0, 0], "high": [1, 1, 1]}
REFUSED: list[tuple[dict[str, Any], str]] = [
    # unknown fields
    ({"speed": 3}, "scene has no field 'speed'; its fields are anchor_region, anchor_speed_m_s"),
    (
        {"noise": {"floor": 1}},
        "scene.noise has no field 'floor'; its fields are floor_m, proportional",
    ),
    ({"noise": {"kind": "range", "floor": 1}}, "scene.noise has no field 'floor'"),
    ({"dt": {"value": 1}}, "scene.dt must be one value, got the dict {'value': 1}"),
    ({"noise": 0.1}, "scene.noise must be a dict of its fields (floor_m, proportional, "),
    ({"links": None}, "scene.links must be a dict of its fields (drop_probability, "),
    # kinds
    ({"noise": {"kind": "loud"}}, "scene.noise.kind must be one of"),
    ({"noise": BOX}, "scene.noise.kind must be one of 'range', 'squared-range'"),
    ({"volume": {"kind": "range"}}, "scene.volume"),
    ({"volume": {"kind": "shell", "inner_m": 1, "outer_m": 2}}, "volume"),
    ({"anchor_region": {"kind": "range"}}, "scene.anchor_region.kind must be one of 'box'"),
    ({"links": BOX}, "scene.links"),
    ({"process": BOX}, "scene.process"),
    ({"dt": BOX}, "dt"),
    ({"noise": Box((0, 0, 0), (1, 1, 1))}, "noise"),
    # numbers
    ({"dt": 0}, "dt must be a finite number of at least 1e-09, got 0.0"),
    ({"dt": "0.1"}, "dt must be a number, got '0.1'"),
    ({"speed_m_s": -1}, "speed_m_s must be a finite number of at least 0, got -1.0"),
    ({"spin_rad_s": np.nan}, "spin_rad_s must be a finite number"),
    ({"initial_rotation_rad": 0}, "initial_rotation_rad must be a finite number"),
    ({"initial_translation_m": [1]}, "initial_translation_m must be a number, got [1]"),
    ({"noise": {"floor_m": -1}}, "scene.noise: floor_m must be a finite number of at least 0"),
    ({"noise": {"floor_m": "0.2"}}, "scene.noise: floor_m must be a number, got '0.2'"),
    ({"links": {"drop_probability": 2}}, "scene.links: drop_probability must be a finite number"),
    ({"process": {"rotation_rad": [1, 2]}}, "scene.process: rotation_rad must be one number or"),
    ({"volume": {"low": [99, 0, 0]}}, "scene.volume: low must lie below high"),
    ({"steps": 0}, "steps must be a positive int, got 0"),
    ({"steps": 2.5}, "steps must be a positive int, got 2.5"),
    ({"n_anchors": True}, "n_anchors must be a positive int, got True"),
    # choices
    ({"trajectory": "loop"}, "trajectory must be one of 'waypoints', 'constant', 'random-twist'"),
    ({"prior": "none"}, "prior must be one of 'drawn', 'start', got 'none'"),
    # arrays
    ({"anchors": [[1, 2, 3]], "n_anchors": 2}, "anchors must hold n_anchors = 2 positions, got 1"),
    ({"anchors": [[1, 2, np.nan]]}, "anchors must be finite, got nan at index (0, 2)"),
    ({"anchors": [[1, 2]]}, "anchors must have shape (..., M, 3), got (1, 2)"),
    ({"anchors": 5}, "anchors must"),
    ({"anchors": []}, "anchors must"),
    ({"tags": [[[1, 2, 3]]]}, "tags must have no leading axes, got shape (1, 1, 3)"),
    ({"tags": None}, "tags must"),
    ({"twist": [0, 0, 0]}, "twist must have shape (..., 6), got (3,)"),
    ({"start_translation": "origin"}, "start_translation must be an array of real numbers"),
    ({"start_rotation": np.diag([1, 1, -1]).tolist()}, "start_rotation must be a proper rotation"),
    ({"start_rotation": [np.eye(3).tolist()] * 2}, "start_rotation must have no leading axes"),
    ({"noise": {"reference_tag": 6}}, "reference_tag must be below the number of tags, 6, got 6"),
]


@pytest.mark.parametrize(("overrides", "message"), REFUSED, ids=lambda x: str(x)[:50])
def test_bad_override_is_refused(overrides, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        scenes.get({"name": "uwb_room", **overrides})


def test_the_page_and_the_error_have_the_same_fields():
    page = Path(__file__).parents[1] / "docs/environments/index.md"
    table = page.read_text(encoding="utf-8").split("## Fields of a scene")[1].split("\n\n")[1]
    names = [name for line in table.splitlines()[2:] for name in line.split("|")[1].split(",")]
    with pytest.raises(ValueError, match="scene has no field") as refused:
        scenes.get({"name": "uwb_room", "colour": 1})
    listed = str(refused.value).split("its fields are ")[1].split(", ")
    assert sorted(name.strip(" `") for name in names) == listed


# --- the limit of the ranges ------------------------------------------------------------------


def longest_range(scene: Scene) -> float:
    """From the farthest corner of the anchors' region to that of the volume, at the start."""
    corners = [
        np.array(np.meshgrid(*np.transpose(r.bounds()))).reshape(3, -1).T
        for r in (scene.anchor_region, scene.volume)
    ]
    return float(ranging.distances(*corners).max())


@every_scene
def test_no_range_at_the_start_exceeds_the_limit(name):
    scene = scenes.get(name)
    assert scene.range_limit_m > longest_range(scene)
    assert np.isfinite(scene.range_limit_m)


def test_limit_follows_the_bias_of_reflections():
    far = scenes.get({"name": "uwb_room", "links": {"nlos_bias_m": 50.0}})
    near = scenes.get({"name": "uwb_room", "links": {"nlos_bias_m": 0.0}})
    np.testing.assert_allclose(far.range_limit_m - near.range_limit_m, 50.0)


@pytest.mark.parametrize("tag", [None, 0, 1, 5])
def test_limit_exists_for_every_reference_tag(tag):
    noise = {"kind": "range", "floor_m": 0.1, "proportional": 0.01, "reference_tag": tag}
    scene = scenes.get({"name": "uwb_room", "noise": noise})
    assert scene.range_limit_m > longest_range(scene)


def test_kinds_are_all_regions_and_noises():
    assert set(KINDS) >= {
        x for x in vars(regions).values() if dataclasses.is_dataclass(x) and isinstance(x, type)
    }

"""Placement problems from files and named scenes: values read, and all errors."""

from __future__ import annotations

import json
import math
import tomllib

import numpy as np
import pytest

from rbl_gym import bounds, placement
from rbl_gym.geometry import bodies
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Box, Shell, Walls
from rbl_gym.measurements.ranging import NOISE_LAWS, RangeNoise
from rbl_gym.placement import building, layouts, scene_files
from rbl_gym.placement.file_tables import read_table
from rbl_gym.placement.problem import PlacementTask
from rbl_gym.worlds import simulation
from rbl_gym.worlds.scenes import SCENES
from tests.helpers import ROOT, changed_tables, needs, share_by_hand

GOOD = {
    "anchors": {"kind": "room", "low": [0, 0, 0.3], "high": [8, 6, 3], "number": 5},
    "region": {"low": [1, 1, 0], "high": [7, 5, 2]},
    "obstacles": [{"low": [3, 2, 0], "high": [4, 3, 2.5]}],
    "body": {"shape": "octahedron", "size_m": 0.8},
    "noise": {"floor_m": 0.1},
}


def changed(path: str, value: object) -> dict:
    return changed_tables(GOOD, path, value)


def test_the_example_is_read():
    problem = scene_files.problem(str(ROOT / "examples" / "warehouse.toml"))
    task, context = PlacementTask(problem.scene, problem.n_anchors), problem.context
    assert problem.name == "warehouse"
    assert task.n_anchors == task.scene.n_anchors == 8
    assert task.scene.anchor_region == Walls((-20, -10, 0.5), (20, 10, 6))
    assert task.scene.volume == Box((-17, -8, 0.5), (17, 8, 3))
    assert task.scene.noise == RangeNoise(0.1, 0.005)
    assert task.blocked_information == 0.01
    np.testing.assert_array_equal(task.scene.tags, bodies.octahedron(0.8))
    np.testing.assert_allclose(context.racks[0], [-8, -4.5, 2, 6, 0.5, 2])
    np.testing.assert_allclose(context.centre, [0, 0, 1.75])
    np.testing.assert_allclose(context.half, [17, 8, 1.25])
    assert context.racks.shape == (4, 6)


@needs("shapely")
@pytest.mark.parametrize("page", ["placement", "building_files"])
def test_the_examples_of_the_documentation_are_read(page):
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    blocks = [block.split("```")[0] for block in text.split("```toml\n")[1:]]
    assert blocks
    for block in blocks:
        tables = tomllib.loads(block)
        if "body" in tables:
            scene_files.of_mapping(tables)
            continue
        # A part of a file.
        for name, table in tables.items():
            for row in table if isinstance(table, list) else [table]:
                if name != "materials":
                    read_table(name, row)


def test_toml_and_json_say_the_same(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(GOOD))
    (tmp_path / "a.toml").write_text("""
[anchors]
kind = "room"
low = [0, 0, 0.3]
high = [8, 6, 3]
number = 5
[region]
low = [1, 1, 0]
high = [7, 5, 2]
[[obstacles]]
low = [3, 2, 0]
high = [4, 3, 2.5]
[body]
shape = "octahedron"
size_m = 0.8
[noise]
floor_m = 0.1
""")
    first, second = (scene_files.problem(str(tmp_path / f"a.{end}")) for end in ("json", "toml"))
    assert first.name == second.name == "a"
    assert (first.scene, first.n_anchors) == (second.scene, second.n_anchors)
    np.testing.assert_array_equal(first.context.racks, second.context.racks)


def test_what_a_file_leaves_open_has_a_default():
    problem = scene_files.of_mapping(changed("obstacles", None))
    assert problem.context.racks.shape == (0, 6)
    assert problem.obstacles.blocked_information == 0.01
    assert problem.scene.initial_translation_m == 0.5
    assert problem.scene.initial_rotation_rad == pytest.approx(math.radians(10))


def test_other_regions_bodies_and_priors():
    tables = changed("anchors", {"kind": "shell", "inner_m": 20, "outer_m": 50, "number": 4})
    tables["body"] = {"tags": [[0, 0, 0], [1, 0, 0], [0, 1, 0]]}
    tables["prior"] = {"rotation_deg": 30, "position_m": 2}
    tables["noise"]["blocked_information"] = 0.0
    problem = scene_files.of_mapping(tables)
    assert problem.scene.anchor_region == Shell(20, 50)
    assert problem.scene.tags == ((0, 0, 0), (1, 0, 0), (0, 1, 0))
    assert problem.scene.initial_translation_m == 2
    assert problem.obstacles.blocked_information == 0
    tables["anchors"] = {"kind": "box", "low": [0, 0, 0], "high": [5, 5, 0], "number": 4}
    assert scene_files.of_mapping(tables).scene.anchor_region == Box((0, 0, 0), (5, 5, 0))


@pytest.mark.parametrize(("kind", "law"), NOISE_LAWS.items())
def test_every_law_of_the_ranges_has_its_kind(kind, law):
    problem = scene_files.of_mapping(changed("noise", {"kind": kind, "blocked_information": 0.5}))
    assert problem.scene.noise == law()
    assert problem.obstacles.blocked_information == 0.5
    task = PlacementTask(problem.scene, problem.n_anchors)
    anchors = layouts.corners(task, problem.context, np.random.default_rng(0))
    assert np.isfinite(placement.score(task, problem.context, anchors))


def test_arguments_go_before_the_file(tmp_path):
    problem = scene_files.of_mapping(GOOD, n_anchors=7, region=([2, 2, 1], [3, 3, 1]))
    assert problem.n_anchors == problem.scene.n_anchors == 7
    np.testing.assert_array_equal(problem.corners(), [[2, 2, 1], [3, 3, 1]])
    without = changed("anchors.number", None)
    assert scene_files.of_mapping(without, n_anchors=4).n_anchors == 4
    assert scene_files.with_anchors(problem, 3).n_anchors == 3


def test_named_scenes():
    problem = scene_files.problem("uwb_room")
    assert problem.n_anchors == 6
    np.testing.assert_array_equal(problem.corners(), [[1, 1, 0.5], [9, 7, 2.2]])
    with_racks = [scene_files.problem("uwb_room", racks=2, seed=seed) for seed in (3, 3, 4)]
    assert with_racks[0].n_anchors == 5
    first, same, other = (problem.context.racks for problem in with_racks)
    np.testing.assert_array_equal(first, same)
    assert (first != other).any()


def test_a_named_scene_keeps_its_own_obstacles():
    hall = SCENES["hall"]
    problem = scene_files.problem("hall")
    np.testing.assert_array_equal(problem.context.racks, hall.obstacles)
    assert problem.scene.obstacles == hall.obstacles
    assert problem.obstacles.blocked_information == hall.blocked_information
    more = scene_files.problem("hall", racks=2, seed=1).context.racks
    assert more.shape == (6, 6)
    np.testing.assert_array_equal(more[:4], hall.obstacles)
    fewer = scene_files.with_anchors(scene_files.problem("hall", racks=1), 5)
    assert fewer.context.racks.shape == (5, 6)


def test_what_is_predicted_of_a_hall_is_what_its_simulation_tells():
    """Information at poses of an episode, by the way of placement and by that of tracking."""
    hall = SCENES["hall"]
    assert hall.anchors is not None
    episode = simulation.draw_episode(hall, np.random.default_rng(3), (20,))
    at, anchors = simulation.epoch_of(episode, 7), np.array(hall.anchors)
    tags = np.array(hall.tags)
    links = np.ones((20, len(anchors), len(tags)), dtype=bool)
    told = bounds.information_at(
        anchors, tags, at.rotation, at.translation, hall.noise,
        simulation.shares(hall, at, anchors, links),
    )  # fmt: skip
    problem = scene_files.problem("hall")
    share = problem.obstacles.share(anchors, at.translation)
    assert 0.1 < (share < 1).mean() < 0.9
    mine = bounds.information_at(
        anchors, tags, at.rotation, at.translation, problem.scene.noise, share[..., None]
    )
    np.testing.assert_allclose(mine, told, rtol=1e-12)
    # And the score of a layout, pose by pose.
    task = PlacementTask(problem.scene, problem.n_anchors)
    places = placement.positions(task, problem.context)
    for k in range(0, task.n_poses, 5):
        wanted = [
            share_by_hand(hall, anchor, places[k])
            * bounds.information_at(anchor[None], tags, task.poses[0][k], places[k], hall.noise)
            for anchor in anchors
        ]
        got = placement.information(task, problem.context, anchors)[k]
        np.testing.assert_allclose(got, sum(wanted), rtol=1e-9, atol=1e-9)


def test_free_points_fill_the_box_and_leave_the_obstacles_out():
    low, high = np.array([0.0, 0, 1]), np.array([4.0, 2, 1])
    obstacles = Obstacles(np.array([[1.0, 1, 1, 1, 1, 1]]), 0.0)
    zone = building.Zone("flat", np.array([[0.0, 0], [4, 0], [4, 2], [0, 2]]), 1.0, 1.0)
    points = building.free_places(zone, obstacles, 200)
    assert points.shape == (200, 3)
    assert not obstacles.contain(points).any()
    assert ((points >= low) & (points <= high)).all()
    np.testing.assert_allclose(points.mean(axis=0), [3, 1, 1], atol=0.05)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("colour", 1, "the file has an unknown key 'colour'"),
        ("anchors", None, "the file must have the key 'anchors'"),
        ("anchors", 3, "anchors must be a table"),
        ("anchors.hight", [1, 2, 3], "anchors has an unknown key 'hight'"),
        ("anchors.kind", None, "anchors.kind must be given"),
        ("anchors.kind", "roof", "anchors.kind must be one of 'room', 'box', 'shell'"),
        ("anchors.kind", "shell", "anchors has an unknown key 'low'"),
        ("anchors.low", None, "anchors must have the key 'low'"),
        ("anchors.low", [0, 0, 3], "anchors: low must lie below high"),
        ("anchors.low", [0, 0], "anchors.low must have shape"),
        ("anchors.low", [[0, 0, 0]], "anchors.low must be three numbers"),
        ("anchors.low", [0, 0, math.nan], "anchors.low must be finite"),
        ("anchors.number", None, "anchors.number must be given"),
        ("anchors.number", 2, "the number of anchors must be 3 to 256, got 2"),
        ("anchors.number", 257, "the number of anchors must be 3 to 256, got 257"),
        ("anchors.number", 4.5, "the number of anchors must be a whole number"),
        ("region.high", [7, 5, -1], "region: low must lie below high"),
        ("region.high", [1, 1, 0], "region must not be empty"),
        ("region.high", [9, 5, 2], "region must lie inside the room"),
        ("region.high", [7, 5, 4], "region must lie inside the room"),
        ("region.size", 1, "region has an unknown key 'size'"),
        (
            "region.position_m",
            0.3,
            "region has an unknown key 'position_m'; it may have low and high",
        ),
        ("region.heading_deg", 3, "use [[zones]] in place of [region]"),
        ("region.high", None, "region must have the key 'high'"),
        ("obstacles", {"low": 1}, "obstacles must be a list"),
        ("obstacles.0", 4, "obstacles[0] must be a table"),
        ("obstacles.0.low", [5, 2, 0], "obstacles[0]: low must lie below high"),
        ("obstacles.0.title", "rack", "obstacles[0] has an unknown key 'title'"),
        ("obstacles", [{"low": [0, 0, 0], "high": [8, 6, 2]}], "obstacles[0] covers the whole"),
        (
            "obstacles",
            [{"low": [0, 0, -1], "high": [4, 6, 2]}, {"low": [4, 0, -1], "high": [8, 6, 2]}],
            "obstacles leave no free place in the region",
        ),
        ("body", {}, "body must have either tags"),
        ("body.tags", [[0, 0, 0]], "body must have either tags"),
        ("body.shape", "sphere", "body.shape must be one of"),
        ("body.size_m", -1, "body: size_m must be a finite number"),
        ("body", {"tags": [[0, 0, 0], [1, 0, 0]]}, "tags must be at least 3"),
        ("body", {"tags": [[0, 0, 0], [1, 1, 0], [2, 2, 0]]}, "tags must be at least 3 and not on"),
        ("body", {"tags": [[0, 0, 0], [0, 0, 0], [0, 0, 0]]}, "tags must be at least 3 and not on"),
        ("body", {"tags": [[0, 0]]}, "body.tags must have shape"),
        ("body", {"tags": [[0, 0, 0]], "size_m": 1}, "body.size_m must be left out"),
        ("noise.floor_m", -0.1, "noise: floor_m must be a finite number"),
        ("noise.proportional", -0.1, "noise: proportional must be a finite number"),
        ("noise.floor_m", 0, "noise: floor_m and proportional must not both be zero"),
        ("noise.std", 0.1, "noise has an unknown key 'std'; it may have floor_m, proportional"),
        ("noise.kind", "loud", "noise.kind must be one of 'range', 'squared-range'"),
        ("noise.kind", "squared-range", "noise has an unknown key 'floor_m'; it may have sigma_m"),
        ("noise.blocked_information", 2, "noise.blocked_information must be a finite number"),
        ("prior.position_m", 0, "prior.position_m must be a finite number"),
        ("prior.angle", 0, "prior has an unknown key 'angle'"),
        ("name", 3, "name must be a printable text"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(path, value, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        scene_files.of_mapping(changed(path, value))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_anchors_without_a_legal_place():
    tables = changed("anchors", {"kind": "box", "low": [0, 0, 3], "high": [2, 2, 3], "number": 4})
    tables["obstacles"] = [{"low": [-1, -1, 2.5], "high": [3, 3, 4]}]
    with pytest.raises(ValueError, match="no anchor can be mounted"):
        scene_files.of_mapping(tables)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scene": "moon"}, "scene must be one of"),
        ({"scene": "camsap2013"}, "scene must have a volume, that of"),
        ({"scene": "uwb_room", "n_anchors": 2}, "the number of anchors must be 3 to 256"),
        ({"scene": "uwb_room", "racks": 3}, "racks must be"),
        ({"scene": "satellite", "racks": 1}, "racks must be 0 outside a named room"),
        ({"scene": "x.toml", "racks": 1}, "racks must be 0 with a file"),
        ({"scene": "uwb_room", "region": ([0, 0, 0], [11, 1, 1])}, "region must lie inside"),
        ({"scene": "uwb_room", "region": ([2, 2, 2], [1, 1, 1])}, "region: low must lie below"),
        ({"scene": "uwb_room", "region": ([math.inf, 2, 2], [1, 1, 1])}, "region low must be fin"),
    ],
)
def test_what_is_wrong_with_a_named_scene_is_named(arguments, message):
    with pytest.raises(ValueError, match="^" + message):
        scene_files.problem(**arguments)


@pytest.mark.parametrize(
    ("name", "text"), [("a.toml", "[anchors\n"), ("a.json", "{"), ("b.json", "[1]")]
)
def test_files_that_cannot_be_read_are_named(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError, match=str(path)):
        scene_files.problem(str(path))
    with pytest.raises(FileNotFoundError):
        scene_files.problem(str(tmp_path / "none.toml"))

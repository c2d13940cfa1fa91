"""Named scenes, and overrides from plain dicts.

`get` returns the `Scene` of a name, or of a JSON-able dict of overrides with the key ``"name"``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

from rbl_gym.checks import as_tuples, check_array, did_you_mean, imported
from rbl_gym.geometry import bodies, rotations
from rbl_gym.geometry.regions import Box, Shell, Walls
from rbl_gym.measurements.ranging import RangeNoise, SquaredRangeNoise
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.worlds import overrides, scene_source
from rbl_gym.worlds.scene import Scene

__all__ = ["SCENES", "get"]

# Readers of files, by suffix. They are entry points, as in Gymnasium, of packages above this one.
READERS = {
    ".toml": "rbl_gym.placement.file_scenes:scene_of_file",
    ".json": "rbl_gym.placement.file_scenes:scene_of_file",
    ".csv": "rbl_gym.placement.layout_files:read_layout",
}


def _per_step(translation_m: float, rotation_deg: float, dt: float) -> ProcessNoise:
    """Return process noise given by standard deviations per step of `dt` seconds."""
    return ProcessNoise(math.radians(rotation_deg) / dt**0.5, translation_m / dt**0.5)


SCENES: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        Scene(
            name="uwb_room",
            volume=Box((1, 1, 0.5), (9, 7, 2.2)),
            anchor_region=Walls((0, 0, 0.3), (10, 8, 3)),
            n_anchors=6,
            anchors=((0, 0, 0.4), (10, 0, 2.8), (10, 8, 0.4), (0, 8, 2.8), (5, 0, 0.4), (5, 4, 3)),
            tags=as_tuples(bodies.octahedron(0.8)),
            noise=RangeNoise(0.10, 0.0),
            blocked_information=0.01,  # behind the racks drawn by placement
            process=_per_step(0.03, 1.5, 0.1),
            dt=0.1,
            speed_m_s=1.0,
            spin_rad_s=0.29,
            initial_rotation_rad=math.radians(10),
            initial_translation_m=0.5,
        ),
        Scene(
            name="drone_yard",
            volume=Box((-50, -50, 5), (50, 50, 40)),
            anchor_region=Box((-60, -60, 0), (60, 60, 6)),
            n_anchors=6,
            anchors=(
                (-60, -60, 0), (60, -60, 6), (60, 60, 0), (-60, 60, 6), (0, -60, 0), (0, 60, 6),
            ),
            tags=as_tuples(bodies.octahedron(1.0)),
            noise=RangeNoise(0.10, 0.001),
            process=_per_step(0.1, 1.5, 0.1),
            dt=0.1,
            speed_m_s=5.0,
            spin_rad_s=0.29,
            initial_rotation_rad=math.radians(10),
            initial_translation_m=1.0,
        ),
        Scene(
            name="auv_buoys",
            volume=Box((-150, -150, -80), (150, 150, -20)),
            anchor_region=Box((-200, -200, 0), (200, 200, 0)),
            n_anchors=4,
            anchors=((-150, -150, 0), (150, -150, 0), (150, 150, 0), (-150, 150, 0)),
            anchor_speed_m_s=4.0,
            tags=as_tuples(bodies.pyramid(2.0)),
            noise=RangeNoise(0.05, 0.001),
            process=_per_step(0.3, 2.0, 1.0),
            dt=1.0,
            speed_m_s=1.5,
            spin_rad_s=0.03,
            initial_rotation_rad=math.radians(10),
            initial_translation_m=3.0,
        ),
        Scene(
            name="satellite",
            volume=Box((-5, -5, -5), (5, 5, 5)),
            anchor_region=Shell(50, 300),
            n_anchors=5,
            anchors=((100, 0, -35), (-35, 94, -35), (-65, -67, -35), (0, 0, 100), (60, 60, 60)),
            anchor_speed_m_s=1.0,
            tags=as_tuples(bodies.octahedron(2.0)),
            noise=RangeNoise(0.02, 0.0002),
            process=_per_step(0.02, 1.0, 1.0),
            dt=1.0,
            speed_m_s=0.05,
            spin_rad_s=0.012,
            initial_rotation_rad=math.radians(5),
            initial_translation_m=0.5,
        ),
        Scene(
            name="auv_craft",
            volume=Box((-150, -150, -80), (150, 150, -20)),
            start_volume=Box((-100, -100, -80), (100, 100, -20)),
            anchor_region=Box((-600, -600, 0), (600, 600, 0)),
            n_anchors=3,
            anchor_start_m=150.0,
            anchor_speed_m_s=4.0,
            tags=as_tuples(bodies.pyramid(2.0)),
            noise=RangeNoise(0.05, 0.002),
            process=_per_step(0.3, 2.0, 2.0),
            dt=2.0,
            speed_m_s=1.5,
            spin_rad_s=0.03,
            initial_rotation_rad=math.radians(10),
            initial_translation_m=3.0,
        ),
        Scene(
            name="hall",
            volume=Box((-17, -8, 0.5), (17, 8, 3)),
            anchor_region=Walls((-20, -10, 0), (20, 10, 6)),
            n_anchors=12,
            anchors=(
                (20, 2.679, 4.125), (20, 10, 5.486), (5.359, 10, 4.878), (-5.359, 10, 2.126),
                (-20, 10, 2.501), (-20, 2.679, 5.368), (-20, -2.679, 1.026), (-20, -10, 5.106),
                (-5.359, -10, 4.985), (5.359, -10, 3.34), (20, -10, 2.515), (20, -2.679, 2.392),
            ),
            obstacles=(
                (-8, 2, 1.5, 0.5, 5, 1.5), (0, -3, 2, 0.5, 4, 2),
                (9, 1, 1.5, 4, 0.5, 1.5), (5, -6, 1.2, 3, 0.5, 1.2),
            ),
            tags=as_tuples(bodies.octahedron(0.8)),
            noise=RangeNoise(0.10, 0.005),
            process=_per_step(0.05, 2.0, 0.2),
            dt=0.2,
            speed_m_s=2.0,
            spin_rad_s=0.2,
            initial_rotation_rad=math.radians(10),
            initial_translation_m=0.5,
        ),
        Scene(
            name="camsap2013",
            volume=Box((0, 0, 0), (0, 0, 0)),
            anchor_region=Box((-1000, -1000, -1000), (1000, 1000, 1000)),
            n_anchors=4,
            # One draw from the cube for all trials, as in the paper's figures.
            anchors=(
                (738.506, -150.447, 822.880),
                (165.416, 353.081, 912.661),
                (101.213, -0.828, -201.236),
                (-309.327, 950.538, -572.864),
            ),
            tags=as_tuples(bodies.pyramid(1.0)),
            noise=SquaredRangeNoise(0.0316),
            process=ProcessNoise(math.radians(0.1), 1.0),
            dt=1.0,  # not printed: an assumption
            steps=20,
            trajectory="constant",
            twist=(*[math.radians(1.0)] * 3, 1.0, 1.0, 1.0),  # 1_3 deg/s and 1_3 m/s
            start_rotation=as_tuples(np.eye(3)),
            start_translation=(0.0, 0.0, 0.0),
            # 100 I12 of the paper: pose information of .02 and .01, that is 50 and 100.
            initial_rotation_rad=math.sqrt(50.0),
            initial_translation_m=10.0,
            prior="start",
        ),
        Scene(
            name="icassp2013",
            volume=Box((0, 0, 0), (10, 10, 10)),
            anchor_region=Box((0, 0, 0), (100, 100, 100)),
            n_anchors=10,
            tags=as_tuples(bodies.icassp2013()),
            # A reference range of 80 dB: a standard deviation of 1e-4 times the range.
            noise=RangeNoise(0.0, 1e-4, reference_tag=0),
            process=ProcessNoise(),
            dt=1.0,
            trajectory="constant",
            start_rotation=as_tuples(
                rotations.from_euler_zyx(*np.deg2rad([10.0, -25.0, 20.0]))
            ),
            start_translation=(5.0, 5.0, 5.0),
            initial_rotation_rad=math.radians(60),
            initial_translation_m=5.0,
        ),
    )
}  # fmt: skip


def get(scene: str | Mapping[str, Any] | Scene) -> Scene:
    """Return the scene of a name, or a named scene with overrides.

    Parameters
    ----------
    scene
        A name of `SCENES`, or a mapping with the key ``"name"`` and fields of `Scene` to change.
        Nested fields take mappings: ``{"name": "uwb_room", "steps": 50, "links":
        {"drop_probability": 0.1}, "noise": {"floor_m": 0.2}}``.

        * ``"kind"`` in a nested mapping selects another kind. Regions: ``"box"``, ``"walls"``,
          ``"shell"``. Noise (`noise_laws.NOISE_FORMS`): ``"range"``, ``"squared-range"``,
          ``"reference-range"`` with `db`, ``"time-of-arrival"`` with `speed_m_s`, `n_samples`,
          `kappa` and `snr`.
        * If `n_anchors` changes but `anchors` does not, every reset draws the positions in the
          anchor region. A file with positions of all anchors refuses another `n_anchors`.
        * ``"stretch": [x, y, z]`` multiplies the volume, the anchor region (box or walls), the
          anchors and the obstacles by a factor for each axis, after all other changes.
        * A ``"name"`` that ends in ``.toml`` or ``.json`` is the path of a file: overrides with the
          key ``"name"`` of a named scene, or a building file (docs/building_files.md), see
          `rbl_gym.placement.file_scenes.scene_of_file`.
        * ``"title"`` is a name of your own, for pictures.
        * ``"layout": "layout.csv"`` reads the anchor positions from a file of ``rbl-gym place``.

    Raises
    ------
    ValueError
        If a name or field is unknown, or a value is invalid. Errors in a file have its name and the
        line.
    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, str):
        scene = {"name": scene}
    if not isinstance(scene, Mapping) or "name" not in scene:
        raise ValueError(
            f"scene must be a name or a dict with the key 'name', got {scene!r:.120}; the name is "
            "the scene whose values the dict changes, such as {'name': 'uwb_room', 'steps': 50}"
        )
    special = ("name", "title", "stretch", "layout")
    changes = {key: value for key, value in scene.items() if key not in special}
    base = _named(scene["name"])
    if "layout" in scene:
        if "anchors" in changes:
            raise ValueError("scene must have either anchors or layout, got both")
        changes["anchors"] = as_tuples(
            imported("layout", READERS[".csv"])(scene["layout"]).positions
        )
    if changes.get("n_anchors", base.n_anchors) != base.n_anchors:
        if base.anchors and "anchors" not in changes and _gives_anchors(scene["name"]):
            raise ValueError(
                f"n_anchors must be {base.n_anchors}, the number of anchors in {scene['name']}, "
                f"got {changes['n_anchors']!r:.80}; with anchors=None every reset draws them"
            )
        changes.setdefault("anchors", None)
    anchors = changes.get("anchors")
    if anchors is not None:
        changes.setdefault("fixed", ())
        changes.setdefault("n_anchors", len(check_array("anchors", anchors, ("M", 3))))
    made = overrides.replace(base, changes, "scene", special)
    if "title" in scene:
        title = scene["title"]
        if not isinstance(title, str) or not title:
            raise ValueError(f"scene.title must be a text, got {title!r:.80}")
        made = dataclasses.replace(made, name=title)
    return _stretched(made, scene["stretch"]) if "stretch" in scene else made


def _named(name: Any) -> Scene:
    """Return a scene by its name or by the path of its file."""
    suffix = PurePath(name).suffix.lower() if isinstance(name, str) else ""
    if suffix in READERS and name not in SCENES:
        changes = scene_source.changes_in(name)
        if changes is None:
            return imported("scene", READERS[suffix])(name)
        try:
            return get(changes)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    if not isinstance(name, str) or name not in SCENES:
        raise ValueError(
            f"scene must be one of {', '.join(map(repr, SCENES))}, or a .toml or .json file; got "
            f"{name!r:.80}{did_you_mean(name, SCENES)}. A world of your own changes the values of "
            "a named scene: {'name': 'uwb_room', 'title': 'my room', ...}"
        )
    return SCENES[name]


def _gives_anchors(name: str) -> bool:
    """Return whether a scene with positions of anchors has them from a file."""
    if name in SCENES:
        return False
    changes = scene_source.changes_in(name)
    if changes is None:  # a building file
        return True
    own = "layout" in changes or changes.get("anchors") is not None
    return own or _gives_anchors(changes["name"])


def _stretched(scene: Scene, stretch: Any) -> Scene:
    """Return the scene with all positions scaled along the axes; the body does not change."""
    factors = check_array("scene.stretch", stretch, (3,))
    if factors.ndim != 1 or not (factors > 0).all():
        raise ValueError(f"scene.stretch must be three positive numbers, got {stretch!r:.80}")
    values: dict[str, Any] = {}
    for name in ("volume", "start_volume", "anchor_region"):
        region = getattr(scene, name)
        if isinstance(region, Box | Walls):
            low, high = (tuple((corner * factors).tolist()) for corner in region.bounds())
            values[name] = dataclasses.replace(region, low=low, high=high)
        elif region is not None:
            raise ValueError(
                f"scene.stretch scales boxes and walls only, but {name} of {scene.name!r} is "
                f"{region!r:.80}"
            )
    for name in ("anchors", "obstacles", "start_translation"):
        places = getattr(scene, name)
        if places:
            row = np.resize(factors, np.shape(places)[-1])
            values[name] = as_tuples(np.array(places) * row)
    return dataclasses.replace(scene, **values)

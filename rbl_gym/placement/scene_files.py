"""Placement problems from files: where anchors may stand, what blocks sight, where the body works.

A TOML or JSON file, or a named scene with a work region, becomes a `Problem`; the format stands
in docs/placement.md. Lengths are metres, a box is given by its corners `low` and `high`.
"""

from __future__ import annotations

import dataclasses
import json
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import placement
from rbl_gym.checks import FloatArray, check_array, check_number, check_one_of
from rbl_gym.geometry import bodies
from rbl_gym.geometry.obstacles import Obstacles, inside
from rbl_gym.geometry.regions import Box, Shell, Walls
from rbl_gym.measurements.ranging import NOISE_LAWS, NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.placement.problem import Context, PlacementTask
from rbl_gym.worlds import scenes
from rbl_gym.worlds.scene import Scene

__all__ = ["Problem", "free_points", "inside", "load", "of_mapping", "problem", "with_anchors"]

REGIONS = {"room": Walls, "box": Box, "shell": Shell}
BODIES = {
    "octahedron": bodies.octahedron,
    "pyramid": bodies.pyramid,
    "cube": bodies.cube,
    "plate": lambda size_m: bodies.plate(size_m, size_m),
}
# Fewer anchors never tell a pose; three leave its mirror image in their plane.
MIN_ANCHORS, MAX_ANCHORS = 3, 64
# Keys of each table of a file; those of [anchors] and [noise] depend on their kind.
_KEYS = {
    "the file": ("name", "anchors", "region", "obstacles", "body", "noise", "prior"),
    "region": ("low", "high"),
    "body": ("shape", "size_m", "tags"),
    "prior": ("rotation_deg", "position_m"),
}
# What is known before the first range where a file does not say.
_PRIOR_ROTATION_DEG, _PRIOR_POSITION_M = 10.0, 0.5
# Irrational steps that fill the cube evenly (Roberts's sequence in three dimensions).
_STEPS = 1.22074408460575947536 ** -np.arange(1.0, 4.0)


class Problem(NamedTuple):
    """A placement problem: the task and its context.

    The volume of the task's scene is the work region, and its obstacles are all there are.
    """

    task: PlacementTask
    context: Context

    @property
    def name(self) -> str:
        """The scene's."""
        return self.task.scene.name

    @property
    def obstacles(self) -> Obstacles:
        """What stands in the way."""
        return self.task.obstacles(self.context)

    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the work region."""
        return self.task.scene.volume.bounds()


def problem(
    scene: str,
    n_anchors: int | None = None,
    region: tuple[ArrayLike, ArrayLike] | None = None,
    racks: int = 0,
    seed: int = 0,
) -> Problem:
    """The problem of a named scene, or of a file (.toml, .json).

    Parameters
    ----------
    scene
        Name or path.
    n_anchors
        How many are placed; None: what the scene or file says.
    region
        Corners of the work region in place of the scene's volume or the file's region.
    racks, seed
        In a named room: boxes on the floor that block sight, drawn by the seed, besides those
        that the scene has.

    Raises
    ------
    ValueError
        On anything that cannot be placed: see `check`.
    """
    if Path(scene).suffix.lower() in (".toml", ".json"):
        if racks:
            raise ValueError(f"racks must be 0 with a file, got {racks}: list them as obstacles")
        tables = load(scene)
        try:
            return of_mapping(tables, n_anchors, region, name=Path(scene).stem)
        except ValueError as error:
            raise ValueError(f"{scene}: {error}") from error
    known = scenes.get(check_one_of("scene", scene, list(scenes.SCENES)))
    task = placement.task(known, n_anchors, racks)
    context = placement.whole_volume(task)
    if racks:
        context = placement.draw_contexts(task, np.random.default_rng([seed, racks]))
    return _checked(known, task.n_anchors, context.racks, region)


def load(path: str) -> dict[str, Any]:
    """The tables of a TOML or JSON file; a ValueError names the file and what is wrong in it."""
    data = Path(path).read_bytes()
    try:
        text = data.decode("utf-8")
        found = tomllib.loads(text) if path.lower().endswith(".toml") else json.loads(text)
    # Both parsers recurse into what is nested.
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from error
    return _table(found, path)


def of_mapping(
    tables: Mapping[str, Any],
    n_anchors: int | None = None,
    region: tuple[ArrayLike, ArrayLike] | None = None,
    name: str = "file",
) -> Problem:
    """The problem that the tables of a file describe. Arguments as `problem`."""
    _check_keys(tables, "the file", _KEYS["the file"], ("anchors", "region", "body", "noise"))
    parts = {
        key: _table(tables.get(key, {}), key)
        for key in ("anchors", "region", "body", "noise", "prior")
    }
    for key in ("region", "body", "prior"):
        _check_keys(parts[key], key, _KEYS[key], ("low", "high") if key == "region" else ())
    noise, blocked = _noise(parts["noise"])
    prior = parts["prior"]
    number = parts["anchors"].get("number") if n_anchors is None else n_anchors
    if number is None:
        raise ValueError("anchors.number must be given, in the file or by --anchors")
    low, high = (_corner(f"region.{key}", parts["region"][key]) for key in ("low", "high"))
    scene = Scene(
        name=_text(tables.get("name", name)),
        volume=_named("region", Box, low=low, high=high),
        anchor_region=_anchor_region(parts["anchors"]),
        n_anchors=check_n_anchors(number),
        tags=_tags(parts["body"]),
        noise=noise,
        blocked_information=blocked,
        process=ProcessNoise(),
        dt=1.0,
        initial_rotation_rad=math.radians(
            check_number(
                "prior.rotation_deg",
                prior.get("rotation_deg", _PRIOR_ROTATION_DEG),
                low=1e-6,
                high=180.0,
            )
        ),
        initial_translation_m=check_number(
            "prior.position_m", prior.get("position_m", _PRIOR_POSITION_M), low=1e-6
        ),
    )
    obstacles = _obstacles(tables.get("obstacles", []))
    return _checked(scene, scene.n_anchors, obstacles, region)


def with_anchors(problem: Problem, n_anchors: int) -> Problem:
    """The same problem with another number of anchors."""
    return _checked(problem.task.scene, n_anchors, problem.context.racks, None)


def check_n_anchors(number: Any) -> int:
    """A number of anchors that can tell a pose, or a ValueError."""
    if isinstance(number, bool) or not isinstance(number, int):
        raise ValueError(f"the number of anchors must be a whole number, got {number!r:.80}")
    if not MIN_ANCHORS <= number <= MAX_ANCHORS:
        raise ValueError(
            f"the number of anchors must be {MIN_ANCHORS} to {MAX_ANCHORS}, got {number}: "
            "fewer than 3 never tell a pose"
        )
    return number


def free_points(low: FloatArray, high: FloatArray, obstacles: FloatArray, count: int) -> FloatArray:
    """Up to `count` points (n, 3) spread evenly over a box, those inside obstacles left out.

    The box from `low` to `high` (3,), `obstacles` (K, 6) as centres and half sizes; metres.
    """
    points = low + _cube(4 * count if len(obstacles) else count) * (high - low)
    return points[~inside(points, obstacles)][:count]


def _cube(count: int) -> FloatArray:
    """Points (count, 3) that fill the unit cube evenly."""
    return (0.5 + np.arange(1, count + 1)[:, None] * _STEPS) % 1.0


# --- checks ----------------------------------------------------------------------------------


def _checked(
    scene: Scene,
    n_anchors: int,
    boxes: FloatArray,
    region: tuple[ArrayLike, ArrayLike] | None,
) -> Problem:
    """The problem, whose scene has the work region as its volume, if it can be solved at all."""
    volume = scene.volume
    if region is not None:
        low, high = (
            _corner(f"region {name}", corner)
            for name, corner in zip(("low", "high"), region, strict=True)
        )
        volume = _named("region", Box, low=low, high=high)
    n_anchors = check_n_anchors(n_anchors)
    scene = dataclasses.replace(
        scene,
        volume=volume,
        n_anchors=n_anchors,
        anchors=None,
        start_translation=None,
        obstacles=boxes,
    )
    _check_region(scene)
    _check_tags(np.asarray(scene.tags))
    _check_obstacles(scene)
    task = PlacementTask(scene, n_anchors)
    return Problem(task, placement.whole_volume(task))


def _check_region(scene: Scene) -> None:
    """The work region must have an extent, and lie in the room where there is one."""
    low, high = scene.volume.bounds()
    if not (high > low).any():
        raise ValueError(f"region must not be empty, got low = high = {_show(low)}")
    if not isinstance(scene.anchor_region, Walls):
        return
    floor, ceiling = scene.anchor_region.bounds()
    # The room begins at the lowest mounts: the body may work below them.
    if (low[:2] < floor[:2]).any() or (high > ceiling).any():
        raise ValueError(
            f"region must lie inside the room, got {_show(low)} to {_show(high)} in a room "
            f"{_show(floor)} to {_show(ceiling)}"
        )


def _check_tags(tags: FloatArray) -> None:
    spread = np.linalg.svd(tags - tags.mean(axis=0), compute_uv=False)
    if len(tags) < 3 or spread[1] <= 1e-9 * max(spread[0], 1e-300):
        raise ValueError(
            f"tags must be at least 3 and not on one line, got {len(tags)}: no ranges tell how "
            "such a body is turned"
        )


def _check_obstacles(scene: Scene) -> None:
    """Obstacles must leave room for the body and for anchors."""
    obstacles = scene.obstruction
    low, high = scene.volume.bounds()
    for index, (centre, half) in enumerate(obstacles.boxes.reshape(-1, 2, 3)):
        if (centre - half <= low).all() and (centre + half >= high).all():
            raise ValueError(f"obstacles[{index}] swallows the whole region")
    if not len(free_points(low, high, obstacles.boxes, 1000)):
        raise ValueError("obstacles leave no free place in the region")
    if obstacles.contain(scene.anchor_region.draw(_cube(4000))).all():
        raise ValueError("anchors have no legal place: obstacles cover all of them")


# --- the tables of a file --------------------------------------------------------------------


def _anchor_region(table: dict[str, Any]) -> Walls | Box | Shell:
    if "kind" not in table:
        raise ValueError(f"anchors.kind must be given: one of {', '.join(map(repr, REGIONS))}")
    kind = REGIONS[check_one_of("anchors.kind", table["kind"], list(REGIONS))]
    sizes = ("inner_m", "outer_m") if kind is Shell else ("low", "high")
    _check_keys(table, "anchors", ("kind", "number", *sizes), sizes)
    if kind is Shell:
        return _named("anchors", Shell, **{key: table[key] for key in sizes})
    return _named("anchors", kind, **{key: _corner(f"anchors.{key}", table[key]) for key in sizes})


def _noise(table: dict[str, Any]) -> tuple[NoiseLaw, float]:
    """The law of the ranges, and what is left of a link's information without sight."""
    law = NOISE_LAWS[check_one_of("noise.kind", table.get("kind", "range"), list(NOISE_LAWS))]
    sizes = [field.name for field in dataclasses.fields(law)]  # pyright: ignore[reportArgumentType]
    _check_keys(table, "noise", (*sizes, "kind", "blocked_information"))
    blocked = check_number(
        "noise.blocked_information", table.get("blocked_information", 0.01), low=0.0, high=1.0
    )
    return _named("noise", law, **{key: table[key] for key in sizes if key in table}), blocked


def _tags(table: dict[str, Any]) -> Any:
    if ("tags" in table) == ("shape" in table):
        raise ValueError("body must have either tags, a list of [x, y, z], or a shape")
    if "tags" not in table:
        shape = BODIES[check_one_of("body.shape", table["shape"], list(BODIES))]
        tags = _named("body", shape, size_m=table.get("size_m", 1.0))
    elif "size_m" in table:
        raise ValueError("body.size_m means nothing beside tags")
    else:
        tags = check_array("body.tags", table["tags"], ("N", 3))
    return tuple(map(tuple, tags.tolist()))


def _obstacles(tables: Any) -> FloatArray:
    """Rows (K, 6) of centres and half sizes."""
    if not isinstance(tables, list):
        raise ValueError(f"obstacles must be a list of tables, got {tables!r:.80}")
    rows = []
    for index, table in enumerate(tables):
        name = f"obstacles[{index}]"
        _check_keys(_table(table, name), name, ("low", "high"), ("low", "high"))
        low, high = (np.array(_corner(f"{name}.{key}", table[key])) for key in ("low", "high"))
        if not (high > low).all():
            raise ValueError(f"{name}: low must lie below high, got {_show(low)}, {_show(high)}")
        rows.append([*0.5 * (low + high), *0.5 * (high - low)])
    return np.array(rows).reshape(-1, 6)


def _table(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a table of keys, got {value!r:.80}")
    return dict(value)


def _check_keys(
    table: Mapping[str, Any], name: str, allowed: tuple[str, ...], needed: tuple[str, ...] = ()
) -> None:
    for key in table:
        if key not in allowed:
            raise ValueError(f"{name} has an unknown key {key!r}; it may have {', '.join(allowed)}")
    for key in needed:
        if key not in table:
            raise ValueError(f"{name} must have the key {key!r}")


def _named(name: str, make: Any, **arguments: Any) -> Any:
    """What `make` makes of the arguments; its errors begin with the table's name."""
    try:
        return make(**arguments)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _corner(name: str, value: Any) -> tuple[float, ...]:
    array = check_array(name, value, (3,))
    if array.ndim != 1:
        raise ValueError(f"{name} must be three numbers, got shape {array.shape}")
    return tuple(array.tolist())


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value or not value.isprintable():
        raise ValueError(f"name must be a printable text, got {value!r:.80}")
    return value


def _show(corner: FloatArray) -> str:
    return "(" + ", ".join(f"{value:g}" for value in corner) + ")"

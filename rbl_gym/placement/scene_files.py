"""Placement problems from files: a building, its mounts, and zones in which the body works.

A TOML or JSON file, or a named scene with a work region, becomes a `Problem`. The format is defined
by `file_keys.FORMAT`; docs/building_files.md is its reference.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import placement
from rbl_gym.checks import FloatArray, as_tuples, check_array, check_number, did_you_mean
from rbl_gym.geometry.obstacles import Prisms, inside
from rbl_gym.geometry.polygons import rectangle
from rbl_gym.geometry.regions import Box, Region, Shell, Walls
from rbl_gym.measurements.gain import Gain
from rbl_gym.measurements.ranging import NOISE_LAWS, NoiseLaw
from rbl_gym.placement.building import Plan, Problem, Zone
from rbl_gym.placement.file_checks import check_numbers, check_problem
from rbl_gym.placement.file_keys import BODIES, FORMAT, MAX_ANCHORS, MIN_ANCHORS
from rbl_gym.placement.file_lines import advice, line_of
from rbl_gym.placement.file_tables import as_table, check_text, read_table
from rbl_gym.placement.file_walls import Built, read_mounts, read_obstacles, show
from rbl_gym.placement.mounting import cut_mounts
from rbl_gym.placement.outline import outside
from rbl_gym.placement.sides import wrong_sides
from rbl_gym.worlds import scenes

__all__ = ["Problem", "inside", "load", "of_mapping", "problem", "with_anchors"]

_REGIONS = {"room": Walls, "box": Box, "shell": Shell}
_REQUIREMENTS = ("position_m", "height_m", "heading_deg")
# Fields of a named scene that its problem has.
_SHARED = (
    "name", "tags", "noise", "anchor_region", "blocked_information", "initial_rotation_rad",
    "initial_translation_m",
)  # fmt: skip


def problem(
    scene: str,
    n_anchors: int | None = None,
    region: tuple[ArrayLike, ArrayLike] | None = None,
    racks: int = 0,
    seed: int = 0,
) -> Problem:
    """Return the problem of a named scene, or of a file (.toml, .json).

    Parameters
    ----------
    scene
        Name or path.
    n_anchors
        Number of anchors; None: the number in the scene or file.
    region
        Corners of the work region, instead of the scene's volume or the file's zones.
    racks, seed
        In a named room: number of boxes on the floor that block sight, in addition to those of the
        scene, and the seed with which they are drawn.

    Raises
    ------
    ValueError
        If the problem is invalid; the message names the table of the file.
    MissingExtraError
        If the file has ``[[mounts]]`` and shapely is not installed.
    """
    if Path(scene).suffix.lower() in (".toml", ".json"):
        if racks:
            raise ValueError(
                f"racks must be 0 with a file, got {racks}: list the racks as obstacles in the file"
            )
        tables = load(scene)
        path = Path(scene)
        try:
            return of_mapping(tables, n_anchors, region, name=path.stem, folder=path.parent)
        except ValueError as error:
            line = line_of(path.read_text(encoding="utf-8"), str(error))
            where = "" if line is None or path.suffix.lower() != ".toml" else f" (line {line})"
            raise ValueError(f"{scene}: {error}{where}") from error
    known = scenes.get(scene)
    task = placement.task(known, n_anchors, racks)
    context = placement.whole_volume(task)
    if racks:
        context = placement.draw_contexts(task, np.random.default_rng([seed, racks]))
    low, high = known.volume.bounds() if region is None else _corners("region", region)
    return check_problem(
        Problem.of(
            (_box_zone("region", low, high),),
            check_n_anchors(task.n_anchors),
            obstacles=as_tuples(context.racks),
            **{key: getattr(known, key) for key in _SHARED},
        )
    )


def load(path: str) -> dict[str, Any]:
    """Return the tables of a TOML or JSON file; a ValueError names the file and the error."""
    data = Path(path).read_bytes()
    try:
        text = data.decode("utf-8")
        found = tomllib.loads(text) if path.lower().endswith(".toml") else json.loads(text)
    # Both parsers recurse into nested values.
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}{advice(data, str(error))}") from error
    return as_table(found, path)


def of_mapping(
    tables: Mapping[str, Any],
    n_anchors: int | None = None,
    region: tuple[ArrayLike, ArrayLike] | None = None,
    name: str = "file",
    folder: str | Path = ".",
) -> Problem:
    """Return the problem described by the tables of a file.

    Parameters
    ----------
    tables, n_anchors, region
        As in `problem`.
    name
        Name if the file has none.
    folder
        Folder of relative paths in the file.
    """
    _check_tables(tables)
    lists = {key: _rows(tables, key) for key, table in FORMAT.items() if table.many}
    anchors = as_table(tables.get("anchors", {}), "anchors")
    if "kind" not in anchors and not lists["mounts"]:
        kinds = ", ".join(map(repr, _REGIONS))
        raise ValueError(f"anchors.kind must be given: one of {kinds}; or [[mounts]]")
    anchors = read_table("anchors", anchors)
    noise, blocked = _noise(tables["noise"])
    prior = read_table("prior", tables.get("prior", {}))
    built = read_obstacles(lists, _materials(tables.get("materials", {})), blocked)
    number = anchors["number"] if n_anchors is None else n_anchors
    if number is None:
        raise ValueError("anchors.number must be given, in the file or by --anchors")
    if region is not None:
        zones = (_box_zone("region", *_corners("region", region)),)
    elif "region" in tables:
        zones = (_region(tables["region"]),)
    else:
        zones = _zones(lists["zones"])
    found = check_problem(
        Problem.of(
            zones,
            check_n_anchors(number),
            anchors["fixed"],
            _plan(tables, Path(folder)),
            name=check_text("name", tables.get("name", name)),
            tags=as_tuples(_tags(tables["body"])),
            noise=noise,
            obstacles=as_tuples(built.obstacles.boxes),
            prisms=built.obstacles.prisms,
            blocked_information=blocked,
            anchor_region=_mounts(anchors, lists, built),
            gain=_gain(anchors),
            initial_rotation_rad=math.radians(prior["rotation_deg"]),
            initial_translation_m=prior["position_m"],
        )
    )
    found = replace(found, obstacle_names=built.names)
    if not lists["mounts"]:
        return found
    mounts = read_mounts(lists["mounts"], built.walls)
    notes = outside(found, built.walls, mounts)
    return replace(found, notes=notes + wrong_sides(found, lists["mounts"], built.walls, mounts))


def with_anchors(problem: Problem, n_anchors: int) -> Problem:
    """Return the same problem with another total number of anchors, including fixed ones."""
    problem = problem.with_anchors(check_n_anchors(n_anchors))
    check_numbers(problem)
    return problem


def check_n_anchors(number: Any) -> int:
    """Return a number of anchors that can determine a pose; raises ValueError otherwise."""
    if isinstance(number, bool) or not isinstance(number, int):
        raise ValueError(f"the number of anchors must be a whole number, got {number!r:.80}")
    if not MIN_ANCHORS <= number <= MAX_ANCHORS:
        raise ValueError(
            f"the number of anchors must be {MIN_ANCHORS} to {MAX_ANCHORS}, got {number}"
            f"{': fewer than 3 never determine a pose' * (number < MIN_ANCHORS)}"
        )
    return number


# --- the tables of a file --------------------------------------------------------------------


def _check_tables(tables: Mapping[str, Any]) -> None:
    """Check that there are only tables of the format, and all required ones."""
    allowed = ("name", *FORMAT, "materials", "$schema")
    for key in tables:
        if key not in allowed:
            raise ValueError(
                f"the file has an unknown key {key!r:.80}; it may have {', '.join(allowed)}"
                f"{did_you_mean(key, allowed)}"
            )
    needed = ["body", "noise"]
    if not tables.get("mounts"):
        needed.insert(0, "anchors")
    if not tables.get("zones"):
        needed.insert(-2, "region")
    for key in needed:
        if key not in tables:
            raise ValueError(f"the file must have the key {key!r}{_INSTEAD.get(key, '')}")
    if "region" in tables and tables.get("zones"):
        raise ValueError("the file must have either [region] or [[zones]], got both")


_INSTEAD = {"anchors": " or [[mounts]]", "region": " or [[zones]]"}


def _rows(tables: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    """Return the values of all tables of a list."""
    rows = tables.get(name, [])
    if not isinstance(rows, list):
        raise ValueError(f"{name} must be a list of tables, [[{name}]], got {rows!r:.80}")
    return [read_table(f"{name}[{index}]", row, name) for index, row in enumerate(rows)]


def _materials(table: Any) -> dict[str, float]:
    return {
        name: check_number(f"materials.{name}", share, low=0.0, high=1.0)
        for name, share in as_table(table, "materials").items()
    }


def _mounts(anchors: dict[str, Any], lists: dict[str, Any], built: Built) -> Region:
    """Return the legal anchor positions."""
    rows, forbidden = lists["mounts"], lists["forbidden"]
    kind: Any = anchors.get("kind")
    if not rows:
        if forbidden:
            raise ValueError(
                f"forbidden has no effect with anchors.kind = {kind!r}: use [[mounts]]"
            )
        sizes = ("inner_m", "outer_m") if kind == "shell" else ("low", "high")
        return _named("anchors", _REGIONS[kind], **{key: anchors[key] for key in sizes})
    if kind is not None:
        raise ValueError("the file must have either anchors.kind or [[mounts]], got both")
    # Where a wall is open there is no face.
    bans = [*forbidden, *built.gaps]
    columns = [[row[key] for row in bans] for key in ("polygon", "low_m", "high_m")]
    mounts = cut_mounts(
        read_mounts(rows, built.walls), built.obstacles, _named("forbidden", Prisms.of, columns)
    )
    if mounts is None:
        raise ValueError(
            "mounts have no permitted position: obstacles and [[forbidden]] cover them"
        )
    return mounts


def _zones(rows: list[dict[str, Any]]) -> tuple[Zone, ...]:
    zones: list[Zone] = []
    for index, row in enumerate(rows):
        name = f"zones[{index}]"
        asked = {key: row[key] for key in _REQUIREMENTS}
        if row["share"] is not None and not any(asked.values()):
            raise ValueError(f"{name}.share needs one of {', '.join(_REQUIREMENTS)}")
        title = row["name"] or f"zone {index + 1}"
        if title in (zone.name for zone in zones):
            raise ValueError(
                f"{name}.name must differ from the names of the other zones, got {title!r} twice"
            )
        if "polygon" in row:
            polygon, low, high = row["polygon"], row["low_m"], row["high_m"]
        else:
            box = _box_zone(name, row["low"], row["high"])
            polygon, low, high = box.polygon, box.low_m, box.high_m
        share = 0.95 if row["share"] is None else row["share"]
        zones.append(
            Zone(title, polygon, low, high, row["weight"], row["attitude"], **asked, share=share)
        )
    return tuple(zones)


def _region(table: Any) -> Zone:
    for key in as_table(table, "region"):
        if key in (*_REQUIREMENTS, "share"):
            raise ValueError(
                f"region has an unknown key {key!r}; it may have low and high. For a requirement "
                "use [[zones]] in place of [region], each with low, high, "
                f"{', '.join(_REQUIREMENTS)}, share"
            )
    values = read_table("region", table)
    return _box_zone("region", values["low"], values["high"])


def _box_zone(name: str, low: Any, high: Any) -> Zone:
    """Return a box as a zone with this name; it may be flat, not empty."""
    box = _named(name, Box, low=tuple(low), high=tuple(high))
    low, high = box.bounds()
    if not (high > low).any():
        raise ValueError(f"{name} must not be empty, got low = high = {show(low)}")
    return Zone(name, rectangle(low, high), float(low[2]), float(high[2]))


def _noise(table: Any) -> tuple[NoiseLaw, float]:
    """Return the noise law of the ranges, and the information fraction without line of sight."""
    values = read_table("noise", table)
    given = {key: table[key] for key in values if key in table}
    law = NOISE_LAWS[given.pop("kind", values["kind"])]
    given.pop("blocked_information", None)
    return _named("noise", law, **given), values["blocked_information"]


def _tags(table: Any) -> FloatArray:
    table = as_table(table, "body")
    if ("tags" in table) == ("shape" in table):
        raise ValueError("body must have either tags, a list of [x, y, z], or a shape")
    if "tags" in table and "size_m" in table:
        raise ValueError("body.size_m must be left out where body.tags is given")
    values = read_table("body", table)
    if "tags" in values:
        return check_array("body.tags", values["tags"], ("N", 3))
    return _named("body", BODIES[values["shape"]], size_m=values["size_m"])


def _gain(anchors: dict[str, Any]) -> Gain:
    limits = {
        "max_range_m": anchors["max_range_m"],
        "half_angle_rad": anchors["half_angle_deg"] and math.radians(anchors["half_angle_deg"]),
    }
    for edge, limit in (("range_edge_m", "max_range_m"), ("angle_edge_deg", "half_angle_deg")):
        if anchors[edge] and anchors[limit] is None:
            raise ValueError(f"anchors.{edge} needs anchors.{limit}")
        if anchors[limit] is not None and anchors[edge] > anchors[limit]:
            raise ValueError(
                f"anchors.{edge} must be at most anchors.{limit} = {anchors[limit]:g}, "
                f"got {anchors[edge]:g}"
            )
    edges = {
        "range_edge_m": anchors["range_edge_m"],
        "angle_edge_rad": math.radians(anchors["angle_edge_deg"]),
    }
    return _named("anchors", Gain, **{k: v for k, v in limits.items() if v is not None}, **edges)


def _plan(tables: Mapping[str, Any], folder: Path) -> Plan | None:
    if "plan" not in tables:
        return None
    values = read_table("plan", tables["plan"])
    if values["image"] is not None and values["metres_per_pixel"] is None:
        raise ValueError("plan.metres_per_pixel must be given with plan.image")
    for key in ("image", "drawing"):
        if values[key] is not None:
            values[key] = str((folder / values[key]).absolute())
    return Plan(**{key: value for key, value in values.items() if value is not None})


def _named(name: str, make: Any, *rows: Any, **arguments: Any) -> Any:
    """Return the result of `make`; its errors begin with the table's name."""
    try:
        return make(*(rows[0] if rows else ()), **arguments)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _corners(name: str, region: tuple[ArrayLike, ArrayLike]) -> tuple[Any, Any]:
    """Return two corners given as arguments."""
    found = []
    for which, corner in zip(("low", "high"), region, strict=True):
        array = check_array(f"{name} {which}", corner, (3,))
        if array.ndim != 1:
            raise ValueError(f"{name} {which} must be three numbers, got shape {array.shape}")
        found.append(tuple(array.tolist()))
    return found[0], found[1]

"""Files of the studio in one folder: a layout as a scene file and as a list.

The studio writes nothing outside the folder. It writes a new file completely, then replaces the old
one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym.app.studio.state import State, open_state
from rbl_gym.app.studio.world import knobs_of, noise_field
from rbl_gym.checks import FloatArray
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.geometry.regions import Box, Shell, Walls
from rbl_gym.measurements.noise_laws import NOISE_LAWS
from rbl_gym.placement import scene_files
from rbl_gym.placement.building import Problem
from rbl_gym.placement.plans.toml_text import to_toml
from rbl_gym.studies.placing.layout_export import write_layout

# Writes a report of a problem and a layout (M, 3) to a path.
Report = Callable[[Problem, FloatArray, str], None]
# First line of the studio's scene files. Only files with this line are overwritten.
HEAD = "Written by rbl-gym studio."
_AUTOSAVE = "-autosave"


def check_name(name: str) -> str:
    """Return a file name that stays within a folder, or raise ValueError.

    Letters, digits, spaces, ``_``, ``.`` and ``-`` are allowed.
    """
    name = name.strip()
    if not re.fullmatch(r"[\w][\w .-]{0,79}", name) or name.endswith("."):
        raise ValueError(
            f"the name must be letters, digits, spaces, '_', '.', '-', at most 80, got {name!r:.80}"
        )
    return name


def default_name(problem: Problem) -> str:
    """Return the default file name of a problem."""
    plain = re.sub(r"[^\w.-]+", "-", problem.name).strip("-.")[:60] or "scene"
    return plain if plain.endswith("-layout") else f"{plain}-layout"


def save(state: State, tables: Mapping[str, Any], folder: Path, name: str) -> list[Path]:
    """Write NAME.toml, the scene with all anchors fixed, and NAME.csv, the mounting list.

    `tables` are those of the file from which the problem was read, or of `tables_of`. Raises
    ValueError if the name is not valid, or a file of that name was not written by the studio.
    """
    stem = owned(folder, name)
    scene, layout = stem.with_name(f"{stem.name}.toml"), stem.with_name(f"{stem.name}.csv")
    replace(
        scene, lambda path: path.write_text(scene_text(state, tables, folder), encoding="utf-8")
    )
    replace(layout, lambda path: write_layout(state.problem, state.anchors, str(path)))
    return [scene, layout]


def autosave(state: State, tables: Mapping[str, Any], folder: Path) -> Path:
    """Save the current layout in NAME-autosave.toml. Arguments as in `save`."""
    stem = owned(folder, default_name(state.problem) + _AUTOSAVE)
    path = stem.with_name(f"{stem.name}.toml")
    text = scene_text(state, tables, folder)
    replace(path, lambda draft: draft.write_text(text, encoding="utf-8"))
    return path


def last_session(state: State, folder: Path) -> FloatArray | None:
    """Return the anchors of a problem's autosave if they differ from those of the state.

    None if there is no autosave, or if the studio saved the problem in the folder later.
    """
    path = folder / f"{default_name(state.problem)}{_AUTOSAVE}.toml"
    try:
        anchors = scene_files.problem(str(path)).fixed
        open_state(state.world.base, anchors)
        if _is_saved_since(path, state.problem.name):
            return None
    except (ValueError, OSError, ModuleNotFoundError):
        return None
    return None if np.array_equal(anchors, state.anchors) else anchors


def _is_saved_since(autosave: Path, name: str) -> bool:
    """Return whether the studio saved a problem of this name after its autosave."""
    written = autosave.stat().st_mtime_ns
    for path in autosave.parent.glob("[!.]*.toml"):
        # An unreadable file does not count as saved.
        with contextlib.suppress(ValueError, OSError):
            is_later = path.stat().st_mtime_ns > written and _is_ours(path)
            if is_later and scene_files.load(str(path)).get("name") == name:
                return True
    return False


def _is_ours(scene: Path) -> bool:
    with scene.open("rb") as file:
        return file.read(len(HEAD) + 2) == f"# {HEAD}".encode()


def save_report(
    state: State, tables: Mapping[str, Any], folder: Path, name: str, report: Report
) -> list[Path]:
    """Run `save`, and write NAME.pdf by `report`."""
    scene, layout = save(state, tables, folder, name)
    path = scene.with_suffix(".pdf")
    replace(path, lambda draft: report(state.problem, state.anchors, str(draft)))
    return [scene, layout, path]


def names(paths: list[Path]) -> str:
    """Return the names of files, separated by commas."""
    return ", ".join(path.name for path in paths)


def owned(folder: Path, name: str) -> Path:
    """Return folder and name. Raises ValueError if the studio did not write a file of that name."""
    stem = folder / check_name(name)
    scene = stem.with_name(f"{stem.name}.toml")
    if scene.exists():
        others = [] if _is_ours(scene) else [scene]
    else:
        ends = (".csv", ".pdf")
        others = [p for p in (stem.with_name(f"{stem.name}{end}") for end in ends) if p.exists()]
    if others:
        raise ValueError(
            f"{others[0].name} exists and was not written by the studio: choose another name"
        )
    return stem


def replace(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a temporary file, then move it to its path in one step."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    try:
        write(Path(name))
        with open(name, "rb") as file:
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


# --- the scene file --------------------------------------------------------------------------


def scene_text(state: State, tables: Mapping[str, Any], folder: Path) -> str:
    """Return the scene file (TOML) of a state: `tables` with its anchors and its knobs."""
    anchors = state.anchors.tolist()
    head = [
        HEAD,
        f"{len(anchors)} anchors, predicted RMS error of the tags b = {state.score:.4g} m. All "
        "anchors are listed as fixed: `rbl-gym place --scene` judges this layout, `rbl-gym studio` "
        "continues from it.",
    ]
    named = {"name": state.problem.name, **tables}
    changed = {key: value for key, value in named.items() if key != "$schema"}
    changed["anchors"] = {**tables.get("anchors", {}), "number": len(anchors), "fixed": anchors}
    plan = state.world.base.plan
    if plan is not None and "plan" in tables:
        # Paths in a scene file are relative to its folder.
        paths = {key: getattr(plan, key) for key in ("image", "drawing")}
        found = {key: os.path.relpath(path, folder) for key, path in paths.items() if path}
        changed["plan"] = {**tables["plan"], **found}
    return to_toml(_with_knobs(changed, state), head)


def _with_knobs(tables: dict[str, Any], state: State) -> dict[str, Any]:
    """Return the tables with the changed knobs."""
    world, problem = state.world, state.world.problem
    now, was = world.knobs, knobs_of(world.base)
    if now.noise_m != was.noise_m:
        tables["noise"] = {**tables["noise"], noise_field(problem): now.noise_m}
    if now[1:3] != was[1:3]:
        tables["body"] = {"tags": problem.tags.tolist()}
    if now.loss_db == was.loss_db:
        return tables
    blocked = problem.obstacles.blocked_information
    tables["noise"] = {**tables["noise"], "blocked_information": blocked}
    power = now.loss_db / was.loss_db if was.loss_db > 0 else 1.0
    if "materials" in tables:
        tables["materials"] = {k: share**power for k, share in tables["materials"].items()}
    for key in ("walls", "obstacles", "slabs"):
        if key in tables:
            tables[key] = [
                row | {"information": row["information"] ** power} if "information" in row else row
                for row in tables[key]
            ]
    return tables


def tables_of(problem: Problem) -> dict[str, Any]:
    """Return the tables of a scene file for a problem of a named scene, without its anchors.

    Raises ValueError for mounts or prisms, which only its own file can describe.
    """
    mounts, noise = problem.mounts, problem.noise
    kinds: dict[type, str] = {Walls: "room", Box: "box", Shell: "shell"}
    if type(mounts) not in kinds or len(problem.obstacles.prisms):
        raise ValueError(
            "a problem with mounts or prisms can only be saved if it comes from a file: pass "
            "tables, the content of that file"
        )
    fields: Any = dataclasses.asdict(mounts)  # pyrefly: ignore[bad-argument-type]
    law = next(name for name, law in NOISE_LAWS.items() if type(noise) is law)
    values: Any = dataclasses.asdict(noise)  # pyrefly: ignore[bad-argument-type]
    boxes = problem.obstacles.boxes
    tables: dict[str, Any] = {
        "name": problem.name,
        "anchors": {"kind": kinds[type(mounts)]} | {k: _plain(v) for k, v in fields.items()},
        "zones": [_zone_table(zone) for zone in problem.zones],
        "obstacles": [
            {"low": _plain(low), "high": _plain(high)}
            for low, high in zip(*box_bounds(boxes), strict=True)
        ],
        "body": {"tags": problem.tags.tolist()},
        "noise": {"kind": law}
        | {k: v for k, v in values.items() if v is not None}
        | {"blocked_information": problem.obstacles.blocked_information},
        "prior": {
            "rotation_deg": float(np.rad2deg(problem.scene.initial_rotation_rad)),
            "position_m": problem.scene.initial_translation_m,
        },
    }
    tables["anchors"] |= _reach(problem)
    return {key: value for key, value in tables.items() if value != []}


def _zone_table(zone: Any) -> dict[str, Any]:
    low, high = zone.bounds()
    shape = {"low": _plain(low), "high": _plain(high)}
    if not zone.is_box:
        shape = {"polygon": zone.polygon.tolist(), "low_m": zone.low_m, "high_m": zone.high_m}
    asked = {key: getattr(zone, key) for key in ("position_m", "height_m", "heading_deg")}
    asked = {key: value for key, value in asked.items() if value is not None}
    row = {"name": zone.name, **shape, "weight": zone.weight, "attitude": zone.attitude, **asked}
    return row | {"share": zone.share} if asked else row


def _reach(problem: Problem) -> dict[str, float]:
    gain, found = problem.gain, {}
    if gain.max_range_m < np.inf:
        found |= {"max_range_m": gain.max_range_m, "range_edge_m": gain.range_edge_m}
    if gain.half_angle_rad < np.pi:
        found["half_angle_deg"] = float(np.rad2deg(gain.half_angle_rad))
        found["angle_edge_deg"] = float(np.rad2deg(gain.angle_edge_rad))
    return found


def _plain(value: Any) -> Any:
    return np.asarray(value, float).tolist()

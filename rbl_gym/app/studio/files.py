"""Files of the studio: a layout as a scene file and a list, kept safe, in one folder.

Nothing is written outside of the folder, and no file is half written: a new one takes the place
of the old one when it is whole.
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
from rbl_gym.geometry.regions import Box, Shell, Walls
from rbl_gym.measurements.noise_laws import NOISE_LAWS
from rbl_gym.placement import scene_files
from rbl_gym.placement.building import Problem
from rbl_gym.placement.plans.toml_text import to_toml
from rbl_gym.studies.placing.layout_export import write_layout

# Writes a report of a problem and a layout (M, 3) to a path.
Report = Callable[[Problem, FloatArray, str], None]
# The first line of a scene file of the studio: only such files are written over.
HEAD = "Written by rbl-gym studio."
_AUTOSAVE = "-autosave"


def check_name(name: str) -> str:
    """A name for files that stays within a folder, or a ValueError.

    Letters, digits, spaces, and ``_ . -`` inside of it.
    """
    name = name.strip()
    if not re.fullmatch(r"[\w][\w .-]{0,79}", name) or name.endswith("."):
        raise ValueError(
            f"the name must be letters, digits, spaces, '_', '.', '-', at most 80, got {name!r:.80}"
        )
    return name


def default_name(problem: Problem) -> str:
    """A name for the files of a problem."""
    plain = re.sub(r"[^\w.-]+", "-", problem.name).strip("-.")[:60] or "scene"
    return plain if plain.endswith("-layout") else f"{plain}-layout"


def save(state: State, tables: Mapping[str, Any], folder: Path, name: str) -> list[Path]:
    """Write NAME.toml, the scene with all anchors fixed, and NAME.csv, the mounting list.

    Parameters
    ----------
    state
        What is saved.
    tables
        Of the file from which the problem was read, or `tables_of` it.
    folder, name
        Where; the folder is made.

    Raises
    ------
    ValueError
        On a name that is none, and where a file of that name was not written by the studio.
    """
    stem = owned(folder, name)
    scene, layout = stem.with_name(f"{stem.name}.toml"), stem.with_name(f"{stem.name}.csv")
    replace(
        scene, lambda path: path.write_text(scene_text(state, tables, folder), encoding="utf-8")
    )
    replace(layout, lambda path: write_layout(state.problem, state.anchors, str(path)))
    return [scene, layout]


def autosave(state: State, tables: Mapping[str, Any], folder: Path) -> Path:
    """Keep the layout as it is in NAME-autosave.toml. Arguments as `save`."""
    stem = owned(folder, default_name(state.problem) + _AUTOSAVE)
    path = stem.with_name(f"{stem.name}.toml")
    text = scene_text(state, tables, folder)
    replace(path, lambda draft: draft.write_text(text, encoding="utf-8"))
    return path


def last_session(state: State, folder: Path) -> FloatArray | None:
    """Anchors of the autosave of a problem, where they differ from those of the state.

    None where there is no autosave, or the studio saved the problem in the folder after it.
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
    """Whether the studio saved a problem of a name beside its autosave, and after it."""
    written = autosave.stat().st_mtime_ns
    for path in autosave.parent.glob("[!.]*.toml"):
        # One that cannot be read is no save.
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
    """`save`, and NAME.pdf, the report. Arguments and errors as there.

    Parameters
    ----------
    state, tables, folder, name
        As in `save`.
    report
        Writes the report.
    """
    scene, layout = save(state, tables, folder, name)
    path = scene.with_suffix(".pdf")
    replace(path, lambda draft: report(state.problem, state.anchors, str(draft)))
    return [scene, layout, path]


def names(paths: list[Path]) -> str:
    """The names of files, with commas."""
    return ", ".join(path.name for path in paths)


def owned(folder: Path, name: str) -> Path:
    """Folder and name, where no file of that name is somebody else's."""
    stem = folder / check_name(name)
    scene = stem.with_name(f"{stem.name}.toml")
    if scene.exists():
        others = [] if _is_ours(scene) else [scene]
    else:
        ends = (".csv", ".pdf")
        others = [p for p in (stem.with_name(f"{stem.name}{end}") for end in ends) if p.exists()]
    if others:
        raise ValueError(
            f"{others[0].name} is there, and was not written by the studio: choose another name"
        )
    return stem


def replace(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a file beside its place, then put it there in one step."""
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
    """The scene file (TOML) of a state, in a folder: `tables` with its anchors and its knobs."""
    anchors = state.anchors.tolist()
    head = [
        HEAD,
        f"{len(anchors)} anchors, b = {state.score:.4g} m. All of them are listed as fixed: "
        "`rbl-gym place --scene` judges this layout, `rbl-gym studio` goes on with it.",
    ]
    named = {"name": state.problem.name, **tables}
    changed = {key: value for key, value in named.items() if key != "$schema"}
    changed["anchors"] = {
        **tables.get("anchors", {}),
        "number": len(anchors),
        "fixed": anchors,
    }
    plan = state.world.base.plan
    if plan is not None and "plan" in tables:
        # Paths of a file are relative to where it is.
        paths = {key: getattr(plan, key) for key in ("image", "drawing")}
        found = {key: os.path.relpath(path, folder) for key, path in paths.items() if path}
        changed["plan"] = {**tables["plan"], **found}
    return to_toml(_with_knobs(changed, state), head)


def _with_knobs(tables: dict[str, Any], state: State) -> dict[str, Any]:
    """Tables with the knobs that were turned."""
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
    """The tables of a scene file for a problem of a named scene, without its anchors.

    Raises
    ------
    ValueError
        Where the problem has what only its own file can say: mounts or prisms.
    """
    mounts, noise = problem.mounts, problem.noise
    kinds = {Walls: "room", Box: "box", Shell: "shell"}
    if type(mounts) not in kinds or len(problem.obstacles.prisms):
        raise ValueError("a problem with mounts or prisms needs the tables of its file")
    fields: Any = dataclasses.asdict(mounts)  # pyright: ignore[reportArgumentType]
    law = next(name for name, law in NOISE_LAWS.items() if type(noise) is law)
    values: Any = dataclasses.asdict(noise)  # pyright: ignore[reportArgumentType]
    boxes = problem.obstacles.boxes
    tables: dict[str, Any] = {
        "name": problem.name,
        "anchors": {"kind": kinds[type(mounts)]} | {k: _plain(v) for k, v in fields.items()},
        "zones": [_zone_table(zone) for zone in problem.zones],
        "obstacles": [
            {"low": _plain(box[:3] - box[3:]), "high": _plain(box[:3] + box[3:])} for box in boxes
        ],
        "body": {"tags": problem.tags.tolist()},
        "noise": {"kind": law}
        | {k: v for k, v in values.items() if v is not None}
        | {"blocked_information": problem.obstacles.blocked_information},
        "prior": {
            "rotation_deg": float(np.rad2deg(problem.prior.rotation_rad)),
            "position_m": problem.prior.position_m,
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

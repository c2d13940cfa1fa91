"""Scenes from building files of `rbl-gym place`."""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path

from rbl_gym.checks import as_tuples
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.placement.scene_files import problem
from rbl_gym.worlds.scene import Scene

__all__ = ["scene_of_file"]

# Motion of the body, which a file does not describe: as in `uwb_room`.
_DT = 0.1
_MOTION = {
    "dt": _DT,
    "speed_m_s": 1.0,
    "spin_rad_s": 0.29,
    "process": ProcessNoise(math.radians(1.5) / _DT**0.5, 0.03 / _DT**0.5),
}


def scene_of_file(path: str) -> Scene:
    """Return the scene of a building file (docs/building_files.md).

    The body moves in the box around the file's zones. The fixed anchors of the file stay. Every
    reset draws the others, up to the file's number, on legal positions. Values that the file does
    not have (speeds, process noise, time) are those of the scene ``"uwb_room"``.

    Raises
    ------
    ValueError
        If the file is invalid; the message has the file and, if known, the line.
    """
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"scene must be a name or a file, but there is no file {path!r}")
    return _read(path, file.stat().st_mtime_ns)


@functools.lru_cache(maxsize=64)
def _read(path: str, changed_ns: int) -> Scene:
    """Read the scene of a file as of a time: an unchanged file gives the same object."""
    found = problem(path)
    fixed = as_tuples(found.fixed) if len(found.fixed) else ()
    every = len(fixed) == found.n_anchors
    return dataclasses.replace(
        found.scene, anchors=fixed if every else None, fixed=() if every else fixed, **_MOTION
    )

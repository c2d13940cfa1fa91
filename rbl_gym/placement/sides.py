"""Notes on mounts along walls that face away from all zones, while their other side does not."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.checks import BoolArray
from rbl_gym.placement.building import Problem
from rbl_gym.placement.file_walls import WallPieces, read_mounts
from rbl_gym.placement.mounting import Mount

_OTHER = {"left": "right", "right": "left"}
# Anchors per face, and positions in the zones, that are tried.
_ALONG, _PLACES = 5, 256
# A link with this share of its information counts as seen.
_SEEN = 0.5


def wrong_sides(
    problem: Problem, tables: list[dict[str, Any]], walls: WallPieces, mounts: list[Mount]
) -> tuple[str, ...]:
    """Return a note on every wall mount that sees no zone, if its other side sees some.

    Parameters
    ----------
    problem
        The problem.
    tables, walls, mounts
        The tables ``mounts`` of its file, its walls, and the faces of the mounts.
    """
    found, first = [], 0
    for index, table in enumerate(tables):
        count = len(read_mounts([table], walls))
        here, first = mounts[first : first + count], first + count
        side = table.get("side")
        if side not in _OTHER:
            continue
        others = read_mounts([table | {"side": _OTHER[side]}], walls)
        wrong = ~_seeing(problem, here)
        wrong[wrong] = _seeing(problem, [others[k] for k in np.flatnonzero(wrong)])
        if wrong.any():
            names = ", ".join(repr(here[k].name) for k in np.flatnonzero(wrong))
            found.append(
                f"Anchors on {names} (mounts[{index}]) see no zone, but on the other side of the "
                f'line they would: side is "{side}"; give side = "{_OTHER[side]}".'
            )
    return tuple(found)


def _seeing(problem: Problem, faces: list[Mount]) -> BoolArray:
    """Return which faces (K,) see any position of the zones."""
    if not faces:
        return np.zeros(0, bool)
    steps = (np.arange(_ALONG) + 0.5) / _ALONG
    points = []
    for face in faces:
        plan = face.shape[0] + steps[:, None] * (face.shape[1] - face.shape[0])
        points += [[*spot, z] for spot in plan for z in (face.low_m, face.high_m)]
    places = problem.free_places(_PLACES)
    seen = (problem.share(np.array(points), places) >= _SEEN).any(axis=0)
    return np.any(seen.reshape(len(faces), -1), axis=1)

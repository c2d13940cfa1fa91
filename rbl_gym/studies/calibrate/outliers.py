"""Name links and anchors that do not fit the truth as the others do."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.studies.misplaced import ANCHOR_M, LEFT, MOST_OFF_M, misplaced

# Fewest ranges of a link that tell its offset.
_FEWEST = 10


def outliers(
    off_m: FloatArray, away_m: FloatArray, links: BoolArray, ids: Any, planar: bool
) -> dict[str, Any]:
    """Return links with unusual offsets, anchors whose positions look wrong, and notes on both.

    `off_m` (K, M, N) are ranges minus distances, `away_m` (K, M, N, 3) from tags to anchors.
    """
    offset = _offsets(off_m, links)
    if np.isfinite(offset).any():
        offset = offset - np.nanmedian(offset)
    far = [
        {"anchor": ids[0][m], "tag": ids[1][n], "offset_m": float(offset[m, n])}
        for m, n in np.argwhere(np.abs(offset) > MOST_OFF_M)
    ]
    wrong = []
    for m, name in enumerate(ids[0]):
        found = misplaced(off_m[:, m], away_m[:, m], links[:, m], planar)
        told = np.isfinite(offset[m])
        turns = found.left < LEFT or abs(offset[m, told].sum()) > ANCHOR_M * told.sum()
        if found.size_m > MOST_OFF_M and turns:
            wrong.append({"anchor": name, "move_m": found.move_m.tolist()})
    notes = []
    if far:
        named = [f"{row['anchor']}-{row['tag']} by {row['offset_m']:+.2f} m" for row in far]
        notes.append(
            "WARNING: the errors of some links differ from the median of all links by more than "
            f"{MOST_OFF_M:g} m: {few(named)}. Check the ids and positions of these anchors and "
            "tags, and whether the links are blocked."
        )
    for row in wrong:
        move = ", ".join(f"{x:+.2f}" for x in row["move_m"])
        notes.append(
            f"WARNING: anchor {row['anchor']} looks misplaced: its ranges fit the truth if it is "
            f"moved by ({move}) m."
        )
    return {"outlying_links": far, "misplaced_anchors": wrong, "notes": notes}


def _offsets(off_m: FloatArray, links: BoolArray) -> FloatArray:
    """Return the median offset (M, N) of the ranges of each link; NaN with too few of them."""
    result = np.full(links.shape[1:], np.nan)
    for m, n in np.argwhere(links.sum(axis=0) >= _FEWEST):
        result[m, n] = np.median(off_m[links[:, m, n], m, n])
    return result


def few(names: list[str]) -> str:
    """Return the first of some names, and the number of the others."""
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")

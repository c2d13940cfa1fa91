"""Tables of anchors and tags."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.recordings.tables import MAX_COORDINATE_M, AnyPath, is_first, read_table

MAX_TAG_M = 1e4


def read_points(path: AnyPath, kind: str) -> tuple[tuple[str, ...], FloatArray]:
    """Ids and coordinates (P, 3) of a table; `kind` is ``"anchor"`` or ``"tag"``."""
    table = read_table(path)
    column = "id" if next(iter(table.columns)) == "id" else kind
    table.check_columns((column, "x", "y", "z"))
    ids = tuple(cell.strip() for cell in table.columns[column])
    table.check(np.array([*map(bool, ids)]), column, "id must not be empty")
    table.check(is_first(ids), column, "id must be unique")
    return ids, table.points("xyz", MAX_TAG_M if kind == "tag" else MAX_COORDINATE_M)

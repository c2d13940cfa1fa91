"""Read the bias by ray direction from a file."""

from __future__ import annotations

import numpy as np

from rbl_gym.measurements.direction_bias import DirectionLaw
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import AS_NAMED, AnyPath, Ids, Source, is_first, read_table

__all__ = ["read_directions"]

_COLUMNS = ("end", "id", "harmonic", "bias_cos_m", "bias_sin_m", "log_std_cos", "log_std_sin")
_MOST = 12


def read_directions(
    path: AnyPath, ids: Ids, source: Source = AS_NAMED, said: Said | None = None
) -> DirectionLaw:
    """Read the range bias by the direction of the ray at its ends: a table of harmonics.

    Parameters
    ----------
    path
        ``end,id,harmonic,bias_cos_m,bias_sin_m[,log_std_cos,log_std_sin]``: `end` is ``anchor`` or
        ``tag``, `id` is the id of one of them, harmonic 1, 2, ... Bearings are angles about z from
        the x axis of the frame of the anchors, or of the body. Points without a row have no bias.
    ids
        Ids of the M anchors and of the N tags, in the order of the arrays.
    source
        Names of the columns.
    said
        Object that collects the columns that are not read.

    Raises
    ------
    ValueError
        If an end or id is unknown, or a harmonic is invalid or duplicate. The message names the
        line.
    """
    table = read_table(path, source)
    table.require(*_COLUMNS[:5])
    if said is not None:
        said.read(table, _COLUMNS)
    end = np.array(table.text("end"))
    table.check((end == "anchor") | (end == "tag"), "end", "must be anchor or tag")
    at_tag = end == "tag"
    at = np.where(at_tag, table.positions("id", ids[1]), table.positions("id", ids[0]))
    table.check(at >= 0, "id", "must be the id of an anchor if end is anchor, else of a tag")
    number = table.numbers("harmonic")
    whole = (number == np.round(number)) & (number >= 1) & (number <= _MOST)
    table.check(whole, "harmonic", f"must be 1, 2, ... {_MOST}")
    harmonic = number.astype(int)
    row = (2 * at + at_tag) * (_MOST + 1) + harmonic
    table.check(is_first(row), "harmonic", "must differ in rows with the same end and id")
    most = int(harmonic.max())
    fields = []
    for cos, sin in (_COLUMNS[3:5], _COLUMNS[5:7]):
        for side, names in ((False, ids[0]), (True, ids[1])):
            field = np.zeros((len(names), 2 * most))
            mine = at_tag == side
            for column, shift in ((cos, 2), (sin, 1)):
                if column in table.columns:
                    values = table.numbers(column)
                    field[at[mine], 2 * harmonic[mine] - shift] = values[mine]
            fields.append(field)
    return DirectionLaw.of(*fields)

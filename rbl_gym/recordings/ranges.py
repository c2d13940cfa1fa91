"""Tables of ranges, long and wide, as arrays over epochs and links."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.recordings.tables import MAX_RANGE_M, TOO_LONG, Ids, Table, is_first

Log = tuple[FloatArray, FloatArray, FloatArray | None]  # times, ranges (0: no link), range_std


def read_wide(table: Table, ids: Ids) -> Log:
    """A row an epoch, a column a link."""
    names = [f"a{anchor}t{tag}" for anchor in ids[0] for tag in ids[1]]
    if not (first := is_first(names)).all():
        name = names[first.argmin()]
        raise ValueError(f"{table.path}: column {name!r} fits two pairs, use a long table")
    table.check_columns(("t",), names)
    times = table.times()
    ranges = np.zeros((len(times), len(names)))
    for link, name in enumerate(names):
        if name in table.columns:
            ranges[:, link] = table.ranges(name)
    return times, ranges.reshape(len(times), len(ids[0]), len(ids[1])), None


def read_long(table: Table, ids: Ids) -> Log:
    """A row a range; rows of one time are an epoch."""
    table.check_columns(("t", "anchor", "tag", "range"), ("std", "valid"))
    times = table.times(may_repeat=True)
    starts = np.diff(times, prepend=-np.inf) > 0
    epoch = np.cumsum(starts) - 1
    cells = (epoch, *table.links(ids, epoch))
    valid = table.numbers("valid") if "valid" in table.columns else np.ones(len(times))
    table.check(np.isin(valid, (0, 1)), "valid", "must be 0 or 1")
    measured = table.ranges("range", valid)
    ranges, range_std = np.zeros((epoch[-1] + 1, len(ids[0]), len(ids[1]))), None
    ranges[cells] = measured
    if "std" in table.columns:
        std = table.numbers("std", may_be_empty=True)
        table.check((std > 0) | (measured == 0), "std", "must be positive")
        table.check((std <= MAX_RANGE_M) | (measured == 0), "std", TOO_LONG)
        range_std = np.zeros_like(ranges)
        range_std[cells] = np.where(measured > 0, std, 0.0)
    return times[starts], ranges, range_std

"""Read the single ranges of a long or wide table, and find invalid ones with their cause."""

from __future__ import annotations

import re
from collections import Counter
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.recordings.column_units import name_and_unit
from rbl_gym.recordings.format import Format
from rbl_gym.recordings.points import Points
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import MAX_RANGE_M, METRES, Ids, IntArray, Table, is_first

# A log with a larger share of invalid ranges is not a log of ranges in this format.
_MOST_BAD = 0.2
# Largest possible offset (m): a light-second is 3e8.
_FARTHEST_M = 1e9
_WIDE = "a{anchor}t{tag}"

# Causes why a range is not a link; those of `_FINE` are not errors. The requirement, and where.
_CAUSES = {
    "": ("", ""),
    "empty": ("", "range"),
    "marked as not valid": ("", "valid"),
    "repeated": ("each link must have only one range at a time", "range"),
    "not a number": ("must be a finite number", "range"),
    "zero": ("range must be positive", "range"),
    "negative": ("range must be positive", "range"),
    "too long": (f"must be at most {MAX_RANGE_M:.0f} m (looks like millimetres?)", "range"),
    "far too long": ("must be at most 1e9 m", "range"),
    "without a standard deviation": ("must be positive and no longer than a range", "std"),
    "of an unknown anchor": ("anchor", "anchor"),
    "of an unknown tag": ("tag", "tag"),
    "to an unknown anchor": ("anchor", "anchor_b"),
    "of an anchor to itself": ("must be another anchor than anchor_a", "anchor_b"),
    "twice with two values": ("each link must have only one range at a time", "range"),
    "of an anchor without a position at that time": (
        "the anchor must have a position at this time",
        "t",
    ),
}
_NAMES = [*_CAUSES]
# More ranges than this share without an anchor or a tag give a warning.
_MANY = 0.01
# Advice if one cause prevails.
_HINTS = {
    "too long": "are the ranges in cm or mm? set --unit",
    "of an unknown anchor": "add it to the table of anchors",
    "of an unknown tag": "add it to the table of tags",
    "twice with two values": "are the stamps too coarse, or does the file have several runs and no "
    "column run?",
    "without a standard deviation": "is it in another column? name it by --columns std=NAME",
    "of an anchor without a position at that time": "do the clocks agree?",
}
_FINE = ("", "empty", "marked as not valid", "repeated")


class Measured(NamedTuple):
    """R ranges of a table: the row and the column of each, its link and its value.

    `cause`: why it is not a link, an index of `_CAUSES`; 0: it is a link. Metres; `std` is None if
    the log has none.
    """

    row: IntArray
    column: IntArray
    anchor: IntArray
    tag: IntArray
    range: FloatArray
    std: FloatArray | None
    cause: IntArray
    columns: list[str]
    std_columns: list[str]

    def drop(self, which: BoolArray, cause: str) -> None:
        """Set `cause` for these ranges, except for those that already have one."""
        self.cause[which & (self.cause == 0)] = _NAMES.index(cause)


def read_measured(
    table: Table, anchors: Points | None, tags: Points | None, format: Format, said: Said
) -> tuple[Measured, Ids]:
    """Read the ranges of a table, and the ids of their anchors and tags.

    ValueError if columns are missing, or tags or anchors are not given.
    """
    pattern = format.of("ranges").columns.get("range", "")
    if "{" in pattern:
        return _read_wide(table, anchors, tags, format, said)
    if table.columns.keys().isdisjoint(("anchor", "tag", "range", "ax")):
        return _read_wide(table, anchors, tags, format, said)
    if anchors is None and not {"ax", "ay"} <= table.columns.keys():
        raise ValueError(
            f"{table.path}: give the positions of the anchors (--anchors), or the columns ax, ay "
            f"and az in this file; got the columns {[*table.names.values()]!r:.200}"
        )
    table.require("t", *id_columns(anchor=anchors, tag=tags), "range")
    read = {"t", "range", "run"}
    anchor_ids = ids_of(table, "anchor", anchors)
    if anchors is None:
        read |= {"ax", "ay", "az"}
    ids = anchor_ids, ids_of(table, "tag", tags)
    none = np.zeros(len(table.lines), dtype=np.intp)
    anchor, tag = (
        table.positions(column, known) if column in table.columns else none
        for column, known in zip(("anchor", "tag"), ids, strict=True)
    )
    read |= {"anchor", "tag"}
    measured = measured_of(table, "range", anchor, tag, scale_of(table, "range", format, said))
    said.read(table, {*read, "valid", *measured.std_columns})
    judge(measured, table, format.offset is not None)
    return measured, ids


def measured_of(
    table: Table, column: str, anchor: IntArray, tag: IntArray, scale: float
) -> Measured:
    """Return the values of a column, with ``std`` or ``var`` and ``valid``, if the table has them.

    `scale` is the length of a unit in metres, also of the deviations without a unit of their own.
    """
    values = scale * table.numbers(column, may_be_missing=True)
    none = np.zeros(len(values), dtype=np.intp)
    std, std_column = None, next((c for c in ("std", "var") if c in table.columns), "")
    if std_column:
        std = table.numbers(std_column, may_be_missing=True)
        with np.errstate(invalid="ignore"):
            std = np.sqrt(std) if std_column == "var" else std
        std *= METRES[table.unit(std_column, METRES)] if table.units.get(std_column) else scale
    rows = np.arange(len(values))
    measured = Measured(rows, none, anchor, tag, values, std, none.copy(), [column], [std_column])
    if "valid" in table.columns:
        valid = table.numbers("valid")
        table.check(np.isin(valid, (0, 1)), "valid", "must be 0 or 1")
        measured.drop(valid == 0, "marked as not valid")
    return measured


def ids_of(table: Table, column: str, points: Points | None) -> tuple[str, ...]:
    """Return the ids of the points of a long table."""
    if points is None:
        if column not in table.columns:
            return ("0",)
        ids = tuple(dict.fromkeys(table.text(column)))
        if column == "tag" and len(ids) > 1:
            raise ValueError(
                f"{table.path}: give the positions of the tags on the body (--tags), as the ranges "
                f"are of {len(ids)} tags, {', '.join(ids):.200}"
            )
        return ids
    return points.ids


def id_columns(**points: Points | None) -> tuple[str, ...]:
    """Return the columns that a long table must have: of points with more than one id."""
    return tuple(
        column for column, found in points.items() if found is not None and len(found.ids) > 1
    )


def _read_wide(
    table: Table, anchors: Points | None, tags: Points | None, format: Format, said: Said
) -> tuple[Measured, Ids]:
    """Read a table with one row per epoch and one column per link."""
    columns = format.of("ranges").columns
    if anchors is None:
        raise ValueError(
            f"{table.path}: give the positions of the anchors (--anchors), which a table with a "
            "column for each link does not have"
        )
    pattern = name_and_unit(columns.get("range", _WIDE))[0]
    links, ids = _links_of(table, pattern, anchors.ids, None if tags is None else tags.ids)
    names = list(links)
    if not names:
        long = [name for name in ("t", *id_columns(anchor=anchors, tag=tags), "range")
                if name not in table.columns]  # fmt: skip
        example = pattern.replace("{anchor}", ids[0][0]).replace("{tag}", ids[1][0])
        raise ValueError(
            f"{table.path}, line {table.header_line}: no column of ranges found. There must be the "
            "columns t, anchor, tag, range, or a column for each link, named like "
            f"{example!r}; got "
            f"{[*table.names.values()]!r:.200}; name them by "
            f"--columns {table.source.given(**dict.fromkeys(long, 'NAME'))}"
        )
    table.require("t")
    scale = scale_of(table, "range", format, said)
    rows, width = len(table.lines), len(names)
    values = scale * np.stack([table.numbers(n, may_be_missing=True) for n in names], axis=1)
    std, std_names = None, []
    if "std" in columns:
        place = _links_of(table, name_and_unit(columns["std"])[0], *ids)[0]
        by_link = {link: name for name, link in place.items()}
        std_names = [by_link.get(link, "") for link in links.values()]
        if "" in std_names:
            name = names[std_names.index("")]
            raise ValueError(
                f"{table.path}, line {table.header_line}: column {name!r} of ranges must have a "
                f"column of standard deviations like {columns['std']!r}, got none"
            )
        std = np.stack([table.numbers(n, may_be_missing=True) for n in std_names], axis=1)
        std = (METRES[table.unit("std", METRES)] if table.units.get("std") else scale) * std.ravel()
    said.read(table, {"t", "run", *names, *std_names})
    where = np.array([*links.values()], dtype=np.intp)
    measured = Measured(
        np.repeat(np.arange(rows), width),
        np.tile(np.arange(width), rows),
        np.tile(where[:, 0], rows),
        np.tile(where[:, 1], rows),
        values.ravel(),
        std,
        np.zeros(rows * width, dtype=np.intp),
        names,
        std_names,
    )
    judge(measured, table, format.offset is not None)
    return measured, ids


def _links_of(
    table: Table, pattern: str, anchors: tuple[str, ...], tags: tuple[str, ...] | None
) -> tuple[dict[str, tuple[int, int]], Ids]:
    """Return anchor and tag of the columns that match `pattern`, and the ids."""
    if "{anchor}" not in pattern or re.sub(r"\{(anchor|tag)\}", "", pattern).count("{"):
        raise ValueError(f"columns of links must be like 'r_{{anchor}}_{{tag}}', got {pattern!r}")
    if tags is None:
        tags = _tags_named(table, pattern, anchors)
    links: dict[str, tuple[int, int]] = {}
    for a, anchor in enumerate(anchors):
        for b, tag in enumerate(tags if "{tag}" in pattern else tags[:1]):
            name = pattern.replace("{anchor}", anchor).replace("{tag}", tag)
            if name in links:
                raise ValueError(
                    f"{table.path}: the name of column {name!r} fits two links: use a table with "
                    "columns t, anchor, tag, range"
                )
            if name in table.columns:
                links[name] = a, b
    if "{tag}" not in pattern and len(tags) > 1:
        raise ValueError(
            f"columns of links must have {{tag}} in their names, as there are {len(tags)} tags, "
            f"{', '.join(tags):.200}; got {pattern!r}"
        )
    return links, (anchors, tags)


def _tags_named(table: Table, pattern: str, anchors: tuple[str, ...]) -> tuple[str, ...]:
    """Return the single tag of a log without a table of tags."""
    if "{tag}" not in pattern:
        return ("0",)
    found: dict[str, None] = {}
    for anchor in anchors:
        parts = pattern.replace("{anchor}", anchor).split("{tag}")
        like = re.compile("(.+)".join(map(re.escape, parts)))
        found |= {m[1]: None for name in table.columns if (m := like.fullmatch(name))}
    if len(found) > 1:
        raise ValueError(
            f"{table.path}: give the positions of the tags on the body (--tags), as the ranges are "
            f"of {len(found)} tags, {', '.join(found):.200}"
        )
    return tuple(found) or ("0",)


def scale_of(table: Table, column: str, format: Format, said: Said) -> float:
    """Return the length of a unit of the ranges in metres."""
    told = "" if format.unit else table.unit(column, METRES)
    if told in ("cm", "mm"):
        said.note(table.path, f"ranges are in {told}, as the header states")
    return METRES.get(format.unit or told, 1.0)


def judge(measured: Measured, table: Table, signed: bool) -> None:
    """Find the ranges with invalid values; `signed`: they may be negative."""
    range, std = measured.range, measured.std
    if np.isnan(range).any():
        at = np.flatnonzero(np.isnan(range))
        empty = np.zeros(len(range), dtype=bool)
        for c, name in enumerate(measured.columns):
            some = at[measured.column[at] == c]
            empty[some] = table.empty(name, measured.row[some])
        measured.drop(empty, "empty")
        measured.drop(np.isnan(range), "not a number")
    measured.drop(measured.anchor < 0, "of an unknown anchor")
    measured.drop(measured.tag < 0, "of an unknown tag")
    if signed:
        measured.drop(np.abs(range) > _FARTHEST_M, "far too long")
    else:
        measured.drop(range == 0, "zero")
        measured.drop(range < 0, "negative")
        measured.drop(range > MAX_RANGE_M, "too long")
    if std is not None:
        measured.drop(~((std > 0) & (std <= MAX_RANGE_M)), "without a standard deviation")


def settle(measured: Measured, table: Table, ids: Ids, format: Format, said: Said) -> None:
    """Count the ranges that are not links; raise if `strict` or if they are more than a fifth.

    ValueError with file, line and column of the first such range.
    """
    counts = Counter({_NAMES[c]: int(n) for c, n in enumerate(np.bincount(measured.cause)) if n})
    said.ranges += len(measured.cause) - counts["empty"]
    for cause, count in counts.items():
        if cause:
            said.drop(cause, count)
    total = sum(n for cause, n in counts.items() if cause not in ("empty", "marked as not valid"))
    bad = {cause: n for cause, n in counts.items() if cause not in _FINE}
    refused = [*bad, *(["repeated"] if counts["repeated"] else [])]
    if format.strict and refused:
        raise ValueError(_first(measured, table, ids, refused))
    if (count := sum(bad.values())) > _MOST_BAD * total:
        causes = ", ".join(f"{n} {cause}" for cause, n in bad.items())
        worst = max(bad, key=lambda cause: bad[cause])
        hint = f"; {_HINTS[worst]}" if worst in _HINTS else ""
        hint = _swapped(table, ids) or hint
        raise ValueError(
            f"{table.path}: {count} of {total} ranges cannot be used ({causes}), more than the "
            f"fifth that is allowed. The first: {_first(measured, table, ids, refused)}{hint}"
        )
    if shown := {c: n for c, n in counts.items() if c not in ("", "empty", "marked as not valid")}:
        causes = ", ".join(
            f"{n} {cause}{_unknown_ids(measured, table, cause)}" for cause, n in shown.items()
        )
        text = f"{sum(shown.values())} of {total} ranges are left out: {causes}"
        missing = {c: n for c, n in shown.items() if "unknown" in c and n > _MANY * total}
        hints = "".join(f"; {_HINTS[cause]}" for cause in missing if cause in _HINTS)
        said.note(table.path, text + hints, warn=bool(missing))


def _swapped(table: Table, ids: Ids) -> str:
    """Return a hint if the columns of anchors and tags have the ids of the other."""
    columns = ("anchor", "tag")
    if any(
        column not in table.columns or (table.positions(column, known) < 0).mean() > _MOST_BAD
        for column, known in zip(columns, ids[::-1], strict=True)
    ):
        return ""
    anchor, tag = (table.name(column) for column in columns)
    told = table.source.given(anchor=tag, tag=anchor)
    return f'; the columns of anchors and tags look swapped: give --columns "{told}"'


def _in_file(table: Table, column: str) -> str:
    """Return the column of the first anchor of a time difference for `anchor`."""
    return "anchor_a" if column == "anchor" and "anchor_a" in table.columns else column


def _unknown_ids(measured: Measured, table: Table, cause: str) -> str:
    """Return the unknown anchors or tags in brackets; nothing for other causes."""
    column = _in_file(table, _CAUSES[cause][1])
    if "unknown" not in cause or column not in table.columns:
        return ""
    rows = measured.row[measured.cause == _NAMES.index(cause)]
    names = sorted({str(table.columns[column][row]) for row in rows.tolist()})
    return f" ({', '.join(names):.80})"


def _first(measured: Measured, table: Table, ids: Ids, causes: list[str]) -> str:
    """Return location, requirement and value of the first range with one of these causes."""
    found = np.isin(measured.cause, [_NAMES.index(cause) for cause in causes])
    at = np.flatnonzero(found)[np.argmin(measured.row[found])]
    cause = _NAMES[measured.cause[at]]
    must, column = _CAUSES[cause]
    row = int(measured.row[at])
    name = {"range": measured.columns, "std": measured.std_columns}.get(column, [column])
    name = name[measured.column[at]] if len(name) > 1 else name[0]
    name = _in_file(table, name)
    got = repr(table.columns[name][row])
    if "unknown" in cause:
        must += f" must be one of {', '.join(ids[column == 'tag'])!s:.200}"
    if "only one" in must:
        got = (
            f"{got} beside an earlier range of anchor {ids[0][measured.anchor[at]]!r} and tag "
            f"{ids[1][measured.tag[at]]!r}"
        )
    return f"{table.place(row, name)}: {must}, got {got:.80}"


def mark_doubles(measured: Measured, epoch: IntArray) -> None:
    """Find links (R,) that occur twice in an epoch, with the same range or with another."""
    used = np.flatnonzero(measured.cause == 0)
    if not len(used):
        return
    size = measured.anchor.max() + 1, measured.tag.max() + 1
    key = (epoch[used] * size[0] + measured.anchor[used]) * size[1] + measured.tag[used]
    order = np.argsort(key, kind="stable")
    starts = is_first(key[order])
    if starts.all():
        return
    first = np.empty(len(key), dtype=np.intp)
    first[order] = order[np.flatnonzero(starts)][np.cumsum(starts) - 1]
    again = first != np.arange(len(key))
    same = measured.range[used] == measured.range[used][first]
    double = np.zeros(len(epoch), dtype=bool)
    double[used] = again & same
    measured.drop(double, "repeated")
    double[used] = again & ~same
    measured.drop(double, "twice with two values")

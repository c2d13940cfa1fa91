"""Report what was dropped, sorted, converted and found while a log was read."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from collections.abc import Iterable

from rbl_gym.recordings.tables import Table

__all__ = ["Report"]


@dataclasses.dataclass(frozen=True)
class Report:
    """Counts and notes on the ranges of a log, collected while it was read.

    Attributes
    ----------
    ranges
        Number of ranges in the log, without empty cells.
    dropped
        Number of ranges that did not become a link, by cause.
    sorted_rows
        Number of rows that were out of order, by one second at most.
    notes
        Notes for the user, one sentence each; serious ones begin with ``WARNING``.
    """

    ranges: int = 0
    dropped: dict[str, int] = dataclasses.field(default_factory=dict)
    sorted_rows: int = 0
    notes: tuple[str, ...] = ()


class Said:
    """Collect a `Report` while files are read."""

    def __init__(self) -> None:
        self.ranges = 0
        self.sorted_rows = 0
        self.dropped: Counter[str] = Counter()
        self.notes: list[str] = []
        self._unread: dict[str, tuple[str, set[str]]] = {}

    def note(self, path: str, text: str, *, warn: bool = False) -> None:
        """Add a note on a file, or a warning; an empty sentence is ignored."""
        if text:
            self.notes.append(f"{'WARNING: ' if warn else ''}{path}: {text}.")

    def drop(self, cause: str, count: int) -> None:
        """Count ranges that do not become a link."""
        if count:
            self.dropped[cause] += count

    def read(self, table: Table, columns: Iterable[str]) -> None:
        """Note which columns of a table are read, and whether its last row was cut off."""
        shown = {table.name(column) for column in columns} | {*table.chosen_by}
        hidden = {*table.names.values()} - shown
        path, before = self._unread.get(os.path.realpath(table.path), (table.path, hidden))
        self._unread[os.path.realpath(table.path)] = path, before & hidden
        if table.cut:
            self.note(table.path, f"the last line, {table.cut}, is cut off and is left out")

    def report(self) -> Report:
        """Return the report so far."""
        notes = [*dict.fromkeys(self.notes)]
        for path, names in self._unread.values():
            named = [name for name in names if not name.startswith("(column")]
            if named:
                some = ", ".join(sorted(named)[:8]) + (", ..." if len(named) > 8 else "")
                notes.append(f"{path}: columns not read: {some}.")
        return Report(self.ranges, dict(self.dropped), self.sorted_rows, tuple(notes))

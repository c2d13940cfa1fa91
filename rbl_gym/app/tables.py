"""Tables and text on the terminal: by rich if it is installed (extra ``cli``), else plain."""

from __future__ import annotations

import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple


def has_rich() -> bool:
    """Return whether rich is installed."""
    try:
        import rich  # noqa: F401
    except ImportError:
        return False
    return True


def new_console(width: int | None = 130) -> Any:
    """Return a console for standard output: rich's, or one that prints plain text."""
    if not has_rich():
        return _PlainConsole()
    # Piped tables keep all of their columns, unless a width is requested.
    width = None if rich_console().is_terminal or bool(os.environ.get("COLUMNS")) else width
    return rich_console(width=width, highlight=False, markup=False)


def rich_console(**arguments: Any) -> Any:
    """Return a console of rich that raises BrokenPipeError if its reader has gone."""
    from rich.console import Console

    class RichConsole(Console):
        def on_broken_pipe(self) -> None:
            """Leave it to the command line; rich would exit with status 1."""
            raise BrokenPipeError

    return RichConsole(**arguments)


def new_table(
    title: str | None,
    texts: Iterable[str],
    figures: Iterable[str] = (),
    notes: Iterable[str] = (),
    whole: int = 0,
) -> Table:
    """Return a table for `new_console`: texts on the left, then figures, aligned right, then notes.

    The cells of the first `whole` columns are not wrapped.
    """
    columns = [Column(heading, False, k < whole, True) for k, heading in enumerate(texts)]
    columns += [Column(heading, True, True, False) for heading in figures]
    return Table(title, columns + [Column(heading, False, False, False) for heading in notes])


class Column(NamedTuple):
    """A column: its heading, alignment, whether its cells stay whole, whether it names the row."""

    heading: str
    right: bool
    whole: bool
    name: bool


class _PlainConsole:
    """`print` as rich's, without style."""

    def print(self, *shown: Any, **_style: Any) -> None:
        """Print text or tables; text is wrapped at words on a terminal."""
        if (width := _plain_width()) < sys.maxsize:
            shown = tuple(_wrapped(x, width) if isinstance(x, str) else x for x in shown)
        print(*shown)


def _plain_width() -> int:
    """Return the width of the terminal, or that of the variable COLUMNS; no limit without both."""
    limited = sys.stdout.isatty() or bool(os.environ.get("COLUMNS"))
    return shutil.get_terminal_size().columns if limited else sys.maxsize


def _wrapped(text: str, width: int) -> str:
    """Return text with its lines broken at spaces."""
    lines = (textwrap.wrap(line, width, break_on_hyphens=False) for line in text.splitlines())
    return "\n".join("\n".join(line) for line in lines)


class Table:
    """Columns, rows and sections; rich draws them with lines, `str` as plain text.

    A table that is too wide for the terminal is split into parts, one below the other. Each part
    begins with the columns that name the row.
    """

    def __init__(self, title: str | None, columns: list[Column]) -> None:
        self._title, self._columns = title, columns
        self._rows: list[tuple[tuple[str, ...], str | None] | None] = []  # None: a section ends

    def add_row(self, *cells: str, style: str | None = None) -> None:
        """Add a row; trailing cells may be missing."""
        missing = len(self._columns) - len(cells)
        self._rows.append(((*cells, *[""] * missing), style))

    def add_section(self) -> None:
        """Add a line below the rows so far."""
        self._rows.append(None)

    def __str__(self) -> str:
        width = _plain_width()
        widths = [max(map(len, self._cells(k))) for k in range(len(self._columns))]
        parts = [self._plain(part, widths) for part in self._parts(widths, width, 2)]
        return "\n".join([self._title, *parts] if self._title else parts)

    def __rich_console__(self, console: Any, options: Any) -> Iterator[Any]:
        """Yield the parts as tables of rich."""
        from rich.table import Table as RichTable

        least = [self._least(k) for k in range(len(self._columns))]
        title = self._title
        for part in self._parts(least, options.max_width - 1, 3):
            spare = options.max_width - 1 - sum(least[k] + 3 for k in part)
            table: Any = RichTable(title=title, title_justify="left")
            for k in part:
                wanted = max(map(len, self._cells(k)))
                width = max(least[k] + min(spare, wanted - least[k]), 1)
                spare = max(spare - width + least[k], 0)
                justify = "right" if self._columns[k].right else "left"
                table.add_column(
                    self._columns[k].heading, justify=justify, width=width, overflow="fold"
                )
            for row in self._rows:
                if row is None:
                    table.add_section()
                else:
                    table.add_row(*(row[0][k] for k in part), style=row[1])
            yield table
            title = None

    def _least(self, k: int) -> int:
        """Return the smallest width of a column in which no word, or no whole cell, is broken."""
        heading, *cells = self._cells(k)
        pieces = heading.split()
        for cell in cells:
            pieces += [cell] if self._columns[k].whole else cell.split()
        return max(map(len, pieces), default=0)

    def _cells(self, k: int) -> list[str]:
        """Return heading and cells of a column."""
        return [self._columns[k].heading, *(row[0][k] for row in self._rows if row)]

    def _parts(self, widths: list[int], most: int, between: int) -> list[list[int]]:
        """Return the columns of each part, given their widths and the space between them."""
        names = [k for k, column in enumerate(self._columns) if column.name]
        parts, used = [names], sum(widths[k] + between for k in names)
        of_names = used
        for k in range(len(names), len(self._columns)):
            used += widths[k] + between
            if used > most and len(parts[-1]) > len(names):
                parts, used = [*parts, names], of_names + widths[k] + between
            parts[-1] = [*parts[-1], k]
        return parts

    def _plain(self, part: list[int], widths: list[int]) -> str:
        line = "  ".join("-" * widths[k] for k in part)

        def text(cells: Sequence[str]) -> str:
            put = (
                cells[k].rjust(widths[k]) if self._columns[k].right else cells[k].ljust(widths[k])
                for k in part
            )
            return "  ".join(put).rstrip()

        body = [line if row is None else text(row[0]) for row in self._rows]
        while body and body[-1] is line:
            body.pop()
        return "\n".join([text([column.heading for column in self._columns]), line, *body, ""])

"""Tables and text on the terminal: by rich if it is installed (extra ``cli``), else plain."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


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
    # Piped tables keep all of their columns.
    width = None if rich_console().is_terminal else width
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
) -> Any:
    """Return a table for `new_console`: rich's, or plain text with the same methods.

    Parameters
    ----------
    title
        Title above the table; None: no title.
    texts, figures, notes
        Headings of the columns: texts on the left, then figures, aligned right, then further texts.
    whole
        Number of columns, from the left, whose cells rich does not wrap.
    """
    if has_rich():
        from rich.table import Table

        table: Any = Table(title=title, title_justify="left")
    else:
        table = _PlainTable(title)
    for index, heading in enumerate(texts):
        table.add_column(heading, no_wrap=index < whole)
    for heading in figures:
        table.add_column(heading, justify="right")
    for heading in notes:
        table.add_column(heading)
    return table


class _PlainConsole:
    """`print` as rich's, without style."""

    def print(self, *shown: Any, **_style: Any) -> None:
        """Print text or tables."""
        print(*shown)


class _PlainTable:
    """Columns, rows and sections as in rich's `Table`; `str` gives the text."""

    def __init__(self, title: str | None) -> None:
        self._title = title
        self._headings: list[str] = []
        self._right: list[bool] = []
        self._rows: list[tuple[str, ...] | None] = []  # None: a section ends

    def add_column(self, heading: str, justify: str = "left", **_style: Any) -> None:
        """Add a column, aligned left or right."""
        self._headings.append(heading)
        self._right.append(justify == "right")

    def add_row(self, *cells: str, **_style: Any) -> None:
        """Add a row; trailing cells may be missing."""
        self._rows.append((*cells, *[""] * (len(self._headings) - len(cells))))

    def add_section(self) -> None:
        """Add a line below the rows so far."""
        self._rows.append(None)

    def __str__(self) -> str:
        rows = [tuple(self._headings), *(row for row in self._rows if row)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        line = "  ".join("-" * width for width in widths)

        def text(row: tuple[str, ...]) -> str:
            cells = zip(row, widths, self._right, strict=True)
            return "  ".join(c.rjust(w) if right else c.ljust(w) for c, w, right in cells).rstrip()

        body = [line if row is None else text(row) for row in self._rows]
        while body and body[-1] is line:
            body.pop()
        title = [self._title] if self._title else []
        return "\n".join([*title, text(rows[0]), line, *body, ""])

"""Results of a conversion on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rbl_gym.app.tables import new_console, new_table


def print_topics(topics: Sequence[dict[str, Any]]) -> None:
    """Print the topics of a log."""
    table = new_table(None, ["topic", "type"], ["messages", "Hz"], ["read as"])
    for row in topics:
        figures = str(row["messages"]), _hertz(row["rate_hz"])
        table.add_row(row["topic"], row["type"], *figures, ", ".join(row["read_as"]))
    new_console().print(table)


def print_fields(fields: Sequence[tuple[str, str]]) -> None:
    """Print field paths of a message and their first values."""
    table = new_table(None, ["field", "in the first message"])
    for row in fields:
        table.add_row(*row)
    new_console().print(table)


def print_convert(result: dict[str, Any]) -> None:
    """Print what was read, written and dropped, and the next command."""
    console = new_console()
    headings = "messages", "rows", "from (s)", "for (s)", "Hz"
    table = new_table(None, ["", "topic", "type"], headings)
    for kind, said in result["kinds"].items():
        first, *more = said["topics"]
        table.add_row(
            kind,
            f"{first} and {len(more)} more" if more else first,
            said["type"],
            str(said["messages"]),
            str(said["rows"]),
            said["start"] or "",
            f"{said['duration_s']:.1f}",
            _hertz(said["rate_hz"]),
        )
    console.print(table)
    lines = []
    for kind, said in result["kinds"].items():
        for end in ("anchors", "tags"):
            if end in said:
                counts = ", ".join(f"{name} {count}" for name, count in said[end].items())
                lines.append(f"ranges by {end[:-1]}: {counts}")
        lines += [f"{kind}: dropped {n}, {cause}" for cause, n in said["dropped"].items()]
    for line in [*lines, *result["notes"]]:
        console.print(line, soft_wrap=True)
    console.print(f"files: {' '.join(result['files'].values())}", soft_wrap=True)
    if result["replay"]:
        console.print(result["replay"], soft_wrap=True)


def _hertz(rate: float | None) -> str:
    return "" if rate is None else f"{rate:.1f}"

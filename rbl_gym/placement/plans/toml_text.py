"""Write tables as TOML for people to edit: comments, one block per entry, wrapped lists."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

__all__ = ["plain", "to_toml"]

_WIDTH = 96
# Remarks on tables, by the name of the table.
_REMARKS = {
    "anchors": "number of anchors to place, `fixed` ones included",
    "zones": "where the body works; attitude: free, level (upright, the tilt is estimated) or "
    "heading (the tilt is known); keys of requirements, for example: position_m = 0.10, "
    "height_m = 0.20, heading_deg = 5.0, share = 0.95",
    "mounts": "where anchors may be mounted: wall, ceiling, column, area or points",
    "forbidden": "no anchors here",
    "walls": "each crossing leaves the share of a link's information that [materials] gives",
    "obstacles": "what weakens links, and where the body cannot be",
    "materials": "share of a link's information that one crossing leaves, 10^(-loss / 10 dB): "
    "rough values, enter your own; drywall, glass, wood, brick, concrete and metal are known "
    "without an entry",
    "plan": "the drawing from which this was read; layouts are exported to its coordinates",
    "body": "the tags on the body, assumed: enter yours, either shape and size_m, or in place of "
    "both tags = [[x, y, z], ...], metres",
    "noise": "standard deviation of a range, assumed: enter that of your radio",
}


def to_toml(tables: Mapping[str, Any], head: list[str]) -> str:
    """Return a building file as text, with comments.

    Parameters
    ----------
    tables
        Tables of the file: texts and numbers, tables, lists of tables. The key ``#`` of a table is
        a comment.
    head
        Lines of the comment at the top.
    """
    lines = [f"# {line}" for text in head for line in _wrapped(text)]
    tables = dict(tables)
    for key, value in tables.items():
        if not isinstance(value, dict) and not _is_tables(value):
            lines.append(f"{key} = {_value(value)}")
    for key, value in tables.items():
        entries = value if _is_tables(value) else [value] if isinstance(value, dict) else []
        if entries:
            lines += ["", *(f"# {line}" for line in _wrapped(_REMARKS.get(key, "")))]
        for number, entry in enumerate(entries):
            if number:
                lines.append("")
            table = f"[[{key}]]" if _is_tables(value) else f"[{key}]"
            # A layer name may contain line breaks, but the comment must stay on its line.
            note = " ".join(str(entry.get("#", "")).split())
            lines.append(f"{table}  # {note}" if note.isprintable() and note else table)
            lines += [_assigned(name, item) for name, item in entry.items() if name != "#"]
    return "\n".join(lines) + "\n"


def plain(tables: Any) -> Any:
    """Return the same tables without comments."""
    if isinstance(tables, Mapping):
        return {key: plain(value) for key, value in tables.items() if key != "#"}
    return [plain(value) for value in tables] if isinstance(tables, list) else tables


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _assigned(key: str, value: Any) -> str:
    """Return ``key = value``; a long list is wrapped."""
    line = f"{key} = {_value(value)}"
    if len(line) <= _WIDTH or not isinstance(value, list):
        return line
    rows = [f"{key} = ["]
    row = "   "
    for item in value:
        text = f" {_value(item)},"
        if len(row) + len(text) > _WIDTH and row.strip():
            rows.append(row)
            row = "   "
        row += text
    return "\n".join([*rows, row, "]"])


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return repr(value)


def _wrapped(text: str) -> list[str]:
    lines = [""] if text else []
    for word in text.split():
        if len(lines[-1]) + len(word) + 1 > _WIDTH - 2 and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines

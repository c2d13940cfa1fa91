"""Self-contained HTML pages: plots by plotly, sortable tables, no network needed."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 2em auto;
       padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; } h2 { font-size: 1.05em; margin: 1.6em 0 .4em; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9em; font-variant-numeric: tabular-nums; }
th, td { padding: .25em .8em; text-align: right; border-bottom: 1px solid #ddd;
         white-space: nowrap; }
th.text, td.text { text-align: left; } th { background: #f3f5f6; }
table.sortable th { cursor: pointer; }
table.sortable th::after { content: "\\00a0\\2195"; color: #b4bac0; font-size: .85em; }
table.sortable th[aria-sort=ascending]::after { content: "\\00a0\\2191"; color: #222; }
table.sortable th[aria-sort=descending]::after { content: "\\00a0\\2193"; color: #222; }
tbody tr:hover { background: #f7faf9; }
input.filter { font: inherit; font-size: .9em; padding: .2em .6em; margin: 0 0 .5em;
               border: 1px solid #bbb; border-radius: 4px; width: 18em; }
p.note { color: #555; font-size: .9em; margin: .4em 0; }
"""
# Cells sort as numbers if all of a column are numbers; missing ones come last.
_SCRIPT = """
document.querySelectorAll("table.sortable").forEach(table => {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  const number = cell => cell.dataset.value === undefined ? NaN : Number(cell.dataset.value);
  const sort = column => {
    const head = heads[column], up = head.getAttribute("aria-sort") !== "ascending";
    const rows = [...body.rows], sign = up ? 1 : -1;
    const empty = row => row.cells[column].textContent.trim() === "-";
    const numeric = rows.every(row => empty(row) || !Number.isNaN(number(row.cells[column])));
    rows.sort((a, b) => {
      if (empty(a) || empty(b)) return empty(a) - empty(b);
      const [one, other] = [a.cells[column], b.cells[column]];
      return sign * (numeric ? number(one) - number(other)
        : one.textContent.localeCompare(other.textContent, "en", {numeric: true}));
    });
    heads.forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    body.append(...rows);
  };
  heads.forEach((head, column) => {
    head.tabIndex = 0;
    head.addEventListener("click", () => sort(column));
    head.addEventListener("keydown", event => { if (event.key === "Enter") sort(column); });
  });
  const filter = table.closest("section").querySelector("input.filter");
  if (filter) filter.addEventListener("input", () => {
    const words = filter.value.toLowerCase().split(/\\s+/);
    [...body.rows].forEach(row => {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every(word => text.includes(word));
    });
  });
});
"""
# Tables with more rows than this get a filter field.
_MANY = 12


def document(title: str, parts: Iterable[str]) -> str:
    """Return a whole page of HTML parts."""
    name = html.escape(title)
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{name}</title><style>{_STYLE}</style></head><body>",
            f"<h1>{name}</h1>",
            *parts,
            f"<script>{_SCRIPT}</script>",
            "</body></html>\n",
        ]
    )


def note(text: str) -> str:
    """Return a small remark."""
    return f'<p class="note">{html.escape(text)}</p>'


def plot(figure: Any, name: str, first: bool = True) -> str:
    """Return a plotly figure; the first one of a page includes plotly's script."""
    return figure.to_html(
        full_html=False,
        include_plotlyjs=first,
        div_id=name,
        auto_play=False,
        config={"displaylogo": False, "responsive": True},
    )


def table(title: str, headings: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table that sorts when a heading is clicked.

    Cells are numbers (shown with four digits), texts, booleans or None. A text that begins with a
    number ("x1.20", "0.3 m") sorts by this number. Long tables get a field to filter their rows.
    """
    columns = [[row[k] for row in rows] for k in range(len(headings))]
    is_text = [
        any(_number(cell) is None and cell is not None for cell in column) for column in columns
    ]
    kinds = [' class="text"' if text else "" for text in is_text]
    head = "".join(
        f"<th{kind}>{html.escape(text)}</th>" for text, kind in zip(headings, kinds, strict=True)
    )
    body = "\n".join(
        "<tr>" + "".join(_cell(cell, kind) for cell, kind in zip(row, kinds, strict=True)) + "</tr>"
        for row in rows
    )
    field = '<input class="filter" type="search" placeholder="filter rows" aria-label="filter">'
    return (
        f"<section><h2>{html.escape(title)}</h2>{field if len(rows) > _MANY else ''}"
        f'<div class="wide"><table class="sortable"><thead><tr>{head}</tr></thead><tbody>\n{body}\n'
        "</tbody></table></div></section>"
    )


def digits(value: float | None, count: int) -> str:
    """Format with this many significant digits, with trailing zeros; None: a dash."""
    return "-" if value is None else f"{value:#.{count}g}".rstrip(".")


def _cell(value: Any, kind: str) -> str:
    number = _number(value)
    data = "" if number is None else f' data-value="{json.dumps(number)}"'
    return f"<td{kind}{data}>{html.escape(_text(value))}</td>"


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _number(value: Any) -> float | None:
    """Return the sort key of a cell: its number, or that at the start of its text, or None."""
    if isinstance(value, bool) or value is None:
        return None
    if isinstance(value, str):
        first = value.strip().removeprefix("x").split(" ")[0].replace(",", "")
        try:
            value = float(first)
        except ValueError:
            return None
    return float(value) if abs(value) < float("inf") else None


def write(text: str, path: str) -> None:
    """Write a page; create its folder."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text, encoding="utf-8")

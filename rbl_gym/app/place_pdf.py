"""The PDF report of a placement: question and answer, plan, maps, mounting list, tables."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from rbl_gym.app import place_answer, place_draw, place_figures
from rbl_gym.app import place_shapes as shapes
from rbl_gym.app.place_report import notes, tables
from rbl_gym.studies.placing.answer import Placed
from rbl_gym.studies.placing.layout_export import mounting_list

# A4 landscape, inches; text margins, as fractions of the page.
_PAGE = (11.69, 8.27)
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.06, 0.94, 0.9, 0.08
_ROW = 0.027
# The zones of the first page end above its footnote.
_ZONES_END = 0.1
_COLOURS = {
    "pass": shapes.WITHIN,
    "fail": shapes.BEYOND,
    "undecided": "#f0e442",
    "no requirement": shapes.NOTHING,
}


def write_pdf(placed: Placed, path: str) -> None:
    """Write the report; create its folder. The same result gives the same bytes."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    name = placed.result["scene"]
    about = {"Title": f"Anchors for {name}", "Creator": "rbl-gym", "CreationDate": None}
    pages = list(report_pages(placed))
    with PdfPages(path, metadata=about) as book:
        for number, page in enumerate(pages, start=1):
            page.text(
                _RIGHT,
                0.03,
                f"{name}   {number} / {len(pages)}",
                ha="right",
                fontsize=8,
                color="0.4",
            )
            book.savefig(page)


def report_pages(placed: Placed) -> Iterator[Figure]:
    """Return the pages as figures."""
    result = placed.result
    yield _title_page(result)
    yield _plan_page(placed)
    maps = shapes.maps_of(placed)
    for quantity in place_figures.map_panels(placed.problem):
        yield _map_page(placed, maps, quantity)
    rows = mounting_rows(placed)
    yield from _table_pages("Mounting list", [("", rows[0], rows[1:])])
    yield from _table_pages(
        "Figures", [(table.title, table.headings, table.rows) for table in tables(result)]
    )
    yield _notes_page(notes(result))


def mounting_rows(placed: Placed) -> list[list[str]]:
    """Return the mounting list as texts, headings first."""
    headings = ["anchor", "x [m]", "y [m]", "z, above floor [m]", "mount", "faces"]
    found = mounting_list(placed.problem, placed.design.anchors, place_figures.anchor_names(placed))
    slabs = any(row["slab"] for row in found)
    if slabs:
        headings.insert(4, "above slab [m]")
    rows = [[*headings, "measured from", "and from"]]
    for row in found:
        ends = [measured_text(one) for one in row["measured"]]
        cells = [row["name"], *(f"{row[key]:.3f}" for key in ("x_m", "y_m", "z_m"))]
        if slabs:
            cells.append(f"{row['above_slab_m']:.2f} above {row['slab']}" if row["slab"] else "-")
        cells += [row["mount"], row["faces"]]
        rows.append([*cells, *[*ends, "-", "-"][:2]])
    return rows


def measured_text(one: dict[str, Any]) -> str:
    """Return a distance to a wall in words."""
    where = one["to"]
    if not where.endswith(")"):  # its name has no position
        where += f" at ({one['x_m']:g}, {one['y_m']:g})"
    if one["side"] in ("left", "right"):
        return f"{one['distance_m']:.2f} m to the {one['side']}: {where}"
    return f"{one['distance_m']:.2f} m towards {one['side']}: {where}"


def _page(title: str) -> Figure:
    page = Figure(figsize=_PAGE)
    page.text(_LEFT, 0.94, title, fontsize=15, fontweight="bold", va="center")
    page.add_artist(
        Rectangle((_LEFT, 0.918), _RIGHT - _LEFT, 0.002, fc="0.2", transform=page.transFigure)
    )
    return page


def _title_page(result: dict[str, Any]) -> Figure:
    page = Figure(figsize=_PAGE)
    page.text(_LEFT, 0.90, f"Anchors for {result['scene']}", fontsize=24, fontweight="bold")
    y = 0.85
    page.text(_LEFT, y, "Question", fontsize=12, fontweight="bold", color="0.35")
    for line in place_answer.question(result)[:12]:
        for part in textwrap.wrap(line, 105):
            y -= 0.030
            page.text(_LEFT, y, part, fontsize=11)
    y -= 0.06
    page.text(_LEFT, y, "Answer", fontsize=12, fontweight="bold", color="0.35")
    overall = result["verdict"]
    y -= 0.05
    _badge(page, _LEFT, y, overall)
    page.text(
        _LEFT + (0.15 if overall != "no requirement" else 0.0),
        y,
        place_answer.headline(result),
        fontsize=14,
        va="center",
    )
    for line in place_answer.warnings(result):
        for part in textwrap.wrap(line, 155):
            y -= 0.024
            page.text(_LEFT, y - 0.014, part, fontsize=9, va="center")
    y -= 0.06
    zones = place_answer.zone_answers(result)
    step = min(0.09, max(0.055, (y - _ZONES_END) / len(zones)))
    for number, zone in enumerate(zones):
        last = number == len(zones) - 1
        if y - 0.64 * step < _ZONES_END + (0.0 if last else 0.025):
            more = "more zones: see the tables" if number else "zones: see the tables"
            page.text(_LEFT, y, more, fontsize=10, color="0.35", va="center")
            break
        _badge(page, _LEFT, y - 0.012, zone.verdict)
        page.text(0.21, y, zone.name, fontsize=11, fontweight="bold", va="center")
        said = "; ".join(part for part in (zone.reached, zone.figures) if part)
        for k, line in enumerate(textwrap.wrap(said, 118)[:2]):
            page.text(0.21, y - 0.31 * step * (k + 1), line, fontsize=9, va="center")
        y -= step
    page.text(
        _LEFT,
        0.06,
        "Errors are one standard deviation, from one reading of all ranges. No unbiased estimate "
        "from one reading has smaller ones (Cramer-Rao bound).\nA filter that combines several "
        "readings can have smaller errors.",
        fontsize=8,
        color="0.35",
        va="center",
    )
    return page


def _badge(page: Figure, x: float, y: float, verdict: str) -> None:
    """Draw a verdict with colour, sign and word."""
    if verdict == "no requirement":
        return
    fail = verdict == "fail"
    page.text(
        x,
        y,
        place_answer.SIGNS[verdict],
        fontsize=10,
        fontweight="bold",
        va="center",
        color="white" if fail else "black",
        bbox={"boxstyle": "round,pad=0.35", "fc": _COLOURS[verdict], "ec": "black", "lw": 0.8},
    )


@place_figures.styled
def _plan_page(placed: Placed) -> Figure:
    problem, anchors = placed.problem, placed.design.anchors
    page = _page("Plan: anchors, zones, and where anchors may be mounted")
    axes = page.add_axes((0.07, 0.13, 0.86, 0.76))
    for zone in problem.zones:
        axes.fill(*zone.polygon.T, color="#dcecf7", zorder=0)
    place_draw.draw_building(axes, problem, anchors)
    texts = place_draw.draw_anchors(
        axes, problem, anchors, place_figures.anchor_names(placed), heights=True
    )
    place_draw.settle_labels(page, [(axes, texts)])
    page.text(0.5, 0.055, place_figures.legend_text(problem), ha="center", fontsize=8, color="0.35")
    return page


@place_figures.styled
def _map_page(placed: Placed, maps: Any, quantity: shapes.Quantity) -> Figure:
    problem = placed.problem
    title = "Requirements" if quantity.field == "relative" else f"Error of {quantity.name}"
    page = _page(title)
    # A title of two lines needs room above.
    axes = page.add_axes((0.07, 0.12, 0.80, 0.70))
    texts = place_figures.map_panel(axes, placed, maps, quantity, heights=False)
    place_draw.settle_labels(page, [(axes, texts)])
    page.text(0.5, 0.055, place_figures.legend_text(problem), ha="center", fontsize=8, color="0.35")
    return page


# --- tables ----------------------------------------------------------------------------------

Table = tuple[str, list[str], list[list[str]]]


def _table_pages(title: str, found: list[Table]) -> Iterator[Figure]:
    """Return tables one below the other, continued on the next page."""
    page, y = _page(title), _TOP - 0.02
    for name, headings, rows in found:
        widths, size = _widths(headings, rows)
        left = list(rows)
        while True:
            room = int((y - _BOTTOM) / _ROW) - (3 if name else 2)
            if room < min(3, len(left)):
                yield page
                page, y = _page(f"{title}, continued"), _TOP - 0.02
                continue
            part, left = left[:room], left[room:]
            y = _draw_table(page, y, name, headings, part, widths, size)
            if not left:
                break
    yield page


def _widths(headings: list[str], rows: list[list[str]]) -> tuple[list[float], float]:
    """Return column widths as fractions of the page, and a font size that fits them."""
    letters = [
        max(1.18 * len(head), *map(len, cells)) + 2.4
        for head, *cells in zip(_broken(headings), *rows, strict=True)
    ]
    size = float(min(9.0, 9.0 * (_RIGHT - _LEFT) * _PAGE[0] * 72 / (5.2 * sum(letters))))
    return [0.58 * size * n / (_PAGE[0] * 72) for n in letters], size


def _broken(headings: list[str]) -> list[str]:
    """Return the longest line of each heading."""
    return [max(_lines(heading), key=len) for heading in headings]


def _lines(heading: str) -> list[str]:
    return textwrap.wrap(heading, 12) or [""]


def _draw_table(
    page: Figure,
    y: float,
    name: str,
    headings: list[str],
    rows: list[list[str]],
    widths: list[float],
    size: float,
) -> float:
    """Draw a table below `y`; return its lower end."""
    if name:
        page.text(_LEFT, y - 0.012, name, fontsize=10.5, fontweight="bold", va="center")
        y -= 1.3 * _ROW
    is_text = [any(not _is_number(row[k]) for row in rows) for k in range(len(headings))]
    deepest = max(len(_lines(heading)) for heading in headings)
    line = 1.25 * size / (72 * _PAGE[1])
    head = max(_ROW, deepest * line + 0.008)
    page.add_artist(
        Rectangle(
            (_LEFT, y - head),
            sum(widths),
            head,
            fc="#eef1f3",
            transform=page.transFigure,
            zorder=-1,
        )
    )
    for k, row in enumerate([headings, *rows]):
        middle = y - 0.5 * head if k == 0 else y - head - (k - 0.5) * _ROW
        x = _LEFT
        for cell, width, text in zip(row, widths, is_text, strict=True):
            page.text(
                x + (0.004 if text else width - 0.004),
                middle,
                "\n".join(_lines(cell)) if k == 0 else cell,
                fontsize=size,
                ha="left" if text else "right",
                va="center",
                fontweight="bold" if k == 0 else "normal",
                linespacing=1.1,
            )
            x += width
    return y - head - len(rows) * _ROW - 0.03


def _is_number(text: str) -> bool:
    cleaned = text.replace("%", "").replace("x", "").strip()
    try:
        float(cleaned)
    except ValueError:
        return cleaned in ("", "-")
    return True


def _notes_page(found: list[str]) -> Figure:
    page, y = _page("How to read it"), _TOP - 0.03
    for note in found:
        for line in textwrap.wrap(note, 130):
            page.text(_LEFT, y, line, fontsize=9.5, va="center")
            y -= 0.026
        y -= 0.014
    return page

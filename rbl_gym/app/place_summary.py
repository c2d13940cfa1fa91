"""The answer of a placement on the terminal: the verdict, short tables, then notes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rbl_gym.app.page import digits
from rbl_gym.app.place_answer import (
    HOW_TO_ASK,
    WORDS,
    only_not_told,
    percent,
    share_heading,
    share_of,
    warnings,
    without_name,
)
from rbl_gym.app.place_loss import loss_tables
from rbl_gym.app.place_report import (
    Rows,
    anchor_rows,
    fewest_rows,
    layout_rows,
    notes,
    required,
    tables,
    title,
    verdict,
)
from rbl_gym.app.tables import new_console, new_table

_HINT = (
    "More tables, and what the columns mean: --details. All figures: --json F. Maps: --plot F or "
    "--html F."
)


def print_place(result: dict[str, Any], details: bool = False) -> None:
    """Print the verdict, the tables and the notes; `details`: all tables, with explanations."""
    console = new_console()
    found = warnings(result)
    told = f" {_count(len(found))} at the end." if found else ""
    console.print(verdict(result) + told)
    for rows in tables(result) if details else short_tables(result):
        last = len(rows.headings) - (rows.headings[-1] == "required")
        figures, wrapped = rows.headings[1:last], rows.headings[last:]
        table = new_table(rows.title, rows.headings[:1], figures, wrapped, whole=1)
        for row in rows.rows:
            table.add_row(*row)
        console.print(table)
    if not details and (why := only_not_told(result["check"])):
        console.print(why)
    if not details and result["next_anchor"] is not None:
        console.print(next_anchor(result))
    for warning in found:
        console.print(f"Note: {warning}")
    if result["verdict"] == "no requirement":
        console.print(HOW_TO_ASK)
    for note in notes(result) if details else [_HINT]:
        console.print(note)


def _count(number: int) -> str:
    return "One note is" if number == 1 else f"{number} notes are"


def short_tables(result: dict[str, Any]) -> Iterator[Rows]:
    """Return the tables that answer the question."""
    yield _zones(result)
    yield from (Rows(*one) for one in loss_tables(result["zones"]))
    if "fewest" in result:
        yield from fewest_rows(result["fewest"])
    if "against_number" in result:
        yield _numbers(result["against_number"])
    yield anchor_rows(result)
    yield layout_rows(result["layouts"], short=True)
    yield _check(result["check"])


def next_anchor(result: dict[str, Any]) -> str:
    """Return where one more anchor would help most, in a sentence."""
    more = result["next_anchor"]
    where = ", ".join(f"{more[key]:.3f}" for key in ("x_m", "y_m", "z_m"))
    changes = [f"b is then {more['ratio']:.3f} times as large"]
    for now, then in zip(more["zones_now"], more["zones"], strict=True):
        if "share" in now:
            changes.append(
                f"within {now['name']} {percent(now['share'])} -> {percent(then['share'])}"
            )
    return f"One more anchor would help most at ({where}), {more['mount']}: {', '.join(changes)}."


def _zones(result: dict[str, Any]) -> Rows:
    zones = result["zones"]
    asks = any("share" in row for row in zones)
    heights = any(row.get("required", {}).get("height_m") is not None for row in zones)
    what = share_heading(zones)
    alike = what != "at share"
    # Each cell names its share if they differ.
    what = f" {what}" if alike else ""
    keys = [("position_m", f"horizontal{what} (m)"), ("heading_deg", f"heading{what} (deg)")]
    if heights:
        keys.insert(1, ("height_m", f"height{what} (m)"))
    rows = []
    for row in zones:
        cells = [row["name"]]
        if "share" in row:
            cells += [WORDS[row["verdict"]], percent(row["share"]), f"{row['margin']:.3f}"]
        elif asks:
            cells += ["-"] * 3
        mark = "" if alike else f" (p{100 * share_of(row):g})"
        for key, _ in keys:
            value = row[key]["at_share"]
            cells.append(digits(value, 3) + mark * (value is not None))
        if result["survive"]:
            cells.append(without_name(result, row) or "-")
        if asks:
            cells.append(required(row["required"]) if "share" in row else "-")
        rows.append(cells)
    headings = ["zone", *(["verdict", "within", "margin"] if asks else [])]
    headings += [heading for _, heading in keys]
    headings += ["worst without"] if result["survive"] else []
    headings += ["required"] if asks else []
    return Rows(title(result), headings, rows)


def _numbers(numbers: list[dict[str, Any]]) -> Rows:
    rows = []
    for row in numbers:
        asked = [zone for zone in row["zones"] if "share" in zone]
        cells = [str(row["n_anchors"]), *([WORDS[row["verdict"]]] if asked else [])]
        cells += [digits(row[key], 3) for key in ("score_m", "position_p95_m", "rotation_p95_deg")]
        rows.append(cells + [percent(zone["share"]) for zone in asked])
    asked = [zone["name"] for zone in numbers[0]["zones"] if "share" in zone]
    headings = ["anchors", *(["verdict"] if asked else []), "b RMS (m)"]
    headings += ["position p95 (m)", "rotation p95 (deg)", *(f"within {name}" for name in asked)]
    return Rows("against the number of anchors", headings, rows)


def _check(check: dict[str, Any]) -> Rows:
    rows = []
    for name, figures in check["filters"].items():
        cells = [name, percent(figures["found"]), "yes" if figures["holds"] else "no"]
        for key in ("position_ratio", "rotation_ratio"):
            cells.append(f"{figures[key]:.3f}" if figures.get(key) is not None else "-")
        rows.append([*cells, f"{figures['nees']:.2f}" if "nees" in figures else "-"])
    headings = [
        "filter", "found", "agrees", "position RMSE / bound", "rotation RMSE / bound", "NEES",
    ]  # fmt: skip
    return Rows(f"checked by Monte Carlo with {check['trials']} bodies", headings, rows)

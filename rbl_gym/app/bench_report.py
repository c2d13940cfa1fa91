"""Tables of the leaderboard on the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rbl_gym.app.tables import new_console, new_table
from rbl_gym.studies.bench.leaderboard import is_recording
from rbl_gym.worlds import scenes

_HEADINGS = (
    "position (m)", "rotation (deg)", "tags (m)", "median", "p95", "x bound", "ANEES", "lost",
    "flipped", "worse than best (m), 95 %", "us / step",
)  # fmt: skip
# Beyond this number a column would contain only digits.
_HUGE = 1e4
_STRESS = ("nlos", "lost-links", "noise-x2", "anchor-off", "tag-off")


def print_bench(result: dict[str, Any]) -> None:
    """Print a table per scene: the nominal condition in full, then the stress columns."""
    console = new_console(170)
    rows: dict[str, dict[str, dict[str, Any]]] = {}
    for row, microseconds in zip(result["rows"], result["microseconds_per_step"], strict=True):
        by_filter = rows.setdefault(row["scene"], {})
        row = row | {"microseconds_per_step": microseconds}
        by_filter.setdefault(row["filter"], {})[row["condition"]] = row
    stress = [name for name in _STRESS if name in result["conditions"]]
    for scene, by_filter in rows.items():
        first = next(iter(next(iter(by_filter.values())).values()))
        if "nominal" in result["conditions"]:
            console.print(_nominal(scene, first, by_filter))
        if stress:
            console.print(_stressed(scene, by_filter, stress))
        for name, conditions in by_filter.items():
            for line in _remarks(name, conditions):
                console.print(f"  {line}")
        console.print()
    for name in stress:
        console.print(f"{name}: {result['conditions'][name]}")
    console.print(
        "Root mean squares over trials and epochs; median, p95 and the columns after them are of "
        "the tag error.\nANEES per degree of freedom: 1 is consistent, + marks an optimistic and "
        "- a pessimistic filter.\nx bound: tag error divided by the bound; 1 is the best value."
    )


def _nominal(scene: str, first: dict[str, Any], by_filter: dict[str, dict[str, Any]]) -> Any:
    table = new_table(f"{scene}, {trials(first)}, seed {first['seed']}", ["filter"], _HEADINGS)
    order = sorted(by_filter.items(), key=lambda item: _tags(item[1], "nominal"))
    ran = {name: rows["nominal"] for name, rows in order if "tags_m" in rows["nominal"]}
    bounds = [row for row in ran.values() if "bound" in row["tags_m"]][-1:]
    columns = [
        fixed(
            [*(row[part]["rmse"] for row in ran.values()), *(row[part]["bound"] for row in bounds)]
        )
        for part in ("position_m", "rotation_deg", "tags_m")
    ]
    columns += [fixed([row["tags_m"][key] for row in ran.values()]) for key in ("median", "p95")]
    columns += [
        [_number(row["tags_m"].get("to_bound"), "{:.3f}") for row in ran.values()],
        _anees(list(ran.values())),
        *([_percent(row.get(key)) for row in ran.values()] for key in ("lost", "flipped")),
        _worse(ran),
        [_number(row["microseconds_per_step"], "{:.1f}") for row in ran.values()],
    ]
    for k, (name, row) in enumerate(ran.items()):
        style = "dim" if row["status"] == "unobservable" else None
        table.add_row(name, *(column[k] for column in columns), style=style)
    for name, rows in order:
        if name not in ran:
            row = rows["nominal"]
            table.add_row(name, f"{row['status']}, see below", style="dim")
    if bounds:
        table.add_row(
            "bound", *(column[-1] for column in columns[:3]), "", "", "1.000", style="bold"
        )
    return table


def _worse(ran: dict[str, dict[str, Any]]) -> list[str]:
    """Return intervals of each filter's excess tag error over the best filter."""
    parts = {name: row["difference"].get("tags_m") for name, row in ran.items()}
    shown = {name: part for name, part in parts.items() if part and part["best"] != name}
    decimals = decimals_of([part["high"] for part in shown.values()], 2)
    texts = {
        name: f"{part['low']:.{decimals}f} to {part['high']:.{decimals}f}"
        for name, part in shown.items()
    }
    return [texts.get(name, "-") for name in ran]


def _stressed(scene: str, by_filter: dict[str, dict[str, Any]], stress: list[str]) -> Any:
    ratio = any("to_bound" in row.get("tags_m", {}) for rows in by_filter.values()
                for row in rows.values())  # fmt: skip
    parts = "tags (m), x bound, ANEES" if ratio else "tags (m), ANEES"
    headings = [f"{condition}: {parts}" for condition in stress]
    table = new_table(f"{scene}, stress", ["filter"], headings)
    order = "nominal" if any("nominal" in rows for rows in by_filter.values()) else stress[0]
    names = sorted(by_filter, key=lambda name: _tags(by_filter[name], order))
    columns = [_stress([by_filter[name][condition] for name in names]) for condition in stress]
    for name, *cells in zip(names, *columns, strict=True):
        unobservable = any(row["status"] == "unobservable" for row in by_filter[name].values())
        table.add_row(name, *cells, style="dim" if unobservable else None)
    return table


def _stress(rows: list[dict[str, Any]]) -> list[str]:
    """Return a column: tag error, its ratio to the bound, ANEES, lost trials; or the status."""
    ran = [row for row in rows if "tags_m" in row]
    parts = [fixed([row["tags_m"]["rmse"] for row in ran])]
    if any("to_bound" in row["tags_m"] for row in ran):
        parts.append([_number(row["tags_m"].get("to_bound"), "{:.3f}") for row in ran])
    parts = [[text.rjust(max(map(len, part))) for text in part] for part in (*parts, _anees(ran))]
    texts = iter(["  ".join(cells) for cells in zip(*parts, strict=True)])
    return [
        row["status"]
        if "tags_m" not in row
        else next(texts) + (f" {_percent(row['lost'])} lost" if row.get("lost") else "")
        for row in rows
    ]


def _remarks(name: str, conditions: dict[str, dict[str, Any]]) -> list[str]:
    """Return remarks that explain a row."""
    first = next(iter(conditions.values()))
    lines = []
    if first["status"] == "unobservable":
        lines.append(
            f"{name}: does not determine the pose in this scene (rank {first['rank']} of "
            f"{first['states']}); its result depends on its prior"
        )
    nominal = conditions.get("nominal", {})
    if name == "iekf" and nominal.get("verdict") == "optimistic" and _fits(nominal["spec"]):
        lines.append(
            "iekf is optimistic under nominal conditions: the probable cause is the linearisation "
            "(a wide prior, anchors almost in a plane), not the code of a filter"
        )
    for condition, row in conditions.items():
        if row["message"]:
            lines.append(f"{name}, {condition}: {row['status']} {row['message']}")
    rates = [rate for row in conditions.values() if (rate := row.get("trigger_rate")) is not None]
    if any(0 < rate < 1 for rate in rates):
        lines.append(
            f"{name}: {100 * rates[0]:.0f} % of the updates end with a projection to a rotation, "
            f"in the worst condition {100 * max(rates):.0f} %"
        )
    return lines


def _fits(spec: Any) -> bool:
    """Return whether the filter `iekf` has the true models of a scene."""
    if is_recording(spec):
        return False
    scene = scenes.get(spec)
    return scene.survey_std_m == 0 and scene.links.nlos_probability == 0


def _tags(conditions: dict[str, Any], condition: str) -> float:
    """Return the sort key of a filter: its tag RMSE, infinite without one."""
    value = conditions.get(condition, {}).get("tags_m", {}).get("rmse")
    return float("inf") if value is None else value


def _anees(rows: list[dict[str, Any]]) -> list[str]:
    """Return an ANEES column with verdict marks, or a space without a verdict."""
    marks = {"optimistic": "+", "pessimistic": "-", "consistent": " "}
    texts = fixed([row["anees"] for row in rows])
    return [text + marks[row["verdict"]] for text, row in zip(texts, rows, strict=True)]


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def fixed(column: Sequence[float | None]) -> list[str]:
    """Format numbers with the decimals of three digits of the smallest one; None is "-"."""
    decimals = decimals_of(column, 3)
    return [
        "-" if value is None else f"{value:.2e}" if abs(value) >= _HUGE else f"{value:.{decimals}f}"
        for value in column
    ]


def decimals_of(column: Sequence[float | None], digits: int) -> int:
    """Return the decimals that show this many digits of the smallest nonzero number."""
    sizes = [abs(value) for value in column if value]
    return max(0, digits - 1 - math.floor(math.log10(min(sizes)))) if sizes else 0


def trials(row: Mapping[str, Any]) -> str:
    """Return the number of trials of a row; a recording counts as one."""
    return "a recording" if is_recording(row["spec"]) else f"{row['trials']} trials"


def print_rerun(result: dict[str, Any]) -> None:
    """Print how many records were reproduced, and which ones differ."""
    console = new_console()
    console.print(f"{result['identical']} of {result['records']} records are identical")
    for name, (before, after) in (*result["versions"].items(), *result["sources"].items()):
        console.print(f"  {name}: {before} then, {after} now")
    if not result["changed"]:
        return
    headings = (
        "scene", "condition", "filter", "fields that differ", "most: field", "then", "now",
        "relative change",
    )  # fmt: skip
    table = new_table("what differs", headings)
    for row in result["changed"]:
        change = row["relative_change"]
        table.add_row(
            row["scene"],
            row["condition"],
            row["filter"],
            str(row["fields"]),
            row["field"],
            str(row["before"]),
            str(row["after"]),
            "-" if change is None else f"{change:.2g}",
        )
    console.print(table)

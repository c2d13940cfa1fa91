"""Tables of the leaderboard on the terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from rbl_gym.app.reports import new_console

_HEADINGS = (
    "filter", "position (m)", "rotation (deg)", "tags (m)", "median", "p95", "x bound",
    "ANEES", "lost", "flipped", "worse than best, 95 %", "us / step",
)  # fmt: skip
_STRESS = ("nlos", "lost-links", "noise-x2", "anchor-off", "tag-off")


def print_bench(result: dict[str, Any]) -> None:
    """One table for each scene: the nominal condition in full, then the stress columns."""
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
        "Root mean squares over trials and epochs; median, p95 and what follows are of the tag "
        "error.\nANEES: per degree of freedom, 1 is honest; + optimistic, - pessimistic. "
        "Stress: tag RMSE (m), then ANEES, then trials lost."
    )


def _nominal(scene: str, first: dict[str, Any], by_filter: dict[str, dict[str, Any]]) -> Table:
    table = Table(title=f"{scene}, {first['trials']} trials, seed {first['seed']}")
    for heading in _HEADINGS:
        table.add_column(heading, justify="left" if heading == "filter" else "right")
    bound = None
    for name, conditions in sorted(by_filter.items(), key=lambda item: _tags(item[1], "nominal")):
        row = conditions["nominal"]
        if "tags_m" not in row:
            table.add_row(name, f"{row['status']}, {_rank(row)}", style="dim")
            continue
        bound = row
        tags, part = row["tags_m"], row["difference"].get("tags_m")
        table.add_row(
            name,
            _number(row["position_m"]["rmse"]), _number(row["rotation_deg"]["rmse"]),
            *(_number(tags[key]) for key in ("rmse", "median", "p95")),
            _number(tags.get("to_bound"), "{:.3f}"),
            _anees(row), _percent(row.get("lost")), _percent(row.get("flipped")),
            "-" if part is None or part["best"] == name else
            f"{_number(part['low'])} to {_number(part['high'])}",
            _number(row["microseconds_per_step"], "{:.1f}"),
            style="dim" if row["status"] == "unobservable" else None,
        )  # fmt: skip
    if bound is not None and "bound" in bound["tags_m"]:
        values = [
            _number(bound[part]["bound"]) for part in ("position_m", "rotation_deg", "tags_m")
        ]
        table.add_row("bound", *values, "", "", "1", style="bold")
    return table


def _stressed(scene: str, by_filter: dict[str, dict[str, Any]], stress: list[str]) -> Table:
    table = Table(title=f"{scene}, stress")
    table.add_column("filter")
    for heading in stress:
        table.add_column(heading, justify="right")
    order = "nominal" if any("nominal" in rows for rows in by_filter.values()) else stress[0]
    for name, conditions in sorted(by_filter.items(), key=lambda item: _tags(item[1], order)):
        cells = []
        for condition in stress:
            row = conditions[condition]
            if "tags_m" not in row:
                cells.append(row["status"])
                continue
            lost = row.get("lost")
            more = f" {_percent(lost)} lost" if lost else ""
            cells.append(f"{_number(row['tags_m']['rmse'])}  {_anees(row)}{more}")
        unobservable = any(row["status"] == "unobservable" for row in conditions.values())
        table.add_row(name, *cells, style="dim" if unobservable else None)
    return table


def _remarks(name: str, conditions: dict[str, dict[str, Any]]) -> list[str]:
    """What a row of figures cannot say."""
    first = next(iter(conditions.values()))
    lines = []
    if first["status"] == "unobservable":
        lines.append(f"{name}: cannot observe this scene, {_rank(first)}: it leans on its prior")
    for condition, row in conditions.items():
        if row["message"]:
            lines.append(f"{name}, {condition}: {row['status']} {row['message']}")
    rates = [rate for row in conditions.values() if (rate := row.get("trigger_rate")) is not None]
    if any(0 < rate < 1 for rate in rates):
        lines.append(f"{name}: triggered at {100 * rates[0]:.0f} % of the updates, "
                     f"{100 * max(rates):.0f} % where most")  # fmt: skip
    return lines


def _tags(conditions: dict[str, Any], condition: str) -> float:
    """Order of a filter: its tag RMSE, infinite where it has none."""
    value = conditions.get(condition, {}).get("tags_m", {}).get("rmse")
    return float("inf") if value is None else value


def _rank(row: dict[str, Any]) -> str:
    return "" if row["rank"] is None else f"rank {row['rank']} of {row['states']}"


def _anees(row: dict[str, Any]) -> str:
    mark = {"optimistic": "+", "pessimistic": "-", "consistent": ""}[row["verdict"]]
    return f"{_number(row['anees'], '{:.3g}')}{mark}"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.3g} %"


def _number(value: float | None, form: str = "{:.3g}") -> str:
    return "-" if value is None else form.format(value)


def print_rerun(result: dict[str, Any]) -> None:
    """How many records came out the same, and what differs."""
    console = new_console()
    console.print(f"{result['identical']} of {result['records']} records are identical")
    for name, (before, after) in (*result["versions"].items(), *result["sources"].items()):
        console.print(f"  {name}: {before} then, {after} now")
    if not result["changed"]:
        return
    table = Table(title="what differs")
    for heading in ("scene", "condition", "filter", "fields", "most: field", "then", "now", "by"):
        table.add_column(heading)
    for row in result["changed"]:
        change = row["relative_change"]
        table.add_row(
            row["scene"], row["condition"], row["filter"], str(row["fields"]), row["field"],
            str(row["before"]), str(row["after"]), "-" if change is None else f"{change:.2g}",
        )  # fmt: skip
    console.print(table)

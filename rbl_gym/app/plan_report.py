"""Contents of a floor plan on the terminal, and the building file made from it."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

from rbl_gym.app.plan_options import Plan
from rbl_gym.app.tables import new_console, new_table
from rbl_gym.placement.plans.toml_text import to_toml


def layer_rows(plan: Plan) -> list[dict[str, Any]]:
    """Return each layer: its meaning, and its number of entities of each kind."""
    rows, drawing = [], plan.drawing
    if drawing is None:
        return rows
    for layer in drawing.layers():
        kinds = Counter(shape.kind for shape in drawing.shapes if shape.layer == layer)
        rows.append(
            {
                "layer": layer,
                "taken_for": plan.used.get(layer, []),
                "entities": dict(sorted(kinds.items())),
                "unread": dict(sorted(drawing.unread.get(layer, {}).items())),
            }
        )
    return rows


def print_plan(layers: list[dict[str, Any]], said: list[str]) -> None:
    """Print the layers, including unmapped ones, and remarks."""
    console = new_console()
    if layers:
        headings = "layer", "read as", "entities", "not read"
        table = new_table("layers of the drawing", headings)
        for row in layers:
            table.add_row(
                row["layer"],
                ", ".join(row["taken_for"]) or "-",
                _counts(row["entities"]) or "-",
                _counts(row["unread"]) or "-",
            )
        console.print(table)
    for line in said:
        console.print(line)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {kind}" for kind, count in counts.items())


def write_building(tables: dict[str, Any], source: str, said: list[str], path: str) -> None:
    """Write a building file; create its folder; paths in [plan] are relative to it."""
    folder = Path(path).parent
    folder.mkdir(parents=True, exist_ok=True)
    plan = {
        key: Path(os.path.relpath(value, folder)).as_posix()
        if key in ("drawing", "image")
        else value
        for key, value in tables["plan"].items()
    }
    head = [
        f"Read from {Path(source).name} by rbl-gym plan. Lengths are in metres. Edit this file.",
        f"Draw it with: rbl-gym plan {Path(path).name} --plot plan.png",
        *said,
    ]
    Path(path).write_text(to_toml({**tables, "plan": plan}, head), encoding="utf-8")

"""Tables of a placement on the terminal, and the same as HTML's."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from rbl_gym.app.page import digits
from rbl_gym.app.tables import new_console, new_table

# A share of lost bodies above this is said in words.
_MANY_LOST = 0.01


class Rows(NamedTuple):
    """A table as texts; the first column is text, the others are figures."""

    title: str
    headings: list[str]
    rows: list[list[str]]


def tables(result: dict[str, Any]) -> Iterator[Rows]:
    """All tables of a result, in the order in which they answer."""
    yield _anchors(result)
    yield _prediction(result)
    yield _layouts(result["layouts"])
    yield _check(result["check"])
    if "against_number" in result:
        yield _numbers(result["against_number"])


def notes(result: dict[str, Any]) -> list[str]:
    """What the tables mean, and what to be warned of; one sentence or two each."""
    criteria, check = result["criteria"], result["check"]
    conditioning = criteria["conditioning"]
    found = [
        "Predicted: Cramer-Rao bound of one epoch of ranges, one sigma of all three axes together, "
        "averaged over turns of the body; b is the root mean square tag error.",
        f"Criteria: position {criteria['position_m']:.4g} m, rotation "
        f"{math.degrees(criteria['rotation_rad']):.3g} deg, D-optimal "
        f"{criteria['d_optimal_m']:.4g} m, E-optimal {criteria['e_optimal_m']:.4g} m, conditioning "
        + ("infinite (coplanar)." if conditioning is None else f"{conditioning:.3g}."),
        f"Check: {check['trials']} bodies at random poses in the region; the EKF starts from a "
        f"prior of {check['prior_rotation_deg']:g} deg and {check['prior_position_m']:g} m around "
        "the truth. NEES of an honest filter: 6. Lost: further off than once in a million. RMSE is "
        "of all bodies; of found, predicted, ratio and NEES are of those not lost.",
    ]
    for name, figures in check["filters"].items():
        if figures["lost"] > _MANY_LOST:
            found.append(
                f"{name}: {100 * figures['lost']:.3g} % of the bodies are lost; the prediction "
                "and its ratio hold for the others only."
            )
    if result["coplanar"]:
        found.append(
            "These anchors lie in one plane: the mirror image behind it can fit the ranges as "
            "well, so a filter must know the side; the linear filters (KF family) lose rank here."
        )
    if result["obstacles"]:
        found.append(
            "'Told': the radio reports which links are blocked, and the filter weighs them less."
        )
    return found


def print_place(result: dict[str, Any]) -> None:
    """Every table, and the notes."""
    console = new_console()
    for rows in tables(result):
        table = new_table(rows.title)
        for index, heading in enumerate(rows.headings):
            table.add_column(heading, justify="right" if index else "left")
        for row in rows.rows:
            table.add_row(*row)
        console.print(table)
    for note in notes(result):
        console.print(note)


def _anchors(result: dict[str, Any]) -> Rows:
    rows = [
        [
            str(index + 1),
            *(f"{anchor[key]:.3f}" for key in ("x_m", "y_m", "z_m")),
            f"{100 * anchor['sees']:.0f} %",
        ]
        for index, anchor in enumerate(result["anchors"])
    ]
    title = f"{result['scene']}: {result['n_anchors']} anchors ({result['method']})"
    return Rows(title, ["anchor", "x (m)", "y (m)", "z (m)", "sees of region"], rows)


def _prediction(result: dict[str, Any]) -> Rows:
    rows = []
    for key, label in (
        ("position_m", "position (m)"),
        ("rotation_deg", "orientation (deg)"),
        ("score_m", "b (m)"),
    ):
        figures = result["predicted"][key]
        where = "(" + ", ".join(f"{x:.3g}" for x in figures["worst_at_m"]) + ")"
        rows.append(
            [
                label,
                *(digits(figures[what], 4) for what in ("rms", "median", "p95", "worst")),
                where,
            ]
        )
    headings = ["one sigma", "RMS", "median", "p95", "worst place", "where (m)"]
    return Rows("predicted over the region", headings, rows)


_FIGURES = (
    ("b RMS (m)", "score_m", 4),
    ("position median (m)", "position_median_m", 4),
    ("p95", "position_p95_m", 4),
    ("worst", "position_worst_m", 4),
    ("rotation median (deg)", "rotation_median_deg", 3),
    ("p95", "rotation_p95_deg", 3),
    ("worst", "rotation_worst_deg", 3),
)


def _layouts(layouts: dict[str, dict[str, float]]) -> Rows:
    rows = [
        [name, *(digits(row[key], n) for _, key, n in _FIGURES), f"{row['ratio']:.3f}"]
        for name, row in layouts.items()
    ]
    headings = ["layout", *(heading for heading, _, _ in _FIGURES), "b / designed"]
    return Rows("the usual layouts, predicted", headings, rows)


def _check(check: dict[str, Any]) -> Rows:
    rows = []
    for name, figures in check["filters"].items():
        row = [name, f"{100 * figures['lost']:.1f} %"]
        for quantity, unit, n in (("position", "m", 4), ("rotation", "deg", 3)):
            for key in ("rmse_all_{}", "rmse_{}", "predicted_{}"):
                value = figures.get(f"{quantity}_{key.format(unit)}")
                row.append("-" if value is None else digits(value, n))
            ratio = f"{quantity}_ratio"
            row.append(f"{figures[ratio]:.3f}" if ratio in figures else "-")
        rows.append([*row, f"{figures['nees']:.2f}" if "nees" in figures else "-"])
    headings = [
        "filter",
        "lost",
        "position RMSE (m)",
        "of found",
        "predicted",
        "ratio",
        "rotation RMSE (deg)",
        "of found",
        "predicted",
        "ratio",
        "NEES (6)",
    ]
    return Rows(f"checked by Monte Carlo, {check['trials']} trials", headings, rows)


def _numbers(numbers: list[dict[str, float]]) -> Rows:
    rows = [
        [str(row["n_anchors"]), *(digits(row[key], n) for _, key, n in _FIGURES)] for row in numbers
    ]
    headings = ["anchors", *(heading for heading, _, _ in _FIGURES)]
    return Rows("against the number of anchors", headings, rows)

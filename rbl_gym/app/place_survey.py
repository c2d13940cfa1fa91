"""Table of the benefit of a better survey, or of calibrated links, for a placement."""

from __future__ import annotations

from typing import Any

from rbl_gym.app.page import digits


def survey_table(result: dict[str, Any]) -> tuple[str, list[str], list[list[str]]]:
    """Return title, headings and rows."""
    rows, asking = [], list(result["survey"][0]["within"])
    for row in result["survey"]:
        figures = (("position_m", 4), ("rotation_deg", 3), ("score_m", 4))
        shares = [f"{100 * row['within'][name]:.1f} %" for name in asking]
        rows.append([row["unknown"], *(digits(row[key], n) for key, n in figures), *shares])
    headings = ["unknown", "position RMS (m)", "orientation RMS (deg)", "b (m)"]
    headings += [f"within {name}" for name in asking]
    return "one epoch, with errors of the survey or of the links", headings, rows

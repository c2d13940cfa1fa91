"""Table of the errors after the worst loss of an anchor at each position of a zone."""

from __future__ import annotations

from typing import Any

from rbl_gym.app.page import digits


def loss_tables(zones: list[dict[str, Any]]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Return title, headings and rows of the table; no table if no anchor may fail."""
    rows = []
    for zone in zones:
        lost = zone.get("any_loss")
        if lost is None:
            return []
        figures = [
            digits(lost[key][what], 3)
            for key in ("position_m", "heading_deg")
            for what in ("median", "p95", "worst")
        ]
        within = f"{100 * lost['share']:.1f} %" if "share" in lost else "-"
        rows.append([zone["name"], within, *figures])
    headings = [
        "zone", "within after any loss",
        "horizontal median (m)", "p95", "worst", "heading median (deg)", "p95", "worst",
    ]  # fmt: skip
    return [("after the loss of the anchor that hurts most at each place", headings, rows)]

"""Whether the tags determine the heading; without it, the figures of a result have no value."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.placement.building import Problem

# Tags closer to each other than this are in one place, metres.
_APART_M = 1e-6
_TURNS = ("heading_deg", "rotation_deg")
# Requirements are not figures, and the check compares the filters with a bound that has a prior.
_KEPT = ("required", "check")


def has_heading(problem: Problem) -> bool:
    """Return whether the ranges determine the heading: not if all tags are on its axis."""
    tags = problem.tags
    if any(zone.attitude == "free" for zone in problem.zones):
        return bool(np.ptp(tags, axis=0).max() > _APART_M)
    return bool(np.ptp(tags[:, :2], axis=0).max() > _APART_M)


def without_heading(figures: Any) -> Any:
    """Return the figures of a result where those of heading and orientation are None.

    They would be those of the prior.
    """
    if isinstance(figures, list):
        return [without_heading(one) for one in figures]
    if not isinstance(figures, dict):
        return figures
    found = {}
    for key, value in figures.items():
        if key in _KEPT:
            found[key] = value
        elif key.startswith(("rotation_", "rms_heading")) or key in _TURNS:
            found[key] = dict.fromkeys(value) if isinstance(value, dict) else None
        else:
            found[key] = without_heading(value)
    if found.get("requirement") == "heading_deg":
        found["value"] = None
    return found

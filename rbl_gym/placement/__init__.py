"""Placement of anchors: the problem, layouts, search, criteria, files."""

from rbl_gym.measurements.gain import Gain
from rbl_gym.placement.gradient import score_and_gradient
from rbl_gym.placement.problem import (
    MAX_RACKS,
    Context,
    PlacementTask,
    build_contexts,
    checked_context,
    context_uniforms,
    draw_contexts,
    information,
    mounts,
    positions,
    score,
    score_of,
    sight_fractions,
    task,
    whole_volume,
)
from rbl_gym.placement.sample import Sample

__all__ = [
    "MAX_RACKS",
    "Context",
    "Gain",
    "PlacementTask",
    "Sample",
    "build_contexts",
    "checked_context",
    "context_uniforms",
    "draw_contexts",
    "information",
    "mounts",
    "positions",
    "score",
    "score_and_gradient",
    "score_of",
    "sight_fractions",
    "task",
    "whole_volume",
]

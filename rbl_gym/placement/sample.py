"""Poses over which a layout is judged."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.problem import Context, PlacementTask, positions

__all__ = ["Sample", "of_context"]


class Sample(NamedTuple):
    """Poses, with what each counts and what is known there before the first range.

    Attributes
    ----------
    rotation, places
        (P, 3, 3) and (P, 3), metres. The turns of the body at one place follow each other.
    weight
        (P,), sums to 1.
    prior
        Information (P, 6, 6) of the pose error.
    zone
        (P,) index of the zone in which the place lies.
    turns
        How many poses stand at each place.
    """

    rotation: FloatArray
    places: FloatArray
    weight: FloatArray
    prior: FloatArray
    zone: np.ndarray
    turns: int = 1


def of_context(task: PlacementTask, context: Context) -> Sample:
    """The poses over which the environments score a layout in a context without batch axes."""
    n = task.n_poses
    prior = np.broadcast_to(task.prior_information, (n, 6, 6))
    return Sample(
        task.poses[0],
        positions(task, context),
        np.full(n, 1 / n),
        prior,
        np.zeros(n, dtype=np.int64),
    )

"""The experiments of the slides: 5 tags on a rectangular pyramid, 4 anchors, static and dynamic.

Source: the slides "Rigid body localization and tracking", which join the static paper
(ICASSP 2013) and the tracking paper (CAMSAP 2013). They print no parameters: those are of the
two papers, the body's size is that of the static paper's.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rbl_gym.checks import as_tuples
from rbl_gym.geometry import bodies
from rbl_gym.studies.papers import camsap2013, icassp2013
from rbl_gym.studies.papers.icassp2013 import Setting
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.worlds.scene import Scene

__all__ = [
    "slides_experiment",
    "slides_scene",
    "slides_settings",
]

TAGS = bodies.centred([[0, 0, 0], [5, 0, 0], [5, 4, 0], [0, 4, 0], [2.5, 2, 5]])
# Four alternate corners of a cube, the best that four can do.
ANCHORS = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1.0]])
# The slides have no event-triggered filter.
FILTERS = {label: value for label, value in camsap2013.FILTERS.items() if label != "ET-KF"}


def slides_settings() -> dict[str, Setting]:
    """Of the static part."""
    return {
        "[0, 100]^3": Setting(0, 100, 100 * ANCHORS, 0.0, TAGS),
        "[-50, 50]^3": Setting(-50, 50, 100 * ANCHORS - 50, 0.0, TAGS),
    }


def slides_scene() -> Scene:
    """Of the dynamic part: the tracking paper's world with the body of the slides."""
    return dataclasses.replace(camsap2013.paper_scene(), tags=as_tuples(TAGS))


def slides_experiment(trials: int, seed: int, advance: Advance = silent) -> dict[str, Any]:
    """The static experiment, with `camsap2013.tracking_experiment` as its ``"dynamic"``."""
    static = icassp2013.static_experiment("slides2013", slides_settings(), trials, seed, advance)
    dynamic = camsap2013.tracking_experiment(
        trials, seed, advance, world=slides_scene(), filters=FILTERS
    )
    return static | {"dynamic": dynamic | {"experiment": "slides2013, dynamic"}}

"""Run the experiments of the slides: 5 tags on a rectangular pyramid, 4 anchors.

Source: the slides "Rigid body localization and tracking", which combine the static paper (ICASSP
2013) and the tracking paper (CAMSAP 2013). They give no parameters. We use those of the two papers,
and the size of the body of the static paper.
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

__all__ = ["slides_experiment", "slides_scene", "slides_settings"]

TAGS = bodies.centred([[0, 0, 0], [5, 0, 0], [5, 4, 0], [0, 4, 0], [2.5, 2, 5]])
# Four alternate corners of a cube, the best layout of four anchors.
ANCHORS = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1.0]])
# The slides have no event-triggered filter.
FILTERS = {label: value for label, value in camsap2013.FILTERS.items() if label != "ET-KF"}


def slides_settings() -> dict[str, Setting]:
    """Return the settings of the static part."""
    return {
        "[0, 100]^3": Setting(0, 100, 100 * ANCHORS, 0.0, TAGS),
        "[-50, 50]^3": Setting(-50, 50, 100 * ANCHORS - 50, 0.0, TAGS),
    }


def slides_scene() -> Scene:
    """Return the world of the dynamic part: the tracking paper with the body of the slides."""
    return dataclasses.replace(camsap2013.paper_scene(), tags=as_tuples(TAGS))


def slides_experiment(trials: int, seed: int, advance: Advance = silent) -> dict[str, Any]:
    """Run the static experiment; ``"dynamic"`` holds `camsap2013.tracking_experiment`."""
    static = icassp2013.static_experiment("slides2013", slides_settings(), trials, seed, advance)
    dynamic = camsap2013.tracking_experiment(
        trials, seed, advance, world=slides_scene(), filters=FILTERS
    )
    return static | {"dynamic": dynamic | {"experiment": "slides2013, dynamic"}}

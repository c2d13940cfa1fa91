"""The figures of the panel: the score, the zones and the scores of other layouts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.app.studio.state import State
from rbl_gym.app.studio.world import Knobs, World
from rbl_gym.checks import FloatArray
from rbl_gym.placement.building import Problem, Zone
from rbl_gym.studies.monte_carlo import rms
from rbl_gym.studies.placing import design
from rbl_gym.studies.placing.accuracy import accuracy
from rbl_gym.studies.placing.judging import Judged
from rbl_gym.studies.placing.requirements import share_within

# Approximate number of links over the positions of all zones while an anchor is dragged.
_FEW = 1200


class ZoneFigures(NamedTuple):
    """Expected errors of a layout in a zone: RMS values, and the share that meets the requirement.

    `verdict` is ``"pass"``, ``"fail"``, ``"undecided"`` or ``"no requirement"``; then the shares
    are NaN.
    """

    name: str
    verdict: str
    share: float
    required: float
    position_m: float
    height_m: float
    heading_deg: float


class BodyFigures(NamedTuple):
    """Standard deviations at the body's pose, and shares (M,) of information that links keep."""

    position_m: float
    heading_deg: float
    seen: FloatArray


class Figures(NamedTuple):
    """Score b of a layout in metres, figures of each zone, and figures at the body."""

    score_m: float
    zones: tuple[ZoneFigures, ...]
    body: BodyFigures


def figures(state: State, few: bool = False) -> Figures:
    """Return the figures of a state, with fewer positions while an anchor is dragged (`few`)."""
    world, anchors = state.world, state.anchors
    zones = world.problem.zones
    most = max(24, _FEW // (len(anchors) * len(zones))) if few else None
    return Figures(
        state.score,
        tuple(
            _zone_figures(world.problem, zone, anchors, places[:most])
            for zone, places in zip(zones, world.places, strict=True)
        ),
        body_figures(state),
    )


def body_figures(state: State) -> BodyFigures:
    """Return the expected errors at the body's position, with the attitude of its zone."""
    problem, place = state.world.problem, state.body[None]
    zone = next((zone for zone in problem.zones if zone.contains(place)[0]), problem.zones[0])
    errors = accuracy(problem, state.anchors, place, zone)
    return BodyFigures(
        float(errors.position[0]),
        float(np.rad2deg(errors.heading[0])),
        problem.share(state.anchors, place)[0],
    )


def _zone_figures(
    problem: Problem, zone: Zone, anchors: FloatArray, places: FloatArray
) -> ZoneFigures:
    errors = accuracy(problem, anchors, places, zone)
    judged = Judged(zone, places, errors)
    share = float(share_within(judged.relative)) if judged.asks else np.nan
    return ZoneFigures(
        zone.name,
        judged.verdict,
        share,
        zone.share if judged.asks else np.nan,
        float(rms(errors.horizontal)),
        float(rms(errors.height)),
        float(np.rad2deg(rms(errors.heading))),
    )


def usual_scores(world: World, n_anchors: int) -> dict[str, float]:
    """Return b of the usual layouts with `count` anchors by name, the best first, metres."""
    found = design.usual_layouts(world.problem.with_anchors(n_anchors), 0)
    scores = {name: world.score(anchors) for name, anchors in found.items()}
    return dict(sorted(scores.items(), key=lambda item: item[1]))


class Others:
    """Layouts for comparison: the usual ones, and designed ones by knobs and number of anchors."""

    def __init__(self) -> None:
        self.designed: dict[tuple[Knobs, int], FloatArray] = {}
        self._of: tuple[World | None, int] = None, 0
        self._usual: dict[str, float] = {}
        self._scored: tuple[World | None, FloatArray | None, float] = None, None, 0.0

    def search_usual(self, world: World, count: int) -> None:
        """Score the usual layouts with `count` anchors, unless this is done already."""
        if self._of != (world, count):
            self._usual, self._of = usual_scores(world, count), (world, count)

    def scores(self, world: World, count: int) -> dict[str, float | None]:
        """Return b by name; None while a design runs. The usual layouts appear when scored."""
        same = [found for (_, number), found in self.designed.items() if number == count]
        designed = self.designed.get((world.knobs, count), same[0] if same else None)
        found: dict[str, float | None] = {}
        if designed is not None:
            if self._scored[0] is not world or self._scored[1] is not designed:
                self._scored = world, designed, world.score(designed)
            found["designed"] = self._scored[2]
        elif not self.designed:
            found["designed"] = None
        return found | (self._usual if self._of == (world, count) else {})

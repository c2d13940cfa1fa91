"""The world of a page: a problem, and the knobs that change it and its radios."""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, as_tuples
from rbl_gym.geometry.obstacles import Obstacles, Prisms
from rbl_gym.placement.building import Problem
from rbl_gym.placement.layouts import sphere
from rbl_gym.placement.sample import Sample, sample
from rbl_gym.placement.setting import Setting
from rbl_gym.studies.placing.accuracy import spread_places

# Number of poses for comparing layouts, and of positions of each zone for its verdict.
N_POSES, N_PLACES = 1024, 600
# A link with a larger loss counts as lost, decibels; fewer tags do not determine a pose.
MOST_LOSS_DB, LEAST_TAGS = 60.0, 3


class Knobs(NamedTuple):
    """Properties of a problem that can change while the anchors stay.

    The constant part of a range's standard deviation; the number of tags, if it differs from the
    body's own, spread evenly on a sphere, and their largest extent; the loss of a link's
    information behind an opaque obstacle (those with a share of their own change in proportion).
    """

    noise_m: float
    n_tags: int
    size_m: float
    loss_db: float


def knobs_of(problem: Problem) -> Knobs:
    """Return the knobs that describe the problem unchanged."""
    return Knobs(
        float(getattr(problem.noise, noise_field(problem))),
        len(problem.tags),
        float(np.ptp(problem.tags, axis=0).max()),
        loss_db(problem.obstacles.blocked_information),
    )


def noise_field(problem: Problem) -> str:
    """Return the name of the constant term of the problem's noise law: its first length."""
    fields: Any = dataclasses.fields(problem.noise)  # pyrefly: ignore[bad-argument-type]
    return next(field.name for field in fields if field.name.endswith("_m"))


def loss_db(share: float) -> float:
    """Return the loss in decibels of an obstacle that leaves a share."""
    return min(-10 * math.log10(max(share, 1e-12)), MOST_LOSS_DB)


@dataclass(frozen=True, eq=False)
class World:
    """A problem as it was opened, and the knobs that change it."""

    base: Problem
    knobs: Knobs

    @functools.cached_property
    def problem(self) -> Problem:
        """The problem to place anchors for. Without changed knobs it is the original one."""
        base, now, was = self.base, self.knobs, knobs_of(self.base)
        changes: dict[str, Any] = {}
        if now.noise_m != was.noise_m:
            law: Any = base.noise
            changes["noise"] = dataclasses.replace(law, **{noise_field(base): now.noise_m})
        if now[1:3] != was[1:3]:
            changes["tags"] = as_tuples(_tags(base.tags, now.n_tags, now.size_m))
        if now.loss_db != was.loss_db:
            changes["blocked_information"] = 10 ** (-now.loss_db / 10)
            changes["prisms"] = _with_loss(base.obstacles, now.loss_db)
        if not changes:
            return base
        return dataclasses.replace(base, scene=dataclasses.replace(base.scene, **changes))

    @functools.cached_property
    def sample(self) -> Sample:
        """The poses over which layouts are compared."""
        return sample(self.base, N_POSES)

    @functools.cached_property
    def setting(self) -> Setting:
        """The setting that compares layouts; no anchor counts as fixed."""
        return Setting(self.problem.scene, self.sample, self.problem.obstacles)

    @functools.cached_property
    def places(self) -> tuple[FloatArray, ...]:
        """Positions (L, 3) of every zone for its verdict, as in `rbl-gym place` with seed 0."""
        return tuple(
            spread_places(self.base, zone, np.random.default_rng([0, 3]), N_PLACES)
            for zone in self.base.zones
        )

    def score(self, anchors: FloatArray) -> float:
        """Return b of a layout (M, 3) over the poses, metres, as `placement.score` computes it."""
        return self.setting.score(anchors)

    def with_knobs(self, knobs: Knobs) -> World:
        """Return the same problem with other knobs."""
        changed = World(self.base, knobs)
        # Neither depends on a knob.
        for name in ("sample", "places"):
            if name in self.__dict__:
                changed.__dict__[name] = self.__dict__[name]
        return changed


def _tags(tags: FloatArray, count: int, size_m: float) -> FloatArray:
    """Return tags (count, 3) of an extent: the body's own, or spread evenly on a sphere."""
    if count != len(tags):
        tags = sphere(count)
    return tags * (size_m / float(np.ptp(tags, axis=0).max()))


def _with_loss(obstacles: Obstacles, db: float) -> Prisms:
    """Return prisms for another loss of obstacles; shares of their own change in proportion."""
    was, prisms = loss_db(obstacles.blocked_information), obstacles.prisms
    share = prisms.share ** (db / was) if was > 0 else prisms.share
    return dataclasses.replace(prisms, share=share)

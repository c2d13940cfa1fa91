"""Collect all inputs of the score of a layout as arrays: body, noise, poses, obstacles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Box, Region, Shell, Walls
from rbl_gym.measurements import ranging
from rbl_gym.measurements.gain import EVERYWHERE, Gain
from rbl_gym.placement.building import Problem
from rbl_gym.placement.gradient import of_arrays
from rbl_gym.placement.problem import Context, PlacementTask, weighted_square
from rbl_gym.placement.sample import Sample, of_context

__all__ = ["Setting", "of_problem", "of_task"]


class Setting(NamedTuple):
    """A placement problem in the form of the search.

    Attributes
    ----------
    tags
        Tags (N, 3) in the body frame, metres.
    noise
        The noise law of the ranges.
    sample
        The poses for the score. Their prior includes the information of fixed anchors.
    region
        Legal anchor positions.
    obstacles
        Obstacles. The line of sight is that from the anchor to the body's origin.
    gain
        Reach and field of view of the anchors.
    """

    tags: FloatArray
    noise: ranging.NoiseLaw
    sample: Sample
    region: Region
    obstacles: Obstacles
    gain: Gain = EVERYWHERE

    def sight(self, anchors: FloatArray) -> FloatArray:
        """Return the information fraction (P, M, N) of each link behind the obstacles."""
        sample, links = self.sample, (len(anchors), len(self.tags))
        if not self.obstacles:
            return np.broadcast_to(1.0, (len(sample.places), *links))
        share = self.obstacles.share(anchors, sample.places[:: sample.turns])
        share = np.repeat(share, sample.turns, axis=0)[..., None]
        return np.broadcast_to(share, (*share.shape[:-2], *links))

    def parts(self, anchors: FloatArray) -> FloatArray:
        """Return the information (M, P, 6, 6) of each anchor alone at each pose."""
        sample = self.sample
        share = np.moveaxis(self.sight(anchors), 1, 0)[..., None, :]
        if self.gain:
            tags = ranging.tag_positions(sample.rotation, sample.places, self.tags)
            normals = self.region.normal(anchors)[:, None, None]
            share = share * self.gain.share(tags - anchors[:, None, None], normals)[..., None, :]
        places = sample.rotation, sample.places
        return bounds.information_at(anchors[:, None, None], self.tags, *places, self.noise, share)

    def told(self, anchors: FloatArray) -> FloatArray:
        """Return the information (P, 6, 6) of a layout and of the prior."""
        return self.parts(anchors).sum(axis=0) + self.sample.prior

    def squares(self, information: FloatArray) -> FloatArray:
        """Return the weighted mean (...) of b^2, for information (..., P, 6, 6) with the prior."""
        sample = self.sample
        return weighted_square(information, sample.rotation, self.tags, sample.weight)

    def score(self, anchors: FloatArray) -> float:
        """Return the score of a layout (M, 3), metres."""
        return float(np.sqrt(self.squares(self.told(anchors))))

    def score_and_gradient(self, anchors: FloatArray) -> tuple[float, FloatArray]:
        """Return the score of a layout, and its derivative (M, 3) by the anchors."""
        normals = self.region.normal(anchors) if self.gain else np.zeros(anchors.shape)
        law = ranging.numbers_of(self.noise, len(self.tags))
        assert law is not None  # the laws of scenes have numbers
        score, gradient = of_arrays(
            anchors,
            normals,
            *self.sample[:4],
            self.tags,
            law,
            self.gain.numbers,
            self.sight(anchors),
        )
        return float(score), gradient

    def legal(self, points: FloatArray) -> BoolArray:
        """Return which points (..., 3) lie in the region and outside of obstacles."""
        off = np.abs(self.region.project(points) - points).max(axis=-1)
        return (off <= 1e-6) & ~self.obstacles.contain(points)

    @property
    def is_smooth(self) -> bool:
        """Whether the score is differentiable and anchors can follow its gradient everywhere.

        This holds without obstacles and limits of reach, if the faces are connected.
        """
        plain = isinstance(self.region, Box | Shell | Walls)
        return plain and not self.obstacles and not self.gain

    def part(self, index: np.ndarray) -> Setting:
        """Return the setting for the poses of indices."""
        return self._replace(sample=self.sample.part(index))


def of_task(task: PlacementTask, context: Context) -> Setting:
    """Return the setting of an environment's problem, a context without batch axes."""
    scene, poses = task.scene, of_context(task, context)
    setting = Setting(
        scene.body, scene.noise, poses, scene.anchor_region, task.obstacles(context), scene.gain
    )
    return _with_fixed(setting, np.array(scene.fixed).reshape(-1, 3))


def of_problem(problem: Problem, sample: Sample) -> Setting:
    """Return the setting of a problem for its poses, with its fixed anchors in the prior."""
    setting = Setting(
        problem.tags, problem.noise, sample, problem.mounts, problem.obstacles, problem.gain
    )
    return _with_fixed(setting, problem.fixed)


def _with_fixed(setting: Setting, fixed: FloatArray) -> Setting:
    """Return the setting with the information of fixed anchors (F, 3) in the prior."""
    if not len(fixed):
        return setting
    return setting._replace(sample=setting.sample._replace(prior=setting.told(fixed)))

"""Collect all inputs of the score of a layout as arrays: body, noise, poses, obstacles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Box, Region, Shell, Walls
from rbl_gym.measurements import ranging
from rbl_gym.placement.building import Problem
from rbl_gym.placement.gradient import of_arrays
from rbl_gym.placement.problem import Context, PlacementTask, weighted_square
from rbl_gym.placement.sample import Sample, of_context
from rbl_gym.worlds.scene import Scene

__all__ = ["Setting", "of_problem", "of_task"]


class Setting(NamedTuple):
    """A placement problem in the form of the search; contexts and layouts may have leading axes.

    Attributes
    ----------
    scene
        Scene with the body, the noise, the region of legal anchor positions, and the anchors' reach
        and field of view.
    sample
        The poses for the score. Their prior includes the information of fixed anchors.
    obstacles
        Obstacles. The line of sight is that from the anchor to the body's origin.
    """

    scene: Scene
    sample: Sample
    obstacles: Obstacles

    @property
    def region(self) -> Region:
        """Legal anchor positions."""
        return self.scene.anchor_region

    def sight(self, anchors: FloatArray) -> FloatArray:
        """Return the information fraction (..., P, M, N) of each link behind the obstacles."""
        places, turns, n = self.sample.places, self.sample.turns, len(self.scene.tags)
        if not self.obstacles:
            return np.broadcast_to(1.0, (places.shape[-2], anchors.shape[-2], n))
        share = np.repeat(self.obstacles.share(anchors, places[..., ::turns, :]), turns, axis=-2)
        return np.broadcast_to(share[..., None], (*share.shape, n))

    def parts(self, anchors: FloatArray) -> FloatArray:
        """Return the information (..., M, P, 6, 6) of each anchor alone at each pose."""
        scene, rotation, places = self.scene, self.sample.rotation, self.sample.places
        share = np.swapaxes(self.sight(anchors), -3, -2)[..., None, :]
        places, anchors = places[..., None, :, :], anchors[..., None, :]
        if scene.gain:
            tags = ranging.tag_positions(rotation, places, scene.body)
            normals = self.region.normal(anchors)[..., None, :]
            links = scene.gain.share(tags - anchors[..., None, :], normals)
            share = share * links[..., None, :]
        return bounds.information_at(
            anchors[..., None, :], scene.body, rotation, places, scene.noise, share
        )

    def told(self, anchors: FloatArray) -> FloatArray:
        """Return the information (..., P, 6, 6) of a layout and of the prior."""
        return self.parts(anchors).sum(axis=-4) + self.sample.prior

    def squares(self, information: FloatArray) -> FloatArray:
        """Return the weighted mean (...) of b^2, for information (..., P, 6, 6) with the prior."""
        sample = self.sample
        return weighted_square(information, sample.rotation, self.scene.body, sample.weight)

    def score(self, anchors: FloatArray) -> float:
        """Return the score of a layout (M, 3), metres."""
        return float(np.sqrt(self.squares(self.told(anchors))))

    def score_and_gradient(self, anchors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return scores (...) of layouts, and their derivatives (..., M, 3) by the anchors."""
        scene = self.scene
        normals = self.region.normal(anchors) if scene.gain else np.zeros(anchors.shape)
        law = ranging.numbers_of(scene.noise, len(scene.tags))
        assert law is not None  # the laws of scenes have numbers
        told = *self.sample[:4], scene.body, law, scene.gain.numbers
        return of_arrays(anchors, normals, *told, self.sight(anchors))

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
        return plain and not self.obstacles and not self.scene.gain

    def with_fixed(self, fixed: FloatArray) -> Setting:
        """Return the setting with the information of further fixed anchors (F, 3) in the prior."""
        if not len(fixed):
            return self
        return self._replace(sample=self.sample._replace(prior=self.told(fixed)))

    def part(self, index: np.ndarray) -> Setting:
        """Return the setting with the poses of these indices."""
        return self._replace(sample=self.sample.part(index))


def of_task(task: PlacementTask, context: Context) -> Setting:
    """Return the setting of an environment's problem in contexts (...)."""
    setting = Setting(task.scene, of_context(task, context), task.obstacles_in(context))
    return setting.with_fixed(np.array(task.scene.fixed).reshape(-1, 3))


def of_problem(problem: Problem, sample: Sample) -> Setting:
    """Return the setting of a problem for its poses, with its fixed anchors in the prior."""
    return Setting(problem.scene, sample, problem.obstacles).with_fixed(problem.fixed)

"""Worlds with an iterated EKF behind their ranges: what the learning tasks have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rbl_gym import bounds, metrics, rendering
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.envs.batch import BatchEnv
from rbl_gym.envs.episodes import EpisodeStore
from rbl_gym.estimators import PoseBelief
from rbl_gym.estimators.iekf.manifold import IteratedEkf, PoseState
from rbl_gym.worlds import simulation
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers.estimate import update

# Iterations of the filter; two are as good as four here, and faster.
_ITERATIONS = 2


class FilterLoop(BatchEnv):
    """Worlds of a scene with an iterated EKF behind their ranges.

    Attributes
    ----------
    scene
        The world.
    state
        The filter's state after the last update.
    anchors
        (B, M, 3), where they stand now.
    """

    def _configure_loop(self, scene: Scene, num_envs: int) -> None:
        self.scene = scene
        self.filter = IteratedEkf(
            np.asarray(scene.tags), scene.noise, scene.process, iterations=_ITERATIONS
        )
        self._tags = np.asarray(scene.tags)
        self._episodes = EpisodeStore(scene, num_envs)
        self.anchors = np.zeros((num_envs, scene.n_anchors, 3))
        self.state = PoseState(
            np.tile(np.eye(3), (num_envs, 1, 1)),
            np.zeros((num_envs, 3)),
            np.tile(np.eye(6), (num_envs, 1, 1)),
        )
        self._score_m: FloatArray | None = None
        # The worlds as they were asked for last, and the epochs of that.
        self._at: tuple[bytes, simulation.Epoch] | None = None

    def _start(self, chosen: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        """New episodes of some worlds; their state is the prior."""
        start = self._episodes.begin(chosen, generators)
        self._at = None
        self.anchors[chosen] = start["anchors"]
        prior = self.filter.initial(
            *(start[f"prior_{name}"] for name in ("rotation", "translation", "covariance"))
        )
        self._put(chosen, prior)

    @property
    def at(self) -> simulation.Epoch:
        """The true worlds now: what a policy must not see. Not to be written to."""
        epochs = self._epochs.tobytes()
        if self._at is None or self._at[0] != epochs:
            self._at = epochs, self._episodes.at(self._epochs)
        return self._at[1]

    @property
    def twist(self) -> FloatArray:
        """Known twist (B, 6) of the interval that ended now."""
        return self.at.twist

    def _predict(self, rows: np.ndarray) -> None:
        """Predict some worlds to their epochs."""
        state = PoseState(*(field[rows] for field in self.state))
        self._put(rows, self.filter.predict(state, self.at.twist[rows], self.scene.dt))

    def _update(self, rows: np.ndarray, chosen: BoolArray | None = None) -> None:
        """Update some worlds with their ranges; `chosen` (B, M): which anchors measure."""
        at = simulation.Epoch(*(None if field is None else field[rows] for field in self.at))  # pyright: ignore[reportArgumentType]
        anchors = self.anchors[rows]
        quality = None
        if self.scene.obstacles:
            quality = simulation.link_quality(self.scene, at, anchors)
        measured = simulation.measure(self.scene, at, anchors, quality=quality)
        links = measured.links if chosen is None else measured.links & chosen[rows, :, None]
        epoch = {"ranges": measured.ranges, "links": links, "anchors": anchors}
        if quality is not None:
            epoch["quality"] = quality
        state = PoseState(*(field[rows] for field in self.state))
        self._put(rows, update(self.filter, state, epoch, self.scene))

    def _put(self, rows: np.ndarray, state: PoseState) -> None:
        self._score_m = None
        if len(rows) == self.num_envs:
            self.state = state
        else:
            self.state = PoseState(*(field.copy() for field in self.state))
            for field, new in zip(self.state, state, strict=True):
                field[rows] = new

    @property
    def belief(self) -> PoseBelief:
        """The beliefs now."""
        return self.filter.belief(self.state)

    @property
    def score_m(self) -> FloatArray:
        """b (B,) of the beliefs, metres."""
        if self._score_m is None:
            self._score_m = bounds.score(self.state.covariance, self.state.rotation, self._tags)
        return self._score_m.copy()

    def _inform(self) -> dict[str, np.ndarray]:
        at, state = self.at, self.state
        error = metrics.pose_error(state.rotation, state.translation, at.rotation, at.translation)
        truth = at.rotation, at.translation
        return {
            "score_m": self.score_m,
            "rotation_error_rad": np.linalg.norm(error[..., :3], axis=-1),
            "position_error_m": np.linalg.norm(error[..., 3:], axis=-1),
            "tag_error_m": metrics.tag_error(state.rotation, state.translation, *truth, self._tags),
            "nees": metrics.nees(error, state.covariance),
            "epoch": self._epochs.copy(),
        }

    def _measuring(self) -> BoolArray:
        """Which anchors (B, M) measured last."""
        return np.ones(self.anchors.shape[:2], dtype=np.bool_)

    def _shot(self) -> tuple[Any, rendering.Pose]:
        at, links = self.at, self._measuring()[..., None]
        shot = rendering.shot(links, self.anchors, at.rotation, at.translation)
        return shot, rendering.Pose(*self.state[:3])

    def _log_std(self) -> FloatArray:
        """Logarithms (B, 6) of the standard deviations, less that of their usual size."""
        std = np.sqrt(np.diagonal(self.state.covariance, axis1=-2, axis2=-1))
        prior = np.sqrt(np.diagonal(self.scene.prior_covariance))
        return np.log(np.maximum(std, 1e-12) / prior) + 1.0

    def _velocity(self) -> FloatArray:
        """Commanded velocities (B, 3) over the speed."""
        speed = max(self.scene.speed_m_s, float(np.abs(self.scene.twist[3:]).max()), 1e-3)
        return self.twist[:, 3:] / speed

    def _columns(self) -> FloatArray:
        """The first two columns (B, 6) of the estimated rotation."""
        return np.swapaxes(self.state.rotation, -1, -2)[:, :2].reshape(-1, 6)

"""RBL/Tracking-v0 with many bodies: the native vector environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from rbl_gym import rendering
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.envs.batch import BatchEnv
from rbl_gym.envs.episodes import EpisodeStore, FamilyStore
from rbl_gym.envs.tracking import action_space, check_reward, observation_space, observed, worlds_of
from rbl_gym.worlds import scene_bounds, simulation
from rbl_gym.worlds.scene import Scene
from rbl_gym.worlds.stacked import StackedScenes

# Keys that only the info of a reset has.
_TOLD = ("prior_rotation", "prior_translation", "prior_covariance", "scene")


class TrackingVectorEnv(BatchEnv):
    """`num_envs` independent `TrackingEnv` worlds in arrays with a leading axis.

    Created by ``gym.make_vec("rbl_gym:RBL/Tracking-v0", num_envs=1024, scene=...)``. Observations,
    rewards and infos are those of the scalar environment, stacked; see its docstring. `info` also
    has Gymnasium's boolean masks ``_key``. Seeding and autoreset work as in `BatchEnv`.

    Parameters
    ----------
    num_envs
        Number of worlds.
    scene, reward, render_mode
        As `TrackingEnv`.
    scenes
        As `TrackingEnv`: each world draws its own scene at every reset.
    max_episode_steps
        Truncate after this many steps, if fewer than the scene's.
    autoreset_mode
        ``"NextStep"`` (default), ``"SameStep"`` or ``"Disabled"``, see `BatchEnv`.
    """

    # Whether worlds take the members of a family in turn instead of drawing them.
    _in_turn = False

    def __init__(
        self,
        num_envs: int = 1,
        scene: str | Mapping[str, Any] | Scene = "uwb_room",
        reward: str = "bound",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        scenes: Any = None,
    ) -> None:
        self.family, self.scene = worlds_of(scene, scenes)
        self.reward_mode = check_reward(reward, self.family)
        worlds = self.family or self.scene
        self.single_observation_space = observation_space(worlds)
        self.single_action_space = action_space(worlds)
        if self.family is None:
            self.film = rendering.film_of(render_mode, self.scene)
        else:
            self.film = rendering.film_of_many(render_mode, self._scene_of, worlds.steps)
        self._configure(num_envs, render_mode, worlds.steps, max_episode_steps, autoreset_mode)
        self._episodes = (
            EpisodeStore(self.scene, num_envs)
            if self.family is None
            else FamilyStore(self.family, num_envs, self._in_turn)
        )
        self._longest = self.steps_limit
        self._anchors: FloatArray = np.zeros((num_envs, worlds.n_anchors, 3))
        self._prior_covariance = np.empty((num_envs, 6, 6))
        size = 6 if self.family is not None else scene_bounds.information_size(self.scene)
        self._information: FloatArray = np.empty((num_envs, size, size))
        self._score_m: FloatArray = np.empty(num_envs)
        self._seen: tuple[simulation.Epoch, dict[str, np.ndarray]] | None = None

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode; of a family, the largest number."""
        return self._longest

    @property
    def world(self) -> Scene | StackedScenes:
        """The scene; of a family, the present scenes of all worlds, stacked."""
        return self._episodes.stack if isinstance(self._episodes, FamilyStore) else self.scene

    def _scene_of(self, world: int) -> Scene:
        assert isinstance(self._episodes, FamilyStore)
        return self._episodes.stack.scenes[world]

    def _restart(
        self, chosen: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, np.ndarray]:
        start = self._episodes.begin(chosen, generators)
        self._anchors[chosen] = start["anchors"]
        self._prior_covariance[chosen] = start["prior_covariance"]
        self._seen = None
        if isinstance(self._episodes, FamilyStore):
            self.steps_limit = np.minimum(self._episodes.stack.arrays.steps, self._longest)
        if self.reward_mode == "bound":
            self._carry_bound(chosen, started=True)
        return {name: value for name, value in start.items() if name in _TOLD}

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        self._seen = None
        if (self.family or self.scene).anchor_speed_m_s > 0:
            # All worlds at once: those that reset in this step get their anchors from the new
            # episode.
            if isinstance(self._episodes, FamilyStore):
                moved = self._episodes.stack.move_anchors(self._anchors, actions)
            else:
                moved = simulation.move_anchors(self.scene, self._anchors, actions)
            if moving.all():
                self._anchors = moved
            else:
                self._anchors[moving] = moved[moving]
        if self.reward_mode == "none":
            return np.zeros(self.num_envs), terminated
        self._carry_bound(np.flatnonzero(moving), started=False)
        return -np.log(self._score_m), terminated

    def _look(self) -> tuple[simulation.Epoch, dict[str, np.ndarray]]:
        """Return all worlds at their epochs and their measurements, computed once for all callers.

        The arrays are new, and `_observe` and `_inform` hand them to the caller.
        """
        if self._seen is None:
            at = self._episodes.at(self._epochs)
            self._seen = at, observed(self.world, at, self._anchors)  # pyrefly: ignore[bad-argument-type]
        return self._seen

    def _observe(self) -> dict[str, np.ndarray]:
        at, told = self._look()
        seen = {key: field for key, field in told.items() if key != "nlos"}
        if at.readings is not None:
            seen["inertial"] = at.readings.copy()
        seen |= {"anchors": simulation.surveyed(at, self._anchors), "twist": at.twist}
        if not isinstance(self._episodes, FamilyStore):
            return seen
        arrays = self._episodes.stack.arrays
        if "quality" in seen:
            seen["quality"] = seen["quality"] * arrays.anchor_mask
        masks = {name: getattr(arrays, name).copy() for name in ("tags", "anchor_mask", "tag_mask")}
        return {key: (seen | masks)[key] for key in self._episodes.stack.family.fields}

    def _inform(self) -> dict[str, np.ndarray]:
        at, told = self._look()
        info = {
            "rotation": at.rotation,
            "translation": at.translation,
            "epoch": self._epochs.copy(),
            "nlos": told["nlos"],
        }
        if at.velocity is not None and at.bias is not None:
            info["velocity"], info["inertial_bias"] = at.velocity.copy(), at.bias.copy()
        if at.survey is not None:
            info["anchors"] = self._anchors.copy()
        if self.reward_mode == "bound":
            info["score_m"] = self._score_m.copy()
        return info

    def _shot(self) -> tuple[Any, None]:
        at, told = self._look()
        known = self._information if self.reward_mode == "bound" else None
        bound = None if known is None else scene_bounds.pose_covariance(known)
        links = told["links"].view(np.bool_)
        return rendering.shot(links, self._anchors, at.rotation, at.translation, bound), None

    def _carry_bound(self, rows: np.ndarray, *, started: bool) -> None:
        """Update the posterior Cramer-Rao bound of the worlds that started or stepped."""
        at, told = self._look()
        anchors, links = self._anchors, told["links"].view(np.bool_)
        information, prior = self._information, self._prior_covariance
        if len(rows) < self.num_envs:
            at = simulation.Epoch(*(None if field is None else field[rows] for field in at))  # pyrefly: ignore[bad-argument-type]
            anchors, links = anchors[rows], links[rows]
            information, prior = information[rows], prior[rows]
        information, score_m = self._bound_of(
            rows, at, anchors, links, None if started else information, prior
        )
        if len(rows) < self.num_envs:
            self._information[rows], self._score_m[rows] = information, score_m
        else:
            self._information, self._score_m = information, score_m

    def _bound_of(
        self,
        rows: np.ndarray,
        at: simulation.Epoch,
        anchors: FloatArray,
        links: BoolArray,
        previous: FloatArray | None,
        prior: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return `scene_bounds.posterior_step` of some worlds, by number of tags in a family."""
        if not isinstance(self._episodes, FamilyStore):
            return scene_bounds.posterior_step(self.scene, at, anchors, links, previous, prior)
        stack = self._episodes.stack.rows(rows)
        information, score = np.empty((len(rows), 6, 6)), np.empty(len(rows))
        for count, alike in stack.bodies():
            information[alike], score[alike] = scene_bounds.posterior_step(
                stack.rows(alike).with_tags(count),  # pyrefly: ignore[bad-argument-type]
                simulation.Epoch(*(None if f is None else f[alike] for f in at)),  # pyrefly: ignore[bad-argument-type]
                anchors[alike],
                links[alike, :, :count],
                None if previous is None else previous[alike],
                prior[alike],
            )
        return information, score

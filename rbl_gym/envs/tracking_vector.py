"""RBL/Tracking-v0, many bodies at once: the native vector environment on the scalar one's core."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from rbl_gym import rendering, scenes, simulation
from rbl_gym.checks import BoolArray, FloatArray, check_array, check_one_of
from rbl_gym.components import whole_rows
from rbl_gym.envs.batch import reset_mask, seeds_of
from rbl_gym.envs.episodes import EpisodeStore
from rbl_gym.envs.tracking import (
    REWARDS,
    TrackingEnv,
    action_space,
    are_zeros,
    is_statistic,
    links_of,
    measure,
    observation_space,
)


class TrackingVectorEnv(VectorEnv[Any, Any, Any]):
    """`num_envs` independent `TrackingEnv` worlds in arrays with a leading axis.

    Made by ``gym.make_vec("rbl_gym:RBL/Tracking-v0", num_envs=1024, scene=...)``. Observations,
    rewards and infos are those of the scalar environment, stacked; its docstring describes
    them. `info` keys have Gymnasium's boolean masks ``_key`` beside them.

    Seeding: ``reset(seed=s)`` seeds environment i with ``s + i``, a list gives each its own.
    Every environment has a generator of its own and draws an episode from it at reset exactly as
    the scalar environment does, so that environment i equals ``TrackingEnv`` seeded with its
    seed, episode after episode, in every autoreset mode.

    Parameters
    ----------
    num_envs
        How many.
    scene, reward, render_mode, observation
        As `TrackingEnv`.
    max_episode_steps
        Truncate after so many steps, if fewer than the scene's.
    autoreset_mode
        ``"NextStep"`` (default): the step after an episode's end resets, ignores its action and
        rewards 0. ``"SameStep"``: the ending step already returns the next episode's first
        observation, and `info` holds ``final_obs`` and ``final_info``. ``"Disabled"``: call
        ``reset(options={"reset_mask": mask})``.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scene: str | Mapping[str, Any] = "uwb_room",
        reward: str = "bound",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        observation: str = "ranges",
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"num_envs must be a positive int, got {num_envs!r}")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be at least 1, got {max_episode_steps!r}")
        modes = [mode.value for mode in AutoresetMode]
        if not isinstance(autoreset_mode, AutoresetMode):
            autoreset_mode = AutoresetMode(check_one_of("autoreset_mode", autoreset_mode, modes))
        self.num_envs = num_envs
        self.scene = scenes.get(scene)
        self.film = rendering.film_of(render_mode, self.scene)
        self.reward_mode = check_one_of("reward", reward, REWARDS)
        self.render_mode = render_mode
        self.steps_limit = min(self.scene.steps, max_episode_steps or self.scene.steps)
        self.metadata = {**TrackingEnv.metadata, "autoreset_mode": autoreset_mode}
        self._mode = autoreset_mode
        self.statistic = is_statistic(observation, self.scene)
        self.single_observation_space = observation_space(self.scene, self.statistic)
        self.single_action_space = action_space(self.scene)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._episodes = EpisodeStore(self.scene, num_envs, self.statistic)
        # Worlds last in memory, as in the store.
        self._anchors = np.empty((num_envs, self.scene.n_anchors, 3), order="F")
        self._prior_covariance = np.empty((num_envs, 6, 6))
        self._done = np.zeros(num_envs, dtype=np.bool_)
        self._epochs = np.zeros(num_envs, dtype=np.int64)

    # --- reset ------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start all episodes, or with ``options={"reset_mask": mask}`` those of the mask."""
        mask = reset_mask(options, self.num_envs)
        seeds = seeds_of(seed, self.num_envs)
        if self._episodes.empty and not mask.all():
            raise gym.error.ResetNeeded("reset all environments before some of them")
        if not self._generators:
            self._generators = [seeding.np_random(one)[0] for one in seeds]
        else:
            for i in np.flatnonzero(mask):
                if seeds[i] is not None:
                    self._generators[i] = seeding.np_random(seeds[i])[0]
        prior = self._restart(mask)
        observation, info, _ = self._observe(fresh=mask, moved=np.zeros_like(mask))
        return observation, {**info, **prior}

    def _restart(self, mask: BoolArray) -> dict[str, Any]:
        """New episodes where the mask says; returns their priors as info."""
        chosen = np.flatnonzero(mask)
        start = self._episodes.begin(chosen, [self._generators[i] for i in chosen])
        self._anchors[chosen] = start["anchors"]
        self._prior_covariance[chosen] = start["prior_covariance"]
        self._epochs[chosen] = 0
        self._done[chosen] = False
        info: dict[str, Any] = {}
        for name in ("prior_rotation", "prior_translation", "prior_covariance"):
            full = np.zeros((self.num_envs, *start[name].shape[1:]))
            full[chosen] = start[name]
            info[name], info[f"_{name}"] = full, mask.copy()
        return info

    # --- step -------------------------------------------------------------------------------

    def step(
        self, actions: ArrayLike
    ) -> tuple[dict[str, np.ndarray], FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Step every world; see the autoreset mode for those whose episode is over."""
        if self._episodes.empty:
            raise gym.error.ResetNeeded("call reset() before step()")
        ended = self._done.copy()
        if ended.any() and self._mode is AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded("episodes are over: reset them by options['reset_mask']")
        moving = ~ended
        self._move(actions, moving)
        prior: dict[str, Any] = {}
        if ended.any():
            prior = self._restart(ended)
        self._epochs[moving] += 1
        observation, info, reward = self._observe(fresh=ended, moved=moving)
        reward[ended] = 0.0
        truncated = moving & (self._epochs >= self.steps_limit)
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        if self._mode is AutoresetMode.SAME_STEP and truncated.any():
            observation, info = self._same_step(truncated, observation, info)
        else:
            self._done = truncated.copy()
        return observation, reward, terminated, truncated, {**info, **prior}

    def _move(self, actions: ArrayLike, moving: BoolArray) -> None:
        if self.scene.anchor_speed_m_s > 0:
            size = 3 * self.scene.n_anchors
            velocities = check_array("actions", actions, (self.num_envs, size))
            if velocities.ndim != 2:
                shape = (self.num_envs, size)
                raise ValueError(f"actions must have shape {shape}, got {velocities.shape}")
            velocities = np.asfortranarray(velocities)
            # Those that reset in this step get their anchors from the new episode.
            with whole_rows():
                moved = simulation.move_anchors(self.scene, self._anchors, velocities)
            if moving.all():
                self._anchors = moved
            else:
                self._anchors[moving] = moved[moving]
        elif not are_zeros(np.asarray(actions), (self.num_envs,)):
            raise ValueError(f"actions must be {self.num_envs} zeros where the anchors are fixed")

    def _same_step(
        self, truncated: BoolArray, observation: dict[str, np.ndarray], info: dict[str, Any]
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The next episodes' first observations in place of the last, which go into `info`."""
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(truncated):
            final[i] = {key: value[i].copy() for key, value in observation.items()}
        last = {
            key: np.where(
                truncated.reshape(-1, *[1] * (value.ndim - 1)), value, np.zeros_like(value)
            )
            for key, value in info.items()
            if not key.startswith("_")
        }
        masks = {f"_{key}": truncated.copy() for key in last}
        prior = self._restart(truncated)
        # Measurements are functions of the epoch: those of the other worlds come out the same.
        fresh, fresh_info, _ = self._observe(fresh=truncated, moved=np.zeros_like(truncated))
        fresh_info.update(prior)
        fresh_info["final_obs"], fresh_info["_final_obs"] = final, truncated.copy()
        fresh_info["final_info"] = {**last, **masks}
        fresh_info["_final_info"] = truncated.copy()
        return fresh, fresh_info

    # --- what is seen -----------------------------------------------------------------------

    def _observe(
        self, *, fresh: BoolArray, moved: BoolArray
    ) -> tuple[dict[str, np.ndarray], dict[str, Any], FloatArray]:
        """Observations, infos and rewards of all worlds at their epochs.

        `fresh` worlds are at the start of an episode, `moved` ones have just stepped: their bound
        is carried on. The others are only looked at again.
        """
        with whole_rows():
            stored = self._episodes.at(self._epochs)
            observation = measure(self.scene, self.statistic, stored, self._anchors)
        at = stored._replace(
            rotation=stored.rotation.copy(),
            translation=stored.translation.copy(),
            twist=stored.twist.copy(),
        )
        info: dict[str, Any] = {
            "rotation": at.rotation,
            "translation": at.translation,
            "epoch": self._epochs.copy(),
        }
        if not self.statistic:
            info["nlos"] = observation.pop("nlos")
        observation["anchors"] = self._anchors.copy()
        observation["twist"] = at.twist
        reward = np.zeros(self.num_envs)
        if self.reward_mode == "bound":
            links = links_of(observation, self.scene, (self.num_envs,))
            self._carry_bound(at, observation["anchors"], links, fresh, moved)
            info["score_m"] = self._score.copy()
            reward = -np.log(info["score_m"])
        if self.film is not None:
            bound = np.linalg.inv(self._information) if self.reward_mode == "bound" else None
            links = links_of(observation, self.scene, (self.num_envs,))
            seen = links, self._anchors, at.rotation, at.translation
            self.film.take(self._epochs, rendering.shot(*seen, bound))
        for key in list(info):
            info[f"_{key}"] = np.ones(self.num_envs, dtype=np.bool_)
        return observation, info, reward

    def render(self) -> Any:
        """A frame of every world, as `TrackingEnv.render`."""
        return rendering.picture(self.film, self.num_envs)

    def _carry_bound(
        self,
        at: simulation.Epoch,
        anchors: FloatArray,
        links: BoolArray,
        fresh: BoolArray,
        moved: BoolArray,
    ) -> None:
        """The posterior Cramer-Rao bound of the worlds that started or stepped."""
        if moved.all():
            self._information, self._score = simulation.posterior_step(
                self.scene, at, anchors, links, self._information, self._prior_covariance
            )
            return
        if fresh.all():
            self._information, self._score = (
                np.empty((self.num_envs, 6, 6)),
                np.empty(self.num_envs),
            )
        for rows, started in ((fresh, True), (moved, False)):
            if rows.any():
                part = simulation.Epoch(*(None if f is None else f[rows] for f in at))  # pyright: ignore[reportArgumentType]
                self._information[rows], self._score[rows] = simulation.posterior_step(
                    self.scene,
                    part,
                    anchors[rows],
                    links[rows],
                    None if started else self._information[rows],
                    self._prior_covariance[rows],
                )

"""Environments made of a stack of wrappers, which look like one environment.

The policy of a task observes a flat view of a belief and returns the task's actions. The belief
comes from an environment and `EstimatePose`, or their vector forms. This stack is `inner`.
`unwrapped` and `spec` are the task's own, so that checkers, specifications and ``make_vec`` see one
environment.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from rbl_gym import rendering
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.envs.batch import StatedLength, check_actions
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.estimators import PoseBelief
from rbl_gym.worlds.families import SceneFamily
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers.estimate import EstimatePose, FilterLike, scene_of
from rbl_gym.wrappers.observations import Seen, Viewer, ViewLike, viewer_of
from rbl_gym.wrappers.rewards import RewardLike
from rbl_gym.wrappers.task_worlds import filter_of_task
from rbl_gym.wrappers.vector_estimate import VectorEstimatePose


class Task(StatedLength):
    """Base of scalar and vector tasks. In the vector form arrays have leading axes (B,).

    A subclass implements `_spaces`, `_command` and `_task_view`; `_below` if a wrapper lies between
    the environment and the filter, and `_price` if actions have a cost. Its ``__init__`` sets
    `scene` and `family`, then calls `_compose`.

    Attributes
    ----------
    inner
        The stack. Its observation is that of `EstimatePose`, a dict with the belief.
    scene
        The scene; of a family, the first of its scenes.
    family
        The family from which every reset draws a scene; None if there is only one scene.
    inner_observation
        The last observation of `inner`, None before the first reset.
    """

    inner: Any = None
    scene: Scene
    family: SceneFamily | None = None
    inner_observation: dict[str, np.ndarray] | None = None
    # The view of the belief; None means the task's own view.
    _viewer: Viewer | None = None

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode."""
        return self.inner.unwrapped.episode_steps

    @property
    def film(self) -> rendering.Film | None:
        """The source of the frames, if there is a render mode."""
        return self.inner.unwrapped.film

    @property
    def belief(self) -> PoseBelief:
        """The present belief of the filter."""
        return _belief_of(self._last_observation())

    @property
    def anchors(self) -> FloatArray:
        """Present positions of the anchors, (..., M, 3), in the order of the actions."""
        return self._last_observation()["anchors"]

    @property
    def twist(self) -> FloatArray:
        """Known twist (..., 6) of the interval that ends at this epoch."""
        return self._last_observation()["twist"]

    def render(self) -> Any:
        """Return a frame, (height, width, 3), uint8; a vector form returns one for each world."""
        return self.inner.render()

    def _last_observation(self) -> dict[str, np.ndarray]:
        if self.inner_observation is None:
            raise gym.error.ResetNeeded("call reset() first")
        return self.inner_observation

    def _spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        """Return the spaces of the task's own view and of the actions, of one world."""
        raise NotImplementedError

    def _below(self, env: Any) -> Any:
        """Return the environment whose measurements the filter gets."""
        return env

    def _command(self, action: np.ndarray) -> Any:
        """Return the action of `inner` for a valid action of the task."""
        raise NotImplementedError

    def _task_view(self, observation: dict[str, np.ndarray], world: Any) -> np.ndarray:
        """Return the policy's view of an observation of `inner` in a `Scene` or `StackedScenes`."""
        raise NotImplementedError

    @property
    def _env_arguments(self) -> dict[str, Any]:
        """The arguments of the environment."""
        worlds = {"scene": self.scene} if self.family is None else {"scenes": self.family}
        return {**worlds, "reward": "none"}

    def _set_viewer(self, observation: ViewLike, hides_obstacles: bool = False) -> None:
        """Set how the policy observes the belief; ``"flat"`` is the task's own view."""
        if isinstance(observation, str) and observation == "flat":
            return
        self._viewer = viewer_of(observation, hides_obstacles)

    def _space_of(self, own: spaces.Space[Any], inner: Any) -> spaces.Space[Any]:
        """Return the observation space of one world; `own` is that of the task's own view."""
        if self._viewer is None:
            return own
        below = getattr(inner, "single_observation_space", inner.observation_space)
        return self._viewer.space_of(inner, scene_of(inner), below)

    def _observe(self, observation: dict[str, np.ndarray], world: Any) -> Any:
        """Return the policy's view of an observation of `inner`; the caller may keep it."""
        if self._viewer is None:
            return self._task_view(observation, world)
        shown = self._viewer(Seen(observation, _belief_of(observation), world))
        if isinstance(shown, dict):
            return {key: np.array(field) for key, field in shown.items()}
        return shown

    def _present_view(self) -> Any:
        """Return the present view of the policy."""
        return self._observe(self._last_observation(), self.world)

    @property
    def world(self) -> Any:
        """The scene of this episode; of a family in the vector form, the stacked scenes."""
        env = self._base
        return getattr(env, "world", env.scene)

    @functools.cached_property
    def _base(self) -> Any:
        """The environment below all wrappers of the stack."""
        return self.inner.unwrapped

    def _price(self, info: dict[str, Any]) -> Any:
        """Return the cost of the step with these infos."""
        return 0.0


def _belief_of(told: dict[str, np.ndarray]) -> PoseBelief:
    rotation = told["belief_rotation"]
    return PoseBelief(rotation, told["belief_translation"], told["belief_covariance"], rotation)


class TaskEnv(Task, gym.Env[Any, Any]):
    """One world of a task."""

    metadata: dict[str, Any] = TrackingEnv.metadata

    def _compose(
        self,
        filter: FilterLike,
        options: Mapping[str, Any] | None,
        reward: RewardLike,
        render_mode: str | None,
    ) -> None:
        """Make the stack and the spaces."""
        own, self.action_space = self._spaces()
        env = self._below(TrackingEnv(**self._env_arguments, render_mode=render_mode))
        self.inner = EstimatePose(env, *filter_of_task(filter, options), reward)
        self.render_mode = render_mode
        self.observation_space = self._space_of(own, self.inner)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; `options` must be empty."""
        self.inner_observation, info = self.inner.reset(seed=seed, options=options)
        world = self.inner.unwrapped
        self._np_random, self._np_random_seed = world.np_random, world.np_random_seed
        return self._present_view(), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the world and its filter."""
        self._last_observation()
        action = check_actions("action", action, self.action_space)
        self.inner_observation, reward, *ended, info = self.inner.step(self._command(action))
        return self._present_view(), float(reward - self._price(info)), *ended, info

    def close(self) -> None:
        """Close the stack."""
        self.inner.close()


class VectorTaskEnv(Task, VectorEnv[Any, Any, Any]):
    """`num_envs` worlds of a task; seeding and autoreset as `BatchEnv`."""

    def _compose(
        self,
        num_envs: int,
        filter: FilterLike,
        options: Mapping[str, Any] | None,
        reward: RewardLike,
        render_mode: str | None,
        max_episode_steps: int | None,
        autoreset_mode: str | AutoresetMode,
    ) -> None:
        """Make the stack and the spaces."""
        own, self.single_action_space = self._spaces()
        envs = TrackingVectorEnv(
            num_envs, **self._env_arguments, render_mode=render_mode,
            max_episode_steps=max_episode_steps, autoreset_mode=autoreset_mode,
        )  # fmt: skip
        below = self._below(envs)
        self.inner = VectorEstimatePose(below, *filter_of_task(filter, options), reward)
        self.num_envs, self.metadata, self.render_mode = envs.num_envs, envs.metadata, render_mode
        self.single_observation_space = self._space_of(own, self.inner)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start all episodes, or with ``options={"reset_mask": mask}`` those of the mask."""
        self.inner_observation, info = self.inner.reset(seed=seed, options=options)
        return self._present_view(), info

    def step(self, actions: Any) -> tuple[Any, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Step every world and its filter."""
        self._last_observation()
        world = self.world
        actions = check_actions("actions", actions, self.single_action_space, self.num_envs)
        self.inner_observation, reward, *ended, info = self.inner.step(self._command(actions))
        price = self._price(info)
        if "final_obs" in info:
            final = info["_final_obs"]
            for i in np.flatnonzero(final):
                scene = world if isinstance(world, Scene) else world.scenes[i]
                info["final_obs"][i] = self._observe(info["final_obs"][i], scene)
            price = np.where(final, self._price(info["final_info"]), price)
        return self._present_view(), reward - price, *ended, info

    def close_extras(self, **kwargs: Any) -> None:
        """Close the stack if there is one: `__del__` also closes after a failed constructor."""
        if self.inner is not None:
            self.inner.close(**kwargs)

"""VectorEstimatePose: one call of a batched filter for all worlds of a vector environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from rbl_gym import metrics, rendering
from rbl_gym.checks import BoolArray, FloatArray, check_one_of
from rbl_gym.estimators import Filter, PoseBelief
from rbl_gym.estimators.filter import reads
from rbl_gym.wrappers.estimate import (
    OBSERVATIONS,
    family_of,
    make_filter,
    measured_of,
    observation_space,
    present,
    scene_of,
    update,
    with_bound,
)
from rbl_gym.wrappers.rewards import Outcome, RewardLike, paid_of, reward_of


class VectorEstimatePose(VectorWrapper, RecordConstructorArgs):
    """`EstimatePose` for a vector environment: beliefs, rewards and infos of all worlds at once.

    Parameters, observations, rewards and infos are those of `EstimatePose`, stacked. Wraps the
    native vector environments (`TrackingVectorEnv`, `BaseStationVectorEnv`) in every autoreset
    mode; worlds that reset get a new state from their prior, the others keep theirs.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from rbl_gym.wrappers import VectorEstimatePose
    >>> envs = gym.make_vec(
    ...     "rbl_gym:RBL/Tracking-v0", num_envs=64, scene="drone_yard", reward="none")
    >>> envs = VectorEstimatePose(envs, "iekf")
    >>> observation, info = envs.reset(seed=1)
    >>> observation["belief_covariance"].shape
    (64, 6, 6)
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        filter: str = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        observation: str = "dict",
    ) -> None:
        RecordConstructorArgs.__init__(
            self, filter=filter, options=options, reward=reward, observation=observation
        )
        VectorWrapper.__init__(self, env)
        self._scene: Any = scene_of(env)
        self._named = filter, options
        self._varied = family_of(env) is not None
        if self._varied:
            self._scene = env.unwrapped.world  # pyright: ignore[reportAttributeAccessIssue]
        self._reward = reward_of(reward)
        self._kind = check_one_of("observation", observation, OBSERVATIONS)
        self._filter = self._filter_of(self._scene)
        self._state: Any = None
        self._belief: PoseBelief | None = None
        single = observation_space(self._kind, env.single_observation_space, self._scene)
        self.single_observation_space = single
        self.observation_space = batch_space(single, env.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the filters of the worlds that reset from their priors."""
        observation, info = self.env.reset(seed=seed, options=options)
        info = with_bound(info)
        self._begin(observation, info, info["_prior_rotation"])
        self._report(self._figures(info), info)
        return self._present(observation), info

    def step(self, actions: Any) -> tuple[Any, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Step the worlds; predict and update those that go on, start those that begin."""
        observation, _, terminated, truncated, info = self.env.step(actions)
        info = with_bound(info)
        fresh = info.get("_prior_rotation", np.zeros(self.num_envs, dtype=np.bool_))
        same_step = self.env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        last = terminated | truncated if same_step else np.zeros_like(fresh)
        moved = ~fresh | last
        reached, truth = _reached(observation, info, last)
        if moved.any():
            self._advance(reached, moved)
        figures = self._figures(truth)
        assert self._belief is not None
        poses = truth["rotation"], truth["translation"], truth.get("bound_m")
        outcome = Outcome(figures, self._belief, *poses, actions, reached, self._scene)
        reward = np.where(moved, paid_of(self._reward, outcome), 0.0)
        if last.any():
            self._finish(info, figures, last)
        if fresh.any():
            self._begin(observation, info, fresh)
            figures = self._figures(info)
        self._report(figures, info)
        return self._present(observation), reward, terminated, truncated, info

    def _advance(self, observation: dict[str, np.ndarray], moved: BoolArray) -> None:
        """Predict and update the worlds that stepped."""
        measured = measured_of(observation)
        if moved.all():
            state, scene, filter = self._state, self._scene, self._filter
        else:
            state, (scene, filter) = _rows(self._state, moved), self._of(moved)
            measured = {key: value[moved] for key, value in measured.items()}
        state = filter.predict(state, measured[reads(filter)], scene.dt)
        self._put(update(filter, state, measured, scene), filter, moved)

    def _begin(
        self, observation: dict[str, np.ndarray], info: dict[str, Any], fresh: BoolArray
    ) -> None:
        """States of new episodes, from the priors in `info`, updated with their first ranges."""
        if self._varied:
            self._scene = self.env.unwrapped.world  # pyright: ignore[reportAttributeAccessIssue]
            self._filter = self._filter_of(self._scene)
        scene, filter = self._of(fresh)
        prior = [info[f"prior_{name}"][fresh] for name in ("rotation", "translation", "covariance")]
        epoch = {key: value[fresh] for key, value in measured_of(observation).items()}
        self._put(update(filter, filter.initial(*prior), epoch, scene), filter, fresh)

    def _of(self, where: BoolArray) -> tuple[Any, Filter]:
        """Scene and filter of the worlds of a mask."""
        if not self._varied or where.all():
            return self._scene, self._filter
        scene = self._scene.rows(where)
        return scene, self._filter_of(scene)

    def _filter_of(self, scene: Any) -> Filter:
        try:
            return make_filter(self.env, scene, *self._named)
        except ValueError as error:
            if not self._varied:
                raise
            raise ValueError(
                f"{error} (worlds with scenes of their own need a filter that takes tags and "
                "process noise of each, as 'iekf'; for others: gym.make_vec(..., "
                "vectorization_mode='sync') of EstimatePose)"
            ) from error

    def _put(self, state: Any, filter: Filter, where: BoolArray) -> None:
        """Take over the states of some worlds, and their beliefs."""
        belief = filter.belief(state)
        if where.all():
            self._state, self._belief = state, belief
        else:
            self._state = _merged(self._state, state, where)
            self._belief = _merged(self._belief, belief, where)

    def _figures(self, info: Mapping[str, Any]) -> metrics.Figures:
        """Errors of the beliefs against the true poses of the infos."""
        assert self._belief is not None
        told = *self._belief[:3], info["rotation"], info["translation"]
        if not self._varied:
            return metrics.judge(*told, self._scene.body)
        figures = np.empty((len(metrics.Figures._fields), self.num_envs))
        for count, alike in self._scene.bodies():
            tags = self._scene.body[alike, :count]
            figures[:, alike] = metrics.judge(*(field[alike] for field in told), tags)
        return metrics.Figures(*figures)

    def _finish(self, info: dict[str, Any], figures: metrics.Figures, last: BoolArray) -> None:
        """The last beliefs of ended episodes into copies of `final_obs` and `final_info`."""
        assert self._belief is not None
        info["final_obs"] = info["final_obs"].copy()
        info["final_info"] = with_bound(info["final_info"])
        for i in np.flatnonzero(last):
            belief = PoseBelief(*(field[i].copy() for field in self._belief))
            scene = self._scene.scenes[i] if self._varied else self._scene
            info["final_obs"][i] = present(self._kind, info["final_obs"][i], belief, scene)
        for name, value in figures._asdict().items():
            info["final_info"][name] = np.where(last, value, 0.0)
            info["final_info"][f"_{name}"] = last.copy()

    def _report(self, figures: metrics.Figures, info: dict[str, Any]) -> None:
        for name, value in figures._asdict().items():
            info[name], info[f"_{name}"] = value, np.ones(self.num_envs, dtype=np.bool_)

    def _present(self, observation: dict[str, np.ndarray]) -> Any:
        assert self._belief is not None
        rendering.tell(self.env, rendering.Pose(*self._belief[:3]))
        belief = PoseBelief(*(field.copy() for field in self._belief))
        return present(self._kind, observation, belief, self._scene)


def _reached(
    observation: dict[str, np.ndarray], info: dict[str, Any], last: BoolArray
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Observations and truth that the steps led to: those of ended worlds are the final ones."""
    if not last.any():
        return observation, info
    final, ended = info["final_obs"][last], with_bound(info["final_info"])
    reached = {key: value.copy() for key, value in observation.items()}
    for key, value in reached.items():
        value[last] = np.stack([one[key] for one in final])
    truth = {key: info[key].copy() for key in ("rotation", "translation", "bound_m") if key in info}
    for key, value in truth.items():
        value[last] = ended[key][last]
    return reached, truth


def _rows(state: Any, where: BoolArray) -> Any:
    """A state of the worlds of a mask."""
    return type(state)(*(None if field is None else field[where] for field in state))


def _merged(state: Any, part: Any, where: BoolArray) -> Any:
    """`state` with the worlds of the mask taken from `part`."""
    fields = []
    for old, new in zip(state, part, strict=True):
        field = None if old is None else np.array(old)
        if field is not None:
            field[where] = new
        fields.append(field)
    return type(state)(*fields)

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
from rbl_gym.estimators import PoseBelief
from rbl_gym.estimators.filter import reads
from rbl_gym.wrappers.estimate import (
    OBSERVATIONS,
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
        self._scene = scene_of(env)
        self._reward = reward_of(reward)
        self._kind = check_one_of("observation", observation, OBSERVATIONS)
        self._tags = self._scene.body
        self._filter = make_filter(env, self._scene, filter, options)
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
        self._start(observation, info, info["_prior_rotation"])
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
            self._start(observation, info, fresh)
            figures = self._figures(info)
        self._report(figures, info)
        return self._present(observation), reward, terminated, truncated, info

    def _advance(self, observation: dict[str, np.ndarray], moved: BoolArray) -> None:
        """Predict and update the worlds that stepped."""
        measured = measured_of(observation)
        everywhere = bool(moved.all())
        state = self._state if everywhere else _rows(self._state, moved)
        if not everywhere:
            measured = {key: value[moved] for key, value in measured.items()}
        state = self._filter.predict(state, measured[reads(self._filter)], self._scene.dt)
        state = update(self._filter, state, measured, self._scene)
        self._put(state, moved)

    def _start(
        self, observation: dict[str, np.ndarray], info: dict[str, Any], fresh: BoolArray
    ) -> None:
        """States of new episodes, from the priors in `info`, updated with their first ranges."""
        prior = [info[f"prior_{name}"][fresh] for name in ("rotation", "translation", "covariance")]
        state = self._filter.initial(*prior)
        epoch = {key: value[fresh] for key, value in measured_of(observation).items()}
        self._put(update(self._filter, state, epoch, self._scene), fresh)

    def _put(self, state: Any, where: BoolArray) -> None:
        """Take over the states of some worlds, and their beliefs."""
        belief = self._filter.belief(state)
        if where.all():
            self._state, self._belief = state, belief
        else:
            self._state = _merged(self._state, state, where)
            self._belief = _merged(self._belief, belief, where)

    def _figures(self, info: Mapping[str, Any]) -> metrics.Figures:
        """Errors of the beliefs against the true poses of the infos."""
        assert self._belief is not None
        truth = info["rotation"], info["translation"]
        return metrics.judge(*self._belief[:3], *truth, self._tags)

    def _finish(self, info: dict[str, Any], figures: metrics.Figures, last: BoolArray) -> None:
        """The last beliefs of ended episodes into copies of `final_obs` and `final_info`."""
        assert self._belief is not None
        info["final_obs"] = info["final_obs"].copy()
        info["final_info"] = with_bound(info["final_info"])
        for i in np.flatnonzero(last):
            belief = PoseBelief(*(field[i].copy() for field in self._belief))
            info["final_obs"][i] = present(self._kind, info["final_obs"][i], belief, self._scene)
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

"""VectorEstimatePose: one call of a batched filter for all worlds of a vector environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from rbl_gym import metrics, rendering
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators import Filter, PoseBelief
from rbl_gym.estimators.filter import belief_of, reads
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers.estimate import (
    FilterLike,
    FilterName,
    family_of,
    make_filter,
    measured_of,
    named_filter,
    scene_of,
    unpadded,
    update,
    with_bound,
)
from rbl_gym.wrappers.forms import check_vector
from rbl_gym.wrappers.observations import Seen, ViewLike, viewer_of
from rbl_gym.wrappers.rewards import Outcome, RewardLike, paid_of, reward_of


class VectorEstimatePose(VectorWrapper, RecordConstructorArgs):
    """`EstimatePose` for a vector environment: beliefs, rewards and infos of all worlds at once.

    Parameters, observations, rewards and infos are those of `EstimatePose`, stacked. Wraps the
    native vector environments (`TrackingVectorEnv`, `BaseStationVectorEnv`) in every autoreset
    mode. Worlds that reset get a new state from their prior; the others keep theirs.

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
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        observation: ViewLike = "dict",
    ) -> None:
        RecordConstructorArgs.__init__(
            self, filter=filter, options=options, reward=reward, observation=observation
        )
        check_vector(env, "EstimatePose")
        VectorWrapper.__init__(self, env)
        self._scene: Any = scene_of(env)
        self._named = named_filter(filter, options)
        self._varied = family_of(env) is not None
        if self._varied:
            self._scene = env.unwrapped.world  # pyrefly: ignore[missing-attribute]
        self._reward = reward_of(reward)
        self._viewer = viewer_of(observation)
        ranged = "ranges" in getattr(env.single_observation_space, "spaces", {})
        self._stacks = self._varied and ranged and _takes_stacks(env, self._scene, *self._named)
        self._parts = self._parted()
        self._state: Any = None
        self._belief: PoseBelief | None = None
        single = self._viewer.space_of(env, scene_of(env), env.single_observation_space)
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
        """Step the worlds; predict and update those that continue, start those that reset."""
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
        states = []
        for part in self._parts_of(moved):
            told = part.measured(observation)
            state = _rows(self._state, part.rows)
            state = part.filter.predict(state, told[reads(part.filter)], part.scene.dt)
            states.append(update(part.filter, state, told, part.scene))
        self._put(states, moved)

    def _begin(
        self, observation: dict[str, np.ndarray], info: dict[str, Any], fresh: BoolArray
    ) -> None:
        """Return states of new episodes: priors of `info`, updated with the first ranges."""
        if self._varied:
            self._scene = self.env.unwrapped.world  # pyrefly: ignore[missing-attribute]
            self._parts = self._parted()
        states = []
        for part in self._parts_of(fresh):
            prior = [
                info[f"prior_{key}"][part.rows] for key in ("rotation", "translation", "covariance")
            ]
            told = part.measured(observation)
            try:
                states.append(_begun(part, prior, told))
            except Exception as error:
                _check_batched(part, prior, told, error)
                raise
        self._put(states, fresh)

    def _parted(self) -> list[_Part]:
        """Return all worlds, grouped by filter."""
        every = np.arange(self.num_envs)
        if not self._varied or self._stacks:
            return [_Part(every, self._scene, make_filter(self.env, self._scene, *self._named))]
        alike: dict[Scene, list[int]] = {}
        for row, scene in enumerate(self._scene.scenes):
            alike.setdefault(scene, []).append(row)
        return [
            _Part(np.array(rows), scene, make_filter(self.env, scene, *self._named))
            for scene, rows in alike.items()
        ]

    def _parts_of(self, where: BoolArray) -> list[_Part]:
        """Return the parts of the worlds of a mask."""
        if where.all():
            return self._parts
        if self._stacks:
            scene = self._scene.rows(where)
            filter = make_filter(self.env, scene, *self._named)
            return [_Part(np.flatnonzero(where), scene, filter)]
        chosen = (part._replace(rows=part.rows[where[part.rows]]) for part in self._parts)
        return [part for part in chosen if len(part.rows)]

    def _put(self, states: list[Any], where: BoolArray) -> None:
        """Store the states of the parts of some worlds, and their beliefs."""
        parts = self._parts_of(where)
        rows = [part.rows for part in parts]
        beliefs = [_believed(part, one) for part, one in zip(parts, states, strict=True)]
        self._state = _joined(self._state, rows, states, self.num_envs)
        self._belief = _joined(self._belief, rows, beliefs, self.num_envs)

    def _figures(self, info: Mapping[str, Any]) -> metrics.Figures:
        """Return errors of the beliefs against the true poses of the infos."""
        assert self._belief is not None
        belief, truth = self._belief[:3], (info["rotation"], info["translation"])
        if not self._varied:
            return metrics.judge(*belief, *truth, self._scene.body)
        figures = np.empty((len(metrics.Figures._fields), self.num_envs))
        for count, alike in self._scene.bodies():
            rotation, translation, covariance = (field[alike] for field in belief)
            turned, moved = (field[alike] for field in truth)
            tags = self._scene.body[alike, :count]
            figures[:, alike] = metrics.judge(
                rotation, translation, covariance, turned, moved, tags
            )
        return metrics.Figures(*figures)

    def _finish(self, info: dict[str, Any], figures: metrics.Figures, last: BoolArray) -> None:
        """Write the last beliefs of ended episodes to copies of `final_obs` and `final_info`."""
        assert self._belief is not None
        info["final_obs"] = info["final_obs"].copy()
        info["final_info"] = with_bound(info["final_info"])
        for i in np.flatnonzero(last):
            belief = PoseBelief(*(field[i].copy() for field in self._belief))
            scene = self._scene.scenes[i] if self._varied else self._scene
            info["final_obs"][i] = self._viewer(Seen(info["final_obs"][i], belief, scene))
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
        return self._viewer(Seen(observation, belief, self._scene))


def _reached(
    observation: dict[str, np.ndarray], info: dict[str, Any], last: BoolArray
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return observations and truth after the steps: those of ended worlds are the final ones."""
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


class _Part(NamedTuple):
    """Worlds tracked by one filter: their indices, their scene or scenes, the filter."""

    rows: np.ndarray
    scene: Any
    filter: Filter

    def measured(self, observation: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the filter's inputs of these worlds."""
        told = measured_of(observation)
        if len(self.rows) < len(told["twist"]):
            told = {key: value[self.rows] for key, value in told.items()}
        padded = "anchor_mask" in observation and isinstance(self.scene, Scene)
        return unpadded(told, self.scene) if padded else told


def _begun(part: _Part, prior: Sequence[FloatArray], told: Mapping[str, np.ndarray]) -> Any:
    """Return the state of a prior after the first epoch."""
    return update(part.filter, part.filter.initial(*prior), told, part.scene)


def _check_batched(
    part: _Part, prior: Sequence[FloatArray], told: Mapping[str, np.ndarray], error: Exception
) -> None:
    """Raise ValueError if the filter, which raised `error`, works for each world alone."""
    try:
        for i in range(len(part.rows)):
            alone = {key: value[i] for key, value in told.items()}
            part.filter.belief(_begun(part, [array[i] for array in prior], alone))
    except Exception:
        return
    raise ValueError(f"{_one_body(part)}; it raised {error!r:.200}") from error


def _believed(part: _Part, state: Any) -> PoseBelief:
    """Return the belief of the worlds of a part; raises ValueError if it has not one for each."""
    belief = belief_of(part.filter, state)
    shape = np.shape(belief[1])
    if shape != (len(part.rows), 3):
        raise ValueError(f"{_one_body(part)}; its belief has a translation of shape {shape}")
    return belief


def _one_body(part: _Part) -> str:
    return (
        f"filter {type(part.filter).__name__} must accept leading batch axes, here "
        f"({len(part.rows)},), in all its arrays, but it accepts a single body: write its formulas "
        "for arrays (..., 3, 3), or wrap it, which loops over the worlds: "
        "filter=rbl_gym.estimators.one_by_one(...)"
    )


def _takes_stacks(
    env: Any, scene: Any, filter: FilterName, options: Mapping[str, Any] | None
) -> bool:
    """Return whether a filter accepts tags and noise per world; others group equal worlds."""
    try:
        make_filter(env, scene, filter, options)
    except ValueError:
        return False
    return True


def _rows(state: Any, rows: np.ndarray) -> Any:
    """Return the state of some worlds."""
    if len(rows) == len(state[0]):
        return state
    return type(state)(*(None if field is None else field[rows] for field in state))


def _joined(old: Any, rows: list[np.ndarray], parts: list[Any], count: int) -> Any:
    """Return the state of all `count` worlds, with some rows from the `parts`."""
    if len(parts) == 1 and len(rows[0]) == count:
        return parts[0]
    if len({tuple(np.shape(field)[1:] for field in part) for part in parts}) > 1:
        raise ValueError(
            "filter must have states of the same shape in all worlds, got "
            f"{' and '.join(str([np.shape(f)[1:] for f in part]) for part in parts[:2])}: use "
            "gym.make_vec(..., vectorization_mode='sync') with EstimatePose"
        )
    fields = []
    for index, first in enumerate(parts[0]):
        if first is None:
            fields.append(None)
            continue
        field = (
            np.zeros((count, *first.shape[1:]), first.dtype)
            if old is None
            else np.array(old[index])
        )
        for where, part in zip(rows, parts, strict=True):
            field[where] = part[index]
        fields.append(field)
    return type(parts[0])(*fields)

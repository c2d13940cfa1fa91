"""Reward a layout by how well a filter tracks with it, instead of by the bound."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from rbl_gym.checks import BoolArray, FloatArray, check_one_of
from rbl_gym.envs.placement import AnchorPlacementEnv, AnchorPlacementVectorEnv
from rbl_gym.envs.placement_family import PlacementFamilyEnv, PlacementFamilyVectorEnv
from rbl_gym.estimators import Filter
from rbl_gym.estimators.filter import check_takes_noise, reads
from rbl_gym.placement import Context, PlacementTask
from rbl_gym.wrappers.estimate import FilterLike, FilterName, make_filter, named_filter
from rbl_gym.wrappers.filter_tracks import check_determined, track_error
from rbl_gym.wrappers.forms import check_single, check_vector

REWARDS = ("bound", "filter")
_REWARD_ADVICE = (
    "for a reward of your own write a gymnasium.Wrapper whose step computes it from info "
    "(info['anchors'], info['score_m'], info['region'])"
)
# Keys of the infos that describe a layout.
_TOLD = ("region", "racks", "anchors", "rack_mask", "anchor_mask")


def filter_of(env: Any, task: PlacementTask, name: FilterName, options: Any) -> Filter:
    """Return the filter of a task; raises ValueError if it does not suit the scene."""
    filter = make_filter(env, task.scene, name, options)
    if reads(filter) != "twist":
        raise ValueError(f"filter must be one that takes the twist, got {name!r}")
    if task.racks:
        check_takes_noise(name, filter, "the racks change the noise from epoch to epoch")
    return filter


class _Judge:
    """Tracking errors of a named filter with complete layouts, in a task or a family of tasks."""

    def __init__(self, env: Any, name: FilterLike, options: Mapping[str, Any] | None) -> None:
        self._env, self._named = env, named_filter(name, options)
        name, options = self._named
        tasks = _tasks_of(env)
        family = getattr(env.unwrapped, "family", None)
        self._one = filter_of(env, tasks[0], name, options) if family is None else None
        for task in tasks[:1] if family is None else family.smallest:
            check_determined(task, name, filter_of(env, task, name, options))

    def errors(self, tasks: Sequence[PlacementTask], info: Mapping[str, Any]) -> FloatArray:
        """Return errors (R,) of the filter for layouts (R, ...) of these tasks, as in the infos."""
        if self._one is not None:
            return _errors(tasks[0], self._one, info)
        found = []
        for row, task in enumerate(tasks):
            boxes, placed = info["rack_mask"][row] > 0, info["anchor_mask"][row] > 0
            own = {
                "region": info["region"][row],
                "racks": info["racks"][row][boxes],
                "anchors": info["anchors"][row][placed],
            }
            found.append(_errors(task, filter_of(self._env, task, *self._named), own))
        return np.array(found)


def _tasks_of(env: Any) -> Sequence[Any]:
    """Return the tasks of the worlds of a placement environment; may raise ValueError."""
    tasks = getattr(env.unwrapped, "tasks", None)
    if tasks is None:
        tasks = [getattr(env.unwrapped, "task", None)]
    if not isinstance(tasks[0], PlacementTask):
        raise ValueError(f"env must be RBL/AnchorPlacement-v0, got {env.unwrapped}")
    return tasks


# --- wrappers ---------------------------------------------------------------------------------


class FilterReward(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Reward the layouts of `RBL/AnchorPlacement-v0` by how well a filter tracks with them.

    The reward is 0 until the last anchor is placed, in every mode. Then the filter tracks bodies on
    8 tracks of 20 epochs through the work region. The reward is ``-log`` of the root mean square
    error of the tag positions in metres. The body moves between way-points in the region at the
    scene's speed, with the scene's process noise. The filter starts from the scene's initial
    uncertainty. Tracks and noise are drawn from a generator that is seeded with the numbers of the
    problem. So the same layout of the same problem has the same reward, and another problem has
    other tracks.

    ``gym.make("rbl_gym:RBL/AnchorPlacement-v0", reward="filter", filter="iekf")`` creates it.

    Parameters
    ----------
    env
        The environment.
    filter, options
        Name of a filter and its options, as in `EstimatePose`. Raises ValueError if no layout
        determines the pose for this filter, for example for a linear Kalman filter with all anchors
        on the water's surface.

    Info
    ----
    `tag_error_m`: the root mean square error of the reward, metres, with the last anchor, and 0
    before. `score_m` is still the prediction of the bound.

    Examples
    --------
    >>> import math
    >>> import gymnasium as gym
    >>> env = gym.make("rbl_gym:RBL/AnchorPlacement-v0", scene="uwb_room", reward="filter")
    >>> observation, info = env.reset(seed=1)
    >>> terminated = False
    >>> while not terminated:
    ...     observation, reward, terminated, _, info = env.step(env.action_space.sample())
    >>> abs(reward + math.log(info["tag_error_m"])) < 1e-12
    True
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, filter=filter, options=options)
        check_single(env, "VectorFilterReward")
        gym.Wrapper.__init__(self, env)
        self._judge = _Judge(env, filter, options)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, "tag_error_m": 0.0}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Place an anchor; the last one gives the reward."""
        observation, _, terminated, truncated, info = self.env.step(action)
        error, reward = 0.0, 0.0
        if terminated:
            rows = {key: np.asarray(value)[None] for key, value in info.items()}
            error = float(self._judge.errors(_tasks_of(self.env), rows)[0])
            reward = -math.log(error)
        return observation, reward, terminated, truncated, {**info, "tag_error_m": error}


class VectorFilterReward(VectorWrapper, RecordConstructorArgs):
    """`FilterReward` for the vector environment, in every autoreset mode."""

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, filter=filter, options=options)
        check_vector(env, "FilterReward")
        VectorWrapper.__init__(self, env)
        self._judge = _Judge(env, filter, options)
        self._error_m = np.zeros(env.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes."""
        observation, info = self.env.reset(seed=seed, options=options)
        # Worlds that continue have not placed their last anchor, or are over and keep its error.
        self._error_m = np.where(info["score_m"] > 0, self._error_m, 0.0)
        return observation, self._told(info)

    def step(self, actions: Any) -> tuple[Any, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Place anchors; the last one of each world gives the reward."""
        tasks = _tasks_of(self.env)
        observation, _, terminated, truncated, info = self.env.step(actions)
        error, reward = np.zeros(self.num_envs), np.zeros(self.num_envs)
        final = info.get("final_info", info)
        if terminated.any():
            complete = {key: final[key][terminated] for key in _TOLD if key in final}
            ended = [tasks[i % len(tasks)] for i in np.flatnonzero(terminated).tolist()]
            error[terminated] = self._judge.errors(ended, complete)
            reward[terminated] = -np.log(error[terminated])
        if final is not info:
            final["tag_error_m"], final["_tag_error_m"] = error, info["_final_info"].copy()
            error = np.zeros(self.num_envs)
        self._error_m = error
        return observation, reward, terminated, truncated, self._told(info)

    def _told(self, info: dict[str, Any]) -> dict[str, Any]:
        told = {
            "tag_error_m": self._error_m.copy(),
            "_tag_error_m": np.ones(self.num_envs, dtype=np.bool_),
        }
        return {**info, **told}


def _errors(task: PlacementTask, filter: Filter, info: Mapping[str, np.ndarray]) -> FloatArray:
    """Return errors (...) of the filter for complete layouts, as described by the infos."""
    region = info["region"]
    context = Context(region[..., :3], region[..., 3:], info["racks"])
    return track_error(task, context, info["anchors"], filter)


# --- factories of the environment id ----------------------------------------------------------


def anchor_placement(
    *,
    reward: str = "bound",
    filter: FilterLike = "iekf",
    options: Mapping[str, Any] | None = None,
    **arguments: Any,
) -> gym.Env[Any, Any]:
    """Create `RBL/AnchorPlacement-v0`: `AnchorPlacementEnv`, or `FilterReward` around it.

    Parameters
    ----------
    reward
        ``"bound"`` or ``"filter"``.
    filter, options
        As `FilterReward`; only with ``reward="filter"``.
    **arguments
        As `AnchorPlacementEnv`; with `scenes` as `PlacementFamilyEnv`.

    Raises
    ------
    ValueError
        If the reward or the filter does not suit the scene.
    """
    form = PlacementFamilyEnv if arguments.get("scenes") is not None else AnchorPlacementEnv
    env = form(**_worlds(arguments))
    return FilterReward(env, filter, options) if _is_filtered(reward, filter, options) else env


def anchor_placement_vector(
    *,
    reward: str = "bound",
    filter: FilterLike = "iekf",
    options: Mapping[str, Any] | None = None,
    **arguments: Any,
) -> VectorEnv[Any, Any, Any]:
    """Create `anchor_placement` with many problems, from `AnchorPlacementVectorEnv`."""
    drawn = arguments.get("scenes") is not None
    form = PlacementFamilyVectorEnv if drawn else AnchorPlacementVectorEnv
    envs = form(**_worlds(arguments))
    filtered = _is_filtered(reward, filter, options)
    return VectorFilterReward(envs, filter, options) if filtered else envs


def _worlds(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments with `scene` or `scenes`; raises ValueError if both are given."""
    scene, scenes = arguments.get("scene", "auv_buoys"), arguments.get("scenes")
    if scenes is not None and scene != "auv_buoys":
        raise ValueError(f"scene must be left out if scenes is given, got {scene!r:.80}")
    left_out = "scenes" if scenes is None else "scene"
    return {key: value for key, value in arguments.items() if key != left_out}


def _is_filtered(reward: str, filter: Any, options: Any) -> bool:
    if check_one_of("reward", reward, REWARDS, _REWARD_ADVICE) == "filter":
        return True
    if not isinstance(filter, str) or filter != "iekf" or options is not None:
        raise ValueError(
            "filter and options need reward='filter', got reward='bound' with filter = "
            f"{filter!r:.80}, options = {options!r:.80}"
        )
    return False


# Gymnasium reads the render modes here.
anchor_placement.metadata = AnchorPlacementEnv.metadata  # pyrefly: ignore[missing-attribute]

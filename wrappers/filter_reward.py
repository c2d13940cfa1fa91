"""A layout paid by how well a filter tracks with it, in place of the bound."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from rbl_gym.checks import BoolArray, FloatArray, check_one_of
from rbl_gym.envs.placement import AnchorPlacementEnv, AnchorPlacementVectorEnv
from rbl_gym.estimators import Filter
from rbl_gym.estimators.filter import check_takes_noise, reads
from rbl_gym.placement import Context, PlacementTask
from rbl_gym.wrappers.estimate import make_filter
from rbl_gym.wrappers.filter_tracks import check_determined, track_error

REWARDS = ("bound", "filter")


def filter_of(env: Any, name: str, options: Mapping[str, Any] | None) -> Filter:
    """The filter of a placement environment, or a ValueError where the scene does not do."""
    task = getattr(env.unwrapped, "task", None)
    if not isinstance(task, PlacementTask):
        raise ValueError(f"env must be RBL/AnchorPlacement-v0, got {env.unwrapped}")
    filter = make_filter(env, task.scene, name, options)
    if reads(filter) != "twist":
        raise ValueError(f"filter must be one that is told the twist, got {name!r}")
    if task.racks:
        check_takes_noise(name, filter, "the racks give every epoch its own noise")
    check_determined(task, name, filter)
    return filter


# --- wrappers ---------------------------------------------------------------------------------


class FilterReward(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Pays the layout of `RBL/AnchorPlacement-v0` by how well a filter tracks with it.

    With the last anchor the reward is ``-log`` of the root mean square tag error in metres over
    8 tracks of 20 epochs through the work region, 0 before; in every mode. The body moves between
    way-points in the region at the scene's speed, with the scene's process noise, and the filter
    starts from the scene's initial uncertainty. The tracks and the noise are drawn from a
    generator that the problem's own numbers seed: the same layout of the same problem has the
    same reward, another problem other tracks.

    ``gym.make("rbl_gym:RBL/AnchorPlacement-v0", reward="filter", filter="iekf")`` makes it.

    Parameters
    ----------
    env
        The environment.
    filter, options
        Name of a filter and its options, as `EstimatePose`. One that the anchors cannot
        determine is refused: the filters of the Kalman family on the water's surface, say.

    Info
    ----
    `tag_error_m`, that error with the last anchor, 0 before; `score_m` stays the bound's.

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
        filter: str = "iekf",
        options: Mapping[str, Any] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, filter=filter, options=options)
        gym.Wrapper.__init__(self, env)
        self._filter = filter_of(env, filter, options)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, "tag_error_m": 0.0}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Place an anchor; the last one is paid."""
        observation, _, terminated, truncated, info = self.env.step(action)
        error, reward = 0.0, 0.0
        if terminated:
            error = float(_errors(self.env, self._filter, info))
            reward = -math.log(error)
        return observation, reward, terminated, truncated, {**info, "tag_error_m": error}


class VectorFilterReward(VectorWrapper, RecordConstructorArgs):
    """`FilterReward` for the vector environment, in every autoreset mode."""

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        filter: str = "iekf",
        options: Mapping[str, Any] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, filter=filter, options=options)
        VectorWrapper.__init__(self, env)
        self._filter = filter_of(env, filter, options)
        self._error_m = np.zeros(env.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes."""
        observation, info = self.env.reset(seed=seed, options=options)
        # Worlds that go on have not placed their last anchor, or are over and keep its error.
        self._error_m = np.where(info["score_m"] > 0, self._error_m, 0.0)
        return observation, self._told(info)

    def step(self, actions: Any) -> tuple[Any, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Place anchors; the last one of each world is paid."""
        observation, _, terminated, truncated, info = self.env.step(actions)
        error, reward = np.zeros(self.num_envs), np.zeros(self.num_envs)
        final = info.get("final_info", info)
        if terminated.any():
            complete = {key: final[key][terminated] for key in ("region", "racks", "anchors")}
            error[terminated] = _errors(self.env, self._filter, complete)
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


def _errors(env: Any, filter: Filter, info: Mapping[str, np.ndarray]) -> FloatArray:
    """Errors (...) of the filter in complete layouts, as the infos describe them."""
    region = info["region"]
    context = Context(region[..., :3], region[..., 3:], info["racks"])
    return track_error(env.unwrapped.task, context, info["anchors"], filter)


# --- what the id makes ------------------------------------------------------------------------


def anchor_placement(
    *,
    reward: str = "bound",
    filter: str = "iekf",
    options: Mapping[str, Any] | None = None,
    **arguments: Any,
) -> gym.Env[Any, Any]:
    """`RBL/AnchorPlacement-v0`: `AnchorPlacementEnv`, with ``reward="filter"`` in `FilterReward`.

    Parameters
    ----------
    reward
        ``"bound"`` or ``"filter"``.
    filter, options
        As `FilterReward`; only with ``reward="filter"``.
    **arguments
        As `AnchorPlacementEnv`.

    Raises
    ------
    ValueError
        On a reward, or a filter, that does not go with the scene.
    """
    env = AnchorPlacementEnv(**arguments)
    return FilterReward(env, filter, options) if _is_filtered(reward, filter, options) else env


def anchor_placement_vector(
    *,
    reward: str = "bound",
    filter: str = "iekf",
    options: Mapping[str, Any] | None = None,
    **arguments: Any,
) -> VectorEnv[Any, Any, Any]:
    """`anchor_placement` of many problems, with `AnchorPlacementVectorEnv`."""
    envs = AnchorPlacementVectorEnv(**arguments)
    filtered = _is_filtered(reward, filter, options)
    return VectorFilterReward(envs, filter, options) if filtered else envs


def _is_filtered(reward: str, filter: Any, options: Any) -> bool:
    if check_one_of("reward", reward, REWARDS) == "filter":
        return True
    if not isinstance(filter, str) or filter != "iekf" or options is not None:
        raise ValueError(
            "filter and options need reward='filter', got reward='bound' with filter = "
            f"{filter!r:.80}, options = {options!r:.80}"
        )
    return False


# Where Gymnasium looks for render modes.
anchor_placement.metadata = AnchorPlacementEnv.metadata  # pyright: ignore[reportFunctionMemberAccess]

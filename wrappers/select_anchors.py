"""SelectAnchors: the action chooses the anchors that measure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from rbl_gym import rendering
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.envs.batch import check_actions
from rbl_gym.wrappers.estimate import scene_of
from rbl_gym.wrappers.forms import check_single, check_vector

# Age of an unknown quality, in steps.
_NEVER = 1e6


class SelectAnchors(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Only the anchors chosen by the action measure, and all anchors stay where they are.

    Wraps `RBL/Tracking-v0`; `EstimatePose` then wraps the result. The action space is
    ``MultiBinary(M)``. Links and ranges of the other anchors are 0. Their `quality` is 1, because
    the quality of a link is only known with its range. At reset no anchor is chosen, and nothing is
    measured.

    Parameters
    ----------
    env
        The environment.
    memory
        Whether the observation also has `known` (M,) and `age` (M,). `known` is the quality of each
        anchor when it was chosen last: 1 in line of sight, the scene's `blocked_information` behind
        an obstacle, 0 if it gave no range. `age` is the number of steps since then. Before its
        first choice an anchor has `known` 0 and `age` 1e6.

    Info
    ----
    `chosen` (M,), int8: the anchors that measured.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from rbl_gym.wrappers import EstimatePose, SelectAnchors
    >>> env = gym.make("rbl_gym:RBL/Tracking-v0", scene="hall", reward="none")
    >>> env = EstimatePose(SelectAnchors(env), "iekf")
    >>> observation, info = env.reset(seed=1)
    >>> observation, *_, info = env.step([1, 1, 1] + [0] * 9)
    >>> observation["links"].any(axis=-1).sum()
    np.int64(3)
    """

    def __init__(self, env: gym.Env[Any, Any], memory: bool = False) -> None:
        RecordConstructorArgs.__init__(self, memory=memory)
        check_single(env, "VectorSelectAnchors")
        gym.Wrapper.__init__(self, env)
        scene_of(env)
        self._n_anchors = env.observation_space["links"].shape[0]  # pyrefly: ignore[bad-index]
        self._rendered = getattr(env.unwrapped, "film", None) is not None
        self.action_space = spaces.MultiBinary(self._n_anchors)
        self._still = _zeros(env.action_space)
        self._memory = _Memory((self._n_anchors,)) if _is_flag(memory) else None
        if self._memory is not None:
            self.observation_space = _with_memory(env.observation_space)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; its first epoch has no ranges."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self._memory is not None:
            self._memory.forget(...)
        return self._selected(observation, info, np.zeros(self._n_anchors, dtype=np.bool_)), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment; `action` (M,) chooses the anchors that measure."""
        chosen = check_actions("action", action, self.action_space).view(np.bool_)
        observation, reward, terminated, truncated, info = self.env.step(self._still)
        if self._memory is not None:
            self._memory.learn(observation, chosen)
        return self._selected(observation, info, chosen), reward, terminated, truncated, info

    def _selected(self, observation: Any, info: dict[str, Any], chosen: BoolArray) -> Any:
        info["chosen"] = chosen.astype(np.int8)
        if self._rendered:
            rendering.select(self.env, chosen)
        return select(observation, chosen, self._memory)


class VectorSelectAnchors(VectorWrapper, RecordConstructorArgs):
    """`SelectAnchors` for a vector environment, in every autoreset mode."""

    def __init__(self, env: VectorEnv[Any, Any, Any], memory: bool = False) -> None:
        RecordConstructorArgs.__init__(self, memory=memory)
        check_vector(env, "SelectAnchors")
        VectorWrapper.__init__(self, env)
        scene_of(env)
        self._shape = env.num_envs, env.single_observation_space["links"].shape[0]  # pyrefly: ignore[bad-index]
        self.single_action_space = spaces.MultiBinary(self._shape[1])
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self._still = _zeros(env.action_space)
        self._chosen = np.zeros(self._shape, dtype=np.bool_)
        self._memory = _Memory(self._shape) if _is_flag(memory) else None
        if self._memory is not None:
            self.single_observation_space = _with_memory(env.single_observation_space)
            self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes; their first epoch has no ranges."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._selected(observation, info, self._chosen), info

    def step(self, actions: Any) -> tuple[Any, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Step the worlds; `actions` (B, M) choose the anchors that measure."""
        space = self.single_action_space
        chosen = check_actions("actions", actions, space, self.num_envs).view(np.bool_)
        observation, *result, info = self.env.step(self._still)
        if self._memory is not None:
            self._memory.learn(_final(observation, info), chosen)
        if "final_obs" in info:
            last = info["_final_obs"]
            for i in np.flatnonzero(last).tolist():
                memory = None if self._memory is None else self._memory.row(i)
                info["final_obs"][i] = select(info["final_obs"][i], chosen[i], memory)
            info["final_info"]["chosen"] = (chosen & last[:, None]).astype(np.int8)
            info["final_info"]["_chosen"] = last.copy()
        return self._selected(observation, info, chosen), *result, info

    def _selected(self, observation: Any, info: dict[str, Any], chosen: BoolArray) -> Any:
        """Return the selection of the worlds that continue; worlds that start have none."""
        began = info.get("_prior_rotation", np.zeros(self.num_envs, dtype=np.bool_))
        self._chosen = chosen = chosen & ~began[:, None]
        if self._memory is not None:
            self._memory.forget(began)
        info["chosen"] = chosen.astype(np.int8)
        info["_chosen"] = np.ones(self.num_envs, dtype=np.bool_)
        rendering.select(self.env, chosen)
        return select(observation, chosen, self._memory)


class _Memory:
    """The last observed quality of each anchor; arrays (..., M)."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.known, self.age = np.zeros(shape), np.full(shape, _NEVER)

    def forget(self, where: Any) -> None:
        """Reset the memory of some worlds."""
        self.known[where], self.age[where] = 0.0, _NEVER

    def learn(self, observation: Mapping[str, np.ndarray], chosen: BoolArray) -> None:
        """Update with a step of all worlds, in which the chosen anchors (..., M) measured."""
        quality = observation["links"].any(axis=-1) * observation.get("quality", 1.0)
        if "anchor_mask" in observation:
            chosen = chosen & observation["anchor_mask"].astype(np.bool_)
        self.known = np.where(chosen, quality, self.known)
        self.age = np.where(chosen, 0.0, np.minimum(self.age + 1, _NEVER))

    def row(self, world: int) -> _Memory:
        """Return the memory of one world."""
        one = _Memory(self.known.shape[1:])
        one.known, one.age = self.known[world], self.age[world]
        return one


def _is_flag(memory: Any) -> bool:
    if not isinstance(memory, bool):
        raise ValueError(f"memory must be True or False, got {memory!r:.80}")
    return memory


def _with_memory(space: Any) -> spaces.Dict:
    """Return the space of an observation with a memory."""
    m = space["links"].shape[0]
    known, age = spaces.Box(0.0, 1.0, (m,), np.float64), spaces.Box(0.0, _NEVER, (m,), np.float64)
    return spaces.Dict({**space.spaces, "known": known, "age": age})


def _final(observation: dict[str, np.ndarray], info: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the observations after the steps: for ended worlds the final observations."""
    if "final_obs" not in info:
        return observation
    last = info["_final_obs"]
    keys = ("links", "quality", "anchor_mask")
    reached = {key: observation[key].copy() for key in keys if key in observation}
    for key, value in reached.items():
        value[last] = np.stack([one[key] for one in info["final_obs"][last]])
    return reached


def select(
    observation: dict[str, np.ndarray], chosen: BoolArray, memory: _Memory | None = None
) -> dict[str, np.ndarray]:
    """Return an observation with only the links of the chosen anchors (..., M), and the memory."""
    each = chosen[..., None]
    selected = observation.copy()
    selected["ranges"] = observation["ranges"] * each
    selected["links"] = observation["links"] * each
    if "quality" in observation:
        selected["quality"] = np.where(chosen, observation["quality"], 1.0)
    if memory is not None:
        selected["known"], selected["age"] = memory.known.copy(), memory.age.copy()
    return selected


def _zeros(space: spaces.Space[Any]) -> np.ndarray:
    """Return the action that does not move the anchors."""
    return np.zeros(space.shape or (), dtype=space.dtype)

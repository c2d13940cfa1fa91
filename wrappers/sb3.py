"""A native vector environment in the form of stable-baselines3, which rejects Gymnasium's own."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from rbl_gym.extras import require

require("stable_baselines3", "rl", "Sb3VecEnv")
from stable_baselines3.common.vec_env.base_vec_env import (  # noqa: E402
    VecEnv,
    VecEnvIndices,
)

__all__ = ["Sb3VecEnv"]


class Sb3VecEnv(VecEnv):
    """Adapter of a `gymnasium.vector.VectorEnv` with autoreset mode SAME_STEP.

    At the end of an episode its info dict has ``terminal_observation``, ``TimeLimit.truncated`` and
    ``episode`` (return ``r``, length ``l``, seconds ``t``, as stable-baselines3's Monitor writes
    them), and the infos of the last step. The dicts of the other worlds are empty, because a dict
    for every world and step would cost more time than the step.

    Parameters
    ----------
    envs
        For example ``gym.make_vec("rbl_gym:RBL/AnchorPlacement-v0", num_envs=64,
        autoreset_mode="SameStep")``.

    Raises
    ------
    ValueError
        If the environment has another autoreset mode.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from stable_baselines3 import PPO  # doctest: +SKIP
    >>> envs = gym.make_vec(
    ...     "rbl_gym:RBL/AnchorPlacement-v0", num_envs=64, autoreset_mode="SameStep")
    >>> PPO("MlpPolicy", Sb3VecEnv(envs)).learn(300_000)  # doctest: +SKIP
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"envs must have autoreset_mode 'SameStep', got {mode}: make them by "
                "gym.make_vec(..., autoreset_mode='SameStep')"
            )
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        self._actions: np.ndarray | None = None
        self._begin = time.perf_counter()
        self._returns = np.zeros(envs.num_envs)
        self._lengths = np.zeros(envs.num_envs, dtype=np.int64)

    def reset(self) -> Any:
        """Start all episodes, with the seeds of `seed` if any were given.

        Options (`set_options`) raise ValueError: the worlds have no options.
        """
        if any(self._options):
            raise ValueError(f"options must be empty, got {self._options!r:.80}")
        seeds: Any = None if all(one is None for one in self._seeds) else self._seeds
        observation, _ = self.envs.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step all worlds."""
        observation, reward, terminated, truncated, info = self.envs.step(self._actions)
        done = terminated | truncated
        self._returns += reward
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            last = info["final_info"]
            infos[i] = {key: last[key][i] for key in last if not key.startswith("_")}
            infos[i]["terminal_observation"] = info["final_obs"][i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            infos[i]["episode"] = {
                "r": float(self._returns[i]),
                "l": int(self._lengths[i]),
                "t": time.perf_counter() - self._begin,
            }
        self._returns[done] = 0.0
        self._lengths[done] = 0
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the environment."""
        self.envs.close()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Return seeds of the worlds at the next reset: s, s + 1, ...; None draws s at random."""
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._seeds = [seed + i for i in range(self.num_envs)]
        return self._seeds

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the attribute of the vector environment, once for each index."""
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Not supported: the worlds have no attributes of their own."""
        raise NotImplementedError(
            f"{attr_name!r} cannot be set: the worlds of a native vector environment share their "
            "attributes. Pass it to gym.make_vec instead"
        )

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Return ``action_masks`` of each world; other names raise an error."""
        if method_name == "action_masks":
            masks = self.envs.action_masks()  # pyrefly: ignore[missing-attribute]
            return [masks[i] for i in self._get_indices(indices)]
        raise NotImplementedError(
            f"{method_name!r} cannot be called: the worlds of a native vector environment have no "
            "methods except action_masks"
        )

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return whether the infos contain the data of Monitor; there is no other wrapper."""
        is_monitor = wrapper_class.__name__ == "Monitor"
        return [is_monitor] * len(list(self._get_indices(indices)))

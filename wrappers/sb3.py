"""A native vector environment as one of stable-baselines3's, which refuses Gymnasium's own."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices  # pyright: ignore[reportMissingImports]

__all__ = ["Sb3VecEnv"]


class Sb3VecEnv(VecEnv):
    """Adapter of a `gymnasium.vector.VectorEnv` with autoreset mode SAME_STEP.

    Where an episode ends, its info dict holds ``terminal_observation``,
    ``TimeLimit.truncated`` and ``episode`` (return ``r``, length ``l``, seconds ``t``: what
    stable-baselines3's Monitor writes), and the infos of the last step. The dicts of the other
    worlds stay empty: a dict for every world and step costs more than the step.

    Parameters
    ----------
    envs
        For instance ``gym.make_vec("rbl_gym:RBL/AnchorPlacement-v0", num_envs=64,
        autoreset_mode="SameStep")``.

    Raises
    ------
    ValueError
        If the environment resets in another way.

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
            raise ValueError(f"envs must have autoreset_mode 'SameStep', got {mode}")
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        self._actions: np.ndarray | None = None
        self._begin = time.perf_counter()
        self._returns = np.zeros(envs.num_envs)
        self._lengths = np.zeros(envs.num_envs, dtype=np.int64)

    def reset(self) -> Any:
        """Start all episodes, with the seeds of `seed` if any were given.

        Options (`set_options`) are refused: the worlds have none of their own.
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
        """Keep the actions for `step_wait`."""
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
        """Seeds of the worlds at the next reset: s, s + 1, ...; None draws s at random."""
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._seeds = [seed + i for i in range(self.num_envs)]
        return self._seeds

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The attribute of the one vector environment, once for each index."""
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: the worlds have no attributes of their own."""
        raise NotImplementedError("the worlds of a native vector environment share attributes")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """``action_masks`` of each world; anything else is refused, the worlds have no methods."""
        if method_name == "action_masks":
            masks = self.envs.action_masks()  # pyright: ignore[reportAttributeAccessIssue]
            return [masks[i] for i in self._get_indices(indices)]
        raise NotImplementedError("the worlds of a native vector environment share methods")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Whether the worlds' infos hold what Monitor writes; no other wrapper is there."""
        is_monitor = wrapper_class.__name__ == "Monitor"
        return [is_monitor] * len(list(self._get_indices(indices)))

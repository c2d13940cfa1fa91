"""Episodes of held-out worlds with policies and references."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.studies.learning.rl_tasks import HELD_OUT_SEED, SEED_STRIDE, RlTask


def held_out(task: RlTask, worlds: int, seed: int) -> tuple[Any, Any, dict[str, Any]]:
    """Return an environment at the start of its held-out episodes, its observation and info."""
    env = task.make(worlds, "Disabled")
    return env, *env.reset(seed=HELD_OUT_SEED + SEED_STRIDE * seed)


def returns(
    task: RlTask, act: Callable[[Any, np.ndarray], np.ndarray], worlds: int, seed: int
) -> tuple[FloatArray, np.ndarray]:
    """Return sums of rewards (worlds,) of one episode of each world, and their steps (worlds,)."""
    total, count = np.zeros(worlds), np.zeros(worlds, dtype=np.int64)
    for going, reward, _, _ in steps(task, act, worlds, seed):
        total += np.where(going, reward, 0.0)
        count += going
    return total, count


def steps(
    task: RlTask, act: Callable[[Any, np.ndarray], np.ndarray], worlds: int, seed: int
) -> Iterator[tuple[np.ndarray, FloatArray, np.ndarray, dict[str, Any]]]:
    """Yield steps until the first episodes of all worlds are over.

    Each step has: which worlds are in their first episode, rewards, which of these episodes end,
    infos. A world whose episode is over before those of others starts another one.
    """
    env, observation, _ = held_out(task, worlds, seed)
    env.action_space.seed(seed)
    going = np.ones(worlds, dtype=np.bool_)
    while going.any():
        observation, reward, terminated, truncated, info = env.step(act(env, observation))
        done = terminated | truncated
        yield going.copy(), reward, going & done, info
        going &= ~done
        if done.any() and going.any():
            observation, _ = env.reset(options={"reset_mask": done})

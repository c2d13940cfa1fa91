"""Check that a wrapper gets the form of environment that it wraps: single or vector."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import VectorEnv


def check_single(env: Any, vector_form: str) -> None:
    """Raise ValueError if `env` is not a single environment; `vector_form`: the other wrapper."""
    if isinstance(env, VectorEnv):
        raise ValueError(
            f"env must be a single environment, got the vector environment {env}: use {vector_form}"
        )
    if not isinstance(env, gym.Env):
        raise ValueError(f"env must be an environment, as gym.make returns it, got {env!r:.80}")


def check_vector(env: Any, single_form: str) -> None:
    """Raise ValueError if `env` is not a vector environment; `single_form`: the other wrapper."""
    if isinstance(env, gym.Env):
        raise ValueError(
            f"env must be a vector environment, got the single environment {env}: use {single_form}"
        )
    if not isinstance(env, VectorEnv):
        raise ValueError(
            f"env must be a vector environment, as gym.make_vec returns it, got {env!r:.80}"
        )

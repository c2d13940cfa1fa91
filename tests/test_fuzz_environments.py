"""Environments of every id, scalar and vector, and wrappers: arguments, actions, resets, seeds.

Whatever comes in: episodes whose observations lie in their space, or a ValueError or TypeError
that names the argument, or Gymnasium's own error. docs/fuzzing.md says what is tried.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs import registration

import rbl_gym  # noqa: F401 (registers the ids)
from rbl_gym import wrappers
from tests.test_fuzz import SIZES, WRONG

# Of each id the arguments to spoil, with a good value, in worlds that are quickly made.
SHORT = {"name": "uwb_room", "steps": 3}
WORLDS: dict[str, dict[str, Any]] = {
    "Tracking": {"scene": SHORT, "reward": "bound"},
    "AnchorPlacement": {
        "scene": SHORT, "mode": "sequential", "racks": 1, "n_anchors": 4, "mirror": True,
        "sight": True, "reward": "filter", "filter": "iekf", "options": {"robust": True},
    },
    "MobileAnchors": {
        "difficulty": "easy", "scene": "auv_craft", "sort_craft": True, "filter": "iekf",
        "options": {"robust": True},
    },
    "AnchorSelection": {
        "mode": "top-k", "k": 3, "price": 0.05, "scene": SHORT, "filter": "iekf",
        "options": {"robust": True},
    },
    "BaseStation": {"scene": {"steps": 3}, "angle_std_rad": 0.01, "reward": "bound"},
    "PlanarNetwork": {
        "n_nodes": 5, "side_m": 10.0, "radius_m": 8.0, "blind_m": 0.5, "bearing_std_rad": 0.05,
        "lengths": "all", "length_std_m": 0.1, "step_m": 0.5, "reward": "bound", "steps": 3,
    },
}  # fmt: skip
BATCH = {"num_envs": 2, "max_episode_steps": 2, "autoreset_mode": "NextStep"}
COMMON: dict[str, Any] = {"render_mode": None}
CASES = [
    pytest.param(name, vector, id=f"{name}-{'vector' if vector else 'scalar'}")
    for name in WORLDS
    for vector in (False, True)
]
ACTIONS = [*WRONG, *SIZES, np.zeros(3), np.full((2, 8), np.nan), np.ones((2, 8), complex), 2**70]
SEEDS = [*WRONG, -1, 2**70, 1.5, float("nan"), [0], [0, -1], ["a", "b"], [None, 1.5], True]


def made(name: str, vector: bool, **arguments: Any) -> Any:
    spec = gym.spec(f"RBL/{name}-v0")
    entry: Any = spec.vector_entry_point if vector else spec.entry_point
    return registration.load_env_creator(entry)(**arguments)


def good(name: str, vector: bool) -> dict[str, Any]:
    return {**WORLDS[name], **COMMON, **(BATCH if vector else {})}


@contextmanager
def named(problems: list[str], tried: str, known: set[str]) -> Iterator[None]:
    """Collect as problems all errors but those that name one of `known`, or Gymnasium's own."""
    try:
        yield
    except gym.error.Error:
        pass
    except (ValueError, TypeError) as error:
        if not any(one in str(error) for one in known):
            problems.append(f"{tried}: {error}")
    except Exception as error:
        problems.append(f"{tried}: {type(error).__name__}: {error}")


def known_of(argument: str, value: Any) -> set[str]:
    """Names that an error may give: of options the filter names the one that is wrong."""
    return {argument, *(map(str, value) if isinstance(value, dict) else ())}


def episode(env: Any, name: str) -> None:
    """A reset and two steps, all of whose observations lie in their space."""
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation), name
    env.action_space.seed(0)
    for _ in range(2):
        observation, reward, *_ = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation), name
        assert np.isfinite(reward).all(), name


@pytest.mark.parametrize(("name", "vector"), CASES)
def test_constructors(name, vector):
    arguments = good(name, vector)
    episode(made(name, vector, **arguments), name)
    problems = []
    values = [*WRONG, *SIZES, {"name": "nowhere"}, {"steps": 0}, {"dt": 1e300}]
    for argument in arguments:
        # The checks are common to both forms: half of the values each.
        for value in values[vector::2]:
            known = {"scene", *known_of(argument, value)}
            with named(problems, f"{argument} = {value!r:.60}", known):
                episode(made(name, vector, **{**arguments, argument: value}), name)
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize(("name", "vector"), CASES)
def test_actions(name, vector):
    env = made(name, vector, **good(name, vector))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())
    problems = []
    for action in ACTIONS:
        env.reset(seed=0)
        with named(problems, f"{action!r:.60}", {"action"}):
            observation, reward, *_ = env.step(action)
            if not (env.observation_space.contains(observation) and np.isfinite(reward).all()):
                problems.append(f"{action!r:.60}: {observation}, {reward}")
    episode(env, name)
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize("vector", [False, True], ids=["scalar", "vector"])
@pytest.mark.parametrize("name", WORLDS)
def test_seeds_and_reset_options(name, vector):
    env = made(name, vector, **good(name, vector))
    problems = []
    tried = [{"seed": seed} for seed in SEEDS]
    if vector:
        tried += [{"options": {"reset_mask": mask}} for mask in [*WRONG, np.zeros(2, np.bool_)]]
        tried += [{"options": options} for options in WRONG]
    for arguments in tried:
        with named(problems, f"{arguments!r:.80}", {"seed", "options", "reset_mask"}):
            env.reset(**arguments)
        episode(env, name)
    assert not problems, "\n".join(problems)


WRAPPERS: dict[str, tuple[str, dict[str, Any]]] = {
    "EstimatePose": (
        "Tracking",
        {"filter": "iekf", "options": {"robust": True}, "reward": "belief", "observation": "dict"},
    ),
    "EstimateNetwork": (
        "PlanarNetwork",
        {"reward": "belief", "cycles": "bfs", "kappa": "best", "order": "asynchronous", "steps": 9},
    ),
}


@pytest.mark.parametrize("vector", [False, True], ids=["scalar", "vector"])
@pytest.mark.parametrize("name", WRAPPERS)
def test_wrappers(name, vector):
    world, arguments = WRAPPERS[name]
    wrapper = getattr(wrappers, f"Vector{name}" if vector else name)
    env = made(world, vector, **good(world, vector))
    episode(wrapper(env, **arguments), name)
    problems = []
    for argument in arguments:
        for value in [*WRONG, *SIZES, {"robust": "x"}, {"nothing": 1}, {1: 2}]:
            with named(problems, f"{argument} = {value!r:.60}", known_of(argument, value)):
                episode(wrapper(env, **{**arguments, argument: value}), name)
    for other in (None, "x", made("MobileAnchors", vector)):
        with pytest.raises((ValueError, TypeError, AssertionError), match="env"):
            wrapper(other)
    assert not problems, "\n".join(problems)

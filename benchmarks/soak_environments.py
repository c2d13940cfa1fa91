"""Worlds of `soak.py --filters none`: every id, its options, actions and resets at random.

Every observation must lie in its space, every reward be finite.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym.worlds import scenes

Rng = np.random.Generator
# How many worlds and steps: seconds, whatever a step costs.
FAST, MEDIUM, SLOW, LEAST = (2048, 300), (256, 100), (64, 100), (8, 50)


def tracking(rng: Rng) -> tuple[dict[str, Any], tuple[int, int]]:
    name = str(rng.choice(list(scenes.SCENES)))
    scene: dict[str, Any] = {"name": name}
    if name not in ("camsap2013", "icassp2013"):
        scene["trajectory"] = str(
            rng.choice(["waypoints", "random-twist", "orbit", "lawn-mower", "constant"])
        )
        scene["links"] = {
            "drop_probability": float(rng.choice([0.0, 0.0, 0.3, 0.9])),
            "nlos_probability": float(rng.choice([0.0, 0.0, 0.1])),
        }
        scene["noise"] = {"floor_m": float(rng.choice([0.01, 0.1, 1.0]))}
    if name != "camsap2013":
        scene["steps"] = int(rng.integers(1, 120))
    reward = str(rng.choice(["none", "bound"], p=[0.8, 0.2]))
    size = FAST if reward == "none" and not scenes.get(scene).obstacles else MEDIUM
    return {"scene": scene, "reward": reward}, size


def placement(rng: Rng) -> tuple[dict[str, Any], tuple[int, int]]:
    mode = str(rng.choice(["sequential", "one-shot", "mounts"]))
    racks = int(rng.integers(0, 3))
    rooms = ["uwb_room", "hall"]
    flat = mode == "mounts" or racks > 0
    scene = str(rng.choice(rooms if flat else [*rooms, "auv_buoys", "drone_yard", "satellite"]))
    n_anchors = int(rng.integers(3, 8))
    options = {"scene": scene, "mode": mode, "racks": racks, "n_anchors": n_anchors}
    return {**options, "mirror": bool(rng.random() < 0.5)}, SLOW


def mobile(rng: Rng) -> tuple[dict[str, Any], tuple[int, int]]:
    scene = {"name": "auv_craft", "steps": int(rng.integers(1, 120))}
    difficulty = str(rng.choice(["easy", "hard"]))
    return {"difficulty": difficulty, "scene": scene, "sort_craft": bool(rng.random() < 0.5)}, SLOW


def selection(rng: Rng) -> tuple[dict[str, Any], tuple[int, int]]:
    scene = {"name": str(rng.choice(["hall", "uwb_room"])), "steps": int(rng.integers(1, 60))}
    mode = str(rng.choice(["top-k", "priced"]))
    return {"mode": mode, "k": int(rng.integers(1, 7)), "scene": scene}, SLOW


def base_station(rng: Rng) -> tuple[dict[str, Any], tuple[int, int]]:
    scene = {"steps": int(rng.integers(1, 120)), "anchor_speed_m_s": float(rng.choice([0.0, 3.0]))}
    reward, std = str(rng.choice(["none", "bound"])), float(rng.choice([1e-4, 0.002, 0.1]))
    return {"scene": scene, "reward": reward, "angle_std_rad": std}, MEDIUM


def network(rng: Rng) -> tuple[dict[str, Any], tuple[int, int]]:
    options = {
        "n_nodes": int(rng.integers(2, 20)),
        "radius_m": float(rng.uniform(1, 8)),
        "bearing_std_rad": float(rng.choice([0.001, 0.05, 1.0])),
        "lengths": str(rng.choice(["none", "one", "all"])),
        "steps": int(rng.integers(1, 60)),
    }
    return options, LEAST


WORLDS: dict[str, Callable[[Rng], tuple[dict[str, Any], tuple[int, int]]]] = {
    "Tracking": tracking,
    "AnchorPlacement": placement,
    "MobileAnchors": mobile,
    "AnchorSelection": selection,
    "BaseStation": base_station,
    "PlanarNetwork": network,
}


def run(seed: int, index: int) -> tuple[str, int]:
    """One world for a while; returns its name and the steps of all its environments."""
    rng = np.random.default_rng([seed, index])
    name = "Tracking" if rng.random() < 0.5 else str(rng.choice(list(WORLDS)))
    options, (num_envs, steps) = WORLDS[name](rng)
    mode = [*AutoresetMode][rng.integers(3)]
    try:
        envs: Any = gym.make_vec(
            f"rbl_gym:RBL/{name}-v0", num_envs=num_envs, autoreset_mode=mode, **options
        )
        over = np.zeros(num_envs, dtype=np.bool_)
        check(envs, envs.reset(seed=int(rng.integers(2**31)))[0])
        for _ in range(steps):
            if over.any() and mode is AutoresetMode.DISABLED:
                check(envs, envs.reset(options={"reset_mask": over})[0])
            elif rng.random() < 0.01:
                check(envs, envs.reset(seed=int(rng.integers(2**31)))[0])
            observation, reward, terminated, truncated, _ = envs.step(actions(envs, rng))
            over = terminated | truncated
            check(envs, observation)
            if not np.isfinite(reward).all():
                raise AssertionError("a reward is not finite")
    except Exception as error:
        error.add_note(f"in world {index} of seed {seed}: {name}, {options}, {mode}")
        raise
    return name, steps * num_envs


def actions(envs: Any, rng: Rng) -> np.ndarray:
    """Random actions of all worlds."""
    space, single = envs.action_space, envs.single_action_space
    if isinstance(single, spaces.Discrete):
        return rng.integers(single.n, size=space.shape)
    if isinstance(single, spaces.MultiBinary):
        return rng.integers(2, size=space.shape)
    return rng.uniform(-1, 1, space.shape)


def check(envs: Any, observation: Any) -> None:
    """Observations lie in their space; NaN never does."""
    parts = observation if isinstance(observation, dict) else {"observation": observation}
    for key, value in parts.items():
        space = envs.observation_space
        space = space[key] if isinstance(observation, dict) else space
        low, high = getattr(space, "low", 0), getattr(space, "high", 1)
        # As NumPy's minima, which are NaN where an entry is.
        if not ((value - low).min() >= 0 and (high - value).min() >= 0):
            raise AssertionError(f"{key} is outside of its space")

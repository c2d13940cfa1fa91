"""Long runs of random scenes and actions: no NaN, no exception, no covariance that is not positive.

Vector environments with the iterated EKF and the KF family behind them, scenes changed at random
(links lost, reflections, noise, trajectories), random actions, resets by every autoreset mode.
Every step of every body is checked. Worlds whose filters are cheap run longest.
`--filters none`: the environments alone, all ids, see `soak_environments.py`.

World k is a function of the seed and k alone: after a stop or a failure `--start-at k` goes on
from there.

    python benchmarks/soak.py [--body-steps 1e6] [--minutes 60] [--cpu-minutes 60] [--start-at 0]
        [--seed 0] [--filters all] [--json F]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import math
import resource
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import soak_environments
from gymnasium.vector import AutoresetMode

from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.worlds import scenes
from rbl_gym.wrappers import VectorEstimatePose

FAMILY = ("kf", "uc-kf", "et-kf", "kf-ortho")
# The KF family needs anchors that are not coplanar, or a prior that knows.
SPATIAL = ("uwb_room", "drone_yard", "satellite", "camsap2013")
CHANGEABLE = ("uwb_room", "drone_yard", "auv_buoys", "satellite")


class Size(NamedTuple):
    """How many bodies a world has, and for how many steps it runs."""

    num_envs: int
    steps: int


# Bodies that stay in the cache; steps that take seconds, whatever the filter costs.
SIZES = {"fast": Size(1024, 400), "general": Size(512, 150), "slow": Size(256, 100)}


class World(NamedTuple):
    """A scene, a filter that can live in it, and which of `SIZES` its cost calls for."""

    scene: dict[str, Any]
    filter: str
    options: dict[str, Any]
    cost: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--body-steps", type=float, default=1e6)
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after so long")
    parser.add_argument("--cpu-minutes", type=float, default=math.inf, help="the same, of CPU time")
    parser.add_argument("--filters", choices=["all", "none"], default="all")
    parser.add_argument("--start-at", type=int, default=0, metavar="K", help="first world")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="F")
    options = parser.parse_args()
    begin, cpu, told = time.perf_counter(), time.process_time(), -math.inf
    counts: dict[str, int] = defaultdict(int)
    index, done, memory = options.start_at, 0, []
    while True:
        if options.filters == "none":
            label, steps = soak_environments.run(options.seed, index)
        else:
            world, steps = run(options.seed, index)
            label = f"{world.scene['name']} {world.filter}"
        counts[label] += steps
        index, done = index + 1, done + steps
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        seconds = time.perf_counter() - begin
        over = done >= options.body_steps or seconds >= 60 * options.minutes
        over = over or time.process_time() - cpu >= 60 * options.cpu_minutes
        if over or seconds > told + 10:
            told = seconds
            rate = done / (time.process_time() - cpu)
            print(
                f"{done:,} body steps, next world {index}, {seconds:.0f} s, "
                f"{rate:,.0f} per CPU second, peak {memory[-1]:.0f} MiB",
                flush=True,
            )
        if over:
            break
    result = {
        "body_steps": done,
        "body_steps_of": dict(sorted(counts.items())),
        "worlds": index - options.start_at,
        "next_world": index,
        "seconds": time.perf_counter() - begin,
        "cpu_seconds": time.process_time() - cpu,
        "peak_mib_half_way": memory[len(memory) // 2],
        "peak_mib": memory[-1],
    }
    print(json.dumps(result))
    if options.json:
        Path(options.json).write_text(json.dumps(result, indent=1) + "\n")


def random_world(rng: np.random.Generator) -> World:
    """A scene at random and a filter that can live in it."""
    name = str(rng.choice(list(scenes.SCENES)))
    scene: dict[str, Any] = {"name": name}
    common, lossy = name == "camsap2013", False
    if name in CHANGEABLE:
        trajectory = str(rng.choice(["waypoints", "random-twist", "orbit", "lawn-mower"]))
        scene |= {"trajectory": trajectory, "steps": int(rng.integers(1, 120))}
        drop = float(rng.choice([0.0, 0.0, 0.3, 0.9]))
        scene["links"] = {
            "drop_probability": drop,
            "nlos_probability": float(rng.choice([0.0, 0.1])),
        }
        # Weights that all tags of an anchor share are the case of the four small filters.
        common, lossy = bool(rng.random() < 0.6), drop > 0
        scene["noise"] = {"floor_m": float(rng.choice([0.01, 0.1, 1.0]))}
        if common:
            scene["noise"]["reference_tag"] = 0
    filter = str(rng.choice(["iekf", *FAMILY] if name in SPATIAL else ["iekf"]))
    options = {"robust": bool(rng.random() < 0.5)} if filter == "iekf" else {}
    if filter in FAMILY and common and not lossy:
        cost = "fast"
    elif filter == "uc-kf" or name not in CHANGEABLE:
        cost = "slow"  # the coupled problem; priors that say nothing
    else:
        cost = "general"
    return World(scene, filter, options, cost)


def run(seed: int, index: int) -> tuple[World, int]:
    """One world for a while; returns it and its body steps."""
    rng = np.random.default_rng([seed, index])
    world = random_world(rng)
    num_envs, steps = SIZES[world.cost]
    mode = AutoresetMode.SAME_STEP if rng.random() < 0.5 else AutoresetMode.NEXT_STEP
    raw = TrackingVectorEnv(num_envs, world.scene, "none", autoreset_mode=mode)
    envs = VectorEstimatePose(raw, world.filter, world.options)
    try:
        envs.reset(seed=int(rng.integers(2**31)))
        for _ in range(steps):
            actions = np.zeros(num_envs, int)
            if raw.scene.anchor_speed_m_s > 0:
                actions = rng.uniform(-1, 1, envs.action_space.shape)
            observation, reward, _, _, info = envs.step(actions)
            check(observation, reward, info)
    except Exception as error:
        error.add_note(f"in world {index} of seed {seed}: {world}, {mode}")
        raise
    return world, steps * num_envs


def check(observation: dict[str, np.ndarray], reward: np.ndarray, info: dict[str, Any]) -> None:
    """Everything is finite, and every covariance symmetric and positive definite."""
    covariance = observation["belief_covariance"]
    values = {"reward": reward, "covariance": covariance, "nees": info["nees"]}
    for name in ("belief_rotation", "belief_translation"):
        values[name] = observation[name]
    for name, array in values.items():
        if not np.isfinite(array).all():
            raise AssertionError(f"{name} is not finite")
    # Cholesky reads one triangle, and raises where a pivot is not positive.
    skew = np.abs(covariance - np.swapaxes(covariance, -1, -2)).max(axis=(-2, -1))
    if (skew > 1e-9 * np.abs(covariance).max(axis=(-2, -1))).any():
        raise AssertionError("a covariance is not symmetric")
    np.linalg.cholesky(covariance)


if __name__ == "__main__":
    main()

"""Long runs of random scenes and actions: no NaN, no exception, no covariance that is not positive.

Vector environments with the iterated EKF and the KF family behind them, scenes changed at random
(links lost, reflections, noise, trajectories), random actions, resets by every autoreset mode.

    python benchmarks/soak.py [--body-steps 1e6] [--seed 0] [--json F]
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from rbl_gym import scenes
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.wrappers import VectorEstimatePose

NUM_ENVS = 512
# The KF family needs anchors that are not coplanar, or a prior that knows.
SPATIAL = ("uwb_room", "drone_yard", "satellite")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--body-steps", type=float, default=1e6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="F")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    begin, done, runs = time.perf_counter(), 0, 0
    memory = []
    while done < options.body_steps:
        done += run(rng)
        runs += 1
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        print(f"{done:,} body steps, {runs} worlds, {time.perf_counter() - begin:.0f} s, "
              f"peak {memory[-1]:.0f} MiB", flush=True)  # fmt: skip
    result = {
        "body_steps": done,
        "worlds": runs,
        "seconds": time.perf_counter() - begin,
        "peak_mib_half_way": memory[len(memory) // 2],
        "peak_mib": memory[-1],
    }
    print(json.dumps(result))
    if options.json:
        Path(options.json).write_text(json.dumps(result, indent=1) + "\n")


def random_world(rng: np.random.Generator) -> tuple[dict[str, Any], str]:
    """A scene at random and a filter that can live in it."""
    name = str(rng.choice(list(scenes.SCENES)))
    scene: dict[str, Any] = {"name": name}
    if name in ("uwb_room", "drone_yard", "auv_buoys", "satellite"):
        trajectory = str(rng.choice(["waypoints", "random-twist", "orbit", "lawn-mower"]))
        scene |= {"trajectory": trajectory, "steps": int(rng.integers(1, 120))}
        scene["links"] = {
            "drop_probability": float(rng.choice([0.0, 0.3, 0.9])),
            "nlos_probability": float(rng.choice([0.0, 0.1])),
        }
        scene["noise"] = {"floor_m": float(rng.choice([0.01, 0.1, 1.0]))}
    filters = ["iekf", "kf", "uc-kf", "et-kf", "kf-ortho"] if name in SPATIAL else ["iekf"]
    return scene, str(rng.choice(filters))


def run(rng: np.random.Generator, steps: int = 150) -> int:
    """One world for a while; returns its body steps."""
    scene, filter = random_world(rng)
    mode = AutoresetMode.SAME_STEP if rng.random() < 0.5 else AutoresetMode.NEXT_STEP
    raw = TrackingVectorEnv(NUM_ENVS, scene, autoreset_mode=mode)
    options = {"robust": bool(rng.random() < 0.5)} if filter == "iekf" else {}
    envs = VectorEstimatePose(raw, filter, options)
    envs.reset(seed=int(rng.integers(2**31)))
    for _ in range(steps):
        actions = np.zeros(NUM_ENVS, int)
        if raw.scene.anchor_speed_m_s > 0:
            actions = rng.uniform(-1, 1, envs.action_space.shape)
        observation, reward, _, _, info = envs.step(actions)
        covariance = observation["belief_covariance"]
        for values in (reward, covariance, info["nees"], observation["belief_translation"]):
            assert np.isfinite(values).all(), (scene, filter)
        assert np.linalg.eigvalsh(covariance).min() > 0, (scene, filter)
    return steps * NUM_ENVS


if __name__ == "__main__":
    main()

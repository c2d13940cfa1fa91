"""Every filter in the tasks that have one in the loop, under the same reference controller.

Of each: b of the belief (geometric mean over steps and worlds, what the reward is made of), median
and 95th percentile of the real tag error, and the median NEES (5.35 of a consistent filter).

    python benchmarks/task_filters.py [--num-envs 64] [--json F]
"""

from __future__ import annotations

import side_by_side  # isort: skip

from typing import Any

import gymnasium as gym
import numpy as np

from rbl_gym import estimators
from rbl_gym.wrappers import controllers

TASKS: dict[str, tuple[str, dict[str, Any], controllers.Controller]] = {
    "MobileAnchors, easy, orbit": ("MobileAnchors", {"difficulty": "easy"}, controllers.orbit),
    "MobileAnchors, easy, random": (
        "MobileAnchors",
        {"difficulty": "easy"},
        controllers.random_velocities,
    ),
    "MobileAnchors, hard, orbit": ("MobileAnchors", {"difficulty": "hard"}, controllers.orbit),
    "AnchorSelection, k=3, nearest": ("AnchorSelection", {"k": 3}, controllers.nearest),
    "AnchorSelection, k=6, nearest": ("AnchorSelection", {"k": 6}, controllers.nearest),
    "AnchorSelection, k=12": ("AnchorSelection", {"k": 12}, controllers.nearest),
}


def main() -> None:
    options = side_by_side.arguments(__doc__, num_envs=64)
    result: dict[str, Any] = {}
    for task, (name, arguments, controller) in TASKS.items():
        for filter in estimators.names():
            envs = gym.make_vec(
                f"rbl_gym:RBL/{name}-v0", num_envs=options.num_envs, filter=filter, **arguments
            )
            try:
                figures = play(envs, controller)
                result[f"{task}, {filter}"] = figures
                line = "  ".join(f"{key} {value:8.3g}" for key, value in figures.items())
            except ValueError as error:
                result[f"{task}, {filter}"] = line = f"refuses an epoch: {error}"
            print(f"{task:<30} {filter:<10} {line}", flush=True)
    side_by_side.write(result, options.json)


def play(envs: Any, controller: controllers.Controller) -> dict[str, float]:
    """Figures of one episode of all worlds, the first five steps left out."""
    rng = np.random.default_rng(0)
    envs.reset(seed=1)
    infos: list[dict[str, np.ndarray]] = []
    truncated = np.array([False])
    while not truncated.any():
        *_, truncated, info = envs.step(controller(envs, rng))
        infos.append(info)
    told = {
        key: np.array([info[key] for info in infos[5:]])
        for key in ("score_m", "tag_error_m", "nees")
    }
    return {
        "b_m": float(np.exp(np.log(told["score_m"]).mean())),
        "median_error_m": float(np.median(told["tag_error_m"])),
        "p95_error_m": float(np.quantile(told["tag_error_m"], 0.95)),
        "median_nees": float(np.median(told["nees"])),
    }


if __name__ == "__main__":
    main()

"""This checkout beside another commit's: filters, `locate` and environments, time and ratio.

Both are measured by this script, each in processes of its own that take turns; what it calls is
the same in both. Process time, one thread; medians over the turns. A row of an environment is a
step of one of its worlds, resets among them. Needs a worktree of the other, and takes a minute:

    git worktree add ../other 282192e
    python benchmarks/against_commit.py ../other [--json F] [--repeats 3]
"""

from __future__ import annotations

import side_by_side  # isort: skip

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

SIZES = ((4, 5), (10, 6))
SCENE = "auv_buoys"
BODIES, EPOCHS = 1024, 512


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("other", nargs="?", help="a worktree of the other commit")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", metavar="F")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure()))
        return
    trees = {"peer": Path(options.other).resolve(), "ours": Path(__file__).resolve().parents[1]}
    times: dict[str, list[dict[str, float]]] = {name: [] for name in trees}
    for _ in range(options.repeats):
        for name, tree in trees.items():
            times[name].append(in_tree(tree))
    results: dict[str, dict[str, side_by_side.Row]] = {}
    for key in times["ours"][0]:
        size, name = key.split(" ", 1)
        columns = {tree: [run[key] for run in runs] for tree, runs in times.items()}
        row = side_by_side.against(columns["peer"], {name: columns["ours"]})
        results.setdefault(size, {}).update(row)
    side_by_side.print_rows(results, "", "one of", "other")
    side_by_side.write(results, options.json)


def in_tree(tree: Path) -> dict[str, float]:
    """What `measure` says in a process that imports from this tree."""
    done = subprocess.run(
        [sys.executable, __file__, "--measure"],
        env={**os.environ, "PYTHONPATH": str(tree)},
        cwd=tree,
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def measure() -> dict[str, float]:
    """Seconds of each job by its size and name: the median of some runs after a first one."""
    jobs = {f"{m}x{n} {name}": job for m, n in SIZES for name, job in jobs_of_size(m, n).items()}
    jobs |= {f"env {name}": job for name, job in environment_jobs().items()}
    result = {}
    for name, job in jobs.items():
        job.run()
        result[name] = float(np.median([side_by_side.seconds(job) for _ in range(3)]))
    return result


def jobs_of_size(m: int, n: int) -> dict[str, side_by_side.Job]:
    """Each job with m anchors and n tags, by its name."""
    from rbl_gym import bodies, estimators, motion, ranging, rotations  # those of the tree

    rng = np.random.default_rng([m, n])
    tags = bodies.octahedron(0.8)[:n]
    noise = ranging.RangeNoise(0.05, 0.001)
    anchors = rng.uniform(-10, 10, (BODIES, m, 3))
    rotation, translation = rotations.random(rng, (BODIES,)), rng.uniform(-3, 3, (BODIES, 3))
    ranges = ranging.simulate(anchors, tags, rotation, translation, noise, rng).ranges
    near = rotations.exp(0.05 * rng.standard_normal((BODIES, 3))) @ rotation
    place = translation + 0.2 * rng.standard_normal((BODIES, 3))
    prior = near, place, np.diag([0.02] * 3 + [0.1] * 3)
    twist = 0.1 * rng.standard_normal((BODIES, 6))
    laws: Any = {"tags": tags, "noise": noise, "process": motion.ProcessNoise(0.02, 0.1)}
    two = estimators.make("iekf", **laws, iterations=2)
    four = estimators.make("iekf", **laws, iterations=4)
    state, one = two.initial(*prior), four.initial(near[0], place[0], prior[2])
    laws["noise"] = ranging.SquaredRangeNoise(0.05)
    linear = estimators.make("kf", **laws, weights=np.ones(m))
    one_covariance = linear.initial(*prior)
    to_common = ranging.simulate(anchors[0], tags, rotation, translation, noise, rng).ranges

    def one_body() -> None:
        for _ in range(100):
            after = four.update(four.predict(one, twist[0], 0.1), ranges[0], anchors[0])
            four.belief(after)

    def one_by_one() -> None:
        for k in range(20):
            estimators.locate(ranges[k], anchors[k], tags, noise, "ml")

    def at_once() -> None:
        estimators.locate(ranges[:EPOCHS], anchors[:EPOCHS], tags, noise, "ml")

    def common_weights() -> None:
        after = linear.predict(one_covariance, twist[0], 0.1)
        linear.update(after, to_common, anchors[0])

    return {
        "update, 1024 bodies": side_by_side.Job(lambda: two.update(state, ranges, anchors), BODIES),
        "epoch, one body": side_by_side.Job(one_body, 100),
        "kf, common weights": side_by_side.Job(common_weights, BODIES),
        "locate, one epoch": side_by_side.Job(one_by_one, 20),
        "locate, 512 epochs": side_by_side.Job(at_once, EPOCHS),
    }


def environment_jobs() -> dict[str, side_by_side.Job]:
    """Whole episodes of the vector environment: alone, with the bound, with the filter."""
    import gymnasium as gym

    from rbl_gym.wrappers import VectorEstimatePose  # that of the tree

    def worlds(reward: str) -> Any:
        return gym.make_vec("rbl_gym:RBL/Tracking-v0", BODIES, scene=SCENE, reward=reward)

    def episode(envs: Any) -> side_by_side.Job:
        steps = envs.unwrapped.scene.steps + 1
        envs.reset(seed=0)
        actions = np.zeros(envs.action_space.shape, envs.action_space.dtype)

        def run() -> None:
            for _ in range(steps):
                envs.step(actions)

        return side_by_side.Job(run, BODIES * steps)

    filtered = VectorEstimatePose(worlds("none"), "iekf", options={"iterations": 2})
    return {
        "no reward": episode(worlds("none")),
        "bound": episode(worlds("bound")),
        "iekf, 2 iterations": episode(filtered),
    }


if __name__ == "__main__":
    main()

"""This checkout beside another commit's: the iterated EKF and `locate`, time and ratio, one run.

Both are measured by this script, each in processes of its own that take turns; what it calls is
the same in both. Process time, one thread; medians over the turns. Needs a worktree of the other:

    git worktree add ../other 282192e
    python benchmarks/against_commit.py ../other [--json F] [--repeats 5]
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
BODIES, EPOCHS = 1024, 512


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("other", nargs="?", help="a worktree of the other commit")
    parser.add_argument("--repeats", type=int, default=5)
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
    side_by_side.print_rows(results, "M x N", "one of", "other")
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
    return {
        f"{m}x{n} {name}": seconds for m, n in SIZES for name, seconds in measure_size(m, n).items()
    }


def measure_size(m: int, n: int) -> dict[str, float]:
    """Seconds of each job with m anchors and n tags, by its name."""
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

    def one_body() -> None:
        for _ in range(100):
            after = four.update(four.predict(one, twist[0], 0.1), ranges[0], anchors[0])
            four.belief(after)

    def one_by_one() -> None:
        for k in range(20):
            estimators.locate(ranges[k], anchors[k], tags, noise, "ml")

    def at_once() -> None:
        estimators.locate(ranges[:EPOCHS], anchors[:EPOCHS], tags, noise, "ml")

    jobs = {
        "update, 1024 bodies": (lambda: two.update(state, ranges, anchors), BODIES),
        "epoch, one body": (one_body, 100),
        "locate, one epoch": (one_by_one, 20),
        "locate, 512 epochs": (at_once, EPOCHS),
    }
    result = {}
    for name, (run, count) in jobs.items():
        run()
        runs = [side_by_side.seconds(side_by_side.Job(run, count)) for _ in range(5)]
        result[name] = float(np.median(runs))
    return result


if __name__ == "__main__":
    main()

"""What the benchmarks share: one thread, process time, interleaved repeats, ratios in one run.

Imported first of all, as it sets the number of threads before numpy is loaded.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

Name = TypeVar("Name")
Row = dict[str, float]


class Job(NamedTuple):
    """A run, and how many trials (times steps) it works through."""

    run: Callable[[], Any]
    count: int = 1


def arguments(doc: str | None, **defaults: int) -> argparse.Namespace:
    """The command line: ``--json F`` and whole numbers by their names."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", metavar="F")
    for name, default in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=default)
    return parser.parse_args()


def seconds(job: Job) -> float:
    """Process time of one of the job's trials."""
    begin = time.process_time()
    job.run()
    return (time.process_time() - begin) / job.count


def interleaved(jobs: Mapping[Name, Job], repeats: int) -> dict[Name, list[float]]:
    """Seconds a trial of every job, `repeats` times in turn: slow moments hit all alike."""
    times: dict[Name, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            times[name].append(seconds(job))
    return times


def against(peer: list[float], ours: Mapping[Name, list[float]]) -> dict[Name, Row]:
    """Medians in microseconds, and the median of the ratios peer / ours of each repeat."""
    return {
        name: {
            "microseconds": 1e6 * float(np.median(times)),
            "peer_microseconds": 1e6 * float(np.median(peer)),
            "ratio": float(np.median(np.divide(peer, times))),
        }
        for name, times in ours.items()
    }


def print_rows(results: Mapping[str, Mapping[str, Row]], size: str, ours: str, peer: str) -> None:
    """The table of `against` for several sizes."""
    print(f"{size:<7} {ours:<24} {'us':>9} {peer + ' us':>13} {'ratio':>9}")
    for label, rows in results.items():
        for name, row in rows.items():
            print(
                f"{label:<7} {name:<24} {row['microseconds']:9.3f} "
                f"{row['peer_microseconds']:13.2f} {row['ratio']:9.2f}"
            )


def write(result: Any, path: str | None) -> None:
    """The figures as JSON, where a path is given."""
    if path:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(json.dumps(result, indent=1) + "\n")

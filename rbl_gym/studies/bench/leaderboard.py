"""Run every filter on every scene for `rbl-gym bench`: tasks, records and summary.

A task is one world (scene and condition) with the filters to run on it. It gives a record for each
filter: plain numbers that depend only on the inputs named in the record. Timings are stored
separately.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

import rbl_gym
from rbl_gym import estimators, wrappers
from rbl_gym.checks import check_one_of
from rbl_gym.studies.bench import figures, recordings, stages, worlds
from rbl_gym.studies.bench.sources import digest, source_of
from rbl_gym.studies.bench.worlds import CONDITIONS
from rbl_gym.worlds import scenes

__all__ = [
    "CONDITIONS",
    "Task",
    "default_filters",
    "further_filters",
    "run_task",
    "summary",
    "tasks",
]

# Options with which our own filters are also listed.
VARIANTS = ("iekf/robust=true",)
# Filters for rare features: an unknown start, biased links, no odometry, an inertial sensor. They
# are slow.
ELSEWHERE = ("iekf-bank", "iekf-bias", "iekf-cv", "iekf-imu", "iekf-log")
# Keys that identify a record; a finished record with the same values is not computed again.
KEY = ("scene_hash", "condition", "filter", "filter_source", "trials", "seed", "versions")


class Task(NamedTuple):
    """One world, the filters to run on it, the number of trials, and the seed."""

    label: str
    scene: str | dict[str, Any]
    condition: str
    filters: tuple[str, ...]
    trials: int
    seed: int

    def __str__(self) -> str:
        return f"{self.label} {self.condition}"


def default_filters() -> list[str]:
    """Return our filters, those of installed packages, and `VARIANTS`, but not `ELSEWHERE`."""
    return [*(name for name in estimators.names() if name not in ELSEWHERE), *VARIANTS]


def further_filters(spec: str | Mapping[str, Any]) -> list[str]:
    """Return the filters for special features of a scene; none for a recording."""
    if is_recording(spec):
        return []
    scene = scenes.get(spec)
    further = ["iekf-imu", "iekf-imu/robust=true"] if scene.inertial is not None else []
    if scene.survey_std_m > 0:
        std = f"{scene.survey_std_m:g}"
        further += [f"iekf/anchor_std_m={std}", f"iekf-bias/bias_std_m={std}/common_std_m=0"]
    return further


def tasks(
    specs: Mapping[str, str | dict[str, Any]],
    conditions: Sequence[str],
    filters: Sequence[str] | None,
    trials: int,
    seed: int,
) -> list[Task]:
    """Return one task for every scene and condition.

    Parameters
    ----------
    specs
        Scenes (for `scenes.get`) and recordings, by their labels in the table.
    conditions
        Names in `CONDITIONS`.
    filters
        Names with options, as in `estimators.parse_filter`; None: `default_filters`, and the
        `further_filters` of every scene.
    trials, seed
        Number of trials of simulated scenes, and seed of all randomness.

    Raises
    ------
    ValueError
        If a condition, filter, option or scene is unknown. It is raised before any run.
    """
    for condition in conditions:
        check_one_of("condition", condition, list(CONDITIONS))
    for text in filters or ():
        scene = scenes.get("uwb_room")
        estimators.make(text, tags=scene.tags, noise=scene.noise, process=scene.process)
    for spec in specs.values():
        digest_of(spec)
    usual = default_filters() if filters is None else filters
    further = {
        label: further_filters(spec) if filters is None else [] for label, spec in specs.items()
    }
    return [
        Task(label, spec, condition, (*usual, *further[label]), trials, seed)
        for label, spec in specs.items()
        for condition in conditions
    ]


def is_recording(spec: str | Mapping[str, Any]) -> bool:
    """Return whether a scene of the benchmark is a recording."""
    return isinstance(spec, Mapping) and "ranges" in spec


def digest_of(spec: str | Mapping[str, Any]) -> str:
    """Return the hash of a scene, or of a recording with its files."""
    if is_recording(spec):
        return recordings.load_recording(spec).digest  # pyrefly: ignore[bad-argument-type]
    return worlds.scene_hash(scenes.get(spec))


def key_of(record: Mapping[str, Any]) -> str:
    """Return the inputs of a record, as text."""
    return json.dumps([record[name] for name in KEY], sort_keys=True)


def timing_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the key of a time within one run."""
    return row["scene_hash"], row["condition"], row["filter"], row["trials"], row["seed"]


def keys_of(task: Task) -> dict[str, str]:
    """Return the keys of the records of all filters of a task."""
    return {filter: key_of(_head(task, filter)) for filter in task.filters}


def run_task(task: Task) -> list[tuple[dict[str, Any], float | None]]:
    """Return the records of a task, each with its microseconds per step (None: not finished).

    Every filter runs on the same world.
    """
    if is_recording(task.scene):
        stage = stages.recording_stage(task.scene, task.condition, task.seed)  # pyrefly: ignore[bad-argument-type]
    else:
        stage = stages.scene_stage(task.scene, task.condition, task.trials, task.seed)
    results = []
    for text in task.filters:
        found, microseconds = stages.run_filter(stage, *estimators.parse_filter(text))
        results.append((_head(task, text) | found, microseconds))
    return results


def _head(task: Task, filter: str) -> dict[str, Any]:
    """Return the header of a record."""
    return {
        "scene": task.label,
        "spec": task.scene,
        "scene_hash": digest_of(task.scene),
        "condition": task.condition,
        "filter": filter,
        "filter_source": source_of(estimators.parse_filter(filter)[0]),
        "trials": task.trials,
        "seed": task.seed,
        "versions": versions(),
    }


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions that the figures depend on; `code` is a digest of this package."""
    folders = [
        Path(rbl_gym.__file__).parent,
        *map(Path, (*estimators.__path__, *wrappers.__path__)),
    ]
    files = [file for folder in folders for file in folder.rglob("*.py")]
    return {
        "rbl-gym": rbl_gym.__version__,
        "code": digest(files),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }


def summary(
    records: Sequence[Mapping[str, Any]], timings: Mapping[tuple[Any, ...], float | None]
) -> dict[str, Any]:
    """Return the leaderboard as plain numbers.

    Parameters
    ----------
    records
        Records of one run.
    timings
        Microseconds per step by `timing_key` of a record.

    Returns
    -------
    A dict: ``conditions`` (their descriptions), ``rows``, and ``microseconds_per_step`` in the
    order of the rows. There is one row for each record, without its lists per trial. Its
    ``difference`` is relative to the best filter of the same world (see `figures.differences`).
    """
    rows = []
    for _, world in groupby(records, key=lambda r: (r["scene"], r["scene_hash"], r["condition"])):
        same = list(world)
        compared = figures.differences(
            {r["filter"]: r["per_trial"] for r in same if "per_trial" in r}, same[0]["seed"]
        )
        rows += [
            {key: value for key, value in record.items() if key != "per_trial"}
            | {"difference": compared.get(record["filter"], {})}
            for record in same
        ]
    used = {record["condition"] for record in records}
    return {
        "benchmark": "rbl-gym bench",
        "conditions": {name: text for name, text in CONDITIONS.items() if name in used},
        "rows": rows,
        "microseconds_per_step": [timings.get(timing_key(record)) for record in records],
    }

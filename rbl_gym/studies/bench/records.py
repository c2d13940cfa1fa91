"""Store records of the benchmark in a file of JSON lines: save, resume, run again.

In the file of a complete run, lines are in the order of the tasks. They hold nothing that changes
from run to run; processor times are in a separate file next to it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rbl_gym.studies import backends
from rbl_gym.studies.backends import HERE, Workers
from rbl_gym.studies.bench import leaderboard
from rbl_gym.studies.bench.leaderboard import Task

__all__ = ["read_records", "read_timings", "rerun", "run_tasks"]

Records = list[dict[str, Any]]
# Fields that tell the runs of one version apart.
_PLACE = ("scene", "condition", "filter", "trials", "seed")


def timings_path(path: Path) -> Path:
    """Return the file of the times that belongs to a file of records."""
    return path.with_suffix(".timings.jsonl")


def run_tasks(
    tasks: Sequence[Task],
    path: Path,
    *,
    workers: Workers = HERE,
    fresh: bool = False,
    advance: Callable[[int], None] = lambda steps: None,
) -> tuple[Records, dict[tuple[str, ...], float]]:
    """Run tasks that are missing in a file; return all records, in order, and their times.

    Every finished task is written immediately, so that the same call resumes an interrupted run.
    All other records stay in the file, after those of the tasks, also those with other trials,
    seeds or versions.

    Parameters
    ----------
    tasks
        Tasks from `leaderboard.tasks`.
    path
        File of the records.
    workers
        Where to run them.
    fresh
        Overwrite the file instead of resuming it.
    advance
        Called with the number of finished records, first with that of the file.

    Raises
    ------
    ValueError
        If a line of the file is not a record, or a worker has other versions.
    """
    if fresh:
        for file in (path, timings_path(path)):
            file.unlink(missing_ok=True)
    wanted = [key for task in tasks for key in leaderboard.keys_of(task).values()]
    found = (
        {leaderboard.key_of(record): record for record in read_records(path)}
        if path.exists()
        else {}
    )
    # An incomplete last line must not be joined to the next one.
    _write(path, list(found.values()))
    advance(sum(key in found for key in wanted))
    with path.open("a", encoding="utf-8") as file, timings_path(path).open("a") as times:
        for _, results in backends.each(leaderboard.run_task, _left(tasks, found), workers):
            for record, microseconds in results:
                _check_worker(record)
                found[leaderboard.key_of(record)] = record
                file.write(_line(record))
                times.write(_line(_timing(record, microseconds)))
            file.flush()
            times.flush()
            advance(len(results))
    ordered = {key: found[key] for key in wanted}
    _write(path, list((ordered | found).values()))
    return list(ordered.values()), read_timings(path)


def _left(tasks: Sequence[Task], found: Mapping[str, Any]) -> list[Task]:
    """Return the tasks without the filters that have records."""
    left = []
    for task in tasks:
        filters = tuple(f for f, key in leaderboard.keys_of(task).items() if key not in found)
        if filters:
            left.append(task._replace(filters=filters))
    return left


def _check_worker(record: Mapping[str, Any]) -> None:
    if record["versions"] != leaderboard.versions():
        raise ValueError(
            f"all workers must have the versions of this process, {leaderboard.versions()}, but "
            f"one has {record['versions']}"
        )


def read_records(path: Path) -> Records:
    """Read the records of a file; an incomplete last line is ignored.

    Raises
    ------
    ValueError
        If another line is not a record; the message names it.
    """
    records: Records = []
    lines = _text(path).split("\n")
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            record = json.loads(line)
            leaderboard.key_of(record)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            if number == len(lines):
                break
            raise ValueError(
                f"{path}, line {number}: not a result of rbl-gym bench; the file must be one that "
                "bench --out wrote"
            ) from error
        records.append(record)
    return records


def read_timings(path: Path) -> dict[tuple[str, ...], float]:
    """Read microseconds per step by scene hash, condition and filter."""
    file = timings_path(path)
    times: dict[tuple[str, ...], float] = {}
    if not file.exists():
        return times
    for line in _text(file).splitlines():
        try:
            row = json.loads(line)
            times[leaderboard.timing_key(row)] = row["microseconds_per_step"]
        except (ValueError, KeyError, TypeError, RecursionError):
            continue  # an unreadable time is ignored
    return times


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: must be UTF-8 text: {error}") from error


def _timing(record: Mapping[str, Any], microseconds: float | None) -> dict[str, Any]:
    return {name: record[name] for name in ("scene_hash", *_PLACE)} | {
        "microseconds_per_step": microseconds
    }


def _line(row: Mapping[str, Any]) -> str:
    return json.dumps(row, allow_nan=False) + "\n"


def _write(path: Path, records: Records) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(path.suffix + ".part")
    beside.write_text("".join(map(_line, records)), encoding="utf-8")
    os.replace(beside, path)


# --- reproduce ------------------------------------------------------------------------------


def tasks_of(records: Sequence[Mapping[str, Any]]) -> list[Task]:
    """Return the tasks that reproduce these records."""
    grouped: dict[str, Task] = {}
    for record in records:
        task = Task(
            record["scene"],
            record["spec"],
            record["condition"],
            (record["filter"],),
            record["trials"],
            record["seed"],
        )
        key = json.dumps(task._replace(filters=()), sort_keys=True)
        before = grouped.get(key)
        if before is None:
            grouped[key] = task
        elif record["filter"] not in before.filters:  # a record of other versions may be there
            grouped[key] = before._replace(filters=(*before.filters, record["filter"]))
    return list(grouped.values())


def compare(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the differences of two records, by path: both values; None if one is missing."""
    before, after = dict(_flat("", old)), dict(_flat("", new))
    return {
        path: (before.get(path), after.get(path))
        for path in sorted(before | after)
        if before.get(path) != after.get(path)
    }


def _flat(path: str, value: Any) -> list[tuple[str, Any]]:
    if isinstance(value, Mapping):
        return [
            pair for key in value for pair in _flat(f"{path}.{key}" if path else key, value[key])
        ]
    if isinstance(value, list):
        return [pair for k, item in enumerate(value) for pair in _flat(f"{path}[{k}]", item)]
    return [(path, value)]


def relative_change(pair: tuple[Any, Any]) -> float:
    """Return the relative difference of two numbers; inf for other values that differ."""
    if not all(isinstance(value, int | float) for value in pair):
        return float("inf")
    return abs(pair[0] - pair[1]) / max(abs(pair[0]), abs(pair[1]))


def rerun(
    records: Sequence[Mapping[str, Any]],
    *,
    workers: Workers = HERE,
    advance: Callable[[int], None] = lambda steps: None,
) -> dict[str, Any]:
    """Reproduce records, and return the differences.

    Parameters
    ----------
    records
        Records from `read_records`.
    workers
        Where to run them.
    advance
        Called with the number of finished records.

    Returns
    -------
    A dict. ``records`` and ``identical`` are counts. ``changed`` has rows with scene, condition,
    filter, trials, seed, ``relative_change`` (the largest of a figure; None if another value
    changed), ``field`` (its name), ``before`` and ``after``. ``versions`` has the two versions by
    name where they differ; ``sources`` has the same for filters and scenes whose own files changed.
    """
    before: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        before.setdefault(_setting(record), []).append(record)
    rows: dict[str, list[dict[str, Any]]] = {setting: [] for setting in before}
    versions, sources, identical = {}, {}, 0
    for _, results in backends.each(leaderboard.run_task, tasks_of(records), workers):
        for record, _ in results:
            setting = _setting(record)
            for old in before[setting]:
                found = compare(old, record)
                for path in [path for path in found if path.startswith("versions.")]:
                    versions[path.removeprefix("versions.")] = found.pop(path)
                for path in [path for path in found if path in ("scene_hash", "filter_source")]:
                    name = record["scene" if path == "scene_hash" else "filter"]
                    sources[name] = found.pop(path)
                identical += not found
                if found:
                    rows[setting].append(_change(record, found))
        advance(len(results))
    return {
        "records": len(records),
        "identical": identical,
        "changed": [row for changed in rows.values() for row in changed],
        "versions": versions,
        "sources": sources,
    }


def _setting(record: Mapping[str, Any]) -> str:
    """Return what a record is the result of, apart from versions and sources, as text."""
    return json.dumps([record[name] for name in ("spec", *_PLACE)], sort_keys=True)


def _change(record: Mapping[str, Any], found: dict[str, tuple[Any, Any]]) -> dict[str, Any]:
    field = max(found, key=lambda path: relative_change(found[path]))
    change = relative_change(found[field])
    return {
        **{name: record[name] for name in _PLACE},
        "fields": len(found),
        "field": field,
        "before": found[field][0],
        "after": found[field][1],
        "relative_change": change if change < float("inf") else None,
    }

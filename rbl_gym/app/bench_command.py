"""The commands rbl-gym bench and rerun."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rbl_gym.app.terminal import (
    FILTER_HELP,
    add_html,
    add_json,
    add_trials,
    check_html,
    names,
    positive,
    print_files,
    progress,
    write_json,
)
from rbl_gym.studies import backends


def add_bench(commands: Any) -> None:
    """Add the parser of ``rbl-gym bench``."""
    bench = commands.add_parser(
        "bench",
        help="compare filters on scenes: the leaderboard",
        description="Run filters on scenes by Monte Carlo, under nominal conditions and under "
        "stress, with the same noise for all filters. Report accuracy and the bound, consistency, "
        "failures and computing time. A run that was stopped continues where it stopped. See "
        "docs/leaderboard.md. The exit status is 1 if a filter failed, or has no result at all.",
    )
    bench.add_argument(
        "--filters",
        type=names,
        metavar="A,B",
        help=f"filters to compare, each {FILTER_HELP}. Default: all filters except iekf-bank, "
        "iekf-bias, iekf-cv, iekf-imu and iekf-log; also iekf/robust=true; in scenes with an "
        "inertial sensor or survey errors also the filters that use or estimate these",
    )
    bench.add_argument(
        "--scenes",
        type=names,
        metavar="A,B",
        help="names of scenes, or .toml or .json files, each with a changed scene or a recording; "
        "default: all named scenes, and the scenes with an inertial sensor, with time differences "
        "and with surveyed anchors",
    )
    bench.add_argument(
        "--conditions",
        type=names,
        metavar="A,B",
        help="nominal, nlos, lost-links, noise-x2, anchor-off, tag-off (docs/leaderboard.md); "
        "default all",
    )
    add_trials(bench, 200)
    bench.add_argument(
        "--out",
        default="out/bench.jsonl",
        metavar="F",
        help="file for the results of the runs, one on each line; default out/bench.jsonl",
    )
    bench.add_argument(
        "--fresh", action="store_true", help="delete the results that the file of --out already has"
    )
    add_html(bench, "page with maps and a sortable table")
    _add_workers(bench)
    add_json(bench)
    bench.set_defaults(run=_bench)


def add_rerun(commands: Any) -> None:
    """Add the parser of ``rbl-gym rerun``."""
    rerun = commands.add_parser(
        "rerun",
        help="repeat the runs of a bench file and compare the results",
        description=(
            "Repeat all runs of a file of rbl-gym bench. The exit status is 1 if a result differs."
        ),
    )
    rerun.add_argument("file", metavar="FILE", help="results, written by rbl-gym bench --out FILE")
    _add_workers(rerun)
    add_json(rerun)
    rerun.set_defaults(run=_rerun)


def _add_workers(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--jobs", type=positive, default=1, metavar="N", help="number of processes, default 1"
    )
    parser.add_argument(
        "--backend", choices=backends.BACKENDS, help="backend of joblib, default loky"
    )
    parser.add_argument("--address", metavar="A", help="address of an existing dask or ray cluster")


def _bench(options: argparse.Namespace) -> int:
    from rbl_gym.studies.bench import leaderboard, spec_files
    from rbl_gym.studies.bench import records as bench_files
    from rbl_gym.worlds import scenes

    check_html(options)
    workers = _workers(options)
    tasks = leaderboard.tasks(
        spec_files.scene_specs(options.scenes or [*scenes.SCENES, *spec_files.SENSED]),
        options.conditions or list(leaderboard.CONDITIONS),
        options.filters,
        options.trials,
        options.seed,
    )
    steps: list[int] = []
    with progress("bench", sum(len(task.filters) for task in tasks)) as advance:

        def count(finished: int) -> None:
            steps.append(finished)
            advance(finished)

        records, timings = bench_files.run_tasks(
            tasks, Path(options.out), workers=workers, fresh=options.fresh, advance=count
        )
    result = leaderboard.summary(records, timings)
    if options.html:
        from rbl_gym.app import bench_html, page

        page.write(bench_html.bench(result), options.html)
    if write_json(result, options.json):
        from rbl_gym.app import bench_report

        bench_report.print_bench(result)
        if steps[0]:
            print(f"{steps[0]} of {len(records)} results from {options.out}; --fresh computes all")
        print_files(records=options.out, page=options.html)
    failed = any(row["status"] == "failed" for row in result["rows"])
    without = {row["filter"] for row in result["rows"]}
    without -= {row["filter"] for row in result["rows"] if "tags_m" in row}
    return int(failed or bool(without))


def _rerun(options: argparse.Namespace) -> int:
    from rbl_gym.studies.bench import records as bench_files

    workers = _workers(options)
    path = Path(options.file)
    records = bench_files.read_records(path)
    if not records:
        raise ValueError(f"{path}: must have results of rbl-gym bench (--out), has none")
    with progress("rerun", len(records)) as advance:
        result = bench_files.rerun(records, workers=workers, advance=advance)
    if write_json(result, options.json):
        from rbl_gym.app import bench_report

        bench_report.print_rerun(result)
    return int(bool(result["changed"]))


def _workers(options: argparse.Namespace) -> backends.Workers:
    if options.address and options.backend not in ("dask", "ray"):
        raise ValueError(
            f"--address needs --backend dask or ray, got {options.backend or 'no --backend'}"
        )
    workers = backends.Workers(options.jobs, options.backend, options.address)
    backends.check(workers)
    return workers

"""What the commands share: progress bars, JSON, arguments, extras that are missing."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rbl_gym.app.tables import has_rich
from rbl_gym.studies.extras import require
from rbl_gym.studies.progress import Advance


def add_json(parser: argparse.ArgumentParser) -> None:
    """The option --json."""
    parser.add_argument(
        "--json",
        nargs="?",
        const="-",
        metavar="F",
        help="write the figures as JSON to F; without F, to standard output in place of the table",
    )


def add_seed(parser: argparse.ArgumentParser, of: str = "of all randomness") -> None:
    """The option --seed."""
    parser.add_argument("--seed", type=natural, default=0, help=f"{of}, default 0")


def add_trials(parser: argparse.ArgumentParser, default: int = 1000, of: str = "") -> None:
    """The options --trials and --seed."""
    parser.add_argument("--trials", type=positive, default=default, help=f"{of}default {default}")
    add_seed(parser)


def add_html(parser: argparse.ArgumentParser, shows: str) -> None:
    """The option --html; `check_html` says before the work whether it can be served."""
    parser.add_argument("--html", metavar="F", help=f"{shows}; one file, no network")


def check_html(options: argparse.Namespace) -> None:
    """A MissingExtraError where a page is asked for and its library is missing."""
    if options.html:
        require("plotly", "viz")


@contextlib.contextmanager
def progress(label: str, total: int = 0) -> Iterator[Advance]:
    """A progress bar on standard error, of `total` steps and those that are announced later."""
    if not has_rich():
        yield from _plain_progress(label, total)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(label, total=total)

        def advance(steps: int = 1, *, more: int = 0) -> None:
            bar.update(task, advance=steps, total=(bar.tasks[task].total or 0) + more)

        yield advance


def _plain_progress(label: str, total: int) -> Iterator[Advance]:
    """A line that is written over, on a terminal only."""
    done, shown = 0, ""

    def advance(steps: int = 1, *, more: int = 0) -> None:
        nonlocal done, shown, total
        done, total = done + steps, total + more
        percent = f"{100 * done // max(total, 1)} %"
        if sys.stderr.isatty() and percent != shown:
            shown = percent
            print(f"\r{label} {done}/{total}", end="", file=sys.stderr, flush=True)

    yield advance
    if shown:
        print(file=sys.stderr)


def write_json(result: dict[str, Any], target: str | None) -> bool:
    """Write figures where asked; returns whether standard output is free for a table."""
    if target is None:
        return True
    text = json.dumps(result, indent=1, allow_nan=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
        return False
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    Path(target).write_text(text, encoding="utf-8")
    return True


def positive(text: str) -> int:
    """A whole number above zero, for argparse."""
    value = natural(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must be at least 1, got 0")
    return value


def natural(text: str) -> int:
    """A whole number, not negative, for argparse."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be a whole number, not negative, got {text!r}")
    return value


def print_files(**files: str | None) -> None:
    """Where what was written stands, a line each: ``picture: out/x.png``."""
    for label, path in files.items():
        if path:
            print(f"{label}: {path}")


def window(text: str) -> tuple[float, float]:
    """``START:END`` in seconds, for argparse."""
    start, _, end = text.partition(":")
    try:
        return float(start), float(end)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be START:END in seconds, got {text!r}") from None


def offset(text: str) -> float | str:
    """Seconds, or ``auto``, for argparse."""
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be seconds or auto, got {text!r}") from None

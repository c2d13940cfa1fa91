"""Shared by all commands: progress bars, JSON, arguments, missing extras."""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rbl_gym.app.tables import has_rich, rich_console
from rbl_gym.extras import require
from rbl_gym.studies.progress import Advance

FILTER_HELP = (
    "NAME, NAME/option=value/option=value or MODULE:FACTORY, as in iekf/robust=true (see Filters "
    "with options in docs/estimators.md)"
)

# Formats of pictures.
_PICTURES = (".png", ".svg", ".pdf", ".jpg", ".jpeg", ".webp", ".eps")
# Time between two updates of a progress bar.
_REFRESH_S = 0.05
# Away from a terminal long work writes a line this often, seconds.
_LINE_S = 20.0


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add the option --json."""
    parser.add_argument(
        "--json",
        nargs="?",
        const="-",
        metavar="F",
        help="write the results as JSON to the file F; without F, print JSON instead of the table",
    )


def add_seed(parser: argparse.ArgumentParser, of: str = "seed of all random numbers") -> None:
    """Add the option --seed."""
    parser.add_argument("--seed", type=natural, default=0, metavar="N", help=f"{of}, default 0")


def add_trials(
    parser: argparse.ArgumentParser, default: int = 1000, what: str = "number of trials"
) -> None:
    """Add the options --trials and --seed."""
    parser.add_argument(
        "--trials", type=positive, default=default, metavar="N", help=f"{what}, default {default}"
    )
    add_seed(parser)


def add_plot(parser: argparse._ActionsContainer, shows: str, default: str | None = None) -> None:
    """Add the option --plot; the name of the file is checked before the work."""
    parser.add_argument(
        "--plot",
        type=_picture,
        default=default,
        metavar="F",
        help=f"picture (.png, .svg or .pdf) {shows}",
    )


def add_html(parser: argparse.ArgumentParser, shows: str) -> None:
    """Add the option --html; `check_html` checks before the work whether it is available."""
    parser.add_argument(
        "--html", metavar="F", help=f"HTML {shows}; a single file that works offline"
    )


def check_html(options: argparse.Namespace) -> None:
    """Raise MissingExtraError if a page is requested and its library is missing."""
    if options.html:
        require("plotly", "viz", "--html")


@contextlib.contextmanager
def progress(label: str, total: int = 0) -> Iterator[Advance]:
    """Show a progress bar on standard error, with `total` steps and those announced later."""
    if not has_rich():
        yield from _plain_progress(label, total)
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=rich_console(stderr=True)) as bar:
        task, done, shown = bar.add_task(label, total=total), 0, 0.0
        told = time.monotonic()

        def advance(steps: int = 1, *, more: int = 0) -> None:
            nonlocal done, total, shown, told
            done, total = done + steps, total + more
            if not bar.console.is_interactive:
                told = _line(label, done, total, told)
            # An update takes as long as an epoch of a filter.
            if (now := time.monotonic()) > shown + _REFRESH_S:
                shown = now
                bar.update(task, completed=done, total=total)

        try:
            yield advance
        except BaseException:
            bar.live.transient = True  # no unfinished bar above the error
            if not bar.console.is_interactive:  # nor the empty line that ends a bar in a file
                bar.live.stop()
                bar.disable = True
            raise
        bar.update(task, completed=done, total=total)


def _line(label: str, done: int, total: int, told: float) -> float:
    """Write the progress if the last line was long ago; return the time of the last line."""
    now = time.monotonic()
    if now < told + _LINE_S:
        return told
    print(f"{label} {done}/{total}", file=sys.stderr, flush=True)
    return now


def _plain_progress(label: str, total: int) -> Iterator[Advance]:
    """Show a line that is overwritten; away from a terminal a line at times."""
    done, shown, told = 0, "", time.monotonic()

    def advance(steps: int = 1, *, more: int = 0) -> None:
        nonlocal done, shown, total, told
        done, total = done + steps, total + more
        percent = f"{100 * done // max(total, 1)} %"
        if not sys.stderr.isatty():
            told = _line(label, done, total, told)
        elif percent != shown:
            shown = percent
            print(f"\r{label} {done}/{total}", end="", file=sys.stderr, flush=True)

    try:
        yield advance
    finally:
        if shown:
            print(file=sys.stderr)


def write_json(result: dict[str, Any], target: str | None) -> bool:
    """Write figures if requested; return whether standard output is free for a table."""
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
    """Parse a positive integer, for argparse."""
    value = natural(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must be at least 1, got 0")
    return value


def natural(text: str) -> int:
    """Parse a non-negative integer, for argparse."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be a non-negative whole number, got {text!r}")
    return value


def _picture(text: str) -> str:
    """Return the name of a picture that matplotlib can write, for argparse."""
    if not text.lower().endswith(_PICTURES):
        raise argparse.ArgumentTypeError(f"must end in one of {', '.join(_PICTURES)}, got {text!r}")
    return text


BOX = "x=MIN:MAX,y=MIN:MAX,z=MIN:MAX"


def box(text: str) -> list[tuple[float | None, float | None]] | None:
    """Parse `BOX` as three pairs, None where a limit or an axis is left out; None: another form."""
    if "=" not in text:
        return None
    limits: dict[str, tuple[float | None, float | None]] = {}
    for part in text.split(","):
        axis, _, ends = part.strip().partition("=")
        low, colon, high = ends.partition(":")
        try:
            pair = [float(end) if end.strip() else None for end in (low, high)]
        except ValueError:
            pair = []
        if not (colon and pair) or axis not in ("x", "y", "z") or axis in limits:
            raise argparse.ArgumentTypeError(
                f"must be {BOX} in metres, each axis once, got {text!r}"
            )
        limits[axis] = pair[0], pair[1]
    for axis, (low, high) in limits.items():
        if low is not None and high is not None and low > high:
            raise argparse.ArgumentTypeError(
                f"{axis} must have MIN below MAX, got {low:g}:{high:g}"
            )
    return [limits.get(axis, (None, None)) for axis in "xyz"]


def print_files(**files: str | None) -> None:
    """Print the written files, one per line: ``picture: out/x.png``."""
    for label, path in files.items():
        if path:
            print(f"{label}: {path}")


def names(text: str) -> list[str]:
    """Parse different names with commas; a comma inside brackets is part of a name."""
    found = [name.strip() for name in re.split(r",(?![^\[]*\])", text)]
    if "" in found or len(set(found)) < len(found):
        raise argparse.ArgumentTypeError(
            f"must be different names separated by commas, got {text!r}"
        )
    return found


def window(text: str) -> tuple[float, float]:
    """Parse ``START:END`` in seconds, for argparse."""
    start, _, end = text.partition(":")
    try:
        return float(start), float(end)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be START:END in seconds, got {text!r}") from None


def offset(text: str) -> float | str:
    """Parse seconds, or ``auto``, for argparse."""
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be seconds or auto, got {text!r}") from None

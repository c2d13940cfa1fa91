"""Options and processes of the benchmarks that compare this tree with that of another commit."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def read_options(about: str | None, cases: Iterable[str]) -> argparse.Namespace:
    """Read the command line. `--measure` and `--seed` are for the processes of `in_tree`."""
    cases = list(cases)
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("other", nargs="?", help="a worktree of the other commit")
    parser.add_argument("--cases", default=",".join(cases), help="of " + ", ".join(cases))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", metavar="F")
    parser.add_argument("--measure", metavar="CASE", help=argparse.SUPPRESS)
    parser.add_argument("--seed", type=int, default=0, help=argparse.SUPPRESS)
    return parser.parse_args()


def in_tree(script: str, tree: Path, name: str, seed: int) -> dict[str, Any]:
    """Return what `--measure` of a script prints in a process that imports from this tree."""
    command = [sys.executable, script, "--measure", name, "--seed", str(seed)]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(
        command, env=environment, cwd=tree, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def as_line(row: dict[str, Any]) -> str:
    return "  ".join(
        f"{key} {value:.4f}" if isinstance(value, float) else f"{key} {value}"
        for key, value in row.items()
    )

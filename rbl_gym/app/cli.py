"""The command line: a parser with one module per command, and the exit status."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from rbl_gym import __version__
from rbl_gym.app import (
    bench_command,
    bounds_command,
    calibrate_command,
    convert_command,
    learning_commands,
    network_command,
    paper_commands,
    place_command,
    plan_command,
    replay_command,
    studio_command,
)
from rbl_gym.studies.extras import MissingExtraError

# Status of a program whose reader has gone (`| head`): 128 + SIGPIPE, as of git.
READER_GONE = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status (2: invalid input, with a message)."""
    try:
        try:
            return _run(arguments)
        finally:
            # When Python itself flushes, at its end, a closed pipe gives a traceback.
            _flush()
    except BrokenPipeError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
        return READER_GONE


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()


def _run(arguments: Sequence[str] | None) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help(sys.stderr)
        return 2
    # MODULE:FACTORY may be in a file of the working folder, which only `python -m` would search.
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        status = options.run(options)
        _flush()
        return status
    except MissingExtraError as error:
        print(f"rbl-gym: {error}", file=sys.stderr)
    except BrokenPipeError:
        raise
    except OSError as error:
        said = f"{error.filename}: {error.strerror}" if error.filename else error
        print(f"rbl-gym {options.command}: {said}", file=sys.stderr)
    except ValueError as error:
        print(f"rbl-gym {options.command}: {error}", file=sys.stderr)
    return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rbl-gym",
        description="Localization of rigid bodies by radio. Help for a command: rbl-gym COMMAND "
        "--help.",
    )
    parser.add_argument("--version", action="version", version=f"rbl-gym {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="command")
    paper_commands.add_demo(commands)
    place_command.add_place(commands)
    plan_command.add_plan(commands)
    studio_command.add_studio(commands)
    learning_commands.add_train(commands)
    learning_commands.add_evaluate(commands)
    learning_commands.add_transfer(commands)
    bench_command.add_bench(commands)
    bench_command.add_rerun(commands)
    bounds_command.add_bounds(commands)
    convert_command.add_convert(commands)
    replay_command.add_replay(commands)
    calibrate_command.add_calibrate(commands)
    paper_commands.add_reproduce(commands)
    network_command.add_network(commands)
    return parser

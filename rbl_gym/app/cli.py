"""The command line: a parser with one module per command, and the exit status."""

from __future__ import annotations

import argparse
import atexit
import gc
import logging
import os
import sys
from collections.abc import Sequence
from importlib import import_module

from gymnasium.error import Error as GymError

from rbl_gym import __version__
from rbl_gym.app.parser import Parser, with_options

# The commands and the module of `rbl_gym.app` with the function `add_NAME` of each, in the order of
# the help.
_COMMANDS = {
    "demo": "paper_commands",
    "place": "place_command",
    "plan": "plan_command",
    "studio": "studio_command",
    "train": "learning_commands",
    "evaluate": "learning_commands",
    "transfer": "learning_commands",
    "bench": "bench_command",
    "rerun": "bench_command",
    "bounds": "bounds_command",
    "convert": "convert_command",
    "replay": "replay_command",
    "calibrate": "calibrate_command",
    "reproduce": "paper_commands",
    "network": "network_command",
}
# Status of a program whose reader has gone (`| head`): 128 + SIGPIPE, as of git.
READER_GONE = 141
# Status of a program that Ctrl-C ended: 128 + SIGINT.
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status (2: invalid input, with a message)."""
    # Commands create few cycles; by default their collection takes a tenth of the time.
    gc.set_threshold(100_000)
    # At its end Python would look for cycles in all objects, for a quarter of a second.
    atexit.register(gc.freeze)
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
    except KeyboardInterrupt:
        print("rbl-gym: interrupted", file=sys.stderr)
        return INTERRUPTED


class _ToStderr(logging.Handler):
    """Print messages to the standard error of the moment, above a progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"rbl-gym: {record.getMessage()}", file=sys.stderr, flush=True)


def _show_log() -> None:
    """Show messages of the package, such as that kernels are compiled."""
    log = logging.getLogger("rbl_gym")
    log.setLevel(logging.INFO)
    if not log.handlers:
        log.addHandler(_ToStderr())


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()


def _run(arguments: Sequence[str] | None) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    _show_log()
    parser = _parser(*arguments[:1])
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help(sys.stderr)
        return 2
    # MODULE:FACTORY may be in a file of the working folder, which only `python -m` would search.
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        absent = _absent_folders(options)
        status = options.run(options)
        for folder in absent:
            if os.path.isdir(folder):
                print(f"rbl-gym {options.command}: made the folder {folder}", file=sys.stderr)
        _flush()
        return status
    except BrokenPipeError:
        raise
    except OSError as error:
        said = f"{error.filename}: {error.strerror}" if error.filename else error
        print(f"rbl-gym {options.command}: {said}", file=sys.stderr)
    except (ValueError, GymError, ModuleNotFoundError) as error:
        said = with_options(str(error), options, arguments)
        print(f"rbl-gym {options.command}: {said}", file=sys.stderr)
    return 2


def _absent_folders(options: argparse.Namespace) -> list[str]:
    """Return the folders of the files to write that do not exist yet."""
    paths = (getattr(options, name, None) for name in ("track", "plot", "html", "json"))
    folders = (os.path.dirname(path) for path in paths if isinstance(path, str))
    return [folder for folder in dict.fromkeys(folders) if folder and not os.path.exists(folder)]


def _parser(command: str = "") -> Parser:
    """Return the parser of one command; of all commands if there is none of this name."""
    parser = Parser(
        prog="rbl-gym",
        description="Localization of rigid bodies by radio. Help for a command: rbl-gym COMMAND "
        "--help.",
    )
    parser.add_argument("--version", action="version", version=f"rbl-gym {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="command")
    for name in [command] if command in _COMMANDS else _COMMANDS:
        module = import_module(f"rbl_gym.app.{_COMMANDS[name]}")
        getattr(module, f"add_{name}")(commands)
    return parser

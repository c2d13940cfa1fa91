"""The parser of the command line: errors of one line, and help whose words stay whole."""

from __future__ import annotations

import argparse
import itertools
import re
import sys
import textwrap
from collections.abc import Sequence
from typing import Any, NoReturn

from rbl_gym.checks import did_you_mean

_NO_VALUE = re.compile(r"argument (\S+): expected one argument")
_CHOICE = re.compile(r"invalid choice: '(.*?)' \(choose from (.*)\)")


class _Help(argparse.HelpFormatter):
    """Help that never breaks a name at its hyphens, such as --metres-per-pixel."""

    def add_argument(self, action: argparse.Action) -> None:
        """Leave room for the longest command, whose indentation argparse does not count."""
        super().add_argument(action)
        if isinstance(action, argparse._SubParsersAction):
            self._action_max_length += self._indent_increment

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        """Wrap each line of a description; a list in it stays a list."""
        return "\n".join(
            textwrap.fill(
                line, width, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
            )
            for line in text.splitlines()
        )


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, with a suggestion for a misspelt name."""

    def __init__(self, **kwargs: Any) -> None:
        kwargs.setdefault("formatter_class", _Help)
        super().__init__(**kwargs)
        self._typed: list[str] = []

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; raise an error here for an unknown option, so that it names the command."""
        self._typed = [*(sys.argv[1:] if args is None else args)]
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            name = unknown[0].partition("=")[0]
            near = self._comma(unknown[0]) or self._no_value()
            if name[:1] == "-":
                near = did_you_mean(name, [*self._option_string_actions])
            self.error(f"unknown argument {unknown[0]!r}{near}")
        return options, unknown

    def error(self, message: str) -> NoReturn:
        """Print the message in one line, without the usage, and exit with status 2."""
        if found := _CHOICE.search(message):
            message += did_you_mean(found[1], [name.strip("'") for name in found[2].split(", ")])
        if found := _NO_VALUE.search(message):
            message += self._negative(found[1].split("/"))
        if "ignored explicit argument" in message:
            message += self._no_value()
        end = "" if message[-1] in ".?" else "."
        self.exit(2, f"{self.prog}: {message}{end} Help: {self.prog} --help\n")

    def _comma(self, word: str) -> str:
        """Return how to write several values of the option before a word, if it takes a list."""
        before = self._typed[: self._typed.index(word)] if word in self._typed else []
        option = next((name for name in reversed(before) if name[:2] == "--"), "")
        action = self._option_string_actions.get(option.partition("=")[0])
        if action is None or action.metavar != "A,B":
            return ""
        return f"; separate the values of {action.option_strings[0]} by commas, without spaces"

    def _no_value(self) -> str:
        """Return that an option takes no value, if a number was typed after it."""
        words = [part for word in self._typed for part in word.split("=", 1)]
        for option, value in itertools.pairwise(words):
            action = self._option_string_actions.get(option)
            if action is not None and action.nargs == 0 and re.fullmatch(r"[\d.]+", value):
                instead = "; give the allowed numbers by --anchors A..B"
                return f"; {option} takes no value{instead * (option == '--fewest')}"
        return ""

    def _negative(self, names: Sequence[str]) -> str:
        """Return how to write an option whose value begins with a minus sign."""
        for option, value in itertools.pairwise(self._typed):
            same = option[:2] == "--" and any(name.startswith(option) for name in names)
            if same and re.match(r"-[\d.]", value):
                return f"; with a minus sign in front, write {option}={value}"
        return ""


def with_options(message: str, given: argparse.Namespace, arguments: Sequence[str]) -> str:
    """Return the message of a library function with the options in place of its arguments.

    ``range_std_m must be positive`` becomes ``--range-std-m must be positive``. The name of a file,
    a column or a value in quotes stays, and so does a single word that was not given as an option.
    """
    names = [name for name in vars(given) if "_" in name]
    words = "|".join(name for name in vars(given) if "_" not in name)
    typed = {argument.partition("=")[0] for argument in arguments}
    first = message.partition(" ")[0]
    if f"--{first}" in typed:
        message = f"--{message}"
    elif f"--{first}s" in typed:  # an option that takes a list
        message = f"--{first}s: {message}"
    message = re.sub(rf"\b(needs|set|leave out) ({words})\b", r"\1 --\2", message)
    message = re.sub(rf"(--[\w-]+ or) ({words})\b", r"\1 --\2", message)
    for name in names:
        option = f"--{name.replace('_', '-')}"
        message = re.sub(rf"(?<![\w'\"./\[-]){name}(?![\w'\"./=])", option, message)
    return message

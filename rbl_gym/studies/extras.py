"""Report missing libraries that are installed by an extra."""

from __future__ import annotations

import importlib.util


class MissingExtraError(Exception):
    """Raised if a library from one of the extras is missing."""


def require(module: str, extra: str, also: str = "", instead: str = "") -> None:
    """Raise MissingExtraError before the work begins; `also`: needed libraries of no extra.

    `instead`: what else can be done.
    """
    if importlib.util.find_spec(module) is None:
        install = f"pip install 'rbl-gym[{extra}]' {also}".rstrip()
        choice = f", or {instead}" if instead else ""
        raise MissingExtraError(f"this command needs the extra {extra}: {install}{choice}")

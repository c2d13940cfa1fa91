"""Report missing libraries that are installed by an extra."""

from __future__ import annotations

import importlib.util


class MissingExtraError(Exception):
    """Raised if a library from one of the extras is missing."""


def require(module: str, extra: str, also: str = "") -> None:
    """Raise MissingExtraError before the work begins; `also`: needed libraries of no extra."""
    if importlib.util.find_spec(module) is None:
        raise MissingExtraError(
            f"this command needs the extra {extra}: pip install 'rbl-gym[{extra}]' {also}".rstrip()
        )

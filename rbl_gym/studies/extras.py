"""Libraries that only an extra installs: say which one is missing."""

from __future__ import annotations

import importlib.util


class MissingExtraError(Exception):
    """A library is missing that one of the extras installs."""


def require(module: str, extra: str, also: str = "") -> None:
    """Say which extra is missing before the work begins, and what is needed `also`, of no extra."""
    if importlib.util.find_spec(module) is None:
        raise MissingExtraError(
            f"this command needs the extra {extra}: pip install 'rbl-gym[{extra}]' {also}".rstrip()
        )

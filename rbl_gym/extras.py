"""Report missing libraries that are installed by an extra."""

from __future__ import annotations

import importlib.util


class MissingExtraError(ModuleNotFoundError):
    """Raised if a library from one of the extras is missing."""


def require(module: str, extra: str, what: str, also: str = "", instead: str = "") -> None:
    """Raise MissingExtraError, with the command that installs the extra, if `module` is missing.

    `what` needs the module. `also`: further libraries of no extra. `instead`: what else can be
    done.
    """
    if importlib.util.find_spec(module) is None:
        choice = f", or {instead}" if instead else ""
        text = f"{what} needs the extra {extra}: {installation(extra)} {also}".rstrip()
        raise MissingExtraError(text + choice, name=module)


def installation(extra: str) -> str:
    """Return the command that installs an extra."""
    return f"pip install 'rbl-gym[{extra}]'"

"""References of `evaluation` that are left out, because the package they need is not installed."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec

__all__ = ["left_out"]

_OF_CMAES = ("one-for-all", "cma-es")


def left_out(references: Sequence[str], named: Sequence[str]) -> list[str]:
    """Return the references that need the package cmaes, without it, except those that are named.

    A reference that is named raises ModuleNotFoundError when it is computed.
    """
    lacking = () if find_spec("cmaes") else _OF_CMAES
    return [name for name in references if name in lacking and name not in named]

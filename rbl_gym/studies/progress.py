"""Report the progress of studies."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Advance"]


class Advance(Protocol):
    """Progress callback: ``advance(0, more=n)`` before n steps, ``advance()`` after each."""

    def __call__(self, steps: int = 1, *, more: int = 0) -> None:
        """Report that `steps` are done, and `more` are added to those announced before."""


def silent(steps: int = 1, *, more: int = 0) -> None:
    """Ignore progress."""

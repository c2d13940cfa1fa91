"""How studies tell how far they are."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Advance"]


class Advance(Protocol):
    """What a study calls: ``advance(0, more=n)`` before n steps, ``advance()`` after each."""

    def __call__(self, steps: int = 1, *, more: int = 0) -> None:
        """`steps` are done, `more` are still to come besides those announced before."""


def silent(steps: int = 1, *, more: int = 0) -> None:
    """Tells nobody."""

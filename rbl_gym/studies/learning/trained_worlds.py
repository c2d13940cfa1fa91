"""The worlds that a policy was trained in, kept in its file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rbl_gym.studies.learning.own_policies import PolicyLike

__all__ = ["common_worlds", "worlds_to_keep"]

# Files that scenes name: buildings, layouts.
_SUFFIXES = (".toml", ".json", ".csv")


def worlds_to_keep(worlds: Mapping[str, Any]) -> dict[str, Any]:
    """Return entries of a policy's `meta` for the worlds of its training.

    Parameters
    ----------
    worlds
        ``{"scene": S}`` or ``{"scenes": S}``, arguments of `RlTask.in_worlds`, of plain values;
        empty: the task's own worlds.

    Returns
    -------
    The same, and under ``"files"`` the SHA-256 of every file that the scenes name.
    """
    files = {path: _digest(path) for path in _files(worlds)}
    return {**worlds, **({"files": files} if files else {})}


def common_worlds(task: str, policies: Mapping[str, PolicyLike]) -> dict[str, Any]:
    """Return the worlds in which policies were trained, as arguments of `RlTask.in_worlds`.

    Parameters
    ----------
    task
        Name of the task. Policies of other tasks are ignored.
    policies
        Policies by label.

    Raises
    ------
    ValueError
        If policies were trained in different worlds, or a file that these name is missing or has
        changed.
    """
    found = {
        label: {key: policy.meta[key] for key in ("scene", "scenes") if key in policy.meta}
        for label, policy in policies.items()
        if policy.meta.get("task") == task
    }
    (first, worlds), *others = found.items() or [("", {})]
    for label, other in others:
        if other != worlds:
            raise ValueError(
                f"policies {first!r} and {label!r} were trained in different scenes: choose "
                "one by --scene or --family"
            )
    for label in found:
        files = policies[label].meta.get("files", {})
        for path, digest in files.items() if isinstance(files, dict) else ():
            state = "has changed since" if Path(path).is_file() else "is not here"
            if state == "is not here" or _digest(path) != digest:
                raise ValueError(
                    f"policy {label!r} was trained in a scene of {path}, which {state}: choose "
                    "a scene by --scene or --family"
                )
    return worlds


def _files(value: Any) -> Iterator[str]:
    """Yield the paths of existing files that nested values name."""
    if isinstance(value, str):
        if value.endswith(_SUFFIXES) and Path(value).is_file():
            yield value
    elif isinstance(value, Mapping | list | tuple):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _files(part)


def _digest(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()

"""Scenes and families of scenes from JSON and TOML files."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["read_scene", "read_scenes"]

SUFFIXES = (".json", ".toml")


def read_scenes(path: str | Path) -> Any:
    """Read a family from a file, for `scenes=` of an environment.

    Parameters
    ----------
    path
        JSON: a list of scenes, or one scene. TOML: one scene, or only ``scenes = [...]``. A scene
        is a name or a table of overrides with the key ``name``. Its values may be laws, see
        `rbl_gym.worlds.families.SceneFamily`.

    Raises
    ------
    ValueError
        If the file cannot be read (with line and column) or has no scenes.
    """
    found = _parsed(path)
    if isinstance(found, Mapping) and set(found) == {"scenes"}:
        found = found["scenes"]
    for index, scene in enumerate(found if isinstance(found, list) else [found]):
        if not isinstance(scene, str) and not (isinstance(scene, Mapping) and "name" in scene):
            raise ValueError(
                f"{path}: scene {index} must be a name or a table with the key 'name', "
                f"got {scene!r:.80}"
            )
    if not found:
        raise ValueError(f"{path} must hold at least one scene, got none")
    return found


def read_scene(name: str) -> Any:
    """Return the value of `scene=` for an environment: a name, or a file's overrides as a dict.

    Parameters
    ----------
    name
        Name of a scene; of a JSON or TOML file with a table of overrides and the key ``name``; or
        of a building file, which is returned unchanged, for the environment.

    Raises
    ------
    ValueError
        If the file cannot be read (with line and column) or has neither.
    """
    if not name.endswith(SUFFIXES):
        return name
    found = _parsed(name)
    if isinstance(found, Mapping) and _is_building(found):
        return name
    if isinstance(found, Mapping) and "name" in found:
        return dict(found)
    raise ValueError(
        f"{name} must hold a table with the key 'name' (changes of a scene) or 'body' (a "
        f"building file), got {found!r:.80}"
    )


def changes_in(path: str) -> dict[str, Any] | None:
    """Return the overrides in a scene file; None for any other file, such as a building file.

    Raises
    ------
    ValueError
        If the scene file changes another scene file.
    """
    found = _changes(path)
    name = None if found is None else found["name"]
    if isinstance(name, str) and name.endswith(SUFFIXES) and _changes(name) is not None:
        raise ValueError(
            f"{path}: name must be a named scene or a building file, got the scene file {name!r}"
        )
    return found


def _changes(path: str) -> dict[str, Any] | None:
    try:
        found = _parsed(path)
    except (OSError, ValueError, RecursionError):
        # The reader of building files describes the error.
        return None
    if not isinstance(found, Mapping) or "name" not in found or _is_building(found):
        return None
    return dict(found)


def _is_building(found: Mapping[str, Any]) -> bool:
    """Return whether a file has a table that only building files have."""
    return any(isinstance(found.get(key), dict | list) for key in ("body", "region", "zones"))


def _parsed(path: str | Path) -> Any:
    if not str(path).endswith(SUFFIXES):
        raise ValueError(f"scenes must come from a .json or .toml file, got {str(path)!r:.80}")
    text = Path(path).read_text(encoding="utf-8")
    try:
        return json.loads(text) if str(path).endswith(".json") else tomllib.loads(text)
    except (json.JSONDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path}: {error}") from error

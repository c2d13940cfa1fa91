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
    """A family from a file: what `scenes=` of an environment takes.

    Parameters
    ----------
    path
        JSON: a list of scenes, or one. TOML: one, or ``scenes = [...]`` alone. A scene is a name
        or a table of overrides with the key ``name``, whose values may be laws; see
        `rbl_gym.worlds.families.SceneFamily`.

    Raises
    ------
    ValueError
        On a file that cannot be read, naming line and column, or holds no scenes.
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
        raise ValueError(f"{path} holds no scenes")
    return found


def read_scene(name: str) -> Any:
    """What `scene=` of an environment takes: a name as it is, a file with overrides as a dict.

    Parameters
    ----------
    name
        Of a scene, or of a JSON or TOML file with a table of overrides and the key ``name``.
        Files without that key are left to the environment.
    """
    if not name.endswith(SUFFIXES):
        return name
    found = _parsed(name)
    if isinstance(found, Mapping) and "name" in found:
        return dict(found)
    if name.endswith(".json"):
        raise ValueError(f"{name} must hold a table with the key 'name', got {found!r:.80}")
    return name


def _parsed(path: str | Path) -> Any:
    if not str(path).endswith(SUFFIXES):
        raise ValueError(f"scenes must come from a .json or .toml file, got {str(path)!r:.80}")
    text = Path(path).read_text(encoding="utf-8")
    try:
        return json.loads(text) if str(path).endswith(".json") else tomllib.loads(text)
    except (json.JSONDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path}: {error}") from error

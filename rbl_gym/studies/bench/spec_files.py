"""Read scenes of the benchmark from names and files: named scenes, changed scenes, recordings.

`SENSED` has further scenes: named ones with other sensors, or with a survey.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rbl_gym.studies.bench import leaderboard
from rbl_gym.studies.bench.recordings import FILES

__all__ = ["SENSED", "read_spec", "scene_specs"]

# Named scenes with an inertial sensor, with an unknown range offset of every tag (time
# differences), and with anchors whose surveyed positions are 5 cm off on every axis.
SENSED: dict[str, dict[str, Any]] = {
    "uwb_room-imu": {"name": "uwb_room", "inertial": "consumer"},
    "drone_yard-imu": {"name": "drone_yard", "inertial": "consumer"},
    "uwb_room-tdoa": {"name": "uwb_room", "links": {"offset": "tag"}},
    "uwb_room-survey": {"name": "uwb_room", "survey_std_m": 0.05},
}


def scene_specs(names: Sequence[str]) -> dict[str, str | dict[str, Any]]:
    """Return scenes by label, checked for errors, for `leaderboard.tasks`.

    Parameters
    ----------
    names
        Names of scenes or of `SENSED`, or ``.toml`` and ``.json`` files (`read_spec`), whose label
        is the file name without its suffix.

    Raises
    ------
    ValueError
        If two scenes have the same label, or a file describes neither a scene nor a recording.
    """
    specs: dict[str, str | dict[str, Any]] = {}
    for name in names:
        path = Path(name)
        label = path.stem if path.suffix in (".toml", ".json") else name
        if label in specs:
            raise ValueError(f"--scenes: two are named {label!r}: rename a file")
        if label == name:
            specs[label] = dict(SENSED[name]) if name in SENSED else name
            continue
        specs[label] = read_spec(path)
        try:
            leaderboard.digest_of(specs[label])
        except (TypeError, ValueError) as error:
            at = "" if str(error).startswith(f"{path}:") else f"{path}: "
            raise ValueError(f"{at}{error}") from error
    return specs


def read_spec(path: Path) -> dict[str, Any]:
    """Return the mapping of a scene (`scenes.get`) or a recording; paths are relative to the file.

    Raises
    ------
    ValueError
        If the file describes neither; the message names it.
    """
    try:
        text = path.read_text(encoding="utf-8")
        spec = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from error
    if isinstance(spec, dict) and "body" in spec:
        return {"name": str(path)}  # a building file, which `scenes.get` reads
    if not isinstance(spec, dict) or ("name" in spec) == ("ranges" in spec):
        raise ValueError(
            f"{path}: must have either the key 'name' (changes of a scene) or the key 'ranges' (a "
            "recording), or be a building file"
        )
    for key in FILES if "ranges" in spec else ():
        if not isinstance(spec.get(key, ""), str):
            raise ValueError(f"{path}: {key} must be the name of a file, got {spec[key]!r:.80}")
        if key in spec:
            spec[key] = str(path.parent / spec[key])
    return spec

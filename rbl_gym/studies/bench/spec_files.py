"""Scenes of the benchmark from names and files: a named one, one with changes, a recording.

Besides the named scenes the benchmark has `SENSED`: the same with other sensors, or a survey.
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

# Named scenes with an inertial sensor, with an unknown offset of every tag's ranges (time
# differences), and with anchors whose surveyed places are 5 cm off on every axis.
SENSED: dict[str, dict[str, Any]] = {
    "uwb_room-imu": {"name": "uwb_room", "inertial": "consumer"},
    "drone_yard-imu": {"name": "drone_yard", "inertial": "consumer"},
    "uwb_room-tdoa": {"name": "uwb_room", "links": {"offset": "tag"}},
    "uwb_room-survey": {"name": "uwb_room", "survey_std_m": 0.05},
}


def scene_specs(names: Sequence[str]) -> dict[str, str | dict[str, Any]]:
    """Scenes by label, each checked to be readable: what `leaderboard.tasks` takes.

    Parameters
    ----------
    names
        Names of scenes or of `SENSED`, or of files ``.toml`` and ``.json`` (`read_spec`), which
        have the name of the file without its ending as label.

    Raises
    ------
    ValueError
        If two have one label, or a file does not describe a scene or a recording.
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
            raise ValueError(f"{path}: {error}") from error
    return specs


def read_spec(path: Path) -> dict[str, Any]:
    """A mapping for `scenes.get`, or one of a recording, its files found beside this one.

    Raises
    ------
    ValueError
        If the file is neither; the message names it.
    """
    try:
        text = path.read_text(encoding="utf-8")
        spec = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from error
    if not isinstance(spec, dict) or ("name" in spec) == ("ranges" in spec):
        raise ValueError(
            f"{path}: must have the key 'name' of a scene, or the files of a recording"
        )
    for key in FILES if "ranges" in spec else ():
        if not isinstance(spec.get(key, ""), str):
            raise ValueError(f"{path}: {key} must be the name of a file, got {spec[key]!r:.80}")
        if key in spec:
            spec[key] = str(path.parent / spec[key])
    return spec

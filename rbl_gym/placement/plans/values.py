"""Values of an entry of a building file: of the shape, else of the layer, else the defaults."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rbl_gym.placement.file_keys import MATERIALS
from rbl_gym.placement.plans.drawing import Shape
from rbl_gym.placement.plans.parts import rounded
from rbl_gym.placement.plans.uses import TEXTS, Use, number

# Names of the keys in other programs.
_PROPERTIES = {
    "height": "high_m",
    "min_height": "low_m",
    "base": "low_m",
    "thickness": "thickness_m",
}


def values_of(
    path: str, shape: Shape | None, use: Use, keys: Iterable[str], usual: dict[str, Any]
) -> dict[str, Any]:
    """Return the values of an entry.

    Parameters
    ----------
    path
        The drawing, for errors.
    shape, use
        The shape, or None, and the use of its layer.
    keys, usual
        The keys of the entry, and their defaults.
    """
    said = {}
    for key, value in ({} if shape is None else shape.properties).items():
        key = _PROPERTIES.get(key, key)
        if key in keys and value is not None:
            said[key] = value if key in TEXTS else number(f"{use.layer}: {key}", value)
    if "name" in said:
        name = " ".join(str(said.pop("name")).split())
        said |= {"name": name} if name and name.isprintable() else {}
    values = usual | {key: use.values[key] for key in use.values if key in keys} | said
    if "material" in values and values["material"] not in MATERIALS:
        other = values.pop("material")
        if "information" not in values:
            raise ValueError(
                f"{path}: layer {use.layer}: material must be one of "
                f"{', '.join(MATERIALS)}, got {other!r:.80}; for another material give "
                "information=SHARE, the share (0 to 1) that remains behind it"
            )
    elif "material" in values and "information" in values:
        values.pop("information" if "material" in said else "material")
    return {
        key: rounded(values[key]) if isinstance(values[key], float) else values[key]
        for key in keys
        if key in values
    }


def mount_values(
    path: str, shape: Shape, use: Use, keys: Iterable[str], usual: dict[str, Any]
) -> dict[str, Any]:
    """Return `values_of` for a mount on a wall or obstacle of the same layer.

    The heights of the wall do not replace those of the mount; they only limit them.

    Parameters
    ----------
    path, shape, use, keys, usual
        As in `values_of`; the shape is the wall, the use that of the mount.
    """
    own = shape.properties
    rest = {key: own[key] for key in own if _PROPERTIES.get(key) not in ("low_m", "high_m")}
    values = values_of(path, shape._replace(properties=rest), use, keys, usual)
    wall = values_of(path, shape, Use("walls", use.layer, {}), ("low_m", "high_m"), {})
    for key, limit in (("low_m", max), ("high_m", min)):
        if key in wall and key in values and key not in own:
            values[key] = limit(values[key], wall[key])
    return values

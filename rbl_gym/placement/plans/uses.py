"""Parse the uses of layers on the command line, and define the keys of their entries."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from rbl_gym.checks import did_you_mean
from rbl_gym.placement.building import ATTITUDES
from rbl_gym.placement.file_keys import FORMAT, MATERIALS

__all__ = ["KEYS", "KINDS", "Use", "parse_use"]

# Kinds of use, with the allowed keys of their entries: those of the file, and `side_by_side_m`, the
# maximum distance of the two lines of a wall.
KEYS = {
    "walls": (
        "name",
        "material",
        "information",
        "thickness_m",
        "low_m",
        "high_m",
        "side_by_side_m",
    ),
    "obstacles": ("name", "material", "information", "low_m", "high_m"),
    "zones": (
        *("name", "low_m", "high_m", "weight", "attitude"),
        *("position_m", "height_m", "heading_deg", "share"),
    ),
    "mounts": ("kind", "name", "low_m", "high_m", "height_m", "side", "cost"),
    "forbidden": ("low_m", "high_m"),
    "fixed": ("height_m",),
}
KINDS = tuple(KEYS)
TEXTS = {"material", "name", "attitude", "kind", "side"}
_CHOICES = {
    "attitude": ATTITUDES,
    "kind": tuple(form.value for form in FORMAT["mounts"].forms),
    "side": ("left", "right", "both"),
}


class Use(NamedTuple):
    """Use of the layers with a name: one of `KINDS`, with the keys of its entries."""

    kind: str
    layer: str
    values: dict[str, Any]


def parse_use(kind: str, text: str) -> Use:
    """Parse ``LAYER,KEY=VALUE,...``; `*` in the name of a layer matches any characters.

    Raises
    ------
    ValueError
        If entries of this kind have no such key, or the key no such value.
    """
    layer, *parts = (part.strip() for part in text.split(","))
    if not layer or "=" in layer:
        raise ValueError(f"--{kind} must be LAYER,KEY=VALUE,..., got {text!r}")
    values: dict[str, Any] = {}
    for part in parts:
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or key in values:
            raise ValueError(f"--{kind} {layer}: must be KEY=VALUE, each key once, got {part!r}")
        if key not in KEYS[kind]:
            raise ValueError(
                f"--{kind} {layer}: unknown key {key!r}; the keys are {', '.join(KEYS[kind])}"
                f"{did_you_mean(key, KEYS[kind])}"
            )
        if value not in _CHOICES.get(key, (value,)):
            raise ValueError(
                f"--{kind} {layer}: {key} must be one of {', '.join(_CHOICES[key])}, got {value!r}"
            )
        values[key] = value if key in TEXTS else number(f"--{kind} {layer}: {key}", value)
    if (
        values.get("material", next(iter(MATERIALS))) not in MATERIALS
        and "information" not in values
    ):
        raise ValueError(
            f"--{kind} {layer}: material must be one of {', '.join(MATERIALS)}, got "
            f"{values['material']!r}; for another material give information=SHARE, the share (0 to "
            "1) that remains behind it"
        )
    return Use(kind, layer, values)


def number(name: str, value: Any) -> float:
    """Return a finite number; raise ValueError otherwise."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name} must be a number, got {value!r:.80}")
    return number

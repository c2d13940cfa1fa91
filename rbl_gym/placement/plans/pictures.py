"""Read a picture of a floor plan: its size in metres, and a first building file for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym.geometry.polygons import rectangle
from rbl_gym.placement.plans.layers import DEVICES, ZONE_M, Building
from rbl_gym.placement.plans.parts import points_of

__all__ = ["backdrop", "of_picture"]


def backdrop(
    path: str, metres_per_pixel: float, origin: tuple[float, float] = (0.0, 0.0)
) -> dict[str, Any]:
    """Return the table [plan] of a picture.

    Parameters
    ----------
    path
        Path of a PNG or JPEG file.
    metres_per_pixel
        Scale of the picture.
    origin
        Position of the lower left corner, metres.

    Raises
    ------
    ValueError
        If the file is not a picture; the message names it.
    """
    pixels(path)
    if not 0 < metres_per_pixel < np.inf:
        raise ValueError(f"metres_per_pixel must be positive, got {metres_per_pixel!r}")
    return {"image": path, "metres_per_pixel": metres_per_pixel, "origin": list(origin)}


def of_picture(plan: dict[str, Any], height_m: float = 3.0, n_anchors: int = 8) -> Building:
    """Return tables of a building file when only the picture is known, to be edited.

    The rectangle of the picture without its margins is one zone. Anchors may be on the ceiling
    above it.

    Parameters
    ----------
    plan
        Table from `backdrop`.
    height_m, n_anchors
        As in `layers.building`.
    """
    path, metres_per_pixel = plan["image"], plan["metres_per_pixel"]
    low = np.array(plan["origin"])
    size = np.array(pixels(path)) * metres_per_pixel
    outline = points_of(rectangle(low, low + size))
    inner = points_of(rectangle(low + 0.05 * size, low + 0.95 * size))
    tables = {
        "name": Path(path).stem,
        "anchors": {"number": n_anchors},
        "zones": [
            {
                "#": "a picture has no zones: this one is the whole picture without its margins",
                "name": "plan",
                "polygon": inner,
                **dict(zip(("low_m", "high_m"), ZONE_M, strict=True)),
            }
        ],
        "mounts": [
            {
                "#": 'the ceiling above the picture; walls: kind = "wall", line = [[x, y], ...]',
                "kind": "ceiling",
                "polygon": outline,
                "height_m": height_m,
            }
        ],
        "plan": plan,
        **DEVICES,
    }
    said = [
        f"the picture is {size[0]:.4g} x {size[1]:.4g} m at {metres_per_pixel:g} m a pixel; its "
        f"lower left corner is at ({low[0]:g}, {low[1]:g})",
        "a picture has no walls: write them as [[walls]] with line = [[x, y], ...]; rbl-gym plan "
        "FILE --plot F draws the file over the picture with a grid of metres",
    ]
    return Building(tables, {}, said)


def pixels(path: str) -> tuple[int, int]:
    """Return width and height in pixels."""
    from PIL import Image, UnidentifiedImageError

    with Path(path).open("rb") as file:
        try:
            with Image.open(file) as image:
                return image.size
        except (UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError) as error:
            why = "unknown format" if isinstance(error, UnidentifiedImageError) else error
            raise ValueError(f"{path}: not a picture that can be read: {why}") from error

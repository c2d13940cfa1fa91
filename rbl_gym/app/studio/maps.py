"""The map of a slice: what the Cramer-Rao bound promises there, and its picture."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from rbl_gym.app.studio.state import State, plane
from rbl_gym.checks import FloatArray
from rbl_gym.studies.placing.accuracy import accuracy
from rbl_gym.studies.placing.judging import limits_of
from rbl_gym.studies.placing.requirements import Errors, relative_errors

# Cells of a map while an anchor is dragged, and when it is let go; links of so many anchors.
COARSE, REFINED, _ANCHORS = 800, 3200, 8
# Cells of a map, at least.
_LEAST_CELLS = 200
# A map that hardly varies must not look as if it did: its colours span at least this ratio.
_LEAST_CONTRAST = 1.3
# Colours are kept as long as the values at their ends change by less than this factor.
_KEPT = 1.5
# Pixels along a cell; the browser smooths the picture too. Shades of the colours.
_ZOOM, _SHADES = 6, 256
# Of the map, up to 255: what lies below it is seen through it.
_OPACITY = 215
# Within and beyond a requirement (Okabe and Ito): told apart by everyone.
WITHIN, BEYOND = (86, 180, 233), (213, 94, 0)
# Green for small errors over yellow to red for large ones, light enough for black lines.
_COLOURS = np.array(
    [
        (38, 130, 142), (66, 173, 141), (140, 205, 130), (222, 227, 140),
        (253, 212, 110), (250, 160, 85), (226, 95, 75),
    ],
    float,
)  # fmt: skip


class Quantity(NamedTuple):
    """What a map can show: a field of `Errors`, its name, its unit, and metres or radians to it."""

    field: str
    name: str
    unit: str
    scale: float = 1.0


QUANTITIES: dict[str, Quantity] = {
    "position": Quantity("position", "Position error", "m"),
    "horizontal": Quantity("horizontal", "Horizontal position error", "m"),
    "height": Quantity("height", "Height error", "m"),
    "heading": Quantity("heading", "Heading error", "deg", 180 / math.pi),
    "rotation": Quantity("rotation", "Orientation error", "deg", 180 / math.pi),
    "requirement": Quantity("", "Error over its limit", ""),
}


class SliceMap(NamedTuple):
    """Values on a plane.

    Attributes
    ----------
    values
        (rows, columns), NaN off the zones and inside of obstacles. In the unit of the quantity;
        of ``"requirement"`` the error over its limit, the largest: within where at most 1.
    low, high
        Corners (3,) of the plane, metres.
    up
        The axis of the rows; that of the columns is x.
    quantity
        What is shown.
    limits
        Between which values the colours run.
    """

    values: FloatArray
    low: FloatArray
    high: FloatArray
    up: int
    quantity: Quantity
    limits: tuple[float, float]

    def is_like(self, other: SliceMap) -> bool:
        """Whether both show the same on the same plane."""
        same = self.quantity is other.quantity and self.up == other.up
        return same and bool((self.low == other.low).all())

    def beside(self, before: SliceMap) -> SliceMap:
        """In the colours of the map before, where that is like it and its values fit them."""
        fits = all(
            1 / _KEPT < new / old < _KEPT
            for new, old in zip(self.limits, before.limits, strict=True)
            if old > 0
        )
        return self._replace(limits=before.limits) if fits and self.is_like(before) else self


def own_limits(values: FloatArray, quantity: Quantity) -> tuple[float, float]:
    """Between which values the colours of a map run: most of its cells lie there."""
    if quantity is QUANTITIES["requirement"] or not np.isfinite(values).any():
        return 0.0, 2.0
    low, high = np.nanquantile(values, (0.02, 0.98)).tolist()
    middle = math.sqrt(low * high)
    return min(low, middle / _LEAST_CONTRAST**0.5), max(high, middle * _LEAST_CONTRAST**0.5)


def shape_of(extent: FloatArray, cells: int) -> tuple[int, int]:
    """Rows and columns of about so many cells over an extent (2,): columns, rows."""
    width, height = np.maximum(extent, 1e-9)
    columns = math.sqrt(cells * width / height)
    # A long slice still has some rows.
    columns = min(max(columns, 4.0), cells / 4)
    return max(1, round(cells / columns)), max(1, round(columns))


def slice_map(state: State, cells: int = COARSE, before: SliceMap | None = None) -> SliceMap:
    """The map of the slice of a state.

    Parameters
    ----------
    state
        Gives the problem, the layout and the slice.
    cells
        About how many there are, with few anchors; with many there are fewer.
    before
        A map whose colours are kept where it is like this one, whatever its values; None: its own.
    """
    problem, at = state.world.problem, state.slice
    low, high = plane(state)
    cells = max(_LEAST_CELLS, round(cells * min(1.0, _ANCHORS / len(state.anchors))))
    rows, columns = shape_of((high - low)[[0, at.up]], cells)
    places = np.empty((rows, columns, 3))
    places[...] = low
    for axis, count, along in ((0, columns, 1), (at.up, rows, 0)):
        steps = (np.arange(count) + 0.5) / count * (high - low)[axis]
        places[..., axis] += np.expand_dims(steps, axis=1 - along)
    free = ~problem.obstacles.contain(places)
    values = np.full((rows, columns), np.nan)
    for zone in problem.zones:
        here = free & zone.contains(places) & np.isnan(values)
        if at.quantity == "requirement" and not zone.has_requirement:
            continue
        if here.any():
            errors = accuracy(problem, state.anchors, places[here], zone)
            values[here] = _shown(errors, at.quantity, zone)
    quantity = QUANTITIES[at.quantity]
    found = SliceMap(values, low, high, at.up, quantity, own_limits(values, quantity))
    if before is not None and found.is_like(before):
        return found._replace(limits=before.limits)
    return found


def _shown(errors: Errors, quantity: str, zone: object) -> FloatArray:
    if quantity == "requirement":
        return relative_errors(errors, limits_of(zone))  # pyright: ignore[reportArgumentType]
    shown = QUANTITIES[quantity]
    return shown.scale * getattr(errors, shown.field)


def picture(found: SliceMap) -> np.ndarray:
    """The map as pixels (height, width, 4), the upper row first; clear where there is no value."""
    values = found.values[::-1]
    free = np.isfinite(values)
    # Colours do not run into the gaps.
    if free.any() and not free.all():
        nearest: Any = ndimage.distance_transform_edt(
            ~free, return_distances=False, return_indices=True
        )
        values = values[tuple(nearest)]
    fine, zoom = _enlarged(np.nan_to_num(values), _ZOOM), _ZOOM
    shown = np.empty((*fine.shape, 4), np.uint8)
    if found.quantity is QUANTITIES["requirement"]:
        shown[..., :3] = np.where((fine <= 1)[..., None], WITHIN, BEYOND)
    else:
        shown[..., :3] = colours(fine, found.limits)
    shown[..., 3] = np.where(np.repeat(np.repeat(free, zoom, 0), zoom, 1), _OPACITY, 0)
    return shown


def colours(values: FloatArray, limits: tuple[float, float]) -> np.ndarray:
    """Colours (..., 3) of values between limits, by their logarithms."""
    low, high = limits
    span = math.log(high / low) if high > low > 0 else 1.0
    share = np.log(np.maximum(values, 1e-300) / max(low, 1e-300)) / span
    return _shades()[(share.clip(0.0, 1.0) * (_SHADES - 1)).astype(np.intp)]


@functools.cache
def _shades() -> np.ndarray:
    """The colours (256, 3) from small to large."""
    at, known = np.linspace(0, 1, _SHADES), np.linspace(0, 1, len(_COLOURS))
    columns = [np.interp(at, known, column) for column in _COLOURS.T]
    return np.round(np.stack(columns, axis=-1)).astype(np.uint8)


def _enlarged(values: FloatArray, zoom: int) -> FloatArray:
    """Every cell as zoom x zoom pixels, linear between the middles of cells."""
    for axis in (0, 1):
        count = values.shape[axis]
        at = ((np.arange(count * zoom) + 0.5) / zoom - 0.5).clip(0, count - 1)
        below = np.minimum(at.astype(int), max(count - 2, 0))
        above = np.minimum(below + 1, count - 1)
        part = np.expand_dims(at - below, axis=1 - axis)
        values = (1 - part) * values.take(below, axis) + part * values.take(above, axis)
    return values


def css_gradient() -> str:
    """The colours from small to large, as a background of a page."""
    stops = ", ".join(f"rgb({r:.0f},{g:.0f},{b:.0f})" for r, g, b in _COLOURS)
    return f"linear-gradient(to right, {stops})"

"""The map of the Cramer-Rao bound on a slice, and its picture."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from rbl_gym.app.place_shapes import enlarged, filled
from rbl_gym.app.studio.state import State, plane
from rbl_gym.checks import FloatArray
from rbl_gym.studies.placing.accuracy import accuracy
from rbl_gym.studies.placing.judging import limits_of
from rbl_gym.studies.placing.requirements import Errors, relative_errors

# Cells of a map while an anchor is dragged, and after; links for this number of anchors.
COARSE, REFINED, _ANCHORS = 800, 3200, 8
# Minimum number of cells of a map.
_LEAST_CELLS = 200
# Minimum ratio of the colour limits, so that a nearly constant map looks constant.
_LEAST_CONTRAST = 1.3
# Colour limits are kept while the values at their ends change by less than this factor.
_KEPT = 1.5
# Pixels along a cell, smoothed by the browser as well; number of colours.
_ZOOM, _SHADES = 6, 256
# Opacity of the map, up to 255: objects below it stay visible.
_OPACITY = 215
# Colours within and beyond a requirement (Okabe and Ito), safe for colour-blind readers.
WITHIN, BEYOND = (86, 180, 233), (213, 94, 0)
# Green for small errors, yellow, then red for large ones; light enough for black lines.
_COLOURS = np.array(
    [
        (38, 130, 142), (66, 173, 141), (140, 205, 130), (222, 227, 140),
        (253, 212, 110), (250, 160, 85), (226, 95, 75),
    ],
    float,
)  # fmt: skip


class Quantity(NamedTuple):
    """A quantity of the map: a field of `Errors`, its name, its unit and the factor from SI."""

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
    """Values (rows, columns) on a plane with two corners (3,), and its colour limits.

    Values are in the unit of the quantity, NaN outside the zones and inside obstacles. For
    ``"requirement"`` they are the largest ratio of an error to its limit; at most 1 meets the
    requirement. `up` is the axis of the rows; the axis of the columns is x.
    """

    values: FloatArray
    low: FloatArray
    high: FloatArray
    up: int
    quantity: Quantity
    limits: tuple[float, float]

    def is_like(self, other: SliceMap) -> bool:
        """Return whether both maps show the same quantity on the same plane."""
        same = self.quantity is other.quantity and self.up == other.up
        return same and bool((self.low == other.low).all())

    def beside(self, before: SliceMap) -> SliceMap:
        """Return the map with the colour limits of a previous map, if they still fit."""
        fits = all(
            1 / _KEPT < new / old < _KEPT
            for new, old in zip(self.limits, before.limits, strict=True)
            if old > 0
        )
        return self._replace(limits=before.limits) if fits and self.is_like(before) else self


def own_limits(values: FloatArray, quantity: Quantity) -> tuple[float, float]:
    """Return the colour limits of a map; most of its cells lie between them."""
    if quantity is QUANTITIES["requirement"] or not np.isfinite(values).any():
        return 0.0, 2.0
    low, high = np.nanquantile(values, (0.02, 0.98)).tolist()
    middle = math.sqrt(low * high)
    return min(low, middle / _LEAST_CONTRAST**0.5), max(high, middle * _LEAST_CONTRAST**0.5)


def shape_of(extent: FloatArray, cells: int) -> tuple[int, int]:
    """Return columns and rows of about `cells` cells over an extent (2,)."""
    width, height = np.maximum(extent, 1e-9)
    columns = math.sqrt(cells * width / height)
    # A long slice keeps a minimum number of rows.
    columns = min(max(columns, 4.0), cells / 4)
    return max(1, round(cells / columns)), max(1, round(columns))


def slice_map(state: State, cells: int = COARSE, before: SliceMap | None = None) -> SliceMap:
    """Return the map of the slice of a state, with about `cells` cells; fewer for many anchors.

    The colour limits of the map `before` are kept if they still fit.
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
        return relative_errors(errors, limits_of(zone))  # pyrefly: ignore[bad-argument-type]
    shown = QUANTITIES[quantity]
    return shown.scale * getattr(errors, shown.field)


def picture(found: SliceMap) -> np.ndarray:
    """Return pixels (height, width, 4), the upper row first; transparent if there is no value."""
    # Fill the gaps first, so that colours do not run into them.
    values, free = filled(found.values[::-1])
    fine, zoom = enlarged(np.nan_to_num(values), _ZOOM), _ZOOM
    shown = np.empty((*fine.shape, 4), np.uint8)
    if found.quantity is QUANTITIES["requirement"]:
        shown[..., :3] = np.where((fine <= 1)[..., None], WITHIN, BEYOND)
    else:
        shown[..., :3] = colours(fine, found.limits)
    shown[..., 3] = np.where(np.repeat(np.repeat(free, zoom, 0), zoom, 1), _OPACITY, 0)
    return shown


def colours(values: FloatArray, limits: tuple[float, float]) -> np.ndarray:
    """Return the colours (..., 3) of values between limits, on a logarithmic scale."""
    low, high = limits
    span = math.log(high / low) if high > low > 0 else 1.0
    share = np.log(np.maximum(values, 1e-300) / max(low, 1e-300)) / span
    return _shades()[(share.clip(0.0, 1.0) * (_SHADES - 1)).astype(np.intp)]


@functools.cache
def _shades() -> np.ndarray:
    """Return the colours (256, 3) from small to large."""
    at, known = np.linspace(0, 1, _SHADES), np.linspace(0, 1, len(_COLOURS))
    columns = [np.interp(at, known, column) for column in _COLOURS.T]
    return np.round(np.stack(columns, axis=-1)).astype(np.uint8)


def css_gradient() -> str:
    """Return the colour scale from small to large as a CSS background."""
    stops = ", ".join(f"rgb({r:.0f},{g:.0f},{b:.0f})" for r, g, b in _COLOURS)
    return f"linear-gradient(to right, {stops})"

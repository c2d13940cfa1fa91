"""Points of a box, and of the walls and ceiling of a room.

The textbook forms are in `rbl_gym.geometry.regions`.
"""

from __future__ import annotations

from typing import Any

from rbl_gym.kernels.jit import gufunc, helper

# A direction this short is undefined.
_NOWHERE = 1e-3


@helper
def _cut(value: float, low: float, high: float) -> float:
    """Return the value within limits; NaN stays NaN."""
    if value < low:
        return low
    return high if value > high else value


@gufunc("(d),(d),(d)->(d)")
def project_to_box(point: Any, low: Any, high: Any, legal: Any) -> None:
    """Compute the nearest point of a box."""
    for i in range(3):
        legal[i] = _cut(point[i], low[i], high[i])


@gufunc("(d),(d),(d)->(d)")
def place_in_box(action: Any, middle: Any, half: Any, legal: Any) -> None:
    """Compute the point of an action, [-1, 1]^3 being the box."""
    for i in range(3):
        legal[i] = middle[i] + _cut(action[i], -1.0, 1.0) * half[i]


@helper
def _project(point: Any, low: Any, high: Any, legal: Any) -> None:
    """Compute the nearest point of the four walls and the ceiling."""
    away = 0.0
    for i in range(3):
        legal[i] = _cut(point[i], low[i], high[i])
        away += (point[i] - legal[i]) ** 2
    axis, place, least = 0, low[0], -1.0
    for i in range(3):
        for side in range(2):
            if i == 2 and side == 0:
                continue
            value = high[i] if side else low[i]
            square = away - (point[i] - legal[i]) ** 2 + (point[i] - value) ** 2
            if square < least or least < 0:
                axis, place, least = i, value, square
    legal[axis] = place


@gufunc("(d),(d),(d)->(d)")
def project(point: Any, low: Any, high: Any, legal: Any) -> None:
    """Compute the nearest legal point."""
    _project(point, low, high, legal)


@gufunc("(d),(d),(d)->(d)")
def place(action: Any, low: Any, high: Any, legal: Any) -> None:
    """Compute where the ray from the room's centre along an action meets a wall or the ceiling."""
    reach = _cut(action[2], -1.0, 1.0)
    for i in range(2):
        reach = max(reach, abs(_cut(action[i], -1.0, 1.0)))
    for i in range(3):
        part = _cut(_cut(action[i], -1.0, 1.0) / max(reach, _NOWHERE), -1.0, 1.0)
        legal[i] = 0.5 * (low[i] + high[i]) + part * (0.5 * (high[i] - low[i]))
    if reach < _NOWHERE:
        point = legal.copy()
        _project(point, low, high, legal)

"""Boxes, bodies and ellipsoids in plotly's 3-D scenes."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go

from rbl_gym.checks import FloatArray
from rbl_gym.rendering.drawing import RADIUS_95, box_corners, box_edges, gapped

# The twelve triangles of a box, by corner.
_TRIANGLES = (
    (0, 0, 4, 4, 0, 0, 2, 2, 0, 0, 1, 1),
    (1, 3, 5, 7, 1, 5, 3, 7, 2, 6, 3, 7),
    (3, 2, 7, 6, 5, 4, 7, 6, 6, 4, 7, 5),
)
# Latitudes and longitudes of an ellipsoid's net.
_LATITUDES, _LONGITUDES = 9, 16


def numbers(values: FloatArray, digits: int = 5) -> Any:
    """Nested lists to a few digits, None where there is no number: pages stay small."""
    if values.ndim > 1:
        return [numbers(row, digits) for row in values]
    return [float(f"{x:.{digits}g}") if np.isfinite(x) else None for x in values]


def xyz(points: FloatArray) -> dict[str, list[float | None]]:
    """Points (K, 3) as plotly's coordinates; NaN is a gap."""
    return dict(zip("xyz", numbers(points.T), strict=True))


def box(low: Any, high: Any, **style: Any) -> go.Scatter3d:
    """The edges of a box as one line."""
    return go.Scatter3d(
        **xyz(gapped(box_edges(low, high))), mode="lines", hoverinfo="skip", **style
    )


def solid(low: Any, high: Any, **style: Any) -> go.Mesh3d:
    """A box with faces."""
    i, j, k = _TRIANGLES
    return go.Mesh3d(
        **xyz(box_corners(low, high)),
        i=i,
        j=j,
        k=k,
        color="#6c757d",
        opacity=0.55,
        flatshading=True,
        hoverinfo="skip",
        **style,
    )


def ellipsoid(centre: FloatArray, covariance: FloatArray) -> dict[str, list[float | None]]:
    """Coordinates of the 95 % region of a Gaussian, on the net of `net`."""
    values, vectors = np.linalg.eigh(covariance)
    height = np.linspace(-np.pi / 2, np.pi / 2, _LATITUDES)[:, None]
    around = np.linspace(0, 2 * np.pi, _LONGITUDES, endpoint=False)
    ball = np.stack(
        np.broadcast_arrays(
            np.cos(height) * np.cos(around), np.cos(height) * np.sin(around), np.sin(height)
        ),
        axis=-1,
    ).reshape(-1, 3)
    half = RADIUS_95 * vectors * np.sqrt(np.maximum(values, 0.0))
    return xyz(centre + ball @ half.T)


def net() -> dict[str, list[int]]:
    """Triangles of an ellipsoid's net."""
    rows = np.arange(_LATITUDES - 1)[:, None] * _LONGITUDES
    along = np.arange(_LONGITUDES)
    next_ = (along + 1) % _LONGITUDES
    a, b, c, d = rows + along, rows + next_, rows + _LONGITUDES + along, rows + _LONGITUDES + next_
    triangles = [
        np.concatenate([part.ravel() for part in corner]) for corner in ((a, b), (b, d), (c, c))
    ]
    return dict(zip("ijk", (corner.tolist() for corner in triangles), strict=True))

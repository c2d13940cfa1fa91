"""Prisms, bodies and ellipsoids in plotly's 3-D scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.polygons import prism_mesh
from rbl_gym.rendering.drawing import RADIUS_95, gapped

# Latitudes and longitudes of an ellipsoid's mesh.
_LATITUDES, _LONGITUDES = 9, 16


def numbers(values: FloatArray, digits: int = 5) -> Any:
    """Return nested lists rounded to a few digits, None for missing numbers: pages stay small."""
    if values.ndim > 1:
        return [numbers(row, digits) for row in values]
    return [float(f"{x:.{digits}g}") if np.isfinite(x) else None for x in values]


def xyz(points: FloatArray) -> dict[str, list[float | None]]:
    """Return points (K, 3) as plotly's coordinates; NaN is a gap."""
    return dict(zip("xyz", numbers(points.T), strict=True))


def lines(segments: FloatArray, **style: Any) -> go.Scatter3d:
    """Return segments (S, 2, 3) as one line."""
    return go.Scatter3d(**xyz(gapped(segments)), mode="lines", hoverinfo="skip", **style)


def prisms(found: Sequence[tuple[FloatArray, float, float]], **style: Any) -> go.Mesh3d:
    """Return prisms, each with corners (V, 2) and two heights, as one mesh with faces."""
    points, triangles = prism_mesh(*zip(*found, strict=True))
    i, j, k = triangles.T.tolist()
    return go.Mesh3d(
        **xyz(points),
        i=i,
        j=j,
        k=k,
        color="#6c757d",
        opacity=0.55,
        flatshading=True,
        hoverinfo="skip",
        showlegend=True,
        **style,
    )


def ellipsoid(centre: FloatArray, covariance: FloatArray) -> dict[str, list[float | None]]:
    """Return coordinates of the 95 % region of a Gaussian, on the mesh of `net`."""
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
    """Return the triangles of an ellipsoid's mesh."""
    rows = np.arange(_LATITUDES - 1)[:, None] * _LONGITUDES
    along = np.arange(_LONGITUDES)
    next_ = (along + 1) % _LONGITUDES
    a, b, c, d = rows + along, rows + next_, rows + _LONGITUDES + along, rows + _LONGITUDES + next_
    triangles = [
        np.concatenate([part.ravel() for part in corner]) for corner in ((a, b), (b, d), (c, c))
    ]
    return dict(zip("ijk", (corner.tolist() for corner in triangles), strict=True))

"""Prisms, bodies and ellipsoids in plotly's 3-D scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.polygons import ears
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


def prism_edges(corners: FloatArray, low: float, high: float) -> FloatArray:
    """Return the edges (3 V, 2, 3) of a prism over corners (V, 2)."""
    bottom, top = (np.insert(corners, 2, z, axis=1) for z in (low, high))
    rings = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in (bottom, top)]
    return np.concatenate([*rings, np.stack([bottom, top], axis=1)])


def prisms(found: Sequence[tuple[FloatArray, float, float]], **style: Any) -> go.Mesh3d:
    """Return prisms, each with corners (V, 2) and two heights, as one mesh with faces."""
    points, triangles, count = [], [], 0
    for corners, low, high in found:
        size = len(corners)
        points += [np.insert(corners, 2, z, axis=1) for z in (low, high)]
        here = np.arange(size)
        there = (here + 1) % size
        caps = ears(corners)
        faces = [
            caps,
            caps + size,
            np.stack([here, there, there + size], axis=1),
            np.stack([here, there + size, here + size], axis=1),
        ]
        triangles.append(np.concatenate(faces) + count)
        count += 2 * size
    i, j, k = np.concatenate(triangles).T.tolist()
    return go.Mesh3d(
        **xyz(np.concatenate(points)),
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

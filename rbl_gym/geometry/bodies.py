"""Define tag layouts of rigid bodies: arrays (N, 3) of tag positions in the body frame, metres.

The layouts are centred (tags sum to zero), because rotation and translation only then
decouple in the linear model. `icassp2013` keeps the origin of its paper.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_number

__all__ = ["centred", "cube", "doa2019", "icassp2013", "octahedron", "perturb", "plate", "pyramid"]


def centred(tags: ArrayLike) -> FloatArray:
    """Return the tags (..., N, 3) shifted so that their mean is the origin."""
    tags = check_array("tags", tags, ("N", 3))
    return tags - tags.mean(axis=-2, keepdims=True)


def pyramid(size_m: float = 1.0) -> FloatArray:
    """Return a square pyramid of 5 tags: base and height `size_m` (tracking paper)."""
    size_m = _check_size(size_m)
    corners = [[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [0, 0, 2]]
    return centred(0.5 * size_m * np.array(corners))


def icassp2013() -> FloatArray:
    """Return the 6 tags of the static paper, its eq. (22), metres, its own frame (not centred)."""
    return np.array([[1, 0, 0], [6, 0, 0], [7, 5, 0], [6, 5, 0], [2, 5, 0], [2.5, 2.5, 5]], float)


def doa2019() -> FloatArray:
    """Return the 4 tags of the DOA paper, a corner and 3 m along its edges, in its own frame."""
    return np.concatenate([np.zeros((1, 3)), 3 * np.eye(3)])


def octahedron(size_m: float = 1.0) -> FloatArray:
    """Return six tags at +- `size_m` / 2 on the three axes."""
    half = 0.5 * _check_size(size_m) * np.eye(3)
    return np.concatenate([half, -half])


def cube(size_m: float = 1.0) -> FloatArray:
    """Return eight tags on the corners of a cube of edge `size_m`."""
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1)
    return 0.5 * _check_size(size_m) * signs.reshape(-1, 3).astype(float)


def plate(length_m: float = 1.0, width_m: float = 1.0) -> FloatArray:
    """Return four tags on the corners of a flat rectangle in the xy plane of the body.

    Coplanar tags make the 12-state linear filters rank-deficient; the filters on the manifold
    are not affected.
    """
    half = 0.5 * np.array([_check_size(length_m, "length_m"), _check_size(width_m, "width_m"), 0.0])
    return half * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])


def perturb(tags: ArrayLike, std_m: float, rng: np.random.Generator) -> FloatArray:
    """Return tags (..., N, 3) with independent Gaussian mounting errors, `std_m` on every axis."""
    tags = check_array("tags", tags, ("N", 3))
    std_m = check_number("std_m", std_m, low=0.0)
    return tags + std_m * rng.standard_normal(tags.shape)


def _check_size(size_m: float, name: str = "size_m") -> float:
    return check_number(name, size_m, low=1e-9)

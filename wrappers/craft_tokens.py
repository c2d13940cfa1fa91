"""Observation of a policy for any number of craft: each craft in its own frame.

The first axis of a craft's frame is horizontal and points from the predicted vehicle to the craft.
The third axis points up. The observation does not change if the scene turns about the vertical or
if the craft are numbered in another order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.wrappers import controllers

__all__ = ["craft_tokens"]

# Numbers of features of a craft, and of a pair.
OWN, PAIR = 41, 5
_UPPER = np.triu_indices(6, 1)


class CraftTokens(NamedTuple):
    """Observations of M craft: arrays with leading axes (B, M).

    `own` (B, M, `OWN`) is the vehicle and its belief in the craft's frame; `pairs` (B, M, M,
    `PAIR`): entry i, j is craft j in the frame of craft i; `others` (B, M, M): 1 if j is another
    craft than i and both exist; `frames` (B, M, 2, 2): from horizontal world axes to the craft's;
    `orbit` (B, M, 2): the horizontal velocity of the orbit in the craft's frame, in units of the
    limit.
    """

    own: FloatArray
    pairs: FloatArray
    others: FloatArray
    frames: FloatArray
    orbit: FloatArray


def craft_tokens(
    rotation: FloatArray,
    translation: FloatArray,
    covariance: FloatArray,
    twist: FloatArray,
    craft: FloatArray,
    mask: np.ndarray,
    reach_m: FloatArray,
    dt: FloatArray | float,
) -> CraftTokens:
    """Return the observation of each craft.

    Parameters
    ----------
    rotation, translation, covariance
        Of the belief: (B, 3, 3), (B, 3), (B, 6, 6).
    twist
        Known twist (B, 6) of the interval that ends at this epoch.
    craft, mask
        Positions (B, M, 3), and 1 for existing craft (B, M).
    reach_m
        Longest move in a step (B,), metres.
    dt
        Duration of a step in seconds, a number or (B,).
    """
    batch, m = mask.shape
    step = twist * np.broadcast_to(dt, batch)[:, None]
    centre = translation + step[:, 3:]
    gap = craft - centre[:, None]
    level = np.sqrt((gap[..., :2] ** 2).sum(axis=-1) + 1e-4)
    along = gap[..., :2] / level[..., None]
    frames = np.stack([along, np.stack([-along[..., 1], along[..., 0]], axis=-1)], axis=-2)
    full = np.zeros((batch, m, 6, 6))
    full[..., :2, :2] = full[..., 3:5, 3:5] = frames
    full[..., 2, 2] = full[..., 5, 5] = 1.0
    turned = full @ covariance[:, None] @ np.swapaxes(full, -1, -2)
    std = np.sqrt(np.maximum(np.diagonal(turned, axis1=-2, axis2=-1), 1e-12))
    correlation = turned / (std[..., None] * std[..., None, :])
    log_distance = 0.5 * np.log((gap**2).sum(axis=-1) / 1e4)
    depth = np.maximum(np.abs(centre[:, None, 2]), 5.0)
    numbers = [
        level / 100,
        log_distance,
        np.minimum(level / depth, 10.0),
        np.broadcast_to(centre[:, None, 2] / 50, (batch, m)),
        np.broadcast_to(reach_m[:, None] / 5, (batch, m)),
        np.broadcast_to(mask.sum(axis=-1)[:, None] / 4, (batch, m)),
    ]
    velocity = (full[..., :3, :3] @ step[:, None, 3:, None])[..., 0]
    turn = (full[..., :3, :3] @ step[:, None, :3, None])[..., 0]
    attitude = full[..., :3, :3] @ rotation[:, None]
    orbit = (frames @ _orbit(centre, translation, craft, mask, reach_m)[..., None])[..., 0]
    own = [
        np.stack(numbers, axis=-1),
        velocity / 3,
        10 * turn,
        np.log(std * (10.0, 10.0, 10.0, 1.0, 1.0, 1.0)),
        correlation[..., *_UPPER],
        attitude[..., 0],
        attitude[..., 1],
        orbit,
    ]
    seen = np.swapaxes(frames @ np.swapaxes(gap[:, None, :, :2], -1, -2), -1, -2)
    bearing = np.swapaxes(frames @ np.swapaxes(along[:, None], -1, -2), -1, -2)
    far = np.broadcast_to(log_distance[:, None, :, None], (batch, m, m, 1))
    others = mask[:, :, None] * mask[:, None, :] * (1.0 - np.eye(m))
    pairs = np.concatenate([seen / 100, bearing, far], axis=-1)
    return CraftTokens(np.concatenate(own, axis=-1), pairs, others, frames, orbit)


def _orbit(
    centre: FloatArray,
    translation: FloatArray,
    craft: FloatArray,
    mask: np.ndarray,
    reach_m: FloatArray,
) -> FloatArray:
    """Return velocities (B, M, 2) of `controllers.orbit`, 0 for craft that do not exist."""
    velocity = np.zeros((*mask.shape, 2))
    counts = mask.sum(axis=-1).astype(int)
    for n in np.unique(counts).tolist():
        rows = counts == n
        depths = controllers.PAIR_ORBIT_DEPTHS if n == 2 else controllers.ORBIT_DEPTHS
        middle = np.concatenate([centre[rows, :2], translation[rows, 2:]], axis=-1)
        own = craft[rows, :n]
        targets = controllers.on_ring(middle, own, reach_m[rows], depths, 1.0)
        wanted = (targets - own[..., :2]) / reach_m[rows, None, None]
        length = np.linalg.norm(wanted, axis=-1, keepdims=True)
        velocity[rows, :n] = wanted / np.maximum(length, 1.0)
    return velocity

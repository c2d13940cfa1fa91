"""Method of the DOA paper: Newton's iteration on the tag positions, then a unit quaternion.

The iteration (NIA) solves for K positions from their 2 K angles and K (K - 1) / 2 known distances,
without the constraint of a rigid body. The unit quaternion method then fits the body to them.
Arrays of a batch are angles (B, 2, K) and places (B, K, 3). Inside, trials are the last axis.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, kernel
from rbl_gym.estimators.costs.levenberg_marquardt import damped_solution
from rbl_gym.geometry import rotations
from rbl_gym.measurements import bearing

# Called without input checks, because positions far away make the matrix large.
_VEE = kernel(rotations.vee)

# Weight of the known distances against the noisy angles: a distance error of the body's size counts
# as an angle of this many radians.
DISTANCE_WEIGHT = 10.0
# Shift of the start C, which has tags on the axes, where the angles have no derivative.
START_SHIFT = 1e-3
STEP_TOLERANCE = 1e-8
MAX_ITERATIONS = 30
# An iteration has diverged beyond the first distance, in sizes of the body, or without convergence
# beyond the second. A body at the first distance needs angles exact to 1e-6, at the second to 1e-3.
FARTHEST = 1e6
_FAR = 1e3
# Below this step, in units of length, the curvature of the residuals is included (full Newton).
# With residuals from noise, Gauss-Newton converges only linearly.
_CURVED = 1e-2


class Places(NamedTuple):
    """Positions (B, K, 3) of the tags, iterations (B,), and whether the last step was small.

    NaN if the iteration diverged: beyond 1e6 sizes of the body, or beyond 1e3 without convergence.
    """

    positions: FloatArray
    iterations: np.ndarray
    converged: BoolArray


def body_size(tags: FloatArray) -> FloatArray:
    """Return the largest distance (...) between tags (..., K, 3) of a body, the unit of length."""
    gap = tags[..., :, None, :] - tags[..., None, :, :]
    return np.sqrt(np.einsum("...i,...i->...", gap, gap).max(axis=(-2, -1)))


def newton_iteration(
    angles: FloatArray, tags: FloatArray, distance_weight: float | None = None
) -> Places:
    """Estimate tag positions by Newton's iteration (Gauss-Newton), from the tags shifted by 1e-3.

    Parameters
    ----------
    angles, tags
        (B, 2, K) and (B, K, 3), radians and metres.
    distance_weight
        Weight of a distance error against an angle error, radians per metre. None:
        `DISTANCE_WEIGHT` over the body's size, so that the unit of length does not matter. The
        paper's 1 is one radian per unit of the tags.

    Notes
    -----
    The iteration stops if the norm of all steps is below 1e-8 of the unit of length.
    """
    unit = body_size(tags) if distance_weight is None else np.ones(len(tags))
    weight = DISTANCE_WEIGHT if distance_weight is None else distance_weight
    body = np.ascontiguousarray((tags / unit[:, None, None]).transpose(2, 1, 0))
    target = np.ascontiguousarray(angles.transpose(1, 2, 0))
    pairs = np.array(list(itertools.combinations(range(body.shape[1]), 2)))
    gap = body[:, pairs[:, 0]] - body[:, pairs[:, 1]]
    lengths = np.sqrt(np.einsum("ipb,ipb->pb", gap, gap))
    x = body + START_SHIFT
    extent = lengths.max(axis=0)
    iterations = np.full(len(tags), MAX_ITERATIONS)
    active = np.arange(len(tags))
    converged = np.zeros(len(tags), bool)
    now, goal, known, size = x, target, lengths, np.full(len(tags), np.inf)
    for iteration in range(1, MAX_ITERATIONS + 1):
        step = _newton_step(
            now, goal, known, pairs, weight, (size < _CURVED * extent).astype(float)
        )
        # A diverged iteration does not return.
        gone = ~(np.abs(now + step).max(axis=(0, 1)) < FARTHEST * extent)
        step = np.where(gone, np.nan, step)
        now = now + step
        size = np.sqrt(np.einsum("ikb,ikb->b", step, step))
        done = size < STEP_TOLERANCE
        stop = done | gone
        if stop.any():
            x[:, :, active[stop]] = now[:, :, stop]
            iterations[active[stop]] = iteration
            converged[active[done]] = True
            keep = ~stop
            active, size, extent = active[keep], size[keep], extent[keep]
            now, goal, known = now[..., keep], goal[..., keep], known[:, keep]
        if not len(active):
            break
    lost = ~(np.abs(now).max(axis=(0, 1)) < _FAR * extent)
    x[:, :, active] = np.where(lost, np.nan, now)
    return Places(x.transpose(2, 1, 0) * unit[:, None, None], iterations, converged)


def _newton_step(
    x: FloatArray,
    angles: FloatArray,
    lengths: FloatArray,
    pairs: np.ndarray,
    weight: float,
    curved: FloatArray,
) -> FloatArray:
    """Return one step (3, K, B) of positions (3, K, B); `curved` (B,): 1 Newton, 0 Gauss-Newton."""
    n_tags, trials = x.shape[1:]
    found, J = bearing.linearize(x)
    residual = found - angles
    own = np.einsum("aikb,ajkb->kijb", J, J)
    if curved.any():
        own += (curved * bearing.curvature(x, residual)).transpose(2, 0, 1, 3)
    gap = x[:, pairs[:, 0]] - x[:, pairs[:, 1]]
    distance = np.sqrt(np.maximum(np.einsum("ipb,ipb->pb", gap, gap), 1e-200))
    along = np.ascontiguousarray((gap * (weight / distance)).swapaxes(0, 1))
    bend = curved * (1 - lengths / distance)
    blocks = (along * (1 - bend)[:, None])[:, :, None] * along[:, None]
    blocks[:, range(3), range(3)] += (weight**2 * bend)[:, None]
    pull = along * (weight * (lengths - distance))[:, None]
    # Each pair has +1 and -1 in its row of the incidence matrix.
    E = np.zeros((len(pairs), n_tags))
    E[range(len(pairs)), pairs[:, 0]], E[range(len(pairs)), pairs[:, 1]] = 1.0, -1.0
    both = (E[:, :, None] * E[:, None]).reshape(len(pairs), -1)
    A = (both.T @ blocks.reshape(len(pairs), -1)).reshape(n_tags, n_tags, 3, 3, trials)
    A[range(n_tags), range(n_tags)] += own
    force = (E.T @ pull.reshape(len(pairs), -1)).reshape(n_tags, 3, trials)
    force -= np.einsum("aikb,akb->kib", J, residual)
    size = 3 * n_tags
    A = A.swapaxes(1, 2).reshape(size, size, trials).transpose(2, 0, 1)
    step = damped_solution(A, force.reshape(size, trials).T, np.zeros(trials))
    return step.T.reshape(n_tags, 3, trials).swapaxes(0, 1)


def unit_quaternion(positions: FloatArray, tags: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit rotation (..., 3, 3) and translation (..., 3) of a body to positions (..., K, 3).

    DOA paper, (11)-(14), corrected: with ``H = sum_k s_k c_k^T`` (centred) the quaternion maximises
    ``q^T P q``, P the symmetric 4 x 4 matrix of H; ``t = s - R c`` of the means.
    """
    s_mean, c_mean = positions.mean(axis=-2), tags.mean(axis=-2)
    s, c = positions - s_mean[..., None, :], tags - c_mean[..., None, :]
    H = np.swapaxes(s, -1, -2) @ c
    P = np.empty((*H.shape[:-2], 4, 4))
    P[..., 0, 0] = np.einsum("...ii->...", H)
    P[..., 1:, 1:] = H + np.swapaxes(H, -1, -2) - P[..., :1, :1] * np.eye(3)
    P[..., 0, 1:] = P[..., 1:, 0] = 2 * _VEE(H)
    rotation = rotations.from_quaternion(np.linalg.eigh(P)[1][..., 3])
    return rotation, s_mean - (rotation @ c_mean[..., None])[..., 0]

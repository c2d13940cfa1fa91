"""The posterior Cramer-Rao bound as the environments carry it: `bounds` where speed counts.

The recursion is that of `bounds.posterior_crb_step`. Many worlds are taken by components, in
blocks, worlds last. One world is taken in few calls: all that no action changes is computed once
for its episode, and the covariance is carried. Nothing is checked here but that the matrices can
be inverted.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtrs  # pyright: ignore[reportAttributeAccessIssue]

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.components import (
    exp_and_left_jacobian,
    first,
    inverse,
    last,
    product,
)
from rbl_gym.geometry import rotations
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

_EYE = np.eye(6)
# Worlds of a block: enough to outweigh the calls, few enough for the processor's cache.
_BLOCK = 1024
_SINGULAR = "the information about the pose is singular or not finite"

# --- one world ----------------------------------------------------------------------------------


class Course(NamedTuple):
    """What the bound of an episode needs and no action changes, at all its epochs (T, ...).

    Attributes
    ----------
    turn, spread
        F and Q of the interval that ends at the epoch, (T, 6, 6).
    positions, jacobian
        The tags (T, N, 3) and their derivative by the pose error (T, N, 3, 6).
    square
        Mean of ``J_n^T J_n`` over the tags, (T, 6, 6).
    """

    turn: FloatArray
    spread: FloatArray
    positions: FloatArray
    jacobian: FloatArray
    square: FloatArray

    def information(
        self, epoch: int | slice, anchors: FloatArray, noise: NoiseLaw, links: BoolArray
    ) -> FloatArray:
        """Fisher information (..., 6, 6) of the ranges of an epoch, or of several."""
        d = self.positions[epoch][..., None, :] - anchors[..., None, :, :]
        squared = (d * d).sum(axis=-1)
        # Each row is the derivative of half a squared range, the distance times that of the range.
        rows = d @ self.jacobian[epoch]
        variance = _transposed(noise.variance(_transposed(np.sqrt(squared))))
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = _transposed(links) / (squared * variance)
        if not squared.all():
            # Where an anchor stands on a tag the range has no gradient: that link tells nothing.
            weight = np.where(squared > 0, weight, 0.0)
        rows = rows.reshape((*rows.shape[:-3], -1, 6))
        return _transposed(rows * weight.reshape((*weight.shape[:-2], -1, 1))) @ rows

    def predict(self, epoch: int, P: FloatArray) -> FloatArray:
        """Pose covariance (6, 6) at an epoch before its ranges, from that of the epoch before."""
        turn = self.turn[epoch]
        return turn @ P @ turn.T + self.spread[epoch]

    def score(self, epoch: int, P: FloatArray) -> float:
        """`bounds.score` of a pose covariance (6, 6) at an epoch."""
        return float(bounds.root_of_trace(np.vdot(self.square[epoch], P)))


def course(
    rotation: FloatArray, positions: FloatArray, twists: FloatArray, tags: FloatArray,
    dt: float, process: ProcessNoise,
) -> Course:  # fmt: skip
    """The course of the true poses (T, 3, 3), tags (T, N, 3) and known twists (T, 6)."""
    turn = np.tile(_EYE, (len(twists), 1, 1))
    turn[:, :3, :3] = rotations.exp(dt * twists[:, :3])
    jacobian = bounds.tag_jacobian(rotation, tags)
    rows = jacobian.reshape(len(rotation), -1, 6)
    square = _transposed(rows) @ rows / len(tags)
    return Course(turn, process.covariance(twists, dt), positions, jacobian, square)


def update(P: FloatArray, information: FloatArray) -> FloatArray:
    """Covariance ``(P^-1 + information)^-1`` (6, 6), as ``L (I + L^T information L)^-1 L^T``.

    With ``P = L L^T``: symmetric all the way, which keeps the digits where the prior is vague.

    Raises
    ------
    ValueError
        If a matrix is not positive definite or not finite.
    """
    lower, flaw = dpotrf(P, lower=1, clean=1)
    if not flaw:
        root, flaw = dpotrf(_EYE + lower.T @ information @ lower, lower=1)
    if not flaw:
        half, flaw = dtrtrs(root, lower.T, lower=1)
    if flaw:
        raise ValueError(_SINGULAR)
    return half.T @ half


def _transposed(matrix: NDArray[Any]) -> NDArray[Any]:
    return matrix.swapaxes(-1, -2)


# --- many worlds --------------------------------------------------------------------------------


class Interval(NamedTuple):
    """Motion between two epochs: known twists (B, 6), seconds, the law of what is not known."""

    twist: FloatArray
    dt: float
    process: ProcessNoise


def step_many(
    J: FloatArray,
    interval: Interval | None,
    anchors: FloatArray,
    tags: tuple[tuple[float, ...], ...],
    rotation: FloatArray,
    translation: FloatArray,
    noise: NoiseLaw,
    links: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """`bounds.posterior_crb_step` of B worlds whose bodies have the same tags.

    Parameters
    ----------
    J
        Information (B, 6, 6) of the epoch before.
    interval
        From there to this epoch; None: J is of this epoch, before its ranges.
    anchors, rotation, translation, links
        At this epoch, (B, M, 3), (B, 3, 3), (B, 3), (B, M, N); the pose is the true one.
    tags, noise
        What all worlds share.

    Returns
    -------
    The information (B, 6, 6) after the ranges, a view of memory that runs along the worlds, and
    the `bounds.score` (B,) of its inverse.

    Raises
    ------
    ValueError
        If the information is singular or not finite.
    """
    maps = _maps(tags)
    updated, trace = np.empty((6, 6, len(J))), np.empty(len(J))
    for start in range(0, len(J), _BLOCK):
        rows = slice(start, start + _BLOCK)
        new, Q = _block(J[rows], 2), _block(rotation[rows], 2)
        seen = _block(_transposed(anchors[rows]), 2) - _block(translation[rows], 1)[:, None]
        seen = np.einsum("ijb,imb->jmb", Q, seen)
        try:
            if interval is not None:
                turn = interval.dt * _block(interval.twist[rows, :3], 1)
                new = _predict(new, turn, interval.dt * interval.process.std() ** 2)
                if new is None:
                    twist = interval.twist[rows]
                    new = bounds.predict_information(J[rows], twist, interval.dt, interval.process)
                    new = _block(new, 2)
            new += _information(maps, seen, Q, noise, _block(_transposed(links[rows]), 2))
            trace[rows] = _trace(maps, Q, inverse(new))
        except np.linalg.LinAlgError as error:
            raise ValueError(_SINGULAR) from error
        updated[..., rows] = new
    return last(updated, 2), bounds.root_of_trace(trace)


def _block(array: NDArray[Any], trailing: int) -> NDArray[Any]:
    return np.ascontiguousarray(first(array, trailing))


def _predict(J: FloatArray, turn: FloatArray, variance: FloatArray) -> FloatArray | None:
    """``(F J^-1 F^T + Q)^-1`` (6, 6, B) after turns (3, B), six variances of the noise.

    As ``(I + T Q)^-1 T``: where little is known, a way by J^-1 loses half the digits.
    """
    step, jacobian = exp_and_left_jacobian(turn)
    top = product(step, J[:3])
    # [A | T] with T = F J F^T and A = I + T Q; A is brought to I.
    both = np.empty((6, 12, J.shape[-1]))
    A, T = both[:, :6], both[:, 6:]
    T[:3, :3] = _times_transposed(top[:, :3], step)
    T[:3, 3:] = top[:, 3:]
    T[3:, :3] = top[:, 3:].swapaxes(0, 1)
    T[3:, 3:] = J[3:, 3:]
    A[:, :3] = product(T[:, :3], _times_transposed(jacobian * variance[:3, None], jacobian))
    np.multiply(T[:, 3:], variance[3:, None], out=A[:, 3:])
    for i in range(6):
        A[i, i] += 1.0
    for k in range(6):
        if not both[k, k].min() > 0.5:
            # Pivots stay above 1 but for turned, uneven noise: then rows must be exchanged.
            return None
        both[k, k + 1 :] /= both[k, k]
        for rows in (both[:k], both[k + 1 :]):
            rows[:, k + 1 :] -= rows[:, k, None] * both[k, k + 1 :]
    return bounds.symmetric(last(T, 2)).transpose(1, 2, 0)


class _TagMaps(NamedTuple):
    """What follows from the tags alone, in the body frame.

    `places` (3, N); `lift` (27, 6 N) takes the upper triangles of the information (6, N) about
    each tag's place to the blocks [ww, wv, vv] (3, 3, 3) of that about the pose, block second;
    `second` (3, 3) and `mean` (3,) are the tags' moments.
    """

    places: FloatArray
    lift: FloatArray
    second: FloatArray
    mean: FloatArray


@functools.lru_cache(maxsize=16)
def _maps(tags: tuple[tuple[float, ...], ...]) -> _TagMaps:
    places = np.array(tags)
    J = bounds.tag_jacobian(np.eye(3), places)
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(zip(*np.triu_indices(3), strict=True)):
        basis[k, i, j] = basis[k, j, i] = 1.0
    full = np.einsum("nia,kij,njb->abkn", J, basis, J)
    blocks = np.stack([full[:3, :3], full[:3, 3:], full[3:, 3:]], axis=1)
    second = places.T @ places / len(places)
    return _TagMaps(places.T, blocks.reshape(27, -1), second, places.mean(axis=0))


def _information(
    maps: _TagMaps, anchors: FloatArray, Q: FloatArray, noise: NoiseLaw, links: BoolArray
) -> FloatArray:
    """Fisher information (6, 6, B) of the ranges, from anchors (3, M, B) in the body frame."""
    upper = _tag_information(maps.places, anchors, noise, links)
    blocks = maps.lift @ upper.reshape(maps.lift.shape[1], -1)
    # Both sides of all three blocks are turned to the world.
    turned = product(Q, blocks.reshape(3, 9, -1)).reshape(3, 3, 3, -1)
    turned = np.einsum("iakb,lkb->ailb", turned, Q)
    information = np.empty((6, 6, Q.shape[-1]))
    information[:3, :3], information[:3, 3:], information[3:, 3:] = turned
    information[3:, :3] = turned[1].swapaxes(0, 1)
    return information


def _tag_information(
    places: FloatArray, anchors: FloatArray, noise: NoiseLaw, links: BoolArray
) -> FloatArray:
    """Upper triangles (6, N, B) of the information about each tag's place, links (N, M, B)."""
    # Tags before anchors, so that each of these long loops runs over anchors and worlds.
    d = places[:, :, None, None] - anchors[:, None]
    squared = d[0] * d[0]
    squared += d[1] * d[1]
    squared += d[2] * d[2]
    distance = _transposed(last(np.sqrt(squared), 2))
    variance = first(_transposed(noise.variance(distance)), 2)
    # The gradients are d / distance: the square of that distance goes into the weight.
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = links / (squared * variance)
    if not squared.min() > 0:
        # Where an anchor stands on a tag the range has no gradient: that link tells nothing.
        weight = np.where(squared > 0, weight, 0.0)
    upper = np.empty((6, len(squared), squared.shape[-1]))
    for i, rows in enumerate((slice(0, 3), slice(3, 5), slice(5, 6))):
        np.einsum("nmb,jnmb->jnb", weight * d[i], d[i:], out=upper[rows])
    return upper


def _trace(maps: _TagMaps, Q: FloatArray, P: FloatArray) -> FloatArray:
    """Mean of ``tr(J_n P J_n^T)`` over the tags, (B,), by their moments."""
    second = _times_transposed(np.einsum("ijb,jk->ikb", Q, maps.second), Q)
    mean = np.einsum("ijb,j->ib", Q, maps.mean)
    trace = P[3, 3] + P[4, 4] + P[5, 5]
    trace += np.trace(maps.second) * (P[0, 0] + P[1, 1] + P[2, 2])
    trace -= np.einsum("ijb,ijb->b", second, P[:3, :3])
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        trace += 2 * mean[i] * (P[k, 3 + j] - P[j, 3 + k])
    return trace


def _times_transposed(A: FloatArray, B: FloatArray) -> FloatArray:
    """``A B^T`` (3, 3, ...) by components."""
    return product(A, B.swapaxes(0, 1))

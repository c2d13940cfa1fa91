"""Bias and standard deviation of ranges as functions of the ray's direction in the body frame.

Bodies block their own radios: a ray through the body is late and has more noise. Bias and logarithm
of the standard deviation are a few harmonics of the ray's bearing at each end. One model holds for
all antennas. The bearing is relative to the direction of the antenna from its body's origin, or to
the x axis. The model is evaluated at the estimated pose, as part of the measurement model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_count, check_one_of
from rbl_gym.estimators.smoothing.knowledge import Level
from rbl_gym.geometry import rotations

__all__ = [
    "DirectionBasis",
    "DirectionModel",
    "choose_basis",
    "direction_model_at",
    "fit_directions",
    "locate_by_directions",
]

# Scales of the coefficients for the ridge: metres of bias, logarithm of the standard deviation.
_BIAS_M, _LOG = 0.2, 1.0
_LEAST_STD_M = 0.01
_HEADINGS, _ITERATIONS = 12, 30
_STEP = 1e-5


@dataclass(frozen=True)
class DirectionBasis:
    """Harmonics that model bias and standard deviation.

    Parameters
    ----------
    harmonics
        Number of harmonics of the bearing at each end; 0: constants alone.
    zero
        Zero of the bearings: ``"antenna"``, its direction from the body's origin, or ``"body"``,
        the x axis.
    ends
        ``"both"`` ends, or the ``"tags"`` alone, for anchors on walls.
    """

    harmonics: int = 1
    zero: str = "antenna"
    ends: str = "both"

    def __post_init__(self) -> None:
        check_count("harmonics", self.harmonics, least=0)
        check_one_of("zero", self.zero, ("antenna", "body"))
        check_one_of("ends", self.ends, ("both", "tags"))


class DirectionModel(NamedTuple):
    """Coefficients (F,) of the bias, metres, and of the logarithm of the standard deviation.

    The first is the constant. Cosine and sine of each harmonic follow, at the anchors' end, if
    included, then at the tags' end.
    """

    basis: DirectionBasis
    bias: FloatArray
    log_std: FloatArray


def fit_directions(
    ranges: ArrayLike,
    links: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    basis: DirectionBasis = DirectionBasis(),
    ridge: float = 0.05,
) -> DirectionModel:
    """Estimate bias and standard deviation from ranges at known poses, with a ridge penalty.

    The estimate is maximum likelihood. Early errors are Gaussian, late errors Cauchy.

    Parameters
    ----------
    ranges, links
        (K, M, N) metres, and a mask of the measured ranges.
    anchors, tags
        (M, 3) and (N, 3), each in the frame of its own body.
    rotation, translation
        (K, 3, 3) and (K, 3): the pose of the tags' body in the anchors' frame.
    basis
        The harmonics.
    ridge
        Weight of the penalty on each harmonic, relative to that of one range of the log. The
        constants have no penalty.

    Raises
    ------
    ValueError
        If there is no range.
    """
    ranges = check_array("ranges", ranges, ("K", "M", "N"))
    mask = np.asarray(links, dtype=bool) & (ranges > 0)
    if not mask.any():
        raise ValueError("ranges must have at least one measured link, got none")
    rotation, translation, anchors, tags = map(np.asarray, (rotation, translation, anchors, tags))
    u, d = _rays(rotation, translation, anchors, tags)
    e = (ranges - d)[mask]
    F = _features(basis, rotation, u, anchors, tags)[mask]
    return _fitted(e, F, basis, ridge)


def _fitted(e: FloatArray, F: FloatArray, basis: DirectionBasis, ridge: float) -> DirectionModel:
    count, n = F.shape[1], len(e)
    draw = np.full(count, ridge * n)
    draw[0] = 0.0
    both = np.concatenate([draw / _BIAS_M**2, draw / _LOG**2]) / n

    def objective(x: FloatArray) -> tuple[float, FloatArray]:
        log_std = F @ x[count:]
        z = (e - F @ x[:count]) / np.exp(log_std)
        loss, pull = _late_loss(z)
        slope = [-F.T @ (pull / np.exp(log_std)), F.T @ (1 - pull * z)]
        value = (loss + log_std).mean() + 0.5 * float(both @ x**2)
        return value, np.concatenate(slope) / n + both * x

    start = np.zeros(2 * count)
    start[0] = np.median(e)
    start[count] = np.log(max(float(np.median(np.abs(e - start[0]))), _LEAST_STD_M))
    low = np.full(2 * count, -np.inf)
    low[count] = np.log(_LEAST_STD_M)
    bounds = [(a if np.isfinite(a) else None, None) for a in low]
    x = scipy.optimize.minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    return DirectionModel(basis, x[:count], x[count:])


def _late_loss(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the loss and its derivative: squares for early residuals, Cauchy for late ones."""
    late = z > 0
    tail = 1 + 0.5 * z * z
    return np.where(late, np.log(tail), 0.5 * z * z), np.where(late, z / tail, z)


def choose_basis(
    ranges: ArrayLike,
    links: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    candidates: tuple[DirectionBasis, ...],
    level: Level,
    ridge: float = 0.05,
    parts: int = 4,
) -> tuple[DirectionBasis, FloatArray]:
    """Choose the simplest basis that locates held-out epochs about as well as the best basis.

    Parameters
    ----------
    ranges, links, anchors, tags, rotation, translation, ridge
        As in `fit_directions`.
    candidates
        Candidate bases, the simplest first.
    level
        As in `locate_by_directions`.
    parts
        Number of intervals of time into which the log is split; each is held out once.

    Returns
    -------
    basis
        The first candidate within one standard error of the difference to the best.
    errors
        (candidates, parts) mean horizontal error of the held-out epochs, metres.

    Notes
    -----
    Cross-validation with the one-standard-error rule (Hastie, Tibshirani, Friedman, "The
    Elements of Statistical Learning", 7.10). To choose by several logs, add their errors.
    """
    arrays = map(np.asarray, (ranges, links, rotation, translation))
    r, there, Q, t = arrays
    parts = check_count("parts", parts, least=2, most=len(r))
    part = np.arange(len(r)) * parts // len(r)
    errors = np.zeros((len(candidates), parts))
    for i, basis in enumerate(candidates):
        for k in range(parts):
            kept, out = part != k, part == k
            model = fit_directions(
                r[kept], there[kept], anchors, tags, Q[kept], t[kept], basis, ridge
            )
            found = locate_by_directions(r[out], there[out], anchors, tags, model, level)[1]
            errors[i, k] = np.linalg.norm((found - t[out])[:, :2], axis=1).mean()
    more = errors - errors[int(np.argmin(errors.mean(axis=1)))]
    enough = more.mean(axis=1) <= more.std(axis=1, ddof=1) / np.sqrt(parts)
    return candidates[int(np.argmax(enough))], errors


def direction_model_at(
    model: DirectionModel,
    rotation: ArrayLike,
    translation: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """Return bias and standard deviation (..., M, N) of the ranges at poses, metres.

    Parameters
    ----------
    model
        Result of `fit_directions`.
    rotation, translation
        (..., 3, 3) and (..., 3): pose of the tags' body in the anchors' frame.
    anchors, tags
        (M, 3) and (N, 3), each in the frame of its own body.
    """
    rotation, translation, anchors, tags = map(np.asarray, (rotation, translation, anchors, tags))
    u, _ = _rays(rotation, translation, anchors, tags)
    F = _features(model.basis, rotation, u, anchors, tags)
    return F @ model.bias, np.maximum(np.exp(F @ model.log_std), _LEAST_STD_M)


def _rays(
    rotation: FloatArray, translation: FloatArray, anchors: FloatArray, tags: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (..., M, N, 3) from anchors to tags, and distances (..., M, N)."""
    places = tags @ np.swapaxes(rotation, -1, -2) + translation[..., None, :]
    apart = places[..., None, :, :] - anchors[:, None]
    d = np.maximum(np.linalg.norm(apart, axis=-1), 1e-9)
    return apart / d[..., None], d


def _features(
    basis: DirectionBasis,
    rotation: FloatArray,
    u: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
) -> FloatArray:
    """Return the basis functions (..., M, N, F) of the coefficients."""
    back = -np.einsum("...mni,...ij->...mnj", u, rotation)
    ends = [(u, anchors[:, None]), (back, tags)] if basis.ends == "both" else [(back, tags)]
    columns = [np.ones(u.shape[:-1])]
    for ray, arms in ends:
        bearing = np.arctan2(ray[..., 1], ray[..., 0])
        if basis.zero == "antenna":
            bearing = bearing - np.arctan2(arms[..., 1], arms[..., 0])
        for k in range(1, basis.harmonics + 1):
            columns += [np.cos(k * bearing), np.sin(k * bearing)]
    return np.stack(columns, axis=-1)


class _Log(NamedTuple):
    ranges: FloatArray  # (K, M, N)
    mask: BoolArray
    anchors: FloatArray
    tags: FloatArray
    model: DirectionModel
    height_m: float
    height_std_m: float
    tilt_std_rad: float


class _Found(NamedTuple):
    cost: FloatArray  # (H, K)
    residual: FloatArray  # (H, K, M, N) over the standard deviation
    std: FloatArray
    bias: FloatArray


def locate_by_directions(
    ranges: ArrayLike,
    links: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
    model: DirectionModel,
    level: Level,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Estimate the most likely pose of each epoch separately, for a body that stays about level.

    The height is about constant. Bias and standard deviation are those of the rays at the pose. The
    search starts from twelve headings.

    Parameters
    ----------
    ranges, links
        (K, M, N) metres, and a mask of the measured ranges.
    anchors, tags
        (M, 3) and (N, 3), each in the frame of its own body.
    model
        Result of `fit_directions`.
    level
        Known height and tilt in the anchors' frame.

    Returns
    -------
    rotation, translation
        (K, 3, 3) and (K, 3).
    cost
        (K,) negative log-likelihood, up to a constant.
    """
    ranges = check_array("ranges", ranges, ("K", "M", "N"))
    mask = np.asarray(links, dtype=bool) & (ranges > 0)
    anchors, tags = check_array("anchors", anchors, ("M", 3)), check_array("tags", tags, ("N", 3))
    if level.height_m is None or level.height_std_m is None or level.tilt_std_rad is None:
        raise ValueError(
            f"level must have height_m, height_std_m and tilt_std_rad, got {level!r:.200}"
        )
    rotation, translation = _starts(ranges, mask, anchors, level.height_m)
    known = level.height_m, level.height_std_m, level.tilt_std_rad
    log = _Log(ranges, mask, anchors, tags, model, *known)
    now = _cost(log, rotation, translation)
    damping = np.full(now.cost.shape, 1e-2)
    for _ in range(_ITERATIONS):
        step = _step(log, rotation, translation, now, damping)
        turned = rotations.exp(step[..., :3]) @ rotation
        moved = translation + step[..., 3:]
        new = _cost(log, turned, moved)
        better = new.cost < now.cost
        rotation = np.where(better[..., None, None], turned, rotation)
        translation = np.where(better[..., None], moved, translation)
        now = _Found(
            *(
                np.where(better.reshape(better.shape + (1,) * (a.ndim - 2)), a, b)
                for a, b in zip(new, now, strict=True)
            )
        )
        damping = np.clip(np.where(better, damping / 4, damping * 6), 1e-9, 1e6)
    best, k = now.cost.argmin(axis=0), np.arange(len(ranges))
    return rotation[best, k], translation[best, k], now.cost[best, k]


def _starts(
    ranges: FloatArray, mask: BoolArray, anchors: FloatArray, height: float
) -> tuple[FloatArray, FloatArray]:
    """Return poses (H, K, ...) towards the short ranges, at the mean range, with H headings."""
    K = len(ranges)
    seen = mask.sum(axis=2)
    mean = (ranges * mask).sum(axis=2) / np.maximum(seen, 1)
    w = (seen > 0).astype(float)
    distance = (mean * w).sum(axis=1) / np.maximum(w.sum(axis=1), 1)
    arms = (anchors - anchors.mean(axis=0))[:, :2]
    short = ((distance[:, None] ** 2 - mean**2) * w) @ arms
    towards = short / np.maximum(np.linalg.norm(short, axis=1, keepdims=True), 1e-12)
    across = np.sqrt(np.maximum(distance**2 - height**2, 0.1))
    place = np.column_stack([towards * across[:, None], np.full(K, height)])
    place[:, :2] += anchors[:, :2].mean(axis=0)
    yaw = np.linspace(0, 2 * np.pi, _HEADINGS, endpoint=False)
    turns = rotations.exp(yaw[:, None] * np.array([0.0, 0.0, 1.0]))
    shape = (_HEADINGS, K)
    return (
        np.broadcast_to(turns[:, None], (*shape, 3, 3)).copy(),
        np.broadcast_to(place, (*shape, 3)).copy(),
    )


def _cost(log: _Log, rotation: FloatArray, translation: FloatArray) -> _Found:
    d = _rays(rotation, translation, log.anchors, log.tags)[1]
    bias, std = direction_model_at(log.model, rotation, translation, log.anchors, log.tags)
    z = np.where(log.mask, (log.ranges - d - bias) / std, 0.0)
    cost = (_late_loss(z)[0] + np.where(log.mask, np.log(std), 0.0)).sum(axis=(-2, -1))
    height = (translation[..., 2] - log.height_m) / log.height_std_m
    tilt = (rotation[..., :2, 2] ** 2).sum(axis=-1) / log.tilt_std_rad**2
    return _Found(cost + 0.5 * (height**2 + tilt), z, std, bias)


def _step(
    log: _Log, rotation: FloatArray, translation: FloatArray, now: _Found, damping: FloatArray
) -> FloatArray:
    """Return steps (H, K, 6) of the pose error."""
    anchors, tags = log.anchors, log.tags
    u, _ = _rays(rotation, translation, anchors, tags)
    arms = tags @ np.swapaxes(rotation, -1, -2)
    J = np.concatenate([np.cross(arms[..., None, :, :], u), u], axis=-1)
    for i, axis in enumerate(np.eye(6)):
        turned = rotations.exp(_STEP * axis[:3]) @ rotation
        moved = translation + _STEP * axis[3:]
        J[..., i] += (
            direction_model_at(log.model, turned, moved, anchors, tags)[0] - now.bias
        ) / _STEP
    z = now.residual
    weight = log.mask * np.where(z > 0, 1 / (1 + 0.5 * z * z), 1.0) / now.std**2
    weighted = weight[..., None] * J
    H = np.einsum("...mni,...mnj->...ij", weighted, J)
    g = np.einsum("...mni,...mn->...i", weighted, z * now.std)
    about = 1 / log.tilt_std_rad**2
    H[..., [0, 1], [0, 1]] += about
    g[..., 0] += about * rotation[..., 1, 2]
    g[..., 1] -= about * rotation[..., 0, 2]
    H[..., 5, 5] += 1 / log.height_std_m**2
    g[..., 5] -= (translation[..., 2] - log.height_m) / log.height_std_m**2
    diagonal = np.einsum("...ii->...i", H)
    diagonal *= 1 + damping[..., None]
    return np.clip(np.linalg.solve(H, g[..., None])[..., 0], -0.5, 0.5)

"""Bias and deviation of ranges as functions of the direction in which a ray leaves the body.

Bodies block their own radios: a ray that leaves through the body is late, and varies more. Bias
and logarithm of the deviation are a few harmonics of the bearing of the ray at each end, one law
for all antennas; the bearing counts from where the antenna points away from its body's origin, or
from the x axis. Evaluated at the pose that is estimated, it is part of the measurement model.
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

# Scales of the coefficients that the ridge refers to: metres of bias, logarithm of the deviation.
_BIAS_M, _LOG = 0.2, 1.0
_LEAST_STD_M = 0.01
_HEADINGS, _ITERATIONS = 12, 30
_STEP = 1e-5


@dataclass(frozen=True)
class DirectionBasis:
    """What bias and deviation are functions of.

    Parameters
    ----------
    harmonics
        Of the bearing at each end; 0: constants alone.
    zero
        Bearings count from ``"antenna"``, its direction from the body's origin, or ``"body"``, the
        x axis.
    ends
        ``"both"`` ends, or the ``"tags"`` alone: of anchors that hang on walls.
    """

    harmonics: int = 1
    zero: str = "antenna"
    ends: str = "both"

    def __post_init__(self) -> None:
        check_count("harmonics", self.harmonics, least=0)
        check_one_of("zero", self.zero, ("antenna", "body"))
        check_one_of("ends", self.ends, ("both", "tags"))


class DirectionModel(NamedTuple):
    """Coefficients (F,) of the bias, metres, and of the logarithm of the deviation.

    The first is the constant; then cosine and sine of each harmonic at the anchors' end, if it
    counts, and at the tags' end.
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
    """Bias and deviation by ranges at known poses: maximum likelihood with a ridge.

    Errors are Gaussian on the early side and Cauchy on the late side.

    Parameters
    ----------
    ranges, links
        (K, M, N) metres, and where there is a range.
    anchors, tags
        (M, 3) and (N, 3), each in the frame of its own body.
    rotation, translation
        (K, 3, 3) and (K, 3): the pose of the tags' body in the anchors' frame.
    basis
        Harmonics.
    ridge
        Weight of a range that draws each harmonic to zero, over that of a range of the log; the
        constants are free.

    Raises
    ------
    ValueError
        Without a range.
    """
    ranges = check_array("ranges", ranges, ("K", "M", "N"))
    mask = np.asarray(links, dtype=bool) & (ranges > 0)
    if not mask.any():
        raise ValueError("ranges must have a link, got none")
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
    """Loss and its derivative: squares for early residuals, Cauchy's for late ones."""
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
    """The simplest basis that places epochs left out about as well as the best one does.

    Parameters
    ----------
    ranges, links, anchors, tags, rotation, translation, ridge
        As of `fit_directions`.
    candidates
        Bases that are tried, the simplest first.
    level
        As of `locate_by_directions`.
    parts
        The log is cut into so many stretches of time; each is left out once.

    Returns
    -------
    basis
        The first candidate that falls short of the best by no more than one standard error of the
        difference.
    errors
        (candidates, parts) mean horizontal error of the epochs left out, metres.

    Notes
    -----
    Cross-validation with the rule of one standard error (Hastie, Tibshirani, Friedman, "The
    Elements of Statistical Learning", 7.10). Add errors of several logs to choose by all of them.
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
    """Bias and deviation (..., M, N) of the ranges at poses, metres.

    Parameters
    ----------
    model
        Of `fit_directions`.
    rotation, translation
        (..., 3, 3) and (..., 3): the tags' body in the anchors' frame.
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
    """Unit vectors (..., M, N, 3) from anchors to tags, and distances (..., M, N)."""
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
    """What the coefficients multiply (..., M, N, F)."""
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


class _Told(NamedTuple):
    """What is known of height and tilt."""

    height_m: float
    height_std_m: float
    tilt_std_rad: float


class _Found(NamedTuple):
    cost: FloatArray  # (H, K)
    residual: FloatArray  # (H, K, M, N) over the deviation
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
    """Most likely pose of every epoch by itself, of a body about level at about one height.

    Bias and deviation are those of the rays at the pose. The search starts from twelve headings.

    Parameters
    ----------
    ranges, links
        (K, M, N) metres, and where there is a range.
    anchors, tags
        (M, 3) and (N, 3), each in the frame of its own body.
    model
        Of `fit_directions`.
    level
        Height and tilt as they are known in the anchors' frame.

    Returns
    -------
    rotation, translation
        (K, 3, 3) and (K, 3).
    cost
        (K,) negative log-likelihood, less its constant.
    """
    ranges = check_array("ranges", ranges, ("K", "M", "N"))
    mask = np.asarray(links, dtype=bool) & (ranges > 0)
    anchors, tags = check_array("anchors", anchors, ("M", 3)), check_array("tags", tags, ("N", 3))
    if level.height_m is None or level.height_std_m is None or level.tilt_std_rad is None:
        raise ValueError(f"level must tell height and tilt, got {level!r:.200}")
    rotation, translation = _starts(ranges, mask, anchors, level.height_m)
    told = _Told(level.height_m, level.height_std_m, level.tilt_std_rad)
    data = (ranges, mask, anchors, tags, model, told)
    now = _cost(*data, rotation, translation)
    damping = np.full(now.cost.shape, 1e-2)
    for _ in range(_ITERATIONS):
        step = _step(*data, rotation, translation, now, damping)
        turned = rotations.exp(step[..., :3]) @ rotation
        moved = translation + step[..., 3:]
        new = _cost(*data, turned, moved)
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
    """Poses (H, K, ...): towards where ranges are short, at the mean range, turned every way."""
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


def _cost(
    ranges: FloatArray, mask: BoolArray, anchors: FloatArray, tags: FloatArray,
    model: DirectionModel, level: _Told, rotation: FloatArray, translation: FloatArray,
) -> _Found:  # fmt: skip
    d = _rays(rotation, translation, anchors, tags)[1]
    bias, std = direction_model_at(model, rotation, translation, anchors, tags)
    z = np.where(mask, (ranges - d - bias) / std, 0.0)
    cost = (_late_loss(z)[0] + np.where(mask, np.log(std), 0.0)).sum(axis=(-2, -1))
    height = (translation[..., 2] - level.height_m) / level.height_std_m
    tilt = (rotation[..., :2, 2] ** 2).sum(axis=-1) / level.tilt_std_rad**2
    return _Found(cost + 0.5 * (height**2 + tilt), z, std, bias)


def _step(
    ranges: FloatArray, mask: BoolArray, anchors: FloatArray, tags: FloatArray,
    model: DirectionModel, level: _Told, rotation: FloatArray, translation: FloatArray,
    now: _Found, damping: FloatArray,
) -> FloatArray:  # fmt: skip
    """Steps (H, K, 6) of the pose error."""
    u, _ = _rays(rotation, translation, anchors, tags)
    arms = tags @ np.swapaxes(rotation, -1, -2)
    J = np.concatenate([np.cross(arms[..., None, :, :], u), u], axis=-1)
    for i, axis in enumerate(np.eye(6)):
        turned = rotations.exp(_STEP * axis[:3]) @ rotation
        moved = translation + _STEP * axis[3:]
        J[..., i] += (direction_model_at(model, turned, moved, anchors, tags)[0] - now.bias) / _STEP
    z = now.residual
    weight = mask * np.where(z > 0, 1 / (1 + 0.5 * z * z), 1.0) / now.std**2
    weighted = weight[..., None] * J
    H = np.einsum("...mni,...mnj->...ij", weighted, J)
    g = np.einsum("...mni,...mn->...i", weighted, z * now.std)
    about = 1 / level.tilt_std_rad**2
    H[..., [0, 1], [0, 1]] += about
    g[..., 0] += about * rotation[..., 1, 2]
    g[..., 1] -= about * rotation[..., 0, 2]
    H[..., 5, 5] += 1 / level.height_std_m**2
    g[..., 5] -= (translation[..., 2] - level.height_m) / level.height_std_m**2
    diagonal = np.einsum("...ii->...i", H)
    diagonal *= 1 + damping[..., None]
    return np.clip(np.linalg.solve(H, g[..., None])[..., 0], -0.5, 0.5)

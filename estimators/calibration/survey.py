"""Anchor survey from ranges of a moving body and ranges between anchors, without ground truth.

Poses of all epochs, anchors and biases are adjusted jointly and robustly. Given the rest, poses are
independent of each other. Each is eliminated separately from the normal equations (Schur complement
over poses). The remaining system has only the unknowns of anchors and biases.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number
from rbl_gym.estimators.calibration import robust
from rbl_gym.geometry import rotations

__all__ = ["Survey", "SurveyModel", "SurveyState", "adjust"]

_ITERATIONS, _CONVERGED_M = 100, 1e-5
_LEAST_STD_M = 1e-4
# Weight of the constraints on a free frame, relative to the largest weight of the anchors.
_FIXED = 10.0
# Number of Jacobian entries in memory at one time.
_PIECE = 20_000_000


@dataclass(frozen=True)
class SurveyModel:
    """Prior knowledge of a survey.

    Parameters
    ----------
    bias_m, bias_std_m
        Common bias of all ranges, metres, and its standard deviation.
    link_std_m
        Standard deviation of the additional bias of each link, metres; 0: none.
    planar
        Anchors keep their heights, and the body its height, roll and pitch.
    """

    bias_m: float = 0.0
    bias_std_m: float = 0.5
    link_std_m: float = 0.05
    planar: bool = False

    def __post_init__(self) -> None:
        check_number("bias_m", self.bias_m)
        check_number("bias_std_m", self.bias_std_m, low=0.0)
        check_number("link_std_m", self.link_std_m, low=0.0)


class SurveyState(NamedTuple):
    """Anchors (M, 3), poses (K, 3, 3) and (K, 3), common bias, additional link biases (M, N)."""

    anchors: FloatArray
    rotation: FloatArray
    translation: FloatArray
    bias_m: float
    link_m: FloatArray


class Survey(NamedTuple):
    """Result of a survey.

    Attributes
    ----------
    state
        Anchors, poses, biases.
    std_m
        (M, 3) of the anchors; 0 for fixed ones. A free frame is that of the anchors' own centre
        and mean rotation.
    covariance
        (3 M + 1, 3 M + 1) of the anchors and the common bias.
    bias_std_m
        Standard deviation of the common bias.
    scale_std, scale_bias_correlation
        Relative standard deviation of the size of the layout, and its correlation with the common
        bias.
    noise_std_m
        Robust standard deviation of a range.
    residuals
        (K, M, N) metres, 0 without a range.
    """

    state: SurveyState
    std_m: FloatArray
    covariance: FloatArray
    bias_std_m: float
    scale_std: float
    scale_bias_correlation: float
    noise_std_m: float
    residuals: FloatArray


class _Problem(NamedTuple):
    ranges: FloatArray
    links: BoolArray
    tags: FloatArray
    pairs: FloatArray  # (M, M) ranges between anchors, 0 for none; upper triangle
    known: BoolArray  # (M,)
    model: SurveyModel
    lasting: float


def adjust(
    ranges: ArrayLike,
    links: ArrayLike,
    tags: ArrayLike,
    start: SurveyState,
    model: SurveyModel = SurveyModel(),
    known: ArrayLike | None = None,
    pairs: ArrayLike | None = None,
    lasting: float = 1.0,
) -> Survey:
    """Adjust anchors, poses and biases jointly, from a start.

    Parameters
    ----------
    ranges, links
        (K, M, N) metres, and a mask of the measured ranges. K may be 0 with `pairs`.
    tags
        (N, 3), body frame.
    start
        Start of the search (`survey_start`).
    model
        Biases, and whether the problem is planar.
    known
        (M,) mask of anchors that keep their start positions; default none. If they do not
        determine the frame, the anchors have no mean shift and no mean rotation from the start.
    pairs
        (M, M) ranges between anchors, metres, 0 for none; both directions are averaged.
    lasting
        Correlation length of the errors in epochs: this many ranges count as one.

    Raises
    ------
    ValueError
        If there are fewer ranges than unknowns.

    Notes
    -----
    Levenberg-Marquardt with iterated weights. A body with one tag has a position and no rotation.
    Triggs et al., "Bundle adjustment: a modern synthesis", 2000, describes it for cameras.
    """
    ranges = (
        check_array("ranges", ranges, ("K", "M", "N")) if np.size(ranges) else np.asarray(ranges)
    )
    mask = np.asarray(links, dtype=bool) & (ranges > 0)
    M = len(start.anchors)
    held = np.zeros(M, dtype=bool) if known is None else np.asarray(known, dtype=bool)
    between = np.zeros((M, M)) if pairs is None else check_array("pairs", pairs, (M, M))
    there, back = np.triu(between, 1), np.triu(between.T, 1)
    between = np.where((there > 0) & (back > 0), 0.5 * (there + back), np.maximum(there, back))
    table = check_array("tags", tags, ("N", 3))
    problem = _Problem(ranges, mask, table, between, held, model, lasting)
    _check_count(problem)
    return _result(problem, *_search(problem, start))


def _counts(problem: _Problem) -> tuple[int, int]:
    """Return the number of ranges and the number of unknowns they determine."""
    axes = 2 if problem.model.planar else 3
    per_epoch = problem.links.sum(axis=(1, 2))
    poses = _pose_axes(problem) * int((per_epoch > 0).sum())
    told = int(per_epoch.sum()) + int((problem.pairs > 0).sum())
    return told, poses + axes * int((~problem.known).sum())


def _check_count(problem: _Problem) -> None:
    told, unknown = _counts(problem)
    if told < unknown:
        raise ValueError(
            f"ranges must be at least as many as the unknowns, got {told} ranges and {unknown} "
            f"unknowns (coordinates of anchors, and {_pose_axes(problem)} for each epoch): each "
            f"epoch needs more than {_pose_axes(problem)} ranges, all of the same time"
        )


def _pose_axes(problem: _Problem) -> int:
    """Return the unknowns of a pose: rotations observable by the tags, and shifts."""
    turns = 0 if len(problem.tags) == 1 else 1 if problem.model.planar else 3
    return turns + (2 if problem.model.planar else 3)


def _linearized(
    problem: _Problem, state: SurveyState, part: slice
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (k, L), derivatives by poses (k, L, P) and by the rest (k, L, A)."""
    axes = [0, 1] if problem.model.planar else [0, 1, 2]
    turned = np.einsum("kij,nj->kni", state.rotation[part], problem.tags)
    apart = (turned + state.translation[part, None])[:, None] - state.anchors[:, None]
    d = np.maximum(np.linalg.norm(apart, axis=-1), 1e-9)
    u = apart / d[..., None]
    k, M, N = d.shape
    e = problem.ranges[part] - d - state.bias_m - state.link_m
    columns = [u[..., axes]]
    if N > 1:
        about = np.cross(turned[:, None], u)
        columns.insert(0, about[..., [2] if problem.model.planar else [0, 1, 2]])
    by_pose = np.concatenate(columns, axis=-1).reshape(k, M * N, -1)
    D = len(axes)
    rest = np.zeros((k, M, N, M * D + M * N + 1))
    for m in range(M):
        rest[:, m, :, m * D : (m + 1) * D] = -u[:, m][..., axes]
    rest = rest.reshape(k, M * N, -1)
    at = np.arange(M * N)
    rest[:, at, M * D + at] = 1.0
    rest[..., -1] = 1.0
    return e.reshape(k, -1), by_pose, rest


def _pair_rows(problem: _Problem, state: SurveyState) -> tuple[FloatArray, FloatArray]:
    """Return residuals of ranges between anchors, and derivatives by anchors and biases."""
    axes = [0, 1] if problem.model.planar else [0, 1, 2]
    i, j = np.nonzero(problem.pairs)
    M, D, A = len(state.anchors), len(axes), 0
    A = M * D + state.link_m.size + 1
    apart = state.anchors[i] - state.anchors[j]
    d = np.maximum(np.linalg.norm(apart, axis=-1), 1e-9)
    rows = np.zeros((len(i), A))
    at = np.arange(len(i))[:, None]
    rows[at, i[:, None] * D + np.arange(D)] = (apart / d[:, None])[:, axes]
    rows[at, j[:, None] * D + np.arange(D)] = -(apart / d[:, None])[:, axes]
    rows[:, -1] = 1.0
    return problem.pairs[i, j] - d - state.bias_m, rows


def _residuals(problem: _Problem, state: SurveyState) -> FloatArray:
    """Return the residuals of all measured ranges and pairs, in one row."""
    turned = np.einsum("kij,nj->kni", state.rotation, problem.tags)
    apart = (turned + state.translation[:, None])[:, None] - state.anchors[:, None]
    e = problem.ranges - np.linalg.norm(apart, axis=-1) - state.bias_m - state.link_m
    return np.concatenate([e[problem.links], _pair_rows(problem, state)[0]])


def _prior(problem: _Problem, state: SurveyState) -> tuple[FloatArray, FloatArray]:
    """Return information (A, A) and gradient (A,) of the prior, in 1/m^2."""
    model, M = problem.model, len(state.anchors)
    D = 2 if model.planar else 3
    link = np.full(state.link_m.size, max(model.link_std_m, 1e-6) ** -2.0)
    common = max(model.bias_std_m, 1e-6) ** -2.0
    weight = np.concatenate([np.where(np.repeat(problem.known, D), 1e12, 0.0), link, [common]])
    away = np.concatenate([np.zeros(M * D), state.link_m.ravel(), [state.bias_m - model.bias_m]])
    return np.diag(weight), -weight * away


def _frame(problem: _Problem, anchors: FloatArray) -> FloatArray:
    """Return orthonormal motions (M D, g) of all anchors that the ranges do not determine."""
    D = 2 if problem.model.planar else 3
    centred = anchors - anchors.mean(axis=0)
    shifts = np.tile(np.eye(D), (len(anchors), 1))
    turns = -rotations.hat(centred)[:, :, [2] if D == 2 else [0, 1, 2]][:, :D]
    free = np.hstack([shifts, turns.reshape(len(anchors) * D, -1)])
    if problem.known.any():
        held = free[np.repeat(problem.known, D)]
        values, vectors = np.linalg.svd(held)[1:]
        rank = int((values > 1e-6 * values[0]).sum())
        free = free @ vectors[rank:].T
    if not free.shape[1]:
        return free
    basis, triangle = np.linalg.qr(free)
    return basis[:, np.abs(np.diag(triangle)) > 1e-9]


def _reduced(
    problem: _Problem, state: SurveyState, std: float, damping: float
) -> tuple[FloatArray, FloatArray, list[tuple[FloatArray, FloatArray, FloatArray]]]:
    """Return the normal equations of anchors and biases, and back-substitution data per block."""
    K, L = len(problem.ranges), state.link_m.size
    H, g = _prior(problem, state)
    pieces: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    step = max(1, _PIECE // max(L * len(g), 1))
    for first in range(0, K, step):
        part = slice(first, min(first + step, K))
        e, J, B = _linearized(problem, state, part)
        w = robust.share_of(e / std) * problem.links[part].reshape(len(e), L)
        w = w / (std**2 * problem.lasting)
        wj = w[..., None] * J
        H_pp = wj.transpose(0, 2, 1) @ J
        diagonal = np.einsum("kii->ki", H_pp)
        diagonal += damping * diagonal + 1e-6
        H_pa = wj.transpose(0, 2, 1) @ B
        g_p = (wj * e[..., None]).sum(axis=1)
        flat = B.reshape(-1, B.shape[-1])
        H += flat.T @ (w.reshape(-1, 1) * flat)
        g += flat.T @ (w * e).ravel()
        solved = np.linalg.solve(H_pp, np.concatenate([H_pa, g_p[..., None]], axis=-1))
        H -= np.einsum("kpa,kpb->ab", H_pa, solved[..., :-1], optimize=True)
        g -= np.einsum("kpa,kp->a", H_pa, solved[..., -1])
        pieces.append((solved[..., :-1], solved[..., -1], H_pp))
    e, B = _pair_rows(problem, state)
    w = robust.share_of(e / std) / std**2
    H += B.T @ (w[:, None] * B)
    g += B.T @ (w * e)
    H = 0.5 * (H + H.T)
    basis = _frame(problem, state.anchors)
    n = len(basis)
    usual = float(np.median(np.diag(H)[:n][~np.repeat(problem.known, n // len(problem.known))]))
    H[:n, :n] += _FIXED * usual * basis @ basis.T
    return H, g, pieces


def _search(problem: _Problem, state: SurveyState) -> tuple[SurveyState, float]:
    damping, std = 1e-2, 0.0
    for iteration in range(_ITERATIONS):
        e = _residuals(problem, state)
        if iteration % 5 == 0 or iteration < 5:
            used = np.ones_like(e, dtype=bool)
            std = float(robust.spread(e, used, _LEAST_STD_M))
        cost = _cost(problem, state, e, std)
        H, g, pieces = _reduced(problem, state, std, damping)
        H[np.diag_indices_from(H)] *= 1 + damping
        step = np.linalg.solve(H, g)
        new = _moved(problem, state, step, pieces)
        better = cost - _cost(problem, new, _residuals(problem, new), std)
        if better > 0:
            moved = np.abs(new.anchors - state.anchors).max(initial=0.0)
            state, damping = new, max(damping / 5, 1e-9)
            if moved < _CONVERGED_M and better < 1e-6 * cost:
                break
        elif damping > 1e6:
            break
        else:
            damping *= 8
    return state, std


def _cost(problem: _Problem, state: SurveyState, residual: FloatArray, std: float) -> float:
    information, _ = _prior(problem, state)
    away = np.concatenate([state.link_m.ravel(), [state.bias_m - problem.model.bias_m]])
    prior = 0.5 * float(np.diag(information)[-len(away) :] @ away**2)
    loss = robust.loss_of(residual / std)
    n = int(problem.links.sum())
    return float(loss[:n].sum()) / problem.lasting + float(loss[n:].sum()) + prior


def _moved(
    problem: _Problem,
    state: SurveyState,
    step: FloatArray,
    pieces: list[tuple[FloatArray, FloatArray, FloatArray]],
) -> SurveyState:
    planar, M = problem.model.planar, len(state.anchors)
    D = 2 if planar else 3
    anchors, translation, rotation = state.anchors.copy(), state.translation, state.rotation
    anchors[:, :D] += step[: M * D].reshape(M, D)
    if pieces:
        poses = np.concatenate([by_pose - by_rest @ step for by_rest, by_pose, _ in pieces])
        turns = poses.shape[1] - D
        translation = translation.copy()
        translation[:, :D] += poses[:, turns:]
        if turns:
            axes = [2] if planar else [0, 1, 2]
            turn = np.clip(poses[:, :turns], -1.0, 1.0)
            rotation = rotations.exp(turn @ np.eye(3)[axes]) @ rotation
    link = state.link_m + step[M * D : -1].reshape(state.link_m.shape)
    return SurveyState(anchors, rotation, translation, state.bias_m + float(step[-1]), link)


def _result(problem: _Problem, state: SurveyState, std: float) -> Survey:
    M, D = len(state.anchors), 2 if problem.model.planar else 3
    told, unknown = _counts(problem)
    # Residuals are smaller than errors; the ratio depends on the number of unknowns.
    std *= np.sqrt(told / max(told - unknown, 1))
    H, _, _ = _reduced(problem, state, std, 0.0)
    cov = np.linalg.inv(H)
    at = np.concatenate([np.arange(M * D), [len(cov) - 1]])
    small = cov[np.ix_(at, at)]
    basis = _frame(problem, state.anchors)
    free = np.eye(M * D + 1)
    free[: M * D, : M * D] -= basis @ basis.T
    small = free @ small @ free.T
    centred = (state.anchors - state.anchors.mean(axis=0))[:, :D].ravel()
    scale = np.append(centred / (centred @ centred), 0.0)
    scale_std = float(np.sqrt(max(scale @ small @ scale, 0.0)))
    bias_std = float(np.sqrt(small[-1, -1]))
    together = float(scale @ small[:, -1]) / max(scale_std * bias_std, 1e-30)
    where = np.concatenate([(3 * np.arange(M)[:, None] + np.arange(D)).ravel(), [3 * M]])
    full = np.zeros((3 * M + 1, 3 * M + 1))
    full[np.ix_(where, where)] = small
    residual = np.zeros(problem.ranges.shape)
    residual[problem.links] = _residuals(problem, state)[: int(problem.links.sum())]
    return Survey(
        state,
        np.sqrt(np.maximum(np.diag(full)[:-1], 0.0)).reshape(M, 3) * ~problem.known[:, None],
        full,
        bias_std,
        scale_std,
        together,
        std,
        residual,
    )

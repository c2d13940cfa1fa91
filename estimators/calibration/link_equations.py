"""Equations of robust least squares for links and tags along a known path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_links, check_one_of
from rbl_gym.estimators.calibration import robust
from rbl_gym.estimators.calibration.drift import NO_DRIFT, Drift, Whitener, find_drift
from rbl_gym.geometry import rotations

__all__ = ["KnownPath", "LinkModel"]

# Prior standard deviations of the parameters, about zero or the table.
BIAS_M, SLOPE, ARM_M, TURN_RAD = 2.0, 0.1, 0.5, 1.0
_LEAST_STD_M = 1e-4
_ITERATIONS, _ROUNDS, _CONVERGED = 10, 3, 0.03
# Number of rows of the Jacobian in memory at one time.
_ROWS = 200_000


class KnownPath(NamedTuple):
    """Poses of the body at K epochs.

    Times (K,) in seconds, rotation (K, 3, 3) and translation (K, 3), metres. Times may step back
    from one run to the next.
    """

    times: FloatArray
    rotation: FloatArray
    translation: FloatArray


@dataclass(frozen=True)
class LinkModel:
    """Parameters to estimate.

    Parameters
    ----------
    biases
        ``"link"``: one per link. ``"node"``: one per anchor and per tag, which add up (antenna
        delays); the mean over the tags is zero. ``"common"``: one for all links.
    slopes
        One per link; with ``"node"`` and ``"common"`` one for all links.
    tags
        ``"held"``: fixed as in the table. ``"turned"``: the whole table is rotated and shifted.
        ``"free"``: each tag separately.
    planar
        Tags keep their heights and the table rotates about z only.
    """

    biases: str = "link"
    slopes: bool = True
    tags: str = "turned"
    planar: bool = False

    def __post_init__(self) -> None:
        check_one_of("biases", self.biases, ("link", "node", "common"))
        check_one_of("tags", self.tags, ("held", "turned", "free"))


class Problem(NamedTuple):
    """Least-squares problem: measurements, path, model, and the parameters' design and prior."""

    ranges: FloatArray  # (K, M, N)
    links: BoolArray
    anchors: FloatArray  # (K, M, 3)
    tags: FloatArray  # (N, 3) the table
    path: KnownPath
    model: LinkModel
    rotation: FloatArray
    design: FloatArray  # (2 M N + G, P) from parameters to those of links and the G others
    prior: FloatArray  # (P,) standard deviations
    n_link: int  # number of link parameters


class Fit(NamedTuple):
    """Estimated parameters, residuals and covariance."""

    parameters: FloatArray  # (P,)
    rotation: FloatArray  # (3, 3) of the table
    residual: FloatArray  # (K, M, N)
    std: FloatArray  # (M, N)
    drift: Drift
    covariance: FloatArray  # (P, P)


def problem_of(
    ranges: ArrayLike,
    links: ArrayLike | None,
    anchors: ArrayLike,
    tags: ArrayLike,
    path: KnownPath,
    model: LinkModel,
    rotation: ArrayLike | None,
) -> Problem:
    """Return the problem of checked arguments."""
    ranges = check_array("ranges", ranges, ("K", "M", "N"))
    tags = check_array("tags", tags, ("N", 3))
    K, M, N = ranges.shape
    anchors = check_array("anchors", anchors, ("M", 3))
    if anchors.shape not in ((M, 3), (K, M, 3)) or tags.shape != (N, 3):
        raise ValueError(
            f"anchors and tags must be ({M}, 3) and ({N}, 3) for ranges {ranges.shape}, got "
            f"{anchors.shape} and {tags.shape}"
        )
    shapes = {"times": (K,), "rotation": (K, 3, 3), "translation": (K, 3)}
    for name, shape in shapes.items():
        value = getattr(path, name)
        if np.shape(value) != shape:
            raise ValueError(f"path.{name} must be {shape}, got {np.shape(value)}")
    mask = ranges > 0 if links is None else check_links(links, ranges.shape)
    assert mask is not None
    if not mask.any():
        raise ValueError("ranges must have at least one measured link, got none")
    start = np.eye(3) if rotation is None else check_array("rotation", rotation, (3, 3))
    link_design, link_prior = _link_design(M, N, model)
    geometry = _geometry_prior(N, model)
    P, G = link_design.shape[1], len(geometry)
    design = np.zeros((2 * M * N + G, P + G))
    design[: 2 * M * N, :P] = link_design
    design[2 * M * N :, P:] = np.eye(G)
    everywhere = np.broadcast_to(anchors, (K, M, 3))
    prior = np.concatenate([link_prior, geometry])
    return Problem(ranges, mask, everywhere, tags, path, model, start, design, prior, P)


def _link_design(M: int, N: int, model: LinkModel) -> tuple[FloatArray, FloatArray]:
    """Return the design from link parameters to biases (M N), then slopes (M N), and priors."""
    L = M * N
    if model.biases == "link":
        bias = np.eye(L)
    elif model.biases == "common":
        bias = np.ones((L, 1))
    else:
        of_anchors = np.kron(np.eye(M), np.ones((N, 1)))
        of_tags = np.kron(np.ones((M, 1)), np.eye(N))
        bias = np.hstack([of_anchors, of_tags @ sum_zero(N)])
    slope = np.zeros((L, 0))
    if model.slopes:
        slope = np.eye(L) if model.biases == "link" else np.ones((L, 1))
    design = np.zeros((2 * L, bias.shape[1] + slope.shape[1]))
    design[:L, : bias.shape[1]] = bias
    design[L:, bias.shape[1] :] = slope
    return design, np.repeat([BIAS_M, SLOPE], [bias.shape[1], slope.shape[1]])


def sum_zero(n: int) -> FloatArray:
    """Return an orthonormal basis (n, n - 1) of vectors with zero sum."""
    return np.linalg.svd(np.ones((1, n)))[2][1:].T


def _geometry_prior(N: int, model: LinkModel) -> FloatArray:
    """Return prior standard deviations of the tags' parameters."""
    arms: dict[str, list[float]] = {
        "held": [],
        "turned": [TURN_RAD, ARM_M, ARM_M] if model.planar else [TURN_RAD] * 3 + [ARM_M] * 3,
        "free": [ARM_M] * ((2 if model.planar else 3) * N),
    }
    return np.array(arms[model.tags])


def axes_of(model: LinkModel) -> tuple[list[int], list[int]]:
    """Return the axes of rotation of the table, and the axes along which tags move."""
    return ([2], [0, 1]) if model.planar else ([0, 1, 2], [0, 1, 2])


def placed(
    problem: Problem, parameters: FloatArray, rotation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return tags (N, 3) in the body frame of the path, and their derivative (N, 3, G)."""
    model, table = problem.model, problem.tags
    turn_axes, move_axes = axes_of(model)
    N = len(table)
    geometry = parameters[problem.n_link :]
    turned = table @ rotation.T
    moving = np.eye(3)[:, move_axes]
    if model.tags == "held":
        return turned, np.zeros((N, 3, 0))
    if model.tags == "turned":
        turns = len(turn_axes)
        about = -rotations.hat(turned)[..., turn_axes]
        derivative = np.concatenate([about, np.broadcast_to(moving, (N, *moving.shape))], axis=-1)
        shift = geometry[turns : turns + len(move_axes)]
        return turned + moving @ shift, derivative
    width = len(move_axes)
    derivative = np.zeros((N, 3, width * N))
    for n in range(N):
        derivative[n, :, width * n : width * (n + 1)] = moving
    return turned + geometry[: width * N].reshape(N, width) @ moving.T, derivative


def directions(anchors: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (K, M, N, 3) from anchors to tags, and distances (K, M, N)."""
    apart = places[:, None] - anchors[:, :, None]
    d = np.maximum(np.linalg.norm(apart, axis=-1), 1e-9)
    return apart / d[..., None], d


def _residual_of(
    problem: Problem, parameters: FloatArray, rotation: FloatArray, jacobian: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals and distances (K, M, N), derivative (K, M, N, G) by the geometry."""
    K, M, N = problem.ranges.shape
    L = M * N
    of_links = problem.design[: 2 * L] @ parameters
    bias, scale = of_links[:L].reshape(M, N), 1 + of_links[L : 2 * L].reshape(M, N)
    tags, derivative = placed(problem, parameters, rotation)
    path = problem.path
    u, d = directions(problem.anchors, carried_tags(path, tags))
    residual = np.where(problem.links, problem.ranges - scale * d - bias, 0.0)
    if not jacobian:
        return residual, d, np.zeros((K, M, N, 0))
    in_body = np.einsum("kmni,kij->kmnj", u, path.rotation)
    columns = np.einsum("kmnj,njg->kmng", in_body, derivative)
    return residual, d, columns * scale[..., None]


def carried_tags(path: KnownPath, tags: FloatArray) -> FloatArray:
    """Return world positions (K, N, 3) of tags (N, 3) in the body frame."""
    return tags @ np.swapaxes(path.rotation, -1, -2) + path.translation[:, None]


def _normal(
    problem: Problem,
    parameters: FloatArray,
    rotation: FloatArray,
    errors: tuple[FloatArray, Drift],
    share: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return Gram matrices (M N, C, C) of whitened columns, and whitened residuals (K, M N).

    Columns are bias, slope, geometry and the residual. `errors` are standard deviations (M N,) and
    the slow part. `share` (K, M N) is the fraction of its weight that each range keeps.
    """
    K, M, N = problem.ranges.shape
    L = M * N
    whitener = Whitener(*errors, problem.path.times)
    grams, white = 0.0, []
    step = max(1, _ROWS // L)
    for first in range(0, K, step):
        part = slice(first, first + step)
        piece = problem._replace(
            ranges=problem.ranges[part],
            links=problem.links[part],
            anchors=problem.anchors[part],
            path=KnownPath(*(a[part] for a in problem.path)),
        )
        e, d, J = _residual_of(piece, parameters, rotation, True)
        used = piece.links.reshape(len(e), L)
        e, d, J = (a.reshape(len(e), L, *a.shape[3:]) for a in (e, d, J))
        one_and_d = np.stack([np.ones_like(d), d], axis=-1)
        columns = np.concatenate([one_and_d, J, e[..., None]], axis=-1)
        whitened = whitener.whitened(columns, used, share[part])
        by_link = np.ascontiguousarray(whitened.transpose(1, 2, 0))
        grams = grams + by_link @ by_link.transpose(0, 2, 1)
        white.append(whitened[..., -1])
    return np.asarray(grams), np.concatenate(white)


def _gathered(problem: Problem, grams: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return information (P, P) and gradient (P,) of the parameters, without the prior."""
    L = len(grams)
    G = grams.shape[-1] - 3
    H, g, at = np.zeros((2 * L + G, 2 * L + G)), np.zeros(2 * L + G), np.arange(L)
    for i in range(2):
        for j in range(2):
            H[i * L + at, j * L + at] = grams[:, i, j]
        rows = slice(i * L, (i + 1) * L)
        H[rows, 2 * L :] = grams[:, i, 2:-1]
        H[2 * L :, rows] = grams[:, i, 2:-1].T
        g[rows] = grams[:, i, -1]
    H[2 * L :, 2 * L :] = grams[:, 2:-1, 2:-1].sum(axis=0)
    g[2 * L :] = grams[:, 2:-1, -1].sum(axis=0)
    return problem.design.T @ H @ problem.design, problem.design.T @ g


def solve(problem: Problem) -> Fit:
    """Run Gauss-Newton with iterated weights; estimate the slow part of the errors in between."""
    K, L = len(problem.ranges), problem.links[0].size
    used = problem.links.reshape(K, L)
    parameters, rotation = np.zeros(len(problem.prior)), problem.rotation
    parameters[: problem.n_link] = _first_biases(problem, rotation)
    prior = np.diag(problem.prior**-2.0)
    drift = NO_DRIFT
    residual = _residual_of(problem, parameters, rotation, False)[0].reshape(K, L)
    std = robust.spread(residual, used, _LEAST_STD_M)
    white = residual / std
    for round in range(_ROUNDS):
        for _ in range(_ITERATIONS):
            share = robust.share_of(white)
            grams, white = _normal(problem, parameters, rotation, (std, drift), share)
            H, g = _gathered(problem, grams)
            covariance = np.linalg.inv(H + prior)
            step = covariance @ (g - prior @ _from_table(problem, parameters, rotation))
            parameters, rotation = _moved(problem, parameters, rotation, step)
            white = white / np.sqrt(share)
            # Weights depend on the spread of the whitened residuals.
            std = np.maximum(std * robust.spread(white, used, 1e-3), _LEAST_STD_M)
            if np.abs(step / np.sqrt(np.diag(covariance))).max() < _CONVERGED:
                break
        residual = _residual_of(problem, parameters, rotation, False)[0].reshape(K, L)
        if round < _ROUNDS - 1:
            total = robust.spread(residual, used, _LEAST_STD_M)
            new = find_drift(residual / total, used, problem.path.times)
            if new == drift == NO_DRIFT:
                break
            drift, std = new, total
    share = robust.share_of(white)
    grams, white = _normal(problem, parameters, rotation, (std, drift), share)
    kept = np.where(used, share, 0.0).sum(axis=0) / np.maximum(used.sum(axis=0), 1)
    factor = robust.variance_factor(white / np.sqrt(share), used) * np.where(kept > 0, kept, 1.0)
    H, _ = _gathered(problem, grams / factor[:, None, None])
    shape, std = problem.ranges.shape, robust.spread(residual, used, _LEAST_STD_M)
    return Fit(
        *(parameters, rotation, residual.reshape(shape), std.reshape(shape[1:]), drift),
        np.linalg.inv(H + prior),
    )


def _first_biases(problem: Problem, rotation: FloatArray) -> FloatArray:
    """Return initial parameters of the links by medians, with zero slopes."""
    zero = np.zeros(len(problem.prior))
    M, N = problem.ranges.shape[1:]
    residual = np.where(problem.links, _residual_of(problem, zero, rotation, False)[0], np.nan)
    seen = problem.links.any(axis=0)
    middle = np.zeros((M, N))
    middle[seen] = np.nanmedian(residual[:, seen], axis=0)
    design = problem.design[: M * N, : problem.n_link] * seen.reshape(-1, 1)
    return np.linalg.lstsq(design, middle.ravel(), rcond=None)[0]


def _from_table(problem: Problem, parameters: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the parameters less the mean of their prior."""
    away = parameters.copy()
    if problem.model.tags == "turned":
        axes = axes_of(problem.model)[0]
        turn = rotations.log(rotation @ problem.rotation.T)
        away[problem.n_link : problem.n_link + len(axes)] = turn[axes]
    return away


def _moved(
    problem: Problem, parameters: FloatArray, rotation: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    parameters = parameters + step
    if problem.model.tags == "turned":
        axes = axes_of(problem.model)[0]
        turned = slice(problem.n_link, problem.n_link + len(axes))
        rotation = rotations.exp(np.eye(3)[:, axes] @ step[turned]) @ rotation
        parameters[turned] = 0.0
    return parameters, rotation

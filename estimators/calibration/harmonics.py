"""Harmonics of bias and standard deviation by ray direction, from residuals along a known path.

The residuals of links are regressed on cosines and sines of the bearing at each end. The number of
harmonics, and whether each node has its own, are chosen by the prediction of held-out intervals of
time. Constants and slopes of the links are subtracted first.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, check_count, check_one_of
from rbl_gym.estimators.calibration import robust
from rbl_gym.estimators.calibration.link_equations import KnownPath, carried_tags, directions
from rbl_gym.measurements.direction_bias import DirectionLaw

__all__ = ["Candidate", "FoundDirections", "candidates_of", "fit_harmonics"]

# Prior standard deviations of coefficients: metres, logarithm of the standard deviation.
_BIAS_M, _LOG = 0.05, 0.3
# Mean and variance of log|z| for a standard Gaussian.
_MEAN_LOG, _VARIANCE_LOG = -0.635, 1.2337
_PARTS, _ROWS, _CELLS = 8, 60_000, 8_000_000
_LEAST = 0.1


class Candidate(NamedTuple):
    """Harmonics at one end or both.

    ``shared``: one model for all antennas of a body. Bearings are then relative to the direction of
    the antenna from its body's origin.
    """

    harmonics: int
    ends: str
    shared: bool


def candidates_of(most: int = 4, ends: str = "tags") -> list[Candidate]:
    """Return the candidates, the simplest first: none, shared by the antennas, one per node."""
    check_count("most", most, least=0, most=8)
    check_one_of("ends", ends, ("tags", "both"))
    kinds = itertools.product((True, False), range(1, most + 1))
    return [Candidate(0, ends, True), *(Candidate(k, ends, shared) for shared, k in kinds)]


class FoundDirections(NamedTuple):
    """Biases by direction.

    Attributes
    ----------
    law
        Model of all anchors and tags.
    bias, deviation
        The chosen candidates.
    gain
        Fraction of the variance of held-out residuals that the biases explain.
    spread_m
        Root mean square of the tags' coefficients of the largest harmonic beyond the first, or of
        the first if there is no other, metres. It estimates the size of a first harmonic, which is
        indistinguishable from a shift of the tags.
    """

    law: DirectionLaw
    bias: Candidate
    deviation: Candidate
    gain: float
    spread_m: float


def fit_harmonics(
    residuals: FloatArray,
    links: BoolArray,
    anchors: FloatArray,
    tags: FloatArray,
    path: KnownPath,
    candidates: Sequence[Candidate],
    lasting: float = 1.0,
    first: int = 1,
) -> FoundDirections:
    """Estimate bias and standard deviation by direction from the residuals of links.

    Parameters
    ----------
    residuals, links
        (K, M, N) metres, and a mask of the measured ranges.
    anchors, tags
        (M, 3) or (K, M, 3), and (N, 3) in the path's body frame.
    path
        Path of the body, at the epochs.
    candidates
        The simplest first. The first one that predicts held-out intervals as well as the best one,
        within one standard error, is chosen.
    lasting
        Correlation length of a link's errors, in epochs.
    first
        First harmonic of the tags to fit. Use 2 if the tag positions are estimated too, because
        these are equivalent to the first harmonic.
    """
    rows = _Rows.of(residuals, links, anchors, tags, path, candidates)
    y = residuals[rows.epoch, rows.anchor, rows.tag]
    z = y / max(float(robust.spread(y, np.ones(len(y), dtype=bool), 1e-4)), 1e-4)
    variance = float(np.median(np.abs(y)) / 0.6745) ** 2
    weight = robust.share_of(z) / max(variance, 1e-8)
    bias, chosen, gain = _chosen(rows, y, weight, candidates, lasting, _BIAS_M, first)
    left = y - rows.features @ bias
    std = max(float(np.median(np.abs(left))) / 0.6745, 1e-4)
    log = np.log(np.maximum(np.abs(left) / std, _LEAST)) - _MEAN_LOG
    weight = np.full(len(log), 1 / _VARIANCE_LOG)
    deviation, how, _ = _chosen(rows, log, weight, candidates, lasting, _LOG, 1)
    fields = zip(*(rows.by_node(x) for x in (bias, deviation)), strict=True)
    (a, log_a), (b, log_b) = (_trimmed(*pair) for pair in fields)
    law = DirectionLaw.of(a, b, log_a, log_b)
    size = np.sqrt((b.reshape(len(b), -1, 2) ** 2).mean(axis=(0, 2)))
    higher = size[1:] if size[1:].any() else size
    spread = float(higher.max()) if len(higher) else 0.0
    return FoundDirections(law, chosen, how, gain, spread)


class _Rows(NamedTuple):
    """Selected ranges: their indices, and the harmonics of their bearings."""

    epoch: np.ndarray  # (n,)
    anchor: np.ndarray
    tag: np.ndarray
    part: np.ndarray  # index of the interval of time
    distance: FloatArray
    features: FloatArray  # (n, 2 H (M + N)), by harmonic, then node: cosine, sine
    nodes: tuple[int, int]
    arms: FloatArray  # (M + N,) bearings of the antennas from their body's origin

    @classmethod
    def of(
        cls, residuals: FloatArray, links: BoolArray, anchors: FloatArray, tags: FloatArray,
        path: KnownPath, candidates: Sequence[Candidate],
    ) -> _Rows:  # fmt: skip
        K, M, N = residuals.shape
        most = max(candidate.harmonics for candidate in candidates)
        # Whole epochs, evenly spaced, so that every link is represented.
        heard = np.flatnonzero(links.any(axis=(1, 2)))
        rows = max(min(_ROWS, _CELLS // max(2 * most * (M + N), 1)), 1)
        heard = heard[:: -(-int(links.sum()) // rows)]
        at, m, n = np.nonzero(links[heard])
        k = heard[at]
        everywhere = np.broadcast_to(anchors, (K, M, 3))
        few, at = np.unique(k, return_inverse=True)
        some = KnownPath(*(a[few] for a in path))
        u, d = directions(everywhere[few], carried_tags(some, tags))
        back = -np.einsum("kmni,kij->kmnj", u, some.rotation)
        bearings = [np.arctan2(ray[..., 1], ray[..., 0])[at, m, n] for ray in (u, back)]
        features = np.zeros((len(k), most, M + N, 2))
        row = np.arange(len(k))
        for node, bearing in zip((m, M + n), bearings, strict=True):
            for h in range(most):
                features[row, h, node, 0] = np.cos((h + 1) * bearing)
                features[row, h, node, 1] = np.sin((h + 1) * bearing)
        middle = everywhere[few].mean(axis=0)
        points = np.concatenate([middle, tags])[:, :2]
        part = k * _PARTS // K
        return cls(
            k, m, n, part, d[at, m, n], features.reshape(len(k), -1), (M, N),
            np.arctan2(points[:, 1], points[:, 0]),
        )  # fmt: skip

    def columns(self, candidate: Candidate, first: int) -> FloatArray:
        """Return the matrix (F, c) from a candidate's coefficients to those of the features."""
        M, N = self.nodes
        most = self.features.shape[1] // (2 * (M + N)) if M + N else 0
        found = []
        for h, node in itertools.product(range(candidate.harmonics), range(M + N)):
            if (node < M and candidate.ends == "tags") or (node >= M and h + 1 < first):
                continue
            # cos(h (bearing - arm)) and its sine, by those of the bearing.
            turn = (h + 1) * self.arms[node] if candidate.shared else 0.0
            c, s = np.cos(turn), np.sin(turn)
            block = np.zeros((most, M + N, 2, 2))
            block[h, node] = [[c, -s], [s, c]]
            found.append(((h, node >= M), block.reshape(-1, 2)))
        if not found:
            return np.zeros((self.features.shape[1], 0))
        if not candidate.shared:
            return np.concatenate([block for _, block in found], axis=1)
        sides = dict.fromkeys(side for side, _ in found)
        return np.concatenate(
            [sum(b for side, b in found if side == one) for one in sides],
            axis=1,
        )

    def by_node(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients of the features as (M, 2 H) and (N, 2 H)."""
        M, N = self.nodes
        whole = coefficients.reshape(-1, M + N, 2).transpose(1, 0, 2).reshape(M + N, -1)
        return whole[:M], whole[M:]


def _trimmed(bias: FloatArray, log_std: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Drop the harmonics after the last nonzero one."""
    some = np.flatnonzero((bias != 0).any(axis=0) | (log_std != 0).any(axis=0))
    width = 2 * (some[-1] // 2 + 1) if len(some) else 0
    return bias[:, :width], log_std[:, :width]


def _chosen(
    rows: _Rows, y: FloatArray, weight: FloatArray, candidates: Sequence[Candidate],
    lasting: float, prior: float, first: int,
) -> tuple[FloatArray, Candidate, float]:  # fmt: skip
    """Return coefficients of the features, the chosen candidate, and its explained fraction."""
    X, y = _without_links(rows, weight, y)
    parts = [
        (X[at].T @ (weight[at, None] * X[at]), X[at].T @ (weight[at] * y[at]),
         float(weight[at] @ y[at] ** 2), max(float(weight[at].sum()), 1e-12))
        for at in (np.flatnonzero(rows.part == part) for part in range(_PARTS)) if len(at)
    ]  # fmt: skip
    scores, solved = [], []
    for candidate in candidates:
        E = rows.columns(candidate, first)
        grams = [(E.T @ G @ E, E.T @ g, s, w) for G, g, s, w in parts]
        H, g = sum(p[0] for p in grams), sum(p[1] for p in grams)
        held = np.eye(E.shape[1]) / prior**2

        def solve(H: FloatArray, g: FloatArray, held: FloatArray = held) -> FloatArray:
            return np.linalg.solve(H / lasting + held, g / lasting)

        solved.append(E @ solve(np.asarray(H), np.asarray(g)))
        score = []
        for G, own, squares, total in grams:
            x = solve(H - G, g - own)
            score.append((squares - 2 * x @ own + x @ G @ x) / total)
        scores.append(score)
    errors = np.array(scores)
    more = errors - errors[int(np.argmin(errors.mean(axis=1)))]
    slack = (
        more.std(axis=1, ddof=1) / np.sqrt(len(parts)) if len(parts) > 1 else np.zeros(len(more))
    )
    taken = int(np.argmax(more.mean(axis=1) <= slack))
    gain = 1 - errors[taken].mean() / max(errors[0].mean(), 1e-12)
    return solved[taken], candidates[taken], float(gain)


def _without_links(rows: _Rows, weight: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Remove a constant and a slope of every link from features and values."""
    both = np.concatenate([rows.features, y[:, None]], axis=1)
    link = rows.anchor * rows.nodes[1] + rows.tag
    order = np.argsort(link, kind="stable")
    for at in np.split(order, np.flatnonzero(np.diff(link[order])) + 1):
        w, d = weight[at], rows.distance[at]
        own = np.stack([np.ones_like(d), d - d.mean()], axis=1)
        H = own.T @ (w[:, None] * own) + 1e-9 * np.eye(2)
        both[at] -= own @ np.linalg.solve(H, own.T @ (w[:, None] * both[at]))
    return both[:, :-1], both[:, -1]

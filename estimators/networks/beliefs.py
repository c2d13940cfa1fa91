"""Beliefs over the poses of a planar network from one epoch, by cycle consensus."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, check_count
from rbl_gym.estimators.networks.consensus import CycleExchange, cycle_iteration
from rbl_gym.estimators.networks.orientations import along_tree
from rbl_gym.estimators.networks.poses import network_poses
from rbl_gym.networks.bounds import Sensing, linked_covariance, linked_to_0
from rbl_gym.networks.graphs import BASES, cycle_matrix
from rbl_gym.networks.sensing import edge_angles, proj

_TOL = 1e-9


class Consensus(NamedTuple):
    """Options of the cycle iteration; see `cycle_iteration`."""

    cycles: str = "bfs"
    kappa: float | str | None = None
    order: str = "synchronous"
    steps: int = 5000  # maximum


class NetworkBelief(NamedTuple):
    """Beliefs (...) over n nodes in the frame of node 0."""

    orientations: FloatArray  # (..., n) radians in [-pi, pi)
    positions: FloatArray | None  # (..., n, 2) metres; None without lengths
    # (..., n, 3, 3) of each node's orientation, x and y; (..., n, 1, 1) without lengths.
    covariance: FloatArray
    chi_square: FloatArray  # (...) per degree of freedom of the residuals; 0 without any


def check_consensus(cycles: Any, kappa: Any, order: Any, steps: Any) -> Consensus:
    """Check the options by a run on a triangle; raise ValueError that names a wrong one."""
    steps = check_count("steps", steps, least=0)
    if not isinstance(cycles, str):
        raise ValueError(f"cycles must be a name such as 'bfs', got {cycles!r:.80}")
    exchange = CycleExchange(order, np.random.default_rng(0))
    cycle_iteration([[0, 1], [1, 2], [0, 2]], np.zeros(3), 3, cycles, kappa, exchange=exchange)
    return Consensus(cycles, kappa, order, steps)


def consensus(
    links: BoolArray,
    bearings: FloatArray,
    before: FloatArray | None = None,
    options: Consensus | None = None,
    rng: np.random.Generator | None = None,
) -> tuple[FloatArray, int, bool]:
    """Estimate orientations (n,) by the cycle iteration; return also steps and convergence.

    Links are (n, n) symmetric, bearings (n, n) of j in the frame of i, radians. With approximate
    orientations `before` (n,), edge angles are taken within pi of theirs, so that the branch of
    every cycle is known. `rng` draws the order of the iteration.
    """
    options = options or Consensus()
    n_nodes = len(links)
    theta = np.zeros(n_nodes) if before is None else before.copy()
    edges = np.argwhere(np.triu(linked_to_0(links)))
    if not len(edges):
        return theta, 0, True
    near = np.isin(np.arange(n_nodes), edges)
    i, j = edges.T
    y = edge_angles(np.column_stack([bearings[i, j], bearings[j, i]]))
    named = (np.cumsum(near) - 1)[edges]
    size = int(near.sum())
    branch: FloatArray | None = None
    if before is not None:
        # The expected angles sum to 0 around any cycle, so angles near them must also.
        expected = before[j] - before[i]
        y = expected + proj(y - expected)
        count = len(edges) - size + 1
        if options.cycles not in BASES:
            count = cycle_matrix(named, size, options.cycles).shape[0]
        branch = np.zeros(count)
    run = cycle_iteration(
        named,
        y,
        size,
        options.cycles,
        options.kappa,
        tol=_TOL,
        max_steps=options.steps,
        exchange=CycleExchange(options.order, rng),
        branch=branch,
    )
    theta[near] = proj(along_tree(named, run.psi, size))
    return theta, run.steps, run.converged


def network_belief(
    links: BoolArray,
    bearings: FloatArray,
    lengths: FloatArray | None,
    orientations: FloatArray,
    positions: FloatArray,
    sensing: Sensing,
) -> NetworkBelief:
    """Return the belief about given orientations; with lengths, maximum-likelihood poses.

    Variances are scaled by max(1, chi-square per degree of freedom of the residuals). The variances
    of the prior are an upper bound. Links, bearings and lengths (None if not measured) are (..., n,
    n) as in `network_poses`; orientations (..., n) are from `consensus`, positions (..., n, 2).
    Nodes without a path to node 0 keep these.
    """
    if lengths is None:
        P = linked_covariance(links, sensing.bearing_std_rad, sensing.prior_std_rad)
        blocks = np.diagonal(P, axis1=-2, axis2=-1)[..., None, None]
        chi_square, degrees = _of_angles(links, bearings, orientations, sensing)
        places = None
    else:
        poses = network_poses(links, bearings, lengths, sensing, orientations, positions)
        orientations, places, chi_square, degrees = (
            poses.orientations,
            poses.positions,
            poses.chi_square,
            poses.degrees,
        )
        before = orientations.shape[-1] - 1
        node = np.arange(before)
        rows = np.stack([node, before + 2 * node, before + 2 * node + 1], axis=-1)
        blocks = poses.covariance[..., rows[:, :, None], rows[:, None, :]]
    # Less than one degree of freedom carries no information about the noise.
    chi_square = np.where(degrees > 0.9, chi_square / np.maximum(degrees, 0.9), 0.0)
    return NetworkBelief(orientations, places, _scaled(blocks, chi_square, sensing), chi_square)


def _of_angles(
    links: BoolArray, bearings: FloatArray, theta: FloatArray, sensing: Sensing
) -> tuple[FloatArray, FloatArray]:
    """Return chi-square (...) of the edge angles' residuals, and its degrees of freedom."""
    near = linked_to_0(links)
    y = bearings - bearings.swapaxes(-1, -2) + np.pi
    off = np.where(near, proj(y - theta[..., None, :] + theta[..., :, None]), 0.0)
    # Each edge occurs twice in the matrix; its variance is 2 sigma^2.
    chi_square = (off**2).sum(axis=(-2, -1)) / (4 * sensing.bearing_std_rad**2)
    unknown = np.maximum(near.any(axis=-1).sum(axis=-1) - 1, 0)
    return chi_square, near.sum(axis=(-2, -1)) / 2 - unknown


def _scaled(blocks: FloatArray, chi_square: FloatArray, sensing: Sensing) -> FloatArray:
    """Return covariances (..., n, k, k), node 0 first, scaled up to at most the prior."""
    most = np.array([sensing.prior_std_rad, sensing.prior_std_m, sensing.prior_std_m]) ** 2
    variance = np.diagonal(blocks, axis1=-2, axis2=-1)
    room = (most[: blocks.shape[-1]] / variance).min(axis=-1)
    scale = np.minimum(np.maximum(chi_square[..., None], 1.0), np.maximum(room, 1.0))
    reference = np.zeros((*blocks.shape[:-3], 1, *blocks.shape[-2:]))
    return np.concatenate([reference, blocks * scale[..., None, None]], axis=-3)

"""Run the experiment of the network paper: Figs 3 to 6, kappa against n, three nodes in space.

Source: G. Piovan, I. Shames, B. Fidan, F. Bullo, B. D. O. Anderson, "On frame and orientation
localization for relative sensing networks". Its variance is taken as that of a bearing, sigma^2, so
that an edge angle has 2 sigma^2. A mean square error is the mean over the edges. The paper shows
its ten points only in a drawing; `PLACES` are ours. In addition to the figures of the paper, the
convergence of (14) is measured on networks of ten nodes, uniform in a square.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import estimators
from rbl_gym.checks import FloatArray, check_array, check_number
from rbl_gym.estimators.networks import consensus
from rbl_gym.estimators.networks.orientations import along_tree
from rbl_gym.networks import graphs as network_graphs
from rbl_gym.networks import sensing
from rbl_gym.networks.bounds import edge_variance
from rbl_gym.networks.edges import IntArray
from rbl_gym.networks.sensing import check_positions, proj, unit_disk_edges
from rbl_gym.studies.papers import network_growth
from rbl_gym.studies.progress import Advance, silent

__all__ = ["network_experiment", "read_points"]

# Node 0, the reference, is at the bottom left, as in Fig. 6.
PLACES = np.array(
    [
        [0.07, 0.13],
        [0.13, 0.50],
        [0.60, 0.03],
        [0.37, 0.51],
        [0.14, 0.79],
        [0.66, 0.28],
        [0.15, 0.93],
        [0.67, 0.51],
        [0.82, 0.55],
        [0.95, 0.62],
    ]
)
LOOPS = (5, 10, 15, 20, 25, 30, 36)  # of Fig. 4, if no footprints are given
VARIANCE, RUN_VARIANCE = 0.1, 0.01  # sigma^2 of Fig. 4, of Figs 5 and 6
_SHOWN_LOOPS, _SHOWN_STEPS = 10, 60
_TOL = 1e-9

N_NODES = 10
BEARING_STD_RAD = float(np.sqrt(VARIANCE))
EXAMPLE_LOOPS = 15
BASES = network_graphs.BASES
RULES = consensus.STEP_RULES
LOSSES = (0.0, 0.2, 0.5)
# Number of networks on which convergence is measured.
_NETWORKS = 10
_STRETCHES = 6


class DrawnNetwork(NamedTuple):
    """A network of the experiment, its true orientations, and its edge angles."""

    positions: FloatArray
    theta: FloatArray
    edges: IntArray
    y: FloatArray


def network_experiment(
    trials: int,
    seed: int,
    advance: Advance = silent,
    *,
    positions: FloatArray | str | None = None,
    footprints: Sequence[float] | None = None,
    variance: float | None = None,
) -> dict[str, Any]:
    """Compute the figures of the paper, and the convergence of (14).

    Parameters
    ----------
    trials, seed
        Number of trials of Fig. 4 and of three nodes in space, and the random seed.
    advance
        Called after each of four steps.
    positions
        Fixed points (n, 2), the first of which is the reference, or the path of a CSV file of them
        with the header x,y; None: `PLACES`.
    footprints
        Sensing radii, in the unit of the positions. Each must connect the points. None: those that
        give `LOOPS` loops; for other points, at most eight that connect them.
    variance
        Variance sigma^2 of a bearing; None: as in the paper, 0.1 in Fig. 4, 0.01 in Figs 5 and 6.

    Returns
    -------
    dict
        Plain numbers:

        - ``networks`` (Fig. 3): points, footprints and edges.
        - ``accuracy`` (Fig. 4): for each footprint the mean square error of y, of the limit psi of
          (14) and of maximum likelihood, the bound ``2 sigma^2 (n - 1) / m``, and ratios to it.
        - ``run`` (Figs 5 and 6): for the largest footprint, the angle of every edge and the error
          of every loop over the steps, and true, measured and estimated orientations.
        - ``convergence``: a row for each cycle basis and rule for kappa. It has lambda_min,
          lambda_max, the measured and the true factor, the factor of Theorem 19, and the share
          of networks for which the theorem holds.
        - ``asynchronous``: rounds for each share of lost messages.
        - ``history``: errors of a run.
        - ``growth``: result of `network_growth.kappa_growth`.
        - ``space``: three nodes in space.

    Raises
    ------
    ValueError
        If a footprint does not connect the points, or an argument is invalid.
    """
    if isinstance(positions, str):
        positions = read_points(positions)
    places = PLACES if positions is None else check_positions(positions)
    radii = (
        _default_footprints(places)
        if footprints is None
        else sorted(check_number("footprint", radius, low=0.0) for radius in footprints)
    )
    if not radii:
        raise ValueError("footprints must have at least one radius, got none")
    advance(0, more=4)
    graphs = [_seen(places, radius) for radius in radii]
    result: dict[str, Any] = {"experiment": "network2009", "trials": trials, "seed": seed}
    result["networks"] = {
        "positions": places.tolist(),
        "footprints": [float(radius) for radius in radii],
        "edges": [edges.tolist() for edges in graphs],
    }
    if variance is not None:
        variance = check_number("variance", variance, low=1e-12)
    sigma = np.sqrt([VARIANCE, RUN_VARIANCE] if variance is None else [variance] * 2)
    result["variance"] = [float(one**2) for one in sigma]
    result["accuracy"] = [
        {
            "footprint": float(radius),
            **_accuracy(
                places, edges, float(sigma[0]), trials, np.random.default_rng([seed, len(edges)])
            ),
        }
        for radius, edges in zip(radii, graphs, strict=True)
    ]
    advance()
    result["run"] = _run(places, graphs[-1], float(sigma[1]), np.random.default_rng([seed, 500]))
    samples = [
        draw_network(EXAMPLE_LOOPS, np.random.default_rng([seed, 1000, k]))
        for k in range(_NETWORKS)
    ]
    result["convergence"] = {
        basis: {rule: _convergence(samples, basis, rule) for rule in RULES} for basis in BASES
    }
    rng = np.random.default_rng([seed, 2000])
    result["asynchronous"] = [_asynchronous(samples, loss, rng) for loss in LOSSES]
    result["history"] = {basis: _history(samples[0], basis) for basis in BASES}
    advance()
    result["growth"] = network_growth.kappa_growth(np.random.default_rng([seed, 3000]))
    advance()
    result["space"] = network_growth.three_in_space(trials, np.random.default_rng([seed, 4000]))
    advance()
    return result


def read_points(path: str) -> FloatArray:
    """Read points (n, 2) from a CSV file with the header x,y.

    Raises
    ------
    ValueError
        If the file is invalid; the message names it.
    """
    with open(path, encoding="utf-8") as file:
        header = file.readline().strip().replace(" ", "")
        if header != "x,y":
            raise ValueError(f"{path}: must have the header x,y, got {header!r:.40}")
        rows = []
        for number, line in enumerate(file, start=2):
            if line.strip():
                try:
                    x, y = map(float, line.split(","))
                except ValueError:
                    raise ValueError(
                        f"{path}, line {number}: must be two numbers x,y, got {line.strip()!r:.40}"
                    ) from None
                rows.append((x, y))
    points = check_array("positions", rows, ("n", 2)) if rows else np.zeros((0, 2))
    if len(points) < 3:
        raise ValueError(f"{path}: must have three points or more, got {len(points)}")
    return points


def _default_footprints(places: FloatArray) -> list[float]:
    """Return the default radii of footprints.

    For `PLACES` they give `LOOPS` loops. For other points they are eight, from the smallest that
    connects all points to one that connects all pairs.
    """
    n_nodes = len(places)
    pairs = np.array(list(itertools.combinations(range(n_nodes), 2)))
    apart = np.linalg.norm(places[pairs[:, 1]] - places[pairs[:, 0]], axis=1)
    steps = np.unique(apart.round(12))
    radii = [
        float(radius)
        for radius in (steps + np.append(steps[1:], 1.04 * steps[-1])) / 2
        if not network_graphs.components(pairs[apart <= radius], n_nodes).any()
    ]
    if places is PLACES:
        return [r for r in radii if np.sum(apart <= r) - n_nodes + 1 in LOOPS]
    return [radii[k] for k in np.unique(np.linspace(0, len(radii) - 1, 8).astype(int))]


def _seen(places: FloatArray, radius: float) -> IntArray:
    edges = unit_disk_edges(places, radius)
    if network_graphs.components(edges, len(places)).any():
        raise ValueError(f"footprint must connect all {len(places)} points, got {radius:g}")
    return edges


def draw_network(loops: int, rng: np.random.Generator) -> DrawnNetwork:
    """Draw a connected unit-disk graph with this many loops, its orientations and edge angles."""
    pairs = np.array(list(itertools.combinations(range(N_NODES), 2)))
    while True:
        positions = rng.uniform(0, 1, (N_NODES, 2))
        apart = np.linalg.norm(positions[pairs[:, 1]] - positions[pairs[:, 0]], axis=1)
        edges = pairs[np.sort(np.argsort(apart)[: N_NODES - 1 + loops])]
        if not network_graphs.components(edges, N_NODES).any():
            break
    theta = rng.uniform(-np.pi, np.pi, N_NODES)
    theta = proj(theta - theta[0])
    bearings = sensing.measure_bearings(positions, theta, edges, BEARING_STD_RAD, rng)
    return DrawnNetwork(positions, theta, edges, sensing.edge_angles(bearings))


def _accuracy(
    places: FloatArray, edges: IntArray, sigma: float, trials: int, rng: np.random.Generator
) -> dict[str, Any]:
    """Return one footprint of Fig. 4, over random orientations and noise."""
    n_nodes, m = len(places), len(edges)
    i, j = edges.T
    theta = rng.uniform(-np.pi, np.pi, (trials, n_nodes))
    true = theta[:, j] - theta[:, i]
    # By (8), the noise of an edge is that of its two bearings.
    y = proj(true + sigma * rng.standard_normal((2, trials, m)).sum(axis=0))
    psi = limit(network_graphs.cycle_matrix(edges, n_nodes).toarray(), y)
    found = np.array([estimators.orientations(edges, one, n_nodes) for one in y])
    errors = {
        name: np.mean(proj(one - true) ** 2, axis=1)
        for name, one in (("measured", y), ("consensus", psi), ("ml", found[:, j] - found[:, i]))
    }
    bound = edge_variance(m, n_nodes, sigma)
    return {
        "loops": m - n_nodes + 1,
        "edges": m,
        "bound": bound,
        "mse": {name: float(values.mean()) for name, values in errors.items()},
        "ratio": {name: float(values.mean()) / bound for name, values in errors.items()},
        "ratio_std_error": {
            name: float(values.std()) / bound / trials**0.5 for name, values in errors.items()
        },
    }


def limit(C: FloatArray, y: FloatArray) -> FloatArray:
    """Return limits (trials, m) of (14) from y for all trials at once, with kappa by Theorem 19."""
    if not len(C):
        return y
    kappa, psi = 2 / (1 + np.linalg.eigvalsh(C @ C.T)[-1]), y.copy()
    while np.abs(off := proj(psi @ C.T)).max() > _TOL:
        psi -= kappa * off @ C
    return psi


def _run(
    places: FloatArray, edges: IntArray, sigma: float, rng: np.random.Generator
) -> dict[str, Any]:
    """Return one run of (14): the curves of Fig. 5, the frames of Fig. 6."""
    n_nodes = len(places)
    theta = rng.uniform(-np.pi, np.pi, n_nodes)
    theta = proj(theta - theta[0])
    y = sensing.edge_angles(sensing.measure_bearings(places, theta, edges, sigma, rng))
    C = network_graphs.cycle_matrix(edges, n_nodes)
    run = consensus.cycle_iteration(edges, y, n_nodes, C, history=True)
    assert run.history is not None
    shown = run.history[: _SHOWN_STEPS + 1]
    i, j = edges.T
    return {
        "kappa": run.kappa,
        "steps": run.steps,
        "edge_angles": shown.tolist(),
        "loop_errors": proj((C @ shown.T).T).tolist() if C.shape[0] else [],
        "theta": theta.tolist(),
        "theta_measured": along_tree(edges, y, n_nodes).tolist(),
        "theta_estimated": along_tree(edges, run.psi, n_nodes).tolist(),
        "rms_measured": float(np.sqrt(np.mean(proj(y - theta[j] + theta[i]) ** 2))),
        "rms_estimated": float(np.sqrt(np.mean(proj(run.psi - theta[j] + theta[i]) ** 2))),
    }


def _convergence(samples: list[DrawnNetwork], basis: str, rule: str) -> dict[str, Any]:
    """Return means over the networks, and the largest difference of measured and true factor."""
    rows = [_one_convergence(one, basis, rule) for one in samples]
    table = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return {
        **{key: float(values.mean()) for key, values in table.items()},
        "largest_difference": float(np.abs(table["measured_factor"] - table["true_factor"]).max()),
    }


def _one_convergence(one: DrawnNetwork, basis: str, rule: str) -> dict[str, float]:
    C = network_graphs.cycle_matrix(one.edges, N_NODES, basis)
    low, high = consensus.eigenvalues(C)
    run = consensus.cycle_iteration(one.edges, one.y, N_NODES, C, rule, history=True)
    assert run.kappa is not None
    printed = consensus.printed_factor(run.kappa)
    true = consensus.convergence_factor(C, run.kappa)
    return {
        "kappa": run.kappa,
        "lambda_min": low,
        "lambda_max": high,
        "steps": float(run.steps),
        "measured_factor": measured_factor(one, C, run),
        "true_factor": true,
        "true_factor_squared": true**2,
        "printed_factor_squared": printed,
        "printed_holds": float(true**2 <= printed + 1e-12),
        "within_theorem": float(run.kappa <= (2 + 1e-9) / (1 + high)),
    }


def distances_from_limit(C: Any, y: FloatArray, run: consensus.CycleRun) -> FloatArray:
    """Return the distance of every psi of a run from the limit on its branch."""
    assert run.history is not None
    limit = consensus.cycle_projection(C, y, run.branch)
    return np.linalg.norm(run.history - limit, axis=1)


def measured_factor(one: DrawnNetwork, C: Any, run: consensus.CycleRun) -> float:
    """Return the factor of a step, from late errors that rounding does not yet affect.

    The errors are scaled to their initial size and iterated again, until one mode remains.
    """
    psi, factor = one.y, 0.0
    nothing = np.zeros(C.shape[0])
    limit = consensus.cycle_projection(C, one.y, run.branch)
    for _ in range(_STRETCHES):
        again = consensus.cycle_iteration(
            one.edges, psi, N_NODES, C, run.kappa, history=True, branch=run.branch
        )
        distance = distances_from_limit(C, one.y, again)
        late = np.flatnonzero(distance > 1e-8 * distance[0])
        first, last = late[len(late) // 2], late[-1]
        factor = float((distance[last] / distance[first]) ** (1 / (last - first)))
        assert again.history is not None
        stretched = (again.history[last] - limit) * (distance[0] / distance[last])
        # Rounding errors outside the cycle space are scaled too, and no step would remove them.
        psi = limit + stretched - consensus.cycle_projection(C, stretched, nothing)
    return factor


def _asynchronous(
    samples: list[DrawnNetwork], loss: float, rng: np.random.Generator
) -> dict[str, Any]:
    steps, off = [], []
    for one in samples:
        C = network_graphs.cycle_matrix(one.edges, N_NODES, "paton")
        exchange = consensus.CycleExchange("asynchronous", rng, loss)
        run = consensus.cycle_iteration(one.edges, one.y, N_NODES, C, exchange=exchange)
        steps.append(run.steps)
        limit = consensus.cycle_projection(C, one.y, run.branch)
        off.append(float(np.abs(run.psi - limit).max()))
    return {"loss": loss, "rounds": float(np.mean(steps)), "largest_error_rad": max(off)}


def _history(one: DrawnNetwork, basis: str) -> dict[str, Any]:
    """Return distances from the limit over the steps of a run, and those of Theorem 19."""
    C = network_graphs.cycle_matrix(one.edges, N_NODES, basis)
    run = consensus.cycle_iteration(one.edges, one.y, N_NODES, C, history=True)
    assert run.kappa is not None
    distance = distances_from_limit(C, one.y, run)
    squared = consensus.printed_factor(run.kappa)
    return {
        "distance": distance.tolist(),
        "printed_factor_squared": squared,
        "printed_distance": (distance[0] * squared ** (np.arange(len(distance)) / 2)).tolist(),
    }

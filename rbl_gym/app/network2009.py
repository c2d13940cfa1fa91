"""The sensing-network paper's experiment: the cycle iteration against the bound, its speed.

Source: G. Piovan, I. Shames, B. Fidan, F. Bullo, B. D. O. Anderson, "On frame and orientation
localization for relative sensing networks". Variances are read as sigma^2 = 0.1 of a bearing,
2 sigma^2 of an edge angle; networks are unit-disk graphs of 10 nodes uniform in a square,
whose radius leaves the wanted number of edges.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import estimators, network_graphs, sensing_network
from rbl_gym.checks import FloatArray
from rbl_gym.estimators import consensus
from rbl_gym.network_bounds import edge_variance
from rbl_gym.sensing_network import IntArray, proj

N_NODES = 10
BEARING_STD_RAD = float(np.sqrt(0.1))
LOOPS = (5, 10, 15, 20, 25, 30, 36)
EXAMPLE_LOOPS = 15
BASES = ("bfs", "paton", "minimum")
RULES = consensus.STEP_RULES
LOSSES = (0.0, 0.2, 0.5)
# Networks that convergence is measured on.
_NETWORKS = 20
_STRETCHES = 6


class Sample(NamedTuple):
    """A network of the experiment."""

    positions: FloatArray
    theta: FloatArray
    edges: IntArray
    y: FloatArray


def work_units() -> int:
    """How often `run` calls `advance`."""
    return len(LOOPS) + 1


def run(trials: int, seed: int, advance: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Error against the number of loops, and convergence.

    Returns
    -------
    A dict of plain numbers. ``loops``: for each number of loops the mean square error of an
    edge angle (Fig 4) of the measured angles, of the iteration's limit and of maximum
    likelihood, the bound ``2 sigma^2 (n - 1) / m`` and ratios to it. ``convergence``: for each
    cycle basis and step rule lambda_min and lambda_max, the measured and the true factor, and
    Theorem 19's, of the squared error, with the share of networks where it holds.
    ``asynchronous``: rounds for each share of lost messages. ``history``: errors of one run.
    """
    result: dict[str, Any] = {"experiment": "network2009", "trials": trials, "seed": seed}
    result["loops"] = []
    for loops in LOOPS:
        result["loops"].append(_accuracy(loops, trials, np.random.default_rng([seed, loops])))
        advance()
    samples = [sample(EXAMPLE_LOOPS, np.random.default_rng([seed, 1000, k]))
               for k in range(_NETWORKS)]  # fmt: skip
    result["convergence"] = {
        basis: {rule: _convergence(samples, basis, rule) for rule in RULES} for basis in BASES
    }
    rng = np.random.default_rng([seed, 2000])
    result["asynchronous"] = [_asynchronous(samples, loss, rng) for loss in LOSSES]
    result["history"] = {basis: _history(samples[0], basis) for basis in BASES}
    advance()
    return result


def sample(loops: int, rng: np.random.Generator) -> Sample:
    """A connected unit-disk graph with this many loops, its truth and its edge angles."""
    pairs = np.array(list(itertools.combinations(range(N_NODES), 2)))
    while True:
        positions = rng.uniform(0, 1, (N_NODES, 2))
        apart = np.linalg.norm(positions[pairs[:, 1]] - positions[pairs[:, 0]], axis=1)
        edges = pairs[np.sort(np.argsort(apart)[: N_NODES - 1 + loops])]
        if not network_graphs.components(edges, N_NODES).any():
            break
    theta = rng.uniform(-np.pi, np.pi, N_NODES)
    theta = proj(theta - theta[0])
    bearings = sensing_network.measure(positions, theta, edges, BEARING_STD_RAD, rng)
    return Sample(positions, theta, edges, sensing_network.edge_angles(bearings))


def _accuracy(loops: int, trials: int, rng: np.random.Generator) -> dict[str, Any]:
    errors: dict[str, list[float]] = {"measured": [], "consensus": [], "ml": []}
    for _ in range(trials):
        _, theta, edges, y = sample(loops, rng)
        i, j = edges.T
        # The iteration's limit, which a test holds it to.
        limit = consensus.cycle_projection(network_graphs.cycle_matrix(edges, N_NODES, "paton"), y)
        found = estimators.orientations(edges, y, N_NODES)
        for name, psi in (("measured", y), ("consensus", limit), ("ml", found[j] - found[i])):
            errors[name].append(float(np.mean(proj(psi - (theta[j] - theta[i])) ** 2)))
    m = N_NODES - 1 + loops
    bound = edge_variance(m, N_NODES, BEARING_STD_RAD)
    return {
        "loops": loops,
        "edges": m,
        "bound": bound,
        "mse": {name: float(np.mean(values)) for name, values in errors.items()},
        "ratio": {name: float(np.mean(values)) / bound for name, values in errors.items()},
        "ratio_std_error": {
            name: float(np.std(values)) / bound / trials**0.5 for name, values in errors.items()
        },
    }


def _convergence(samples: list[Sample], basis: str, rule: str) -> dict[str, Any]:
    """Means over the networks; the measured factor against the true one at its worst."""
    rows = [_one_convergence(one, basis, rule) for one in samples]
    table = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return {
        **{key: float(values.mean()) for key, values in table.items()},
        "largest_difference": float(np.abs(table["measured_factor"] - table["true_factor"]).max()),
    }


def _one_convergence(one: Sample, basis: str, rule: str) -> dict[str, float]:
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
        "printed_factor_squared": printed,
        "printed_holds": float(true**2 <= printed + 1e-12),
    }


def errors(C: Any, y: FloatArray, run: consensus.CycleRun) -> FloatArray:
    """Distance of every psi of a run from the limit on its branch."""
    assert run.history is not None
    limit = consensus.cycle_projection(C, y, run.branch)
    return np.linalg.norm(run.history - limit, axis=1)


def measured_factor(one: Sample, C: Any, run: consensus.CycleRun) -> float:
    """Factor of a step, from late errors that rounding does not yet touch.

    They are stretched to their first size and iterated on, until one mode is left.
    """
    psi, factor = one.y, 0.0
    nothing = np.zeros(C.shape[0])
    limit = consensus.cycle_projection(C, one.y, run.branch)
    for _ in range(_STRETCHES):
        again = consensus.cycle_iteration(one.edges, psi, N_NODES, C, run.kappa, history=True,
                                          branch=run.branch)  # fmt: skip
        distance = errors(C, one.y, again)
        late = np.flatnonzero(distance > 1e-8 * distance[0])
        first, last = late[len(late) // 2], late[-1]
        factor = float((distance[last] / distance[first]) ** (1 / (last - first)))
        assert again.history is not None
        stretched = (again.history[last] - limit) * (distance[0] / distance[last])
        # Rounding off the cycles is stretched as well, and no step would take it away.
        psi = limit + stretched - consensus.cycle_projection(C, stretched, nothing)
    return factor


def _asynchronous(samples: list[Sample], loss: float, rng: np.random.Generator) -> dict[str, Any]:
    steps, off = [], []
    for one in samples:
        C = network_graphs.cycle_matrix(one.edges, N_NODES, "paton")
        run = consensus.cycle_iteration(one.edges, one.y, N_NODES, C, order="asynchronous",
                                        rng=rng, loss=loss)  # fmt: skip
        steps.append(run.steps)
        limit = consensus.cycle_projection(C, one.y, run.branch)
        off.append(float(np.abs(run.psi - limit).max()))
    return {"loss": loss, "rounds": float(np.mean(steps)), "largest_error_rad": max(off)}


def _history(one: Sample, basis: str) -> list[float]:
    C = network_graphs.cycle_matrix(one.edges, N_NODES, basis)
    run = consensus.cycle_iteration(one.edges, one.y, N_NODES, C, history=True)
    return errors(C, one.y, run).tolist()

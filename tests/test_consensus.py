"""Cycle consensus: the ring, the iteration (14), its factor, its limit in any order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from rbl_gym import estimators
from rbl_gym.estimators.networks import consensus
from rbl_gym.estimators.networks.consensus import (
    CycleExchange,
    cycle_consensus,
    cycle_iteration,
    cycle_projection,
)
from rbl_gym.networks.graphs import BASES, cycle_matrix
from rbl_gym.networks.sensing import proj, random_network
from rbl_gym.studies.papers import network2009
from tests.helpers import load

GOLDEN = load("network_golden.json")
every_case = pytest.mark.parametrize("case", GOLDEN["cases"], ids=["5", "16", "31"])
every_basis = pytest.mark.parametrize("basis", BASES)


def networks(count, sigma=0.3, seed=0, most=30):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        one = random_network(int(rng.integers(8, most)), rng.uniform(4, 8), sigma, rng)
        yield one.edges, one.y, len(one.positions)


def test_ring_example():
    ring = GOLDEN["ring"]
    got = estimators.ring_least_squares(ring["y"])
    np.testing.assert_allclose(got, ring["psi"], atol=1e-12)
    batch = estimators.ring_least_squares([ring["y"], [0.1, 0.1, 0.1, -0.1]])
    np.testing.assert_allclose(batch[0], got, atol=0)
    np.testing.assert_allclose(batch[1], [0.05, 0.05, 0.05, -0.15], atol=1e-15)


@every_basis
def test_a_ring_is_the_iterations_simplest_case(basis):
    ring = [[0, 1], [1, 2], [2, 3], [3, 0]]
    psi = cycle_consensus(ring, GOLDEN["ring"]["y"], 4, basis)
    np.testing.assert_allclose(psi, GOLDEN["ring"]["psi"], atol=1e-12)


@every_case
def test_reference_networks(case):
    C = cycle_matrix(case["E"], len(case["P"]))
    low, high = consensus.eigenvalues(C)
    assert low == pytest.approx(case["lambda_min"], rel=1e-10)
    assert high == pytest.approx(case["lambda_max"], rel=1e-10)
    np.testing.assert_allclose(cycle_projection(C, case["y"]), case["projection"], atol=1e-10)
    run = cycle_iteration(case["E"], case["y"], len(case["P"]))
    assert run.kappa == pytest.approx(case["iteration14"]["kappa"], rel=1e-10)
    np.testing.assert_allclose(run.psi, case["iteration14"]["psi"], atol=1e-10)
    assert abs(run.steps - case["iteration14"]["steps"]) <= 0.1 * run.steps


@every_basis
def test_the_limit_is_the_projection_on_its_branch_in_any_order(basis):
    tol = 1e-10
    for seed, (edges, y, n_nodes) in enumerate(networks(2, most=16)):
        C = cycle_matrix(edges, n_nodes, basis)
        bound = tol / np.sqrt(consensus.eigenvalues(C)[0]) + 1e-12
        runs = [cycle_iteration(edges, y, n_nodes, C, tol=tol)]
        runs += [
            cycle_iteration(edges, y, n_nodes, C, rule, tol=tol) for rule in consensus.STEP_RULES
        ]
        for k, (kappa, loss) in enumerate([(None, 0.0), (None, 0.4), (0.1, 0.0)]):
            exchange = CycleExchange("asynchronous", np.random.default_rng([seed, k]), loss)
            run = cycle_iteration(edges, y, n_nodes, C, kappa, tol=tol, exchange=exchange)
            runs.append(run)
        for run in runs:
            assert run.converged
            limit = cycle_projection(C, y, run.branch)
            assert np.linalg.norm(run.psi - limit) <= bound
            np.testing.assert_allclose(C @ run.psi, 2 * np.pi * run.branch, atol=2 * tol)


@pytest.mark.parametrize("rule", consensus.STEP_RULES)
@every_basis
def test_measured_factor_is_the_true_one(basis, rule):
    row = network2009._convergence(
        [network2009.draw_network(15, np.random.default_rng(0))], basis, rule
    )
    assert row["largest_difference"] < 1e-3
    if basis == "bfs":
        assert row["printed_holds"] == 1
        assert row["lambda_min"] >= 1 - 1e-9


def test_the_step_must_be_below_two_over_lambda_max():
    edges, y, n_nodes = next(networks(1))
    high = consensus.largest_eigenvalue(cycle_matrix(edges, n_nodes))
    assert cycle_iteration(edges, y, n_nodes, kappa=1.99 / high, tol=1e-6).converged
    for wrong in (2 / high, 0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="kappa must"):
            cycle_iteration(edges, y, n_nodes, kappa=wrong)
    with pytest.raises(ValueError, match="kappa must be one of 'theorem', 'best', 'trace', 'rows'"):
        cycle_iteration(edges, y, n_nodes, kappa="fast")


@every_basis
def test_every_rule_is_what_it_says(basis):
    for edges, _, n_nodes in networks(3, seed=8):
        C = cycle_matrix(edges, n_nodes, basis)
        values = np.linalg.eigvalsh((C @ C.T).toarray())
        want = {
            "theorem": 2 / (1 + values[-1]),
            "best": 2 / (values[0] + values[-1]),
            "trace": 2 / (1 + np.abs(C.toarray()).sum()),
            "rows": 2 / (1 + np.abs((C @ C.T).toarray()).sum(axis=1).max()),
        }
        for rule, kappa in want.items():
            assert consensus.step_size(C, rule) == pytest.approx(kappa, rel=1e-10)
            assert kappa < 2 / values[-1]
            true = np.abs(1 - kappa * values).max()
            assert consensus.convergence_factor(C, kappa) == pytest.approx(true, rel=1e-10)
            assert consensus.convergence_factor(C, want["best"]) <= true + 1e-12
            if basis == "bfs":  # Theorem 19, of the squared error
                assert true**2 <= consensus.printed_factor(kappa) + 1e-12


def test_the_printed_factor_is_one_minus_kappa_squared():
    """At Theorem 19's bound it is the true one of a basis with lambda_min = 1."""
    assert consensus.printed_factor(0.25) == 0.5625
    pairs = [[i, j] for i in range(6) for j in range(i + 1, 6)]
    C = cycle_matrix(pairs, 6)  # K6, the cycles of a star: eigenvalues 1 and 6
    assert consensus.eigenvalues(C) == pytest.approx((1, 6))
    kappa = consensus.step_size(C, "theorem")
    true = consensus.convergence_factor(C, kappa)
    assert true**2 == pytest.approx(consensus.printed_factor(kappa))


K4 = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


def test_all_cycles_of_k4_agree_with_the_projection_or_say_that_they_cannot():
    """7 cycles of rank 3, noise of 0.9 rad an edge: cycles often slip, some against others."""
    rng = np.random.default_rng(0)
    C = cycle_matrix(K4, 4, "all")
    rests = 0
    for k in range(80):
        y = proj(rng.normal(0, 0.9, 6))
        order = consensus.ORDERS[k % 10 == 0]
        run = cycle_iteration(K4, y, 4, "all", exchange=CycleExchange(order, rng))
        assert np.isfinite(run.psi).all()
        assert run.converged == run.consistent
        if run.consistent:
            np.testing.assert_allclose(run.psi, cycle_projection(C, y, run.branch), atol=1e-10)
            B = np.linalg.lstsq(C.toarray(), C @ y - 2 * np.pi * run.branch, rcond=None)[0]
            np.testing.assert_allclose(run.psi, y - B, atol=1e-10)
        else:
            rests += 1
            with pytest.raises(ValueError, match="branch must be rint"):
                cycle_projection(C, y, run.branch)
            with pytest.raises(ValueError, match="and no angles give"):
                cycle_iteration(K4, y, 4, "all", branch=run.branch)
            with pytest.raises(RuntimeError, match=r"did not converge in \d+ steps: branch"):
                cycle_consensus(K4, y, 4, "all", max_steps=1000)
    assert 0 < rests < 20


def test_dependent_cycles_of_consistent_branches_give_what_a_basis_gives():
    """Copies of cycles and all cycles span what a basis spans; the nearest branches agree."""
    rng = np.random.default_rng(3)
    y = 0.1 * rng.standard_normal((5, 6))
    basis = cycle_matrix(K4, 4)
    want = cycle_projection(basis, y)
    for C in (cycle_matrix(K4, 4, "all"), sp.csr_matrix(sp.vstack([basis, basis[:1], -basis[1:]]))):
        np.testing.assert_allclose(cycle_projection(C, y), want, atol=1e-12)
        np.testing.assert_allclose(cycle_consensus(K4, y[0], 4, C), want[0], atol=1e-10)
    # The eigenvalues that are not zero are all alike: one step.
    assert consensus.eigenvalues(cycle_matrix(K4, 4, "all")) == pytest.approx((8, 8))
    assert cycle_iteration(K4, y[0], 4, "all", "best").steps == 1


def test_a_random_order_that_cannot_come_to_rest_ends():
    """Branches 1, 0, 0, 0, -1, 0, 0 of K4 contradict each other; Kaczmarz would run for ever."""
    rng = np.random.default_rng(0)
    C = cycle_matrix(K4, 4, "all")
    while True:
        y = proj(rng.normal(0, 0.9, 6))
        if not cycle_iteration(K4, y, 4, C).consistent:
            break
    for order, loss in (("asynchronous", 0.0), ("synchronous", 0.3)):
        exchange = CycleExchange(order, np.random.default_rng(1), loss)
        run = cycle_iteration(K4, y, 4, C, exchange=exchange)
        assert run.converged == run.consistent
        assert run.steps < 5000


def test_projection_of_many_is_the_projection_of_each():
    edges, y, n_nodes = next(networks(1, seed=9))
    C = cycle_matrix(edges, n_nodes)
    many = y + 0.1 * np.random.default_rng(0).standard_normal((2, 3, len(y)))
    got = cycle_projection(C, many)
    for k in np.ndindex(2, 3):
        np.testing.assert_allclose(got[k], cycle_projection(C, many[k]), atol=1e-12)


def test_sparse_eigenvalues_agree_with_dense_ones(monkeypatch):
    edges, _, n_nodes = next(networks(1, seed=4))
    C = cycle_matrix(edges, n_nodes)
    dense = consensus.eigenvalues(C)
    monkeypatch.setattr(consensus, "_DENSE", 0)
    assert consensus.eigenvalues(C) == pytest.approx(dense, rel=1e-8)
    assert consensus.largest_eigenvalue(C) == pytest.approx(dense[1], rel=1e-8)


def test_history_begins_with_y_and_lost_messages_do_nothing():
    edges, y, n_nodes = next(networks(1))
    run = cycle_iteration(edges, y, n_nodes, history=True)
    assert run.history is not None
    assert run.history.shape == (run.steps + 1, len(edges))
    np.testing.assert_array_equal(run.history[0], y)
    np.testing.assert_array_equal(run.history[-1], run.psi)
    silence = CycleExchange(rng=np.random.default_rng(0), loss=1.0)
    lost = cycle_iteration(edges, y, n_nodes, exchange=silence, max_steps=5)
    np.testing.assert_array_equal(lost.psi, y)
    assert not lost.converged
    with pytest.raises(RuntimeError, match="did not converge in 5 steps"):
        cycle_consensus(edges, y, n_nodes, max_steps=5)


def test_a_branch_that_is_known_is_kept_in_any_order():
    edges, y, n_nodes = next(networks(1, seed=6))
    C = cycle_matrix(edges, n_nodes)
    branch = np.random.default_rng(0).integers(-2, 3, C.shape[0])
    limit = cycle_projection(C, y, branch)
    for order in consensus.ORDERS:
        exchange = CycleExchange(order, np.random.default_rng(1))
        run = cycle_iteration(edges, y, n_nodes, C, exchange=exchange, branch=branch)
        np.testing.assert_array_equal(run.branch, branch)
        np.testing.assert_allclose(run.psi, limit, atol=1e-10)


def test_trees_and_single_nodes_stay_as_they_are():
    y = np.array([0.3, -2.0, 1.0])
    for basis in BASES:
        np.testing.assert_array_equal(cycle_consensus([[0, 1], [0, 2], [2, 3]], y, 4, basis), y)
        assert cycle_consensus([], [], 1, basis).shape == (0,)


def test_an_edge_that_comes_twice_was_measured_twice():
    psi = cycle_consensus([[0, 1], [1, 0]], [0.5, -0.7], 2)
    np.testing.assert_allclose(psi, [0.6, -0.6], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"y": [0.1, np.nan, 0.2]}, "y must be finite, got nan at index"),
        ({"y": [0.1, 0.2]}, r"y must have shape \(3,\), a row for each edge"),
        ({"n_nodes": 4}, "2 components"),
        ({"cycles": "some"}, "cycles must be one of"),
        ({"cycles": np.ones((1, 2))}, "one for each edge"),
        ({"cycles": 2 * np.array([[1, 1, -1]])}, "must have only the entries -1, 0 and 1, got 2"),
        ({"cycles": [[1, 1, 1]]}, "closed walks, but row 0 is an open one"),
        ({"exchange": CycleExchange("random")}, "order must be one of"),
        (
            {"exchange": CycleExchange("asynchronous")},
            r"rng must be a numpy\.random\.Generator, .* got None",
        ),
        ({"max_steps": -1}, "max_steps must be an int of at least 0, got -1"),
        ({"max_steps": 2.5}, r"max_steps must be an int of at least 0, got 2\.5"),
        ({"exchange": CycleExchange(loss=1.5)}, "loss must be"),
        ({"tol": -1.0}, "tol must be"),
        ({"branch": [0.5]}, "branch must be 1 whole numbers"),
        ({"branch": [0, 1]}, "branch must have shape"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    triangle = {"edges": [[0, 1], [1, 2], [0, 2]], "y": [0.1, 0.2, 0.3], "n_nodes": 3}
    arguments: dict[str, Any] = {**triangle, **change}
    with pytest.raises(ValueError, match=message):
        cycle_iteration(**arguments)


@pytest.mark.parametrize(
    ("y", "branch", "message"),
    [
        ([0.1, 0.2, 0.3], [0.5], "branch must be 1 whole numbers"),
        ([0.1, 0.2, 0.3], [0, 1], "branch must have shape"),
        (np.zeros((2, 4)), None, "y must have shape"),
    ],
)
def test_wrong_arguments_of_the_projection_are_named(y, branch, message):
    with pytest.raises(ValueError, match=message):
        cycle_projection(np.array([[1.0, 1.0, -1.0]]), y, branch)


@pytest.mark.parametrize("trials", [200, pytest.param(1000, marks=pytest.mark.long)])
def test_accuracy_is_the_bounds_from_5_to_36_loops(trials):
    """Figure 4, to 4 standard deviations.

    Of 9 degrees of freedom a mean square scatters by sqrt(2 / 9), of m edges by sqrt(2 / m). A
    cycle slips by 2 pi in one trial of 600 or so, and that adds 3 % to the mean.
    """
    for loops in (5, 36):
        radius = network2009._default_footprints(network2009.PLACES)[network2009.LOOPS.index(loops)]
        edges = network2009._seen(network2009.PLACES, radius)
        row = network2009._accuracy(
            network2009.PLACES, edges, 0.1**0.5, trials, np.random.default_rng([0, loops])
        )
        assert row["loops"] == loops
        tolerance = 4 * np.sqrt(2 / 9 / trials) + 0.03
        assert row["ratio"]["consensus"] == pytest.approx(1, abs=tolerance)
        tolerance = 4 * np.sqrt(2 / row["edges"] / trials)
        assert row["ratio"]["measured"] * row["bound"] == pytest.approx(0.2, rel=tolerance)

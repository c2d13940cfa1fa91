"""Weighted Procrustes against closed forms, brute force and the reference implementation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from rbl_gym.estimators.linear import squared_range
from rbl_gym.estimators.linear.least_squares import procrustes, unvec, vec
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from tests.helpers import load


def test_vec_stacks_columns_and_unvec_undoes_it():
    M = np.arange(9.0).reshape(3, 3)
    np.testing.assert_array_equal(vec(M), M.ravel(order="F"))
    np.testing.assert_array_equal(unvec(vec(M)), M)
    assert vec(np.zeros((2, 3, 4))).shape == (2, 12)


@given(st.integers(0, 10_000))
def test_with_unit_weight_it_is_the_nearest_rotation(seed):
    rng = np.random.default_rng(seed)
    M = rotations.random(rng) + 0.2 * rng.standard_normal((3, 3))
    Q, cost = procrustes(np.eye(9), vec(M), rotations.random(rng))
    np.testing.assert_allclose(cost, 0.5 * np.sum((Q - M) ** 2))
    # From any start it ends in a stationary point, and from the projection it stays there.
    np.testing.assert_allclose(
        procrustes(np.eye(9), vec(M), rotations.nearest(M))[0], rotations.nearest(M), atol=1e-9
    )
    S = Q.T @ M
    np.testing.assert_allclose(S, S.T, atol=1e-7)


@pytest.mark.parametrize("spread", [1.0, 100.0])
def test_the_best_of_a_few_starts_is_the_global_optimum(spread):
    rng = np.random.default_rng(4)
    for _ in range(4):
        root = rng.standard_normal((9, 9)) * np.geomspace(1, spread, 9)
        weight, target = root @ root.T, vec(rotations.random(rng)) + 0.3 * rng.standard_normal(9)

        def residual(w, root=root, target=target):
            return root.T @ (vec(rotations.exp(w)) - target)

        starts = rotations.random(rng, (24,))
        Q, costs = procrustes(weight, target, starts)
        brute = min(least_squares(residual, rotations.log(q), method="lm").cost for q in starts)
        assert costs.min() <= brute * (1 + 1e-6)
        found = [0.5 * np.sum(residual(rotations.log(q)) ** 2) for q in Q]
        np.testing.assert_allclose(costs, found, rtol=1e-6)


@pytest.mark.parametrize("case", load("static_estimates.json"), ids=["40 dB", "80 dB", "60 dB"])
def test_weighted_procrustes_of_the_reference_implementation(case):
    anchors, tags, ranges = np.array(case["A"]).T, np.array(case["C"]).T, np.array(case["rhat"])
    noise = ranging.RangeNoise(0.0, case["s0"], reference_tag=0)
    weights = 1 / noise.squared_range_variance(ranges)
    matrix, vector = squared_range.information(
        squared_range.statistic(ranges, anchors, tags, weights)
    )
    # The translation eliminated: Schur complement of the 12 x 12 information.
    cross = np.linalg.solve(matrix[9:, 9:], matrix[9:, :9])
    weight = matrix[:9, :9] - matrix[:9, 9:] @ cross
    target = np.linalg.solve(weight, vector[:9] - cross.T @ vector[9:])
    Q, costs = procrustes(weight, target, rotations.random(np.random.default_rng(0), (12,)))
    np.testing.assert_allclose(Q[np.argmin(costs)], case["WOPP"]["Q"], atol=1e-7)

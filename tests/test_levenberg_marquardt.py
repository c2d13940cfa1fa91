"""The Gauss-Newton loop on problems whose minimum is known."""

from __future__ import annotations

import numpy as np

from rbl_gym.estimators.costs.levenberg_marquardt import Linearization, minimize_pose
from rbl_gym.geometry import rotations


def to_pose(rotation, translation, log=rotations.error):
    """Squared distance to a pose, residual (log(Q R^T), t - s), Gauss-Newton Hessian."""

    def linearize(Q, t):
        turn, shift = log(Q, rotation), t - translation
        D = rotations.left_jacobian_inverse(turn)
        hessian = np.zeros((*turn.shape[:-1], 6, 6))
        hessian[..., :3, :3] = np.swapaxes(D, -1, -2) @ D
        hessian[..., 3:, 3:] = np.eye(3)
        pulled = (np.swapaxes(D, -1, -2) @ turn[..., None])[..., 0]
        cost = 0.5 * (np.sum(turn**2, axis=-1) + np.sum(shift**2, axis=-1))
        return Linearization(cost, np.concatenate([pulled, shift], axis=-1), hessian)

    return linearize


def test_finds_the_pose_from_anywhere_and_says_so():
    rng = np.random.default_rng(1)
    rotation, start = rotations.random(rng, (20,)), rotations.random(rng, (20,))
    translation = rng.standard_normal((20, 3))
    found = minimize_pose(to_pose(rotation, translation), start, np.zeros((20, 3)), 50)
    assert found.converged.all()
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-8)
    np.testing.assert_allclose(found.translation, translation, atol=1e-12)


def test_never_raises_the_cost_and_damps_where_it_would():
    """A gradient ten times too large overshoots: the cost falls all the same."""
    rng = np.random.default_rng(2)
    honest = to_pose(rotations.random(rng), np.ones(3))

    def exaggerated(Q, t):
        at = honest(Q, t)
        return at._replace(hessian=0.1 * at.hessian)

    start = rotations.random(rng, (10,)), np.zeros((10, 3))
    costs = [minimize_pose(exaggerated, *start, iterations=k).at.cost for k in range(25)]
    # Below 1e-4 standard deviations steps are taken unseen: 1e-8 of cost.
    assert (np.diff(costs, axis=0) <= 1e-7).all()
    assert (costs[-1] < 0.2 * costs[0]).all()


def test_too_few_iterations_are_not_called_converged():
    rng = np.random.default_rng(3)
    problem = to_pose(rotations.random(rng), 100 * np.ones(3))
    assert not minimize_pose(problem, rotations.random(rng), np.zeros(3), 1).converged

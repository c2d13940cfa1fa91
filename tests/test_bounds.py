"""Bounds against finite differences, naive recursions, sampled errors, and a reference file.

``data/static_bounds.json``: the static paper's setting, computed by an independent
implementation; anchors A and tags C are columns there.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rbl_gym import bounds, metrics
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.measurements.ranging import RangeNoise, SquaredRangeNoise
from rbl_gym.motion import ProcessNoise
from tests.helpers import assert_bound, load

PROPERTY = settings(deadline=None, derandomize=True, max_examples=30)
SEEDS = st.integers(0, 2**32 - 1)
CASES = load("static_bounds.json")
PROCESS = ProcessNoise((0.1, 0.2, 0.0), (0.3, 0.0, 0.5))
LAWS = [
    RangeNoise(0.1),
    RangeNoise(0.05, 0.01),
    RangeNoise(0.0, 0.01, reference_tag=0),
    RangeNoise(0.05, 0.01, reference_tag=-1),
    SquaredRangeNoise(0.1),
]
every_law = pytest.mark.parametrize("law", LAWS, ids=str)


def world(seed: int, batch: tuple[int, ...] = (), n_anchors: int = 5, n_tags: int = 5):
    """Anchors about 10 m away, tags about 1 m off the body's origin, a pose."""
    rng = np.random.default_rng(seed)
    anchors = rng.normal(0, 10, (*batch, n_anchors, 3))
    tags = rng.standard_normal((*batch, n_tags, 3))
    return anchors, tags, rotations.random(rng, batch), rng.standard_normal((*batch, 3))


def draw_covariance(seed: int, batch: tuple[int, ...] = ()) -> np.ndarray:
    root = np.random.default_rng(seed).standard_normal((*batch, 6, 9))
    return root @ np.swapaxes(root, -1, -2)


def tag_places(error: np.ndarray, tags, Q, t) -> np.ndarray:
    """Tags (N, 3) in the world at the pose off by ``error = (w, v)``, with scipy's rotation."""
    turn = Rotation.from_rotvec(error[:3]).as_matrix()
    return np.stack([turn @ Q @ tag + t + error[3:] for tag in tags])


def naive_range_information(anchors, tags, Q, t, law, links=None) -> np.ndarray:
    """sum of J^T J / var, the gradients J of each distance by central differences."""
    step = 1e-5

    def distances(error):
        places = tag_places(error, tags, Q, t)
        return np.array([[np.linalg.norm(s - a) for s in places] for a in anchors])

    gradient = np.stack([distances(step * e) - distances(-step * e) for e in np.eye(6)]) / 2 / step
    true = distances(np.zeros(6))
    variance = np.broadcast_to(law.variance(true), true.shape)
    information = np.zeros((6, 6))
    for m, n in np.ndindex(true.shape):
        if links is None or links[m, n]:
            information += np.outer(gradient[:, m, n], gradient[:, m, n]) / variance[m, n]
    return information


def assert_close(got, want, rtol: float = 1e-9) -> None:
    """Equal to `rtol` of the largest entry of each matrix."""
    scale = np.abs(want).max(axis=(-2, -1), keepdims=True)
    np.testing.assert_allclose(got / scale, want / scale, atol=rtol, rtol=0)


# --- Fisher information -----------------------------------------------------------------------


@PROPERTY
@given(SEEDS)
def test_tag_jacobian_equals_finite_differences(seed):
    _, tags, Q, t = world(seed)
    step = 1e-5
    want = np.stack(
        [tag_places(step * e, tags, Q, t) - tag_places(-step * e, tags, Q, t) for e in np.eye(6)],
        axis=-1,
    ) / (2 * step)
    np.testing.assert_allclose(bounds.tag_jacobian(Q, tags), want, atol=1e-8)


@every_law
@pytest.mark.parametrize("seed", range(3))
def test_range_information_equals_finite_differences(law, seed):
    w = world(seed)
    want = naive_range_information(*w, law)
    assert_close(bounds.range_information(*w, law), want, 1e-8)


@every_law
def test_lost_links_tell_nothing(law):
    w = world(4)
    links = np.random.default_rng(4).random((5, 5)) < 0.6
    want = naive_range_information(*w, law, links)
    for mask in (links, links.astype(int), links.tolist()):
        assert_close(bounds.range_information(*w, law, mask), want, 1e-8)


def test_anchor_on_a_tag_tells_nothing_of_that_tag():
    _, tags, _, t = world(5, n_anchors=1)
    # A quarter turn and halves, exact in any order of sums.
    tags, Q, t = np.round(2 * tags) / 2, np.eye(3)[[1, 2, 0]], np.round(t)
    anchor = ranging.tag_positions(Q, t, tags)[:1]
    links = np.array([[True, False, False, False, False]])
    got = bounds.range_information(anchor, tags, Q, t, RangeNoise(0.1), links)
    np.testing.assert_array_equal(got, np.zeros((6, 6)))
    distance, unit = bounds.directions(anchor, ranging.tag_positions(Q, t, tags))
    assert distance[0, 0] == 0
    np.testing.assert_array_equal(unit[0, 0], np.zeros(3))


@pytest.mark.parametrize("law", [RangeNoise(0.0, 0.01), SquaredRangeNoise(0.1)], ids=str)
def test_anchor_on_a_tag_without_noise_floor_gives_no_nan(law):
    _, tags, Q, t = world(5)
    anchors = np.concatenate([ranging.tag_positions(Q, t, tags)[1:2], 10 * np.eye(3)])
    assert np.isfinite(bounds.range_information(anchors, tags, Q, t, law)).all()


# --- the static bound -------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['db']} dB")
def test_static_bound_equals_the_reference(case):
    anchors, tags, Q = np.array(case["A"]).T, np.array(case["C"]).T, np.array(case["Q"])
    noise = RangeNoise(floor_m=0.0, proportional=case["s0"], reference_tag=0)
    P = bounds.pose_crb(anchors, tags, Q, case["t"], noise)
    assert_close(P, np.array(case["crb6"]), 1e-9)
    assert_bound(P, Q, case["bound"])


@PROPERTY
@given(SEEDS, st.sampled_from(LAWS))
def test_bound_is_the_inverse_of_information_and_prior(seed, law):
    w, prior = world(seed), draw_covariance(seed)
    information = bounds.range_information(*w, law)
    eye = np.eye(6)
    np.testing.assert_allclose(bounds.pose_crb(*w, law) @ information, eye, atol=1e-7)
    with_prior = bounds.pose_crb(*w, law, prior_information=prior)
    np.testing.assert_allclose(with_prior @ (information + prior), eye, atol=1e-7)


def geometries() -> dict:
    """Name -> (anchors, tags, rank of the information)."""
    anchors, tags, _, _ = world(6)
    line = np.linspace(-1, 1, 5)[:, None] * [0.6, 0.0, 0.8]
    return {
        "one tag": (anchors, tags[:1], 3),
        "two tags": (anchors, tags[:2], 5),
        "collinear tags": (anchors, line + 0.3, 5),
        "one anchor": (anchors[:1], tags, 3),
        "two anchors": (anchors[:2], tags, 5),
        "coincident anchors": (np.repeat(anchors[:1], 5, axis=0), tags, 3),
        "one anchor, one tag": (anchors[:1], tags[:1], 1),
        "three anchors": (anchors[:3], tags, 6),
        "coplanar tags": (anchors, tags * [1, 1, 0], 6),
    }


@pytest.mark.parametrize("case", geometries())
@pytest.mark.parametrize("unit_m", [1e-3, 1.0, 1e3])
def test_singular_geometry_is_named_with_its_rank_in_any_unit(case, unit_m):
    anchors, tags, rank = geometries()[case]
    _, _, Q, t = world(6)
    w = anchors / unit_m, tags / unit_m, Q, t / unit_m
    law = RangeNoise(0.05 / unit_m, 0.01)
    assert bounds.information_rank(bounds.range_information(*w, law)) == rank
    if rank == 6:
        bounds.pose_crb(*w, law)
        return
    with pytest.raises(ValueError, match=f"information has rank {rank} of 6"):
        bounds.pose_crb(*w, law)
    prior = np.diag([1.0] * 3 + [unit_m**2] * 3)
    assert np.isfinite(bounds.pose_crb(*w, law, prior_information=prior)).all()


def test_singular_trial_of_a_batch_is_named():
    anchors, tags, Q, t = world(7, (3, 2))
    anchors[1, 0] = anchors[1, 0, :1]
    with pytest.raises(ValueError, match=r"has rank 3 of 6 at index \(1, 0\)"):
        bounds.pose_crb(anchors, tags, Q, t, LAWS[0])


@pytest.mark.parametrize("rank", range(7))
def test_rank_is_free_of_units(rank):
    root = np.random.default_rng(rank).standard_normal((6, rank))
    units = np.array([1e-6, 1e6, 1.0, 1e3, 1e-3, 1.0])
    scaled = units[:, None] * root
    assert bounds.information_rank(root @ root.T) == rank
    assert bounds.information_rank(scaled @ scaled.T) == rank


# --- the world may be moved, renamed, measured in other units ---------------------------------


@every_law
@pytest.mark.parametrize("batched", [(0,), (1,), (2,), (3,), (0, 2), (0, 1, 2, 3)])
def test_batched_arguments_are_a_loop_over_trials(law, batched):
    many, one = world(8, (4, 2)), world(9)
    w = [many[i] if i in batched else one[i] for i in range(4)]
    got = bounds.pose_crb(*w, noise=law)
    assert got.shape == (4, 2, 6, 6)
    for index in np.ndindex(4, 2):
        trial = [x[index] if i in batched else x for i, x in enumerate(w)]
        assert_close(got[index], bounds.pose_crb(*trial, noise=law), 1e-9)


def test_links_of_many_trials_mask_one_world():
    w, links = world(10), np.random.default_rng(1).random((3, 5, 5)) < 0.8
    got = bounds.pose_crb(*w, LAWS[3], links=links)
    for mask, P in zip(links, got, strict=True):
        assert_close(P, bounds.pose_crb(*w, LAWS[3], links=mask))


# --- recursions -------------------------------------------------------------------------------


def naive_step(twist: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """F and Q of one step, written out; Jl by its power series."""
    w = twist[:3] * dt
    W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    jacobian, term = np.eye(3), np.eye(3)
    for k in range(2, 40):
        term = term @ W / k
        jacobian = jacobian + term
    F, Q = np.eye(6), np.zeros((6, 6))
    F[:3, :3] = Rotation.from_rotvec(w).as_matrix()
    Q[:3, :3] = dt * jacobian @ np.diag([0.1**2, 0.2**2, 0.0]) @ jacobian.T
    Q[3:, 3:] = dt * np.diag([0.3**2, 0.0, 0.5**2])
    return F, Q


@PROPERTY
@given(SEEDS, st.floats(0.05, 2))
def test_predicted_covariance_equals_the_naive_one(seed, dt):
    P, twist = draw_covariance(seed), np.random.default_rng(seed).standard_normal(6)
    F, Q = naive_step(twist, dt)
    assert_close(bounds.predict_covariance(P, twist, dt, PROCESS), F @ P @ F.T + Q, 1e-13)


def test_predicted_covariance_is_that_of_sampled_errors():
    n, dt, twist = 40_000, 0.5, np.array([1.0, -2.0, 0.5, 1.0, 2.0, 3.0])
    rng = np.random.default_rng(2)
    P, process = 1e-4 * draw_covariance(3), ProcessNoise(0.01, 0.02)
    error = rng.multivariate_normal(np.zeros(6), P, n)
    noise = rng.standard_normal((n, 6)) * process.std() / dt**0.5
    Q0 = rotations.exp(error[:, :3])  # the truth is the identity
    estimate = rotations.exp(twist[:3] * dt) @ Q0
    truth = rotations.exp((twist + noise)[:, :3] * dt)
    sampled = np.concatenate(
        [rotations.error(estimate, truth), error[:, 3:] - noise[:, 3:] * dt], axis=-1
    )
    want = bounds.predict_covariance(P, twist, dt, process)
    scale = np.outer(np.diag(want), np.diag(want))
    off = np.abs(np.cov(sampled.T) - want)
    # 4.5 standard deviations of a sampled covariance, 0.5 % for the second order.
    assert (off <= 4.5 * np.sqrt((scale + want**2) / n) + 5e-3 * np.sqrt(scale)).all()


@PROPERTY
@given(SEEDS, st.floats(0.05, 2), st.sampled_from(LAWS))
def test_posterior_step_equals_the_naive_recursion(seed, dt, law):
    w, rng = world(seed), np.random.default_rng(seed)
    J, naive = np.linalg.inv(draw_covariance(seed)), np.linalg.inv(draw_covariance(seed))
    for _ in range(4):
        twist = rng.standard_normal(6)
        F, Q = naive_step(twist, dt)
        naive = np.linalg.inv(F @ np.linalg.inv(naive) @ F.T + Q)
        naive = naive + naive_range_information(*w, law)
        J = bounds.posterior_crb_step(J, *w, law, twist, dt, PROCESS)
        assert_close(J, naive, 1e-7)
        np.testing.assert_allclose(J, J.T, rtol=1e-12)


@pytest.mark.parametrize("rank", range(6))
def test_posterior_step_starts_from_singular_information(rank):
    w, rng = world(11), np.random.default_rng(rank)
    root, twist, dt = rng.standard_normal((6, rank)), rng.standard_normal(6), 0.5
    F, Q = naive_step(twist, dt)
    turned = F @ root @ root.T @ F.T
    # (T^-1 + Q)^-1 = T - T S (I + S^T T S)^-1 S^T T with Q = S S^T, which needs no T^-1.
    values, vectors = np.linalg.eigh(Q)
    S = vectors * np.sqrt(np.maximum(values, 0))
    inner = np.linalg.inv(np.eye(6) + S.T @ turned @ S)
    want = turned - turned @ S @ inner @ S.T @ turned
    want = want + naive_range_information(*w, LAWS[1])
    got = bounds.posterior_crb_step(root @ root.T, *w, LAWS[1], twist, dt, PROCESS)
    assert_close(got, want, 1e-8)


def test_posterior_steps_of_a_batch_are_a_loop():
    w, rng = world(12, (3, 2)), np.random.default_rng(0)
    J, twist = draw_covariance(0, (3, 2)), rng.standard_normal((3, 2, 6))
    links = rng.random((3, 2, 5, 5)) < 0.7
    got = bounds.posterior_crb_step(J, *w, LAWS[1], twist, 0.2, PROCESS, links)
    for i in np.ndindex(3, 2):
        anchors, tags, Q, t = (x[i] for x in w)
        one = bounds.posterior_crb_step(
            J[i], anchors, tags, Q, t, LAWS[1], twist[i], 0.2, PROCESS, links[i]
        )
        assert_close(got[i], one)


# --- score ------------------------------------------------------------------------------------


@PROPERTY
@given(SEEDS)
def test_score_equals_the_naive_sum(seed):
    _, tags, Q, _ = world(seed)
    P = draw_covariance(seed)
    total = 0.0
    for tag in tags:
        c = Q @ tag
        J = np.hstack([[[0, c[2], -c[1]], [-c[2], 0, c[0]], [c[1], -c[0], 0]], np.eye(3)])
        total += np.trace(J @ P @ J.T)
    np.testing.assert_allclose(bounds.score(P, Q, tags), (total / 5) ** 0.5, rtol=1e-12)


def test_score_is_the_root_mean_square_tag_error_of_sampled_poses():
    _, tags, Q, t = world(13)
    P, n = 1e-6 * draw_covariance(13), 20_000
    error = np.random.default_rng(0).multivariate_normal(np.zeros(6), P, n)
    poses = rotations.exp(error[:, :3]) @ Q, t + error[:, 3:]
    squared = metrics.tag_error(*poses, Q, t, tags) ** 2
    # 4.5 standard deviations of the mean, 0.1 % for the second order.
    off = abs(squared.mean() - bounds.score(P, Q, tags) ** 2)
    assert off <= 4.5 * squared.std() / n**0.5 + 1e-3 * squared.mean()


def test_scores_of_a_batch_are_a_loop():
    _, tags, Q, _ = world(14, (3, 2))
    P = draw_covariance(14, (3, 2))
    got = bounds.score(P, Q, tags[0, 0])
    for index in np.ndindex(3, 2):
        np.testing.assert_allclose(got[index], bounds.score(P[index], Q[index], tags[0, 0]))


# --- errors -----------------------------------------------------------------------------------

GOOD = {
    "anchors": 10 * np.eye(3), "tags": bodies.cube(), "rotation": np.eye(3),
    "translation": np.zeros(3), "noise": RangeNoise(0.1), "links": None,
}  # fmt: skip


@pytest.mark.parametrize("function", [bounds.range_information, bounds.pose_crb])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"anchors": np.ones((4, 2))}, r"anchors must have shape \(\.\.\., M, 3\), got \(4, 2\)"),
        ({"tags": np.ones(3)}, r"tags must have shape \(\.\.\., N, 3\), got \(3,\)"),
        ({"rotation": np.eye(4)}, r"rotation must have shape \(\.\.\., 3, 3\), got \(4, 4\)"),
        ({"translation": 1.0}, r"translation must have shape \(\.\.\., 3\), got \(\)"),
        ({"translation": [0, np.inf, 0]}, r"translation must be finite, got inf at index \(1,\)"),
        ({"links": np.ones((8, 3))}, r"links must have shape \(\.\.\., 3, 8\), got \(8, 3\)"),
        ({"links": np.full((3, 8), 0.5)}, r"links must be True"),
        ({"noise": RangeNoise(0.1, reference_tag=8)}, r"reference_tag must be below .* 8, got 8"),
    ],
)
def test_bad_argument_is_refused(function, change, message):
    with pytest.raises(ValueError, match=message):
        function(**(GOOD | change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"J": np.eye(3)}, r"J must have shape \(\.\.\., 6, 6\), got \(3, 3\)"),
        ({"twist": np.zeros(3)}, r"twist must have shape \(\.\.\., 6\), got \(3,\)"),
        ({"J": np.full((6, 6), np.nan)}, "J must be finite"),
        ({"dt": np.nan}, "dt must"),
        ({"dt": -1.0}, "dt must"),
    ],
)
def test_bad_step_is_refused(change, message):
    good = GOOD | {"J": np.eye(6), "twist": np.zeros(6), "dt": 0.1, "process": PROCESS}
    with pytest.raises(ValueError, match=message):
        bounds.posterior_crb_step(**(good | change))


def test_bad_prior_is_refused():
    with pytest.raises(ValueError, match=r"prior_information must have shape \(\.\.\., 6, 6\)"):
        bounds.pose_crb(**GOOD, prior_information=np.eye(3))


@pytest.mark.parametrize("covariance", [np.full((6, 6), np.nan), -np.eye(6)])
def test_score_of_no_covariance_is_refused_and_not_perfect(covariance):
    with pytest.raises(ValueError, match="covariance"):
        bounds.score(covariance, np.eye(3), bodies.cube())

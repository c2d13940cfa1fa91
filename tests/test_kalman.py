"""The 12-state filters against the reference track, a textbook Kalman filter, and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from rbl_gym import estimators, motion
from rbl_gym.estimators.linear.kalman import expand_covariance
from rbl_gym.estimators.linear.least_squares import vec
from rbl_gym.estimators.linear.unitary import state_jacobian
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from tests.helpers import load, random_world, reference_filter, simulate, textbook_model

FAMILY = ["kf", "uc-kf", "et-kf", "kf-ortho"]
NOISE = ranging.SquaredRangeNoise(0.05)
PROCESS = motion.ProcessNoise(0.02, 0.1)
TWIST = np.array([0.2, -0.1, 0.3, 1.0, -0.5, 0.2])


@pytest.mark.parametrize("engine", ["batched", "filterpy"])
@pytest.mark.parametrize(
    ("name", "key"), list(zip(FAMILY, ["KF", "UCKF", "ETKF", "KFortho"], strict=True))
)
def test_track_of_the_reference_implementation(name, key, engine):
    track = load("track.json")
    filter = reference_filter(name, track, engine=engine)
    state = filter.initial(np.eye(3), np.zeros(3), 100 * np.eye(12))
    for step in track["steps"]:
        state = filter.predict(state, track["twist"], 1.0)
        state = filter.update(state, np.sqrt(step["d"]), np.array(track["A"]).T)
        np.testing.assert_allclose(state.mean, step[key]["theta"], rtol=0, atol=1e-9)
        traces = [np.trace(state.covariance[:9, :9]), np.trace(state.covariance[9:, 9:])]
        np.testing.assert_allclose(traces, step[key]["trP"], rtol=1e-9)


class TextbookKalman:
    """Full measurement matrix, gain, Joseph form: nothing clever."""

    def __init__(self, mean, covariance, process, tags):
        self.x, self.P, self.process, self.tags = mean, covariance, process, tags

    def predict(self, twist, dt):
        F = np.eye(12)
        F[:9, :9] = np.kron(np.eye(3), rotations.exp(twist[:3] * dt))
        std = self.process.std()
        self.x = F @ self.x + np.concatenate([np.zeros(9), twist[3:] * dt])
        self.P = F @ self.P @ F.T + dt * np.diag([std[0] ** 2] * 9 + list(std[3:] ** 2))

    def update(self, ranges, anchors, weights, links=None):
        H, z = textbook_model(ranges, anchors, self.tags, weights, links)
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + np.eye(len(z)))
        self.x = self.x + K @ (z - H @ self.x)
        A = np.eye(12) - K @ H
        self.P = A @ self.P @ A.T + K @ K.T


@pytest.mark.parametrize("engine", ["batched", "filterpy"])
@pytest.mark.parametrize(("m", "n"), [(4, 5), (10, 6), (20, 12)])
@pytest.mark.parametrize("case", ["common weights", "own weights", "lost links"])
def test_equals_textbook_kalman_over_20_steps(m, n, case, engine):
    rng = np.random.default_rng([m, n])
    anchors, tags, rotation, translation = random_world(rng, m, n)
    noise = NOISE if case == "common weights" else ranging.RangeNoise(0.02, 0.002)
    filter = estimators.make("kf", tags=tags, noise=noise, process=PROCESS, engine=engine)
    state = filter.initial(rotation, translation, 100 * np.eye(12))
    naive = TextbookKalman(state.mean, state.covariance, PROCESS, tags)
    for _ in range(20):
        rotation, translation = motion.propagate(rotation, translation, TWIST, 0.1)
        ranges = simulate(rng, anchors, tags, rotation, translation, noise)
        links = rng.random((m, n)) > 0.2 if case == "lost links" else None
        weights = 1 / noise.squared_range_variance(ranges)
        state = filter.update(filter.predict(state, TWIST, 0.1), ranges, anchors, links)
        naive.predict(TWIST, 0.1)
        naive.update(ranges, anchors, weights, links)
        np.testing.assert_allclose(state.mean, naive.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            state.covariance, naive.P, rtol=1e-9, atol=1e-9 * np.abs(naive.P).max()
        )


@pytest.mark.parametrize("name", FAMILY)
@pytest.mark.parametrize("lost", [False, True])
def test_a_batch_is_a_loop_over_trials_and_both_engines_agree(name, lost):
    rng = np.random.default_rng(3)
    anchors, _, rotation, translation = random_world(rng, 6, 5, (7,))
    tags = bodies.pyramid(1.0)
    links = rng.random((7, 6, 5)) > 0.15 if lost else None
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    prior = rotations.exp(0.1 * rng.standard_normal((7, 3))) @ rotation
    covariance = np.diag([0.01] * 3 + [0.25] * 3)

    def run(engine, pick):
        filter = estimators.make(name, tags=tags, noise=NOISE, process=PROCESS, engine=engine)
        state = filter.initial(prior[pick], translation[pick], covariance)
        state = filter.predict(state, TWIST, 0.0)
        mask = None if links is None else links[pick]
        return filter.belief(filter.update(state, ranges[pick], anchors[pick], mask))

    together = run("batched", slice(None))
    for trial in range(7):
        for engine in ("batched", "filterpy"):
            for whole, single in zip(together, run(engine, trial), strict=True):
                np.testing.assert_allclose(whole[trial], single, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("coupled", [False, True])
def test_uc_kf_minimises_the_constrained_cost_by_brute_force(coupled):
    rng = np.random.default_rng(5)
    tags = bodies.pyramid(1.0)
    anchors, _, rotation, translation = random_world(rng, 6, 5)
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    filter = estimators.make("uc-kf", tags=tags, noise=NOISE, process=PROCESS, coupled=coupled)
    prior = filter.initial(rotation, translation, np.diag([0.3] * 3 + [2.0] * 3))
    state = filter.update(prior, ranges, anchors)
    H, z = textbook_model(ranges, anchors, tags, 1 / NOISE.squared_range_variance(ranges))
    precision = np.linalg.inv(prior.covariance)

    def cost(pose):
        x = np.concatenate([vec(rotations.exp(pose[:3])), pose[3:]])
        return np.sum((z - H @ x) ** 2) + (x - prior.mean) @ precision @ (x - prior.mean)

    starts = np.concatenate([rotations.log(rotations.random(rng, (12,))), [[0, 0, 0]]])
    costs = [
        minimize(cost, np.concatenate([start, translation]), tol=1e-12).fun for start in starts
    ]
    found = np.concatenate([rotations.log(filter.belief(state).rotation), state.mean[9:]])
    # Centred tags and an isotropic prior: (26)-(27) solve the coupled problem exactly.
    assert cost(found) <= min(costs) * (1 + 1e-8)


def test_coupled_and_decoupled_agree_for_centred_tags_only():
    rng = np.random.default_rng(6)
    anchors, _, rotation, translation = random_world(rng, 6, 5)
    differences = []
    for tags in (bodies.pyramid(1.0), bodies.pyramid(1.0) + [0.5, 0.0, 0.2]):
        ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
        means = []
        for coupled in (False, True):
            filter = estimators.make(
                "uc-kf", tags=tags, noise=NOISE, process=PROCESS, coupled=coupled
            )
            prior = filter.initial(rotation, translation, np.diag([0.3] * 3 + [2.0] * 3))
            means.append(filter.update(prior, ranges, anchors).mean)
        differences.append(np.abs(means[0] - means[1]).max())
    assert differences[0] < 1e-9 < differences[1]


def test_event_trigger_projects_exactly_where_the_defect_passes_the_threshold():
    rng = np.random.default_rng(7)
    tags = bodies.pyramid(1.0)
    anchors, _, rotation, translation = random_world(rng, 5, 5, (200,))
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    covariance = np.diag([0.05] * 3 + [1.0] * 3)

    def mean(name):
        filter = estimators.make(name, tags=tags, noise=NOISE, process=PROCESS)
        state = filter.initial(rotation, translation, covariance)
        return filter.update(state, ranges, anchors)

    kf, ortho, event = mean("kf"), mean("kf-ortho"), mean("et-kf")
    Q = np.swapaxes(kf.mean[:, :9].reshape(-1, 3, 3), 1, 2)
    defect = np.linalg.norm(np.swapaxes(Q, 1, 2) @ Q - np.eye(3), axis=(1, 2))
    assert 20 < (defect > 0.15).sum() < 180
    np.testing.assert_array_equal(event.constrained, defect > 0.15)
    expected = np.where((defect > 0.15)[:, None], ortho.mean, kf.mean)
    np.testing.assert_allclose(event.mean, expected, rtol=0, atol=1e-12)
    assert ortho.constrained.all()
    assert not kf.constrained.any()


def test_beliefs_hold_proper_rotations_and_the_raw_matrix():
    rng = np.random.default_rng(8)
    tags = bodies.pyramid(1.0)
    anchors, _, rotation, translation = random_world(rng, 4, 5, (50,))
    ranges = simulate(rng, anchors, tags, rotation, translation, ranging.SquaredRangeNoise(0.5))
    for name in FAMILY:
        filter = estimators.make(name, tags=tags, noise=NOISE, process=PROCESS)
        state = filter.initial(rotation, translation, np.diag([0.3] * 3 + [1.0] * 3))
        belief = filter.belief(filter.update(state, ranges, anchors))
        rotations.check_rotation("rotation", belief.rotation)
        raw = np.abs(np.linalg.det(belief.matrix) - 1).max()
        # At this noise the event-triggered filter always projects.
        assert (raw > 0.1) == (name == "kf")
        assert np.linalg.eigvalsh(belief.covariance).min() > 0


def test_state_jacobian_by_finite_differences():
    Q = rotations.random(np.random.default_rng(1))
    J = state_jacobian(Q)
    step = 1e-6
    for axis in range(3):
        turn = rotations.exp(step * np.eye(3)[axis])
        numeric = (vec(turn @ Q) - vec(turn.T @ Q)) / (2 * step)
        np.testing.assert_allclose(J[:9, axis], numeric, atol=1e-9)
    np.testing.assert_array_equal(J[9:], np.eye(6)[3:])


def test_covariance_survives_the_way_to_twelve_states_and_back():
    P = np.diag([0.3, 0.3, 0.3, 1.0, 2.0, 3.0])
    J = state_jacobian(rotations.random(np.random.default_rng(2)))
    pinv = np.linalg.pinv(J)
    np.testing.assert_allclose(pinv @ expand_covariance(P) @ pinv.T, P, atol=1e-12)


def test_a_pose_covariance_of_50_and_100_is_the_papers_hundred():
    filter = estimators.make("kf", tags=bodies.pyramid(), noise=NOISE, process=PROCESS)
    state = filter.initial(np.eye(3), np.zeros(3), np.diag([50.0] * 3 + [100.0] * 3))
    np.testing.assert_allclose(state.covariance, 100 * np.eye(12))


def test_scaled_process_noise_and_fixed_weights():
    tags = bodies.pyramid()
    rng = np.random.default_rng(9)
    anchors, _, rotation, translation = random_world(rng, 5, 5)
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    weights = 1 / NOISE.squared_range_variance(ranges)
    plain = estimators.make("kf", tags=tags, noise=NOISE, process=PROCESS)
    fixed = estimators.make(
        "kf", tags=tags, noise=NOISE, process=PROCESS, weights=weights[:, 0], sigma_q_scale=0.5
    )
    state = plain.initial(rotation, translation, np.diag([0.1] * 3 + [1.0] * 3))
    np.testing.assert_allclose(
        plain.update(state, ranges, anchors).mean, fixed.update(state, ranges, anchors).mean
    )
    added = [
        np.diag(f.predict(state, np.zeros(6), 2.0).covariance - state.covariance)
        for f in (plain, fixed)
    ]
    np.testing.assert_allclose(added[0], [2 * 0.02**2] * 9 + [2 * 0.1**2] * 3)
    np.testing.assert_allclose(added[1][:9], 0.25 * added[0][:9])


def test_an_epoch_without_links_changes_nothing_and_nan_behind_a_lost_link_is_no_matter():
    tags = bodies.pyramid()
    rng = np.random.default_rng(10)
    anchors, _, rotation, translation = random_world(rng, 5, 5)
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    for name in FAMILY:
        filter = estimators.make(name, tags=tags, noise=NOISE, process=PROCESS)
        state = filter.initial(rotation, translation, np.diag([0.1] * 3 + [1.0] * 3))
        blind = filter.update(state, ranges, anchors, np.zeros((5, 5), bool))
        np.testing.assert_allclose(blind.mean, state.mean, atol=1e-9)
        np.testing.assert_allclose(blind.covariance, state.covariance, atol=1e-9)
        links = np.ones((5, 5), bool)
        links[2, 3] = links[0] = False
        spoiled = np.where(links, ranges, np.nan)
        first = filter.update(state, ranges, anchors, links)
        second = filter.update(state, spoiled, anchors, links)
        np.testing.assert_array_equal(first.mean, second.mean)


def test_vague_priors_lose_nothing_in_the_information_form():
    """At P0 = 1e8 the covariance equals the inverse of the information to 1e-9."""
    rng = np.random.default_rng(11)
    anchors, tags, rotation, translation = random_world(rng, 6, 5)
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    H, _ = textbook_model(ranges, anchors, tags, 1 / NOISE.squared_range_variance(ranges))
    exact = np.linalg.inv(H.T @ H + 1e-8 * np.eye(12))
    filter = estimators.make("kf", tags=tags, noise=NOISE, process=PROCESS, engine="batched")
    state = filter.initial(rotation, translation, 1e8 * np.eye(12))
    posterior = filter.update(state, ranges, anchors)
    np.testing.assert_allclose(posterior.covariance, exact, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("name", FAMILY)
@pytest.mark.parametrize(
    ("anchors", "tags", "rank"),
    [
        ([[0, 0, 0], [5, 0, 0], [0, 5, 0], [5, 5, 0]], bodies.pyramid(), 8),
        ([[0, 0, 0], [5, 0, 0]], bodies.pyramid(), 4),
        ([[0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5]], bodies.plate(), 9),
    ],
    ids=["coplanar anchors", "2 anchors", "coplanar tags"],
)
def test_undetermined_states_raise_with_their_rank_unless_the_prior_stands_in(
    name, anchors, tags, rank
):
    filter = estimators.make(name, tags=tags, noise=NOISE, process=PROCESS)
    ranges = ranging.distances(anchors, tags + [1.0, 2.0, 3.0])
    vague = filter.initial(np.eye(3), [1, 2, 3], np.diag([50.0] * 3 + [100.0] * 3))
    with pytest.raises(ValueError, match=f"rank {rank} of the filter's 12 states"):
        filter.update(vague, ranges, np.array(anchors, float))
    tight = filter.initial(np.eye(3), [1, 2, 3], np.diag([0.01] * 3 + [0.1] * 3))
    assert np.isfinite(filter.update(tight, ranges, np.array(anchors, float)).mean).all()

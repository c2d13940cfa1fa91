"""Bias by the direction of a ray: by hand, by finite differences, inside the filters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rbl_gym import estimators, motion
from rbl_gym.estimators import innovations, smoothing
from rbl_gym.measurements import ranging
from rbl_gym.measurements.direction_bias import DirectionLaw, direction_bias
from rbl_gym.motion.unknown_twist import WanderingTwist
from rbl_gym.recordings import read_directions
from rbl_gym.studies import calibrate

ANCHORS = np.array([[-4.0, 3, 0.3], [4, 3, 2.0], [4, -3, 1], [-4, -3, 1.5], [0, 4, 0.2]])
TAGS = np.array([[0.2, 0.1, 0.0], [-0.2, 0.15, 0.1], [0.0, -0.25, 0.0]])


def law_of(rng, anchors=1, tags=2):
    fields = [0.05 * rng.standard_normal((n, 2 * h)) for n, h in ((5, anchors), (3, tags))]
    return DirectionLaw.of(*fields, *(3 * field for field in fields))


def test_the_sum_is_that_of_the_equation():
    rng = np.random.default_rng(0)
    law = law_of(rng)
    Q, t = Rotation.from_rotvec([0.2, -0.1, 2.0]).as_matrix(), np.array([0.5, -0.8, 1.0])
    found = direction_bias(law, Q, t, ANCHORS, TAGS)
    for m, anchor in enumerate(ANCHORS):
        for n, tag in enumerate(TAGS):
            place = Q @ tag + t
            phi = np.arctan2(*(place - anchor)[[1, 0]])
            psi = np.arctan2(*(Q.T @ (anchor - place))[[1, 0]])
            a, b = law.anchors[m], law.tags[n]
            want = a[0] * np.cos(phi) + a[1] * np.sin(phi) + b[0] * np.cos(psi)
            want += b[1] * np.sin(psi) + b[2] * np.cos(2 * psi) + b[3] * np.sin(2 * psi)
            assert found.bias[m, n] == pytest.approx(want, abs=1e-12)
            assert found.log_std[m, n] == pytest.approx(3 * want, abs=1e-12)


def test_the_derivative_is_that_of_finite_differences():
    rng = np.random.default_rng(1)
    law = law_of(rng)
    Q = Rotation.from_rotvec(rng.normal(0, 1, (4, 3))).as_matrix()
    t = rng.normal(0, 1, (4, 3))
    found = direction_bias(law, Q, t, ANCHORS, TAGS)
    for i, axis in enumerate(1e-6 * np.eye(6)):
        ends = [
            direction_bias(
                law, Rotation.from_rotvec(s * axis[:3]).as_matrix() @ Q, t + s * axis[3:],
                ANCHORS, TAGS,
            ).bias
            for s in (-1, 1)
        ]  # fmt: skip
        np.testing.assert_allclose(found.jacobian[..., i], (ends[1] - ends[0]) / 2e-6, atol=1e-8)


def test_the_first_harmonic_of_a_tag_is_a_shift_of_it():
    """Far away, level: a tag moved by d has ranges that are shorter by d . direction."""
    shift = np.array([0.01, -0.02, 0.0])
    law = DirectionLaw.of(np.zeros((5, 0)), np.tile(-shift[:2], (3, 1)))
    far = ANCHORS * [1e4, 1e4, 0]
    Q, t = Rotation.from_rotvec([0, 0, 0.7]).as_matrix(), np.zeros(3)
    moved, there = (
        np.linalg.norm((tags @ Q.T)[None] - far[:, None], axis=-1) for tags in (TAGS + shift, TAGS)
    )
    found = direction_bias(law, Q, t, far, TAGS)
    np.testing.assert_allclose(found.bias, moved - there, atol=1e-6)


def test_coefficients_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="a cosine and a sine"):
        DirectionLaw.of(np.zeros((2, 2)), np.zeros((3, 1)))
    with pytest.raises(ValueError, match="tags_log_std"):
        DirectionLaw.of(np.zeros((2, 2)), np.zeros((3, 2)), None, np.zeros((3, 4)))


def epochs(law, rng, count, noise=0.02):
    """Ranges of a body that drives and turns in a plane, and its poses."""
    times = 0.1 * np.arange(count)
    yaw = 0.9 * times
    place = np.column_stack([2 * np.sin(0.4 * times), 1.5 * np.cos(0.3 * times), 1 + 0 * times])
    rotation = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    places = place[:, None] + TAGS @ np.swapaxes(rotation, 1, 2)
    d = np.linalg.norm(places[:, None] - ANCHORS[:, None], axis=-1)
    found = direction_bias(law, rotation, place, ANCHORS, TAGS)
    std = noise * np.exp(found.log_std)
    ranges = d + found.bias + std * rng.standard_normal(d.shape)
    return times, ranges, rotation, place


@pytest.mark.parametrize("name", ["iekf-log", "iekf-bias"])
def test_filters_that_know_the_law_are_nearer_and_honest(name):
    """Patterns of 6 cm: without the law the heading errs by degrees, with it by its noise."""
    rng = np.random.default_rng(2)
    law = law_of(rng, anchors=1, tags=3)._replace(
        anchors_log_std=np.zeros((5, 2)), tags_log_std=np.zeros((3, 6))
    )
    times, ranges, rotation, place = epochs(law, rng, 150)
    means = {}
    for directions in (None, law):
        filt = estimators.make(
            name, tags=TAGS, noise=ranging.RangeNoise(0.02),
            process=motion.ProcessNoise(0.05, 0.05), directions=directions,
            **({"constant_std_m": 0.01, "constant_common_m": 0.01, "drift_std_m": 0.01}
               if name == "iekf-log" else {"bias_std_m": 0.01, "common_std_m": 0.01}),
        )  # fmt: skip
        state = filt.initial(rotation[0], place[0], 0.01 * np.eye(6))
        before, errors, nees, nis = None, [], [], []
        for k in range(len(times)):
            if k:
                twist = np.r_[0, 0, 0.9, np.diff(place, axis=0)[k - 1] / 0.1]
                state = filt.predict(state, twist, 0.1)
            before = state
            state = filt.update(state, ranges[k], ANCHORS)
            told = innovations(
                filt, before, state, ranges[k], ANCHORS, TAGS, ranging.RangeNoise(0.02)
            )
            belief = filt.belief(state)
            turn = Rotation.from_matrix(belief.rotation @ rotation[k].T).as_rotvec()
            error = np.concatenate([turn, belief.translation - place[k]])
            errors.append(error)
            nees.append(error @ np.linalg.solve(belief.covariance, error) / 6)
            nis.append(told.nis / told.dof)
        means[directions is None] = [
            np.sqrt((np.array(errors)[20:] ** 2).mean(axis=0))[2],
            np.mean(nees[20:]),
            np.mean(nis[20:]),
        ]
    assert means[False][0] < 0.4 * means[True][0]
    assert means[False][1] < 2 < means[True][1]
    assert 0.5 < means[False][2] < 1.2


def test_the_update_is_at_the_least_cost():
    """One epoch, a wide prior: the pose is where squares over ranges and prior are least."""
    rng = np.random.default_rng(3)
    law = law_of(rng)._replace(anchors_log_std=np.zeros((5, 2)), tags_log_std=np.zeros((3, 4)))
    _, ranges, rotation, place = epochs(law, rng, 1)
    std = np.array([0.1, 0.1, 0.15, 0.2, 0.2, 0.2])
    filt = estimators.make(
        "iekf-bias", tags=TAGS, noise=ranging.RangeNoise(0.05), process=motion.ProcessNoise(),
        bias_std_m=1e-9, common_std_m=0.0, directions=law, iterations=10,
    )  # fmt: skip
    state = filt.initial(rotation[0], place[0] + 0.05, np.diag(std**2))
    found = filt.belief(filt.update(state, ranges[0], ANCHORS))

    def residuals(x):
        Q, t = Rotation.from_rotvec(x[:3]).as_matrix() @ rotation[0], place[0] + 0.05 + x[3:]
        d = np.linalg.norm((t + TAGS @ Q.T)[None] - ANCHORS[:, None], axis=-1)
        d = d + direction_bias(law, Q, t, ANCHORS, TAGS).bias
        return np.concatenate([x / std, ((d - ranges[0]) / 0.05).ravel()])

    best = least_squares(residuals, np.zeros(6), xtol=1e-12).x
    want = Rotation.from_rotvec(best[:3]).as_matrix() @ rotation[0]
    np.testing.assert_allclose(found.translation, place[0] + 0.05 + best[3:], atol=2e-4)
    assert Rotation.from_matrix(found.rotation @ want.T).magnitude() < 1e-3


def test_the_smoother_takes_the_law_too():
    rng = np.random.default_rng(4)
    law = law_of(rng, anchors=1, tags=2)
    times, ranges, rotation, place = epochs(law, rng, 40)
    log = smoothing.RangeLog(times, ranges, ANCHORS)
    wander = WanderingTwist(1.0, 3.0, 0.2, 0.5)
    errors = []
    for directions in (None, law):
        model = smoothing.LogModel(
            TAGS, ranging.RangeNoise(0.02), smoothing.UnknownTwist(wander), directions=directions
        )
        prior = rotation[0], place[0], 0.01 * np.eye(6)
        found = estimators.smooth(log, model, prior, (rotation, place))
        errors.append(np.sqrt(((found.translation - place) ** 2).sum(axis=-1).mean()))
        ratio = found.squares.sum() / found.freedom.sum()
    assert errors[1] < 0.5 * errors[0]
    assert 0.7 < ratio < 1.3


def test_a_table_of_harmonics_is_read_as_it_is_written(tmp_path):
    rng = np.random.default_rng(5)
    law = law_of(rng, anchors=2, tags=2)
    path, ids = tmp_path / "directions.csv", (tuple("ABCDE"), tuple("xyz"))
    calibrate.write_directions(path, ids, law)
    for got, want in zip(read_directions(path, ids), law, strict=True):
        np.testing.assert_allclose(got, want, atol=1e-6)
    text = path.read_text()
    for old, new, message in (
        ("anchor,A,1", "wall,A,1", "must be anchor or tag"),
        ("anchor,A,1", "anchor,Q,1", "must be the id"),
        ("anchor,A,1", "anchor,A,0.5", "must be 1, 2"),
        ("anchor,A,1", "anchor,A,2", "must differ in rows with the same end"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(ValueError, match=message):
            read_directions(path, ids)

"""The inertial sensor: its model, preintegration, the carried covariance, its logs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym import kernels
from rbl_gym.geometry import rotations
from rbl_gym.measurements import inertial
from rbl_gym.motion import navigation, smooth
from rbl_gym.recordings import InertialLog, read_inertial, samples_between

CONSUMER = inertial.SENSORS["consumer"]
G = inertial.GRAVITY_M_S2


def flight(times):
    """A smooth motion, written down by hand: rotation, translation."""
    angles = np.stack([0.6 * np.sin(times), 0.4 * np.cos(1.3 * times), 0.8 * times], axis=-1)
    place = np.stack([2 * np.sin(0.7 * times), times - 1, 0.3 * np.cos(2 * times)], axis=-1)
    return Rotation.from_euler("zyx", angles).as_matrix(), place


def readings_of(times):
    """True readings at times, and the motion."""
    moved = smooth.from_function(flight, times)
    force = inertial.specific_force(moved.rotation, moved.acceleration)
    return np.concatenate([moved.turn_rate, force], axis=-1), moved


def naive(readings, step, bias):
    """Rotation, place and velocity from the identity, by scipy and small steps of Euler's rule."""
    parts = 400
    R, p, v = Rotation.identity(), np.zeros(3), np.zeros(3)
    for reading in readings - bias:
        h = step / parts
        middle = R * Rotation.from_rotvec(0.5 * step * reading[:3])
        force = middle.apply(reading[3:])
        for _ in range(parts):
            p, v = p + h * v + 0.5 * h**2 * force, v + h * force
            R = R * Rotation.from_rotvec(h * reading[:3])
    return R.as_matrix(), p, v


# --- the sensor ------------------------------------------------------------------------------


def test_a_sensor_by_name_and_by_fields():
    assert inertial.sensor("tactical") is not CONSUMER
    assert inertial.sensor({"kind": "tactical"}) == inertial.SENSORS["tactical"]
    told = inertial.sensor({"rate_hz": 200, "gyro_noise": 1e-3})
    assert told == inertial.InertialSensor(rate_hz=200.0, gyro_noise=1e-3)
    assert inertial.sensor(told) is told
    assert told.samples(0.1) == 20


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("cheap", "inertial.kind must be one of 'consumer', 'tactical', got 'cheap'"),
        ({"noise": 1.0}, "inertial has no field 'noise'; its fields are rate_hz"),
        ({"gyro_noise": -1.0}, "gyro_noise must be a finite number"),
        (3, "inertial must be a name or a dict of its fields, got 3"),
    ],
)
def test_what_is_no_sensor(value, message):
    with pytest.raises(ValueError, match=message):
        inertial.sensor(value)


def test_samples_must_fill_the_interval():
    with pytest.raises(ValueError, match=r"whole number of samples in dt = 0\.015"):
        CONSUMER.samples(0.015)


def test_a_body_at_rest_reads_gravity_upwards():
    Q = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    np.testing.assert_allclose(inertial.specific_force(np.eye(3), np.zeros(3)), [0, 0, G])
    np.testing.assert_allclose(inertial.specific_force(Q, np.zeros(3)), [0, G, 0], atol=1e-12)
    np.testing.assert_allclose(inertial.specific_force(np.eye(3), [0, 0, -G]), 0, atol=1e-12)


def test_simulated_readings_have_the_stated_noise_and_biases():
    rng = np.random.default_rng(0)
    zero = np.zeros((4000, 50, 3))
    read = inertial.simulate(CONSUMER, zero, zero, rng)
    assert isinstance(read, inertial.InertialReadings)
    # 4000 trials: deviations are known to 1.1 %, over the 50 samples better; 5 sigma.
    white = (read.readings - read.bias).std(axis=(0, 1))
    np.testing.assert_allclose(white[:3], 3e-4 * 10, rtol=0.01)
    np.testing.assert_allclose(white[3:], 4e-3 * 10, rtol=0.01)
    np.testing.assert_allclose(read.bias[:, 0].std(axis=0), CONSUMER.prior_std, rtol=0.06)
    walked = (read.bias[:, -1] - read.bias[:, 0]).std(axis=0)
    np.testing.assert_allclose(walked[:3], 3e-5 * np.sqrt(0.49), rtol=0.06)
    np.testing.assert_allclose(walked[3:], 1e-3 * np.sqrt(0.49), rtol=0.06)


def test_readings_are_cut_at_the_limits_and_repeat_with_the_seed():
    rate, force = np.full((20, 3), 50.0), np.full((20, 3), -200.0)
    read = [inertial.simulate(CONSUMER, rate, force, np.random.default_rng(1)) for _ in range(2)]
    np.testing.assert_array_equal(read[0].readings[:, :3], 34.9)
    np.testing.assert_array_equal(read[0].readings[:, 3:], -78.5)
    assert read[0].bias.tobytes() == read[1].bias.tobytes()


def test_readings_in_other_axes():
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    found = inertial.turned([[1.0, 0, 0, 0, 2, 0]], turn)
    np.testing.assert_allclose(found, [[0, 1, 0, -2, 0, 0]], atol=1e-12)


# --- smooth motion ---------------------------------------------------------------------------


def test_a_bspline_and_its_derivatives():
    rng = np.random.default_rng(2)
    R = rotations.exp(np.cumsum(0.5 * rng.standard_normal((2, 6, 3)), axis=1))
    p = np.cumsum(rng.standard_normal((2, 6, 3)), axis=1)
    at = np.linspace(0.01, 1.99, 40)
    found = smooth.bspline(R, p, 0.5, at)
    # Centred differences across a knot see its third derivative change.
    by_hand = smooth.from_function(lambda t: smooth.bspline(R, p, 0.5, t)[:2], at)
    for name, one, other in zip(found._fields, found, by_hand, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6, err_msg=name)
    start = smooth.bspline(R, p, 0.5, [0.0, 2.0])
    np.testing.assert_allclose(start.rotation[:, 0], R[:, 0], atol=1e-12)
    np.testing.assert_allclose(start.translation[:, 0], p[:, 0], atol=1e-12)


def test_a_bspline_keeps_a_constant_twist():
    k = np.arange(5)[:, None]
    R, p = rotations.exp(k * np.array([0.1, 0.2, -0.3])), k * np.array([1.0, 2, 3])
    found = smooth.bspline(R, p, 2.0, np.linspace(0, 6, 13))
    np.testing.assert_allclose(found.turn_rate, np.tile([0.05, 0.1, -0.15], (13, 1)), atol=1e-12)
    np.testing.assert_allclose(found.velocity, np.tile([0.5, 1, 1.5], (13, 1)), atol=1e-12)
    np.testing.assert_allclose(found.acceleration, 0, atol=1e-12)


def test_splines_go_through_poses():
    known, at = np.linspace(0, 3, 61), np.linspace(0.5, 2.5, 21)
    found, expected = smooth.through(known, *flight(known), at), smooth.from_function(flight, at)
    assert isinstance(found, smooth.SmoothMotion)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-5)
    np.testing.assert_allclose(found.velocity, expected.velocity, atol=1e-4)
    np.testing.assert_allclose(found.turn_rate, expected.turn_rate, atol=2e-3)
    np.testing.assert_allclose(found.acceleration, expected.acceleration, atol=5e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: smooth.bspline(np.eye(3)[None], np.zeros((1, 3)), 1.0, [0.0]), "at least 2"),
        (
            lambda: smooth.bspline(np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3)), 1.0, [2.5]),
            r"times must be \(T,\) from 0 to 2",
        ),
        (
            lambda: smooth.through([0.0, 1], np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), [2]),
            r"at must have shape \(T,\) and lie in \[0, 1\]",
        ),
        (
            lambda: smooth.through([0.0, 0], np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), [0]),
            "increase strictly",
        ),
    ],
)
def test_what_is_no_motion(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# --- preintegration --------------------------------------------------------------------------


def test_preintegration_against_small_steps():
    readings, _ = readings_of(np.arange(12) * 0.02 + 0.01)
    bias = np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.05])
    found = navigation.preintegrate(readings, 0.02, bias, CONSUMER)
    assert isinstance(found, navigation.Preintegrated)
    R, p, v = naive(readings, 0.02, bias)
    np.testing.assert_allclose(found.rotation, R, atol=1e-12)
    np.testing.assert_allclose(found.translation, p, atol=1e-10)
    np.testing.assert_allclose(found.velocity, v, atol=1e-10)
    assert found.duration == pytest.approx(0.24)


@pytest.mark.parametrize(("rate", "tolerance"), [(50, 3e-4), (200, 2e-5)])
def test_true_readings_lead_to_the_true_pose(rate, tolerance):
    """The error of a sample falls with the cube of its length."""
    step = 1 / rate
    readings, _ = readings_of((np.arange(2 * rate) + 0.5) * step)
    found = navigation.preintegrate(readings, step, np.zeros(6), CONSUMER)
    ends = smooth.from_function(flight, [0.0, 2.0])
    Q, T = ends.rotation[0], 2.0
    np.testing.assert_allclose(Q @ found.rotation, ends.rotation[1], atol=tolerance)
    down = np.array([0, 0, -G])
    place = ends.translation[0] + T * ends.velocity[0] + 0.5 * T**2 * down + Q @ found.translation
    np.testing.assert_allclose(place, ends.translation[1], atol=3 * tolerance)
    np.testing.assert_allclose(
        ends.velocity[0] + T * down + Q @ found.velocity, ends.velocity[1], atol=3 * tolerance
    )


def test_derivatives_by_the_biases_against_finite_differences():
    rng = np.random.default_rng(3)
    readings, _ = readings_of(np.arange(10) * 0.02)
    steps, bias, e = rng.uniform(0.005, 0.03, 10), 0.1 * rng.standard_normal(6), 1e-5
    found = navigation.preintegrate(readings, steps, bias, CONSUMER)
    for i in range(6):
        ends = [
            navigation.preintegrate(readings, steps, bias + s * e * np.eye(6)[i], CONSUMER)
            for s in (1, -1)
        ]
        turn = rotations.error(ends[0].rotation, ends[1].rotation)
        change = np.concatenate(
            [turn, ends[0].translation - ends[1].translation, ends[0].velocity - ends[1].velocity]
        )
        np.testing.assert_allclose(found.jacobian[:, i], change / (2 * e), atol=1e-8)
    other = bias + 1e-3 * rng.standard_normal(6)
    again, exact = found.corrected(other), navigation.preintegrate(readings, steps, other, CONSUMER)
    np.testing.assert_allclose(again.rotation, exact.rotation, atol=1e-6)
    np.testing.assert_allclose(again.translation, exact.translation, atol=1e-6)
    np.testing.assert_allclose(again.velocity, exact.velocity, atol=1e-6)


def test_covariance_of_a_preintegration_against_noisy_draws():
    sensor = inertial.InertialSensor(gyro_noise=0.02, accel_noise=0.3)
    readings, _ = readings_of(np.arange(10) * 0.02)
    exact = navigation.preintegrate(readings, 0.02, np.zeros(6), sensor)
    rng, trials = np.random.default_rng(4), 20_000
    std = np.repeat([0.02, 0.3], 3) / np.sqrt(0.02)
    noisy = readings + std * rng.standard_normal((trials, 10, 6))
    drawn = navigation.preintegrate(noisy, 0.02, np.zeros(6), sensor)
    errors = np.concatenate(
        [
            rotations.error(drawn.rotation, exact.rotation),
            drawn.translation - exact.translation,
            drawn.velocity - exact.velocity,
        ],
        axis=-1,
    )
    scale = np.sqrt(np.diagonal(exact.covariance))
    # Entries of a correlation matrix from 20,000 draws: 0.007 and 0.01 on the diagonal, 5 sigma.
    found = np.cov(errors.T) / np.outer(scale, scale)
    np.testing.assert_allclose(found, exact.covariance / np.outer(scale, scale), atol=0.05)


def test_samples_of_no_length_tell_nothing():
    readings, _ = readings_of(np.arange(6) * 0.02)
    steps = np.array([0.02, 0.02, 0, 0.02, 0, 0])
    padded = navigation.preintegrate(readings, steps, np.zeros(6), CONSUMER)
    plain = navigation.preintegrate(readings[[0, 1, 3]], 0.02, np.zeros(6), CONSUMER)
    for one, other in zip(padded, plain, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-15)


@pytest.mark.parametrize(
    ("readings", "steps", "message"),
    [
        (np.zeros((3, 5)), 0.1, r"readings must have shape \(..., S, 6\), got \(3, 5\)"),
        (np.full((3, 6), np.nan), 0.1, "readings must be finite"),
        (np.zeros((3, 6)), -0.1, "steps must not be negative, got -0.1"),
        (np.zeros((3, 6)), [0.1, 0.1], "steps must be one number, or one for each of 3 samples"),
    ],
)
def test_what_cannot_be_preintegrated(readings, steps, message):
    with pytest.raises(ValueError, match=message):
        navigation.preintegrate(readings, steps, np.zeros(6), CONSUMER)


# --- state and covariance --------------------------------------------------------------------


def random_state(rng, n):
    A = rng.standard_normal((n, n))
    return rotations.random(rng), rng.standard_normal(3), 0.1 * rng.standard_normal(n - 6), A @ A.T


def moved(state, change):
    """A state with an error (n,) put on it: global rotation, then sums."""
    Q, t, extra, _ = state
    return rotations.exp(change[:3]) @ Q, t + change[3:6], extra + change[6:]


@pytest.mark.parametrize("tilted", [0.0, 1.0])
def test_the_carried_covariance_against_finite_differences(tilted):
    rng = np.random.default_rng(5)
    n = 19
    state, readings = random_state(rng, n), rng.standard_normal((5, 6)) + 5
    law = np.append(np.zeros(4), [G, tilted])
    steps = rng.uniform(0.01, 0.03, 5)
    propagate = navigation.propagate.textbook
    end = propagate(*state, readings, steps, law)
    F, e = np.empty((n, n)), 1e-6
    for i in range(n):
        ends = [
            propagate(*moved(state, s * e * np.eye(n)[i]), state[3], readings, steps, law)
            for s in (1, -1)
        ]
        turn = rotations.error(ends[0][0], ends[1][0])
        rest = [ends[0][k] - ends[1][k] for k in (1, 2)]
        F[:, i] = np.concatenate([turn, *rest]) / (2 * e)
    np.testing.assert_allclose(end[3], F @ state[3] @ F.T, atol=1e-6)


@pytest.mark.skipif(not kernels.enabled(), reason="needs numba")
@pytest.mark.parametrize(("n", "tilted"), [(15, 0.0), (17, 1.0), (24, 0.0), (41, 1.0)])
@pytest.mark.parametrize("batch", [(), (3,)])
def test_the_kernel_and_the_textbook(n, tilted, batch):
    rng = np.random.default_rng(6)
    A = rng.standard_normal((*batch, n, n))
    state = (
        rotations.random(rng, batch), rng.standard_normal((*batch, 3)),
        0.1 * rng.standard_normal((*batch, n - 6)), A @ np.swapaxes(A, -1, -2),
    )  # fmt: skip
    readings, steps = rng.standard_normal((*batch, 10, 6)), rng.uniform(0, 0.05, 10)
    steps[3] = 0.0
    law = np.array([0.01, 0.02, 0.03, 0.04, G, tilted])
    one = navigation.propagate.textbook(*state, readings, steps, law)
    other = navigation.propagate.kernel(*state, readings, steps, law)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_gravity_in_a_tilted_world():
    np.testing.assert_allclose(navigation.gravity([0.0, 0.0], G), [0, 0, -G])
    tilt = np.array([0.1, -0.2])
    expected = -G * Rotation.from_rotvec([*tilt, 0]).as_matrix()[:, 2]
    np.testing.assert_allclose(navigation.gravity(tilt, G), expected, atol=1e-12)


def test_attitude_from_gravity_but_for_the_heading():
    rng = np.random.default_rng(7)
    Q = rotations.random(rng, (20,))
    force = inertial.specific_force(Q, np.zeros(3))
    readings = np.concatenate([np.zeros((20, 3)), force], axis=-1)[:, None]
    found, covariance = navigation.attitude(readings, CONSUMER)
    # Both have the same vertical in the body.
    np.testing.assert_allclose(found[:, 2], Q[:, 2], atol=1e-9)
    assert covariance[0, 2, 2] == pytest.approx(np.pi**2 / 3)
    np.testing.assert_allclose(rotations.yaw(found), 0, atol=1e-9)
    with pytest.raises(ValueError, match=r"mean specific force near 9\.81"):
        navigation.attitude(readings / G, CONSUMER)


# --- logs ------------------------------------------------------------------------------------


def log_file(tmp_path, rows, header="t,wx,wy,wz,ax,ay,az"):
    path = tmp_path / "imu.csv"
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]))
    return path


ROWS = [(k / 100, 0.1, 0, 0.2, 0, 0.5, 9.8) for k in range(11)]


def test_a_log_is_read_in_its_units(tmp_path):
    log = read_inertial(log_file(tmp_path, ROWS))
    assert isinstance(log, InertialLog)
    np.testing.assert_allclose(log.readings[4], [0.1, 0, 0.2, 0, 0.5, 9.8])
    degrees = [(t, *np.rad2deg(row[:3]), *np.array(row[3:]) / G) for t, *row in ROWS]
    header = "t,gx,wy,wz,ax,ay,az"
    again = read_inertial(
        log_file(tmp_path, degrees, header), columns={"wx": "gx"}, turn_unit="deg/s", force_unit="g"
    )
    np.testing.assert_allclose(again.readings, log.readings)


@pytest.mark.parametrize(
    ("rows", "options", "message"),
    [
        ([(0, 1, 2, 3, 4, 5, "x"), *ROWS[1:]], {}, "line 2, column 'az': must be a finite number"),
        ([*ROWS[:2], ROWS[0]], {}, "line 4, column 't': time must increase"),
        (ROWS, {"columns": {"wx": "gx"}}, "line 1: missing column 'gx'"),
        (ROWS, {"columns": {"gx": "wx"}}, "columns must be one of 't', 'wx'"),
        (ROWS, {"turn_unit": "rpm"}, "turn_unit must be one of 'rad/s', 'deg/s'"),
        (ROWS, {"force_unit": "g"}, r"9.81 g, which does not fit a log in g \(is it in m/s\^2\?"),
        ([(t, *w, *np.array(a) / G) for t, *w, a in [(r[0], *r[1:4], r[4:]) for r in ROWS]], {},
         "is it in g, or was gravity"),
        ([(r[0], 200, 0, 0, *r[4:]) for r in ROWS], {}, r"are they in deg/s"),
    ],
)  # fmt: skip
def test_what_is_no_log(tmp_path, rows, options, message):
    with pytest.raises(ValueError, match=message):
        read_inertial(log_file(tmp_path, rows), **options)


def test_samples_between_two_times():
    log = InertialLog(np.arange(11) / 100, np.arange(66.0).reshape(11, 6))
    readings, steps = samples_between(log, 0.012, 0.038)
    np.testing.assert_allclose(steps, [0.003, 0.01, 0.01, 0.003])
    np.testing.assert_allclose(readings, log.readings[1:5])
    for start, end in ((0.021, 0.022), (0.02, 0.02), (-0.05, 0.15)):
        readings, steps = samples_between(log, start, end)
        assert steps.sum() == pytest.approx(end - start)
        assert len(readings) == len(steps)
    gappy = InertialLog(np.array([0, 0.01, 0.3, 0.31]), np.zeros((4, 6)))
    for start, end in ((0.1, 0.2), (0.0, 0.31), (0.005, 0.02), (0.4, 0.5)):
        with pytest.raises(ValueError, match=r"longer than 0\.1 s"):
            samples_between(gappy, start, end)

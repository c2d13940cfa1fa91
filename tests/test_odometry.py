"""Odometry: its law, its filter by finite differences and statistics, its logs, replay with it."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym import estimators, metrics, motion, recordings
from rbl_gym.app.cli import main
from rbl_gym.estimators import smoothing
from rbl_gym.estimators.costs.bias_cost import AugmentedState
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.measurements.odometry import OdometrySensor, expected
from rbl_gym.recordings import (
    Format,
    InertialLog,
    OdometryLog,
    odometry_between,
    read_odometry,
)
from rbl_gym.recordings.tables import Source
from rbl_gym.recordings.truth import Truth
from rbl_gym.studies import replay
from rbl_gym.studies.replay import smoothing as replay_smoothing
from rbl_gym.studies.replay.clocks import _peak
from tests import recorded
from tests.helpers import with_kernels

REAL = Path(__file__).parents[2] / "shared" / "data" / "labyrinth_single_tag"
ANCHORS = np.array([[0.0, 0, 0], [6, 0, 2], [6, 5, 0], [0, 5, 2]])
TAGS = np.array([[0.2, 0.1, 0.0], [-0.2, 0.0, 0.1]])
STILL = motion.ProcessNoise(0.0, 0.0)
SENSOR = OdometrySensor(0.03, 0.02, 0.03, 0.05, 0.04, 0.02)


def a_filter(**options):
    options = {"odometry": SENSOR, "robust": False, **options}
    noise = ranging.RangeNoise(0.05)
    return estimators.make("iekf-log", tags=TAGS, noise=noise, process=STILL, **options)


def test_readings_are_the_scaled_twist_and_a_bias():
    twist = np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])
    found = expected(twist, np.array([0.1, -0.5, 0.01, 0.02, 0.03]))
    assert np.allclose(found, [0.12, -0.2, 0.36, 0.5, 1.0, 1.5])
    rng = np.random.default_rng(0)
    readings = SENSOR.read(np.zeros((20_000, 6)), 0.25, rng, np.zeros(5))
    # Standard deviations of 20 000 draws: within 0.02, four of their own.
    assert np.allclose(readings.std(axis=0) / (2 * SENSOR.noise()), 1, atol=0.02)


@pytest.mark.parametrize("field", [{"speed_noise": 0.0}, {"turn_scale_std": -1.0}])
def test_a_sensor_of_impossible_noise_is_refused(field):
    with pytest.raises(ValueError, match=next(iter(field))):
        OdometrySensor(**field)


def test_the_filter_moves_along_the_arc_and_its_jacobian_is_that_of_differences():
    """Without readings the error after a step is F times that before it."""
    rng = np.random.default_rng(1)
    filter = a_filter(turn_acceleration=0.0, acceleration=0.0, drift_std_m=0.0)
    Q, t = rotations.random(rng), np.array([1.0, 2.0, 0.5])
    extra = np.concatenate([[0.3, -0.4, 0.9, 1.2, -0.3, 0.4], np.zeros(5)])
    none, dt = np.full((1, 6), np.nan), 0.2

    def step(pose, further, P):
        state = AugmentedState(pose[0], pose[1], further, P)
        return filter.predict(state, none, dt)

    base = step((Q, t), extra, np.zeros((17, 17)))
    # A screw, by scipy in a hundred short pieces.
    R, place = Rotation.from_matrix(Q), t.copy()
    for _ in range(400):
        half = R * Rotation.from_rotvec(extra[:3] * dt / 800)
        place = place + half.apply(extra[3:6]) * dt / 400
        R = half * Rotation.from_rotvec(extra[:3] * dt / 800)
    assert np.allclose(base.rotation, R.as_matrix(), atol=1e-9)
    assert np.allclose(base.translation, place, atol=1e-7)
    small, F = 1e-6, np.zeros((12, 12))
    for k in range(12):
        e = np.zeros(17)
        e[k] = small
        new = step((rotations.exp(e[:3]) @ Q, t + e[3:6]), extra + e[6:], np.zeros((17, 17)))
        turn = rotations.error(new.rotation, base.rotation)
        moved = [turn, new.translation - base.translation, (new.extra - base.extra)[:6]]
        F[:, k] = np.concatenate(moved) / small
    A = rng.standard_normal((12, 12))
    P = np.zeros((17, 17))
    P[:12, :12] = A @ A.T
    found = step((Q, t), extra, P).covariance[:12, :12]
    # The way's derivative by the turn rate is of first order in the turn: 0.2 rad here.
    assert np.allclose(found, F @ P[:12, :12] @ F.T, atol=2e-2 * np.abs(found).max())


def test_a_reading_is_a_kalman_update_of_the_twist():
    """With scales that are known it is the linear update."""
    sensor = dataclasses.replace(SENSOR, speed_scale_std=0.0, turn_scale_std=0.0)
    filter = a_filter(odometry=sensor, turn_acceleration=0.0, acceleration=0.0)
    state = filter.initial(np.eye(3), np.zeros(3), 0.01 * np.eye(6))
    reading, dt = np.array([[np.nan, np.nan, 0.4, 1.0, 0.0, np.nan]]), 1e-6
    after = filter.predict(state, reading, dt)
    rows = [2, 3, 4]
    H = np.zeros((3, 17))
    H[range(3), [6 + row for row in rows]] = 1.0
    H[0, 16] = 1.0
    P, R = state.covariance, np.diag(sensor.noise()[rows] ** 2 / dt)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    assert np.allclose(after.extra, (K @ reading[0, rows])[6:], atol=1e-9)
    assert np.allclose(after.covariance[6:, 6:], (P - K @ H @ P)[6:, 6:], atol=1e-6)


def driven(rng, trials, steps, dt):
    """Rotation, translation and twists of bodies that drive on, turning now and then."""
    turn = np.zeros((steps, trials, 6))
    turn[..., 3] = 0.8 + 0.4 * np.sin(0.3 * np.arange(steps))[:, None]
    turn[..., 2] = rng.normal(0, 0.8, (steps // 10 + 1, trials)).repeat(10, axis=0)[:steps]
    Q = rotations.exp(rng.uniform(-1, 1, (trials, 1)) * [0.0, 0.0, 1.0])
    t = rng.uniform([2, 2, 0.5], [4, 3, 1.0], (trials, 3))
    path = [(Q, t)]
    for k in range(steps):
        w, v = turn[k, :, :3] * dt, turn[k, :, 3:] * dt
        t = t + (Q @ rotations.left_jacobian(w) @ v[..., None])[..., 0]
        Q = Q @ rotations.exp(w)
        path.append((Q, t))
    return path, turn


def test_beliefs_and_calibration_are_honest():
    """150 bodies: NEES of pose (6), and of scales and bias of the turn rate (3)."""
    rng = np.random.default_rng(2)
    trials, steps, dt = 150, 80, 0.1
    path, twists = driven(rng, trials, steps, dt)
    calibration = SENSOR.calibration_std() * rng.standard_normal((trials, 5))
    filter = a_filter(
        constant_std_m=0.0, constant_common_m=0.0, drift_std_m=0.0,
        turn_acceleration=10.0, acceleration=3.0,
    )  # fmt: skip
    std = np.array([0.05] * 3 + [0.2] * 3)
    off = std * rng.standard_normal((trials, 6))
    Q, t = path[0]
    state = filter.initial(rotations.exp(off[:, :3]) @ Q, t + off[:, 3:], np.diag(std**2))
    for k in range(steps):
        # Two readings an epoch.
        told = np.stack(
            [SENSOR.read(twists[k], dt / 2, rng, calibration) for _ in range(2)], axis=-2
        )
        state = filter.predict(state, told, dt)
        exact = ranging.distances(ANCHORS, ranging.tag_positions(*path[k + 1], TAGS))
        state = filter.update(state, exact + 0.05 * rng.standard_normal(exact.shape), ANCHORS)
    belief = filter.belief(state)
    error = metrics.pose_error(belief.rotation, belief.translation, *path[-1])
    nees = metrics.nees(error, belief.covariance).mean() / 6
    # 150 trials of 6: one standard deviation is 0.047.
    assert 0.8 < nees < 1.2
    seen = [12, 13, 16]
    off = state.extra[:, [6, 7, 10]] - calibration[:, [0, 1, 4]]
    P = state.covariance[:, seen][:, :, seen]
    # 150 trials of 3: one standard deviation is 0.067.
    assert 0.75 < metrics.nees(off, P).mean() / 3 < 1.3
    assert np.sqrt(P[:, 1, 1]).mean() < 0.4 * SENSOR.speed_scale_std


@pytest.mark.parametrize(
    ("readings", "dt", "what"),
    [(np.zeros(6), 0.1, "readings"), (np.zeros((2, 5)), 0.1, "readings"),
     (np.full((1, 6), np.inf), 0.1, "readings"), (np.zeros((2, 6)), np.zeros(3), "steps|dt"),
     (np.zeros((1, 6)), -1.0, "dt")],
)  # fmt: skip
def test_wrong_readings_are_refused(readings, dt, what):
    filter = a_filter()
    state = filter.initial(np.eye(3), np.zeros(3), np.eye(6))
    with pytest.raises(ValueError, match=what):
        filter.predict(state, readings, dt)


# Logs.


def written(path, text):
    path.write_text(text)
    return path


def test_columns_that_are_not_there_are_not_measured_or_what_wheels_cannot(tmp_path):
    log = read_odometry(written(tmp_path / "a.csv", "t,vx,wz\n0,1,0.1\n0.1,2,0.2\n"))
    assert np.array_equal(log.readings, [[0, 0, 0.1, 1, 0, 0], [0, 0, 0.2, 2, 0, 0]])
    text = "t,vx,vy,wz\n0,1,0,5.729577951308232\n0.1,,0,0\n"
    log = read_odometry(written(tmp_path / "b.csv", text), turn_unit="deg/s")
    nan = np.nan
    expect = [[nan, nan, 0.1, 1, 0, nan], [nan, nan, 0, nan, 0, nan]]
    assert np.allclose(log.readings, expect, equal_nan=True)
    log = read_odometry(written(tmp_path / "c.csv", "t,wx,wy,wz\n0,1,2,3\n0,1,2,3\n1,4,5,6\n"))
    assert len(log.times) == 2
    assert np.isnan(log.readings[:, 3:]).all()


def test_wheels_of_a_file_without_a_header_by_number(tmp_path):
    path = written(tmp_path / "a.txt", "odom 0.0 1.0 1.2 9\nodom 0.1 0.5 0.5 9\n")
    source = Source({"t": "2", "left": "3", "right": "4"})
    log = read_odometry(path, source, wheelbase_m=0.4)
    assert np.allclose(log.readings, [[0, 0, 0.5, 1.1, 0, 0], [0, 0, 0, 0.5, 0, 0]])
    with_width = read_odometry(path, Source({"t": "2", "left": "3", "right": "4", "width": "5"}))
    assert np.allclose(with_width.readings[0, 2], 0.2 / 9)


@pytest.mark.parametrize(
    ("text", "options", "what"),
    [
        ("t,a\n0,1\n", {}, "must have some of the columns"),
        ("t,left,right\n0,1,1\n", {}, "wheelbase_m"),
        ("t,left,right\n0,1,1\n", {"wheelbase_m": 0.0}, "wheelbase_m"),
        ("t,vx,wz\n0,1,1\n", {"wheelbase_m": 0.4}, "wheelbase_m"),
        ("t,vx,wz\n0,1,x\n", {}, "line 2, column 'wz'"),
        ("t,vx,wz\n1,1,0\n0,1,0\n", {}, "line 3, column 't'"),
        ("t,vx,wz\n0,1,90\n", {}, "deg/s"),
        ("t,vx,wz\n0,800,0\n", {}, "are they in mm/s"),
        ("t,left,right,width\n0,1,1,0\n", {}, "width"),
        ("t,vx\n0,1\n", {"turn_unit": "rpm"}, "turn_unit"),
    ],
)
def test_odometry_that_is_none_is_refused(tmp_path, text, options, what):
    with pytest.raises(ValueError, match=what):
        read_odometry(written(tmp_path / "a.csv", text), **options)


def test_readings_count_until_half_way_and_no_longer_than_they_may():
    log = OdometryLog(np.array([0.0, 0.1, 0.2, 2.0]), np.arange(4.0)[:, None] * np.ones(6))
    readings, steps = odometry_between(log, 0.02, 0.18)
    assert np.allclose(readings[:, 0], [0, 1, 2])
    assert np.allclose(steps, [0.03, 0.1, 0.03])
    readings, steps = odometry_between(log, 0.2, 2.0, hold_s=0.4)
    assert np.allclose(readings[:, 0], [2, np.nan, 3], equal_nan=True)
    assert np.allclose(steps, [0.2, 1.4, 0.2])
    readings, steps = odometry_between(log, 5.0, 6.0)
    assert np.isnan(readings).all()
    assert np.allclose(steps, [1.0])
    with pytest.raises(ValueError, match="end_s"):
        odometry_between(log, 1.0, 0.0)


# Replay.


def a_log(seed=3, K=150, ahead=0.0):
    """A robot that drives a loop with one tag, a range an epoch; its clock may be ahead."""
    rng = np.random.default_rng(seed)
    dt = 0.1
    times = dt * np.arange(K)
    Q, t = rotations.exp([0.0, 0.0, 2.5]), np.array([4.0, 3.5, 0.0])
    anchors = ANCHORS * [1, 1, 0]
    ranges, places, twists = np.zeros((K, 4, 1)), [], []
    for k in range(K):
        places.append(t)
        ranges[k, k % 4, 0] = np.linalg.norm(anchors[k % 4] - t) + rng.normal(0, 0.05)
        w = 1.2 * np.sin(0.5 * times[k])
        twists.append([0, 0, w, 0.5, 0, 0])
        t = t + (Q @ rotations.left_jacobian([0.0, 0.0, w * dt]) @ [0.5 * dt, 0, 0])
        Q = Q @ rotations.exp([0.0, 0.0, w * dt])
    noise = OdometrySensor(0.02, 1e-6, 0.03)
    told = noise.read(np.array(twists), dt, rng, np.zeros(5))
    told[:, [0, 1, 4, 5]] = 0.0
    odometry = OdometryLog(times + 0.5 * dt + ahead, told)
    truth = Truth(times, None, np.array(places), True)
    return recorded.recording(times, ranges, anchors, np.zeros((1, 3)), truth, odometry=odometry)


SETTINGS = replay.Settings.of(
    filter="iekf-log", planar=True, height_m=0.0, range_std_m=0.05, constant_std_m=0.01,
    constant_common_m=0.0, drift_std_m=0.0,
)  # fmt: skip
START = (4.0, 3.5, 0.0, 143.0)


@with_kernels
def test_odometry_finds_the_heading_of_one_tag_and_halves_the_error():
    log = a_log()
    errors: dict[str, Any] = {
        name: replay.replay_recording(recording, SETTINGS).errors
        for name, recording in (("with", log), ("without", log._replace(odometry=None)))
    }
    late = slice(50, None)
    rms = {k: np.sqrt(np.mean(e.position[late] ** 2)) for k, e in errors.items()}
    assert rms["with"] < 0.04
    assert rms["with"] < 0.5 * rms["without"]


def test_the_smoother_with_odometry_is_better_than_the_filter():
    log = a_log(K=100)
    settings = SETTINGS.changed(
        smooth=True, smooth_bias_std_m=0.0, smooth_constant_m=0.01, smooth_common_m=0.0
    )
    found: Any = replay.replay_recording(log, settings)
    rms = [np.sqrt(np.mean(e.position**2)) for e in (found.errors, found.smoothed_errors)]
    assert rms[1] < 0.6 * rms[0]
    assert rms[1] < 0.05
    # Odometry of the way back is that of a body that goes it backwards.
    backwards: Any = replay_smoothing._backwards(log, settings)
    there: Any = log.odometry
    assert np.allclose(backwards.readings[0], -there.readings[-1])


def test_rows_of_the_smoother_have_the_derivatives_of_differences():
    rng = np.random.default_rng(4)
    intervals = [(rng.standard_normal((n, 6)), np.full(n, 0.03)) for n in (3, 2, 3)]
    intervals[0][0][1, 2] = np.nan
    readings, steps = smoothing.padded(intervals)
    assert readings.shape == (3, 3, 6)
    assert steps[1, 2] == 0
    law = smoothing.OdometryMotion(readings, steps, SENSOR)
    Q, t = rotations.random(rng, (4,)), rng.standard_normal((4, 3))
    own, small = 0.1 * rng.standard_normal(5), 1e-6

    def at(x, y):
        Qx = rotations.exp(x[:, :3]) @ Q
        state = smoothing.LogState(Qx, t + x[:, 3:], np.zeros((4, 0)), own + y)
        return law.linearize(state, np.zeros(4), own + y)

    base: Any = at(np.zeros((4, 6)), np.zeros(5))
    for i in range(6):
        x = np.zeros((4, 6))
        x[1, i] = small
        change = (at(x, np.zeros(5)).residual - base.residual) / small
        assert np.allclose(change[0], base.after[0, :, i], atol=1e-3)
        assert np.allclose(change[1], base.before[1, :, i], atol=1e-3)
    for i in range(5):
        y = np.zeros(5)
        y[i] = small
        change = (at(np.zeros((4, 6)), y).residual - base.residual) / small
        # To second order in the turn of a reading.
        assert np.allclose(change, base.constants[..., i], atol=0.02 * np.abs(change).max())


@with_kernels
def test_the_clock_of_the_odometry_by_the_likelihood():
    found = replay.sensor_clock(a_log(K=120, ahead=0.5), SETTINGS.changed(start=START))
    assert abs(found.offset_s - 0.5) < 3 * found.std_s
    assert found.std_s < 0.1
    assert found.gain > 5
    assert isinstance(found, replay.SensorClock)
    assert replay.CLOCK_TRIALS > 1


@with_kernels
def test_the_estimated_clock_is_printed_without_truth(tmp_path, capsys):
    log: Any = a_log(K=80, ahead=0.4)
    ranges = np.where(log.links, log.ranges, np.nan)
    files = recorded.files(tmp_path, log.anchors, log.tags, log.times, ranges)
    rows = np.c_[log.odometry.times, log.odometry.readings[:, [3, 2]]]
    files["odometry"] = recorded.table(tmp_path / "odometry.csv", "t,vx,wz", rows)
    how = ["--planar", "--height-m", "0", "--range-std-m", "0.05"]
    assert main(["replay", *recorded.options(files), *how, "--time-offset", "odometry=auto"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    found = re.search(r"the clock of --odometry is ahead by (\S+) s \+- (\S+) s", printed)
    assert found is not None
    assert abs(float(found[1]) - 0.4) < 4 * float(found[2])


def test_tuning_finds_the_noise_of_the_odometry():
    log = a_log(K=25)
    rough = SETTINGS.changed(odometry_m=0.5, odometry_deg=60.0, start=START)
    tuned = replay.tune(log, rough)
    assert {*tuned.found} >= {"range_std_m", "odometry_m", "odometry_deg", "constant_std_m"}
    assert float(tuned.found["odometry_m"]) < 0.2
    assert tuned.log_likelihood > tuned.log_likelihood_before


def test_other_filters_do_not_read_odometry():
    with pytest.raises(ValueError, match="odometry needs the filter 'iekf-log'"):
        replay.replay_recording(a_log(K=20), replay.Settings.of(filter="iekf"))


@pytest.mark.skipif(not REAL.is_dir(), reason="the data set is not here")
def test_a_wheeled_robot_with_one_tag_from_an_unknown_heading():
    names = {"odometry.t": "2", "odometry.left": "3", "odometry.right": "4"}
    log = recordings.read_recording(
        recordings.Files(
            REAL / "ranges.csv", truth=REAL / "truth.csv", odometry=REAL / "odometry_raw.txt"
        ),
        format=Format(columns=names, wheelbase_m=0.157),
    )
    settings = replay.Settings.of(filter="iekf-log", planar=True, height_m=0.0)
    figures = replay.replay_recording(log, settings).figures
    assert figures["position_rmse_m"] < 0.09


# An inertial sensor in replay.


def an_inertial_log(ahead=0.0):
    """A body that circles with two tags, ranges at 10 Hz, and an ideal sensor at 100 Hz."""
    rng, rate, radius, K = np.random.default_rng(5), 0.8, 1.5, 60
    when = np.arange(-1.0, 7.0, 0.01)
    turn = np.array([[0.0, 0.0, rate], [-rate * rate * radius, 0.0, 9.80665]])
    readings = np.tile(turn.ravel(), (len(when), 1)) + 1e-3 * rng.standard_normal((len(when), 6))
    times = 0.1 * np.arange(K)
    Q = rotations.exp(rate * times[:, None] * [0.0, 0.0, 1.0])
    t = np.array([3.0, 2.5, 0.8]) + radius * Q[:, :, 0]
    ranges = ranging.distances(ANCHORS, ranging.tag_positions(Q, t, TAGS))
    ranges = ranges + 0.03 * rng.standard_normal(ranges.shape)
    log = InertialLog(when + ahead, readings)
    return recorded.recording(times, ranges, ANCHORS, TAGS, Truth(times, Q, t), inertial=log)


INERTIAL = replay.Settings.of(
    filter="iekf-imu", range_std_m=0.03, constant_std_m=0.01, constant_common_m=0.0,
    drift_std_m=0.0, gyro_noise=1e-3, accel_noise=0.01, gravity_tilt_deg=0.0, headings=8,
)  # fmt: skip


def test_replay_with_an_inertial_sensor_finds_the_pose():
    errors: Any = replay.replay_recording(an_inertial_log(), INERTIAL).errors
    assert np.sqrt(np.mean(errors.position[30:] ** 2)) < 0.05
    assert np.degrees(np.sqrt(np.mean(errors.rotation[30:] ** 2))) < 4


def test_a_track_by_an_inertial_sensor_is_smoothed():
    """From an unknown heading, which the smoother knows from the first epoch on."""
    settings = INERTIAL.changed(smooth=True)
    replayed: Any = replay.replay_recording(an_inertial_log(), settings)
    assert replayed.smoothed.found.converged
    causal, smoothed = replayed.errors, replayed.smoothed_errors
    assert np.degrees(np.sqrt(np.mean(smoothed.rotation**2))) < 4
    for name in ("position", "rotation"):
        square = [np.mean(getattr(errors, name) ** 2) for errors in (causal, smoothed)]
        assert square[1] < 0.5 * square[0]
    assert 0.3 < np.mean(smoothed.nees) / smoothed.freedom < 2.5


@pytest.mark.parametrize("sensor", ["odometry", "inertial"])
def test_the_smoother_keeps_a_planar_body_level_with_a_sensor(sensor):
    """Held within 1 mm and 1 mrad, as by the filter."""
    log: Any = an_inertial_log()
    settings = INERTIAL.changed(planar=True, height_m=0.8)
    if sensor == "odometry":
        # Wheels that measure the turn rate and the speed along y.
        told = np.tile([np.nan, np.nan, 0.8, np.nan, 1.2, np.nan], (len(log.times), 1))
        log = log._replace(inertial=None, odometry=OdometryLog(log.times, told))
        settings = SETTINGS.changed(height_m=0.8, range_std_m=0.03)
    found: Any = replay.replay_recording(log, settings.changed(smooth=True))
    track = found.smoothed.track
    assert found.smoothed.found.converged
    assert np.abs(track.rotation[:, :2, 2]).max() < 1e-3
    assert np.abs(track.translation[:, 2] - settings.knowledge.height_m).max() < 1e-3


def test_ranges_that_state_their_deviations_count_by_a_share():
    """What they state is noise and biases: by half of it the filter is told half of it."""
    log = an_inertial_log()
    std = np.full(log.ranges.shape, 0.06)
    own = INERTIAL.changed(range_std_m=None, recorded_share=0.5)
    tracks = [
        replay.track_recording(log._replace(range_std=std), own),
        replay.track_recording(log, INERTIAL.changed(range_std_m=0.03)),
    ]
    np.testing.assert_allclose(tracks[0].translation, tracks[1].translation, atol=1e-9)
    assert replay.Settings.of(filter="iekf-imu").biases.drift_time_s == 20


def test_epochs_without_readings_are_left_out_by_the_clock():
    log = an_inertial_log(ahead=3.0)
    short = replay.covered(log, INERTIAL)
    assert short.times[0] >= 2.25
    assert len(replay.covered(log, INERTIAL.changed(imu_offset_s=3.0)).times) == len(log.times)
    with pytest.raises(ValueError, match=r"--time-offset imu="):
        replay.covered(log, INERTIAL.changed(imu_offset_s=-50.0))
    with pytest.raises(ValueError, match="needs imu"):
        replay.replay_recording(log._replace(inertial=None), INERTIAL)


def test_axes_of_a_sensor_by_a_vector_or_a_file(tmp_path):
    want = Rotation.from_rotvec([30, -20, 10], degrees=True)
    assert np.allclose(recordings.read_frame("30,-20,10"), want.as_matrix())
    x, y, z, w = want.as_quat()
    path = written(tmp_path / "frame.csv", f"qw,qx,qy,qz\n{w},{x},{y},{z}\n")
    assert np.allclose(recordings.read_frame(path), want.as_matrix())
    with pytest.raises(ValueError, match="norm 1"):
        recordings.read_frame(written(tmp_path / "a.csv", "qw,qx,qy,qz\n1,1,0,0\n"))


def test_settings_of_sensors_are_checked_and_known_by_their_fields():
    settings = replay.Settings.of(slip_m=0.1, gyro_noise=0.01)
    assert settings.odometry == replay.Odometry(slip_m=0.1)
    assert settings.inertial == replay.Inertial(gyro_noise=0.01)
    for wrong in ({"odometry_m": 0.0}, {"headings": 0}, {"gravity_tilt_deg": -1.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            replay.Settings.of(**wrong)


@pytest.mark.parametrize("odometry", [True, {"speed": 1.0}])
def test_a_wrong_sensor_of_the_filter_is_named(odometry):
    with pytest.raises(ValueError, match="odometry must be an OdometrySensor, its fields, or None"):
        estimators.make(
            "iekf-log",
            tags=np.eye(3),
            noise=ranging.RangeNoise(0.1),
            process=motion.ProcessNoise(),
            odometry=odometry,
        )


def test_the_peak_of_a_ragged_likelihood():
    """The sharp bend between the finest steps is that of noise, not of the peak."""
    x = [0.0, 0.1, 0.11, 0.14, 0.17, 0.2, 0.23, 0.26, 0.29, 0.3, 0.4]
    y = [-6.2, -3.3, -3.9, -6.2, -9.4, 0.0, -1.1, -17.3, -18.1, -18.8, -29.2]
    at, std = _peak(dict(zip(x, y, strict=True)), 0.2)
    assert abs(at - 0.15) < 2 * std
    exact = {a: -0.5 * ((a - 0.18) / 0.05) ** 2 for a in x}
    assert _peak(exact, 0.17) == pytest.approx((0.18, 0.05))

"""Bias and deviation by direction, and the axes of a gyroscope: known answers, real agents."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym.estimators.calibration.directions import (
    DirectionBasis,
    DirectionModel,
    choose_basis,
    direction_model_at,
    fit_directions,
    locate_by_directions,
)
from rbl_gym.estimators.calibration.turn_rates import SensorTurn, align_turn_rates
from rbl_gym.estimators.smoothing.knowledge import Level
from rbl_gym.recordings import InertialLog, Truth, read_frame, read_inertial, read_truth
from rbl_gym.studies import calibrate
from tests.helpers import ROOT, with_kernels

STARLOC = ROOT.parent / "shared" / "data" / "starloc_two_tags"
MURP = ROOT.parent / "shared" / "data" / "murp_relative"
ANGLES = np.pi / 6 + np.pi / 3 * np.arange(6)
RING = 0.32 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(6)])
TRUE = DirectionModel(
    DirectionBasis(1), np.array([0.1, -0.08, 0.02, -0.06, 0.0]), np.array([-3, -0.5, 0, -0.4, 0.2])
)
LEVEL = Level(-0.5, 0.2, np.radians(3))


def agents(rng, epochs, model=TRUE):
    """Two rings of antennas; ranges with the law of the module, entry by entry."""
    yaw, bearing = rng.uniform(-np.pi, np.pi, (2, epochs))
    away = rng.uniform(2, 6, epochs)
    place = np.column_stack([away * np.cos(bearing), away * np.sin(bearing), np.full(epochs, -0.5)])
    rotation = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    ranges = np.zeros((epochs, 6, 6))
    for k in range(epochs):
        for m in range(6):
            for n in range(6):
                ray = place[k] + rotation[k] @ RING[n] - RING[m]
                at_a = np.arctan2(ray[1], ray[0]) - ANGLES[m]
                back = -rotation[k].T @ ray
                at_b = np.arctan2(back[1], back[0]) - ANGLES[n]
                f = [1, np.cos(at_a), np.sin(at_a), np.cos(at_b), np.sin(at_b)]
                std = np.exp(model.log_std @ f)
                ranges[k, m, n] = np.linalg.norm(ray) + model.bias @ f
                ranges[k, m, n] += std * rng.standard_normal()
    return ranges, rotation, place


def test_coefficients_are_found_and_poses_with_them():
    rng = np.random.default_rng(0)
    ranges, rotation, place = agents(rng, 150)
    told = (ranges > 0, RING, RING)
    found = fit_directions(ranges, *told, rotation, place, ridge=1e-4)
    assert isinstance(found, DirectionModel)
    # Late residuals are taken for Cauchy's: of a Gaussian the bias comes out a little early.
    np.testing.assert_allclose(found.bias[1:], TRUE.bias[1:], atol=0.01)
    np.testing.assert_allclose(found.log_std[1:], TRUE.log_std[1:], atol=0.15)
    fresh, turned, moved = agents(rng, 40)
    errors = {}
    for basis in (DirectionBasis(0), DirectionBasis(1)):
        model = fit_directions(ranges, *told, rotation, place, basis)
        Q, t, cost = locate_by_directions(fresh, fresh > 0, RING, RING, model, LEVEL)
        assert cost.shape == (40,)
        errors[basis.harmonics] = np.linalg.norm((t - moved)[:, :2], axis=1).mean()
        heading = np.degrees(
            np.abs(Rotation.from_matrix(Q @ np.swapaxes(turned, 1, 2)).magnitude())
        )
    assert errors[1] < 0.6 * errors[0]
    assert heading.mean() < 6


def test_the_model_is_that_of_the_equations():
    rng = np.random.default_rng(1)
    quiet = TRUE._replace(log_std=np.array([-20.0, 0, 0, 0, 0]))
    ranges, rotation, place = agents(rng, 3, quiet)
    bias, std = direction_model_at(TRUE, rotation, place, RING, RING)
    places = place[:, None] + RING @ np.swapaxes(rotation, 1, 2)
    d = np.linalg.norm(places[:, None] - RING[:, None], axis=-1)
    np.testing.assert_allclose(d + bias, ranges, atol=1e-6)
    assert (std > 0).all()


@with_kernels
def test_cross_validation_takes_the_simplest_that_serves():
    rng = np.random.default_rng(2)
    candidates = DirectionBasis(0), DirectionBasis(1)
    for model, want in (
        (TRUE, 1),
        (
            TRUE._replace(bias=TRUE.bias * [1, 0, 0, 0, 0], log_std=TRUE.log_std * [1, 0, 0, 0, 0]),
            0,
        ),
    ):
        ranges, rotation, place = agents(rng, 18, model)
        told = (ranges > 0, RING, RING, rotation, place)
        best, errors = choose_basis(ranges, *told, candidates, LEVEL, parts=3)
        assert best == DirectionBasis(want)
        assert errors.shape == (2, 3)


def test_directions_refuse_what_is_wrong():
    with pytest.raises(ValueError, match="zero"):
        DirectionBasis(zero="north")
    with pytest.raises(ValueError, match="ends"):
        DirectionBasis(ends="anchors")
    nothing = np.zeros((2, 6, 6))
    with pytest.raises(ValueError, match="must have at least one measured link"):
        fit_directions(nothing, nothing > 0, RING, RING, np.zeros((2, 3, 3)), np.zeros((2, 3)))


def test_a_gyroscope_is_found_with_honest_deviations():
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        turn = Rotation.from_rotvec(rng.uniform(-1.5, 1.5, 3)).as_matrix()
        bias = 0.02 * rng.standard_normal(3)
        body = rng.normal([0.0, 0.1, 0.3], [0.3, 0.4, 0.6], (400, 3))
        sensor = body @ turn + bias + 0.05 * rng.standard_normal((400, 3))
        if seed % 2:
            sensor[::40] += 5.0
        found = align_turn_rates(sensor, body)
        assert isinstance(found, SensorTurn)
        error = Rotation.from_matrix(found.rotation @ turn.T).as_rotvec()
        squares += [
            *((error / found.rotation_std_rad) ** 2),
            *(((found.bias - bias) / found.bias_std) ** 2),
        ]
    assert np.mean(squares) == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(squares)))
    with pytest.raises(ValueError, match="two axes"):
        align_turn_rates(np.outer(np.arange(20.0), [0, 0, 1]), np.outer(np.arange(20.0), [0, 0, 1]))
    with pytest.raises(ValueError, match="at least 10"):
        align_turn_rates(np.eye(3), np.eye(3))


def recorded(trial: int, base: int, target: int):
    """Ranges, antennas, and pose of the target relative to the base."""
    arms: dict[int, list] = {}
    for row in csv.DictReader((MURP / "antenna_lever_arms_fitted.csv").open()):
        arms.setdefault(int(row["agent"]), []).append([float(row[axis]) for axis in "xyz"])
    rows = list(csv.DictReader((MURP / f"trial{trial:02d}_base{base}_target{target}.csv").open()))
    poses = {}
    for end in "AB":
        angles = [[float(row[f"{end}_{a}"]) for a in ("yaw", "pitch", "roll")] for row in rows]
        place = np.array([[float(row[f"{end}_{a}"]) for a in "xyz"] for row in rows])
        poses[end] = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix(), place
    ranges = [
        [[float(row[f"r_{i}_{j}"]) for j in range(1, 7)] for i in range(1, 7)] for row in rows
    ]
    back = np.swapaxes(poses["A"][0], 1, 2)
    shift = (back @ (poses["B"][1] - poses["A"][1])[..., None])[..., 0]
    return (
        np.array(ranges),
        np.array(arms[base]),
        np.array(arms[target]),
        back @ poses["B"][0],
        shift,
    )


def test_clock_and_turn_of_a_sensor_by_a_track(tmp_path):
    """The sensor's clock is 1.7 s ahead, it sits turned, and its bias is small."""
    rng = np.random.default_rng(3)
    times = 0.01 * np.arange(3000)
    yaw = np.sin(0.9 * times) + 0.7 * np.sin(2.3 * times)
    angles = np.column_stack([yaw, 0.5 * np.sin(1.7 * times), 0.4 * np.cos(1.1 * times)])
    path = Rotation.from_euler("ZYX", angles)
    turn = Rotation.from_euler("xyz", [179, 2, 13], degrees=True).as_matrix()
    step = (path[:-1].inv() * path[1:]).as_rotvec() / 0.01
    bias = np.array([0.01, -0.02, 0.005])
    sensor = step @ turn + bias + 0.02 * rng.standard_normal(step.shape)
    stamps = times[:-1] + 0.005 + 1.7
    log = InertialLog(stamps, np.concatenate([sensor, np.zeros_like(sensor)], axis=1))
    truth = Truth(times, path.as_matrix(), np.zeros((3000, 3)))
    found = calibrate.calibrate_inertial(log, truth)
    assert isinstance(found, calibrate.CalibratedInertial)
    assert found.clock.offset_s == pytest.approx(1.7, abs=0.005)
    off = Rotation.from_matrix(found.turn.rotation @ turn.T).magnitude()
    assert np.degrees(off) < 0.3
    np.testing.assert_allclose(found.turn.bias, bias, atol=0.005)
    calibrate.write_frame(tmp_path / "imu_frame.csv", found.turn.rotation)
    read = read_frame(tmp_path / "imu_frame.csv")
    np.testing.assert_allclose(read, found.turn.rotation, atol=1e-7)
    figures = calibrate.inertial_figures(found, 0.2)
    assert figures["imu_offset_s"] == pytest.approx(1.9, abs=0.005)
    vector = Rotation.from_matrix(read).as_rotvec(degrees=True)
    np.testing.assert_allclose(figures["rotation_vector_deg"], vector, atol=1e-4)
    with pytest.raises(ValueError, match="rotations"):
        calibrate.calibrate_inertial(log, truth._replace(rotation=None))


@pytest.mark.skipif(not STARLOC.is_dir(), reason="the STAR-loc recording is not on this machine")
def test_a_real_sensor_by_motion_capture():
    log = read_inertial(STARLOC / "imu.csv")
    found = calibrate.calibrate_inertial(log, read_truth(STARLOC / "truth.csv"))
    assert found.clock.offset_s == pytest.approx(1.392, abs=0.01)
    want = Rotation.from_rotvec(np.radians([179.0, 0.2, 13.6])).as_matrix()
    off = Rotation.from_matrix(found.turn.rotation @ want.T).magnitude()
    assert np.degrees(off) < 1.5


@pytest.mark.long
@pytest.mark.skipif(not MURP.is_dir(), reason="the MURP recordings are not on this machine")
def test_real_agents_one_trial_by_another():
    """Fitted on trial 9, tried on trial 13: one harmonic at each end against a constant."""
    errors: dict[int, list] = {0: [], 1: []}
    headings: dict[int, list] = {0: [], 1: []}
    for pair in ((1, 2), (1, 3), (2, 3)):
        r, a, b, Q, t = recorded(9, *pair)
        fresh, _, _, turned, moved = recorded(13, *pair)
        level = Level(float(t[:, 2].mean()), 0.2, np.radians(3))
        for harmonics in errors:
            model = fit_directions(r, r > 0, a, b, Q, t, DirectionBasis(harmonics))
            R, p, _ = locate_by_directions(fresh, fresh > 0, a, b, model, level)
            errors[harmonics] += np.linalg.norm((p - moved)[:, :2], axis=1).tolist()
            off = R @ np.swapaxes(turned, 1, 2)
            yaw = np.arctan2(off[:, 1, 0] - off[:, 0, 1], off[:, 0, 0] + off[:, 1, 1])
            headings[harmonics] += np.degrees(np.abs(yaw)).tolist()
    assert np.mean(errors[1]) <= 0.24
    assert np.mean(errors[1]) < 0.85 * np.mean(errors[0])
    assert np.mean(headings[1]) <= 7.0

"""Motion against a step-by-step loop, the noisy kinematics themselves, scipy, and geometry."""

from __future__ import annotations

import itertools
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from rbl_gym import motion
from rbl_gym.geometry import rotations
from rbl_gym.motion import ProcessNoise, Trajectory

PROPERTY = settings(deadline=None, derandomize=True, max_examples=30)
SEEDS = st.integers(0, 2**32 - 1)
STILL = ProcessNoise()


def draw_trajectory(seed: int, batch: tuple[int, ...] = (), steps: int = 7) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(
        rotations.random(rng, batch),
        rng.normal(0, 5, (*batch, 3)),
        rng.standard_normal((*batch, steps, 6)),
    )


def naive_path(start: Trajectory, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """One trial, one step after the other, with scipy's rotations."""
    rotation, place = Rotation.from_matrix(start.rotation), np.array(start.translation)
    matrices, places = [rotation.as_matrix()], [place]
    for twist in start.twists:
        rotation = Rotation.from_rotvec(twist[:3] * dt) * rotation
        place = place + twist[3:] * dt
        matrices.append(rotation.as_matrix())
        places.append(place)
    return np.stack(matrices), np.stack(places)


# --- kinematics -------------------------------------------------------------------------------


@PROPERTY
@given(SEEDS, st.floats(0.01, 2))
def test_simulate_equals_a_loop_with_scipy(seed, dt):
    start = draw_trajectory(seed)
    matrices, places = naive_path(start, dt)
    path = motion.simulate(start, dt, STILL)
    np.testing.assert_allclose(path.rotation, matrices, atol=1e-13)
    np.testing.assert_allclose(path.translation, places, atol=1e-12)


@PROPERTY
@given(SEEDS, st.floats(0.01, 2))
def test_propagate_repeated_equals_simulate(seed, dt):
    start = draw_trajectory(seed, (3,))
    path = motion.simulate(start, dt, STILL)
    pose = start.rotation, start.translation
    for k in range(start.twists.shape[-2]):
        pose = motion.propagate(*pose, start.twists[:, k], dt)
        np.testing.assert_allclose(pose[0], path.rotation[:, k + 1], atol=1e-13)
        np.testing.assert_allclose(pose[1], path.translation[:, k + 1], atol=1e-12)


def test_propagate_takes_a_time_step_per_trial():
    start = draw_trajectory(0, (4,))
    dt = np.array([0.1, 0.2, 0.5, 1.0])
    rotation, translation = motion.propagate(*start[:2], start.twists[:, 0], dt)
    for n in range(4):
        pose = start.rotation[n], start.translation[n]
        want = motion.propagate(*pose, start.twists[n, 0], dt[n])
        np.testing.assert_array_equal(rotation[n], want[0])
        np.testing.assert_array_equal(translation[n], want[1])


def test_process_noise_of_simulate_is_on_the_twist():
    process = ProcessNoise((0.1, 0.2, 0.3), (1.0, 0.0, 2.0))
    start, dt = draw_trajectory(1), 0.25
    normals = np.random.default_rng(2).standard_normal(start.twists.shape)
    path = motion.simulate(start, dt, process, normals)
    std = np.array([0.1, 0.2, 0.3, 1.0, 0.0, 2.0]) / np.sqrt(dt)
    noisy = start._replace(twists=start.twists + normals * std)
    matrices, places = naive_path(noisy, dt)
    np.testing.assert_allclose(path.rotation, matrices, atol=1e-13)
    np.testing.assert_allclose(path.translation, places, atol=1e-12)


def test_simulated_trials_are_a_loop_over_trials():
    batch = draw_trajectory(3, (2, 3))
    path = motion.simulate(batch, 0.1, STILL)
    for index in np.ndindex(2, 3):
        one = motion.simulate(Trajectory(*(x[index] for x in batch)), 0.1, STILL)
        np.testing.assert_allclose(path.rotation[index], one.rotation, rtol=1e-14)
        np.testing.assert_allclose(path.translation[index], one.translation, rtol=1e-14)


@PROPERTY
@given(SEEDS, st.floats(0.01, 0.5))
def test_twists_between_poses_reproduce_the_path(seed, dt):
    start = draw_trajectory(seed, (2,))
    twists = motion.twists_between(*motion.simulate(start, dt, STILL), dt)
    np.testing.assert_allclose(twists, start.twists, atol=1e-11)


def test_twists_between_poses_at_uneven_times():
    path = motion.simulate(draw_trajectory(6, steps=3), 1.0, STILL)
    dt = np.array([0.5, 1.0, 2.0])
    twists = motion.twists_between(*path, dt)
    for k in range(3):
        pose = path.rotation[k], path.translation[k]
        rotation, translation = motion.propagate(*pose, twists[k], dt[k])
        np.testing.assert_allclose(rotation, path.rotation[k + 1], atol=1e-13)
        np.testing.assert_allclose(translation, path.translation[k + 1], atol=1e-13)


# --- process noise ----------------------------------------------------------------------------

TWIST = np.array([1.2, -0.7, 2.0, 3.0, 0.0, -1.0])
PER_AXIS = ProcessNoise((0.02, 0.01, 0.0), (0.3, 0.0, 0.1))


@pytest.mark.parametrize("process", [ProcessNoise(0.02, 0.3), PER_AXIS])
@pytest.mark.parametrize("dt", [0.1, 1.0])
def test_process_covariance_is_that_of_the_noisy_kinematics(process, dt):
    n = 40_000
    normals = np.random.default_rng(8).standard_normal((n, 1, 6))
    start = motion.constant_twist(np.eye(3), np.zeros(3), TWIST, 1)
    noisy, still = (motion.simulate(start, dt, process, z) for z in (normals, normals[:1] * 0))
    turn = rotations.error(noisy.rotation[:, 1], still.rotation[:, 1])
    error = np.concatenate([turn, noisy.translation[:, 1] - still.translation[:, 1]], axis=-1)
    want = process.covariance(TWIST, dt)
    variance = np.diagonal(want)
    # Of n draws a covariance entry has deviation sqrt((P_ii P_jj + P_ij^2) / n); 4.5 of them,
    # and 1e-3 of the scale for the second order of the exponential.
    scale = np.sqrt(np.multiply.outer(variance, variance))
    off = np.abs(error.T @ error / n - want)
    assert (off <= 4.5 * np.sqrt((scale**2 + want**2) / n) + 1e-3 * scale + 1e-18).all()


@pytest.mark.parametrize("dt", [0.01, 0.5, 1.0])
def test_process_covariance_is_propagated_by_finite_differences(dt):
    step, columns = 1e-5, []
    rotation, _ = motion.propagate(np.eye(3), np.zeros(3), TWIST, dt)
    for e in step * np.eye(6):
        there, back = (motion.propagate(np.eye(3), np.zeros(3), TWIST + s * e, dt) for s in (1, -1))
        turn = rotations.error(there[0], rotation) - rotations.error(back[0], rotation)
        columns.append(np.concatenate([turn, there[1] - back[1]]) / (2 * step))
    B = np.stack(columns, axis=-1)
    want = B @ np.diag(PER_AXIS.std() ** 2 / dt) @ B.T
    np.testing.assert_allclose(PER_AXIS.covariance(TWIST, dt), want, atol=1e-9 * want.max())


def test_process_covariance_of_a_batch_is_a_loop():
    twists = np.random.default_rng(0).standard_normal((4, 3, 6))
    dt = np.array([0.1, 0.5, 1.0])
    got = PER_AXIS.covariance(twists, dt)
    assert got.shape == (4, 3, 6, 6)
    for i, j in np.ndindex(4, 3):
        np.testing.assert_allclose(got[i, j], PER_AXIS.covariance(twists[i, j], dt[j]), rtol=1e-14)
    spread = PER_AXIS.covariance(twists[0, 0], dt)
    np.testing.assert_allclose(spread[1], PER_AXIS.covariance(twists[0, 0], dt[1]), rtol=1e-14)


def test_one_number_of_noise_counts_for_all_axes():
    np.testing.assert_array_equal(ProcessNoise(0.1, (1, 2, 3)).std(), [0.1, 0.1, 0.1, 1, 2, 3])


def test_process_noise_from_lists_is_hashable_and_equal_to_that_from_tuples():
    lists: list = [0.1, 0.2, 0.3]
    assert ProcessNoise(lists, lists) == ProcessNoise((0.1, 0.2, 0.3), (0.1, 0.2, 0.3))  # pyrefly: ignore[bad-argument-type]
    assert hash(ProcessNoise(lists, 1)) == hash(ProcessNoise((0.1, 0.2, 0.3), 1.0))  # pyrefly: ignore[bad-argument-type]


@pytest.mark.parametrize("name", ["rotation_rad", "translation_m"])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (-0.1, "must not be negative, got -0.1"),
        ([0.1, -0.2, 0.3], "must not be negative, got [0.1, -0.2, 0.3]"),
        ([0.1, 0.2], "must be one number or three, got shape (2,)"),
        (np.ones((4, 2)), "must be one number or three, got shape (4, 2)"),
        (np.nan, "must be finite, got nan"),
        ("0.1", "must be an array of real numbers, got '0.1'"),
    ],
)
def test_bad_process_noise_is_refused(name, value, message):
    with pytest.raises(ValueError, match=re.escape(f"{name} {message}")):
        ProcessNoise(**{name: value})


# --- trajectories -----------------------------------------------------------------------------


def test_constant_twist_is_the_same_at_every_step():
    start = motion.constant_twist(np.eye(3), [1, 2, 3], TWIST, 5)
    np.testing.assert_array_equal(start.twists, [TWIST] * 5)
    end = motion.simulate(start, 0.2, STILL)
    np.testing.assert_allclose(end.rotation[-1], Rotation.from_rotvec(TWIST[:3]).as_matrix())
    np.testing.assert_allclose(end.translation[-1], np.array([1, 2, 3]) + TWIST[3:])


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_held_twists_have_exact_speeds_and_hold_their_directions(batch):
    directions = np.random.default_rng(0).standard_normal((*batch, 3, 2, 3))
    twists = motion.held_twists(directions, 0.2, 1.5, 25, 10)
    assert twists.shape == (*batch, 25, 6)
    np.testing.assert_allclose(np.linalg.norm(twists[..., :3], axis=-1), 0.2, rtol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(twists[..., 3:], axis=-1), 1.5, rtol=1e-14)
    changes = np.abs(np.diff(twists, axis=-2)).max(axis=-1) > 0
    want = np.isin(np.arange(24), [9, 19])
    np.testing.assert_array_equal(changes, np.broadcast_to(want, changes.shape))


POINTS = np.array([[0.0, 0, 0], [4, 0, 0], [4, 3, 0], [4, 3, 0], [4, 3, 2]])  # one point twice


def point_at(points: np.ndarray, travelled: float) -> np.ndarray:
    """The point of a polyline at a length from its start, leg by leg."""
    for start, stop in itertools.pairwise(points):
        length = float(np.linalg.norm(stop - start))
        if travelled <= length and length > 0:
            return start + travelled / length * (stop - start)
        travelled -= length
    return points[-1]


@PROPERTY
@given(SEEDS, st.floats(0, 10), st.floats(0.01, 1))
def test_waypoints_go_along_the_line_at_constant_speed_and_rest_at_its_end(seed, speed, dt):
    points = np.random.default_rng(seed).normal(0, 3, (5, 3))
    spin = np.array([0.1, 0.2, -0.3])
    start = motion.waypoints(np.eye(3), points, speed, dt, 30, spin)
    path = motion.simulate(start, dt, STILL)
    want = [point_at(points, speed * dt * k) for k in range(31)]
    np.testing.assert_allclose(path.translation, want, atol=1e-10)
    np.testing.assert_allclose(
        path.rotation[-1], Rotation.from_rotvec(30 * dt * spin).as_matrix(), atol=1e-12
    )


def test_simulate_writes_into_given_arrays():
    rng = np.random.default_rng(7)
    start = rotations.random(rng, (3,)), rng.standard_normal((3, 3))
    trajectory = motion.Trajectory(*start, rng.standard_normal((3, 5, 6)))
    want = motion.simulate(trajectory, 0.1, motion.ProcessNoise())
    # Epoch by epoch in memory, as the vector environments hold them.
    arrays = np.empty((6, 3, 3, 3)), np.empty((6, 3, 3))
    out = motion.Path(*(np.swapaxes(array, 0, 1) for array in arrays))
    motion.simulate(trajectory, 0.1, motion.ProcessNoise(), out=out)
    for got, field in zip(out, want, strict=True):
        np.testing.assert_array_equal(got, field)


def test_waypoints_pass_through_the_points():
    path = motion.simulate(motion.waypoints(np.eye(3), POINTS, 2.0, 0.5, 12), 0.5, STILL)
    np.testing.assert_allclose(path.translation[[0, 4, 7, 9]], POINTS[[0, 1, 2, 4]], atol=1e-14)
    np.testing.assert_allclose(path.translation[9:], [POINTS[-1]] * 4, atol=1e-14)


def test_waypoints_of_a_batch_are_a_loop():
    rng = np.random.default_rng(3)
    points, spin = rng.normal(0, 3, (2, 3, 4, 3)), rng.standard_normal((2, 3, 3))
    got = motion.waypoints(rotations.random(rng, (2, 3)), points, 1.0, 0.5, 9, spin)
    for index in np.ndindex(2, 3):
        one = motion.waypoints(got.rotation[index], points[index], 1.0, 0.5, 9, spin[index])
        np.testing.assert_array_equal(got.twists[index], one.twists)
        np.testing.assert_array_equal(got.translation[index], one.translation)


def test_one_line_of_waypoints_takes_many_spins():
    spin = np.random.default_rng(0).standard_normal((5, 3))
    got = motion.waypoints(np.eye(3), POINTS, 1.0, 0.5, 9, spin)
    one = motion.waypoints(np.eye(3), POINTS, 1.0, 0.5, 9, spin[2])
    np.testing.assert_array_equal(got.twists[2], one.twists)


@pytest.mark.parametrize(
    ("low", "high", "spacing", "lanes"),
    [
        ((0, 0, -2), (10, 6, 4), 2.0, [0, 2, 4, 6]),
        ((0, 0, -2), (10, 5, 4), 2.0, [0, 2, 4]),
        ((0, 0, 0), (10, 0, 0), 2.0, [0]),
        ((0, 0, 0), (10, 0.3, 0), 0.1, [0, 0.1, 0.2, 0.3]),
        ((0, 1, 0), (10, 7, 0), 0.2 * 6, [1, 2.2, 3.4, 4.6, 5.8, 7]),
    ],
)
def test_lawn_mower_goes_up_and_down_its_lanes(low, high, spacing, lanes):
    points = motion.lawn_mower_points(low, high, spacing)
    assert points.shape == (2 * len(lanes), 3)
    np.testing.assert_allclose(points[:, 1], np.repeat(lanes, 2), atol=1e-12)
    np.testing.assert_array_equal(points[:, 2], (low[2] + high[2]) / 2)
    ends = [[low[0], high[0]], [high[0], low[0]]] * len(lanes)
    np.testing.assert_array_equal(points[:, 0].reshape(-1, 2), ends[: len(lanes)])


def test_orbit_stays_on_its_circle_at_its_speed_with_the_nose_along_the_motion():
    centre, dt = np.array([1.0, 2, 3]), 0.05
    path = motion.simulate(motion.orbit(centre, 4.0, 2.0, dt, 300, phase=0.7), dt, STILL)
    arm = path.translation - centre
    angle = 0.7 + 2.0 / 4.0 * dt * np.arange(301)
    want = 4 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    np.testing.assert_allclose(arm, want, atol=1e-12)
    nose = path.rotation[..., 0]
    np.testing.assert_allclose(nose, np.cross([0, 0, 1], arm) / 4, atol=1e-12)
    np.testing.assert_allclose(path.rotation[..., 2], [[0, 0, 1]] * 301, atol=1e-12)
    speed = np.linalg.norm(np.diff(path.translation, axis=0), axis=-1) / dt
    np.testing.assert_allclose(speed, 2 * 4 * np.sin(0.5 * 0.5 * dt) / dt)  # chords
    np.testing.assert_allclose(speed, 2.0, rtol=1e-4)


@pytest.mark.parametrize("centre", [np.zeros(3), np.arange(12.0).reshape(4, 3)])
@pytest.mark.parametrize("phase", [0.3, np.array([0.1, 0.2, 3.0, -1.0])])
def test_orbits_of_a_batch_are_a_loop(centre, phase):
    got = motion.orbit(centre, 4.0, 2.0, 0.1, 6, phase)
    for n in range(4):
        one_centre = centre if centre.ndim == 1 else centre[n]
        one = motion.orbit(one_centre, 4.0, 2.0, 0.1, 6, np.resize(phase, 4)[n])
        for a, b in zip(got, one, strict=True):
            a = np.broadcast_to(a, (4, *b.shape))[n]
            np.testing.assert_allclose(a, b, atol=1e-12)


# --- recorded tracks --------------------------------------------------------------------------


def track(seed: int, length: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.2, 1.0, length))
    return times, rotations.random(rng, (length,)), rng.standard_normal((length, 3))


@PROPERTY
@given(SEEDS)
def test_interpolation_equals_slerp_and_lines_and_holds_the_ends(seed):
    times, rotation, translation = track(seed)
    inside = np.random.default_rng(seed).uniform(times[0], times[-1], 20)
    at = np.concatenate([times, inside])
    path = motion.interpolate(times, rotation, translation, at)
    slerp = Slerp(times, Rotation.from_matrix(rotation))
    np.testing.assert_allclose(path.rotation, slerp(at).as_matrix(), atol=1e-11)
    want = np.stack([np.interp(at, times, column) for column in translation.T], axis=-1)
    np.testing.assert_allclose(path.translation, want, atol=1e-12)
    ends = motion.interpolate(times, rotation, translation, times[[0, -1]] + [-5, 5])
    np.testing.assert_allclose(ends.rotation, rotation[[0, -1]], atol=1e-12)
    np.testing.assert_allclose(ends.translation, translation[[0, -1]], atol=1e-12)


@PROPERTY
@given(SEEDS, st.floats(0.05, 0.3))
def test_recorded_track_is_driven_through_its_resampled_poses(seed, dt):
    times, rotation, translation = track(seed)
    path = motion.simulate(motion.recorded(times, rotation, translation, dt), dt, STILL)
    at = times[0] + dt * np.arange(path.translation.shape[0])
    assert at[-1] <= times[-1] + 1e-6 < at[-1] + dt + 2e-6
    slerp = Slerp(times, Rotation.from_matrix(rotation))
    at = np.minimum(at, times[-1])
    np.testing.assert_allclose(path.rotation, slerp(at).as_matrix(), atol=1e-9)
    want = np.stack([np.interp(at, times, column) for column in translation.T], axis=-1)
    np.testing.assert_allclose(path.translation, want, atol=1e-9)


# --- errors -----------------------------------------------------------------------------------

I, O, RNG = np.eye(3), np.zeros(3), np.random.default_rng(0)  # noqa: E741
TIMES = [0.0, 1.0, 2.0]
BAD_CALLS: dict[str, tuple[Any, tuple[Any, ...], str]] = {
    "steps zero": (motion.constant_twist, (I, O, TWIST, 0), "steps must be an int from 1 to"),
    "steps half": (motion.constant_twist, (I, O, TWIST, 2.5), "steps must be an int from 1 to"),
    "steps nan": (motion.constant_twist, (I, O, TWIST, np.nan), "steps must be an int from 1 to"),
    "no step": (
        motion.simulate,
        (motion.constant_twist(I, O, TWIST, 3), 0.0, motion.ProcessNoise(0.1)),
        "dt must be a finite number",
    ),
    "twist shape": (motion.constant_twist, (I, O, O, 3), "twist must have shape (..., 6), got"),
    "not a rotation": (motion.constant_twist, (2 * I, O, TWIST, 3), "rotation must be orthogonal"),
    "one point": (motion.waypoints, (I, [O], 1, 1, 5), "points must hold at least 2 way-points"),
    "point nan": (motion.waypoints, (I, I * np.nan, 1, 1, 5), "points must be finite"),
    "speed": (
        motion.waypoints,
        (I, I, -1, 1, 5),
        "speed_m_s must be a finite number of at least 0",
    ),
    "dt": (motion.waypoints, (I, I, 1, 0, 5), "dt must be a finite number"),
    "spin": (motion.waypoints, (I, I, 1, 1, 5, 0.1), "spin_rad_s must have shape (..., 3), got ()"),
    "spacing": (motion.lawn_mower_points, (O, O + 1, 0), "spacing_m must be a finite number"),
    "corner": (motion.lawn_mower_points, (O, [1, 1], 1), "high must have shape (..., 3), got (2,)"),
    "upside down": (motion.lawn_mower_points, (O + 1, O, 1), "low must"),
    "radius": (motion.orbit, (O, 0, 1, 1, 5), "radius_m must be a finite number"),
    "phase nan": (motion.orbit, (O, 1, 1, 1, 5, np.nan), "phase must be finite"),
    "times": (motion.recorded, ([0, 1, 1], [I] * 3, [O] * 3, 1), "two or more and increase"),
    "one time": (motion.recorded, ([0], [I], [O], 1), "two or more and increase"),
    "short": (motion.recorded, (TIMES, [I] * 3, [O] * 3, 5), "times must span at least one step"),
    "few turns": (motion.recorded, (TIMES, [I] * 2, [O] * 3, 0.5), "rotation must have shape"),
    "many turns": (motion.recorded, (TIMES, [I] * 4, [O] * 3, 0.5), "rotation must have shape"),
    "many places": (motion.recorded, (TIMES, [I] * 3, [O] * 4, 0.5), "translation must have shape"),
}


@pytest.mark.parametrize("case", BAD_CALLS)
def test_bad_call_is_refused(case):
    function, arguments, message = BAD_CALLS[case]
    with pytest.raises(ValueError, match=re.escape(message)):
        function(*arguments)


def test_numbers_of_steps_are_whole():
    assert motion.orbit(np.zeros(3), 1.0, 1.0, 0.1, np.int64(5)).twists.shape == (5, 6)  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ValueError, match=r"steps must be an int from 1 to .*, got 5\.0"):
        motion.orbit(np.zeros(3), 1.0, 1.0, 0.1, 5.0)  # pyrefly: ignore[bad-argument-type]

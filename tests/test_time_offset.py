"""Clock offsets from signals and from motion: values and standard deviations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from rbl_gym import motion
from rbl_gym.geometry import rotations
from rbl_gym.recordings import TimeOffset, motion_offset, read_truth, time_offset

DATA = Path(__file__).parents[2] / "shared" / "data" / "starloc_two_tags"


def pair(seed, offset_s, *, std=(0.3, 0.3), step_s=(0.02, 0.03), correlated_s=0.0, columns=1,
         duration_s=40.0):  # fmt: skip
    """Times and values of one random signal by two clocks, with noise of either."""
    rng = np.random.default_rng(seed)
    fine = 0.005
    true = rng.standard_normal((int((duration_s + 20) / fine), columns))
    true = gaussian_filter1d(true, 0.4 / fine, axis=0)
    true /= true.std(axis=0)
    when = -10 + fine * np.arange(len(true))
    signals = []
    for late, noise, step in zip((0.0, offset_s), std, step_s, strict=True):
        times = np.arange(0, duration_s, step)
        times = times + rng.uniform(-0.3, 0.3, times.shape) * step
        error = rng.standard_normal((len(times), columns))
        if correlated_s:
            error = gaussian_filter1d(error, correlated_s / step, axis=0)
            error /= error.std()
        values = np.stack([np.interp(times, when, column) for column in true.T], axis=-1)
        signals += [times + late, values + noise * error]
    return signals


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"std": (1.0, 1.0)},
        {"std": (0.0, 0.3)},
        {"correlated_s": 0.2},
        {"columns": 3},
        {"step_s": (0.2, 0.01), "std": (0.1, 0.1)},
    ],
    ids=str,
)
def test_offsets_are_as_certain_as_they_say(options):
    offsets = np.random.default_rng(1).uniform(-3, 3, 30)
    scores = []
    for seed, offset in enumerate(offsets):
        found = time_offset(*pair(seed, offset, **options), search_s=5)
        scores.append((found.offset_s - offset) / found.std_s)
    # A mean square of 30 normal scores has a standard deviation of 0.26: within three of them,
    # and a tenth for the standard deviations, which are of 24 parts.
    assert 0.35 < np.mean(np.square(scores)) < 1.9
    # Of 30 scores with 23 degrees of freedom none is beyond 4.5 but once in 200 times.
    assert np.abs(scores).max() < 4.5


def test_gains_offsets_and_stamps_since_1970_do_not_matter():
    a, x, b, y = pair(3, 0.7)
    want = time_offset(a, x, b, y, search_s=5)
    found = time_offset(a + 1.7e9, 3 * x - 40, b + 1.7e9, 0.1 * y + 7, search_s=5)
    assert found.offset_s == pytest.approx(want.offset_s, abs=1e-5)
    assert found.std_s == pytest.approx(want.std_s, rel=1e-3)
    far = time_offset(a, x, b + 1.7e9, y)
    assert far.offset_s == pytest.approx(want.offset_s + 1.7e9, abs=1e-5)


def test_the_other_way_round_is_the_other_sign():
    a, x, b, y = pair(4, 1.1)
    there, back = time_offset(a, x, b, y, 5.0), time_offset(b, y, a, x, 5.0)
    assert back.offset_s == pytest.approx(-there.offset_s, abs=0.5 * there.std_s)


def test_a_gap_of_either_is_left_out():
    a, x, b, y = pair(5, 0.4, std=(0.1, 0.1))
    keep = (a < 12) | (a > 16)
    y = np.where((b > 20)[:, None] & (b < 20.8)[:, None], 0.0, y)
    found = time_offset(a[keep], x[keep], b, y, 5.0)
    assert as_told(found, 0.4)
    assert found.std_s < 0.02


def test_what_tells_no_offset_is_refused():
    a, x, b, y = pair(6, 0.4)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="do not agree at any offset"):
        time_offset(a, rng.standard_normal(len(a)), b, y, 3.0)
    with pytest.raises(ValueError, match=r"do not agree|do not change"):
        time_offset(a, np.ones(len(a)), b, y, 3.0)
    with pytest.raises(ValueError, match="overlap too little"):
        time_offset(a, x, b + 100, y, 3.0)
    with pytest.raises(ValueError, match="agree as well at an offset"):
        time_offset(a, np.sin(2 * a), b, np.sin(2 * (b - 0.4)), 8.0)
    with pytest.raises(ValueError, match="times_a must increase"):
        time_offset(a[::-1], x, b, y)
    with pytest.raises(ValueError, match="the same number of columns"):
        time_offset(a, x, b, np.tile(y, 2))
    with pytest.raises(ValueError, match="values_b"):
        time_offset(a, x, b, y[:-1])


def as_told(found: TimeOffset, offset_s: float) -> bool:
    return abs(found.offset_s - offset_s) < 4 * found.std_s


def track(times, late_s, seed=0, std=0.03):
    """Poses at these stamps of a clock that is late, with noise."""
    rng = np.random.default_rng(seed)
    t = times - late_s
    turn = np.stack([0.3 * np.sin(0.7 * t), 0.2 * np.cos(t), 0.4 * t + np.sin(0.31 * t)], axis=-1)
    place = np.stack(
        [2 * np.sin(0.5 * t) + 0.1 * t, 1.5 * np.sin(0.83 * t), 0.4 * np.cos(1.1 * t)], axis=-1
    )
    noise = std * rng.standard_normal((2, *place.shape))
    return times, rotations.exp(noise[0]) @ rotations.exp(turn), place + noise[1]


TURN = rotations.exp([0.4, -1.0, 2.0])


@pytest.mark.parametrize("place_only", [False, True])
@pytest.mark.parametrize("one_frame", [False, True])
@pytest.mark.parametrize("planar", [False, True])
def test_the_motion_of_a_body_tells_the_offset(place_only, one_frame, planar):
    a = track(np.arange(0, 30, 0.1), 0.0)
    b = track(np.arange(-2, 35, 0.013), 0.37, seed=1, std=0.01)
    if not one_frame:
        R = rotations.exp([0, 0, 2.0]) if planar else TURN
        b = b[0], R @ b[1], b[2] @ R.T + [5, 2, -1]
    if place_only:
        b = b[0], None, b[2]
    found = motion_offset(a, b, 5.0, planar=planar, one_frame=one_frame)
    assert as_told(found, 0.37)
    assert found.std_s < 0.03
    assert found.correlation > 0.9


def test_a_marker_turned_on_the_body_does_not_matter():
    a = track(np.arange(0, 30, 0.1), 0.0)
    b = track(np.arange(0, 30, 0.013), -0.2, seed=1)
    found = motion_offset(a, (b[0], b[1] @ TURN, b[2]))
    assert as_told(found, -0.2)


def test_velocity_and_turn_that_contradict_each_other_widen_the_offset():
    a = track(np.arange(0, 30, 0.05), 0.0)
    b, late = (track(np.arange(0, 30, 0.05), shift, seed=1) for shift in (0.0, 0.6))
    found = motion_offset(a, (b[0], late[1], b[2]), 5.0)
    assert found.std_s > 0.2
    assert -0.1 < found.offset_s < 0.7


def test_motion_that_tells_nothing_is_refused():
    times = np.arange(0, 30, 0.1)
    still = times, np.tile(np.eye(3), (len(times), 1, 1)), np.zeros((len(times), 3))
    with pytest.raises(ValueError, match="the motion does not determine a time offset"):
        motion_offset(track(times, 0.0), still)
    with pytest.raises(ValueError, match="must last"):
        motion_offset(track(times, 0.0), (still[0][:3], still[1][:3], still[2][:3]))


def test_a_gyroscope_against_motion_capture():
    if not DATA.exists():
        pytest.skip("the data sets are not here")
    truth = read_truth(DATA / "truth.csv")
    assert truth.rotation is not None
    imu = np.genfromtxt(DATA / "imu.csv", delimiter=",", skip_header=1)
    twist = motion.twists_between(truth.rotation, truth.translation, np.diff(truth.times))
    when = 0.5 * (truth.times[1:] + truth.times[:-1])
    # The motion capture is wrong for a second.
    good = (when < 6.4) | (when > 7.3)
    speeds = np.linalg.norm(twist[:, :3], axis=-1), np.linalg.norm(imu[:, 1:4], axis=-1)
    found = time_offset(when[good], speeds[0][good], imu[:, 0], speeds[1])
    assert found.offset_s == pytest.approx(1.3919, abs=4 * found.std_s)
    assert found.std_s < 0.002

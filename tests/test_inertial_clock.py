"""The clock offset of an inertial sensor from ranges: known offsets, errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym.app.cli import main
from rbl_gym.estimators.calibration.inertial_clock import (
    InertialClock,
    TaggedRanges,
    inertial_clock,
)
from rbl_gym.estimators.calibration.range_track import range_track
from rbl_gym.geometry import rotations
from rbl_gym.measurements import inertial
from rbl_gym.motion import smooth
from rbl_gym.recordings import InertialLog, Recording, read_frame
from rbl_gym.studies import replay
from tests import recorded

ANCHORS = np.array([[0, 0, 0.3], [8, 0, 2.7], [8, 6, 0.3], [0, 6, 2.7], [4, 0, 2.0], [8, 3, 0.5]])
TAGS = np.array([[0.1, 0.1, 0.0], [0.1, -0.1, 0.0]])
SECONDS, AHEAD_S = 30.0, 3.217


def moving(seed: int, period_s: float | None = None, sway: float = 1.0):
    """A body carried about at random, or round and round; ranges one by one; its sensor."""
    rng = np.random.default_rng(seed)
    # Sums of sines, or one sine.
    rates = (
        rng.uniform(0.4, 6.0, (6, 6)) if period_s is None else np.full((1, 6), 2 * np.pi / period_s)
    )
    phase, size = (
        rng.uniform(0, 6, rates.shape),
        sway * np.array([1.0, 1.0, 0.2]) / rates[:, :3] ** 1.5,
    )

    def pose(t):
        swing = np.sin(rates * t[:, None, None] + phase)
        turn = 0.15 * swing[..., 3:].sum(axis=1) * [0.3, 0.3, 1.0]
        return rotations.exp(turn), np.array([4, 3, 1.2]) + (size * swing[..., :3]).sum(axis=1)

    when = np.arange(0, SECONDS, 0.01)
    moved = smooth.from_function(pose, when)
    force = inertial.specific_force(moved.rotation, moved.acceleration)
    read = inertial.simulate(inertial.sensor("consumer"), moved.turn_rate, force, rng).readings
    times = np.sort(rng.uniform(1.0, SECONDS - 1, 3000))
    anchor, tag = rng.integers(0, 6, 3000), rng.integers(0, 2, 3000)
    Q, p = pose(times)
    places = p + (Q @ TAGS[tag][..., None])[..., 0]
    distance = np.linalg.norm(places - ANCHORS[anchor], axis=1)
    late = np.where(rng.random(3000) < 0.1, rng.exponential(0.5, 3000), 0.0)
    ranges = distance + 0.15 + 0.06 * rng.standard_normal(3000) + late
    std = np.full(3000, 0.1)
    told = TaggedRanges(times, ranges, std, ANCHORS[anchor], TAGS[tag], 2 * anchor + tag)
    return told, when + AHEAD_S, read, places


def test_a_track_by_ranges_alone():
    """Biased by 0.15 m, some of them late by far more: the spline is the path of the tags."""
    told, _, _, places = moving(0)
    arms = np.zeros_like(told.tags)
    path = range_track(told.times, told.ranges, told.anchors - arms, told.std, [4.0, 3, 1])
    assert np.sqrt(np.mean((path(told.times) - places) ** 2)) < 0.12
    with pytest.raises(ValueError, match="times must not decrease"):
        range_track([1.0, 0.0], [1.0, 1.0], np.zeros((2, 3)), [1.0, 1.0], [0.0, 0, 0])


@pytest.mark.parametrize("bodies", [1, pytest.param(4, marks=pytest.mark.long)])
def test_the_offset_is_found_within_what_it_claims(bodies):
    """Errors over claims have a mean square of 1; it is below 1 + 4 deviations."""
    scaled = []
    for seed in range(bodies):
        told, times, readings, _ = moving(seed)
        found = inertial_clock(told, times, readings, [4.0, 3, 1])
        assert isinstance(found, InertialClock)
        assert found.gain > 4
        assert abs(found.rival_s - found.offset_s) > 0.2
        scaled.append((found.offset_s - AHEAD_S) / found.std_s)
        assert abs(found.offset_s - AHEAD_S) < 0.05
    assert np.mean(np.square(scaled)) < 1 + 4 * (2 / bodies) ** 0.5


def test_the_recording_s_clock():
    told, times, readings, _ = moving(1)
    shape = (len(told.times), 6, 2)
    ranges, links = np.zeros(shape), np.zeros(shape, dtype=bool)
    where = (np.arange(len(told.times)), told.links // 2, told.links % 2)
    ranges[where], links[where] = told.ranges, True
    log: Any = Recording(
        told.times, ranges, links, None, ANCHORS, TAGS, tuple("abcdef"), tuple("01"), None,
        inertial=InertialLog(times, readings),
    )  # fmt: skip
    settings = replay.Settings.of(filter="iekf-imu")
    found = replay.sensor_clock(log, settings, "imu_offset_s")
    assert found.offset_s == pytest.approx(AHEAD_S, abs=0.05)
    assert found.correlation is not None
    with pytest.raises(ValueError, match=r"imu_offset_s: .* give a rough offset"):
        replay.sensor_clock(log, settings.changed(imu_offset_s=60.0), "imu_offset_s")
    with pytest.raises(ValueError, match="has none"):
        replay.sensor_clock(log._replace(inertial=None), settings, "imu_offset_s")


def test_what_tells_no_clock_is_refused():
    told, times, readings, _ = moving(2, period_s=1.5)
    with pytest.raises(ValueError, match=r"about as well at .* give the offset"):
        inertial_clock(told, times, readings, [4.0, 3, 1])
    told, times, readings, _ = moving(3, sway=0.0)
    with pytest.raises(ValueError, match=r"at no offset|about as well"):
        inertial_clock(told, times, readings, [4.0, 3, 1])
    with pytest.raises(ValueError, match="must overlap for 10 s without a gap"):
        inertial_clock(told, times[:500], readings[:500], [4.0, 3, 1])


def test_axes_and_clock_of_an_imu_on_the_command_line(tmp_path, capsys):
    """`calibrate` writes the axes that `replay` reads; it needs a truth, and finds them itself."""
    rng = np.random.default_rng(5)
    when = np.arange(0, SECONDS, 0.01)
    turn = rotations.exp([1.0, 0.5, -0.7])
    phases = rng.uniform(0, 6, (4, 6))
    rates = rng.uniform(0.5, 3.0, (4, 6))

    def pose(t):
        swing = np.sin(rates * t[:, None, None] + phases).sum(axis=1)
        return rotations.exp(0.3 * swing[:, 3:]), np.array([4, 3, 1.2]) + 0.4 * swing[:, :3]

    moved = smooth.from_function(pose, when)
    force = inertial.specific_force(moved.rotation, moved.acceleration)
    body = inertial.simulate(inertial.sensor("consumer"), moved.turn_rate, force, rng).readings
    read = inertial.turned(body, turn.T)
    times = np.arange(1.0, SECONDS - 1, 0.02)
    Q, p = pose(times)
    ends = p[:, None] + np.einsum("kij,nj->kni", Q, TAGS)

    anchor, tag = rng.integers(0, 6, len(times)), rng.integers(0, 2, len(times))
    distance = np.linalg.norm(ends[np.arange(len(times)), tag] - ANCHORS[anchor], axis=1)
    ranges = np.full((len(times), 6, 2), np.nan)
    ranges[np.arange(len(times)), anchor, tag] = distance + 0.02 * rng.standard_normal(len(times))
    files = recorded.files(tmp_path, ANCHORS, TAGS, times, ranges, (Q, p))
    rows = np.column_stack([when[: len(read)] + 0.7, read])
    files["imu"] = recorded.table(tmp_path / "imu.csv", "t,wx,wy,wz,ax,ay,az", rows)
    told = [f"--{name}={path}" for name, path in files.items()]
    out = tmp_path / "out"
    assert main(["calibrate", *told, f"--out={out}", "--arms=held"]) == 0
    assert "--imu-frame" in capsys.readouterr().out
    off = rotations.log(read_frame(out / "imu_frame.csv") @ turn.T)
    assert np.degrees(np.linalg.norm(off)) < 0.5
    assert main(["calibrate", *told, "--imu-frame=1,2,3"]) == 2
    assert "leave out --imu-frame" in capsys.readouterr().err
    assert main(["calibrate", *[x for x in told if "truth" not in x]]) == 2
    assert "--imu needs --truth" in capsys.readouterr().err

"""The inertial filter on the log of a rig with two tags and an inertial sensor (STAR-loc)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import estimators, metrics, motion
from rbl_gym.geometry import rotations
from rbl_gym.measurements import inertial, ranging
from rbl_gym.motion import navigation
from rbl_gym.recordings import (
    Files,
    Format,
    read_inertial,
    read_recording,
    samples_between,
    truth_at,
)
from tests.helpers import ROOT

STARLOC = ROOT.parent / "shared" / "data" / "starloc_two_tags"
SENSOR = inertial.InertialSensor(
    rate_hz=200, gyro_noise=0.003, accel_noise=0.11, gyro_walk=1e-4, accel_walk=2e-3,
    gyro_bias_rad_s=0.01, accel_bias_m_s2=0.06,
)  # fmt: skip
# The sensor's clock is ahead; its axes by a rotation vector in degrees.
AHEAD_S, AXES_DEG = 1.3919, (179.0, 0.2, 13.6)
SECONDS = 12.0
# Where the truth swings and neither gyroscope nor ranges do.
WRONG_TRUTH = (6.4, 7.3)


def tracked(column, yaw_off_rad, headings):
    """Times, errors (K, 6) and NEES / 6 of the filter from a start 0.3 m off."""
    log: Any = read_recording(
        Files(
            STARLOC / "uwb.csv",
            STARLOC / "anchors.csv",
            STARLOC / "tags.csv",
            STARLOC / "truth.csv",
        ),
        format=Format(columns={"range": column}),
    )
    sensed = read_inertial(STARLOC / "imu.csv")
    axes = rotations.exp(np.deg2rad(AXES_DEG))
    sensed = sensed._replace(
        times=sensed.times - AHEAD_S, readings=inertial.turned(sensed.readings, axes)
    )
    filter: Any = estimators.make(
        "iekf-imu", tags=log.tags, noise=ranging.RangeNoise(0.1), process=motion.ProcessNoise(),
        robust="late", inertial=SENSOR, gravity_tilt_rad=np.deg2rad(1), common_std_m=0.073,
        drift_std_m=0.05, drift_time_s=20.0, headings=headings,
    )  # fmt: skip
    chosen = np.flatnonzero((log.times > sensed.times[0] + 0.3) & (log.times < SECONDS))
    times = log.times[chosen]
    Q, t, _ = truth_at(log.truth, times)
    assert Q is not None
    level, spread = navigation.attitude(
        samples_between(sensed, times[0] - 0.25, times[0])[0], SENSOR
    )
    yaw = rotations.yaw(Q[0]) - rotations.yaw(level) + yaw_off_rad
    if headings == 1:
        spread[2, 2] = np.deg2rad(20) ** 2
    spread[:2, :2] = np.maximum(spread[:2, :2], np.deg2rad(3) ** 2 * np.eye(2))
    covariance = np.diag([0, 0, 0, 0.09, 0.09, 0.09])
    covariance[:3, :3] = spread
    start = rotations.exp([0, 0, yaw]) @ level, t[0] + [0.2, -0.2, 0.1], covariance
    state, beliefs = filter.initial(*start), []
    for i, k in enumerate(chosen):
        if i:
            readings, steps = samples_between(sensed, times[i - 1], times[i])
            state = filter.predict(state, readings, steps)
        links = log.links[k]
        noise = ranging.LinkNoise(np.where(links, 0.5 * log.range_std[k], 1.0))
        state = filter.update(state, log.ranges[k], log.anchors, links, noise)
        beliefs.append(filter.belief(state))
    rotation, translation, P, _ = (np.array(column) for column in zip(*beliefs, strict=True))
    error = metrics.pose_error(rotation, translation, Q, t)
    return times, error, metrics.nees(error, P) / 6


@pytest.mark.skipif(not STARLOC.is_dir(), reason="the STAR-loc recording is not on this machine")
@pytest.mark.parametrize(
    ("column", "yaw_off_rad", "headings"),
    [
        ("range_calib", 0.4, 1),
        ("range", -0.4, 1),
        pytest.param("range", 2.5, 12, marks=pytest.mark.long),
    ],
)
def test_a_rig_with_two_tags_is_tracked(column, yaw_off_rad, headings):
    """Raw ranges carry a common bias of 0.2 m; ranges alone give the axis of the tags only."""
    times, error, nees = tracked(column, yaw_off_rad, headings)
    clean = (times < WRONG_TRUTH[0]) | (times > WRONG_TRUTH[1])
    late = clean & (times > 4)
    position = np.sqrt((error[clean, 3:] ** 2).sum(axis=1).mean())
    angle = np.rad2deg(np.sqrt((error[late, :3] ** 2).sum(axis=1).mean()))
    assert position < 0.12
    assert angle < 5
    assert 0.3 < nees[clean].mean() < 2.5

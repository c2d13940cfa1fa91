"""Recordings through the smoother."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rbl_gym import recordings
from rbl_gym.app.cli import main
from rbl_gym.geometry import bodies
from rbl_gym.recordings import Recording, Truth
from rbl_gym.studies import replay
from rbl_gym.studies.replay.figures import wide_note
from tests import recorded
from tests.helpers import with_kernels
from tests.recorded import ROOM, flight, swaying

REAL = Path(__file__).parents[2] / "shared" / "data"
LIAS, LABYRINTH = REAL / "lias_planar", REAL / "labyrinth_single_tag"
TAGS = bodies.octahedron(0.8)
SMOOTH = replay.Settings.of(
    walk_m=0.4,
    walk_deg=20.0,
    range_std_m=0.05,
    smooth=True,
    smooth_accel_m=0.3,
    smooth_bias_std_m=0.02,
)


@with_kernels
def test_smoothed_is_nearer_than_causal_and_honest():
    replayed = replay.replay_recording(flight(TAGS, biases=0.05), SMOOTH)
    smoothed = replayed.figures["smoothed"]
    assert isinstance(replayed.smoothed, replay.SmoothedRecording)
    assert smoothed["converged"]
    for name in ("position_rmse_m", "rotation_rmse_deg"):
        assert smoothed[name] < 0.8 * replayed.figures[name]
    # One draw of biases that stay: their law is wider than they are.
    assert 0.1 < smoothed["anees"] < 2
    found = np.array(smoothed["mean_bias_m"])
    np.testing.assert_allclose(found, replayed.smoothed.found.biases.mean(axis=0))
    assert (
        "smoothed"
        not in replay.replay_recording(flight(TAGS), SMOOTH.changed(smooth=False)).figures
    )


def test_a_covariance_wider_than_the_errors_names_the_assumed_errors():
    """Biases that a log does not have; none if the log is as assumed."""
    log = flight(TAGS)
    good = {"smooth_constant_m": 0.0, "smooth_common_m": 0.0, "smooth_bias_std_m": 0.0}
    for changed, wide in (({}, True), ({**good, "robust": False}, False)):
        figures = replay.replay_recording(log, SMOOTH.changed(**changed)).figures
        assert (figures["smoothed"]["anees"] < 0.4) == wide
        notes = [note for note in figures["notes"] if "smoothed track is too large" in note]
        assert len(notes) == wide
        assert not wide or "0.05 m, and biases of 0.1 m (each link), 0.2 m (common)" in notes[0]
    replayed = replay.replay_recording(log._replace(truth=None), SMOOTH.changed(range_std_m=0.15))
    (note,) = [n for n in replayed.figures["notes"] if "smoothed track" in n]
    assert f"NIS {replayed.figures['smoothed']['nis']:.2f}" in note


def test_a_small_nis_is_no_wide_covariance_if_the_errors_are_larger():
    settings = SMOOTH.flat()
    (wide,) = wide_note({"nis": 0.45, "anees": 0.3}, settings)
    assert "too large" in wide
    assert wide_note({"nis": 0.45, "anees": 1.0}, settings) == []
    (narrow,) = wide_note({"nis": 0.45, "anees": 4.78}, settings)
    assert "too small (NEES per degree of freedom 4.78" in narrow
    assert "an anchor or a tag at a wrong position" in narrow
    assert "too large" not in narrow


@with_kernels
def test_moving_anchors_and_coordinates_of_a_map():
    near = replay.replay_recording(flight(TAGS, swaying), SMOOTH)
    assert near.figures["smoothed"]["position_rmse_m"] < 0.05
    far = replay.replay_recording(flight(TAGS, swaying, shift=4e5), SMOOTH)
    assert near.smoothed is not None
    assert far.smoothed is not None
    np.testing.assert_allclose(
        far.smoothed.track.translation - 4e5, near.smoothed.track.translation, atol=1e-4
    )


@with_kernels
def test_a_start_that_lost_its_way_is_replaced():
    log, settings = flight(TAGS), SMOOTH
    track = replay.track_recording(log, settings)
    good = replay.smooth_recording(log, settings, track)
    # Behind the wall, upside down.
    turned = track.rotation @ np.diag([1.0, -1.0, -1.0])
    lost = track._replace(rotation=turned, translation=track.translation + [0, -30.0, 0])
    found = replay.smooth_recording(log, settings, lost)
    np.testing.assert_allclose(found.found.cost, good.found.cost, rtol=1e-6)
    np.testing.assert_allclose(found.track.translation, good.track.translation, atol=1e-3)


def test_what_does_not_fit_into_memory_is_refused():
    log = flight(TAGS, count=40)
    track = replay.track_recording(log, SMOOTH)
    long = log._replace(
        times=np.arange(400000.0),
        ranges=np.broadcast_to(log.ranges[0], (400000, 6, 6)),
        links=np.broadcast_to(True, (400000, 6, 6)),
    )
    with pytest.raises(ValueError, match="smooth_bias_std_m"):
        replay.smooth_recording(long, SMOOTH, track)


@pytest.mark.parametrize(
    "options", [{"smooth_accel_m": -1.0}, {"smooth_bias_time_s": 0.0}, {"smooth_common_m": np.nan}]
)
def test_laws_that_cannot_be_are_named(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        replay.Smoothing(**options)


@with_kernels
@pytest.mark.usefixtures("no_search_for_causes")
def test_soft_knowledge_and_the_loss_for_late_ranges():
    log = flight(TAGS, count=30)
    log = log._replace(
        ranges=log.ranges + 2.0 * (np.random.default_rng(3).random(log.ranges.shape) < 0.1)
    )
    settings = SMOOTH.changed(height_m=1.2, height_std_m=0.3, tilt_std_deg=5.0)
    figures = [
        replay.replay_recording(log, settings.changed(robust=robust)).figures["smoothed"]
        for robust in (False, "late")
    ]
    assert figures[1]["position_rmse_m"] < 0.5 * figures[0]["position_rmse_m"]
    assert figures[1]["position_rmse_m"] < 0.06


def test_the_command_prints_both_tracks(tmp_path, capsys):
    log = flight(TAGS, count=20)
    files = recorded.files(tmp_path, ROOM, TAGS, log.times, log.ranges)
    command = ["replay", *recorded.options(files)]
    assert main([*command, "--smooth", "--smooth-accel-m", "0.3", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["settings"]["smooth_accel_m"] == 0.3
    assert result["smoothed"]["nis"] < 1
    picture = tmp_path / "track.png"
    assert main([*command, "--smooth", "--plot", str(picture)]) == 0
    assert "smoothed" in capsys.readouterr().out
    assert picture.stat().st_size > 10_000


@pytest.mark.skipif(not LABYRINTH.is_dir(), reason=f"the recording is not at {LABYRINTH}")
def test_one_tag_and_one_range_at_a_time_of_a_real_robot():
    """At most 0.10 m from ranges alone, without a calibration."""
    data = np.genfromtxt(LABYRINTH / "ranges.csv", delimiter=",", names=True)
    place = np.genfromtxt(LABYRINTH / "truth.csv", delimiter=",", names=True)
    ids, first, link = np.unique(data["anchor"], return_index=True, return_inverse=True)
    K = len(data)
    anchors = np.zeros((len(ids), 3))
    anchors[:, 0], anchors[:, 1] = data["anchor_x"][first], data["anchor_y"][first]
    ranges = np.zeros((K, len(ids), 1))
    ranges[np.arange(K), link, 0] = data["range"]
    true = np.column_stack([place["x"], place["y"], np.zeros(len(place))])
    truth = Truth(place["t"], np.tile(np.eye(3), (len(place), 1, 1)), true)
    names = tuple(str(int(i)) for i in ids)
    log = Recording(
        data["t"], ranges, ranges > 0, None, anchors, np.zeros((1, 3)), names, ("0",), truth
    )
    figures = replay.replay_recording(
        log, replay.Settings.of(filter="iekf", planar=True, smooth=True)
    ).figures
    assert figures["smoothed"]["position_rmse_m"] <= 0.10
    assert figures["smoothed"]["position_rmse_m"] < 0.5 * figures["position_rmse_m"]


@pytest.mark.long
@pytest.mark.skipif(not LIAS.is_dir(), reason=f"the recording is not at {LIAS}")
@pytest.mark.parametrize(
    ("calibration", "limits"),
    [(LIAS / "calibration_8_14.csv", (0.028, 3.35)), (None, (0.042, 4.2))],
    ids=["calibrated", "raw"],
)
def test_a_real_planar_recording(calibration, limits):
    log = recordings.read_recording(
        recordings.Files(
            LIAS / "dynamic_fast_ranges.csv",
            LIAS / "anchors_8_14.csv",
            LIAS / "tags_8_14.csv",
            LIAS / "dynamic_fast_truth.csv",
            calibration,
        )
    )
    settings = replay.Settings.of(
        planar=True, height_offset_m=0.08, yaw_offset_deg=7.0, smooth=True
    )
    figures = replay.replay_recording(log, settings).figures["smoothed"]
    assert figures["position_rmse_m"] <= limits[0]
    assert figures["yaw_rmse_deg"] <= limits[1]
    assert 0.5 < figures["anees"] < 2.5

"""Replay of bodies with one or two tags, a start, soft knowledge; notes on unknown directions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.recordings import Files, Truth, read_recording
from rbl_gym.studies import replay
from rbl_gym.studies.replay import study
from rbl_gym.studies.replay.centre import about_origin
from rbl_gym.studies.replay.observed import Observed, observed
from rbl_gym.studies.replay.place import start_of
from tests import recorded
from tests.helpers import ROOT

ANCHORS = np.array([[0.0, 0, 0], [6, 0, 3], [6, 5, 0], [0, 5, 3], [3, 0, 3], [3, 5, 0.5]])


def record(tags, epochs=60, one_by_one=False, height=1.0, anchors=ANCHORS, seed=0):
    """A body on a circle that turns as it goes, level; 10 epochs a second."""
    rng = np.random.default_rng(seed)
    times = 0.1 * np.arange(epochs)
    angle = 0.4 * times
    place = np.stack([3 + np.cos(angle), 2.5 + np.sin(angle), height + 0 * angle], axis=-1)
    turn = rotations.exp(np.stack([0 * angle, 0 * angle, angle + np.pi / 2], axis=-1))
    exact = ranging.distances(anchors, ranging.tag_positions(turn, place, tags))
    ranges = exact + 0.05 * rng.standard_normal(exact.shape)
    links = np.ones(exact.shape, dtype=bool)
    if one_by_one:
        links = np.arange(links[0].size) == rng.integers(links[0].size, size=(epochs, 1))
        links = links.reshape(exact.shape)
    truth = Truth(times, turn, place)
    return recorded.recording(times, ranges * links, anchors, tags, truth)


def outcome(recording, **options):
    settings = replay.Settings.of(**{"filter": "iekf-log", "range_std_m": 0.05, **options})
    return replay.replay_recording(recording, settings)


def test_one_tag_gives_a_place_and_says_so():
    found = outcome(record(np.zeros((1, 3)))).figures
    assert found["position_rmse_m"] < 0.2
    assert (found["known_directions"], found["known_directions_since_s"]) == (3, 0.0)
    assert found["centre_rmse_m"] == pytest.approx(found["position_rmse_m"])
    assert "axis_rmse_deg" not in found
    (note,) = [note for note in found["notes"] if "do not determine" in note]
    assert note.startswith("Note: the ranges do not determine the rotation (since the start)")
    assert found["settings"]["robust"] == "late"


def test_an_origin_far_from_the_line_of_the_tags_is_a_warning():
    """Half a metre around the unknown axis is no Gaussian error; level bodies have none of it."""
    recording = record(np.array([[0.0, 0.4, 0.5], [0.0, -0.4, 0.5]]))
    figures = outcome(recording).figures
    (note,) = [one for one in figures["notes"] if "do not determine" in one]
    assert len(figures["undetermined"]) == 1
    assert figures["undetermined"][0].startswith("the rotation about the body's axis (")
    assert note.startswith("WARNING: ")
    assert "0.50 m away from the tags" in note
    assert "--tilt-std-deg" in note
    found = outcome(recording, tilt_std_deg=3.0).figures
    assert not any("do not determine" in one for one in found["notes"])
    assert found["undetermined"] == []
    assert found["position_rmse_m"] < 0.2


@pytest.mark.parametrize("filter", ["iekf", "iekf-log"])
@pytest.mark.parametrize("tags", [[[0.3, 0.0, 0.2]], [[0.3, 0.2, 0.1], [-0.3, 0.2, 0.1]]])
def test_no_information_is_made_up_about_a_rotation_that_the_ranges_leave_open(tags, filter):
    tags = np.array(tags)
    result = outcome(record(tags), filter=filter, walk_m=0.3, smooth=True)
    assert result.smoothed is not None
    for track, figures in (
        (result.track, result.figures),
        (result.smoothed.track, result.figures["smoothed"]),
    ):
        assert figures["anees"] < 2
        assert figures["centre_rmse_m"] < 0.25
        spread = np.sqrt(np.linalg.eigvalsh(track.covariance[:, :3, :3])[:, -1])
        assert spread[5:].min() > 1.5
        assert np.linalg.eigvalsh(track.covariance)[:, 0].min() > 0
    with_start = outcome(record(tags), filter=filter, walk_m=0.3, start=(4.0, 2.5, 1.0))
    assert with_start.figures["anees"] < 2


@pytest.mark.parametrize("std", [0.05, 0.8, 3.0])
def test_moments_of_an_origin_away_from_the_centre_of_the_tags(std):
    """About one axis they are those of Gaussian angles; 5 standard deviations of the samples."""
    rng = np.random.default_rng(3)
    Q, centre = rotations.exp([0.3, -0.2, 0.5]), np.array([0.3, -0.1, 0.2])
    axis = rotations.exp([0.4, 0.1, -0.3])[2]
    P = 1e-8 * np.eye(6)
    P[:3, :3] += std**2 * np.outer(axis, axis)
    P[3:, 3:] += np.diag([0.1, 0.2, 0.3]) ** 2
    poses = replay.Track(np.zeros(1), Q[None], np.ones((1, 3)), P[None])
    moved = about_origin(poses, centre)
    np.testing.assert_allclose(moved.translation[0], 1 - Q @ centre)
    angle = std * rng.standard_normal(200_000)
    w = angle[:, None] * axis
    off = rng.standard_normal((len(w), 3)) * [0.1, 0.2, 0.3]
    off = off + rotations.exp(w) @ (-Q @ centre) + Q @ centre
    samples = np.concatenate([w, off], axis=1)
    products = samples[:, :, None] * samples[:, None]
    error = products.std(axis=0) / np.sqrt(len(w))
    assert (np.abs(products.mean(axis=0) - moved.covariance[0]) < 5 * error + 1e-6).all()


def test_two_tags_give_their_line():
    tags = np.array([[0.0, 0.4, 0.1], [0.0, -0.4, 0.1]])
    result = outcome(record(tags))
    found = result.figures
    assert found["known_directions"] == 5
    assert found["axis_rmse_deg"] < 15
    assert found["centre_rmse_m"] < 0.2
    (note,) = [note for note in found["notes"] if "do not determine" in note]
    assert "the rotation about the body's axis (" in note
    axis = [float(x) for x in note.split("(")[1].split(")")[0].split(",")]
    np.testing.assert_allclose(axis, [0, 1, 0], atol=0.1)
    held = observed(result.track, tags)
    assert isinstance(held, Observed)
    assert held.turns[-1] == 2
    assert held.places[-1] == 3
    # Planar, they give the heading.
    planar = outcome(record(tags), planar=True, height_m=1.0).figures
    assert planar["known_directions"] == 6
    assert planar["yaw_rmse_deg"] < 12


def test_ranges_one_by_one_from_a_start():
    recording = record(np.zeros((1, 3)), 300, one_by_one=True)
    found = outcome(recording, start=(3.8, 2.6, 1.3), prior_position_m=0.5).figures
    assert found["position_rmse_m"] < 0.25
    assert found["links"] == 300


def test_soft_knowledge_of_height_and_tilt_stands_for_a_plane():
    """Anchors and tags in planes: without it height and tilt wander."""
    anchors, tags = ANCHORS.copy(), np.array([[0.4, 0, 0], [-0.3, 0.4, 0], [-0.3, -0.4, 0]])
    anchors[:, 2] = 1.5
    recording = record(tags, anchors=anchors)
    found = outcome(recording, height_m=1.0, height_std_m=0.1, tilt_std_deg=2.0).figures
    assert found["position_rmse_m"] < 0.25
    assert found["yaw_rmse_deg"] < 10
    assert 0.1 < found["anees"] < 2
    assert "mirror" not in found


def test_a_start_is_the_prior():
    recording = record(np.zeros((1, 3)))
    told = {"start": (1, 2, 0.5, 90), "prior_position_m": 0.2, "prior_rotation_deg": 10}
    rotation, place, P = start_of(recording, replay.Settings.of(**told))
    np.testing.assert_allclose(rotation, rotations.exp(np.array([0, 0, np.pi / 2])), atol=1e-12)
    np.testing.assert_allclose(place, [1, 2, 0.5])
    np.testing.assert_allclose(np.sqrt(np.diag(P)), [np.deg2rad(10)] * 3 + [0.2] * 3)
    free = np.sqrt(np.diag(start_of(recording, replay.Settings.of(start=(1, 2, 0.5)))[2]))
    np.testing.assert_allclose(free, [np.pi] * 3 + [0.5] * 3)
    soft = {"height_m": 0.4, "height_std_m": 0.1, "tilt_std_deg": 3}
    _, place, P = start_of(recording, replay.Settings.of(**soft))
    assert place[2] == 0.4
    np.testing.assert_allclose(np.sqrt(np.diag(P))[[0, 1, 5]], [*[np.deg2rad(3)] * 2, 0.1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": (1, 2)}, "start must be x, y, z and optionally yaw_deg, got 2 numbers"),
        ({"prior_position_m": 1.0}, "prior_position_m needs start"),
        ({"height_m": 1.0}, "height_m needs height_std_m, its standard deviation; or set planar"),
        ({"height_std_m": 1.0}, "height_std_m needs height_m"),
        ({"planar": True, "tilt_std_deg": 1.0}, "must be left out with planar, where height"),
        (
            {"planar": True, "height_m": 1.0, "height_offset_m": 0.3},
            "height_m and height_offset_m must not both be given",
        ),
        ({"drift_time_s": 0.0}, "drift_time_s"),
    ],
)
def test_what_contradicts_itself_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        replay.Settings.of(**options)


@pytest.mark.parametrize(("nees", "shown"), [(0.3, True), (1.01, False)])
def test_noise_is_not_called_too_large_if_the_errors_are_as_large(monkeypatch, nees, shown):
    """A NIS below 0.7 with a NEES near 1: the covariance of the track is right."""
    log = ROOT / "examples" / "log"
    names = ("ranges", "anchors", "tags", "truth")
    given: dict[str, Any] = {name: log / f"{name}.csv" for name in names}
    files = Files(**given)
    figures = study.track_figures
    monkeypatch.setattr(study, "track_figures", lambda *given: {**figures(*given), "anees": nees})
    found = study.replay_recording(read_recording(files), replay.Settings.of())
    assert found.figures["consistency"]["nis_per_dof"] < 0.7
    assert any("assumed noise" in note for note in found.figures["notes"]) == shown

"""Mirror poses of recordings: reported if the ranges allow them, else excluded."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

from rbl_gym import metrics, motion
from rbl_gym.app.cli import main
from rbl_gym.geometry import rotations
from rbl_gym.geometry.mirror import mirror_pose
from rbl_gym.measurements import ranging
from rbl_gym.recordings import Truth
from rbl_gym.studies import replay
from rbl_gym.studies.replay.mirror import other_pose
from rbl_gym.studies.replay.tracking import named_filter
from tests import recorded
from tests.helpers import needs

ROOM = np.array([[0, 0, 0.3], [8, 0, 2.7], [8, 6, 0.3], [0, 6, 2.7], [4, 0, 2], [8, 3, 0.5]])
CEILING = np.array([[0, 0, 2], [0, 3, 2], [4, 3, 2], [4, 0, 2], [1.3, 1, 2], [2.6, 1.5, 2.0]])
WALL = CEILING[:, [2, 0, 1]] - [2, 0, 0]  # in the plane x = 0
FLAT = np.array([[0.2, 0.15, 0], [-0.2, 0.15, 0], [-0.2, -0.15, 0], [0.2, -0.15, 0]])
SOLID = FLAT + [[0, 0, 0.3], [0, 0, 0], [0, 0, 0.2], [0, 0, -0.1]]
OPTIONS: dict[str, Any] = {"walk_m": 0.3, "walk_deg": 20.0, "range_std_m": 0.03}


def record(anchors, tags, seed=0, epochs=25, noise_m=0.03, start=(1.5, 1.2, 0.8)):
    """A body that turns and flies at 0.3 m/s, at 10 Hz, with its truth."""
    rng = np.random.default_rng(seed)
    twist = [0.05, 0, 0.3, 0.25, 0.1, 0.05]
    first = rotations.exp(np.array([0.1, -0.1, 0.5]))
    path = motion.simulate(
        motion.constant_twist(first, list(start), twist, epochs - 1), 0.1, motion.ProcessNoise()
    )
    exact = ranging.distances(anchors, ranging.tag_positions(path.rotation, path.translation, tags))
    ranges = exact + noise_m * rng.standard_normal(exact.shape)
    times = 0.1 * np.arange(epochs)
    truth = Truth(times, path.rotation, path.translation)
    return recorded.recording(times, ranges, anchors, tags, truth)


def outcome(recording, **options):
    settings = replay.Settings.of(**{**OPTIONS, **options})
    track = replay.track_recording(recording, settings)
    found = replay.track_errors(recording, track, settings)
    return track, replay.track_figures(recording, track, found, settings)


@pytest.mark.parametrize("name", ["iekf", "iekf-bank", "iekf-bias"])
@pytest.mark.parametrize("anchors", [CEILING, WALL], ids=["ceiling", "wall"])
def test_a_mirror_pose_is_named_and_the_belief_covers_it(name, anchors):
    """Whichever side the filter is on: the truth is within what its belief expects."""
    recording = record(anchors, FLAT)
    track, result = outcome(recording, filter=name)
    assert result["mirror"]["epochs"] > 20
    (note,) = [note for note in result["notes"] if "--volume" in note]
    assert "inside what --volume" not in note
    assert result["anees"] < 1.5
    height = np.sqrt(track.covariance[10, 3:, 3:].trace())
    assert height > 0.5
    assert recording.truth is not None
    assert track.other is not None
    truth = recording.truth.translation
    nearer = np.minimum(
        *(
            np.linalg.norm(pose - truth, axis=-1)
            for pose in (track.translation, track.other.translation)
        )
    )
    assert np.sqrt((nearer[5:] ** 2).mean()) < 0.1
    # A track on the wrong side is told so; no fault of the truth is made up.
    wrong = result["position_rmse_m"] > 0.5
    assert result["notes"][1:] == ["Note: the truth is at the mirror pose."] * wrong


@pytest.mark.parametrize(("name", "seed"), [("iekf", 0), ("iekf-bank", 1), ("iekf-bias", 2)])
def test_a_volume_tells_the_sides_apart(name, seed):
    recording = record(CEILING, FLAT, seed)
    for options in ({"below_anchors": True}, {"volume": (None, None, None, None, None, 2.0)},
                    {"volume": (0, 4, 0, 3, 0, 1.9)}):  # fmt: skip
        track, result = outcome(recording, filter=name, **options)
        assert "mirror" not in result
        assert result["notes"] == []
        assert result["epochs_outside_volume"] == 0
        assert result["position_rmse_m"] < 0.1
        assert np.sqrt(track.covariance[10, 3:, 3:].trace()) < 0.2
    _, above = outcome(recording, filter=name, volume=(None, None, None, None, 2.1, None))
    assert "mirror" not in above
    assert above["position_rmse_m"] > 2


@pytest.mark.parametrize("name", ["iekf", "iekf-bank"])
@pytest.mark.parametrize(
    ("anchors", "tags"),
    [(ROOM, SOLID), (ROOM, FLAT), (CEILING, SOLID)],
    ids=["room", "room, flat body", "ceiling, solid body"],
)
def test_no_word_where_the_ranges_tell_the_sides_apart(name, anchors, tags):
    for seed in range(3):
        # Under a ceiling a filter that began on the wrong side is told of the better pose.
        _, result = outcome(record(anchors, tags, seed), filter=name)
        wrong = result["position_rmse_m"] > 0.5
        assert ("mirror" in result) == wrong
        assert result["anees"] < 2
        if wrong:
            assert "better" in result["notes"][0]


def test_ranges_decide_by_what_they_leave_not_by_the_deviation_told():
    """Anchors nearly in a plane, ten times too wide a deviation: still no false alarm."""
    lifted = CEILING + np.array([0, 0.3, 0, -0.3, 0, 0.2])[:, None] * [0, 0, 1]
    _, result = outcome(record(lifted, FLAT, noise_m=0.01, epochs=40), range_std_m=0.1)
    assert "mirror" not in result


def test_a_track_that_left_a_wrong_start_is_not_doubted_again():
    """The first pose is excluded, so nothing remains to be covered, wherever the track goes."""
    anchors = CEILING + np.array([0, 0.3, 0, 0.3, 0.1, 0])[:, None] * [0, 0, 1]
    log = record(anchors, SOLID, epochs=60)
    truth: Any = log.truth
    P = np.tile(np.diag([0.05**2] * 6), (60, 1, 1))
    Q, t, _ = mirror_pose(truth.rotation, truth.translation, P, anchors, SOLID)
    right, wrong = (truth.rotation, truth.translation), (Q, t)
    judge = named_filter(log, replay.Settings.of(**OPTIONS), "iekf", {})
    at = [*[1] * 5, *[0] * 35, *[1] * 20]
    track = [np.array([(right, wrong)[a][i][k] for k, a in enumerate(at)]) for i in (0, 1)]
    found = other_pose(log, judge, 0.03, (track[0], track[1], P))
    assert found is not None
    assert found.alive[:5].any()
    assert not found.alive[5:].any()
    past = found._replace(alive=np.arange(60) < 20, log_odds=np.full(60, -np.inf))
    doubted = replay.Track(log.times, *right, P, past)
    notes = replay.track_figures(log, doubted, None, replay.Settings.of(**OPTIONS))["notes"]
    (note,) = [note for note in notes if "mirror" in note]
    assert note.startswith("Note: from 0.0 to 1.9 s after the start, in 20 epochs, a mirror pose")
    assert "up to 3 deg and 0.05 m" in note


def test_one_range_at_a_time():
    """Ranges of a ceiling, each with its own time and deviation; the track is given."""
    whole = record(CEILING, FLAT, epochs=60)
    count = len(whole.times)
    one = np.zeros(whole.ranges.shape, bool)
    one.reshape(count, -1)[np.arange(count), np.arange(count) * 5 % 24] = True
    recording = whole._replace(
        links=one, ranges=whole.ranges * one, range_std=np.where(one, 0.03, 0.0)
    )
    settings = replay.Settings.of(walk_m=0.3, walk_deg=20)
    judge = replay.recording_filter(recording, settings)
    P = np.broadcast_to(1e-3 * np.eye(6), (count, 6, 6))
    assert whole.truth is not None
    poses: Any = (whole.truth.rotation, whole.truth.translation, P)
    other = replay.other_pose(recording, judge, None, poses)
    assert other is not None
    assert other.alive[-10:].all()
    np.testing.assert_allclose(other.translation[-10:, 2] - 2, 2 - poses[1][-10:, 2], atol=0.3)
    room = record(ROOM, FLAT, epochs=60)
    recording = room._replace(links=one, ranges=room.ranges * one, range_std=0.03 * one)
    other = replay.other_pose(recording, judge, None, poses)
    assert other is None or np.isneginf(other.log_odds[-1])


def test_a_mirrored_planar_track_is_held_by_its_height():
    recording = record(CEILING, FLAT)
    assert (
        replay.track_recording(
            recording, replay.Settings.of(planar=True, height_offset_m=1.2)
        ).other
        is None
    )


def test_map_coordinates_give_the_track_of_local_ones():
    shift = np.array([448_262.0, 5_411_932.0, 310.0])
    near = record(CEILING, SOLID)
    assert near.truth is not None
    far = near._replace(
        anchors=near.anchors + shift,
        truth=near.truth._replace(translation=near.truth.translation + shift),
    )
    for name in ("iekf", "iekf-bank"):
        tracks = [
            replay.track_recording(
                recording, replay.Settings.of(**{**OPTIONS, "filter": name, "below_anchors": True})
            )
            for recording in (near, far)
        ]
        np.testing.assert_allclose(tracks[0].rotation, tracks[1].rotation, atol=1e-4)
        gap = tracks[1].translation - shift - tracks[0].translation
        np.testing.assert_allclose(gap, 0, atol=1e-4)


def test_the_note_is_printed(capsys):
    _, result = outcome(record(CEILING, FLAT))
    from rbl_gym.app import reports

    reports.print_replay(json.loads(json.dumps(result)))
    shown = capsys.readouterr().out
    assert "25 of 25 epochs have truth" in shown
    assert "a mirror pose behind the anchors' plane" in shown


@needs("plotly")
def test_the_command_takes_a_volume(tmp_path, capsys):
    recording = record(CEILING, FLAT, epochs=6)
    files = recorded.files(tmp_path, CEILING, FLAT, recording.times, recording.ranges)
    command = ["replay", *recorded.options(files)]
    page = tmp_path / "page.html"
    assert main([*command, "--html", str(page)]) == 0
    assert "a mirror pose behind" in capsys.readouterr().out
    assert "a mirror pose behind" in page.read_text(encoding="utf-8")
    for option in ("--below-anchors", "--volume=-1,5,-1,4,0,2", "--volume=,,,,,2", "--volume=z=:2"):
        assert main([*command, option]) == 0
        assert "mirror" not in capsys.readouterr().out
    assert main([*command, "--volume", "x=-1:5,z=0:9"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "Both are inside what --volume or --below-anchors allows. State where" in shown
    # Both answers, for the user to choose.
    limits = re.findall(r"--volume z=(\S*?)\)", shown)
    assert [limit.count(":") for limit in limits] == [1, 1]
    assert main([*command, f"--volume=z={limits[0]}"]) == 0
    assert "mirror" not in capsys.readouterr().out
    for wrong in ("1,2", "a,b,c,d,e,f", "z=2", "z=1:2,z=3:4", "w=1:2", "z=a:2"):
        with pytest.raises(SystemExit):
            main([*command, f"--volume={wrong}"])
        assert "must be x=MIN:MAX" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*command, "--volume=z=2:1"])
    assert "z must have MIN below MAX" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("volume", "message"),
    [((0, 1, 0, 1), "volume must be xmin, .*, got 4"), ((1, 0, 0, 1, 0, 1), "xmin below xmax"),
     ((0, np.nan, 0, 1, 0, 1), "volume must be")],
)  # fmt: skip
def test_wrong_volumes_are_named(volume, message):
    with pytest.raises(ValueError, match=message):
        replay.Settings.of(volume=volume)


def test_a_volume_out_of_reach_is_named():
    settings = replay.Settings.of(volume=(None, None, None, None, 50, None))
    with pytest.raises(ValueError, match=r"volume must overlap with the space that .* got \[-inf"):
        replay.recording_filter(record(CEILING, FLAT, epochs=2), settings)
    settings = replay.Settings.of(volume=(None, None, None, None, 2.5, None), below_anchors=True)
    with pytest.raises(ValueError, match="volume must have zmin below 2 m"):
        replay.recording_filter(record(CEILING, FLAT, epochs=2), settings)


def test_the_bank_covers_its_rivals():
    """Its covariance is the second moment about the leader of a mixture."""
    recording = record(CEILING, FLAT)
    settings = replay.Settings.of(**OPTIONS, filter="iekf-bank")
    bank: Any = replay.recording_filter(recording, settings)
    states = [step.state for step in replay.recording_steps(recording, settings, bank)]
    state, belief = states[3], bank.belief(states[3])
    share = bank.probabilities(state)
    poses = [(state.rotation, state.translation, state.covariance)]
    poses += zip(state.rival_rotation, state.rival_translation, state.rival_covariance, strict=True)
    expected = 0
    for p, (R, t, P) in zip(share, poses, strict=True):
        e = metrics.pose_error(state.rotation, state.translation, R, t)
        expected = expected + p * (P + np.outer(e, e))
    assert share[1] > 0.1
    np.testing.assert_allclose(belief.covariance, expected, rtol=0.05, atol=1e-3)
    np.testing.assert_array_equal(belief.translation, state.translation)

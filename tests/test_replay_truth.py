"""Truth and track: what is compared, notes if there is little truth, and hints."""

from __future__ import annotations

import re
from functools import partial
from typing import Any

import numpy as np
import pytest

from rbl_gym import recordings
from rbl_gym.app import reports
from rbl_gym.geometry import bodies, rotations
from rbl_gym.recordings import Recording, Truth
from rbl_gym.studies import replay
from rbl_gym.studies.frozen_truth import frozen_spells
from rbl_gym.studies.replay.overlap import check_overlap, stamp_hints
from rbl_gym.studies.replay.truth import Judged, fault_hints, matched
from tests.helpers import with_kernels
from tests.recorded import curve, flight, honest_track


def moving(step_s, duration_s=10.0, start_s=0.0):
    """Times and poses of `curve`."""
    times = np.arange(start_s, duration_s, step_s)
    return times, *curve(times)


def pair(truth, step_s=0.1, seed=0):
    """A recording with this truth and one tag, and an honest track of the curve."""
    return honest_track(truth, np.arange(0, 10, step_s), np.zeros((1, 3)), seed)


def outcome(truth, settings=replay.Settings(), **options):  # noqa: B008
    recording, track = pair(truth, **options)
    return replay.track_figures(
        recording, track, replay.track_errors(recording, track, settings), settings
    )


@pytest.mark.parametrize("step_s", [0.01, 0.1, 0.37])
def test_an_honest_track_has_no_hints(step_s):
    result = outcome(Truth(*moving(step_s)))
    assert result["notes"] == []
    assert result["epochs_with_truth"] >= 97
    assert result["anees"] == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize(("start_s", "count"), [(0.05, 10), (0.0, 10), (0.41, 10)])
def test_truth_at_1_hz_is_compared_at_its_own_poses(start_s, count):
    result = outcome(Truth(*moving(1.0, start_s=start_s)))
    assert result["epochs_with_truth"] == count
    assert result["notes"] == []
    # Halfway between two epochs errors average: half the square.
    assert 0.2 < result["anees"] < 2


def test_sparse_poses_are_compared_exactly_and_dense_ones_as_they_were():
    dense, sparse = moving(0.02, 5.0), moving(1.0, 10.0, 6.03)
    times, rotation, place = (np.concatenate(pair) for pair in zip(dense, sparse, strict=True))
    truth = Truth(times, rotation, place)
    times, rotation, place = moving(0.1)
    found: Any = matched(truth, times, rotation, place, 0.5)
    turned, moved, known = found
    old: Any = recordings.truth_at(truth, times, 0.5)
    np.testing.assert_array_equal(turned[old[2]], old[0][old[2]])
    np.testing.assert_array_equal(moved[old[2]], old[1][old[2]])
    np.testing.assert_array_equal(np.flatnonzero(known & ~old[2]), [60, 70, 80, 90])
    # The track is the truth: what is left is how far a curve is from its chords.
    np.testing.assert_allclose(moved[known], place[known], atol=2e-3)
    assert np.abs(rotations.error(turned[known], rotation[known])).max() < 2e-3


def test_gaps_in_both_are_named():
    ranges, truth = np.arange(0, 10, 1.0), Truth(*moving(1.0, start_s=0.5))
    with pytest.raises(ValueError, match=r"gaps above 0.5 s are not bridged; .* 1 s in the truth "
                                         r"and 1 s in the ranges .*--truth-gap-s"):  # fmt: skip
        check_overlap(truth, ranges, 0.5)
    check_overlap(truth, ranges, 1.0)
    check_overlap(truth._replace(times=truth.times - 0.5), ranges, 0.5)


def test_gaps_of_the_ranges_are_counted():
    recording, track = pair(Truth(*moving(0.1)))
    settings = replay.Settings()
    assert replay.track_figures(recording, track, None, settings)["gaps"]["count"] == 0
    kept = np.ones(100, dtype=bool)
    kept[20:35] = kept[60:91] = False
    rotation, translation, covariance = (field[kept] for field in track[1:4])
    fewer = replay.Track(track.times[kept], rotation, translation, covariance)
    log = recording._replace(
        times=recording.times[kept], ranges=recording.ranges[kept], links=recording.links[kept]
    )
    found = replay.track_figures(log, fewer, None, settings)
    assert found["gaps"] == {
        "count": 2,
        "longest_s": pytest.approx(3.2),
        "longest_at_s": pytest.approx(5.9),
    }
    said = "has 2 gaps without ranges; the longest lasts 3.2 s from 5.9 s after the start."
    assert f"Note: the log {said}" in found["notes"]


def test_a_truth_that_stays_while_the_ranges_change_is_noted():
    tags = bodies.octahedron(0.8)
    log = flight(tags, count=120)
    truth: Any = log.truth
    kept = np.arange(120)
    kept[40:61] = 40
    frozen = truth._replace(rotation=truth.rotation[kept], translation=truth.translation[kept])
    late = frozen._replace(times=truth.times + 0.3)
    settings = replay.Settings.of(range_std_m=0.06)
    for one, changed, seen in (
        (truth, {}, False),
        (frozen, {}, True),
        (late, {"time_offset": 0.3}, True),
        (frozen, {"truth_exclude": ((4.0, 6.0),)}, False),
    ):
        found = replay.replay_recording(log._replace(truth=one), settings.changed(**changed))
        notes = [note for note in found.figures["notes"] if "repeats one pose" in note]
        assert len(notes) == seen
        if seen:
            assert "for 2.00 s from 4.00 s on, while the ranges change" in notes[0]
            assert notes[0].endswith("--truth-exclude 4.00:6.00.")
    # A body that rests as long is no fault.
    rests = log._replace(ranges=log.ranges[kept] + 0.05 * noise_of(log), truth=frozen)
    assert frozen_spells(rests) == []
    # Noise alone must not say otherwise: the pose of a whole log.
    still = frozen._replace(
        rotation=np.repeat(truth.rotation[:1], 120, 0),
        translation=np.repeat(truth.translation[:1], 120, 0),
    )
    for seed in range(20):
        ranges = log.ranges[:1] + 0.05 * noise_of(log, seed)
        assert frozen_spells(log._replace(ranges=ranges, truth=still)) == []


def noise_of(log, seed=0):
    return np.random.default_rng(seed).standard_normal(log.ranges.shape)


def test_no_common_time_names_what_lies_between():
    times, rotation, place = moving(0.1)
    with pytest.raises(
        ValueError, match=r"does not overlap with the ranges in time: .* 5 s apart$"
    ):
        check_overlap(Truth(times[:20] + 14.9, rotation[:20], place[:20]), times, 0.5)
    with pytest.raises(ValueError, match="the truth's clock may be ahead by about 1700000000 s"):
        check_overlap(Truth(times + 1.7e9, rotation, place), times, 0.5)
    with pytest.raises(ValueError, match="the stamps of the truth look like milliseconds"):
        check_overlap(Truth(1e3 * times + 50, rotation, place), times, 0.5)


@pytest.mark.parametrize(
    ("scale", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
def test_stamps_in_another_unit_are_hinted(scale, unit):
    times, rotation, place = moving(0.1)
    truth = Truth(times, rotation, place)
    hints = [*stamp_hints(scale * times, truth)]
    assert len(hints) == 1
    assert f"the stamps of the ranges look like {unit}" in hints[0]
    late = Truth(scale * times, rotation, place)
    assert f"the stamps of the truth look like {unit}" in next(stamp_hints(times, late))
    assert "milliseconds?" in next(stamp_hints(1e3 * times, None))
    assert [*stamp_hints(times, truth), *stamp_hints(times, None)] == []
    # A truth of a part of the run is no fault.
    assert [*stamp_hints(times, Truth(times[:5], rotation[:5], place[:5]))] == []


def transformed(world=(0, 0, 0), shift=(0, 0, 0), body=(0, 0, 0), arm=(0, 0, 0), late_s=0.0):
    times, rotation, place = moving(0.05)
    R, C = rotations.exp(np.array(world, float)), rotations.exp(np.array(body, float))
    place = place + rotation @ np.array(arm, float)
    return Truth(times + late_s, R @ rotation @ C, place @ R.T + np.array(shift, float))


QUATERNION = rotations.quaternion(moving(0.05)[1])
TIMES, _, PLACE = moving(0.05)
FAULTS = {
    "xyzw as wxyz": (
        Truth(TIMES, rotations.from_quaternion(np.roll(QUATERNION, -1, axis=-1)), PLACE),
        "quaternions look like x, y, z, w",
    ),
    "wxyz as xyzw": (
        Truth(TIMES, rotations.from_quaternion(np.roll(QUATERNION, 1, axis=-1)), PLACE),
        "quaternions look like w, x, y, z",
    ),
    "world to body": (
        Truth(TIMES, np.swapaxes(moving(0.05)[1], 1, 2), PLACE), "rotations look inverted",
    ),
    "centimetres": (Truth(TIMES, moving(0.05)[1], 100 * PLACE), "positions look like centimetres"),
    "late": (transformed(late_s=0.3), r"clock looks about 0.(25|30|35) s ahead; see --time-off"),
    "early": (transformed(late_s=-0.4), r"clock looks about 0.(35|40|45) s behind .*offset -0"),
    "shift": (transformed(shift=(5, -2, 0.3)), r"world frame, turned by \(.*shifted by \(-5\.0"),
    "map": (transformed(shift=(448262, 5411932, 310)), "world frame"),
    "north-east-down": (
        transformed((np.pi / 2**0.5, np.pi / 2**0.5, 0)),
        "world frame, .* as if x and y of the anchors .* swapped, or the truth in north-east-down",
    ),
    "half turn about x": (transformed((3.1, 0.1, 0)), "as if the layout of the anchors .*mirrored"),
    "half turn about z": (transformed((0, 0.1, 3.1)), r"world frame, .* m; see --align"),
    "turned frame": (transformed((0, 0, 0.6), (1, 2, 0)), r"world frame, .* m; see --align"),
    "marker off the body": (transformed(arm=(0.3, 0.1, -0.2)), "body frame.*shifted by"),
    "marker turned": (transformed(body=(0.1, 0, 0.5)), r"body frame, turned by \(-\d\.\d, "),
}  # fmt: skip


@pytest.mark.parametrize("step_s", [0.05, 1.0])
@pytest.mark.parametrize("name", FAULTS)
def test_a_constant_fault_is_hinted(name, step_s):
    truth, words = FAULTS[name]
    assert truth.rotation is not None
    some = slice(None, None, round(step_s / 0.05))
    result = outcome(Truth(truth.times[some], truth.rotation[some], truth.translation[some]))
    assert len(result["notes"]) == 1, result["notes"]
    assert re.search(words, result["notes"][0]), result["notes"]


def floor_run(count, swapped, late_s=0.3):
    """A planar log of tags on the x axis of a body that faces its way; x and y swapped or not."""
    times = 0.1 * np.arange(300)
    truth_times = 0.05 * np.arange(-20, 640)

    def pose(t):
        place = np.stack([6 + 4 * np.sin(0.21 * t), 4 + 2.4 * np.sin(0.42 * t + 0.3), 0 * t], -1)
        yaw = np.arctan2(2.4 * 0.42 * np.cos(0.42 * t + 0.3), 4 * 0.21 * np.cos(0.21 * t))
        return rotations.exp(yaw[:, None] * [0.0, 0, 1]), place

    anchors = np.array([[0, 0, 0], [12, 0, 0], [12, 8, 0], [0, 8, 0], [6, 0, 0], [6, 8, 0.0]])
    tags = np.array([[0.3, 0, 0], [-0.3, 0, 0]])[:count]
    rotation, place = pose(times)
    points = place[:, None] + tags @ np.swapaxes(rotation, 1, 2)
    exact = np.linalg.norm(points[:, None] - anchors[:, None], axis=-1)
    ranges = exact + 0.05 * np.random.default_rng(2).standard_normal(exact.shape)
    ids = tuple("abcdef"), tuple("xy"[:count])
    anchors = anchors[:, [1, 0, 2]] if swapped else anchors
    told = Truth(truth_times + late_s, *pose(truth_times))
    return Recording(times, ranges, ranges > 0, None, anchors, tags, *ids, told)


@with_kernels
@pytest.mark.parametrize("count", [1, 2])
def test_swapped_axes_of_the_anchors_are_hinted_on_a_floor(count):
    """The ranges fit the mirrored layout, and an aligned frame has no heading of its own."""
    for given in (
        {},
        {"align": "yaw"},
        {"align": "yaw", "time_offset": "auto"},
        {"align": "position"},
    ):
        settings = replay.Settings.of(planar=True, range_std_m=0.05, **given)
        late = 0.3 if "time_offset" in given else 0.0
        for swapped in (False, True):
            found = replay.replay_recording(floor_run(count, swapped, late), settings).figures
            hints = [n for n in found["notes"] if "mirror image of the truth: x and y" in n]
            assert [n.startswith("WARNING") for n in hints] == [True] * swapped, found["notes"]
            assert found["position_rmse_m"] > 1 or not swapped
    settings = replay.Settings.of(planar=True, range_std_m=0.05, time_offset="auto")
    with pytest.raises(ValueError, match=r"time_offset 'auto'.*; x and y of the anchors \(or of "):
        replay.replay_recording(floor_run(count, True), settings)


def test_a_shift_is_hinted_even_if_the_beliefs_are_wide():
    recording, track = pair(transformed(late_s=0.3))
    wide = track._replace(covariance=400 * track.covariance)
    errors = replay.track_errors(recording, wide, replay.Settings())
    figures = replay.track_figures(recording, wide, errors, replay.Settings())
    assert figures["anees"] < 0.3
    assert re.search(r"clock looks about 0.(25|30|35) s ahead", figures["notes"][-1])


def test_the_rotation_of_one_tag_has_no_number():
    recording, track = pair(Truth(*moving(0.05)))
    for std, cells in ((4.0, ["undetermined", "", ""]), (0.01, None)):
        covariance = track.covariance.copy()
        covariance[:, :3, :3] = std**2 * np.eye(3)
        wide = track._replace(covariance=covariance)
        errors = replay.track_errors(recording, wide, replay.Settings())
        figures = replay.track_figures(recording, wide, errors, replay.Settings())
        rows = dict(reports.error_rows(figures, "xyz", reports.turn_open(figures)))
        for name in ("yaw (deg)", "rotation (deg)"):
            assert rows[name] == cells if cells else rows[name][0] != "undetermined"
        assert rows["position xyz (m)"][0] == f"{figures['position_rmse_m']:.4f}"


def test_a_table_of_runs_has_no_angles_of_one_tag(capsys):
    """Nor has the row of all runs together; runs of two tags have them."""
    settings = replay.Settings.of(planar=True, smooth=True)
    for count in (1, 2):
        logs = {run: floor_run(count, False, 0.0).part(slice(40)) for run in "ab"}
        figures = replay.replay_runs(logs, settings).figures
        reports.print_runs(figures)
        said = capsys.readouterr().out
        angles = [f"{one['yaw_rmse_deg']:.2f}" for one in figures["runs"].values()]
        assert "together" in said
        assert "smoothed" in said
        assert said.count("undetermined") == (6 if count == 1 else 0)
        assert all((angle in said) == (count == 2) for angle in angles)


def test_a_truth_without_heights_hints_at_the_floor():
    told = Truth(*moving(0.1))._replace(planar=True)
    for settings, hinted in (
        (replay.Settings(), True),
        (replay.Settings.of(planar=True, height_m=0.0), False),
    ):
        notes = outcome(told, settings)["notes"]
        assert any("--planar --height-m H" in note for note in notes) == hinted


def test_two_faults_are_both_hinted():
    truth = transformed((0, 0, 0.6), (1, 2, 0))
    assert truth.rotation is not None
    q = np.roll(rotations.quaternion(truth.rotation), -1, axis=-1)
    notes = outcome(truth._replace(rotation=rotations.from_quaternion(q)))["notes"]
    assert len(notes) == 1
    assert re.search("quaternions look like x, y, z, w .*, with .*world frame", notes[0])


def planar_note(change):
    """The only note on a planar body, of whose true headings something is changed."""
    settings = replay.Settings.of(planar=True, height_offset_m=0.0)
    times, _, place = moving(0.05)
    heading = rotations.exp(0.4 * times[:, None] * [0, 0, 1])
    recording, track = pair(Truth(times, change(heading), place))
    track = track._replace(rotation=rotations.exp(0.4 * track.times[:, None] * [0, 0, 1]))
    found = replay.track_errors(recording, track, settings)
    (note,) = replay.track_figures(recording, track, found, settings)["notes"]
    return note


def test_a_planar_offset_of_the_heading_is_hinted():
    note = planar_note(lambda R: R @ rotations.exp(np.array([0, 0, -0.2])))
    assert "body frame, turned by (0.0, 0.0, 11.5) deg" in note.replace("-0.0", "0.0")


def returned(judged, delay, rotations):
    return judged


def test_no_order_of_quaternions_is_hinted_for_headings():
    times, rotation, place = moving(0.05)
    heading = rotations.exp(rotations.yaw(rotation)[:, None] * [0, 0, 1])
    for truth, hinted in ((rotation, True), (heading, False)):
        track = rotations.from_quaternion(np.roll(rotations.quaternion(truth), 1, axis=-1))
        small = np.full(len(times), 1e-4)
        judged = Judged(times, track, place, truth, place, small, small)
        hints = fault_hints(partial(returned, judged), lambda R: R, False)
        assert any("quaternion" in hint for hint in hints) == hinted, hints


def test_another_order_of_quaternions_is_hinted_for_planar_bodies():
    note = planar_note(
        lambda R: rotations.from_quaternion(np.roll(rotations.quaternion(R), -1, axis=-1))
    )
    assert re.search("quaternions look like x, y, z, w in columns named w, x, y, z: ", note)

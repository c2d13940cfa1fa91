"""Logs of time differences and pseudo-ranges: reading, errors, replay."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from rbl_gym import recordings
from rbl_gym.app.cli import main
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import offsets, ranging
from rbl_gym.recordings import differences
from rbl_gym.studies import replay
from tests.recorded import options, points, table

M, N = 6, 4
STD = 0.05
ANCHORS = np.array(
    [[0, 0, 0.3], [10, 0, 2.7], [10, 8, 0.4], [0, 8, 2.8], [5, 0, 2.9], [5, 8, 0.2]], float
)
TAGS = 0.5 * bodies.octahedron(1.0)[[0, 2, 4, 1]] + [0.0, 0.0, 0.05]


def walk(K: int = 60, seed: int = 0):
    """Times, poses, arrivals (K, M, N) of a body that turns and moves slowly."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(K)
    rotation = rotations.exp(np.stack([0.1 * np.sin(t), 0 * t, 0.3 * t], axis=-1))
    place = np.stack([4 + 2 * np.sin(0.3 * t), 4 + 1.5 * np.cos(0.4 * t), 1.2 + 0.1 * t], axis=-1)
    far = ranging.distances(ANCHORS, ranging.tag_positions(rotation, place, TAGS))
    return t, rotation, place, far + STD * rng.standard_normal(far.shape), rng


def tables(folder) -> dict[str, Any]:
    return {
        "anchors": points(folder / "a.csv", "anchor", ANCHORS),
        "tags": points(folder / "b.csv", "tag", TAGS),
    }


def difference_rows(t, arrivals, pairs):
    return [
        [f"{time:.3f}", a, b, n, f"{arrivals[k, a, n] - arrivals[k, b, n]:.9f}"]
        for k, time in enumerate(t)
        for n in range(N)
        for a, b in pairs
    ]


HEADER = "t,anchor_a,anchor_b,tag,difference"
REFERENCE = [(a, 0) for a in range(1, M)]
CHAIN = [(a, a + 1) for a in range(M - 1)]
ALL = [(a, b) for a in range(M) for b in range(a)]


@pytest.mark.parametrize("pairs", [REFERENCE, CHAIN, ALL], ids=["reference", "chain", "all"])
def test_differences_are_pseudo_ranges_with_the_noise_of_arrivals(tmp_path, pairs):
    t, _, _, arrivals, _ = walk(5)
    path = table(tmp_path / "r.csv", HEADER, difference_rows(t, arrivals, pairs))
    log = recordings.read_recording(recordings.Files(path, **tables(tmp_path)))
    assert log.offset == "tag"
    assert log.links.all()
    ones = np.ones_like(arrivals)
    # As if the arrivals themselves had been told, but for what the tag has in common.
    np.testing.assert_allclose(
        offsets.centred(log.ranges, ones, "tag"), offsets.centred(arrivals, ones, "tag"), atol=1e-8
    )


def test_anchors_that_hang_together_with_no_other_are_left_out(tmp_path):
    t, _, _, arrivals, _ = walk(3)
    pairs = [(1, 0), (2, 1), (3, 2), (5, 4)]
    path = table(tmp_path / "r.csv", HEADER, difference_rows(t, arrivals, pairs))
    log = recordings.read_recording(recordings.Files(path, **tables(tmp_path)))
    assert log.links[:, :4].all()
    assert not log.links[:, 4:].any()
    assert log.report.dropped["of anchors without a connection to the others"] == 3 * N


def test_a_deviation_of_a_difference_is_that_of_two_arrivals(tmp_path):
    t, _, _, arrivals, _ = walk(3)
    rows = [[*row, 0.1] for row in difference_rows(t, arrivals, REFERENCE)]
    path = table(tmp_path / "r.csv", HEADER + ",std", rows)
    log = recordings.read_recording(recordings.Files(path, **tables(tmp_path)))
    assert log.range_std is not None
    np.testing.assert_allclose(log.range_std, 0.1 / np.sqrt(2))


@pytest.mark.parametrize("offset", offsets.OFFSETS)
def test_pseudo_ranges_of_any_sign_are_read(tmp_path, offset):
    t, _, _, arrivals, rng = walk(20)
    told = arrivals + 100 * rng.standard_normal((20, *offsets.group_shape(offset, M, N)))
    told[3] -= told[3, 0, 0]
    rows = [
        [f"{time:.3f}", m, n, f"{told[k, m, n]:.9f}"]
        for k, time in enumerate(t) for m in range(M) for n in range(N)
    ]  # fmt: skip
    path = table(tmp_path / "r.csv", "t,anchor,tag,range", rows)
    format = recordings.Format(offset=offset)
    log = recordings.read_recording(recordings.Files(path, **tables(tmp_path)), format=format)
    assert log.offset == offset
    assert log.links.all()
    ones = np.ones_like(told)
    np.testing.assert_allclose(
        offsets.centred(log.ranges, ones, offset), offsets.centred(told, ones, offset), atol=1e-8
    )
    with pytest.raises(ValueError, match="cannot be used"):
        recordings.read_recording(recordings.Files(path, **tables(tmp_path)))


@pytest.mark.parametrize(
    ("row", "column", "cell", "message"),
    [
        (7, 4, "nan", "difference.*must be a finite number"),
        (7, 4, "x", "difference.*must be a finite number"),
        (7, 4, "1e12", "at most 1e9 m"),
        (7, 1, "9", "anchor must be one of 0, 1, 2"),
        (7, 2, "9", "anchor must be one of 0, 1, 2"),
        (7, 3, "9", "tag must be one of 0, 1, 2"),
        (7, 2, "3", "must be another anchor than anchor_a"),
        (7, 0, "nan", "t.*finite"),
        (7, 0, "-5", "time must not decrease"),
    ],
)
def test_bad_rows_are_refused_by_line(tmp_path, row, column, cell, message):
    t, _, _, arrivals, _ = walk(3)
    rows = difference_rows(t, arrivals, REFERENCE)
    assert rows[row][1] == 3
    rows[row][column] = cell
    path = table(tmp_path / "r.csv", HEADER, rows)
    format = recordings.Format(strict=True)
    with pytest.raises(ValueError, match=message) as caught:
        recordings.read_recording(recordings.Files(path, **tables(tmp_path)), format=format)
    assert f"line {row + 2}" in str(caught.value) or "time" in message


def test_a_pair_that_comes_twice_is_dropped_and_counted(tmp_path):
    t, _, _, arrivals, _ = walk(10)
    rows = difference_rows(t, arrivals, REFERENCE)
    rows.insert(1, [rows[0][0], rows[0][2], rows[0][1], rows[0][3], "1.0"])
    path = table(tmp_path / "r.csv", HEADER, rows)
    log = recordings.read_recording(recordings.Files(path, **tables(tmp_path)))
    assert log.report.dropped["twice with two values"] == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"anchors": None}, "positions of the anchors .--anchors., which time diff"),
        ({"offset": "anchor"}, "offset must be None or 'tag'"),
        ({"calibration": "c.csv"}, "calibration must be left out for ranges"),
    ],
)  # fmt: skip
def test_what_does_not_go_with_differences_is_refused(tmp_path, change, message):
    t, _, _, arrivals, _ = walk(3)
    path = table(tmp_path / "r.csv", HEADER, difference_rows(t, arrivals, REFERENCE))
    change = dict(change)
    if "calibration" in change:
        change = {"calibration": table(tmp_path / "c.csv", "anchor,tag,bias_m", [[0, 0, 0.1]])}
    format = recordings.Format(offset=change.pop("offset", None))
    told: dict[str, Any] = {**tables(tmp_path), **change}
    files = recordings.Files(path, **told)
    with pytest.raises(ValueError, match=message):
        recordings.read_recording(files, format=format)


def test_differences_longer_than_their_anchors_are_apart_are_refused(tmp_path):
    t, _, _, arrivals, _ = walk(5)
    path = table(tmp_path / "r.csv", HEADER, difference_rows(t, 100 * arrivals, REFERENCE))
    with pytest.raises(ValueError, match="units look inconsistent"):
        recordings.read_recording(recordings.Files(path, **tables(tmp_path)))


def test_missing_columns_are_named(tmp_path):
    path = table(tmp_path / "r.csv", "t,anchor_a,tag,difference", [[0, 0, 0, 1.0]])
    with pytest.raises(ValueError, match="anchor_b"):
        recordings.read_recording(recordings.Files(path, **tables(tmp_path)))


def test_the_larger_part_of_a_graph():
    part = differences._largest_part(np.array([0, 2, 3, 4]), np.array([1, 3, 4, 5]), 7)
    np.testing.assert_array_equal(part, [False, False, True, True, True, True, False])


@pytest.mark.parametrize("name", ["iekf", "iekf-cv", "iekf-log"])
def test_differences_are_replayed_and_smoothed(tmp_path, name):
    t, rotation, place, arrivals, _ = walk(80)
    path = table(tmp_path / "r.csv", HEADER, difference_rows(t, arrivals, REFERENCE))
    poses = np.column_stack([t, place, rotations.quaternion(rotation)])
    truth = table(tmp_path / "truth.csv", "t,x,y,z,qw,qx,qy,qz", poses)
    log = recordings.read_recording(recordings.Files(path, **tables(tmp_path), truth=truth))
    settings = replay.Settings.of(
        filter=name, range_std_m=STD, constant_std_m=1e-3, constant_common_m=0.0,
        drift_std_m=1e-3, smooth=name == "iekf-cv", smooth_constant_m=1e-3, smooth_common_m=0.0,
        smooth_bias_std_m=1e-3,
    )  # fmt: skip
    replayed = replay.replay_recording(log, settings)
    assert replayed.errors is not None
    assert np.sqrt(np.square(replayed.errors.position[20:]).mean()) < 0.12
    assert 0.5 < replayed.figures["consistency"]["nis_per_dof"] < 1.5
    if name == "iekf-cv":
        assert replayed.smoothed_errors is not None
        smooth = np.sqrt(np.square(replayed.smoothed_errors.position).mean())
        assert smooth < 0.04


def test_the_command_replays_pseudo_ranges(tmp_path, capsys):
    t, _, _, arrivals, rng = walk(30)
    told = arrivals + 1e3 * rng.standard_normal((30, 1, N))
    rows = [
        [f"{time:.3f}", m, n, f"{told[k, m, n]:.9f}"]
        for k, time in enumerate(t) for m in range(M) for n in range(N)
    ]  # fmt: skip
    path = table(tmp_path / "r.csv", "t,anchor,tag,range", rows)
    files = options(tables(tmp_path))
    arguments = ["replay", "--ranges", path, *files, "--filter", "iekf", "--json", "-"]
    assert main([*arguments, "--offset", "tag"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert 0.3 < figures["consistency"]["nis_per_dof"] < 2.0
    assert main(arguments) != 0

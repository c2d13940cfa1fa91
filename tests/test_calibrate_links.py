"""Calibration of links, tags and clocks with truth: known answers, standard deviations, files."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

from rbl_gym.app.cli import main
from rbl_gym.estimators.calibration import (
    KnownPath,
    LinkFit,
    LinkModel,
    fit_links,
    spread_of_residuals,
)
from rbl_gym.estimators.calibration.clock import Clock, find_clock
from rbl_gym.estimators.calibration.drift import NO_DRIFT, Drift, Whitener, find_drift
from rbl_gym.recordings import Files, Truth, read_recording
from rbl_gym.studies import calibrate
from rbl_gym.studies.calibrate import CalibratedLinks, LinkSettings
from tests import recorded
from tests.helpers import ROOT

LIAS = ROOT.parent / "shared" / "data" / "lias_planar"
ANCHORS = np.array(
    [[-4, 3, 0.3], [0, 3, 2.5], [4, 3, 0.5], [4, -3, 2.2], [0, -3, 0.2], [-4, -3, 2]]
)
TAGS = np.array([[0.3, 0.0, 0.05], [-0.2, 0.25, 0.0], [-0.2, -0.2, 0.1], [0.0, 0.1, 0.35]])


def path_of(times, planar=False):
    """A body that drives about and turns every way."""
    place = np.stack([2.5 * np.sin(0.5 * times), 1.8 * np.sin(0.83 * times + 1)], -1)
    height = np.full_like(times, 1.0) if planar else 1.2 + 0.6 * np.sin(0.31 * times)
    yaw = 0.9 * times + np.sin(0.4 * times)
    tilt = 0.0 if planar else 0.6
    angles = np.stack([yaw, tilt * np.sin(0.37 * times), tilt * np.cos(0.53 * times)], -1)
    rotation = Rotation.from_euler("ZYX", angles).as_matrix()
    return rotation, np.column_stack([place, height])


def ranges_of(
    times: Any,
    rng: Any,
    tags: Any = TAGS,
    bias: Any = 0.0,
    slope: Any = 0.0,
    noise: float = 0.05,
    late: float = 0.0,
    planar: bool = False,
):
    """Ranges at exact poses, by a loop over links."""
    rotation, place = path_of(times, planar)
    M, N = len(ANCHORS), len(tags)
    bias, slope = np.broadcast_to(bias, (M, N)), np.broadcast_to(slope, (M, N))
    ranges = np.zeros((len(times), M, N))
    for n in range(N):
        at = place + rotation @ tags[n]
        for m in range(M):
            d = np.sqrt(((at - ANCHORS[m]) ** 2).sum(axis=1))
            ranges[:, m, n] = (1 + slope[m, n]) * d + bias[m, n]
    ranges += noise * rng.standard_normal(ranges.shape)
    return ranges + (rng.random(ranges.shape) < late) * rng.exponential(1.0, ranges.shape)


def recording_of(times, ranges, truth, tags=TAGS):
    return recorded.recording(times, ranges, ANCHORS, tags, truth)


def test_standard_deviations_are_honest_with_white_noise_and_late_ranges():
    """2 x 24 x 12 errors over their standard deviations: mean square 1 within 4 sigma."""
    times = 0.1 * np.arange(500)
    rotation, place = path_of(times)
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        bias = rng.normal(0.1, 0.1, (6, 4))
        slope = 0.01 * rng.standard_normal((6, 4))
        ranges = ranges_of(times, rng, bias=bias, slope=slope, late=0.05 if seed % 2 else 0.0)
        fit = fit_links(ranges, None, ANCHORS, TAGS, KnownPath(times, rotation, place))
        squares += [((fit.bias_m - bias) / fit.bias_std_m) ** 2]
        squares += [((fit.slope - slope) / fit.slope_std) ** 2]
        np.testing.assert_allclose(np.median(fit.noise_std_m), 0.05, rtol=0.1)
        assert np.abs(fit.tags - TAGS).max() < 0.01
    squares = np.array(squares)
    # Bias and slope of a link go together: half as many are independent.
    assert squares.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / (squares.size / 2)))


def test_standard_deviations_are_honest_with_errors_that_last():
    """Gauss-Markov errors of 1 s at 10 Hz, three times the white ones: white laws claim a third."""
    times = 0.1 * np.arange(1000)
    rotation, place = path_of(times)
    squares, shares = [], []
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        slow = np.zeros((len(times), 6, 4))
        a = np.exp(-0.1)
        slow[0] = 0.06 * rng.standard_normal((6, 4))
        for k in range(1, len(times)):
            step = 0.06 * np.sqrt(1 - a * a) * rng.standard_normal((6, 4))
            slow[k] = a * slow[k - 1] + step
        ranges = ranges_of(times, rng, noise=0.02) + slow
        fit = fit_links(ranges, None, ANCHORS, TAGS, KnownPath(times, rotation, place))
        squares += [(fit.bias_m / fit.bias_std_m) ** 2, (fit.slope / fit.slope_std) ** 2]
        shares += [(fit.drift.share, fit.drift.time_s)]
    squares = np.array(squares)
    assert squares.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / (squares.size / 2)))
    np.testing.assert_allclose(np.mean(shares, axis=0), [0.9, 1.0], rtol=0.2)


def test_whitening_is_that_of_the_covariance():
    """Whitened columns have the Gram matrix of the inverse covariance, built entry by entry."""
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.05, 0.3, 40))
    used = rng.random((40, 2)) < 0.8
    std, drift = np.array([0.1, 0.3]), Drift(0.6, 0.7)
    columns = rng.standard_normal((40, 2, 3))
    whitener = Whitener(std, drift, times)
    white = [whitener.whitened(columns[a:b], used[a:b], np.ones((b - a, 2)))
             for a, b in ((0, 13), (13, 40))]  # fmt: skip
    white = np.concatenate(white)
    for link in range(2):
        at = used[:, link]
        apart = np.abs(times[at][:, None] - times[at])
        cov = std[link] ** 2 * (0.6 * np.exp(-apart / 0.7) + 0.4 * np.eye(at.sum()))
        want = columns[at, link].T @ np.linalg.solve(cov, columns[at, link])
        got = white[:, link].T @ white[:, link]
        np.testing.assert_allclose(got, want, rtol=1e-9)
    plain = Whitener(std, NO_DRIFT, times).whitened(columns, used, np.full((40, 2), 0.25))
    np.testing.assert_allclose(plain, 0.5 * columns * used[..., None] / std[:, None])


def test_white_residuals_have_no_slow_part():
    rng = np.random.default_rng(0)
    z = rng.standard_normal((400, 12))
    assert find_drift(z, np.ones_like(z, dtype=bool), 0.1 * np.arange(400)) == NO_DRIFT


def test_nodes_share_the_delays_of_antennas():
    times = 0.2 * np.arange(40)
    rng = np.random.default_rng(5)
    of_anchors, of_tags = rng.normal(0.2, 0.1, 6), np.array([0.1, -0.05, 0.03, -0.08])
    ranges = ranges_of(times, rng, bias=of_anchors[:, None] + of_tags, noise=0.02)
    path = KnownPath(times, *path_of(times))
    fit = fit_links(ranges, None, ANCHORS, TAGS, path, LinkModel("node", slopes=False, tags="held"))
    assert isinstance(fit, LinkFit)
    assert fit.node_delay_m is not None
    assert fit.node_delay_std_m is not None
    want = np.concatenate([of_anchors, of_tags])
    assert (np.abs(fit.node_delay_m - want) < 4 * fit.node_delay_std_m).all()
    assert fit.node_delay_m[6:].sum() == pytest.approx(0, abs=1e-12)
    common = fit_links(ranges, None, ANCHORS, TAGS, path, LinkModel("common", tags="held"))
    assert np.ptp(common.bias_m) == 0
    assert np.ptp(common.slope) == 0


@pytest.mark.parametrize("planar", [False, True])
def test_clock_turn_and_arms_are_found(planar):
    """The truth's body is upside down and 7 degrees off, its clock 0.31 s ahead."""
    times = 0.05 * np.arange(1200)
    rng = np.random.default_rng(7)
    turn = Rotation.from_euler("ZYX", [7, 0, 0 if planar else 180], degrees=True).as_matrix()
    shift = np.array([0.02, -0.03, 0.0])
    table = (TAGS - shift) @ turn  # what the truth's frame calls TAGS
    off = table + np.where(np.arange(4)[:, None] == 2, [0.04, -0.03, 0.0], 0.0)
    ranges = ranges_of(times, rng, bias=0.15, planar=planar, late=0.03)
    truth_times = 0.02 * np.arange(3100)
    truth = Truth(truth_times + 0.31, *path_of(truth_times, planar))
    recording = recording_of(times, ranges, truth, off)
    settings = LinkSettings(tags="free", planar=planar)
    found = calibrate.calibrate_links(recording, settings)
    assert isinstance(found, CalibratedLinks)
    assert found.clock is not None
    assert found.clock.std_s < 0.006
    assert abs(found.clock.offset_s - 0.31) < 4 * found.clock.std_s
    axes = slice(2) if planar else slice(3)
    error, std = (found.fit.tags - TAGS)[:, axes], found.fit.tags_std_m[:, axes]
    assert (np.abs(error) < 4.5 * std).all()
    assert std.max() < 0.02
    if planar:
        assert "planar" in " ".join(found.figures["not_determined"])
    rigid = calibrate.calibrate_links(
        recording._replace(tags=table), LinkSettings(planar=planar, time_offset=0.31)
    )
    assert np.degrees(Rotation.from_matrix(rigid.fit.rotation @ turn.T).magnitude()) < 0.5
    np.testing.assert_allclose(rigid.fit.tags, TAGS, atol=0.01)
    json.dumps(found.figures, allow_nan=False)


def test_a_body_that_stands_says_what_it_does_not_tell():
    times = 0.1 * np.arange(200)
    rng = np.random.default_rng(2)
    rotation, place = path_of(np.zeros(1))
    ranges = ranges_of(np.zeros(200), rng, bias=0.1, noise=0.03)
    truth = Truth(times, np.repeat(rotation, 200, 0), np.repeat(place, 200, 0))
    found = calibrate.calibrate_links(recording_of(times, ranges, truth))
    said = " ".join(found.figures["not_determined"])
    assert found.clock is None
    assert "time offset" in said
    assert "slope of A0-T0" in said


def test_clock_by_hand():
    """A cosine and its copy, 0.12 s late, on one link."""
    times = 0.05 * np.arange(600)
    ranges = (5 + np.cos(times))[:, None, None]
    rng = np.random.default_rng(0)
    noisy = ranges + 0.01 * rng.standard_normal(ranges.shape)

    def distances(shift):
        return 5 + np.cos(times + shift - 0.12)[:, None, None], np.ones(600, dtype=bool)

    clock = find_clock(times, noisy, ranges > 0, distances, 1.0)
    assert isinstance(clock, Clock)
    assert abs(clock.offset_s - 0.12) < 4 * clock.std_s
    assert clock.std_s < 0.01


@pytest.mark.parametrize(
    ("lasts_s", "path_std", "most_s"), [(60, 0.0, 0.02), (60, 0.01, 0.04), (20, 0.0, 0.201)]
)
def test_clock_with_lost_and_late_ranges_where_the_body_faces_its_way(lasts_s, path_std, most_s):
    """A tag further ahead looks like a later clock, and lost ranges change what is known.

    A path with noise (m and rad) has large rates, and a short log leaves few blocks of time.
    """
    hall = np.array(
        [[0, 0, 2.6], [12, 0, 2.2], [12, 8, 2.7], [0, 8, 2.3], [6, 0, 1.2], [6, 8, 1.5]]
    )
    z, times, tags = [], np.arange(0, lasts_s, 0.1), TAGS[:2]

    def pose(at):
        w = 0.21
        place = np.stack([6 + 4 * np.sin(w * at), 4 + 2.4 * np.sin(2 * w * at + 0.3), 0 * at], -1)
        yaw = np.arctan2(4.8 * np.cos(2 * w * at + 0.3), 4 * np.cos(w * at))
        return Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]).as_matrix(), place

    rotation, place = pose(times)
    places = place[:, None] + tags @ np.swapaxes(rotation, -1, -2)
    d = np.linalg.norm(places[:, None] - hall[:, None], axis=-1)
    on_truth = np.arange(0, lasts_s, 0.02)
    settings = calibrate.LinkSettings(slopes=False, planar=True)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        ranges = d + 0.08 * rng.standard_normal(d.shape)
        ranges += np.where(rng.random(d.shape) < 0.05, rng.uniform(0.5, 4, d.shape), 0)
        ranges[rng.random(d.shape) < 0.1] = 0
        turned, moved = pose(on_truth)
        moved = moved + path_std * rng.standard_normal(moved.shape)
        yaw = path_std * rng.standard_normal((len(moved), 1)) * [0.0, 0.0, 1.0]
        truth = Truth(on_truth + 0.3, Rotation.from_rotvec(yaw).as_matrix() @ turned, moved)
        recording = recording_of(times, ranges, truth, tags)._replace(anchors=hall)
        found = calibrate.calibrate_links(recording, settings)
        assert found.clock is not None
        assert found.clock.std_s < most_s
        z.append((found.clock.offset_s - 0.3) / found.clock.std_s)
        assert (np.abs(found.fit.tags - tags)[:, :2] < 5 * found.fit.tags_std_m[:, :2] + 1e-3).all()
    # Squared deviations: the largest below 4 sigma, the sum below its 99.99 % point.
    assert np.abs(z).max() < 4
    assert np.square(z).sum() < scipy.stats.chi2.ppf(0.9999, len(z))


def test_a_truth_that_repeats_a_pose_and_jumps_does_not_tell_the_clock():
    """A tracker lost the body for 0.44 s. What it repeated is interpolated."""
    times, on_truth = 0.05 * np.arange(600), 0.01 * np.arange(3100)
    ranges = ranges_of(times, np.random.default_rng(4))
    rotation, translation = path_of(on_truth)
    truth = Truth(on_truth + 0.3, rotation, translation)
    held = np.arange(3100)
    held[1500:1544] = 1500
    frozen = Truth(truth.times, rotation[held], translation[held])
    settings = LinkSettings(tags="held")
    results = [
        calibrate.calibrate_links(recording_of(times, ranges, one), settings)
        for one in (truth, frozen)
    ]
    whole, found = (result.clock for result in results)
    assert whole is not None
    assert found is not None
    assert results[0].figures["notes"] == []
    (note,) = results[1].figures["notes"]
    assert "repeats one pose for 0.43 s from 15.0" in note or "from 14.9" in note
    assert abs(found.offset_s - whole.offset_s) < 0.2 * whole.std_s
    assert found.std_s == pytest.approx(whole.std_s, rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_position_of_an_anchor_and_a_wrong_link_are_named(seed):
    rng = np.random.default_rng(seed)
    times = 0.1 * np.arange(400)
    truth = Truth(times, *path_of(times))
    bias = 0.1 + 0.05 * rng.standard_normal((6, 4))
    ranges = ranges_of(times, rng, bias=bias, slope=0.01 * rng.standard_normal((6, 4)), late=0.03)
    recording = recording_of(times, ranges, truth)
    figures = calibrate.calibrate_links(recording).figures
    assert figures["notes"] == []
    late = ranges.copy()
    late[:, 2, 1] += 0.4
    figures = calibrate.calibrate_links(recording._replace(ranges=late)).figures
    (row,) = figures["outlying_links"]
    assert (row["anchor"], row["tag"]) == ("A2", "T1")
    assert row["offset_m"] == pytest.approx(0.4, abs=0.15)
    assert figures["misplaced_anchors"] == []
    (note,) = figures["notes"]
    assert note.startswith(
        "WARNING: the errors of some links differ from the median of all links by more than 0.3 m"
    )
    angle = rng.uniform(0, 2 * np.pi)
    move = 0.5 * np.array([np.cos(angle), np.sin(angle), 0.0])
    anchors = ANCHORS.copy()
    anchors[4] -= move
    figures = calibrate.calibrate_links(recording._replace(anchors=anchors)).figures
    (row,) = figures["misplaced_anchors"]
    assert row["anchor"] == "A4"
    np.testing.assert_allclose(row["move_m"], move, atol=0.15)
    assert {row["anchor"] for row in figures["outlying_links"]} <= {"A4"}
    assert "anchor A4 looks misplaced" in figures["notes"][-1]


@pytest.mark.parametrize("slopes", [True, False])
def test_swapped_axes_of_the_anchors_are_refused(slopes):
    times = 0.1 * np.arange(300)
    ranges = ranges_of(times, np.random.default_rng(3), noise=0.08, late=0.05, planar=True)
    recording = recording_of(times, ranges, Truth(times, *path_of(times, planar=True)))
    settings = calibrate.LinkSettings(slopes=slopes, planar=True)
    assert calibrate.calibrate_links(recording, settings).fit.noise_std_m.max() < 0.15
    swapped = recording._replace(anchors=ANCHORS[:, [1, 0, 2]])
    with pytest.raises(ValueError, match=r"ranges contradict anchors.*Check the axes"):
        calibrate.calibrate_links(swapped, settings)
    rough = ranges_of(times, np.random.default_rng(3), noise=0.9, planar=True)
    calibrate.calibrate_links(recording._replace(ranges=np.maximum(rough, 0.01)), settings)


def test_a_truth_without_heights_needs_the_height_of_the_body():
    times = 0.1 * np.arange(300)
    ranges = ranges_of(times, np.random.default_rng(4), planar=True)
    rotation, place = path_of(times, planar=True)
    truth = Truth(times, rotation, place * [1, 1, 0], planar=True)
    recording = recording_of(times, ranges, truth)
    found = calibrate.calibrate_links(recording, calibrate.LinkSettings(planar=True, height_m=1.0))
    assert np.median(found.fit.noise_std_m) == pytest.approx(0.05, rel=0.1)
    np.testing.assert_allclose(found.fit.bias_m, 0, atol=0.06)
    with pytest.raises(ValueError, match="height_m or height_offset_m must be given"):
        calibrate.calibrate_links(recording, calibrate.LinkSettings(planar=True))
    with pytest.raises(ValueError, match="height_m must be left out"):
        calibrate.LinkSettings(height_m=1.0, height_offset_m=0.5)


def test_a_table_of_links_has_a_row_of_every_link_that_is_told(tmp_path):
    bias = np.array([[0.1, 0.2], [0.3, 0.4]])
    path = tmp_path / "new" / "calibration.csv"
    calibrate.write_link_table(path, "AB", "xy", {"bias_m": bias}, bias > 0.15)
    rows = path.read_text().splitlines()
    assert rows == ["anchor,tag,bias_m", "A,y,0.200000", "B,x,0.300000", "B,y,0.400000"]


def test_spread_of_residuals_leaves_biases_out():
    rng = np.random.default_rng(1)
    times = 0.1 * np.arange(300)
    rotation, place = path_of(times)
    ranges = ranges_of(times, rng, bias=rng.normal(0, 1, (6, 4)), noise=0.05)
    places = place[:, None] + TAGS @ np.swapaxes(rotation, -1, -2)
    got = spread_of_residuals(ranges, ranges > 0, ANCHORS, places)
    assert got == pytest.approx(0.05 * 0.6745, rel=0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"truth": None}, "the recording must have truth"),
        ({"rotation": None}, "must have rotations"),
        ({"planar": True}, "set planar"),
        ({"late": 100.0}, "no range has truth"),
    ],
)
def test_what_cannot_serve_is_refused(change, message):
    times = 0.1 * np.arange(50)
    ranges = ranges_of(times, np.random.default_rng(0))
    truth = Truth(times + change.pop("late", 0.0), *path_of(times))
    truth = change.pop("truth", truth)
    recording = recording_of(times, ranges, truth and truth._replace(**change))
    with pytest.raises(ValueError, match=message):
        calibrate.calibrate_links(recording)


def test_the_command_writes_what_replay_reads(tmp_path, capsys):
    times = 0.1 * np.arange(150)
    rng = np.random.default_rng(4)
    bias = rng.normal(0.2, 0.1, (6, 4))
    ranges = ranges_of(times, rng, bias=bias, noise=0.02)
    files = recorded.files(tmp_path, ANCHORS, TAGS, times, ranges, path_of(times))
    calibrate.write_points(files["anchors"], "anchor", "012345", ANCHORS)
    arguments = recorded.options(files)
    out = tmp_path / "out"
    plot = tmp_path / "links.png"
    assert main(["calibrate", *arguments, "--out", str(out), "--plot", str(plot)]) == 0
    said = capsys.readouterr().out
    assert "Noise of a range: 0.0" in said
    assert plot.stat().st_size > 10_000
    corrected = read_recording(
        Files(
            files["ranges"],
            files["anchors"],
            out / "tags.csv",
            files["truth"],
            out / "calibration.csv",
        )
    )
    clean = ranges_of(times, rng, noise=0.0)
    assert np.abs((corrected.ranges - clean).mean(axis=0)).max() < 0.01
    assert main(["calibrate", *arguments, "--model", "node", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert len(figures["nodes"]) == 10
    assert main(["calibrate", *arguments, "--calibration", str(out / "calibration.csv")]) == 2
    assert "leave out --calibration" in capsys.readouterr().err
    assert main(["calibrate", *arguments, "--start", "ranges"]) == 2
    assert "--start must be left out with --truth" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.skipif(not LIAS.is_dir(), reason="the LIAS recording is not on this machine")
def test_a_real_recording_at_a_third_of_its_rate():
    recording = read_recording(
        Files(
            LIAS / "dynamic_fast_ranges.csv",
            LIAS / "anchors_8_14.csv",
            LIAS / "tags_8_14.csv",
            LIAS / "dynamic_fast_truth.csv",
        )
    )
    thin = recording._replace(
        times=recording.times[::3], ranges=recording.ranges[::3], links=recording.links[::3]
    )
    found = calibrate.calibrate_links(thin, LinkSettings(planar=True))
    assert found.clock is not None
    # Turns of the whole table look alike: the clock is known to some hundredths of a second.
    assert found.clock.std_s < 0.1
    assert abs(found.clock.offset_s - 0.03) < 2 * found.clock.std_s
    assert found.figures["turn"]["rotation_vector_deg"][2] == pytest.approx(7, abs=1)
    assert found.figures["noise"]["std_m"] == pytest.approx(0.058, abs=0.008)
    assert found.fit.bias_m.mean() == pytest.approx(0.12, abs=0.03)


def test_clocks_of_two_epochs_are_refused_with_the_offset():
    times = 0.1 * np.arange(100)
    ranges = ranges_of(times, np.random.default_rng(3))
    rotation, place = path_of(times)
    recording = recording_of(times + 1763550004.137, ranges, Truth(times, rotation, place))
    for told in ("auto", -1763550600.0):
        with pytest.raises(ValueError, match=r"behind by about 1763550004\.137 s, and auto .* 1 s"):
            calibrate.calibrate_links(recording, LinkSettings(time_offset=told))

"""Survey of anchors without truth: known answers, consistent covariances, unknown starts, files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym.app.cli import main
from rbl_gym.estimators.calibration.survey import Survey, SurveyModel, SurveyState, adjust
from rbl_gym.estimators.calibration.survey_start import (
    anchors_from_pairs,
    anchors_from_points,
    start_from_anchors,
)
from rbl_gym.recordings import Files, align_positions, apply_alignment, read_recording
from rbl_gym.studies import calibrate
from rbl_gym.studies.calibrate import AnchorSettings, SurveyedAnchors
from tests import recorded
from tests.helpers import ROOT

LIAS = ROOT.parent / "shared" / "data" / "lias_planar"
HALL = np.array(
    [[-5, 4, 1], [0, 4.2, 1], [5, 4, 1], [5.2, 0, 1], [5, -4, 1], [0, -4, 1], [-5, -4, 1.0]]
)
TAGS = np.array([[0.3, 0.0, 0.0], [-0.2, 0.25, 0.0], [-0.2, -0.2, 0.0]])


def simulate(rng, anchors, tags, epochs=150, noise=0.05, bias=0.0, planar=True):
    """Ranges of a body at random places, link by link."""
    place = rng.uniform([-4, -3, 0.5], [4, 3, 2.5], (epochs, 3))
    angles = rng.uniform(-np.pi, np.pi, (epochs, 3)) * ([1, 0, 0] if planar else [1, 0.3, 0.3])
    if planar:
        place[:, 2] = 0.7
    rotation = Rotation.from_euler("ZYX", angles).as_matrix()
    ranges = np.zeros((epochs, len(anchors), len(tags)))
    for m, anchor in enumerate(anchors):
        for n, tag in enumerate(tags):
            ranges[:, m, n] = np.linalg.norm(place + rotation @ tag - anchor, axis=1)
    ranges += bias + noise * rng.standard_normal(ranges.shape)
    return ranges, rotation, place


def recording_of(ranges, anchors, tags=TAGS):
    return recorded.recording(0.5 * np.arange(len(ranges)), ranges, anchors, tags)


def off(found, true):
    """Root mean square of what a rigid transform in the plane leaves."""
    onto = align_positions(found * [1, 1, 0], true * [1, 1, 0], "yaw")
    moved = apply_alignment(onto, None, found * [1, 1, 0])[1]
    return np.sqrt(((moved - true * [1, 1, 0]) ** 2).sum(axis=1).mean())


def test_covariances_are_honest_and_say_that_size_and_bias_trade_off():
    """Errors within the frame, over 20 draws: their squares by the covariance have mean 1."""
    squares, biases, sizes = [], [], []
    model = SurveyModel(planar=True, link_std_m=0.0, bias_std_m=1.0)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        ranges, rotation, place = simulate(rng, HALL, TAGS, 60, bias=0.2)
        start = SurveyState(HALL, rotation, place, 0.0, np.zeros((7, 3)))
        found = adjust(ranges, ranges > 0, TAGS, start, model)
        assert isinstance(found, Survey)
        error = np.append((found.state.anchors - HALL).ravel(), found.state.bias_m - 0.2)
        values, vectors = np.linalg.eigh(found.covariance)
        told = values > 1e-9 * values[-1]
        assert told.sum() == 2 * 7 - 3 + 1
        squares += ((vectors.T @ error)[told] ** 2 / values[told]).tolist()
        biases.append((found.state.bias_m - 0.2) / found.bias_std_m)
        centred = HALL - HALL.mean(axis=0)
        size = ((found.state.anchors - HALL) * centred).sum() / (centred**2).sum()
        sizes.append(size / found.scale_std)
        assert found.scale_bias_correlation < -0.9
    assert np.mean(squares) == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(squares)))
    for z in (biases, sizes):
        assert np.mean(np.square(z)) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 20))


@pytest.mark.parametrize("bias", [0.0, 0.25])
def test_a_plane_from_nothing(bias):
    rng = np.random.default_rng(1)
    ranges, _, _ = simulate(rng, HALL, TAGS, bias=bias)
    blank = recording_of(ranges, np.zeros((7, 3)) + [0, 0, 1])
    settings = AnchorSettings("ranges", planar=True, height_offset_m=0.3)
    found = calibrate.survey_anchors(blank, settings)
    assert isinstance(found, SurveyedAnchors)
    assert off(found.survey.state.anchors, HALL) < 0.05
    assert abs(found.survey.state.bias_m - bias) < 4 * found.survey.bias_std_m
    np.testing.assert_allclose(found.survey.state.anchors[0], [0, 0, 1], atol=1e-9)
    assert found.survey.state.anchors[1, 1] == pytest.approx(0, abs=1e-9)
    assert "size of the layout" in " ".join(found.figures["not_determined"])


def test_space_from_rough_places_with_some_known():
    rng = np.random.default_rng(2)
    anchors = rng.uniform([-5, -4, 0], [5, 4, 3], (8, 3))
    tags = rng.uniform(-0.4, 0.4, (4, 3))
    ranges, _, _ = simulate(rng, anchors, tags, planar=False, bias=0.1)
    ranges[rng.random(ranges.shape) < 0.2] = 0.0
    late = rng.random(ranges.shape) < 0.05
    ranges[late & (ranges > 0)] += 1.5
    rough = anchors + 0.3 * rng.standard_normal(anchors.shape)
    rough[:3] = anchors[:3]
    settings = AnchorSettings(known=("A0", "A1", "A2"), link_std_m=0.0)
    found = calibrate.survey_anchors(recording_of(ranges, rough, tags), settings)
    error, std = found.survey.state.anchors - anchors, found.survey.std_m
    np.testing.assert_allclose(error[:3], 0, atol=1e-6)
    assert (np.abs(error[3:]) < 4.5 * std[3:]).all()
    assert std.max() < 0.1
    assert found.figures["frame"] == "that of the known anchors"


def test_ranges_between_anchors_alone_and_beside():
    rng = np.random.default_rng(3)
    pairs = np.linalg.norm(HALL[:, None] - HALL, axis=-1)
    pairs = np.triu(pairs + 0.03 * rng.standard_normal(pairs.shape), 1)
    layout = anchors_from_pairs(pairs, planar=True)
    assert min(off(layout, HALL), off(layout * [1, -1, 1], HALL)) < 0.06
    start = SurveyState(
        HALL + 0.2 * rng.standard_normal(HALL.shape) * [1, 1, 0],
        *(np.zeros((0, 3, 3)), np.zeros((0, 3)), 0.0, np.zeros((7, 3))),
    )
    none = np.zeros((0, 7, 3))
    model = SurveyModel(planar=True, bias_std_m=0.01, link_std_m=0.0)
    alone = adjust(none, none > 0, TAGS, start, model, pairs=pairs)
    assert off(alone.state.anchors, HALL) < 0.05
    ranges, _, _ = simulate(rng, HALL, TAGS, 40)
    settings = AnchorSettings("ranges", planar=True, height_offset_m=0.3)
    blank = recording_of(ranges, np.zeros((7, 3)) + [0, 0, 1])
    both = calibrate.survey_anchors(blank, settings, pairs)
    assert off(both.survey.state.anchors, HALL) < 0.04
    without = calibrate.survey_anchors(blank, settings)
    assert both.survey.std_m.max() < without.survey.std_m.max()


def test_exact_ranges_give_the_layout_from_points():
    rng = np.random.default_rng(4)
    anchors = rng.uniform(-5, 5, (11, 3))
    points = rng.uniform(-4, 4, (60, 3))
    ranges = np.linalg.norm(points[:, None] - anchors, axis=-1) + 0.1
    layout = anchors_from_points(ranges, ranges > 0, 0.1)
    assert layout is not None
    want = np.linalg.norm(anchors[:, None] - anchors, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(layout[:, None] - layout, axis=-1), want, atol=1e-6)
    assert anchors_from_points(ranges[:, :8], ranges[:, :8] > 0, 0.1) is None


def test_poses_by_exact_ranges():
    rng = np.random.default_rng(5)
    ranges, rotation, place = simulate(rng, HALL, TAGS, 20, noise=0.0)
    state = start_from_anchors(ranges, ranges > 0, HALL, TAGS, planar=True, height_m=0.7)
    np.testing.assert_allclose(state.rotation, rotation, atol=1e-6)
    np.testing.assert_allclose(state.translation, place, atol=1e-6)


def test_what_cannot_be_surveyed_is_refused():
    rng = np.random.default_rng(6)
    ranges, _, _ = simulate(rng, HALL, TAGS, 20)
    recording = recording_of(ranges, HALL)
    with pytest.raises(ValueError, match="known must be anchors of the recording, got 'B'"):
        calibrate.survey_anchors(recording, AnchorSettings(known=("B",)))
    few = recording._replace(ranges=ranges[:, :4], links=ranges[:, :4] > 0, anchors=HALL[:4])
    with pytest.raises(ValueError, match="cannot be located without rough positions"):
        calibrate.survey_anchors(few, AnchorSettings("ranges", planar=True))
    one = recording._replace(links=recording.links & (np.arange(7) == 0)[:, None])
    with pytest.raises(ValueError, match="at least as many as the unknowns"):
        calibrate.survey_anchors(one)
    moving = recording._replace(anchors=np.broadcast_to(HALL, (20, 7, 3)))
    with pytest.raises(ValueError, match="must be fixed"):
        calibrate.survey_anchors(moving)
    with pytest.raises(ValueError, match="joins anchor 0 to the anchors"):
        anchors_from_pairs(np.kron(np.eye(2), np.array([[0, 1.0], [1, 0]])))


def test_the_command_writes_anchors_that_replay_reads(tmp_path, capsys):
    rng = np.random.default_rng(7)
    ranges, _, _ = simulate(rng, HALL, TAGS, 80, bias=0.2)
    rough = HALL + 0.2 * rng.standard_normal(HALL.shape) * [1, 1, 0]
    files = recorded.files(tmp_path, rough, TAGS, 0.5 * np.arange(80), ranges)
    pairs = tmp_path / "pairs.csv"
    apart = np.linalg.norm(HALL[0] - HALL[3])
    pairs.write_text(f"anchor_a,anchor_b,range\n0,3,{apart + 0.2}\n0,3,{apart + 0.2}\n")
    out, plot = tmp_path / "out", tmp_path / "anchors.png"
    arguments = ["calibrate", *recorded.options(files)]
    arguments += ["--planar", "--height-offset-m", "0.3", "--anchor-ranges", str(pairs)]
    assert main([*arguments, "--out", str(out), "--plot", str(plot)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "correlation of the two" in said
    assert plot.stat().st_size > 10_000
    read = read_recording(
        Files(files["ranges"], out / "anchors.csv", files["tags"], None, out / "calibration.csv")
    )
    assert off(read.anchors, HALL) < 0.06
    assert np.median(ranges - read.ranges) == pytest.approx(0.2, abs=0.08)
    assert main([*arguments, "--start", "ranges", "--known", "0,3", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert [row["known"] for row in figures["anchors"]] == [True, False, False, True] + [False] * 3
    assert main([*arguments, "--arms", "free"]) == 2
    assert "--arms needs --truth" in capsys.readouterr().err
    pairs.write_text("anchor_a,anchor_b,range\n0,9,3\n")
    assert main(arguments) == 2
    assert "unknown anchor" in capsys.readouterr().err
    pairs.write_text("anchor_a,anchor_b,range\n0,0,3\n")
    with pytest.raises(ValueError, match="another anchor"):
        calibrate.read_anchor_ranges(pairs, ("0", "1"))


@pytest.mark.skipif(not LIAS.is_dir(), reason="the LIAS recording is not on this machine")
@pytest.mark.parametrize(
    ("told", "limit"), [({}, 0.075), ({"bias_m": 0.17, "bias_std_m": 0.005}, 0.06)]
)
def test_a_real_hall_from_nothing(told, limit):
    recording = read_recording(
        Files(LIAS / "dynamic_fast_ranges.csv", LIAS / "anchors_8_14.csv", LIAS / "tags_8_14.csv")
    )
    settings = AnchorSettings("ranges", planar=True, height_offset_m=0.08, epochs=800, **told)
    found = calibrate.survey_anchors(recording, settings)
    assert off(found.survey.state.anchors, recording.anchors) <= limit
    assert found.survey.scale_bias_correlation < -0.2

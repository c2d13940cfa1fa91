"""Comparison of a replayed track with truth: positions only, other clocks and frames, gaps."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import scipy

from rbl_gym.app.figures import replay_figure
from rbl_gym.app.reports import compared, print_replay
from rbl_gym.geometry import rotations
from rbl_gym.recordings import Recording, Truth
from rbl_gym.studies import replay
from tests import recorded
from tests.recorded import CORNERS, STD_M, STD_RAD, curve, honest_track

pytest.importorskip("plotly", reason="needs the extra viz")
from rbl_gym.app import track_pages

TAGS = np.array([[0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3]])


def replayed(truth, **settings) -> tuple[Recording, Any]:
    """As `replay.replay_recording`, of a track that is given."""
    recording, track = honest_track(truth, np.arange(0, 20, 0.1), TAGS)
    chosen = replay.Settings.of(**settings)
    found = replay.track_errors(recording, track, chosen)
    figures = replay.track_figures(recording, track, found, chosen)
    return recording, replay.Replayed(chosen, track, found, figures)


TIMES = np.arange(-1, 22, 0.02)
ROTATION, PLACE = curve(TIMES)
TURN = rotations.exp([0.5, -0.4, 1.0])
SHIFT = np.array([10.0, -4.0, 2.0])


@pytest.mark.parametrize(("planar", "freedom"), [(False, 3), (True, 2)])
def test_truth_of_positions_judges_positions_alone(planar, freedom):
    truth = Truth(TIMES, None, PLACE * (1, 1, not planar), planar)
    _, result = replayed(truth)
    _, whole = replayed(Truth(TIMES, ROTATION, PLACE))
    assert result.errors.yaw is None
    assert result.errors.rotation is None
    assert result.errors.tags is None
    figures = result.figures
    assert not [name for name in figures if name.startswith(("yaw", "rotation"))]
    assert figures["position_rmse_m"] == pytest.approx(STD_M * freedom**0.5, rel=0.1)
    assert figures["position_axes"] == "xyz"[:freedom]
    # The mean of 200 epochs of 2 or 3 components: standard deviation 0.07 at most.
    assert figures["anees"] == pytest.approx(1, abs=0.25)
    assert figures["notes"] == []
    if not planar:
        assert figures["position_rmse_m"] == whole.figures["position_rmse_m"]


def test_a_heading_alone_judges_yaw_and_the_plane():
    heading = rotations.exp(rotations.yaw(ROTATION)[:, None] * (0, 0, 1.0))
    _, result = replayed(Truth(TIMES, heading, PLACE * (1, 1, 0), planar=True))
    assert result.errors.freedom == 3
    assert "rotation_rmse_deg" not in result.figures
    assert result.figures["yaw_rmse_deg"] == pytest.approx(np.rad2deg(STD_RAD), rel=0.2)
    assert result.figures["position_rmse_m"] == pytest.approx(STD_M * 2**0.5, rel=0.1)


@pytest.mark.parametrize("align", ["position", "yaw", "se3"])
@pytest.mark.parametrize("with_rotation", [True, False])
def test_a_frame_of_its_own_is_aligned(align, with_rotation):
    turn = {"position": np.eye(3), "yaw": rotations.exp([0, 0, 2.0]), "se3": TURN}[align]
    rotation = turn.T @ ROTATION if with_rotation else None
    truth = Truth(TIMES, rotation, (PLACE - SHIFT) @ turn)
    _, result = replayed(truth, align=align)
    figures = result.figures
    assert figures["position_rmse_m"] == pytest.approx(STD_M * 3**0.5, rel=0.1)
    assert figures["anees"] == pytest.approx(1, abs=0.25)
    assert figures["notes"] == []
    if with_rotation:
        assert figures["rotation_rmse_deg"] == pytest.approx(np.rad2deg(STD_RAD) * 3**0.5, rel=0.1)
    found = figures["alignment"]
    np.testing.assert_allclose(found["translation_m"], SHIFT, atol=0.1)
    np.testing.assert_allclose(
        np.deg2rad(found["rotation_vector_deg"]), rotations.log(turn), atol=0.02
    )
    assert found["turn_deg"] == pytest.approx(np.linalg.norm(found["rotation_vector_deg"]))
    assert f"aligned ({align})" in compared(figures)[-1]
    # Without it the frame is hinted at, and the way out.
    notes = replayed(truth)[1].figures["notes"]
    assert any("world frame" in note and "see --align" in note for note in notes)


def test_a_wrong_window_is_left_out_and_counted():
    wrong = PLACE + ((TIMES > 6.35) & (TIMES < 7.35))[:, None] * (0.8, 0, 0)
    truth = Truth(TIMES, ROTATION, wrong)
    _, with_it = replayed(truth)
    assert with_it.figures["position_rmse_m"] > 0.15
    _, result = replayed(truth, truth_exclude=[(6.35, 7.35), (12, 12.55)])
    figures = result.figures
    assert figures["epochs_excluded"] == 16
    assert figures["epochs_with_truth"] == 184
    assert figures["position_rmse_m"] == pytest.approx(STD_M * 3**0.5, rel=0.1)
    assert "16 further epochs are excluded" in compared(figures)[1]
    with pytest.raises(
        ValueError, match="truth_exclude must leave an epoch with truth, but excludes all 200"
    ):
        replayed(truth, truth_exclude=[(-5, 100)])


def test_a_clock_that_is_ahead():
    truth = Truth(TIMES + 1.4e9, ROTATION, PLACE)
    with pytest.raises(ValueError, match=r"ahead by about 1399999999 s: see --time-offset"):
        replayed(truth)
    _, result = replayed(truth, time_offset=1.4e9)
    assert result.figures["position_rmse_m"] == pytest.approx(STD_M * 3**0.5, rel=0.1)
    assert compared(result.figures)[1] == "the truth's clock is ahead by 1400000000 s (time_offset)"


def test_a_suggested_offset_includes_the_given_one():
    """Milliseconds are kept beside ten digits of seconds; the suggested value works as it is."""
    ahead = -1763550004.137
    truth = Truth(TIMES + ahead, ROTATION, PLACE)
    with pytest.raises(ValueError, match="see --time-offset") as refused:
        replayed(truth, time_offset=ahead - 600)
    found = re.search(r"behind by about (\S+) s: see --time-offset \((\S+), or", str(refused.value))
    assert found
    assert found[2] == "-" + found[1]
    assert float(found[2]) == pytest.approx(ahead - 1, abs=0.002)  # the truth starts 1 s earlier
    _, result = replayed(truth, time_offset=float(found[2]) + 1)
    assert result.figures["position_rmse_m"] == pytest.approx(STD_M * 3**0.5, rel=0.1)
    line = compared(result.figures)[1]
    assert line == "the truth's clock is ahead by -1763550004.137 s (time_offset)"
    (note,) = replayed(truth, time_offset=ahead - 0.4)[1].figures["notes"]
    assert re.search(r"0\.(35|40|45) s ahead; see --time-offset -1763550004\.(09|14|19)", note), (
        note
    )


@pytest.mark.parametrize("align", ["none", "se3"])
@pytest.mark.parametrize("ahead_s", [0.35, 1.4e9])
@pytest.mark.parametrize("with_rotation", [True, False])
def test_a_clock_is_found_by_the_motion(align, ahead_s, with_rotation):
    R = TURN if align == "se3" else np.eye(3)
    truth = Truth(TIMES + ahead_s, R @ ROTATION if with_rotation else None, PLACE @ R.T)
    recording, track = honest_track(truth, np.arange(0, 20, 0.1), TAGS)
    chosen = replay.Settings.of(time_offset="auto", align=align)
    found = replay.find_offset(recording, track, chosen)
    assert found is not None
    assert abs(found.offset_s - ahead_s) < 4 * found.std_s
    assert found.std_s < 0.03
    errors = replay.track_errors(recording, track, chosen)
    assert errors is not None
    assert errors.nees[errors.known].mean() / errors.freedom == pytest.approx(1, abs=0.4)


def recorded_run(truth):
    """A recording of the curve with three tags, 12 s."""
    rng = np.random.default_rng(0)
    times = np.arange(0, 12, 0.1)
    rotation, place = curve(times)
    anchors = np.concatenate([CORNERS, [[4, 4, 3.5], [1, 6, 0.5]]])
    tags = (rotation @ TAGS.T).swapaxes(1, 2) + place[:, None]
    ranges = np.linalg.norm(anchors[:, None] - tags[:, None], axis=-1)
    ranges = ranges + 0.03 * rng.standard_normal(ranges.shape)
    return recorded.recording(times, ranges, anchors, TAGS, truth)


def test_an_offset_of_motions_that_hardly_agree_is_doubted():
    rng = np.random.default_rng(4)
    poor = PLACE + 1.5 * scipy.ndimage.gaussian_filter1d(rng.standard_normal(PLACE.shape), 6, 0)
    for place, doubted in ((PLACE, False), (poor, True)):
        settings = replay.Settings.of(range_std_m=0.1, time_offset="auto")
        recording = recorded_run(Truth(TIMES + 0.4, None, place))
        figures = replay.replay_recording(recording, settings).figures
        assert (figures["time_offset"]["correlation"] < 0.9) == doubted
        assert any("time offset" in n and "unreliable" in n for n in figures["notes"]) == doubted


def test_a_run_finds_the_clock_by_its_own_track():
    """Of a smoothed track, which does not lag."""
    recording = recorded_run(Truth(TIMES + 0.4, None, PLACE))
    off = {}
    for smooth in (False, True):
        settings = replay.Settings.of(walk_m=0.1, walk_deg=15, range_std_m=0.1, robust=False,
                                      time_offset="auto", smooth=smooth)  # fmt: skip
        found = replay.replay_recording(recording, settings).figures["time_offset"]
        assert found["track"] == ("smoothed" if smooth else "causal")
        off[smooth] = found["offset_s"] - 0.4
        assert found["std_s"] < 0.05
    # The filter takes ranges for worse than they are, and lags by a tenth of a second.
    assert -0.2 < off[False] < -0.06
    assert abs(off[True]) < 0.02


def test_what_cannot_be_compared_is_said():
    still = Truth(TIMES, None, np.zeros((len(TIMES), 3)))
    with pytest.raises(ValueError, match=r"time_offset 'auto': .*give it in seconds"):
        replayed(still, time_offset="auto")
    with pytest.raises(ValueError, match=r"align 'se3': the .* positions do not determine"):
        replayed(still, align="se3")
    with pytest.raises(ValueError, match="align 'se3': planar motion has no heights"):
        replayed(Truth(TIMES, ROTATION, PLACE), align="se3", planar=True, height_offset_m=0.0)
    for options, message in (
        ({"align": "sim3"}, "align must be one of"),
        ({"time_offset": "now"}, "time_offset must be"),
        ({"truth_exclude": [(3, 2)]}, "truth_exclude must be pairs of start and end"),
        ({"truth_exclude": [3]}, "truth_exclude must be pairs of start and end"),
    ):
        with pytest.raises(ValueError, match=message):
            replay.Settings.of(**options)


@pytest.mark.parametrize("planar", [False, True])
def test_table_picture_and_page_without_rotations(planar, capsys):
    pytest.importorskip("plotly")
    truth = Truth(TIMES + 0.5, None, PLACE * (1, 1, not planar) + (5, 0, 0), planar)
    recording, result = replayed(truth, align="position", time_offset=0.5)
    print_replay(result.figures)
    text = capsys.readouterr().out
    assert "position xy" in text
    assert "yaw" not in text
    figure = replay_figure(recording, result)
    line: Any = figure.axes[0].lines[1]
    # The path of the truth is drawn where it was aligned to.
    np.testing.assert_allclose(line.get_xdata()[0], 3, atol=0.1)
    html = track_pages.replay_page(recording, result)
    assert "aligned (position)" in html
    path = replay.truth_path(recording, result.track, result.settings)
    np.testing.assert_allclose(path[:, :2], line.get_xydata())
    reference = replay.truth_of(recording, result.track, result.settings)
    assert isinstance(reference, replay.Reference)
    assert reference.turn_axes == []

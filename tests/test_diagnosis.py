"""Diagnosis of a filter that does not fit its data: inserted faults are named, good logs pass."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from rbl_gym.app import consistency, figures, reports
from rbl_gym.estimators import Innovations
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.studies import replay
from rbl_gym.studies.epochs import Reading, track_epochs
from rbl_gym.studies.groups import innovations_of
from rbl_gym.studies.replay.tracking import start_of
from tests import recorded
from tests.helpers import with_kernels

ANCHORS = np.array(
    [[0, 0, 2.5], [10, 0, 0.5], [10, 8, 3], [0, 8, 0.4], [4, 3, 3], [7, 6, 2.8], [2, 7, 1.2]],
    dtype=float,
)
TAGS = np.array([[0.4, 0, 0], [-0.3, 0.3, 0.1], [0, -0.4, 0.2], [0.1, 0.1, -0.35], [-0.2, -0.2, 0]])
SETTINGS = replay.Settings.of(range_std_m=0.1, walk_m=0.3, walk_deg=17.0)


def walked(seed: int, logs: int = 1, epochs: int = 70, planar: bool = False):
    """Ranges (logs, epochs, M, N) of bodies that walk as the settings say."""
    rng = np.random.default_rng(seed)
    std = np.array([0, 0, 0.3, 0.3, 0.3, 0] if planar else [0.3] * 6)
    moves = np.sqrt(0.1) * rng.standard_normal((logs, epochs, 6)) * std
    rotation = np.empty((logs, epochs, 3, 3))
    rotation[:, 0] = np.eye(3)
    for k in range(1, epochs):
        rotation[:, k] = rotations.exp(moves[:, k, :3]) @ rotation[:, k - 1]
    translation = np.array([5.0, 4.0, 1.5]) + np.cumsum(moves[..., 3:], axis=1)
    true = ranging.distances(ANCHORS, ranging.tag_positions(rotation, translation, TAGS))
    return true + 0.1 * rng.standard_normal(true.shape)


def recording(ranges, anchors=ANCHORS, tags=TAGS):
    return recorded.recording(0.1 * np.arange(len(ranges)), ranges, anchors, tags)


RANGES = walked(1)[0]


def only(anchor: int | slice = slice(None), tag: int | slice = slice(None)):
    mask = np.zeros((7, 5))
    mask[anchor, tag] = 1.0
    return mask


FAULTS = {
    "nothing": (None, recording(RANGES), {}),
    "walk": ("walk", recording(RANGES), {"walk_m": 0.02, "walk_deg": 1.0}),
    "law of an unknown twist": (
        "acceleration",
        recording(RANGES),
        {"filter": "iekf-cv", "walk_m": 0, "walk_deg": 0, "accel_m": 0.01, "accel_deg": 0.5},
    ),
    "deviation": ("range-std", recording(RANGES), {"range_std_m": 0.03}),
    "two anchors": ("anchors-swapped", recording(RANGES[:, [0, 4, 2, 3, 1, 5, 6]]), {}),
    "two tags": ("tags-swapped", recording(RANGES[..., [3, 1, 2, 0, 4]]), {}),
    "x and y": ("mirrored", recording(RANGES, ANCHORS[:, [1, 0, 2]]), {}),
    "an anchor": (
        "anchor-moved",
        recording(RANGES, ANCHORS + only(2)[:, :1] * [0.8, -0.5, 0.3]),
        {},
    ),
    "an anchor's ranges, while the noise is assumed too large": (
        "anchor-bias",
        recording(RANGES + 0.8 * only(3)),
        {"range_std_m": 0.25},
    ),
    "ranges there and back": ("units", recording(2 * RANGES), {}),
    "all ranges": ("common-bias", recording(RANGES + 0.4), {}),
    "an anchor's ranges": ("anchor-bias", recording(RANGES + 0.5 * only(3)), {}),
    "a tag's ranges": ("tag-bias", recording(RANGES + 0.4 * only(tag=2)), {}),
    "a link": ("link-bias", recording(RANGES + 0.8 * only(3, 1)), {}),
    "feet": ("units", recording(RANGES / 0.3048), {}),
    "tags in feet": ("units", recording(RANGES, tags=TAGS / 0.3048), {}),
    "late ranges": (
        "outliers",
        recording(RANGES + 4.0 * (np.random.default_rng(2).random(RANGES.shape) < 0.04)),
        {"robust": False},
    ),
}
WORDS = {
    "two anchors": "anchors A1 and A4 look swapped",
    "two tags": "tags T0 and T3 look swapped",
    "x and y": "x and y of the anchors look swapped",
    "all ranges": "all ranges look 0.40 m too long",
    "an anchor's ranges": "the ranges of anchor A3 look 0.5",
    "a tag's ranges": "the ranges of tag T2 look 0.4",
    "a link": "the ranges from anchor A3 to tag T1 look 0.8",
    "an anchor": "anchor A2 looks misplaced",
    "deviation": "try --range-std-m 0.1",
    "walk": "try --walk-m 0.3 --walk-deg 20",
}


@with_kernels
@pytest.mark.parametrize("fault", FAULTS)
def test_the_fault_put_in_is_named(fault):
    kind, log, changed = FAULTS[fault]
    replayed = replay.replay_recording(log, SETTINGS.changed(**changed))
    found, notes = replayed.figures["consistency"], replayed.figures["notes"]
    assert found["contradicts"] == (kind is not None)
    assert [cause["kind"] for cause in found["causes"]] == [kind] * (kind is not None)
    if kind is None:
        assert notes == []
        assert found["nis_per_dof"] == pytest.approx(1.0, abs=0.1)
        return
    cause = found["causes"][0]
    assert cause["mended"] > 0.8
    assert 0.4 < cause["nis_per_dof"] < 1.6
    assert WORDS.get(fault, "") in cause["text"]
    # Ranges far too long for the room may fit a mirror pose as well.
    whole = found["nis_per_dof"] > 1.5 or found["rejected_share"] > 0.2
    subject = "the filter does not fit its data" if whole else "a part of the ranges does not fit"
    assert notes[-1].startswith(f"WARNING: {subject}")
    assert cause["text"] in notes[-1]


@pytest.mark.parametrize("fault", ["deviation", "two anchors"])
def test_a_short_log_tells_a_fault_of_settings_and_one_of_files(fault):
    kind, log, changed = FAULTS[fault]
    log = log._replace(times=log.times[:25], ranges=log.ranges[:25], links=log.links[:25])
    figures = replay.replay_recording(log, SETTINGS.changed(**changed)).figures
    assert [cause["kind"] for cause in figures["consistency"]["causes"]] == [kind]
    assert figures["consistency"]["causes"][0]["mended"] > 0.9


@with_kernels
def test_a_symmetric_body_may_have_two_swapped_tags_or_mirrored_anchors():
    tags = np.array([[0.4, 0, 0], [-0.3, 0.3, 0.1], [-0.3, -0.3, 0.1]])
    rng = np.random.default_rng(8)
    turn = rotations.exp(np.linspace(0, 3, 70)[:, None] * [0, 0, 1.0])
    place = np.array([5.0, 4, 0]) + np.linspace(-2, 2, 70)[:, None] * [1, 0.5, 0]
    true = ranging.distances(ANCHORS, ranging.tag_positions(turn, place, tags))
    ranges = true + 0.1 * rng.standard_normal(true.shape)
    log = recording(ranges, ANCHORS[:, [1, 0, 2]], tags)
    settings = SETTINGS.changed(planar=True, height_m=0.0, walk_deg=60.0, walk_m=0.6)
    (cause,) = replay.replay_recording(log, settings).figures["consistency"]["causes"]
    assert cause["kind"] in ("mirrored", "tags-swapped")
    assert "x and y of the anchors look swapped" in cause["text"]
    assert "; or tags T1 and T2 look swapped" in cause["text"]


@with_kernels
def test_two_faults_are_both_named():
    log = recording(RANGES[:, [0, 4, 2, 3, 1, 5, 6]])
    settings = SETTINGS.changed(range_std_m=0.04)
    found = replay.track_recording(log, settings).innovations
    assert found is not None
    causes = replay.likely_causes(log, settings, found)
    assert all(isinstance(cause, replay.Cause) for cause in causes)
    assert [cause.kind for cause in causes] == ["anchors-swapped", "range-std"]


@with_kernels
def test_the_height_of_a_planar_body():
    log = recording(walked(3, planar=True)[0])
    # The tags' mean height is 1.49 m, the anchors' 1.91 m.
    known = SETTINGS.changed(planar=True, height_offset_m=0.42)
    found = replay.replay_recording(log, known).figures["consistency"]
    assert not found["contradicts"]
    found = replay.replay_recording(log, known.changed(height_offset_m=0.0)).figures["consistency"]
    assert [cause["kind"] for cause in found["causes"]] == ["height"]
    assert "--height-offset-m=0.4" in found["causes"][0]["text"]
    # The same said by the height of the body's origin.
    offset = float(log.anchors[:, 2].mean() - log.tags[:, 2].mean())
    held = SETTINGS.changed(planar=True, height_m=offset)
    found = replay.replay_recording(log, held).figures["consistency"]
    assert [cause["kind"] for cause in found["causes"]] == ["height"]
    named = re.search(r"--height-m=([\d.]+)", found["causes"][0]["text"])
    assert named is not None
    assert float(named[1]) == pytest.approx(offset - 0.42, abs=0.05)


@with_kernels
def test_noise_that_nothing_explains_has_no_cause():
    """Each epoch of another place and body: no fault makes sense of that."""
    log = recording(np.random.default_rng(5).uniform(1, 9, RANGES.shape))
    figures = replay.replay_recording(log, SETTINGS).figures
    assert figures["consistency"]["contradicts"]
    assert all(cause["kind"] == "range-std" for cause in figures["consistency"]["causes"])


@with_kernels
def test_honest_logs_are_not_doubted():
    """None of two hundred logs that are as the filter believes is said to contradict it."""
    ranges = walked(7, logs=200, epochs=40)
    logs = [recording(r) for r in ranges]
    filter = replay.recording_filter(logs[0], SETTINGS)
    Q, t, P = (np.broadcast_to(a, (200, *a.shape)) for a in start_of(logs[0], SETTINGS))
    readings = (
        Reading(ranges[:, k], ANCHORS, twist=np.zeros(6) if k else None, dt=0.1) for k in range(40)
    )
    steps = track_epochs(filter, (Q, t, P), readings)
    noise = ranging.RangeNoise(0.1)
    each = [found for _, found in innovations_of(filter, steps, TAGS, noise)]
    columns = [np.concatenate(column).swapaxes(0, 1) for column in zip(*each, strict=True)]
    doubted = [
        replay.contradicts(Innovations(*(column[b] for column in columns)), logs[b])
        for b in range(200)
    ]
    assert sum(doubted) == 0


@with_kernels
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_an_anchor_that_the_biases_of_the_filter_absorb_is_named(seed):
    """0.5 m away in any horizontal direction. The innovations look sound."""
    rng = np.random.default_rng(seed)
    times = 0.1 * np.arange(250)
    phase = rng.uniform(0, 2 * np.pi, 3)
    place = np.array([5.0, 4, 1.5]) + np.stack(
        [3 * np.sin(0.5 * times + phase[0]), 2.4 * np.sin(0.37 * times + phase[1]), 0 * times], -1
    )
    turn = rotations.exp((0.6 * times + np.sin(times + phase[2]))[:, None] * [0, 0, 1.0])
    true = ranging.distances(ANCHORS, ranging.tag_positions(turn, place, TAGS))
    ranges = true + 0.05 * rng.standard_normal((7, 5)) + 0.08 * rng.standard_normal(true.shape)
    log = recorded.recording(times, ranges, ANCHORS, TAGS)
    settings = replay.Settings.of(start=(*place[0], 30.0), tilt_std_deg=5.0)
    assert not any(
        "misplaced" in x for x in replay.replay_recording(log, settings).figures["notes"]
    )
    angle, m = rng.uniform(0, 2 * np.pi), int(rng.integers(7))
    move = 0.5 * np.array([np.cos(angle), np.sin(angle), 0])
    anchors = ANCHORS.copy()
    anchors[m] -= move
    figures = replay.replay_recording(log._replace(anchors=anchors), settings).figures
    assert not figures["consistency"]["contradicts"]
    (note,) = [note for note in figures["notes"] if "misplaced" in note]
    found = re.search(r"^WARNING: anchor A(\d) looks misplaced: .* moved by \((.*)\) m", note)
    assert found is not None
    assert int(found[1]) == m
    named = np.array([float(x) for x in found[2].split(",")])
    # The tags move little in height.
    assert (np.abs(named - move) < [0.15, 0.15, 0.4]).all()


def test_the_constant_biases_of_a_track_are_those_of_the_links():
    rng = np.random.default_rng(3)
    bias = 0.1 * rng.standard_normal((7, 5))
    settings = SETTINGS.changed(filter="iekf-log", range_std_m=0.1)
    found: Any = replay.track_recording(recording(RANGES + bias), settings).biases
    off = (found.mean_m - bias).ravel()
    off, std = off - off.mean(), np.sqrt(np.diag(found.covariance))
    assert np.abs(off).mean() < 0.6 * np.abs(bias - bias.mean()).mean()
    # The biases are drawn from twice the law.
    assert np.sqrt(np.mean((off / std) ** 2)) < 2.5
    assert replay.track_recording(recording(RANGES), SETTINGS).biases is None


def test_residuals_by_anchor_tag_and_link():
    log = recording(RANGES + 0.8 * only(3, 1))
    lost = log.links.copy()
    lost[:, 6] = False
    lost[:40, 0, 0] = False
    log = log._replace(links=lost)
    track = replay.track_recording(log, SETTINGS)
    found = track.innovations
    assert found is not None
    tables = replay.residual_tables(found, log)
    assert [row["anchor"] for row in tables["anchors"]] == [f"A{m}" for m in range(6)]
    assert len(tables["tags"]) == 5
    assert len(tables["links"]) == 30
    first = tables["links"][0]
    here = found.residual[40:, 0, 0]
    assert first["ranges"] == 30
    assert first["mean_m"] == pytest.approx(here[found.used[40:, 0, 0]].mean())
    assert first["spread_m"] == pytest.approx(0.1, rel=0.4)
    late = next(row for row in tables["links"] if (row["anchor"], row["tag"]) == ("A3", "T1"))
    assert late["rejected_share"] == 1.0
    assert late["mean_m"] is None
    assert sum(row["ranges"] for row in tables["links"]) == lost.sum()
    when, ratio, low, high = replay.nis_curve(log.times, found, points=10)
    assert len(when) == len(ratio) == 10
    assert when[0] == pytest.approx(log.times[:7].mean())
    assert ratio[3] == pytest.approx(found.nis[21:28].sum() / found.dof[21:28].sum())
    assert ((low < 1) & (high > 1)).all()


@with_kernels
def test_the_page_and_the_picture_show_what_the_figures_say(capsys):
    pytest.importorskip("plotly")
    from rbl_gym.app import track_pages

    _, log, changed = FAULTS["a link"]
    lost = log.links.copy()
    lost[:, 6, 4] = False
    log = log._replace(links=lost, times=log.times + 1.7e9)
    replayed = replay.replay_recording(log, SETTINGS.changed(**changed))
    chart = consistency._charts(replayed)
    mean, refused = (trace for trace in chart.data if trace.type == "heatmap")
    links = replayed.figures["consistency"]["residuals"]["links"]
    assert refused.z[3][1] == pytest.approx(100.0)
    assert np.isnan(mean.z[6][4])
    assert np.isnan(mean.z[3][1])
    assert mean.z[0][2] == next(
        row["mean_m"] for row in links if (row["anchor"], row["tag"]) == ("A0", "T2")
    )
    html = track_pages.replay_page(log, replayed)
    for heading in (
        "likely causes",
        "residuals of anchors",
        "residuals of tags",
        "residuals of links",
    ):
        assert f"<h2>{heading}</h2>" in html
    assert "the ranges from anchor A3 to tag T1 look 0.8" in html
    axes = figures.replay_figure(log, replayed).axes[-1]
    assert axes.get_ylabel() == "NIS / dof"
    # Clock times are drawn since the start of the log.
    since = log.times - log.times[0]
    np.testing.assert_allclose(np.asarray(axes.lines[0].get_xdata()), since, atol=1e-6)
    line = [trace for trace in chart.data if trace.type == "scatter"][-1]
    assert 0 <= min(line.x) < max(line.x) <= since[-1]
    found = replayed.track.innovations
    assert found is not None
    np.testing.assert_allclose(np.asarray(axes.lines[0].get_ydata()), found.nis / found.dof)
    reports.print_replay(replayed.figures)
    out = capsys.readouterr().out
    assert "anchor A3" in out
    assert "20.0" in out


@with_kernels
def test_a_wrong_height_that_the_biases_of_the_filter_absorb_is_named():
    """A planar body, 0.5 m lower than told: no anchor is blamed, and a right height passes."""
    rng = np.random.default_rng(4)
    times = 0.1 * np.arange(200)
    place = np.array([5.0, 4, 1.0]) + np.stack(
        [3 * np.sin(0.5 * times), 2.4 * np.sin(0.37 * times), 0 * times], -1
    )
    turn = rotations.exp((0.6 * times)[:, None] * [0, 0, 1.0])
    true = ranging.distances(ANCHORS, ranging.tag_positions(turn, place, TAGS))
    log = recorded.recording(times, true + 0.08 * rng.standard_normal(true.shape), ANCHORS, TAGS)
    for height_m, named in ((1.5, True), (1.0, False)):
        settings = replay.Settings.of(planar=True, height_m=height_m)
        notes = replay.replay_recording(log, settings).figures["notes"]
        warnings = [note for note in notes if note.startswith("WARNING")]
        assert len(warnings) == named, warnings
        if named:
            found = re.search(r"another height: try --height-m=(\S+)\. The filter", warnings[0])
            assert found, warnings
            assert float(found[1]) == pytest.approx(1.0, abs=0.15)


def test_the_tuning_says_why_it_used_no_more_epochs():
    found = {"epochs": 3000, "seconds": 27.5, "options": "--filter iekf"}
    found |= {"log_likelihood": 1.0, "log_likelihood_before": 0.5}
    text = consistency.tuned_text(found)
    assert text.startswith("tuned on 3000 epochs (the most that are used) of the first 27.5 s: --f")
    assert "most" not in consistency.tuned_text(found | {"epochs": 2999})

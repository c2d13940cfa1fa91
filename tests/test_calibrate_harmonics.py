"""Bias by the direction of the ray from a log with truth: known patterns, no bias, the command."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym.app.cli import main
from rbl_gym.estimators.calibration import KnownPath
from rbl_gym.estimators.calibration.harmonics import (
    Candidate,
    FoundDirections,
    candidates_of,
    fit_harmonics,
)
from rbl_gym.measurements.direction_bias import DirectionLaw, direction_bias
from rbl_gym.recordings import InertialLog, Truth, read_directions
from rbl_gym.studies import calibrate
from rbl_gym.studies.calibrate import LinkSettings
from tests import recorded
from tests.helpers import with_kernels
from tests.test_calibrate_links import ANCHORS, TAGS, path_of, ranges_of, recording_of

TIMES = 0.1 * np.arange(400)
ANGLES = np.pi / 3 * np.arange(6)


def pattern(rng, tags=TAGS):
    """A second and a third harmonic of every tag by itself."""
    field = 0.06 * rng.standard_normal((len(tags), 6)) * [0, 0, 1, 1, 0.3, 0.3]
    return DirectionLaw.of(np.zeros((len(ANCHORS), 0)), field)


def with_pattern(rng, law, noise=0.05):
    ranges = ranges_of(TIMES, rng, bias=0.1, noise=noise, planar=True)
    rotation, place = path_of(TIMES, planar=True)
    return ranges + direction_bias(law, rotation, place, ANCHORS, TAGS).bias, rotation, place


def test_patterns_of_tags_are_found_and_taken_off():
    rng = np.random.default_rng(0)
    law = pattern(rng)
    ranges, rotation, place = with_pattern(rng, law)
    recording = recording_of(TIMES, ranges, Truth(TIMES, rotation, place))
    cases: tuple[dict[str, Any], ...] = {}, {"harmonics": 4}
    plain, found = (
        calibrate.calibrate_links(recording, LinkSettings(planar=True, time_offset=0.0, **more))
        for more in cases
    )
    assert isinstance(found.directions, FoundDirections)
    assert found.directions.bias.harmonics >= 3
    assert not found.directions.bias.shared
    np.testing.assert_allclose(found.directions.law.tags[:, 2:6], law.tags[:, 2:], atol=0.012)
    assert np.median(plain.fit.noise_std_m) > 0.06
    assert np.median(found.fit.noise_std_m) == pytest.approx(0.05, rel=0.06)
    json.dumps(found.figures, allow_nan=False)


def test_no_harmonic_is_taken_where_there_is_none():
    rng = np.random.default_rng(1)
    ranges, rotation, place = with_pattern(rng, DirectionLaw.of(np.zeros((6, 0)), np.zeros((4, 2))))
    path = KnownPath(TIMES, rotation, place)
    d = np.linalg.norm(
        (place[:, None] + TAGS @ np.swapaxes(rotation, 1, 2))[:, None] - ANCHORS[:, None], axis=-1
    )
    told = (ranges - d, ranges > 0, ANCHORS, TAGS, path)
    for ends in ("tags", "both"):
        found = fit_harmonics(*told, candidates_of(3, ends))
        assert found.bias == Candidate(0, ends, True)
        assert found.law.tags.shape[1] == 2 * found.deviation.harmonics


def test_one_law_of_all_antennas_at_both_ends_and_deviations():
    """Bearings count from where the antenna points; the deviation doubles on one side."""
    rng = np.random.default_rng(2)
    ring = 0.3 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), 0 * ANGLES])
    yaw, bearing = rng.uniform(-np.pi, np.pi, (2, 500))
    away = rng.uniform(2, 6, 500)
    place = np.column_stack([away * np.cos(bearing), away * np.sin(bearing), 0 * yaw])
    rotation = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    turned = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
    law = DirectionLaw.of(0.05 * turned, -0.08 * turned, 0 * turned, 0.5 * turned)
    found = direction_bias(law, rotation, place, ring, ring)
    residuals = found.bias + 0.04 * np.exp(found.log_std) * rng.standard_normal(found.bias.shape)
    there = np.ones(residuals.shape, dtype=bool)
    path = KnownPath(np.arange(500.0), rotation, place)
    got = fit_harmonics(residuals, there, ring, ring, path, candidates_of(2, "both"))
    assert got.bias == Candidate(1, "both", True)
    assert got.deviation.harmonics
    np.testing.assert_allclose(got.law.anchors[:, :2], law.anchors, atol=0.006)
    np.testing.assert_allclose(got.law.tags[:, :2], law.tags, atol=0.006)
    np.testing.assert_allclose(got.law.tags_log_std[:, :2], law.tags_log_std, atol=0.12)


def test_tags_found_by_themselves_are_no_better_known_than_the_patterns_allow():
    rng = np.random.default_rng(3)
    for law, least in ((pattern(rng), 0.02), (None, 0.0)):
        ranges, rotation, place = with_pattern(
            rng, DirectionLaw.of(np.zeros((6, 0)), np.zeros((4, 2))) if law is None else law
        )
        recording = recording_of(TIMES, ranges, Truth(TIMES, rotation, place))
        settings = LinkSettings(planar=True, tags="free", time_offset=0.0)
        found = calibrate.calibrate_links(recording, settings)
        std = found.fit.tags_std_m[:, :2]
        assert (std >= least).all()
        if law is None:
            assert std.max() < 0.012
        else:
            assert "a shift of the tag" in " ".join(found.figures["not_determined"])


@with_kernels
@pytest.mark.usefixtures("no_search_for_causes")
def test_the_command_writes_directions_that_replay_reads(tmp_path, capsys):
    rng = np.random.default_rng(4)
    law = pattern(rng)
    ranges, rotation, place = with_pattern(rng, law, noise=0.02)
    files = recorded.files(tmp_path, ANCHORS, TAGS, TIMES, ranges, (rotation, place))
    logs = recorded.options(files)
    out, plot = tmp_path / "out", tmp_path / "links.png"
    how = ["--planar", "--arms", "held", "--harmonics", "3", "--time-offset", "0"]
    assert main(["calibrate", *logs, *how, "--out", str(out), "--plot", str(plot)]) == 0
    assert "harmonics at the tags, separate for each antenna" in capsys.readouterr().out
    assert plot.stat().st_size > 10_000
    got = read_directions(out / "directions.csv", (tuple("012345"), tuple("0123")))
    np.testing.assert_allclose(got.tags[:, 2:], law.tags[:, 2:], atol=0.012)
    # A part of the log tells as much of the bearing as the whole.
    lines = (tmp_path / "ranges.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (tmp_path / "ranges.csv").write_text("".join(lines[:121]), encoding="utf-8")
    errors = []
    height = ANCHORS[:, 2].mean() - 1 - TAGS[:, 2].mean()
    logs += ["--height-offset-m", f"{height:.4f}", "--filter", "iekf-bias"]
    calibration = ["--calibration", str(out / "calibration.csv")]
    for more in ([], ["--directions", str(out / "directions.csv")]):
        assert main(["replay", *logs, "--planar", *calibration, *more, "--json"]) == 0
        errors.append(json.loads(capsys.readouterr().out)["yaw_rmse_deg"])
    assert errors[1] < 0.7 * errors[0]
    wrong = ["--filter", "iekf", "--directions", str(out / "directions.csv")]
    assert main(["replay", *logs, "--planar", *wrong]) == 2
    assert "directions needs one of the filters iekf-log" in capsys.readouterr().err
    assert main(["calibrate", *logs[:8], *wrong[2:]]) == 2
    assert "leave out --directions" in capsys.readouterr().err


def test_the_clock_of_a_gyroscope_with_a_bias():
    """A body that turns slowly: the bias changes the lengths of the rates as much as the clock."""
    often = 0.02 * np.arange(2000)
    fine = 0.01 * np.arange(-50, 4050)
    path = Rotation.from_matrix(path_of(fine)[0])
    body = (path[:-1].inv() * path[1:]).as_rotvec() / 0.01
    turn = Rotation.from_rotvec([0.3, -2.0, 0.5]).as_matrix()
    readings = np.concatenate([body @ turn + 0.01, np.zeros_like(body)], axis=1)
    log = InertialLog(fine[:-1] + 0.005 + 0.7, readings)
    found = calibrate.calibrate_inertial(log, Truth(often, *path_of(often)))
    assert found.clock.offset_s == pytest.approx(0.7, abs=0.01)
    assert np.degrees(Rotation.from_matrix(found.turn.rotation @ turn.T).magnitude()) < 0.5

"""Tuning of settings by the likelihood of the first part of a log."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rbl_gym.app import cli
from rbl_gym.recordings import Truth
from rbl_gym.studies import replay
from tests import recorded
from tests.helpers import with_kernels
from tests.test_diagnosis import ANCHORS, RANGES, SETTINGS, TAGS, recording

DEFAULTS = replay.Settings("iekf")


@with_kernels
def test_the_settings_that_made_a_log_are_found():
    """From the defaults: 0.12 m, 0.1 m and 7 degrees; the log has 0.1 m, 0.3 m, 17 degrees."""
    tuned = replay.tune(recording(RANGES), DEFAULTS)
    # Two hundred steps of the motion and 2,400 ranges: some per cent, and 1 % of the deviation.
    assert tuned.found == {
        "range_std_m": pytest.approx(0.1, rel=0.05),
        "walk_m": pytest.approx(0.3, rel=0.25),
        "walk_deg": pytest.approx(17.2, rel=0.25),
    }
    assert isinstance(tuned, replay.Tuned)
    assert tuned.settings == DEFAULTS.changed(**tuned.found)
    assert tuned.log_likelihood > tuned.log_likelihood_before
    assert tuned.epochs == 70
    assert tuned.seconds == pytest.approx(6.9)
    figures = replay.replay_recording(recording(RANGES), tuned.settings).figures
    assert figures["consistency"]["nis_per_dof"] == pytest.approx(1.0, abs=0.1)
    assert figures["consistency"]["log_likelihood"] == pytest.approx(tuned.log_likelihood, abs=1e-3)


@with_kernels
def test_only_the_first_part_is_looked_at_and_never_the_truth():
    log = recording(RANGES)
    spoiled = RANGES.copy()
    spoiled[40:] += 3.0
    truth = Truth(log.times, np.broadcast_to(np.eye(3), (70, 3, 3)), np.zeros((70, 3)))
    plain = replay.tune(log, SETTINGS, seconds=2.0)
    assert plain.epochs == 21
    assert replay.tune(recording(spoiled)._replace(truth=truth), SETTINGS, seconds=2.0) == plain


@with_kernels
def test_the_likelier_filter_is_taken():
    """Biases where there are some; none where the noise is white."""
    biases = 0.15 * np.random.default_rng(6).standard_normal((7, 5))
    settings = SETTINGS.changed(bias_std_m=0.15, bias_time_s=None)
    for ranges, name in ((RANGES, "iekf"), (RANGES + biases, "iekf-bias")):
        tuned = replay.tune(recording(ranges[:14]), settings, filters=("iekf", "iekf-bias"))
        assert tuned.found["filter"] == tuned.settings.filter == name
        assert tuned.options.startswith(f"--filter {name} --range-std-m ")


def test_a_short_log_tells_its_deviation_and_every_round_is_told():
    told = []
    tuned = replay.tune(recording(RANGES[:25]), DEFAULTS, advance=lambda: told.append(1))
    assert len(told) == replay.TUNING_ROUNDS
    # By 875 ranges, less what the poses take, to 3 %: four standard deviations.
    assert tuned.found["range_std_m"] == pytest.approx(0.1, rel=0.12)


@with_kernels
def test_late_ranges_have_their_price():
    """A twentieth of the ranges is late: neither are they noise, nor is all else refused."""
    late = RANGES + 3.0 * (np.random.default_rng(4).random(RANGES.shape) < 0.05)
    tuned = replay.tune(recording(late), DEFAULTS)
    assert tuned.found["range_std_m"] == pytest.approx(0.1, rel=0.1)


@with_kernels
def test_filters_of_an_unknown_twist_have_their_acceleration_tuned():
    settings = DEFAULTS.changed(filter="iekf-cv", walk_m=0.0, walk_deg=0.0)
    tuned = replay.tune(recording(RANGES), settings)
    assert list(tuned.found) == ["range_std_m", "accel_m", "accel_deg"]
    assert tuned.settings.motion.walk_m == 0.0
    assert tuned.log_likelihood > tuned.log_likelihood_before + 0.03
    options = tuned.options.split()
    assert options[::2] == ["--filter", "--range-std-m", "--accel-m", "--accel-deg"]
    assert [float(value) for value in options[3::2]] == list(tuned.found.values())


def test_options_of_the_filter_are_kept_and_printed():
    settings = DEFAULTS.changed(filter="iekf/iterations=2/robust=late", walk_m=0.0, walk_deg=0.0)
    tuned = replay.tune(recording(RANGES[:12]), settings)
    assert tuned.options.startswith("--filter iekf/robust=late/iterations=2 --range-std-m ")
    assert tuned.settings.filter_text == settings.filter_text
    assert tuned.settings.loss.robust == "late"


def test_a_log_too_short_to_tune_by_is_refused():
    message = r"first 0\.5 s must have at least 10 epochs for tuning, got 6: .* \(--tune-s\)"
    with pytest.raises(ValueError, match=message):
        replay.tune(recording(RANGES), SETTINGS, seconds=0.5)
    with pytest.raises(ValueError, match="seconds"):
        replay.tune(recording(RANGES), SETTINGS, seconds=-1.0)


def written(folder):
    """The files of a log, as arguments."""
    times = 0.1 * np.arange(len(RANGES))
    return ["replay", *recorded.options(recorded.files(folder, ANCHORS, TAGS, times, RANGES))]


@with_kernels
def test_the_command_runs_with_what_it_tuned_and_prints_it(tmp_path, capsys):
    arguments = written(tmp_path)
    assert (
        cli.main(
            [
                *arguments,
                "--filter",
                "iekf",
                "--tune-s",
                "2",
                "--json",
                str(tmp_path / "tuned.json"),
            ]
        )
        == 0
    )
    tuned = json.loads((tmp_path / "tuned.json").read_text())
    options = tuned["tuned"]["options"].split()
    assert tuned["settings"]["walk_m"] == float(options[options.index("--walk-m") + 1])
    assert tuned["tuned"]["epochs"] == 21
    # The options repeated give the same run.
    assert cli.main([*arguments, *options, "--json", str(tmp_path / "again.json")]) == 0
    again = json.loads((tmp_path / "again.json").read_text())
    assert again["consistency"] == tuned["consistency"]
    capsys.readouterr()
    assert cli.main([*arguments, "--tune", "--tune-s", "1"]) == 0
    out = capsys.readouterr().out
    assert "tuned on 11 epochs of the first 1.0 s: --filter iekf" in " ".join(out.split())
    assert "NIS per degree of freedom" in out

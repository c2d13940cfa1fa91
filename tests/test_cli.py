"""The command line, run in this process: demo and replay, their files, their errors."""

from __future__ import annotations

import csv
import json
import math
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest

from rbl_gym import estimators, motion, recordings
from rbl_gym.app.cli import main
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.studies import replay
from rbl_gym.studies.papers import camsap2013
from tests import recorded
from tests.helpers import ROOT, Told, assert_table_holds, with_kernels
from tests.recorded import table

LIAS = ROOT.parent / "shared" / "data" / "lias_planar"


def test_demo_writes_a_table_a_picture_a_page_and_the_figures_of_the_study(tmp_path, capsys):
    picture, html, figures = (tmp_path / "new" / f"demo.{end}" for end in ("png", "html", "json"))
    arguments = ["demo", "--trials", "4", "--seed", "3", "--plot", str(picture)]
    if with_page := find_spec("plotly") is not None:
        arguments += ["--html", str(html)]
    settings = dict(matplotlib.rcParams)
    assert main([*arguments, "--json", str(figures)]) == 0
    assert dict(matplotlib.rcParams) == settings
    table = capsys.readouterr().out
    for label in camsap2013.FILTERS:
        assert label in table
    assert picture.stat().st_size > 20_000
    if with_page:
        assert f"page: {html}" in table
        assert "Plotly.newPlot" in html.read_text(encoding="utf-8")
    told = Told()
    first, second = json.loads(figures.read_text()), camsap2013.tracking_experiment(4, 3, told)
    assert told.done == told.announced == 120
    for result in (first, second):
        for filter in result["filters"].values():
            assert filter.pop("microseconds_per_step") > 0
    assert first == json.loads(json.dumps(second))
    assert {claim["statement"] for claim in second["claims"]}
    assert camsap2013.Claim(**second["claims"][0]).source == "paper"


@pytest.mark.parametrize("name", ["camsap2013", "doa2019", "icassp2013", "slides2013"])
def test_reproduce_prints_plots_and_writes_the_same_figures_everywhere(name, tmp_path, capsys):
    picture, table = tmp_path / "x.png", tmp_path / "x.csv"
    arguments = ["reproduce", name, "--trials", "3", "--plot", str(picture), "--csv", str(table)]
    assert main([*arguments, "--json", str(tmp_path / "x.json")]) == 0
    assert "bound" in capsys.readouterr().out
    assert picture.stat().st_size > 20_000
    result = json.loads((tmp_path / "x.json").read_text())
    assert_table_holds(table, result, least=100)
    if name == "slides2013":
        assert set(result["dynamic"]["filters"]) == {"KF", "KF-ortho", "UC-KF", "iterated EKF"}


LONG = [pytest.param((1000, seed), marks=pytest.mark.long) for seed in (0, 1, 2)]


@pytest.fixture(scope="module", params=[(300, 0), *LONG], ids=str)
def experiment(request):
    return camsap2013.tracking_experiment(*request.param)


def test_the_tracking_papers_claims_hold(experiment):
    """All of them in 1000 trials; in fewer, ours on each single step is left to chance."""
    claims = experiment["claims"]
    assert [claim["source"] for claim in claims].count("paper") == 9
    failed = [claim["statement"] for claim in claims if not claim["holds"]]
    if experiment["trials"] < 1000:
        failed = [statement for statement in failed if not statement.startswith("iterated EKF")]
    assert failed == []


def test_the_series_of_figs_2_and_3_are_those_of_the_paper(experiment):
    """Orders of the curves, and the estimate of KF as every filter of the family claims it."""
    steps = {label: filter["per_step"] for label, filter in experiment["filters"].items()}
    for key in ("rotation_rmse", "mean_angular_error_deg"):
        family = [np.array(steps[name][key]) for name in ("UC-KF", "KF-ortho", "ET-KF")]
        assert all(len(series) == 20 for series in family)
        assert (family[0] < family[1]).all()
        assert (family[1] < family[2]).all()
    kf = steps["KF"]
    for name in ("KF-ortho", "ET-KF", "UC-KF"):
        for what in ("estimated_rotation_rmse", "estimated_translation_rmse_m"):
            np.testing.assert_allclose(steps[name][what], kf[what], rtol=1e-9)
    # The angle of a column is about its chord: three columns of MAE a, RMSE r, a <= r / sqrt(3).
    chord = np.array(kf["rotation_rmse"]) / np.sqrt(3)
    assert (np.deg2rad(kf["mean_angular_error_deg"]) < chord).all()


def test_only_the_iterated_ekf_reaches_the_bound(experiment):
    ratios = {
        label: (filter["rotation_to_bound"], filter["translation_to_bound"])
        for label, filter in experiment["filters"].items()
    }
    assert max(ratios.pop("iterated EKF")) < 1.03
    assert all(translation > 2 for _, translation in ratios.values())
    assert 1.05 < ratios["UC-KF"][0] < 1.2 < ratios["KF-ortho"][0] < ratios["ET-KF"][0]


@pytest.fixture
def files(tmp_path):
    """A body turning and flying through a room for 20 s, 3-D, with its truth."""
    anchors, tags, times, ranges, path = recorded.walk(101, 1)
    ranges[7, 0, 4] = np.nan
    return recorded.files(tmp_path, anchors, tags, times, ranges, path)


def arguments(files):
    return ["replay", *recorded.options(files)]


@pytest.mark.parametrize("name", ["iekf", "iekf-cv", "iekf-bias", "uc-kf", "kf-ortho"])
def test_replay_tracks_a_recording_from_nothing(files, name, tmp_path, capsys):
    picture = tmp_path / "track.png"
    options = ["--filter", name, "--range-std-m", "0.03", "--walk-m", "0.5", "--walk-deg", "25"]
    if drawn := name == "iekf":
        options += ["--plot", str(picture)]
    assert main([*arguments(files), *options, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["epochs"] == 101
    assert result["links"] == 101 * 36 - 1
    limit = 1.0 if "iekf" in name else 2.0
    assert result["position_rmse_m"] < 0.05 * limit
    assert result["rotation_rmse_deg"] < 4 * limit
    assert result["yaw_rmse_deg"] < 4 * limit
    assert result["position_median_m"] < result["position_p95_m"]
    assert not drawn or picture.stat().st_size > 10_000


def test_replay_yaw_offset_counts_against_the_truth(files, capsys):
    options = ["--range-std-m", "0.03", "--walk-m", "0.5", "--walk-deg", "25"]
    means = []
    for offset in ("0", "10"):
        assert main([*arguments(files), *options, "--yaw-offset-deg", offset, "--json"]) == 0
        means.append(json.loads(capsys.readouterr().out)["yaw_mean_deg"])
    assert math.isclose(means[0] - means[1], 10.0, abs_tol=1e-6)


def test_replay_without_truth_prints_no_errors(files, capsys):
    del files["truth"]
    assert main(arguments(files)) == 0
    assert "no truth, so no errors" in capsys.readouterr().out


@pytest.mark.parametrize(
    "given", ["--yaw-offset-deg=7", "--truth-gap-s=1", "--truth-exclude=1:2", "--align=yaw"]
)
def test_replay_options_of_the_comparison_need_a_truth(files, capsys, given):
    del files["truth"]
    assert main([*arguments(files), given]) != 0
    assert f"{given.partition('=')[0]} needs --truth" in capsys.readouterr().err


@pytest.mark.skipif(not LIAS.is_dir(), reason="the LIAS recording is not on this machine")
@pytest.mark.long
def test_replay_of_a_real_planar_recording(tmp_path):
    """The defaults reach 0.033 m and 3.8 degrees over the whole run, causally."""
    files = {"ranges": LIAS / "dynamic_fast_ranges.csv", "anchors": LIAS / "anchors_8_14.csv",
             "tags": LIAS / "tags_8_14.csv", "truth": LIAS / "dynamic_fast_truth.csv",
             "calibration": LIAS / "calibration_8_14.csv"}  # fmt: skip
    options = ["--planar", "--height-offset-m", "0.08", "--yaw-offset-deg", "7"]
    figures = tmp_path / "lias.json"
    assert main([*map(str, arguments(files)), *options, "--json", str(figures)]) == 0
    result = json.loads(figures.read_text())
    assert result["epochs"] == result["epochs_with_truth"] == 13481
    assert result["position_rmse_m"] <= 0.033
    assert result["yaw_rmse_deg"] <= 3.8


@pytest.fixture
def raw_files(tmp_path):
    """A planar robot on a circle; every link has its bias, and all have 0.17 m in common."""
    rng = np.random.default_rng(2)
    tags = np.array([[-0.07, -0.14, 0], [-0.07, 0.14, 0], [0.2, 0.14, 0]])
    sides = [[-4, 3], [0, 3], [4, 3], [4, 0], [4, -3], [0, -3], [-4, -3], [-4, 0]]
    anchors = np.column_stack([sides, np.ones(8)])
    track = motion.orbit([0, 0, 0.92], 2.0, 0.4, 0.1, 150)
    path = motion.simulate(track, 0.1, motion.ProcessNoise())
    noise = ranging.RangeNoise(0.03)
    ranges = ranging.simulate(anchors, tags, *path, noise, rng).ranges
    ranges = ranges + 0.17 + 0.06 * rng.standard_normal((8, 3))
    times = 0.1 * np.arange(151)
    poses = np.column_stack([times, path.translation, np.rad2deg(rotations.yaw(path.rotation))])
    files = recorded.files(tmp_path, anchors, tags, times, ranges)
    return files | {"truth": table(tmp_path / "truth.csv", "t,x,y,z,yaw_deg", poses)}


@with_kernels
@pytest.mark.usefixtures("no_search_for_causes")
def test_replay_of_raw_ranges_learns_the_biases(raw_files, capsys):
    options = ["--planar", "--height-offset-m", "0.08", "--walk-m", "0.3", "--walk-deg", "10"]
    options += ["--range-std-m", "0.05", "--json"]
    found = {}
    for name, more in (("plain", []), ("raw", ["--raw"])):
        assert main([*arguments(raw_files), *options, *more]) == 0
        found[name] = json.loads(capsys.readouterr().out)
    settings = found["raw"]["settings"]
    assert settings["filter"] == "iekf-bias"
    assert (settings["bias_std_m"], settings["bias_time_s"]) == (0.05, None)
    for error in ("position_median_m", "yaw_rmse_deg"):
        assert found["raw"][error] < 0.75 * found["plain"][error]
    assert found["plain"]["anees"] > 3
    assert found["raw"]["anees"] < 2


def lias(calibrated: bool, folder: Path) -> dict[str, str]:
    """Every fourth epoch of the dynamic recording, as files; the full rate is in the docs."""
    lines = (LIAS / "dynamic_fast_ranges.csv").read_text().splitlines()
    thin = folder / "ranges.csv"
    thin.write_text("\n".join([lines[0], *lines[1::4]]))
    files = {"ranges": thin, "anchors": LIAS / "anchors_8_14.csv", "tags": LIAS / "tags_8_14.csv",
             "truth": LIAS / "dynamic_fast_truth.csv"}  # fmt: skip
    if calibrated:
        files["calibration"] = LIAS / "calibration_8_14.csv"
    return {name: str(file) for name, file in files.items()}


@pytest.mark.skipif(not LIAS.is_dir(), reason="the LIAS recording is not on this machine")
@pytest.mark.parametrize(
    ("calibrated", "options", "limits"),
    [
        (True, ["--filter", "iekf-bias", "--range-std-m", "0.06"], (0.031, 3.6)),
        (
            False,
            ["--raw", "--range-std-m", "0.09", "--walk-m", "0.2", "--walk-deg", "8"],
            (0.055, 4.2),
        ),
    ],
    ids=["calibrated", "raw"],
)
@pytest.mark.long
def test_biases_of_a_real_recording(calibrated, options, limits, tmp_path, capsys):
    """At a quarter of the rate, hence half the standard deviation of a range."""
    planar = ["--planar", "--height-offset-m", "0.08", "--yaw-offset-deg", "7", "--json"]
    assert main([*arguments(lias(calibrated, tmp_path)), *options, *planar]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["epochs_with_truth"] == 3371
    assert result["position_rmse_m"] <= limits[0]
    assert result["yaw_rmse_deg"] <= limits[1]
    assert 0.5 < result["anees"] < 2.0


@pytest.mark.skipif(not LIAS.is_dir(), reason="the LIAS recording is not on this machine")
@pytest.mark.parametrize("every", [16, pytest.param(4, marks=pytest.mark.long)])
def test_static_runs_of_a_real_recording(every, tmp_path):
    """30 poses, each from nothing: at most 0.035 m over all runs, thinned by so much."""
    settings = replay.Settings.of(
        filter="iekf-bias", planar=True, height_offset_m=0.08, yaw_offset_deg=5.6, range_std_m=0.06
    )
    truth = {
        row["run"]: row
        for row in csv.DictReader((LIAS / "static_truth.csv").read_text().splitlines())
    }
    runs: dict[str, list[list[str]]] = {run: [] for run in truth}
    header, *rows = csv.reader((LIAS / "static_ranges.csv").read_text().splitlines())
    for run, *cells in rows:
        runs[run].append(cells)
    squares, nees = [], []
    for run, cells in runs.items():
        place = [truth[run][key] for key in ("x", "y", "yaw_deg")]
        ends = [[cells[k][0], *place] for k in (0, -1)]
        recording = recordings.read_recording(
            recordings.Files(
                table(tmp_path / "ranges.csv", ",".join(header[1:]), cells[::every]),
                LIAS / "anchors_8_14.csv",
                LIAS / "tags_8_14.csv",
                table(tmp_path / "truth.csv", "t,x,y,yaw_deg", ends),
                LIAS / "calibration_8_14.csv",
            )
        )
        found = replay.track_errors(
            recording, replay.track_recording(recording, settings), settings
        )
        assert found is not None
        squares.append(np.mean(found.position[found.known] ** 2))
        nees.append(found.nees[found.known].mean() / 3)
    assert len(squares) == 30
    assert np.sqrt(np.mean(squares)) <= 0.035
    assert 0.5 < np.mean(nees) < 2


def test_replay_says_which_deviation_of_a_range_it_took(files, capsys):
    def settings(*options):
        assert main([*arguments(files), *options, "--json"]) == 0
        return json.loads(capsys.readouterr().out)["settings"]

    assert settings()["range_std_m"] == 0.12
    header, first, *_ = csv.reader(Path(files["ranges"]).read_text().splitlines())
    rows = [
        [first[0], *name[1:].split("t"), r, 0.05]
        for name, r in zip(header[1:], first[1:], strict=True)
    ]
    table(Path(files["ranges"]), "t,anchor,tag,range,std", rows)
    assert settings()["range_std_m"] == "recorded"
    blind = "--filter", "tests.test_cli:blind"
    assert main([*arguments(files), *blind]) == 2
    assert "filter 'tests.test_cli:blind' must take update(" in capsys.readouterr().err
    assert settings(*blind, "--range-std-m", "0.1")["range_std_m"] == 0.1


def blind(tags, noise, process):
    """A filter that cannot be told the law of an epoch."""
    inner = estimators.make("iekf", tags=tags, noise=noise, process=process)

    def update(state, ranges, anchors, links=None):
        return inner.update(state, ranges, anchors, links)

    return SimpleNamespace(
        initial=inner.initial, predict=inner.predict, update=update, belief=inner.belief
    )


@pytest.mark.parametrize("offset", [None, "0", "0.2"])
def test_planar_among_anchors_at_different_heights_needs_the_tags_height(raw_files, offset, capsys):
    rows = Path(raw_files["anchors"]).read_text().splitlines()
    rows[1] = rows[1].replace(",1.0", ",1.4")
    Path(raw_files["anchors"]).write_text("\n".join(rows))
    options = ["--planar", "--json"] + ([] if offset is None else ["--height-offset-m", offset])
    status = main([*arguments(raw_files), *options])
    said = capsys.readouterr()
    if offset is None:
        assert status == 2
        assert "as the anchors are at heights of 1 to 1.4 m" in said.err
    else:
        assert status == 0
        assert json.loads(said.out)["settings"]["height_offset_m"] == float(offset)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--raw", "--calibration", "x.csv"], "--raw must be left out with --calibration"),
        (["--raw", "--filter", "iekf"], "need the filter iekf-bias, got iekf"),
        (["--filter", "uc-kf", "--bias-std-m", "0.1"], "need the filter iekf-bias, got uc-kf"),
        (["--bias-std-m", "-1"], "std_m must be a finite number"),
        (["--accel-m", "-1"], "--accel-m must be a finite number"),
        (["--ranges", "nowhere.csv"], "nowhere.csv"),
        (["--height-offset-m", "0.1"], "--height-offset-m needs --planar"),
        (["--filter", "magic"], "filter must be one of"),
        (["--walk-m", "-1"], "--walk-m must be a finite number"),
        (["--range-std-m", "0"], "--range-std-m must be a finite number"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_with_status_2(files, change, message, capsys):
    assert main([*arguments(files), *change]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("rbl-gym replay: ")
    assert message in error


def test_a_planar_recording_refuses_the_linear_filters_with_their_rank(files, tmp_path, capsys):
    rows = [
        [i, x, y, 0] for i, (x, y) in enumerate([(0, 0), (8, 0), (8, 8), (0, 8), (4, 0), (4, 8)])
    ]
    files["anchors"] = table(tmp_path / "flat.csv", "anchor,x,y,z", rows)
    assert main([*arguments(files), "--filter", "kf"]) == 2
    assert "rank 8 of the filter's 12 states" in capsys.readouterr().err


def test_a_missing_extra_is_named(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    page = str(tmp_path / "x.html")
    assert main(["demo", "--trials", "2", "--html", page]) == 2
    assert capsys.readouterr().err == (
        "rbl-gym demo: --html needs the extra viz: pip install 'rbl-gym[viz]'\n"
    )


@pytest.mark.parametrize("bad", [["--trials", "0"], ["--trials", "x"], ["--seed", "-1"]])
def test_numbers_out_of_range_are_usage_errors(bad, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["demo", *bad])
    assert "must be" in capsys.readouterr().err


def test_an_option_of_the_filter_goes_before_the_setting(capsys):
    log = ROOT / "examples" / "log"
    command = ["replay", "--json"]
    for name in ("ranges", "anchors", "tags"):
        command += [f"--{name}", str(log / f"{name}.csv")]
    assert main([*command, "--filter", "iekf/robust=false"]) == 0
    assert json.loads(capsys.readouterr().out)["settings"]["robust"] is False

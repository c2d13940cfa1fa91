"""rbl-gym bench and rerun: their worlds, figures, rows and files."""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import json
from typing import Any

import numpy as np
import pytest
from scipy import stats

from rbl_gym import estimators, metrics
from rbl_gym.app import bench_report
from rbl_gym.app.cli import main
from rbl_gym.estimators import filter as belief
from rbl_gym.recordings import Files, read_recording
from rbl_gym.studies import monte_carlo, replay
from rbl_gym.studies.bench import figures as bench_figures
from rbl_gym.studies.bench import leaderboard, records, sources, spec_files
from rbl_gym.studies.bench import worlds as bench_worlds
from rbl_gym.worlds import scenes
from tests import fragile, recorded
from tests.helpers import ROOT

SHORT = {"name": "uwb_room", "steps": 4}


@pytest.fixture
def short(tmp_path):
    """A scene of five epochs as a file."""
    path = tmp_path / "short.json"
    path.write_text(json.dumps(SHORT))
    return str(path)


def bench(tmp_path, *arguments, name="x.jsonl"):
    """Run the command; its status and the file's bytes."""
    out = tmp_path / name
    status = main(["bench", "--out", str(out), "--trials", "6", *map(str, arguments)])
    return status, out.read_bytes() if out.exists() else b""


def rows(data: bytes):
    return [json.loads(line) for line in data.decode().splitlines()]


# --- worlds ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def worlds():
    scene = scenes.get({**SHORT, "steps": 10})
    return {
        name: bench_worlds.simulate_condition(scene, name, 40, 3)
        for name in bench_worlds.CONDITIONS
    }


@pytest.mark.parametrize("name", [n for n in bench_worlds.CONDITIONS if n != "nominal"])
def test_motion_and_prior_are_the_same_under_every_condition(worlds, name):
    for field in ("rotation", "translation", "anchors", "tags"):
        np.testing.assert_array_equal(
            getattr(worlds[name], field), getattr(worlds["nominal"], field)
        )
    for one, other in zip(worlds[name].readings[1:], worlds["nominal"].readings[1:], strict=True):
        np.testing.assert_array_equal(one.twist, other.twist)
    for one, other in zip(worlds[name].prior, worlds["nominal"].prior, strict=True):
        np.testing.assert_array_equal(one, other)


def ranges(world):
    return np.array([reading.ranges for reading in world.readings])


def true_ranges(world):
    places = np.einsum("kbij,nj->kbni", world.rotation, world.tags) + world.translation[:, :, None]
    return np.linalg.norm(places[:, :, None] - world.anchors[:, :, None], axis=-1)


def test_noise_is_doubled_and_the_filter_is_not_told(worlds):
    clean = true_ranges(worlds["nominal"])
    once, twice = (ranges(worlds[name]) - clean for name in ("nominal", "noise-x2"))
    np.testing.assert_allclose(twice, 2 * once, atol=1e-12)
    assert worlds["noise-x2"].told == worlds["nominal"].told
    assert 0.095 < once.std() < 0.105


def test_a_tenth_of_the_ranges_is_reflected(worlds):
    extra = ranges(worlds["nlos"]) - ranges(worlds["nominal"])
    reflected = extra > 1
    np.testing.assert_allclose(extra[reflected], 5.0)
    np.testing.assert_array_equal(extra[~reflected], 0.0)
    assert 0.09 < reflected.mean() < 0.11
    # The bound of clean ranges.
    np.testing.assert_allclose(worlds["nlos"].bound, worlds["nominal"].bound)


def test_half_of_the_links_are_lost_and_the_bound_knows(worlds):
    links = np.array([reading.links for reading in worlds["lost-links"].readings])
    assert 0.48 < links.mean() < 0.52
    np.testing.assert_array_equal(ranges(worlds["lost-links"]), ranges(worlds["nominal"]) * links)
    traces = [np.trace(worlds[n].bound, axis1=2, axis2=3).mean() for n in ("lost-links", "nominal")]
    assert traces[0] > 1.3 * traces[1]


def test_an_anchor_and_a_tag_are_told_wrong_and_nothing_else(worlds):
    nominal = worlds["nominal"]
    told = worlds["anchor-off"].readings[0].anchors - nominal.anchors
    np.testing.assert_allclose(np.linalg.norm(told[:, 0], axis=-1), 0.5)
    np.testing.assert_array_equal(told[:, 1:], 0.0)
    assert np.abs(told[:, 0].mean(axis=0)).max() < 0.2
    tags = np.array(worlds["tag-off"].told.tags) - nominal.tags
    np.testing.assert_allclose(np.linalg.norm(tags[0]), 0.05)
    np.testing.assert_array_equal(tags[1:], 0.0)
    for name in ("anchor-off", "tag-off"):
        np.testing.assert_array_equal(ranges(worlds[name]), ranges(nominal))


def test_another_seed_and_another_scene_are_another_world():
    scene = scenes.get(SHORT)
    first = bench_worlds.simulate_condition(scene, "nominal", 2, 0)
    for other in (
        bench_worlds.simulate_condition(scene, "nominal", 2, 1),
        bench_worlds.simulate_condition(scenes.get({**SHORT, "speed_m_s": 1.1}), "nominal", 2, 0),
    ):
        assert np.abs(other.translation[0] - first.translation[0]).max() > 0.01
    again = bench_worlds.simulate_condition(scene, "nominal", 2, 0)
    np.testing.assert_array_equal(again.translation, first.translation)


def test_the_scene_hash_sees_every_field():
    hashes = {bench_worlds.scene_hash(scene) for scene in scenes.SCENES.values()}
    assert len(hashes) == len(scenes.SCENES)
    room = scenes.get("uwb_room")
    facts = bench_worlds.scene_facts(room)
    # A scene without what later fields say keeps the hash that it had before there were any.
    younger = {"inertial", "survey_std_m", "prisms", "gain", "fixed"}
    assert set(facts) == {field.name for field in dataclasses.fields(room)} - younger | {"kind"}
    fixed = {"fixed": [[0, 0, 1]], "anchors": None}
    changes = {"inertial": "consumer"}, {"survey_std_m": 0.1}, {"gain": {"max_range_m": 9.0}}, fixed
    for change in changes:
        changed = scenes.get({"name": "uwb_room", **change})
        assert set(bench_worlds.scene_facts(changed)) == {*facts, *change}
        assert bench_worlds.scene_hash(changed) not in hashes
    assert bench_worlds.scene_hash(dataclasses.replace(room, steps=99)) not in hashes
    for change in ({"dt": 0.2}, {"noise": {"floor_m": 0.2}}, {"links": {"nlos_bias_m": 4.0}},
                   {"noise": {"kind": "squared-range", "sigma_m": 0.1}}):  # fmt: skip
        scene = scenes.get({"name": "uwb_room", **change})
        assert bench_worlds.scene_hash(scene) not in hashes


def test_mirror_images_are_those_of_the_anchors_plane():
    flat = bench_worlds.simulate_condition(
        scenes.get({"name": "auv_buoys", "steps": 2}), "nominal", 3, 0
    )
    image = bench_worlds.mirrored(flat)
    assert image is not None
    np.testing.assert_allclose(image, flat.translation * [1, 1, -1], atol=1e-9)
    room = bench_worlds.simulate_condition(scenes.get(SHORT), "nominal", 3, 0)
    assert bench_worlds.mirrored(room) is None


# --- figures --------------------------------------------------------------------------------


def test_the_verdict_is_that_of_the_chi_square_interval():
    rng = np.random.default_rng(0)
    honest = rng.chisquare(6, (30, 100))
    found = bench_figures.consistency(honest, 6)
    low, high = stats.chi2.interval(0.95, 600)
    np.testing.assert_allclose(found["anees_interval"], [low / 600, high / 600], rtol=1e-8)
    assert found["verdict"] == "consistent"
    assert found["within"] >= 0.8
    np.testing.assert_allclose(found["anees"], honest.mean() / 6)
    assert bench_figures.consistency(1.3 * honest, 6)["verdict"] == "optimistic"
    assert bench_figures.consistency(0.7 * honest, 6)["verdict"] == "pessimistic"
    honest[3, 4] = np.nan
    broken = bench_figures.consistency(honest, 6)
    assert (broken["verdict"], broken["anees"]) == ("optimistic", None)


def test_differences_have_the_interval_of_the_paired_bootstrap():
    old = "rng" not in inspect.signature(stats.bootstrap).parameters
    draws: dict[str, Any] = {"random_state" if old else "rng": np.random.default_rng(2)}
    rng = np.random.default_rng(1)
    base = np.abs(rng.standard_normal(150))
    errors = {"good": base, "bad": base * 1.1 + 0.05, "none": np.full(150, np.nan)}
    per_trial = {
        name: {part: bench_figures.json_number(values) for part in bench_figures.PARTS}
        for name, values in errors.items()
    }
    found = bench_figures.differences(per_trial, 0)
    want = stats.bootstrap(
        (errors["bad"], errors["good"]), lambda a, b, axis: monte_carlo.rms(a, axis)
        - monte_carlo.rms(b, axis), paired=True, method="percentile", n_resamples=4000,
        **draws,
    ).confidence_interval  # fmt: skip
    row = found["bad"]["tags_m"]
    np.testing.assert_allclose([row["low"], row["high"]], want, rtol=0.05)
    assert row["best"] == "good"
    assert row["low"] < row["difference"] < row["high"]
    assert found["good"]["tags_m"]["difference"] == 0
    assert found["none"]["tags_m"]["low"] is None


def test_lost_and_flipped_are_what_they_say():
    K, B = 8, 5
    error = np.full((K, B), 0.01)
    rotation = np.full((K, B), 1.0)
    error[:, 1] = 0.2  # far off the bound, but within what was known at the start
    error[-2:, 2] = 5.0  # ends far off
    error[-1, 3] = np.nan
    rotation[-1, 4] = 120.0
    errors = bench_figures.BenchErrors(error, rotation, error, np.full((K, B), 6.0))
    mirror = np.array([9.0, 9.0, 4.0, 9.0, 9.0])
    bound = {part: np.full((K, B), 0.01) for part in bench_figures.PARTS}
    reference = bench_figures.Reference(bound, np.full(B, 0.5), mirror)
    assert bench_figures.is_lost(error, reference).tolist() == [False, False, True, True, False]
    assert bench_figures.is_flipped(errors, reference).tolist() == [False, False, True, True, True]
    away = reference._replace(mirror_m=None)
    assert bench_figures.is_flipped(errors, away).tolist() == [False] * 4 + [True]


def test_a_record_has_the_figures_of_a_plain_loop(tmp_path, short):
    _, data = bench(tmp_path, "--scenes", short, "--filters", "uc-kf", "--conditions", "nominal")
    record = rows(data)[0]
    scene = scenes.get(SHORT)
    world = bench_worlds.simulate_condition(scene, "nominal", 6, 0)
    filter = estimators.make("uc-kf", tags=scene.tags, noise=scene.noise, process=scene.process)
    tags, nees, position = [], [], []
    for b in range(6):
        state = filter.initial(*(array[b] for array in world.prior))
        for k, reading in enumerate(world.readings):
            if reading.twist is not None:
                state = filter.predict(state, reading.twist[b], scene.dt)
            state = filter.update(state, reading.ranges[b], world.anchors[b])
            belief = filter.belief(state)
            truth = world.rotation[k, b], world.translation[k, b]
            tags.append(metrics.tag_error(*belief[:2], *truth, world.tags))
            error = metrics.pose_error(*belief[:2], *truth)
            position.append(np.linalg.norm(error[3:]))
            nees.append(metrics.nees(error, belief.covariance))
    np.testing.assert_allclose(record["tags_m"]["rmse"], np.sqrt(np.mean(np.square(tags))))
    np.testing.assert_allclose(record["position_m"]["rmse"], np.sqrt(np.mean(np.square(position))))
    assert record["position_m"]["median"] == pytest.approx(sorted(position)[len(position) // 2])
    assert np.quantile(position, 0.9) <= record["position_m"]["p95"] <= max(position)
    np.testing.assert_allclose(record["anees"], np.mean(nees) / 6)
    bound = np.sqrt(np.trace(world.bound[..., 3:, 3:], axis1=-2, axis2=-1).mean())
    np.testing.assert_allclose(record["position_m"]["bound"], bound)
    np.testing.assert_allclose(
        record["position_m"]["to_bound"], record["position_m"]["rmse"] / bound
    )
    assert record["rank"] == record["states"] == 12
    assert len(record["per_trial"]["tags_m"]) == 6
    assert len(record["per_epoch"]["tags_m"]) == 5


def test_the_iterated_ekf_is_at_the_bound_and_honest():
    task = leaderboard.Task("room", "uwb_room", "nominal", ("iekf",), 100, 0)
    ((record, microseconds),) = leaderboard.run_task(task)
    for part in bench_figures.PARTS:
        assert 0.95 < record[part]["to_bound"] < 1.03
    assert record["verdict"] == "consistent"
    assert record["lost"] == record["flipped"] == 0
    assert microseconds is not None
    assert microseconds > 0


# --- rows that are not figures --------------------------------------------------------------


def test_a_filter_that_cannot_observe_is_a_row_with_its_rank(tmp_path, capsys):
    (tmp_path / "sea.json").write_text('{"name": "auv_buoys", "steps": 3}')
    (tmp_path / "vague.toml").write_text(
        'name = "auv_buoys"\nsteps = 3\ninitial_rotation_rad = 3.0'
    )
    scene_files = f"{tmp_path / 'sea.json'},{tmp_path / 'vague.toml'}"
    status, data = bench(tmp_path, "--scenes", scene_files, "--filters", "kf,iekf",
                         "--conditions", "nominal,lost-links")  # fmt: skip
    assert status == 0
    found = {(r["scene"], r["filter"], r["condition"]): r for r in rows(data)}
    sea, vague = found["sea", "kf", "nominal"], found["vague", "kf", "nominal"]
    assert (sea["status"], sea["rank"], sea["states"]) == ("unobservable", 8, 12)
    assert sea["tags_m"]["rmse"] > 0
    assert (vague["status"], vague["rank"]) == ("ValueError", 8)
    assert vague["message"].startswith("at epoch 0: anchors and tags determine only rank 8")
    assert found["sea", "iekf", "nominal"]["status"] == "ok"
    assert (found["sea", "iekf", "nominal"]["rank"], found["sea", "iekf", "nominal"]["states"]) == (
        6,
        6,
    )
    table = capsys.readouterr().out
    assert "kf: does not determine the pose in this scene (rank 8 of 12)" in table
    assert "kf, lost-links: ValueError at epoch 0" in table


def test_a_filter_that_fails_is_a_row_and_a_status(tmp_path, short, capsys):
    status, data = bench(tmp_path, "--scenes", short, "--conditions", "nominal",
                         "--filters", "iekf,tests.fragile:stumbles/epoch=2")  # fmt: skip
    assert status == 1
    good, bad = rows(data)
    assert good["status"] == "ok"
    assert (bad["status"], bad["message"]) == ("failed", "at epoch 2: TypeError: stumbled")
    table = " ".join(capsys.readouterr().out.split())
    assert "failed at epoch 2: TypeError: stumbled" in table


def test_a_filter_that_takes_no_such_law_and_one_without_a_pose_are_rows(tmp_path, short):
    status, data = bench(tmp_path, "--scenes", f"camsap2013,{short}", "--conditions", "nominal",
                         "--filters", "tests.fragile:refuses_the_paper")  # fmt: skip
    assert status == 1
    paper, room = rows(data)
    assert (paper["status"], paper["message"]) == (
        "ValueError",
        "at epoch 0: noise must have a floor",
    )
    assert room["status"] == "failed"
    assert "TypeError: beliefs must have arrays" in room["message"]
    assert "got [(6, 3, 3), (6, 3), (6, 3, 3)]" in room["message"]


def test_a_belief_that_is_a_plain_tuple_is_a_row_and_names_the_filter(tmp_path, short, capsys):
    status, data = bench(tmp_path, "--scenes", short, "--conditions", "nominal",
                         "--filters", "iekf,tests.fragile:Tuples")  # fmt: skip
    assert status == 1
    good, bad = rows(data)
    assert (good["status"], bad["status"]) == ("ok", "failed")
    assert (
        "belief of the filter Tuples must return rbl_gym.estimators.PoseBelief(" in (bad["message"])
    )
    assert "failed, see below" in capsys.readouterr().out


@pytest.mark.parametrize("one_by_one", [False, True])
def test_trials_need_only_the_belief_of_a_filter(one_by_one):
    trials = monte_carlo.simulate_trials(scenes.get(SHORT), 3, np.random.default_rng(0))
    make = estimators.one_by_one("tests.fragile:OtherState") if one_by_one else fragile.OtherState
    trace = monte_carlo.track_trials(trials, make, {})  # pyrefly: ignore[bad-argument-type]
    iekf = monte_carlo.track_trials(trials, "iekf", {})
    assert trace.own_translation.shape == iekf.own_translation.shape == (5, 3)
    assert (np.diff(trace.own_translation, axis=0) > 0).all()  # dead reckoning
    np.testing.assert_allclose(trace.own_translation[0], 3 * 0.5**2, rtol=0.5)


@pytest.mark.parametrize(
    ("changes", "noted"),
    [
        ({}, True),
        ({"initial_translation_m": 0.1}, False),
        ({"survey_std_m": 0.1}, False),
        ({"links": {"nlos_probability": 0.1}}, False),
    ],
)
def test_an_optimistic_iekf_gets_a_note_on_the_linearisation(tmp_path, capsys, changes, noted):
    # Five anchors within 10 cm of a plane.
    path = tmp_path / "flat.json"
    anchors = [[0, 0, 2.4], [6, 0, 2.3], [6, 5, 2.4], [0, 5, 2.3], [3, 0, 2.4]]
    flat = {"anchors": anchors, "initial_translation_m": 2.0, "noise": {"floor_m": 0.02}}
    path.write_text(json.dumps(SHORT | flat | changes))
    assert bench(tmp_path, "--scenes", path, "--filters", "iekf", "--conditions", "nominal",
                 "--trials", "100")[0] == 0  # fmt: skip
    shown = " ".join(capsys.readouterr().out.split())
    assert ("the probable cause is the linearisation" in shown) == noted


def test_the_table_of_stress_has_the_ratio_to_the_bound(tmp_path, short, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    bench(tmp_path, "--scenes", short, "--conditions", "nlos", "--filters", "iekf,kf",
          "--json", tmp_path / "x.json")  # fmt: skip
    shown = " ".join(capsys.readouterr().out.split())
    assert "nlos: tags (m), x bound, ANEES" in shown
    for row in json.loads((tmp_path / "x.json").read_text())["rows"]:
        assert f"{row['tags_m']['to_bound']:.3f}" in shown


def test_event_triggered_filters_say_how_often(tmp_path, short):
    _, data = bench(tmp_path, "--scenes", short, "--conditions", "nominal",
                    "--filters", "kf,et-kf,et-kf/threshold=0,kf-ortho,iekf")  # fmt: skip
    rates = [record["trigger_rate"] for record in rows(data)]
    assert rates[0] == 0
    assert 0 < rates[1] < 1
    assert rates[2:] == [1, 1, None]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--filters", "magic"], "filter must be one of"),
        (["--filters", "nowhere.at_all:make"], "cannot be imported: No module named 'nowhere'"),
        (["--filters", "tests.fragile:missing"], "cannot be imported: module 'tests.fragile'"),
        (["--filters", "tests.fragile:not_callable"], "must be callable, got 3"),
        (["--filters", "iekf/robust"], "must have the form name/option=value"),
        (["--filters", "iekf/gain=2"], "filter 'iekf' has no option 'gain'"),
        (["--scenes", "moon"], "scene must be one of"),
        (["--scenes", "nowhere.toml"], "rbl-gym bench: nowhere.toml: No such file or directory"),
        (["--conditions", "rain"], "condition must be one of"),
        (["--address", "tcp://127.0.0.1:1"], "--address needs --backend dask or ray"),
    ],
)
def test_what_is_wrong_is_said_before_the_work_with_status_2(tmp_path, arguments, message, capsys):
    status, data = bench(tmp_path, *arguments)
    assert status == 2
    assert message in capsys.readouterr().err
    assert data == b""


# --- files ----------------------------------------------------------------------------------


def test_a_run_that_was_cut_off_goes_on_and_ends_in_the_same_bytes(
    tmp_path, short, monkeypatch, capsys
):
    options = ["--scenes", short, "--filters", "kf,iekf", "--conditions", "nominal,nlos"]
    _, whole = bench(tmp_path, *options)
    assert [(r["condition"], r["filter"]) for r in rows(whole)] == [
        (condition, filter) for condition in ("nominal", "nlos") for filter in ("kf", "iekf")
    ]
    lines = whole.splitlines(keepends=True)
    # The second record is missing, the last was being written.
    (tmp_path / "cut.jsonl").write_bytes(lines[0] + lines[2] + lines[3][:100])
    ran = []
    run = leaderboard.run_task
    monkeypatch.setattr(leaderboard, "run_task", lambda task: ran.append(task) or run(task))
    _, again = bench(tmp_path, *options, name="cut.jsonl")
    assert again == whole
    assert [(task.condition, task.filters) for task in ran] == [
        ("nominal", ("iekf",)),
        ("nlos", ("iekf",)),
    ]
    # A part of it, and then another filter beside it: nothing is run twice, nothing is dropped.
    ran.clear()
    _, more = bench(tmp_path, "--scenes", short, "--conditions", "nlos", "--filters", "iekf,uc-kf",
                    name="cut.jsonl")  # fmt: skip
    assert [task.filters for task in ran] == [("uc-kf",)]
    assert set(more.splitlines()) > set(whole.splitlines())
    assert [r["filter"] for r in rows(more)][:2] == ["iekf", "uc-kf"]


def test_a_file_keeps_records_of_other_settings_until_it_is_replaced(
    tmp_path, short, monkeypatch, capsys
):
    options = ["--scenes", short, "--filters", "kf", "--conditions", "nominal"]
    _, first = bench(tmp_path, *options)
    (old,) = rows(first)
    (tmp_path / "x.jsonl").write_text(json.dumps(old | {"versions": {"numpy": "1.0"}}) + "\n")
    _, updated = bench(tmp_path, *options)
    assert [row["versions"] for row in rows(updated)] == [old["versions"], {"numpy": "1.0"}]
    status, both = bench(tmp_path, *options, "--trials", 7, "--seed", 1)
    assert status == 0
    assert [(row["trials"], row["seed"]) for row in rows(both)] == [(7, 1), (6, 0), (6, 0)]
    assert rows(both)[1:] == rows(updated)
    capsys.readouterr()
    # Each is the result of its settings, and none is computed again.
    assert main(["rerun", str(tmp_path / "x.jsonl")]) == 0
    assert "3 of 3 records are identical" in capsys.readouterr().out
    with monkeypatch.context() as patch:
        patch.setattr(leaderboard, "run_task", lambda task: pytest.fail(f"ran {task} again"))
        assert bench(tmp_path, *options, "--json", tmp_path / "x.json")[0] == 0
    (row,) = json.loads((tmp_path / "x.json").read_text())["rows"]
    assert (row["trials"], row["seed"], row["versions"]) == (6, 0, old["versions"])
    status, other = bench(tmp_path, *options, "--seed", 1, "--fresh")
    assert status == 0
    assert [(row["trials"], row["seed"]) for row in rows(other)] == [(6, 1)]
    assert rows(other)[0]["tags_m"] != rows(first)[0]["tags_m"]
    (tmp_path / "x.jsonl").write_text("not a record\n{}\n")
    assert bench(tmp_path, *options)[0] == 2
    assert "line 1: not a result of rbl-gym bench" in capsys.readouterr().err


def test_records_say_what_they_are_of_and_times_stand_apart(tmp_path, short, capsys):
    options = ["--scenes", short, "--filters", "kf,iekf", "--conditions", "nominal,nlos"]
    _, data = bench(tmp_path, *options, "--json", tmp_path / "x.json")
    for record in rows(data):
        assert record["spec"] == SHORT
        assert record["scene_hash"] == bench_worlds.scene_hash(scenes.get(SHORT))
        assert (record["trials"], record["seed"]) == (6, 0)
        assert {"rbl-gym", "code", "numpy", "scipy"} == record["versions"].keys()
    assert b"microseconds" not in data
    times = records.read_timings(tmp_path / "x.jsonl")
    assert len(times) == 4
    assert min(times.values()) > 0
    result = json.loads((tmp_path / "x.json").read_text())
    assert len(result["rows"]) == len(result["microseconds_per_step"]) == 4
    assert all("per_trial" not in row for row in result["rows"])
    worse = [row["difference"]["tags_m"] for row in result["rows"]]
    assert {row["best"] for row in worse} <= {"kf", "iekf"}
    assert sorted(row["difference"] == 0 for row in worse) == [False, False, True, True]
    assert "tags (m)" in capsys.readouterr().out


def test_rerun_gives_the_same_and_says_what_differs(tmp_path, short, capsys):
    options = [
        "--scenes",
        short,
        "--filters",
        "kf,iekf/robust=true",
        "--conditions",
        "nominal,nlos",
    ]
    _, data = bench(tmp_path, *options)
    path = str(tmp_path / "x.jsonl")
    assert main(["rerun", path]) == 0
    assert "4 of 4 records are identical" in capsys.readouterr().out
    changed = rows(data)
    changed[2]["tags_m"]["rmse"] *= 1.5
    changed[3]["versions"]["numpy"] = "1.0"
    (tmp_path / "y.jsonl").write_text("".join(json.dumps(row) + "\n" for row in changed))
    assert main(["rerun", str(tmp_path / "y.jsonl"), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["records"], found["identical"]) == (4, 3)
    assert found["versions"] == {"numpy": ["1.0", np.__version__]}
    (row,) = found["changed"]
    assert (row["condition"], row["filter"], row["field"]) == ("nlos", "kf", "tags_m.rmse")
    np.testing.assert_allclose(row["relative_change"], 1 / 3)
    assert main(["rerun", str(tmp_path / "y.jsonl")]) == 1
    assert "3 of 4 records are identical" in capsys.readouterr().out


def test_rerun_compares_records_of_one_name_with_their_own_scene(tmp_path, capsys):
    path = tmp_path / "room.json"
    for floor in (0.5, 0.05):
        path.write_text(json.dumps(SHORT | {"noise": {"floor_m": floor}}))
        bench(tmp_path, "--scenes", path, "--filters", "kf", "--conditions", "nominal")
    assert main(["rerun", str(tmp_path / "x.jsonl")]) == 0
    shown = capsys.readouterr().out
    assert "2 of 2 records are identical" in shown
    assert "what differs" not in shown


def test_rerun_of_nothing_is_an_error(tmp_path, capsys):
    (tmp_path / "empty.jsonl").write_text("")
    assert main(["rerun", str(tmp_path / "empty.jsonl")]) == 2
    assert "must have results of rbl-gym bench" in capsys.readouterr().err


def test_a_missing_library_is_said_before_a_bar_is_drawn(tmp_path, short, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    status, data = bench(tmp_path, "--scenes", short, "--jobs", "2")
    assert (status, data) == (2, b"")
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        "rbl-gym bench: running in several processes needs the extra parallel: pip install "
        "'rbl-gym[parallel]', or leave out --jobs"
    )


# --- recordings -----------------------------------------------------------------------------


@pytest.fixture
def recording(tmp_path):
    """A log of 41 epochs of a body that turns and drifts, as files and the file that names them."""
    files = recorded.files(tmp_path, *recorded.walk(41, 4))
    names = "".join(f'{name} = "{name}.csv"\n' for name in files)
    path = tmp_path / "walk.toml"
    path.write_text(f"{names}range_std_m = 0.03\nwalk_m = 0.5\nwalk_deg = 25\n")
    return path


def test_a_recording_is_a_scene(tmp_path, recording, capsys):
    status, data = bench(tmp_path, "--scenes", recording, "--filters", "iekf,et-kf")
    assert status == 0
    found = {(r["condition"], r["filter"]): r for r in rows(data)}
    assert len(found) == 12
    first = found["nominal", "iekf"]
    settings = replay.Settings.of(range_std_m=0.03, walk_m=0.5, walk_deg=25, robust=False)
    files = {name: tmp_path / f"{name}.csv" for name in ("ranges", "anchors", "tags", "truth")}
    log = read_recording(Files(**files))
    track = replay.track_recording(log, settings)
    figures = replay.track_figures(log, track, replay.track_errors(log, track, settings), settings)
    # The stretches leave out what the last of 41 epochs does not fill.
    for part, name in (("position_m", "position_rmse_m"), ("rotation_deg", "rotation_rmse_deg")):
        np.testing.assert_allclose(first[part]["rmse"], figures[name], rtol=0.02)
    np.testing.assert_allclose(first["anees"], figures["anees"], rtol=0.02)
    assert len(first["per_trial"]["tags_m"]) == 20
    assert "to_bound" not in first["tags_m"]
    assert not {"lost", "per_epoch"} & first.keys()
    tags = {key: record["tags_m"]["rmse"] for key, record in found.items()}
    for condition in ("nlos", "lost-links", "anchor-off"):
        assert tags[condition, "iekf"] > 1.2 * tags["nominal", "iekf"]
    assert found["noise-x2", "iekf"]["anees"] > 2 * first["anees"]
    assert 0 < found["nlos", "et-kf"]["trigger_rate"] <= 1
    shown = capsys.readouterr().out
    assert "walk, a recording, seed 0" in shown
    assert "walk, stress" in shown


def test_a_recording_has_a_page_without_colours(tmp_path, recording, short):
    pytest.importorskip("plotly", reason="needs the extra viz")
    path = tmp_path / "page.html"
    for names, words in (
        (f"{recording}", "a recording in each row"),
        (f"{short},{recording}", "6 trials or a recording in each row"),
    ):
        status, _ = bench(tmp_path, "--scenes", names, "--filters", "iekf,kf", "--fresh",
                          "--conditions", "nominal", "--html", path)  # fmt: skip
        assert status == 0
        text = path.read_text()
        assert words in text
        assert ('id="maps"' in text) == (short in names)


@pytest.mark.parametrize(
    ("column", "shown"),
    [
        ([0.995, 1.0, 26.0], ["0.995", "1.000", "26.000"]),
        ([3.41, 15.0, None], ["3.41", "15.00", "-"]),
        ([-0.000986, 0.0, 0.00473], ["-0.000986", "0.000000", "0.004730"]),
        ([544.0, 15.6e6], ["544", "1.56e+07"]),
        ([None], ["-"]),
        ([], []),
    ],
)
def test_a_column_has_one_number_of_decimals(column, shown):
    assert bench_report.fixed(column) == shown


def test_a_recording_that_was_changed_is_named_by_rerun(tmp_path, recording, capsys):
    bench(tmp_path, "--scenes", recording, "--filters", "kf", "--conditions", "nominal,nlos")
    path = str(tmp_path / "x.jsonl")
    assert main(["rerun", path]) == 0
    assert "2 of 2 records are identical" in capsys.readouterr().out
    (tmp_path / "tags.csv").write_text((tmp_path / "tags.csv").read_text() + "\n# touched\n")
    # Another file is another seed of what a condition draws, and of nothing else.
    assert main(["rerun", path, "--json"]) == 1
    again = json.loads(capsys.readouterr().out)
    assert list(again["sources"]) == ["walk"]
    assert [row["condition"] for row in again["changed"]] == ["nlos"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "uwb_room"\nranges = "x.csv"', "must have either the key 'name'"),
        ("steps = 3", "must have either the key 'name'"),
        ('ranges = "ranges.csv"\nspeed = 3', "walk.toml: a recording has no key 'speed'"),
        ('ranges = "ranges.csv"\nanchors = "a.csv"', "walk.toml: a recording needs the key 'tags'"),
        ("ranges = 3", "walk.toml: ranges must be the name of a file, got 3"),
        ('name = "uwb_room"\nstep = 3', "walk.toml: scene has no field 'step'"),
        ("ranges = ", "walk.toml: Invalid value"),
    ],
)
def test_a_file_that_is_no_scene_is_refused(tmp_path, recording, text, message, capsys):
    recording.write_text(text)
    assert bench(tmp_path, "--scenes", recording)[0] == 2
    assert message in capsys.readouterr().err


def test_a_building_file_is_a_scene():
    path = ROOT / "examples" / "warehouse.toml"
    assert spec_files.scene_specs([str(path)]) == {"warehouse": {"name": str(path)}}


def test_a_filter_is_ours_by_where_its_factory_lives(monkeypatch):
    monkeypatch.setattr(belief, "_FACTORIES", dict(belief._FACTORIES))
    assert {leaderboard.source_of(name) for name in belief._FACTORIES} == {"rbl-gym"}
    belief.register("mine", lambda tags, noise, process: None)  # pyrefly: ignore[bad-argument-type]
    assert len(sources.source_of("mine")) == 16
    with pytest.raises(ValueError, match="filter must be one of"):
        sources.source_of("nobody")


def unrun(name: str):
    """A module whose code did not run."""
    spec = importlib.util.find_spec(name)
    assert spec is not None
    return importlib.util.module_from_spec(spec)


@pytest.mark.parametrize(
    ("files", "home"),
    [
        ({"src_a.py": "import src_b", "src_b.py": ""}, "src_a"),
        ({"src_c.py": "def f():\n    from src_d import X", "src_d.py": "import src_e",
          "src_e.py": "import src_c"}, "src_c"),
        ({"src_f/__init__.py": "", "src_f/a/__init__.py": "", "src_f/a/b.py": "from ..c import X",
          "src_f/c.py": "from . import d, e", "src_f/d.py": "", "src_f/e/__init__.py": ""},
         "src_f.a.b"),
        ({"src_g/__init__.py": "from .h import *", "src_g/h.py": ""}, "src_g"),
    ],
)  # fmt: skip
def test_a_filter_is_its_module_and_those_beside_it_that_it_imports(
    tmp_path, monkeypatch, files, home
):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sources, "factory_of", lambda name: type)
    # Some of these files cannot run.
    monkeypatch.setattr(sources, "import_module", unrun)
    for name, text in {**files, "src_z.py": "import src_a"}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    found = [sources.source_of(f"{home}:F")]
    for name in files:
        (tmp_path / name).write_text(files[name] + "\n")
        found.append(sources.source_of(f"{home}:F"))
    assert len(set(found)) == 1 + len(files)
    (tmp_path / "src_z.py").write_text("")
    assert sources.source_of(f"{home}:F") == found[-1]


def test_results_of_an_edited_helper_are_computed_again(tmp_path, short, monkeypatch, capsys):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "bench_wrap.py").write_text(
        "import bench_helper\nfrom rbl_gym import estimators\n"
        "def F(tags, noise, process):\n"
        "    return estimators.make('iekf', tags=tags, noise=noise, process=process)\n"
    )
    (tmp_path / "bench_helper.py").write_text("")
    options = ["--scenes", short, "--conditions", "nominal", "--filters", "iekf,bench_wrap:F"]
    assert bench(tmp_path, *options)[0] == 0
    assert "results from" not in capsys.readouterr().out
    for text, taken in (("", 2), ("A = 1\n", 1)):
        (tmp_path / "bench_helper.py").write_text(text)
        assert bench(tmp_path, *options)[0] == 0
        shown = capsys.readouterr().out
        assert f"{taken} of 2 results from {tmp_path / 'x.jsonl'}; --fresh computes all" in shown


def test_filters_made_for_other_worlds_run_when_they_are_named():
    assert set(leaderboard.ELSEWHERE) < set(estimators.names())
    assert set(leaderboard.default_filters()) & set(leaderboard.ELSEWHERE) == set()
    assert {"iekf", "kf", *leaderboard.VARIANTS} <= set(leaderboard.default_filters())


def test_scenes_with_other_sensors_bring_the_filters_made_for_them():
    specs = spec_files.scene_specs(["uwb_room", *spec_files.SENSED])
    hashes = {leaderboard.digest_of(spec) for spec in specs.values()}
    assert len(hashes) == len(specs)
    usual = tuple(leaderboard.default_filters())
    for task in leaderboard.tasks(specs, ["nominal"], None, 5, 0):
        further = leaderboard.further_filters(task.scene)
        assert task.filters == (*usual, *further)
        for text in task.filters:
            estimators.parse_filter(text)
    assert leaderboard.further_filters("uwb_room") == []
    assert leaderboard.further_filters(specs["uwb_room-imu"]) == [
        "iekf-imu", "iekf-imu/robust=true",
    ]  # fmt: skip
    assert "iekf/anchor_std_m=0.05" in leaderboard.further_filters(specs["uwb_room-survey"])


def test_who_knows_the_survey_is_honest_and_who_does_not_is_optimistic():
    """40 trials of 21 epochs: NEES/6 of the first within 25 %, of the second above 1.5."""
    spec = {**spec_files.SENSED["uwb_room-survey"], "steps": 20}
    filters = ("iekf", "iekf/anchor_std_m=0.05")
    task = leaderboard.Task("x", spec, "nominal", filters, 40, 0)
    plain, knows = (record for record, _ in leaderboard.run_task(task))
    assert knows["anees"] == pytest.approx(1, abs=0.25)
    assert knows["tags_m"]["to_bound"] < 1.1
    assert plain["anees"] > 1.5
    assert plain["tags_m"]["rmse"] > knows["tags_m"]["rmse"]


def test_scenes_keep_their_hash_when_fields_are_added():
    # The seed of the trials comes from it: another hash makes every published figure another.
    plain, sensed = scenes.get("uwb_room"), scenes.get({"name": "uwb_room", "inertial": "consumer"})
    assert bench_worlds.scene_hash(plain) == "ef968268a369d56a"
    assert bench_worlds.scene_hash(sensed) != "ef968268a369d56a"

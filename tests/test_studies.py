"""The commands as functions: the same results from Python."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rbl_gym.app.cli import main
from rbl_gym.placement import scene_files
from rbl_gym.studies import backends, monte_carlo, network, replay
from rbl_gym.studies.bench import leaderboard, records, spec_files
from rbl_gym.studies.learning import evaluation, transfer
from rbl_gym.studies.learning.rl_tasks import rl_task
from rbl_gym.studies.papers import camsap2013, doa2019, icassp2013, network_growth, slides2013
from rbl_gym.studies.placing import accuracy, answer, check, design, judging
from rbl_gym.worlds import scenes
from tests.helpers import Told, needs
from tests.test_epoch_noise import log


def printed(capsys, *arguments):
    """The JSON that a command prints."""
    assert main([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def timeless(value):
    """Without what is different in every run."""
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if "second" not in k and k != "time_ratio"}
    if isinstance(value, list):
        return [timeless(item) for item in value]
    return value


def test_an_example_has_the_errors_of_its_beliefs():
    found = camsap2013.example(1)
    assert isinstance(found, camsap2013.Example)
    assert found.trials.scene == camsap2013.paper_scene()
    assert list(found.beliefs) == list(found.errors) == ["KF", "iterated EKF"]
    truth = found.trials.episode.translation[0]
    for name, belief in found.beliefs.items():
        np.testing.assert_allclose(found.errors[name][:, 3:], belief.translation - truth)


def test_bench(capsys, tmp_path):
    file = tmp_path / "short.json"
    file.write_text('{"name": "uwb_room", "steps": 3}')
    specs = spec_files.scene_specs([str(file)])
    assert specs == {"short": {"name": "uwb_room", "steps": 3}}
    tasks = leaderboard.tasks(specs, ["nominal"], ["iekf", "kf"], 5, 1)
    mine, timings = records.run_tasks(tasks, tmp_path / "mine.jsonl")
    assert [record for task in tasks for record, _ in leaderboard.run_task(task)] == mine
    theirs = printed(
        capsys, "bench", "--scenes", str(file), "--conditions", "nominal", "--filters", "iekf,kf",
        "--trials", "5", "--seed", "1", "--out", str(tmp_path / "theirs.jsonl"),
    )  # fmt: skip
    assert leaderboard.summary(mine, timings)["rows"] == theirs["rows"]
    assert records.read_records(tmp_path / "theirs.jsonl") == mine
    assert records.rerun(mine, workers=backends.HERE)["identical"] == 2


def test_settings_of_a_replay_by_group_and_by_name():
    grouped = replay.Settings(
        "iekf",
        range_std_m=0.05,
        motion=replay.Motion(walk_m=0.3),
        biases=replay.Biases(bias_time_s=None),
        loss=replay.Loss(robust=False),
        knowledge=replay.Knowledge(planar=True, height_offset_m=0.2),
        comparison=replay.Comparison(yaw_offset_deg=7),
    )
    named = {
        "filter": "iekf",
        "range_std_m": 0.05,
        "walk_m": 0.3,
        "bias_time_s": None,
        "robust": False,
        "planar": True,
        "height_offset_m": 0.2,
        "yaw_offset_deg": 7,
    }
    assert replay.Settings.of(**named) == grouped
    assert grouped.flat() == {**replay.Settings().flat(), **named}
    assert grouped.changed(walk_m=0.1).motion == replay.Motion()
    given = {
        "iekf-log": {},
        "iekf": {"walk_deg": 5.0},
        "iekf-bias": {"walk_m": 1.0, "bias_std_m": 1.0},
    }
    assert [replay.Settings.of(**fields).filter for fields in given.values()] == [*given]
    assert replay.Settings() == replay.Settings.of()
    with pytest.raises(ValueError, match="settings have no field 'walk'; the fields are filter, "):
        replay.Settings.of(walk=0.1)


def test_replay_in_one_call_is_the_four():
    recording, settings = log(0.02), replay.Settings.of(walk_m=0.3)
    found = replay.replay_recording(recording, settings)
    assert isinstance(found, replay.Replayed)
    track = replay.track_recording(recording, settings)
    np.testing.assert_array_equal(found.track.translation, track.translation)
    errors = replay.track_errors(recording, track, settings)
    assert isinstance(errors, replay.TrackErrors)
    figures = replay.track_figures(recording, track, errors, found.settings)
    # What is not the recording's: how fast it went.
    assert found.figures.pop("microseconds_per_epoch") > 0
    # And what the log says of itself, with a warning where it has to be.
    assert found.figures.pop("consistency")["residuals"].keys() == {"anchors", "tags", "links"}
    notes, said = figures.pop("notes"), found.figures.pop("notes")
    assert said[: len(notes)] == notes
    assert found.figures == figures
    np.testing.assert_array_equal(replay.origin_of(recording), np.zeros(3))
    assert replay.volume_of(recording, settings) is None
    checked = replay.check_replay(recording, settings)
    assert checked.knowledge.height_offset_m == replay.height_offset(recording, settings)
    assert checked == found.settings
    # The filter by its name, with options of its own.
    filter = replay.named_filter(recording, settings, "iekf", {"robust": True})
    *_, last = replay.recording_steps(recording, settings, filter)
    np.testing.assert_array_equal(last.belief.translation, track.translation[-1])
    assert replay.range_std_of(recording._replace(range_std=None), settings) == (
        replay.DEFAULT_RANGE_STD_M
    )


@needs("cmaes")
@pytest.mark.usefixtures("coarse_design")
def test_place(capsys):
    problem = scene_files.problem("uwb_room", 4, None, 0, 0)
    placed = answer.place_anchors(problem, answer.Question(range(4, 5), trials=20))
    arguments = "--scene", "uwb_room", "--anchors", "4", "--trials", "20"
    assert placed.result == printed(capsys, "place", *arguments)
    assert isinstance(placed, answer.Placed)
    assert isinstance(placed.design, design.Design)
    plan = accuracy.accuracy_map(problem, placed.design.anchors)
    assert isinstance(plan, accuracy.Map)
    again = check.check_layout(problem, placed.design.anchors, 20, 0)
    assert again == placed.result["check"]
    drawn = check.draw_bodies(problem, placed.design.anchors, 5, np.random.default_rng(0))
    assert isinstance(drawn, check.DrawnBodies)
    (judged,) = judging.judge(problem, placed.design.anchors, 0)
    assert isinstance(judged, judging.Judged)
    found = accuracy.accuracy(problem, placed.design.anchors, judged.places, problem.zones[0])
    assert float(monte_carlo.rms(found.score)) == placed.result["predicted"]["score_m"]["rms"]
    edges = judging.at_edges(problem, placed.design.anchors, judged)
    row = placed.result["zones"][0]
    assert judging.zone_row(judged, edges) == {key: row[key] for key in row if key != "lever"}
    assert judging.overview([judged], [edges]) == placed.result["predicted"]


@needs("cmaes")
def test_transfer_is_layouts_and_bodies_among_them(monkeypatch):
    monkeypatch.setattr(transfer, "_STEPS", 12)
    task, told = rl_task("mounts"), Told()
    found = transfer.transfer_task(task, {}, ["random", "greedy"], 2, 1, 3, told)
    assert told.done == told.announced > 2
    layouts = evaluation.layouts_of(task, {}, ["random", "greedy"], 2, 3)
    again = transfer.track_layouts(layouts, ["iekf"], 1, 3)
    assert again["filters"]["iekf"] == found["filters"]["iekf"]
    assert (found["worlds"], found["seed"]) == (2, 3)


def test_network(capsys, tmp_path):
    file = tmp_path / "net.csv"
    file.write_text("i,j,dtheta\n0,1,0.1\n1,2,0.2\n0,2,0.33\n")
    solved = network.solve_network(str(file))
    assert isinstance(solved, network.Solved)
    assert timeless(solved.result) == timeless(printed(capsys, "network", str(file)))
    np.testing.assert_allclose(solved.theta, [0, 0.11, 0.32], atol=1e-9)


def test_the_papers_experiments():
    """Small ones: every method at every noise, each ratio above what chance allows."""
    setting = icassp2013.static_settings()["[0, 100]^3"]
    assert isinstance(setting, icassp2013.Setting)
    found = icassp2013.static_experiment("one", {"a": setting}, 40, 0)
    # 40 trials x 7 noises x 3 axes: the ratio is known to 2.5 %; four standard deviations.
    assert found["settings"]["a"]["methods"]["ML"]["ratio"]["translation_rmse_m"] == pytest.approx(
        1.0, abs=0.1
    )
    angles = doa2019.doa_experiment(2, 0)
    assert list(angles["settings"]) == ["R = I", "random R"]
    both = slides2013.slides_experiment(2, 0)
    assert list(both["settings"]) == list(slides2013.slides_settings())
    assert list(both["dynamic"]["filters"]) == list(slides2013.FILTERS)
    assert len(slides2013.slides_scene().tags) == 5
    rows = network_growth.three_in_space(300, np.random.default_rng(0))
    # 600 turns of three axes each: 4 sigma of a root mean square is 7 %, and 3 % of second order.
    assert all(row["ratio"] == pytest.approx(1, abs=0.1) for row in rows)


def test_trials_are_a_batch_and_the_bound_is_theirs():
    scene = scenes.get({"name": "uwb_room", "steps": 2})
    trials = monte_carlo.simulate_trials(scene, 3, np.random.default_rng(0))
    assert isinstance(trials, monte_carlo.SimulatedTrials)
    measured = monte_carlo.measure_episode(scene, trials.episode)
    for one, other in zip(measured, trials.measurements, strict=True):
        np.testing.assert_array_equal(one.ranges, other.ranges)
    trace = monte_carlo.track_trials(trials, "iekf", {})
    assert isinstance(trace, monte_carlo.Trace)
    assert trace.nees.shape == (3, 3)

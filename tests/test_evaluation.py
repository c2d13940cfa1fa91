"""Evaluation and transfer: losses by hand, held-out worlds, intervals, the command line."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import estimators, placement
from rbl_gym.app.cli import main
from rbl_gym.envs.placement import AnchorPlacementEnv
from rbl_gym.measurements import ranging
from rbl_gym.placement import Context, layouts, search
from rbl_gym.studies.learning import evaluation, left_out, policies, rollouts, training, transfer
from rbl_gym.studies.learning.policies import AnyPolicy
from rbl_gym.studies.learning.rl_tasks import HELD_OUT_SEED, SEED_STRIDE, TASKS, RlTask, rl_task
from rbl_gym.studies.progress import silent
from rbl_gym.wrappers.selection import AnchorSelectionEnv
from rbl_gym.wrappers.tasks import MobileAnchorsEnv
from tests.helpers import Told, needs
from tests.test_policies import random_policy

SHORT: dict[str, tuple[RlTask, type, tuple[int, ...], str]] = {
    "mobile": (
        RlTask("RBL/MobileAnchors-v0", {"scene": {"name": "auv_craft", "steps": 4}}),
        MobileAnchorsEnv, (24, 8, 6), "box",
    ),
    "selection": (
        RlTask("RBL/AnchorSelection-v0", {"k": 2, "scene": {"name": "hall", "steps": 5}}),
        AnchorSelectionEnv, (18, 8, 12), "box",
    ),
    "priced": (
        RlTask("RBL/AnchorSelection-v0",
               {"mode": "priced", "price": 0.2, "scene": {"name": "hall", "steps": 5}}),
        AnchorSelectionEnv, (18, 8, 12), "multi-binary",
    ),
}  # fmt: skip
MOUNTS = RlTask(
    "RBL/AnchorPlacement-v0", {"scene": "uwb_room", "racks": 1, "mode": "mounts", "n_anchors": 3}
)


def evaluate(task, played=None, names=(), worlds=3, seed=0) -> dict[str, Any]:
    return evaluation.evaluate(task, played or {}, list(names), worlds, seed, silent)


# --- losses by hand ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SHORT)
@pytest.mark.parametrize("seed", [0, 2])
def test_a_policys_loss_is_minus_its_mean_reward_in_scalar_worlds(kind, seed):
    task, scalar, sizes, policy_kind = SHORT[kind]
    policy = random_policy(policy_kind, sizes)
    got = evaluation._loop_losses(task, {"mine": policy}, [], 3, seed, silent)["mine"]
    for i in range(3):
        env, rewards, over = scalar(**task.arguments), [], False
        observation, _ = env.reset(seed=HELD_OUT_SEED + SEED_STRIDE * seed + i)
        while not over:
            observation, reward, _, over, _ = env.step(policy(observation))
            rewards.append(reward)
        np.testing.assert_allclose(got[i], -np.mean(rewards), rtol=1e-4)


@pytest.mark.parametrize("name", ["ring", "corners", "random"])
def test_a_layouts_loss_is_its_log_score(name):
    task = rl_task("auv_buoys")
    ((problem, contexts, found),) = evaluation.layouts_of(task, {}, [name], 3, 1, silent)
    losses = evaluation._loss_of(problem, contexts, found[name])
    for i in range(3):
        env = AnchorPlacementEnv()
        _, info = env.reset(seed=HELD_OUT_SEED + SEED_STRIDE + i)
        context = Context(info["region"][:3], info["region"][3:], np.zeros((0, 6)))
        if name == "random":
            assert found[name].shape == (3, 8, 4, 3)
            tries = found[name][i]
        else:
            tries = layouts.LAYOUTS[name](problem, context, np.random.default_rng(0))[None]
        scores = [math.log(placement.score(problem, context, one)) for one in tries]
        np.testing.assert_allclose(losses[i], np.mean(scores), rtol=1e-9)


def test_a_placement_policy_is_played_as_in_the_scalar_environment_and_refining_helps():
    pytest.importorskip("cmaes", reason="needs the extra placement")
    task, policy = rl_task("auv_buoys"), random_policy(sizes=(22, 8, 3))
    result = evaluate(task, {"mine": policy}, worlds=1)
    strongest = ["gradient", "hybrid", "cma-es"]
    assert list(result["methods"]) == [
        "random", *strongest, "mine", "mine + gradient", "best-known",
    ]  # fmt: skip
    env, over, reward = AnchorPlacementEnv(), False, 0.0
    observation, _ = env.reset(seed=HELD_OUT_SEED)
    while not over:
        observation, reward, over, _, _ = env.step(policy(observation))
    figures = result["methods"]
    np.testing.assert_allclose(figures["mine"]["loss"], -reward, rtol=1e-6)
    np.testing.assert_allclose(figures["mine"]["score_m"], np.exp(-reward), rtol=1e-6)
    best, refined = figures["best-known"]["loss"], figures["mine + gradient"]["loss"]
    assert best - 1e-3 < refined < figures["mine"]["loss"]
    assert best == min(figures[name]["loss"] for name in strongest)


def test_the_best_known_is_the_best_search_in_each_world(monkeypatch):
    """By stand-ins: one search is good in even worlds, another in odd ones."""

    def only(odd: int):
        def layout(task, contexts, rng):
            rows = np.arange(len(contexts.centre)) % 2 == odd
            good, bad = layouts.ring(task, contexts, rng), layouts.corners(task, contexts, rng)
            return np.where(rows[:, None, None], good, bad)

        return layout

    for name, stand_in in (("gradient", only(0)), ("hybrid", only(1)), ("cma-es", layouts.corners)):
        monkeypatch.setitem(search.SEARCHES, name, stand_in)
    monkeypatch.setattr(
        "rbl_gym.studies.learning.left_out._OF_CMAES", ()
    )  # stand-ins need no cmaes
    result = evaluate(rl_task("auv_buoys"), names=["ring"], worlds=4)
    figures = result["methods"]
    assert (result["best_reference"], result["best_of"]) == ("best-known", list(search.STRONGEST))
    assert figures["best-known"] == figures["ring"]
    assert figures["ring"]["normalised"] == 1
    for name in search.STRONGEST:
        assert figures[name]["normalised"] < 1


def test_normalised_by_hand_and_intervals_hold_the_mean():
    for task in (SHORT["selection"][0], SHORT["mobile"][0], MOUNTS):
        result = evaluate(task, names=evaluation.references(task), worlds=6)
        figures = result["methods"]
        best = evaluation.references(task)[-1]
        assert result["best_reference"] == best
        assert list(figures) == evaluation.references(task)
        low, high = figures["random"]["loss"], figures[best]["loss"]
        for row in figures.values():
            wanted = (low - row["loss"]) / (low - high)
            np.testing.assert_allclose(row["normalised"], wanted, atol=1e-12)
            assert row["normalised_low"] <= wanted + 1e-12
            assert row["normalised_high"] >= wanted - 1e-12
            assert row["score_m"] == pytest.approx(math.exp(row["loss"]))
        for name, value in (("random", 0), (best, 1)):
            assert figures[name]["normalised_low"] == pytest.approx(value)
            assert figures[name]["normalised_high"] == pytest.approx(value)


def test_intervals_are_paired():
    """What is common to all methods in a world does not widen them."""
    rng = np.random.default_rng(1)
    common, own = 5 * rng.standard_normal(40), 0.01 * rng.standard_normal(40)
    resamples = rng.integers(40, size=(500, 40))
    row = evaluation._figures(common + 0.5 + own, common + 1, common, resamples)
    assert row["normalised"] == pytest.approx(0.5, abs=0.01)
    assert row["normalised_high"] - row["normalised_low"] < 0.02
    assert row["loss_std_error"] == pytest.approx(5 / math.sqrt(40), rel=0.3)


def test_a_priced_loss_is_no_score():
    task, _, sizes, kind = SHORT["priced"]
    result = evaluate(task, {"mine": random_policy(kind, sizes)})
    assert {row["score_m"] for row in result["methods"].values()} == {None}


# --- seeds ------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_figures_whatever_else_is_asked():
    task, _, sizes, kind = SHORT["selection"]
    alone = evaluate(task)
    beside = evaluate(task, {"mine": random_policy(kind, sizes)}, ["nearest", "greedy-blind"])
    assert evaluate(task) == alone
    for name, row in alone["methods"].items():
        assert beside["methods"][name] == row
    assert evaluate(task, seed=1)["methods"]["random"] != alone["methods"]["random"]


@pytest.mark.parametrize("kind", SHORT)
def test_a_policy_as_saved_is_scored_in_the_worlds_of_evaluations(kind):
    task, scalar, sizes, policy_kind = SHORT[kind]
    policy = random_policy(policy_kind, sizes)
    got = evaluation.held_out_returns(task, policy, 3, 2)
    returns = []
    for i in range(3):
        env = scalar(**task.arguments)
        observation, _ = env.reset(seed=HELD_OUT_SEED + 2 * SEED_STRIDE + i)
        total, truncated = 0.0, False
        while not truncated:
            observation, reward, _, truncated, _ = env.step(policy(observation))
            total += reward
        returns.append(total)
    assert got["policy_mean_return"] == pytest.approx(np.mean(returns), rel=1e-6)
    assert got["policy_std_error"] == pytest.approx(np.std(returns, ddof=1) / 3**0.5, rel=1e-5)
    assert got["random_mean_return"] != got["policy_mean_return"]
    assert evaluation.held_out_returns(task, policy, 3, 2) == got


def test_a_training_says_how_good_the_policy_is_that_it_saved(monkeypatch, tmp_path, capsys):
    """By a stand-in for PPO: the learning curve shines, the policy that is saved does not."""
    size = rl_task("auv_buoys").make(1).single_observation_space.shape[0]
    bad = random_policy("box", (size, 8, 3))

    def pretend(name, task, steps, seed, advance, algorithm):
        assert algorithm == "ppo"
        curve = [{"steps": steps, "mean_return": 99.0}]
        figures = {"task": name, "seed": seed, "steps": steps, "seconds": 1.0, "cpu_seconds": 1.0,
                   "env_share": 0.1, "curve": curve}  # fmt: skip
        return bad._replace(biases=(*bad.biases[:-1], np.full(3, 1e3))), figures

    monkeypatch.setattr(training, "train", pretend)
    monkeypatch.setattr(training, "require", lambda *_: None)
    command = ["train", "auv_buoys", "--steps", "1", "--out", str(tmp_path / "p.npz")]
    assert main([*command, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["held_out"]
    assert told["worlds"] == 256
    # All anchors in one corner.
    assert told["policy_mean_return"] < told["random_mean_return"]
    assert main(command) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "99.0000 while exploring" in text
    assert f"256 held-out worlds: policy {told['policy_mean_return']:.4f}" in text
    assert "NO BETTER THAN RANDOM ACTIONS" in text


def test_evaluations_and_trainings_never_share_worlds():
    assert max(task.training.num_envs for task in TASKS.values()) <= SEED_STRIDE
    with pytest.raises(ValueError, match="seed must be below 1000, got 1000"):
        training.train("auv_buoys", rl_task("auv_buoys"), 64, 1000, lambda _: None)
    first, second = (
        rollouts.held_out(rl_task("auv_buoys"), 50, seed)[0].contexts.centre for seed in (0, 1)
    )
    assert not {tuple(row) for row in first} & {tuple(row) for row in second}


# --- what is refused before the work begins ---------------------------------------------------


@pytest.mark.parametrize("task", [SHORT["mobile"][0], MOUNTS])
def test_wrong_references_and_policies_are_named(task):
    with pytest.raises(ValueError, match="reference must be one of 'random'.*got 'best'"):  # noqa: RUF043
        evaluate(task, names=["best"])
    with pytest.raises(ValueError, match="policy 'mine' does not fit: it was trained on"):
        evaluate(task, {"mine": random_policy()})
    for name in ("random", "best-known"):
        with pytest.raises(ValueError, match=f"policy '{name}' has the name of a reference"):
            evaluate(task, {name: random_policy()})


@pytest.mark.parametrize("name", TASKS)
def test_tasks_and_their_references(name):
    task = rl_task(name)
    envs = task.make(1)
    known = evaluation.references(task)
    assert known[0] == "random"
    assert len(known) >= 3
    assert envs.single_observation_space.shape[0] < 256


def test_progress_is_told_as_often_as_announced():
    told, (small, _, sizes, kind) = Told(), SHORT["selection"]
    played: dict[str, AnyPolicy] = {"mine": random_policy(kind, sizes)}
    evaluation.evaluate(small, played, ["nearest"], 2, 0, told)
    assert told.done == told.announced > 0


def test_an_unknown_task_is_named():
    with pytest.raises(ValueError, match="task must be one of 'auv_buoys'"):
        rl_task("buoys")


# --- transfer ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["uwb_room", "auv_buoys"])
def test_filter_errors_by_hand(name):
    task = rl_task(name)
    ((problem, contexts, found),) = evaluation.layouts_of(task, {}, ["ring"], 2, 3, silent)
    bodies = transfer._bodies(problem, contexts, 1, np.random.default_rng(4))
    got = transfer._tag_rmse(problem, contexts, found["ring"], bodies, "iekf", 1)
    scene, tags = problem.scene, np.array(problem.scene.tags)
    for i in range(2):
        total, anchors = 0.0, found["ring"][i]
        for k in range(41):
            Q, t = bodies.rotation[k, i], bodies.translation[k, i]
            distance = np.linalg.norm(tags @ Q.T + t - anchors[:, None], axis=-1)
            share = np.ones((len(anchors), 1))
            for rack in contexts.racks[i]:
                along = anchors[:, None] + np.linspace(0, 1, 4001)[:, None] * (t - anchors[:, None])
                blocked = (np.abs(along - rack[:3]) <= rack[3:]).all(axis=-1).any(axis=-1)
                share[blocked] = problem.blocked_information
            std = np.sqrt(scene.noise.variance(distance) / share)
            ranges = np.maximum(distance + std * bodies.normals[k, i], 1e-3)
            law = ranging.LinkNoise(np.sqrt(scene.noise.variance(ranges) / share))
            filt: Any = estimators.make(
                "iekf", tags=tags, noise=law, process=scene.process, iterations=2
            )
            if k == 0:
                state = filt.initial(bodies.prior[0][i], bodies.prior[1][i], scene.prior_covariance)
            else:
                state = filt.predict(state, bodies.twists[k - 1, i], scene.dt)
            state = filt.update(state, ranges, anchors)
            if k > 10:
                gap = tags @ (state.rotation - Q).T + state.translation - t
                total += (gap**2).sum() / len(tags) / 30
        np.testing.assert_allclose(got[i], math.sqrt(total), rtol=1e-6)


def test_filters_and_references_by_task():
    assert transfer.tracking_filters(rl_task("auv_buoys")) == [
        "iekf",
        "iekf-bank",
        "iekf/robust=true, reflections",
    ]
    everywhere = transfer.tracking_filters(rl_task("auv_buoys"))
    assert transfer.tracking_filters(rl_task("mounts")) == [*everywhere, "uc-kf"]
    assert transfer.transfer_references(rl_task("mounts")) == ["random", "greedy-swaps"]
    assert transfer.transfer_references(rl_task("satellite"))[-1] == "hybrid"


def test_the_strongest_searches_stay_those_that_count_as_1(monkeypatch):
    monkeypatch.setitem(search.SEARCHES, "later", search.best_of_random)
    names = evaluation.references(rl_task("auv_buoys"))
    assert names[-4:] == ["later", *search.STRONGEST]
    assert evaluation.strongest(rl_task("auv_buoys")) == list(search.STRONGEST)
    assert evaluation.strongest(rl_task("mounts")) == ["greedy-swaps"]


def test_correlations_need_three():
    assert transfer._figures(np.array([1.0]), np.array([2.0]))["correlation"] is None
    values = np.array([1.0, 2.0, 4.0])
    assert transfer._figures(values, 3 - 2 * values)["correlation"] == pytest.approx(-1)


# --- the command line -------------------------------------------------------------------------


@needs("cmaes")
def test_evaluate_prints_a_table_or_json(tmp_path, capsys):
    path = tmp_path / "mine.npz"
    policies.save(random_policy(sizes=(18, 4, 12), task="selection"), path)
    arguments = ["evaluate", "selection", "--worlds", "2", "--references", "nearest",
                 "--policy", str(path)]  # fmt: skip
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert list(result["methods"]) == ["random", "nearest", "greedy-with-map", "mine"]
    assert (result["task"], result["worlds"], result["seed"]) == ("selection", 2, 0)
    figures = tmp_path / "new" / "figures.json"
    assert main([*arguments, "--json", str(figures)]) == 0
    table = capsys.readouterr().out
    assert "lower is better" in table
    assert json.loads(figures.read_text()) == result
    for word in (*result["methods"], "normalised: 0 is random, 1 is greedy-with-map"):
        assert word in table
    assert main(["evaluate", "selection-priced", "--worlds", "1", "--references", "random"]) == 0
    assert "greedy-with-map" in capsys.readouterr().out


def test_without_cmaes_its_references_are_skipped(monkeypatch, capsys):
    monkeypatch.setattr(left_out, "find_spec", lambda name: None)
    arguments = ["evaluate", "auv_buoys", "--worlds", "2", "--references", "ring", "--json"]
    assert main(arguments) == 0
    told = capsys.readouterr()
    assert "skipped: one-for-all, cma-es: pip install 'rbl-gym[placement]'" in told.err
    result = json.loads(told.out)
    assert list(result["methods"]) == ["random", "ring", "gradient", "hybrid", "best-known"]
    assert result["best_of"] == ["gradient", "hybrid"]
    assert result["skipped"] == ["one-for-all", "cma-es"]


@needs("cmaes")
def test_transfer_prints_tables_or_json(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(transfer, "_STEPS", 14)
    path = tmp_path / "mine.npz"
    sizes = (TASKS["mounts"].make(1).single_observation_space.shape[0], 4, 57)
    policies.save(random_policy("discrete", sizes, task="mounts"), path)
    arguments = ["transfer", "mounts", "--worlds", "1", "--repeats", "1", "--policy", str(path)]
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert list(result["filters"]) == [
        "iekf",
        "iekf-bank",
        "iekf/robust=true, reflections",
        "uc-kf",
    ]
    for rows in result["filters"].values():
        assert list(rows) == ["random", "greedy-swaps", "mine"]
        assert rows["mine"]["correlation"] is None
        assert abs(rows["random"]["correlation"]) <= 1
        assert rows["greedy-swaps"]["score_m"] < rows["random"]["score_m"]
        assert all(row["tag_rmse_m"] > 0 for row in rows.values())
    assert main([*arguments, "--references", "greedy"]) == 0
    table = capsys.readouterr().out
    assert "correlation" in table
    assert re.findall("greedy\\S*|random", table) == ["greedy"] * 4


@needs("cmaes")
def test_errors_are_one_line(tmp_path, capsys):
    good, same = tmp_path / "mine.npz", tmp_path / "other" / "mine.npz"
    for path in (good, same):
        policies.save(random_policy(sizes=(18, 4, 12), task="selection"), path)
    broken = tmp_path / "broken.npz"
    broken.write_text("nothing")
    for arguments, message in (
        (["evaluate", "selection", "--references", "best"], "reference must be one of 'random'"),
        (["evaluate", "selection", "--references", "random,"], "got ''"),
        (["transfer", "mounts", "--references", "ring"], "reference must be one of 'random', 'gr"),
        (["evaluate", "auv_buoys", "--policy", str(good)], "policy 'mine' does not fit"),
        (
            ["evaluate", "selection", "--policy", str(good), "--policy", str(same)],
            "two policies are named 'mine'",
        ),
        (["evaluate", "selection", "--policy", str(broken)], "is not a policy of rbl-gym"),
        (["evaluate", "selection", "--policy", str(tmp_path / "no.npz")], "No such file"),
        (["transfer", "mounts", "--policy", str(good)], "policy 'mine' does not fit"),
        (["train", "selection", "--seed", "1000"], "seed must be below 1000"),
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert error.startswith("rbl-gym ")
        assert message in error
    for arguments in (["evaluate", "selection", "--worlds", "0"], ["train", "chess"]):
        with pytest.raises(SystemExit):
            main(arguments)


def test_transfer_of_a_loop_by_hand():
    """Scores and errors after ten steps, of a policy in drawn worlds, filter by filter."""
    scenes = [{"name": "auv_craft", "n_anchors": {"integers": [2, 3]}, "steps": 14}]
    task = rl_task("mobile-easy").in_worlds(scenes=scenes)
    size = task.make(1).single_observation_space.shape[0]
    policy = random_policy("box", (size, 4, 6), seed=2)
    told: list[int] = []
    found = transfer.transfer_task(
        task, {"mine": policy}, ["orbit"], 4, 1, 5, lambda steps=1, *, more=0: told.append(steps)
    )
    assert list(found["filters"]) == ["iekf", "iekf-bank", "iekf/robust=true, reflections"]
    assert sum(told) == 6
    law = {"nlos_probability": transfer.NLOS_PROBABILITY, "nlos_bias_m": transfer.NLOS_BIAS_M}
    for name in ("iekf", "iekf/robust=true, reflections"):
        kind, options, reflections = transfer.FILTERS[name]
        members = [{**scenes[0], "links": law}] if reflections else scenes
        filter = {"name": kind, **options}
        scores, errors = [], []
        for i in range(4):
            env = gym.make("rbl_gym:RBL/MobileAnchors-v0", scenes=members, filter=filter,
                           difficulty="easy")  # fmt: skip
            seen, _ = env.reset(seed=HELD_OUT_SEED + 5 * SEED_STRIDE + i)
            infos, over = [], False
            while not over:
                seen, _, _, over, info = env.step(policy(seen).astype(np.float32))
                infos.append(info)
            last = infos[10:]
            assert len(last) == 4
            scores.append(np.mean([np.log(info["score_m"]) for info in last]))
            errors.append(0.5 * np.log(np.mean([info["tag_error_m"] ** 2 for info in last])))
        row = found["filters"][name]["mine"]
        assert row["score_m"] == pytest.approx(np.exp(np.mean(scores)), rel=1e-4)
        assert row["tag_rmse_m"] == pytest.approx(np.exp(np.mean(errors)), rel=1e-4)
        assert row["correlation"] == pytest.approx(np.corrcoef(scores, errors)[0, 1], abs=1e-3)
    rows = found["filters"]["iekf"]
    assert rows["orbit"]["tag_rmse_m"] < rows["mine"]["tag_rmse_m"]


def test_transfer_of_a_loop_in_its_own_scene_and_a_short_one(tmp_path, capsys):
    with pytest.raises(ValueError, match="policy 'other' does not fit"):
        transfer.transfer_task(rl_task("selection"), {"other": random_policy()}, [], 1, 1, 0)
    path = tmp_path / "mine.npz"
    policies.save(random_policy(sizes=(18, 4, 12), task="selection"), path)
    scene = tmp_path / "hall.json"
    scene.write_text('{"name": "hall", "steps": 12}')
    arguments = ["transfer", "selection", "--scene", str(scene), "--worlds", "3"]
    arguments += ["--policy", str(path), "--references", "random,greedy-blind"]
    assert main(arguments) == 0
    table = capsys.readouterr().out
    assert "greedy-blind" in table
    assert "reflections" in table
    assert "mine" in table
    scene.write_text('{"name": "hall", "steps": 10}')
    assert main(arguments) == 2
    assert "scenes must have episodes of more than 10 steps" in capsys.readouterr().err


# --- scenes that are drawn --------------------------------------------------------------------

ROOMS = [
    {"name": "uwb_room", "n_anchors": {"integers": [4, 6]}, "racks": {"integers": [0, 1]}},
    {"name": "drone_yard", "n_anchors": 7},
]


def test_drawn_problems_are_each_placed_in_by_itself():
    task = rl_task("auv_buoys").in_worlds(scenes=ROOMS)
    assert "one-for-all" not in evaluation.references(task)
    env = task.make(1)
    size = env.single_observation_space.shape[0]
    policy = random_policy("box", (size, 4, 3), seed=1)
    groups = evaluation.layouts_of(task, {"mine": policy}, ["random", "ring"], 8, 0)
    assert [len(one.contexts.centre) for one in groups] == [1] * 8
    assert len({one.problem.n_anchors for one in groups}) > 1
    played = policy.player()
    for i, (problem, contexts, found) in enumerate(groups):
        alone = gym.make("rbl_gym:RBL/AnchorPlacement-v0", **task.arguments)
        seen, _ = alone.reset(seed=HELD_OUT_SEED + i)
        terminated, reward = False, np.nan
        while not terminated:
            seen, reward, terminated, _, info = alone.step(played(None, seen).astype(np.float32))
        placed = info["anchors"][: problem.n_anchors]
        np.testing.assert_allclose(found["mine"][0], placed, atol=1e-5)
        score = placement.score(problem, contexts, found["mine"])
        assert float(reward) == pytest.approx(-np.log(score[0]), abs=1e-4)
        assert found["ring"].shape == (1, problem.n_anchors, 3)
        assert found["random"].shape == (1, 8, problem.n_anchors, 3)


def test_layouts_in_drawn_rooms_are_tracked():
    task = rl_task("auv_buoys").in_worlds(scenes=ROOMS)
    groups = evaluation.layouts_of(task, {}, ["random", "ring"], 3, 0)
    rows = transfer.track_layouts(groups, ["iekf"], 1, 0)["filters"]["iekf"]
    assert rows["ring"]["tag_rmse_m"] < rows["random"]["tag_rmse_m"]
    assert "uc-kf" not in transfer.tracking_filters(task.in_worlds(scenes=["auv_buoys"]))


def test_worlds_with_episodes_of_their_own_length():
    scenes = [{"name": "hall", "steps": 3}, {"name": "hall", "steps": 6}]
    task = rl_task("selection").in_worlds(scenes=scenes)
    totals, steps = rollouts.returns(task, lambda env, _: np.ones(env.action_space.shape), 6, 0)
    assert set(steps.tolist()) == {3, 6}
    for i in range(6):
        env = gym.make("rbl_gym:RBL/AnchorSelection-v0", **task.arguments)
        env.reset(seed=HELD_OUT_SEED + i)
        total, over, count = 0.0, False, 0
        while not over:
            _, reward, _, over, _ = env.step(np.ones(12, np.float32))
            total, count = total + float(reward), count + 1
        assert count == steps[i]
        np.testing.assert_allclose(total, totals[i], atol=1e-6)

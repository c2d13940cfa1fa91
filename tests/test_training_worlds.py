"""Scenes and families from files, tasks in other worlds, and every way to train, in a few steps."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from rbl_gym.app import learning_commands
from rbl_gym.app.cli import main
from rbl_gym.studies.learning import policies, trained_worlds
from rbl_gym.studies.learning.policies import Policy
from rbl_gym.studies.learning.rl_tasks import TASKS, RlTask, Training, rl_task
from rbl_gym.studies.learning.set_policies import SetPolicy
from rbl_gym.worlds.families import family
from rbl_gym.worlds.scene_source import read_scene, read_scenes
from tests.helpers import ROOT, needs

DRAWN = {"name": "auv_craft", "n_anchors": {"integers": [2, 3]}, "steps": 4}
TOML = """
[[scenes]]
name = "auv_craft"
steps = 4
n_anchors = { integers = [2, 3] }
"""


def test_families_from_files(tmp_path):
    (tmp_path / "one.json").write_text(json.dumps(DRAWN))
    (tmp_path / "many.json").write_text(json.dumps([DRAWN, "auv_craft"]))
    (tmp_path / "many.toml").write_text(TOML)
    (tmp_path / "one.toml").write_text('name = "hall"\nsteps = 7')
    assert read_scenes(tmp_path / "one.json") == DRAWN
    assert read_scenes(tmp_path / "many.json") == [DRAWN, "auv_craft"]
    assert read_scenes(tmp_path / "many.toml") == [DRAWN]
    assert read_scene(str(tmp_path / "one.toml")) == {"name": "hall", "steps": 7}
    assert read_scene("hall") == "hall"
    assert family(read_scenes(tmp_path / "many.json")).n_anchors == 3


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", "[{]", r"a\.json: .*line 1 column 3"),
        ("a.toml", "x = = 1", r"a\.toml: .*line 1, column 5"),
        ("a.json", "[]", "must hold at least one scene"),
        ("a.json", '["hall", {"steps": 3}]', "scene 1 must be a name or a table"),
        ("a.yaml", "", r"must come from a \.json or \.toml file"),
    ],
)
def test_files_that_hold_no_scenes_are_named(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        read_scenes(tmp_path / name)


def test_a_building_file_is_for_the_environment(tmp_path):
    """With a name of its own, too; and overrides of a building."""
    building = str(Path(__file__).parents[1] / "examples" / "warehouse.toml")
    assert read_scene(building) == building
    task = rl_task("selection").in_worlds(read_scene(building))
    assert len(task.make(1).scene.obstacles) == 4
    (tmp_path / "short.json").write_text(json.dumps({"name": building, "steps": 7}))
    task = rl_task("selection").in_worlds(read_scene(str(tmp_path / "short.json")))
    assert task.make(1).episode_steps == 7


def test_a_scene_file_without_a_name_is_refused(tmp_path):
    (tmp_path / "a.json").write_text('{"steps": 3}')
    with pytest.raises(ValueError, match="must hold a table with the key 'name'"):
        read_scene(str(tmp_path / "a.json"))


def test_a_task_in_other_worlds_keeps_what_else_it_says():
    task = rl_task("halls").in_worlds({"name": "hall", "steps": 5})
    assert task.arguments == {"k": 3, "scene": {"name": "hall", "steps": 5}}
    assert task.make(2).episode_steps == 5
    task = rl_task("selection").in_worlds(scenes=["hall"])
    assert task.scene_family().n_anchors == 12
    assert rl_task("selection").in_worlds() is rl_task("selection")
    with pytest.raises(ValueError, match="must be left out if scenes is given"):
        task.in_worlds("hall", ["hall"])


def test_a_task_of_one_scene_is_a_family_of_one():
    assert [one.n_anchors for one in rl_task("mobile-hard").scene_family().corners] == [2]


# --- the worlds in a policy's file ------------------------------------------------------------


def trained(monkeypatch, tmp_path, *options: str) -> str:
    """Return the file of `rbl-gym train selection` with a policy of zeros."""
    from rbl_gym.studies.learning import training

    def zeros(name, task, steps, seed, advance, algorithm):
        env = task.make(1)
        n, m = env.single_observation_space.shape[0], env.single_action_space.shape[0]
        policy = Policy((np.zeros((m, n)),), (np.linspace(-1, 1, m),), "box", {"task": name})
        return policy, {"steps": 0}

    monkeypatch.setattr(training, "train", zeros)
    monkeypatch.setattr(training, "require", lambda *_: None)
    monkeypatch.setattr(learning_commands, "_WORLDS", 2)
    path = str(tmp_path / f"p{len([*tmp_path.glob('*.npz')])}.npz")
    assert main(["train", "selection", "--out", path, "--json", *options]) == 0
    return path


def played(capsys, *paths: str) -> str:
    policies = [word for path in paths for word in ("--policy", path)]
    capsys.readouterr()
    code = main(["evaluate", "selection", "--references", "random", "--worlds", "2", "--json"]
                + policies)  # fmt: skip
    printed = capsys.readouterr()
    return json.loads(printed.out)["task"] if code == 0 else printed.err


def test_a_policy_keeps_the_scene_of_its_training(monkeypatch, tmp_path, capsys):
    """Its evaluation plays there, also when the file of the scene is gone."""
    file = tmp_path / "short.json"
    file.write_text(json.dumps({"name": "hall", "n_anchors": 5, "steps": 3}))
    path = trained(monkeypatch, tmp_path, "--scene", str(file))
    file.unlink()
    policy = policies.load(path)
    assert policy.meta["scene"] == {"name": "hall", "n_anchors": 5, "steps": 3}
    assert trained_worlds.common_worlds("selection", {"p": policy}) == {
        "scene": policy.meta["scene"]
    }
    assert trained_worlds.common_worlds("halls", {"p": policy}) == {}
    # The hall of the task has 12 anchors, which the policy does not fit.
    assert played(capsys, path) == "selection in the scene of the training"
    other = trained(monkeypatch, tmp_path)
    assert "scene" not in policies.load(other).meta
    assert "were trained in different scenes" in played(capsys, path, other)


def test_the_worlds_of_the_task_are_not_kept():
    assert trained_worlds.worlds_to_keep({}) == {}


def test_a_policy_keeps_families_of_scenes(monkeypatch, tmp_path, capsys):
    file = tmp_path / "halls.json"
    file.write_text(json.dumps([{"name": "hall", "steps": 2}]))
    path = trained(monkeypatch, tmp_path, "--family", str(file))
    assert policies.load(path).meta["scenes"] == [{"name": "hall", "steps": 2}]
    assert played(capsys, path) == "selection in the scene of the training"


def test_a_building_that_changed_since_the_training_is_named(monkeypatch, tmp_path, capsys):
    building = tmp_path / "warehouse.toml"
    building.write_text((ROOT / "examples" / "warehouse.toml").read_text())
    file = tmp_path / "short.json"
    file.write_text(json.dumps({"name": str(building), "steps": 3}))
    path = trained(monkeypatch, tmp_path, "--scene", str(file))
    digest = hashlib.sha256(building.read_bytes()).hexdigest()
    assert policies.load(path).meta["files"] == {str(building): digest}
    assert played(capsys, path) == "selection in the scene of the training"
    building.write_text(building.read_text() + "\n")
    assert "which has changed since" in played(capsys, path)
    building.unlink()
    assert "which is not here" in played(capsys, path)


# --- training ---------------------------------------------------------------------------------

FEW = RlTask(
    "RBL/MobileAnchors-v0",
    {"scenes": [DRAWN]},
    Training(24, 3, 0.9, num_envs=4, algorithm="set-ppo"),
)
SHORT = Training(9, 3, num_envs=3)
HALL = RlTask("RBL/AnchorSelection-v0", {"scene": {"name": "hall", "steps": 3}}, SHORT)
PRICED = RlTask(HALL.env_id, {**HALL.arguments, "mode": "priced"}, SHORT)
MOUNTS = RlTask(
    "RBL/AnchorPlacement-v0", dict(TASKS["mounts"].arguments), Training(20, 5, num_envs=4)
)


@pytest.mark.parametrize(
    ("task", "algorithm", "kind"),
    [
        (FEW, "set-ppo", "craft"),
        (HALL, "supervised", "sight"),
        (HALL, "recurrent-ppo", "box"),
        (MOUNTS, "maskable-ppo", "discrete"),
        (PRICED, "maskable-ppo", "multi-binary"),
    ],
)
@needs("torch", "stable_baselines3", "sb3_contrib")
def test_every_way_to_train_makes_a_policy_that_plays(monkeypatch, tmp_path, task, algorithm, kind):
    from rbl_gym.studies.learning import evaluation, sight_training, training

    monkeypatch.setattr(sight_training, "_TRACKS", 3)
    steps: list[int] = []
    made = [
        training.train("mine", task, task.training.steps, 1, steps.append, algorithm)
        for _ in range(2)
    ]
    policy, figures = made[0]
    assert policy.kind == kind
    assert policy.meta["algorithm"] == figures["algorithm"] == algorithm
    assert sum(steps) == 2 * task.training.steps
    for k, (one, _) in enumerate(made):
        policies.save(one, tmp_path / f"{k}.npz")
    # The same seed gives the same bytes.
    assert (tmp_path / "0.npz").read_bytes() == (tmp_path / "1.npz").read_bytes()
    again = policies.load(tmp_path / "0.npz")
    assert isinstance(again, SetPolicy if kind in ("craft", "sight") else Policy)
    told = evaluation.held_out_returns(task, again, 3, seed=0)
    assert np.isfinite(told["policy_mean_return"])


@pytest.mark.parametrize(
    ("task", "algorithm", "message"),
    [
        ("auv_buoys", "set-ppo", r"is for RBL/MobileAnchors-v0, got a task of RBL/AnchorPlace"),
        ("craft", "supervised", r"is for RBL/AnchorSelection-v0"),
        ("craft", "maskable-ppo", "is for tasks with discrete actions"),
        ("craft", "nix", "algorithm must be one of"),
    ],
)
def test_what_cannot_learn_a_task_is_named(task, algorithm, message):
    from rbl_gym.studies.learning import training

    assert {one.training.algorithm for one in TASKS.values()} <= set(training.ALGORITHMS)
    with pytest.raises(ValueError, match=message):
        training.train(task, rl_task(task), 10, 0, algorithm=algorithm)


@needs("torch", "stable_baselines3")
def test_advantages_by_hand():
    from rbl_gym.studies.learning import craft_training

    rng, gamma, mixing = np.random.default_rng(0), 0.9, 0.8
    reward, value = rng.standard_normal((5, 3)), rng.standard_normal((5, 3))
    last, beyond = rng.random((5, 3)) < 0.3, rng.standard_normal(3)
    nothing = np.zeros(0)
    rollout = craft_training._Rollout(*(nothing,) * 7, value=value, reward=reward, last=last)
    got, target = craft_training._advantages(rollout, beyond, gamma, mixing)
    scaled = value / (1 - gamma)
    for world in range(3):
        for start in range(5):
            total, factor = 0.0, 1.0
            for t in range(start, 5):
                after = scaled[t + 1, world] if t < 4 else beyond[world] / (1 - gamma)
                after = scaled[t, world] if last[t, world] else after
                total += factor * (reward[t, world] + gamma * after - scaled[t, world])
                factor *= gamma * mixing
                if last[t, world]:
                    break
            np.testing.assert_allclose(got[start, world], total)
    np.testing.assert_allclose(target, (got + scaled) * (1 - gamma))


@needs("torch", "stable_baselines3")
def test_a_new_policy_for_craft_is_the_orbit():
    from rbl_gym.studies.learning import craft_training
    from rbl_gym.wrappers import controllers

    env = rl_task("craft").make(4, "Disabled")
    seen, _ = env.reset(seed=0)
    network = craft_training._Learner.new().actor.arrays()
    actions = SetPolicy(network, "craft", {}).player()(env.unwrapped, seen)
    wanted = controllers.MOBILE["orbit"](env.unwrapped, np.random.default_rng(0))
    np.testing.assert_allclose(actions, wanted, atol=1e-9)


@pytest.mark.parametrize(
    ("task", "algorithm"),
    [(HALL, "recurrent-ppo"), (MOUNTS, "maskable-ppo"), (PRICED, "maskable-ppo")],
)
@needs("torch", "stable_baselines3", "sb3_contrib")
def test_files_play_what_the_model_would(task, algorithm):
    """The deterministic actions of stable-baselines3 itself, along an episode."""
    from rbl_gym.studies.learning import sb3_models, training
    from rbl_gym.wrappers.sb3 import Sb3VecEnv

    envs = Sb3VecEnv(task.make(3))
    model = training._model(algorithm, task.training, envs, 0)
    policy = sb3_models.policy_of(model)
    env = task.make(3, "Disabled")
    (seen, _), state, play = env.reset(seed=5), None, policy.player()
    for step in range(3):
        told = {}
        if algorithm == "maskable-ppo":
            told = {"action_masks": env.unwrapped.action_masks()}
        else:
            told = {"state": state, "episode_start": np.full(3, step == 0)}
        wanted, state = model.predict(seen, deterministic=True, **told)
        actions = play(env, seen)
        np.testing.assert_allclose(actions, wanted, atol=1e-5)
        seen = env.step(actions)[0]

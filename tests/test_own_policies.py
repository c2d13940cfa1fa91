"""Policies of the user's own in `evaluate` and its command: functions, models, environments."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym.app.cli import main
from rbl_gym.extras import MissingExtraError
from rbl_gym.studies.learning import own_policies, policies, training
from rbl_gym.studies.learning.evaluation import evaluate
from rbl_gym.studies.learning.own_policies import OwnPolicy, policies_by_label, policy_like
from rbl_gym.studies.learning.rl_tasks import rl_task, task_of
from rbl_gym.wrappers import controllers
from tests.helpers import needs
from tests.test_policies import random_policy

ID = "rbl_gym:RBL/AnchorSelection-v0"
SHORT: dict[str, Any] = {"k": 4, "scene": {"name": "hall", "steps": 6}}


def all_alike(seen):
    return np.ones((len(seen), 12))


def of_the_place(env, seen):
    """The controller `nearest`, written anew."""
    return -np.linalg.norm(env.anchors - env.belief.translation[:, None], axis=-1)


class Model:
    """As those of stable-baselines3."""

    def __init__(self):
        self.told: list[Any] = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        self.told.append((state, np.array(episode_start)))
        return np.ones((len(observation), 12)), (state or 0) + 1


def test_a_function_is_a_row_beside_the_references():
    mine = {"alike": all_alike, "place": of_the_place, "file": random_policy(sizes=(18, 4, 12))}
    scalar, vector = gym.make(ID, **SHORT), gym.make_vec(ID, num_envs=5, **SHORT)
    results = [evaluate(env, mine, ["nearest"], worlds=3, seed=1) for env in (scalar, vector)]
    assert results[0] == results[1]
    found = results[0]["methods"]
    assert list(found) == ["random", "nearest", "greedy-with-map", "alike", "place", "file"]
    assert found["place"] == found["nearest"]
    assert found["alike"]["loss"] > found["place"]["loss"]
    assert 0 < found["alike"]["score_m"] < 10
    one = evaluate(scalar, all_alike, ["random"], worlds=3, seed=1)["methods"]
    assert one["policy"] == found["alike"]


def test_a_model_with_predict_keeps_its_memory_within_an_episode():
    model = Model()
    found = evaluate(gym.make(ID, **SHORT), model, [], worlds=2)["methods"]
    alike = evaluate(gym.make(ID, **SHORT), all_alike, [], worlds=2)["methods"]
    assert found["policy"] == alike["policy"]
    assert [state for state, _ in model.told] == [None, 1, 2, 3, 4, 5]
    assert [start.tolist() for _, start in model.told] == [[True, True], *[[False, False]] * 5]


def test_a_model_with_masks_gets_them():
    class Masked(Model):
        def predict(self, observation, action_masks, **told):  # pyrefly: ignore[bad-override]
            assert action_masks.shape == (2, 24)
            return np.zeros((2, 12)), None

    env = gym.make(ID, mode="priced", scene={"name": "hall", "steps": 2})
    assert evaluate(env, Masked(), [], worlds=2)["methods"]["policy"]["score_m"] is None


def test_a_reward_of_ones_own_is_no_score_in_metres():
    env = gym.make(ID, **SHORT, reward="error")
    found = evaluate(env, all_alike, [], worlds=2)["methods"]
    assert {row["score_m"] for row in found.values()} == {None}
    assert found["random"]["loss"] > 0


def test_the_command_takes_a_function_of_a_module(tmp_path, monkeypatch, capsys):
    (tmp_path / "my_agent.py").write_text(
        "import numpy as np\n\ndef act(seen):\n    return np.ones((len(seen), 12))\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    policies.save(random_policy(sizes=(18, 4, 12), task="selection"), tmp_path / "file.npz")
    command = ["evaluate", "selection", "--worlds", "2", "--references", "random"]
    command += ["--policy", "my_agent:act", "--policy", "file.npz"]
    assert main([*command, "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["methods"])[-2:] == ["act", "file"]
    assert main([*command, "--policy", "my_agent:act"]) == 2
    assert "two policies are named 'act'" in capsys.readouterr().err
    assert main([*command[:-2], "--policy", "my_agent:nix"]) == 2
    assert "policy 'my_agent:nix' cannot be imported" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (lambda seen: np.ones(12), r"got \(12,\)\. It gets the observations of all worlds at once"),
        (lambda seen: np.ones((2, 5)), r"actions of shape \(2, 12\).*got \(2, 5\)$"),
        (lambda seen: np.full((2, 12), np.nan), "actions must be finite"),
        (3, "policy must be a file of rbl-gym train.*got 3"),
        (
            lambda a, b, c: a,
            r"function of \(observation\) or \(env, observation\), but .*<lambda> has the "
            r"arguments \(a, b, c\)",
        ),
        (lambda: 0, r"has the arguments \(\)"),
        ("no.such:function", "policy 'no.such:function' cannot be imported"),
        ({"random": all_alike}, "policy 'random' has the name of a reference"),
    ],
)
def test_what_is_no_policy_is_named_before_the_references_run(policy, message, monkeypatch):
    monkeypatch.setitem(controllers.SELECTION, "random", None)
    with pytest.raises(ValueError, match=message):
        evaluate(rl_task("selection"), policy, [], worlds=2)


def test_forms_of_policies():
    file = random_policy()
    assert policy_like(file) is file
    assert policies_by_label(None) == {}
    assert policies_by_label({"a": all_alike}) == {"a": OwnPolicy(all_alike)}
    assert policy_like(f"{own_policies.__name__}:policy_like") == OwnPolicy(policy_like)
    with pytest.raises(FileNotFoundError):
        policy_like("none.npz")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gym.make("rbl_gym:RBL/SharedAnchors-v0"), "an environment with references.*got"),
        (
            lambda: gym.wrappers.TransformReward(gym.make(ID), lambda reward: reward),
            "wrappers, got TransformReward",
        ),
        (lambda: "buoys", "task must be one of 'auv_buoys'"),
        (lambda: 3, "task must be one of auv_buoys,.*got 3"),
    ],
)
def test_what_is_no_task_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        task_of(make())


def test_a_missing_library_is_named_before_a_training_begins(monkeypatch, capsys):
    def missing(module, extra, what):
        raise MissingExtraError(f"needs {module}, extra {extra}")

    monkeypatch.setattr(training, "require", missing)
    with pytest.raises(MissingExtraError, match="needs torch"):
        training.check_training(rl_task("halls"), 0)
    assert main(["train", "halls"]) == 2
    # No progress bar before it.
    assert capsys.readouterr().err == "rbl-gym train: needs torch, extra rl\n"


@needs("torch", "stable_baselines3")
def test_a_model_of_stable_baselines3():
    from stable_baselines3 import PPO

    from rbl_gym.studies.learning.sb3_models import policy_of
    from rbl_gym.wrappers.sb3 import Sb3VecEnv

    envs = Sb3VecEnv(gym.make_vec(ID, num_envs=2, autoreset_mode="SameStep", **SHORT))
    model = PPO("MlpPolicy", envs, n_steps=2, batch_size=4, seed=0)
    both = {"model": model, "file": policy_of(model)}
    found = evaluate(gym.make(ID, **SHORT), both, [], worlds=3)["methods"]
    assert found["model"]["loss"] == pytest.approx(found["file"]["loss"], rel=1e-6)


@pytest.mark.parametrize(
    "arguments",
    [{}, {"sort_craft": False}, {"observation": "dict"}, {"scenes": "auv_craft"}],
)
def test_a_policy_of_craft_needs_only_the_anchors_and_the_belief(arguments):
    """Entries of actions and anchors belong to the same craft, in any order of the craft."""
    env: Any = gym.make("rbl_gym:RBL/MobileAnchors-v0", **arguments)
    envs: Any = gym.make_vec("rbl_gym:RBL/MobileAnchors-v0", num_envs=6, **arguments)
    for one, batch in ((env.unwrapped, ()), (envs.unwrapped, (6,))):
        one.reset(seed=2)
        before = one.anchors
        gap = before[..., :2] - one.belief.translation[..., None, :2]
        if not arguments:
            bearing = np.arctan2(gap[..., 1], gap[..., 0])
            assert (np.diff(bearing, axis=-1) > 0).all()
            np.testing.assert_array_equal(
                before,
                np.take_along_axis(one.inner_observation["anchors"], one.order[..., None], -2),
            )
        velocity = np.random.default_rng(1).uniform(-0.7, 0.7, (*batch, 3, 2))
        numbers = one.order.copy()
        one.step(velocity.reshape(*batch, 6))
        after = np.take_along_axis(one.inner_observation["anchors"], numbers[..., None], axis=-2)
        np.testing.assert_allclose((after - before)[..., :2], 8 * velocity, atol=1e-9)


def circle(env, observation):
    """The policy of docs/environments/mobile_anchors.md."""
    gap = env.anchors[..., :2] - env.belief.translation[:, None, :2]
    radius = 0.9 * np.abs(env.belief.translation[:, 2:])
    slot = 2 * np.pi / 3 * np.arange(3)
    angle = np.arctan2(gap[..., 1], gap[..., 0])
    turn = np.angle(np.exp(1j * (angle - slot)).mean(axis=1, keepdims=True))
    place = turn + slot + 8.0 / radius
    target = radius[..., None] * np.stack([np.cos(place), np.sin(place)], axis=-1)
    return ((target - gap) / 8.0).reshape(len(gap), -1)


def test_the_policy_of_the_page_is_as_good_as_the_orbit():
    """It is the orbit without the prediction of one step: within 0.05 of its mean log b."""
    losses = {}
    for name in ("mine", "orbit", "random"):
        env: Any = gym.make_vec("rbl_gym:RBL/MobileAnchors-v0", num_envs=16).unwrapped
        seen, _ = env.reset(seed=3)
        rng, total = np.random.default_rng(0), 0.0
        for _ in range(40):
            actions = circle(env, seen) if name == "mine" else controllers.MOBILE[name](env, rng)
            seen, reward, *_ = env.step(actions)
            total -= reward.mean() / 40
        losses[name] = total
    assert abs(losses["mine"] - losses["orbit"]) < 0.05 < losses["random"] - losses["orbit"]

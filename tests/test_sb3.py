"""The adapter to stable-baselines3, and the training that uses it."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra rl")

from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from rbl_gym.app.cli import main
from rbl_gym.envs.placement import AnchorPlacementEnv
from rbl_gym.studies.learning import policies, training
from rbl_gym.studies.learning.rl_tasks import RlTask, Training
from rbl_gym.wrappers.sb3 import Sb3VecEnv
from rbl_gym.wrappers.tasks import MobileAnchorsEnv

ENVS: dict[str, tuple[str, dict[str, Any]]] = {
    "placement": ("RBL/AnchorPlacement-v0", {}),
    "at once": ("RBL/AnchorPlacement-v0", {"scene": "uwb_room", "mode": "one-shot", "racks": 2}),
    "mounts": ("RBL/AnchorPlacement-v0", {"scene": "uwb_room", "mode": "mounts"}),
    "mobile": ("RBL/MobileAnchors-v0", {"scene": {"name": "auv_craft", "steps": 6}}),
    "selection": ("RBL/AnchorSelection-v0", {"scene": {"name": "hall", "steps": 6}}),
    "priced": ("RBL/AnchorSelection-v0", {"mode": "priced", "scene": {"name": "hall", "steps": 6}}),
}
every_env = pytest.mark.parametrize("kind", ENVS)


def vector(kind, n=4, mode="SameStep"):
    env_id, arguments = ENVS[kind]
    return gym.make_vec(f"rbl_gym:{env_id}", num_envs=n, autoreset_mode=mode, **arguments)


@every_env
def test_their_checker_has_no_complaint(kind):
    env_id, arguments = ENVS[kind]
    check_env(gym.make(f"rbl_gym:{env_id}", **arguments).unwrapped, skip_render_check=True)


def ppo(envs, **arguments):
    return PPO("MlpPolicy", envs, n_steps=25, batch_size=100, n_epochs=2, device="cpu",
               policy_kwargs={"net_arch": [16]}, **arguments)  # fmt: skip


@every_env
def test_ppo_learns_2000_steps(kind):
    envs = Sb3VecEnv(vector(kind))
    model = ppo(envs, seed=1).learn(2000)
    assert model.num_timesteps == 2000
    assert len(model.ep_info_buffer) == 100
    assert np.isfinite([info["r"] for info in model.ep_info_buffer]).all()
    mean, _ = evaluate_policy(model, envs, n_eval_episodes=8)
    assert np.isfinite(mean)


@pytest.mark.parametrize("kind", ["placement", "mobile"])
def test_ends_of_episodes_as_scalar_environments_have_them(kind):
    envs = Sb3VecEnv(vector(kind, 2))
    peers = [
        (AnchorPlacementEnv if kind == "placement" else MobileAnchorsEnv)(**ENVS[kind][1])
        for _ in range(2)
    ]
    envs.seed(5)
    observations = envs.reset()
    for i, peer in enumerate(peers):
        np.testing.assert_allclose(observations[i], peer.reset(seed=5 + i)[0], atol=1e-6)
    rng, returns, ends = np.random.default_rng(0), np.zeros(2), 0
    for _ in range(13):
        actions = rng.uniform(-1, 1, (2, *envs.action_space.shape)).astype(np.float32)
        observations, rewards, dones, infos = envs.step(actions)
        assert (observations.dtype, rewards.dtype, dones.dtype) == (np.float32, np.float32, bool)
        for i, peer in enumerate(peers):
            last, reward, terminated, truncated, info = peer.step(actions[i])
            returns[i] += reward
            np.testing.assert_allclose(rewards[i], reward, rtol=1e-4, atol=1e-6)
            assert dones[i] == (terminated or truncated)
            if not dones[i]:
                assert infos[i] == {}
                np.testing.assert_allclose(observations[i], last, atol=1e-4)
                continue
            ends += 1
            np.testing.assert_allclose(infos[i]["terminal_observation"], last, atol=1e-4)
            assert infos[i]["TimeLimit.truncated"] is truncated is (kind == "mobile")
            assert infos[i]["episode"]["l"] == (4 if kind == "placement" else 6)
            np.testing.assert_allclose(infos[i]["episode"]["r"], returns[i], rtol=1e-4)
            np.testing.assert_allclose(infos[i]["score_m"], info["score_m"], rtol=1e-4)
            returns[i] = 0
            np.testing.assert_allclose(observations[i], peer.reset()[0], atol=1e-4)
    assert ends == (6 if kind == "placement" else 4)


def test_seeds_are_used_once_and_reproduce():
    envs = Sb3VecEnv(vector("placement"))
    assert envs.seed(3) == [3, 4, 5, 6]
    first, second = envs.reset(), envs.reset()
    envs.seed(3)
    np.testing.assert_array_equal(envs.reset(), first)
    np.testing.assert_array_equal(envs.reset(), second)
    assert (first != second).any()
    assert len(set(envs.seed())) == 4


def test_what_the_adapter_says_and_refuses():
    for mode in ("NextStep", "Disabled"):
        with pytest.raises(ValueError, match="envs must have autoreset_mode 'SameStep', got"):
            Sb3VecEnv(vector("placement", 2, mode))
    envs = Sb3VecEnv(vector("placement", 3))
    assert envs.env_is_wrapped(Monitor) == [True] * 3
    assert envs.env_is_wrapped(gym.Wrapper, [0]) == [False]
    assert envs.get_attr("num_envs", [0, 2]) == [3, 3]
    with pytest.raises(NotImplementedError, match="share their attributes"):
        envs.set_attr("scene", None)
    with pytest.raises(NotImplementedError, match="have no methods"):
        envs.env_method("reset")
    envs.close()


# --- training ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "kind"),
    [("auv_buoys", "box"), ("selection-priced", "multi-binary"), ("mounts", "discrete")],
)
def test_train_twice_gives_the_same_bytes_and_a_small_file(task, kind, tmp_path, capsys):
    paths = [tmp_path / name for name in ("a.npz", "b.npz", "c.npz")]
    for path, seed in zip(paths, "001", strict=True):
        arguments = ["train", task, "--steps", "2048", "--seed", seed, "--out", str(path)]
        assert main([*arguments, "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        assert result["policy"] == str(path)
        assert result["steps"] >= 2048
        assert 0 < result["env_share"] < 1
    data = [path.read_bytes() for path in paths]
    assert data[0] == data[1] != data[2]
    assert len(data[0]) < 200_000
    policy = policies.load(paths[0])
    assert policy.kind == kind
    assert policy.meta == {
        "task": task,
        "seed": 0,
        "steps": 2048,
        "algorithm": "ppo",
        "command": f"rbl-gym train {task} --steps 2048 --seed 0",
    }
    if task == "selection-priced":
        arguments = ["evaluate", task, "--worlds", "1", "--references", "random", "--json"]
        assert main([*arguments, "--policy", str(paths[0])]) == 0
        assert "a" in json.loads(capsys.readouterr().out)["methods"]


def test_trainings_of_different_seeds_see_different_worlds(monkeypatch):
    seen = []

    def make(task, num_envs, autoreset_mode="SameStep"):
        envs: Any = gym.make_vec(
            f"rbl_gym:{task.env_id}", num_envs=num_envs, autoreset_mode=autoreset_mode
        )
        reset = envs.reset

        def noted(**arguments):
            result = reset(**arguments)
            seen.append({tuple(row) for row in envs.contexts.centre})
            return result

        envs.reset = noted
        return envs

    monkeypatch.setattr(RlTask, "make", make)
    short = Training(64, 4, num_envs=16, batch_size=64, epochs=1)
    task = RlTask("RBL/AnchorPlacement-v0", {}, short)
    for seed in (0, 1):
        training.train("auv_buoys", task, 64, seed, lambda _: None)
    assert [len(worlds) for worlds in seen] == [16, 16]
    assert not seen[0] & seen[1]

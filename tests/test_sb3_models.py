"""Models of stable-baselines3 as policy files: the same actions, and unsupported models."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra rl")
pytest.importorskip("sb3_contrib", reason="needs the extra rl")

import torch
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from rbl_gym.app.cli import main
from rbl_gym.studies.learning import policies
from rbl_gym.studies.learning.sb3_models import policy_of
from rbl_gym.wrappers.sb3 import Sb3VecEnv
from tests.test_sb3 import every_env, vector

SMALL: dict[str, Any] = {"n_steps": 16, "device": "cpu", "seed": 3}
RELU = {"net_arch": [32, 16], "activation_fn": torch.nn.ReLU}


def model_of(kind, form=PPO, **changes):
    """A model with weights that no initialisation made alike."""
    arguments = {**SMALL, "batch_size": 64, **changes}
    if form is A2C:
        del arguments["batch_size"]
    policy = "MlpLstmPolicy" if form is RecurrentPPO else "MlpPolicy"
    return spread(form(policy, Sb3VecEnv(vector(kind, 4)), **arguments))


def spread(model):
    """The model with larger weights: its actions differ from one observation to the other."""
    numbers = torch.manual_seed(0)
    with torch.no_grad():
        for weight in model.policy.parameters():
            if weight.ndim == 2:
                weight.add_(0.6 * torch.randn(weight.shape, generator=numbers))
    return model


def assert_same_actions(got, wanted, kind):
    if kind == "box":
        np.testing.assert_allclose(got, wanted, atol=1e-5)
    else:
        np.testing.assert_array_equal(got, wanted)


@every_env
@pytest.mark.parametrize(
    ("form", "changes"),
    [(PPO, {}), (PPO, {"policy_kwargs": RELU}), (A2C, {"policy_kwargs": {"net_arch": []}})],
)
def test_the_file_plays_the_models_actions(kind, form, changes, tmp_path):
    model = model_of(kind, form, **changes)
    policies.save(policy_of(model, kind), tmp_path / "p.npz")
    policy: Any = policies.load(tmp_path / "p.npz")
    assert policy.meta == {"task": kind, "algorithm": form.__name__.lower(), "steps": 0}
    envs = vector(kind, 64)
    observations, _ = envs.reset(seed=1)
    for _ in range(4):
        wanted, _ = model.predict(observations, deterministic=True)
        assert_same_actions(policy(observations), wanted, policy.kind)
        observations, *_ = envs.step(wanted)
    shown = np.random.default_rng(2).uniform(-1, 1, observations.shape).astype(np.float32)
    wanted, _ = model.predict(shown, deterministic=True)
    assert wanted.std(axis=0).max() > 0
    assert_same_actions(policy(shown), wanted, policy.kind)


@pytest.mark.parametrize("kind", ["mounts", "priced"])
def test_masks_are_kept(kind, tmp_path):
    if kind == "priced":
        # Halls with fewer anchors than places for them.
        drawn = {"name": "hall", "n_anchors": {"integers": [6, 12]}, "steps": 5}
        arguments = {"mode": "priced", "scenes": [drawn]}
        envs = gym.make_vec("rbl_gym:RBL/AnchorSelection-v0", num_envs=32,
                            autoreset_mode="SameStep", **arguments)  # fmt: skip
    else:
        envs = vector(kind, 32)
    model = spread(MaskablePPO("MlpPolicy", Sb3VecEnv(envs), batch_size=64, **SMALL))
    policies.save(policy_of(model), tmp_path / "p.npz")
    play = policies.load(tmp_path / "p.npz").player()
    observations, _ = envs.reset(seed=1)
    worlds: Any = envs.unwrapped
    told = 0
    for _ in range(5):
        masks = worlds.action_masks()
        free, _ = model.predict(observations, deterministic=True)
        wanted, _ = model.predict(observations, deterministic=True, action_masks=masks)
        np.testing.assert_array_equal(play(envs, observations), wanted)
        told += (free != wanted).sum()
        observations, *_ = envs.step(wanted)
    # The masks forbade something.
    assert told > 0


def test_a_memory_is_kept(tmp_path):
    lstm = {"lstm_hidden_size": 8, "net_arch": [12]}
    model = model_of("mobile", RecurrentPPO, policy_kwargs=lstm)
    policies.save(policy_of(model), tmp_path / "p.npz")
    policy: Any = policies.load(tmp_path / "p.npz")
    assert policy.meta["algorithm"] == "recurrent-ppo"
    play, envs, state = policy.player(), vector("mobile", 16), None
    observations, _ = envs.reset(seed=1)
    for _ in range(4):
        wanted, state = model.predict(observations, state=state, deterministic=True)
        np.testing.assert_allclose(play(envs, observations), wanted, atol=1e-5)
        observations, *_ = envs.step(wanted)


def test_observations_through_vec_normalize_are_scaled_in_the_file(tmp_path):
    envs = VecNormalize(Sb3VecEnv(vector("mobile", 8)), clip_obs=1.5)
    model = spread(PPO("MlpPolicy", envs, batch_size=64, **SMALL).learn(200))
    policies.save(policy_of(model), tmp_path / "p.npz")
    policy: Any = policies.load(tmp_path / "p.npz")
    observations, _ = vector("mobile", 256).reset(seed=1)
    scaled = envs.normalize_obs(observations)
    assert (np.abs(scaled) == 1.5).any()
    wanted, _ = model.predict(scaled, deterministic=True)
    np.testing.assert_allclose(policy(observations), wanted, atol=1e-5)
    # Of a model from a file nobody knows it.
    model.save(tmp_path / "m.zip")
    loaded = PPO.load(tmp_path / "m.zip", device="cpu")
    assert policy_of(loaded).scaling is None
    again = policy_of(loaded, normalize=envs)
    np.testing.assert_allclose(again(observations), wanted, atol=1e-5)
    other = VecNormalize(Sb3VecEnv(vector("selection", 2)))
    with pytest.raises(
        ValueError, match=r"normalize must have observations of shape \(\d+,\), got"
    ):
        policy_of(loaded, normalize=other)


def small(observation=None, action=None, form=PPO, policy: Any = "MlpPolicy", **changes):
    """A model on an environment of these spaces, which does nothing."""
    unit = gym.spaces.Box(-1, 1, (3,))

    class Still(gym.Env):
        observation_space = observation or unit
        action_space = action or unit

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), 0.0, True, False, {}

    return form(policy, DummyVecEnv([Still]), device="cpu", **changes)


class Doubled(FlattenExtractor):
    def forward(self, observations):
        return 2 * super().forward(observations)


def replaced(**parts):
    model = small()
    for name, part in parts.items():
        setattr(model.policy, name, part)
    return model


def odd(model):
    """A layer that looks like one of theirs and does something else."""
    forward = model.policy.action_net.forward
    model.policy.action_net.forward = lambda x: forward(x) + 1
    return model


box = gym.spaces.Box
IMAGE = box(0, 255, (36, 36, 3), np.uint8)
BOTH = gym.spaces.Dict({"a": box(-1, 1, (2,)), "b": box(-1, 1, (2,))})
LSTM = {"form": RecurrentPPO, "policy": "MlpLstmPolicy"}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: "no model", "a PPO, A2C, MaskablePPO or RecurrentPPO .* got str"),
        (lambda: small(form=SAC), "got SAC"),
        (lambda: small(action=gym.spaces.Discrete(3), form=DQN), "got DQN"),
        (lambda: small(IMAGE, policy="CnnPolicy"), "observe one vector.* got Box"),
        (lambda: small(box(-1, 1, (4, 3))), r"observe one vector.*\(4, 3\)"),
        (lambda: small(BOTH, policy="MultiInputPolicy"), "got Dict.*observation='flat'"),
        (lambda: small(gym.spaces.Discrete(4)), "observe one vector"),
        (lambda: small(action=box(-2, 2, (3,))), r"actions in Box\(-1, 1, \(n,\)\).*got Box\(-2"),
        (lambda: small(action=box(-1, 1, (3, 2))), r"actions in Box\(-1, 1, \(n,\)\)"),
        (lambda: small(action=gym.spaces.MultiDiscrete([2, 3])), "got MultiDiscrete"),
        (
            lambda: small(policy_kwargs={"features_extractor_class": Doubled}),
            "without a custom features extractor, got Doubled",
        ),
        (
            lambda: small(policy=type("Mine", (PPO.policy_aliases["MlpPolicy"],), {})),
            "without a custom policy class, got Mine",
        ),
        (
            lambda: replaced(mlp_extractor=torch.nn.Sequential()),
            "without a custom network, got Sequential",
        ),
        (
            lambda: replaced(action_net=torch.nn.Sequential()),
            "without a custom last layer, got Sequential",
        ),
        (
            lambda: small(policy_kwargs={"activation_fn": torch.nn.ELU}),
            "Tanh or ReLU as activation_fn, got ELU",
        ),
        (lambda: small(use_sde=True, policy_kwargs={"squash_output": True}), "squash_output=False"),
        (lambda: small(**LSTM, policy_kwargs={"n_lstm_layers": 2}), "one LSTM layer"),
        (lambda: odd(small()), "only 0% of its actions"),
    ],
)
def test_what_cannot_be_converted_is_named(make, message):
    with pytest.raises(ValueError, match=f"model must .*{message}"):
        policy_of(make())


def test_commands_play_the_file_and_need_no_torch(tmp_path, capsys):
    path = tmp_path / "mine.npz"
    policies.save(policy_of(model_of("placement"), "auv_buoys"), path)
    players = ["auv_buoys", "--policy", str(path), "--references", "random,ring", "--worlds", "2"]
    code = (
        "import sys\n"
        "from rbl_gym.studies.learning import policies, rollouts\n"
        "from rbl_gym.studies.learning.rl_tasks import rl_task\n"
        f"policy = policies.load({str(path)!r})\n"
        "print(rollouts.returns(rl_task('auv_buoys'), policy.player(), 2, 0)[0])\n"
        "assert 'torch' not in sys.modules and 'stable_baselines3' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert main(["transfer", *players, "--repeats", "1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert np.isfinite(told["filters"]["iekf"]["mine"]["tag_rmse_m"])

"""Policies in numpy: by hand, through their files, and invalid files."""

from __future__ import annotations

import itertools
import json
import math
import zipfile
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym.studies.learning import policies
from rbl_gym.studies.learning.policies import Policy, Scaling

SIZES = (5, 8, 3)


def random_policy(kind="box", sizes=SIZES, seed=0, **meta):
    rng = np.random.default_rng(seed)
    pairs = list(itertools.pairwise(sizes))
    return Policy(
        tuple(rng.standard_normal((b, a)).astype(np.float32).astype(float) for a, b in pairs),
        tuple(rng.standard_normal(b).astype(np.float32).astype(float) for _, b in pairs),
        kind,
        {"task": "auv_buoys", **meta},
    )


@pytest.mark.parametrize("kind", policies.KINDS)
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_actions_by_hand(kind, batch):
    policy = random_policy(kind)
    observations = np.random.default_rng(1).standard_normal((*batch, 5)).astype(np.float32)
    actions = policy(observations)
    for index in np.ndindex(batch):
        hidden = np.tanh(policy.weights[0] @ observations[index].astype(float) + policy.biases[0])
        output = policy.weights[1] @ hidden + policy.biases[1]
        wanted = {
            "box": np.clip(output, -1, 1),
            "discrete": int(np.argmax(output)),
            "multi-binary": [int(value > 0) for value in output],
        }[kind]
        np.testing.assert_allclose(actions[index], wanted, atol=1e-12)
    dtype = {"box": np.float64, "discrete": np.int64, "multi-binary": np.int8}[kind]
    assert actions.dtype == dtype
    assert actions.shape == (batch if kind == "discrete" else (*batch, 3))


@pytest.mark.parametrize("kind", policies.KINDS)
@pytest.mark.parametrize("sizes", [SIZES, (4, 2), (22, 128, 128, 3)])
def test_files_give_the_same_policy_back(tmp_path, kind, sizes):
    policy = random_policy(kind, sizes, seed=3, command="rbl-gym train auv_buoys", steps=10)
    path = tmp_path / "new" / "policy.npz"
    policies.save(policy, path)
    again = policies.load(path)
    assert isinstance(again, policies.Policy)
    assert (again.kind, again.meta) == (kind, policy.meta)
    for got, want in zip(
        (*again.weights, *again.biases), (*policy.weights, *policy.biases), strict=True
    ):
        np.testing.assert_array_equal(got, want)
    policies.save(again, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()
    assert path.stat().st_size < 200_000


@pytest.mark.parametrize("activation", policies.ACTIVATIONS)
def test_scaled_observations_and_activations_by_hand_and_through_a_file(activation, tmp_path):
    function = {"tanh": math.tanh, "relu": lambda x: max(x, 0.0)}[activation]
    rng = np.random.default_rng(4)
    scaling = Scaling(rng.integers(-3, 4, 5) / 4, rng.integers(1, 5, 5) / 4, 1.5)
    policy = random_policy()._replace(activation=activation, scaling=scaling)
    policies.save(policy, tmp_path / "policy.npz")
    again = policies.load(tmp_path / "policy.npz")
    assert isinstance(again, Policy)
    assert (again.activation, again.meta) == (activation, policy.meta)
    seen = rng.standard_normal((7, 5))
    clipped = 0
    for observation, got, one in zip(seen, again(seen), policy(seen), strict=True):
        ratio = [(x - m) / s for x, m, s in zip(observation, *scaling[:2], strict=True)]
        clipped += sum(abs(x) > 1.5 for x in ratio)
        hidden = policy.weights[0] @ [min(max(x, -1.5), 1.5) for x in ratio] + policy.biases[0]
        wanted = policy.weights[1] @ [function(x) for x in hidden] + policy.biases[1]
        np.testing.assert_allclose(got, np.clip(wanted, -1, 1), atol=1e-12)
        np.testing.assert_allclose(one, got, atol=1e-12)
    assert 0 < clipped < seen.size


def test_masks_of_a_multi_binary_policy_forbid_choices():
    policy = random_policy("multi-binary")
    seen = np.random.default_rng(5).standard_normal((20, 5))
    free, mask = policy(seen), np.ones((20, 6), dtype=bool)
    mask[:, 3] = False  # the second of three may not be 1
    np.testing.assert_array_equal(policy(seen, mask), free * [1, 0, 1])
    assert free[:, 1].any()


def test_a_wrong_observation_is_named():
    with pytest.raises(ValueError, match="must have 5 entries for this policy, got 6"):
        random_policy()(np.zeros((2, 6)))


def arrays(**changes) -> dict[str, Any]:
    policy = random_policy()
    good = {
        "weight_0": policy.weights[0],
        "bias_0": policy.biases[0],
        "weight_1": policy.weights[1],
        "bias_1": policy.biases[1],
        "meta": np.array(json.dumps({"kind": "box", "task": "auv_buoys"})),
    }
    return {key: value for key, value in {**good, **changes}.items() if value is not None}


def scaled(**changes):
    good = {"mean": np.zeros(5), "scale": np.ones(5), "clip": np.array(10.0)}
    return {f"scaling_{name}": array for name, array in {**good, **changes}.items()}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"meta": None}, "meta"),
        ({"meta": np.array("no json")}, "is not a policy of rbl-gym"),
        ({"meta": np.array("[1]")}, "is not a policy of rbl-gym"),
        ({"meta": np.array("{}")}, "kind"),
        ({"meta": np.array('{"kind": "fuzzy"}')}, "kind must be one of 'box'"),
        ({"weight_0": None, "bias_0": None}, "is not a policy of rbl-gym"),
        ({f"{n}_{k}": None for n in ("weight", "bias") for k in (0, 1)}, "the file has no layers"),
        ({"bias_1": None}, "bias_1"),
        ({"bias_1": np.zeros(4)}, "weight_1 must have shape"),
        ({"weight_1": np.zeros((3, 9))}, "weight_1 must have shape"),
        ({"weight_0": np.zeros(5)}, "weight_0 must have shape"),
        ({"weight_0": np.full((8, 5), np.nan)}, "weight_0 must be finite"),
        ({"bias_0": np.full(8, np.inf)}, "bias_0 must be finite"),
        ({"meta": np.array('{"kind": "box", "activation": "elu"}')}, "activation must be one of"),
        ({"scaling_clip": np.array(1.0)}, "is not a policy of rbl-gym"),
        (scaled(scale=np.zeros(5)), "must be positive"),
        (scaled(clip=np.array(-1.0)), "must be positive"),
        (scaled(mean=np.zeros(4)), "scaling_mean must have shape"),
        ({"weight_0": np.array("text")}, "is not a policy of rbl-gym"),
    ],
)
def test_archives_that_hold_no_policy_are_refused(tmp_path, changes, message):
    path = tmp_path / "p.npz"
    np.savez(path, **arrays(**changes))
    with pytest.raises(ValueError, match=message) as caught:
        policies.load(path)
    assert str(caught.value).startswith(f"{path} is not a policy of rbl-gym")


def test_a_model_of_stable_baselines3_is_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "model.zip", "w") as archive:
        archive.writestr("policy.pth", b"")
    with pytest.raises(ValueError, match=r"a model of stable-baselines3. Convert it by.*policy_of"):
        policies.load(tmp_path / "model.zip")


@pytest.mark.parametrize("damage", ["empty", "text", "half", "flipped", "array"])
def test_files_that_are_no_archive_are_refused(tmp_path, damage):
    path = tmp_path / "p.npz"
    policies.save(random_policy(sizes=(22, 128, 3)), path)
    data = path.read_bytes()
    middle = len(data) // 2
    spoiled = bytes(255 - byte for byte in data[middle : middle + 64])
    content = {
        "empty": b"",
        "text": b"not a policy",
        "half": data[:middle],
        "flipped": data[:middle] + spoiled + data[middle + 64 :],
    }
    if damage == "array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    else:
        path.write_bytes(content[damage])
    with pytest.raises(ValueError, match="is not a policy of rbl-gym"):
        policies.load(path)
    with pytest.raises(FileNotFoundError):
        policies.load(tmp_path / "none.npz")


def test_kinds_of_action_spaces():
    assert policies.kind_and_outputs(gym.spaces.Discrete(57)) == ("discrete", 57)
    assert policies.kind_and_outputs(gym.spaces.MultiBinary(12)) == ("multi-binary", 12)
    assert policies.kind_and_outputs(gym.spaces.Box(-1, 1, (6,))) == ("box", 6)


def test_a_policy_that_does_not_fit_is_named():
    envs = gym.make_vec("rbl_gym:RBL/AnchorSelection-v0", num_envs=1)
    policies.check_fit(random_policy(sizes=(18, 4, 12)), "mine", envs)
    for wrong in (
        random_policy(sizes=(17, 4, 12)),
        random_policy(sizes=(18, 4, 11)),
        random_policy("multi-binary", sizes=(18, 4, 12)),
    ):
        with pytest.raises(ValueError, match="policy 'mine' does not fit: it was trained on"):
            policies.check_fit(wrong, "mine", envs)
    envs.single_observation_space = gym.spaces.Box(0.0, 1.0, (18, 2))
    with pytest.raises(ValueError, match=r"task has an observation of shape \(18, 2\) and 12 out"):
        policies.check_fit(random_policy("multi-binary", sizes=(18, 4, 12)), "mine", envs)

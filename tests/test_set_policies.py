"""Policies for any number of anchors: by hand, in any order, padded, turned, and through files."""

from __future__ import annotations

import itertools
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym.geometry import rotations
from rbl_gym.studies.learning import policies
from rbl_gym.studies.learning.deep_sets import SUM_SCALE, DeepSets
from rbl_gym.studies.learning.policies import Lstm, Policy
from rbl_gym.studies.learning.rl_tasks import rl_task
from rbl_gym.studies.learning.set_policies import SET_KINDS, SetPolicy
from rbl_gym.wrappers import craft_tokens, sight_tokens
from rbl_gym.wrappers.controllers import MOBILE, greedy
from rbl_gym.wrappers.situations import situations


def layers(rng, *sizes):
    return tuple(
        (
            (rng.standard_normal((b, a)) / math.sqrt(a)).astype(np.float32).astype(float),
            (0.1 * rng.standard_normal(b)).astype(np.float32).astype(float),
        )
        for a, b in itertools.pairwise(sizes)
    )


def network(kind, seed=0):
    rng = np.random.default_rng(seed)
    n_own, n_pair, n_out = SET_KINDS[kind][1]
    return DeepSets(layers(rng, n_own + n_pair, 8, 6), layers(rng, n_own + 12, 10, n_out))


def set_policy(kind, seed=0):
    return SetPolicy(network(kind, seed), kind, {"task": "craft"})


def mlp(x, parts, last=True):
    for k, (weight, bias) in enumerate(parts):
        x = weight @ x + bias
        x = np.tanh(x) if last or k < len(parts) - 1 else x
    return x


def test_sets_by_hand():
    rng = np.random.default_rng(1)
    net = network("craft", 2)
    n_own, n_pair, _ = SET_KINDS["craft"][1]
    own, pairs = rng.standard_normal((4, n_own)), rng.standard_normal((4, 5, n_pair))
    others = np.array([[1, 1, 0, 1, 1], [0, 0, 0, 0, 0], [1, 0, 0, 0, 0], [1, 1, 1, 1, 1]])
    got = net(own, pairs, others)
    for i in range(4):
        told = [mlp(np.r_[own[i], pairs[i, j]], net.inner) for j in np.flatnonzero(others[i])]
        total = SUM_SCALE * np.sum(told, axis=0) if told else np.zeros(6)
        most = np.max(told, axis=0) if told else np.full(6, -1.0)
        wanted = mlp(np.r_[own[i], total, most], net.outer, last=False)
        np.testing.assert_allclose(got[i], wanted, atol=1e-12)


def test_sets_in_torch_are_those_in_numpy():
    torch = pytest.importorskip("torch")
    from rbl_gym.studies.learning.set_networks import SetNetwork

    torch.manual_seed(0)
    net, rng = SetNetwork(7, 3, 2, inner=(8, 6), outer=(9,)), np.random.default_rng(0)
    own, pairs = rng.standard_normal((2, 4, 7)), rng.standard_normal((2, 4, 5, 3))
    others = (rng.random((2, 4, 5)) < 0.6).astype(float)
    others[0, 1] = 0.0
    told = (torch.as_tensor(one, dtype=torch.float32) for one in (own, pairs, others))
    np.testing.assert_allclose(
        net(*told).detach().numpy(), net.arrays()(own, pairs, others), atol=1e-5
    )


def test_a_memory_in_torch_is_that_in_numpy():
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    layer, rng = torch.nn.LSTM(5, 4), np.random.default_rng(0)
    reads, recalls, *biases = (one.detach().numpy().astype(float) for one in layer.parameters())
    lstm = Lstm(reads, recalls, np.sum(biases, axis=0))
    seen = rng.standard_normal((6, 3, 5))
    wanted = layer(torch.as_tensor(seen, dtype=torch.float32))[0].detach().numpy()
    state = np.zeros((3, 4)), np.zeros((3, 4))
    for one, out in zip(seen, wanted, strict=True):
        state = lstm(one, *state)
        np.testing.assert_allclose(state[0], out, atol=1e-6)


def test_a_policy_with_a_memory_is_played_from_the_start_and_kept_in_files(tmp_path):
    rng = np.random.default_rng(3)

    def draw(*shape):
        return rng.standard_normal(shape).astype(np.float32).astype(float)

    lstm = Lstm(draw(12, 5), draw(12, 3), draw(12))
    policy = Policy((draw(2, 3),), (draw(2),), "box", {"task": "selection"}, lstm)
    policies.save(policy, tmp_path / "memory.npz")
    again = policies.load(tmp_path / "memory.npz")
    assert isinstance(again, Policy)
    seen = rng.standard_normal((4, 2, 5))
    plays = [one.player() for one in (policy, policy, again)]
    actions = [[play(None, one) for one in seen] for play in plays]
    np.testing.assert_array_equal(actions[0], actions[1])
    np.testing.assert_array_equal(actions[0], actions[2])
    # The same observation, another memory.
    play = policy.player()
    assert np.abs(play(None, seen[0]) - play(None, seen[0])).max() > 1e-6
    with pytest.raises(ValueError, match="played by player"):
        policy(seen[0])
    with pytest.raises(ValueError, match="must have 5 entries"):
        policy.player()(None, seen[..., :4])


def test_masked_actions_are_never_chosen():
    policy = Policy((np.eye(3),), (np.zeros(3),), "discrete", {"algorithm": "maskable-ppo"})
    seen = np.array([[1.0, 3.0, 2.0], [5.0, 0.0, 1.0]])
    mask = np.array([[True, False, True], [False, True, True]])

    class Env:
        unwrapped: Env

        def action_masks(self):
            return mask

    env = Env()
    env.unwrapped = env
    assert policy.player()(env, seen).tolist() == [2, 2]
    assert policy(seen).tolist() == [1, 0]


@pytest.mark.parametrize("kind", SET_KINDS)
def test_files_give_the_same_policy_back(tmp_path, kind):
    policy = set_policy(kind)
    path = tmp_path / "policy.npz"
    policies.save(policy, path)
    again = policies.load(path)
    assert isinstance(again, SetPolicy)
    assert (again.kind, again.meta) == (kind, policy.meta)
    for part in ("inner", "outer"):
        pairs = zip(getattr(again.network, part), getattr(policy.network, part), strict=True)
        for got, want in pairs:
            for a, b in zip(got, want, strict=True):
                np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inner_bias_0": np.zeros(3)}, "inner_weight_0"),
        ({"outer_weight_1": np.full((2, 10), np.nan)}, "outer_weight_1"),
        ({"outer_bias_1": np.zeros(3), "outer_weight_1": np.zeros((3, 10))}, "2 outputs, got 3"),
    ],
)
def test_files_of_other_networks_are_refused(tmp_path, change, message):
    path = tmp_path / "policy.npz"
    policies.save(set_policy("craft"), path)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{**arrays, **change})
    with pytest.raises(ValueError, match=message):
        policies.load(path)


# --- craft ------------------------------------------------------------------------------------


def situation(rng, batch=3, m=4) -> dict[str, Any]:
    low = rng.standard_normal((batch, 6, 6))
    return {
        "rotation": rotations.random(rng, (batch,)),
        "translation": rng.uniform(-50, 50, (batch, 3)) * (1, 1, 0) - (0, 0, 40),
        "covariance": low @ np.swapaxes(low, -1, -2) + np.eye(6),
        "twist": rng.standard_normal((batch, 6)) * 0.5,
        "craft": rng.uniform(-150, 150, (batch, m, 3)) * (1, 1, 0),
        "mask": np.ones((batch, m)),
        "reach_m": np.full(batch, 8.0),
        "dt": 2.0,
    }


def velocities(net, told):
    seen = craft_tokens.craft_tokens(**told)
    own = net(seen.own, seen.pairs, seen.others) + seen.orbit
    return (np.swapaxes(seen.frames, -1, -2) @ own[..., None])[..., 0]


def test_the_order_of_the_craft_does_not_matter():
    rng = np.random.default_rng(4)
    net, told = network("craft"), situation(rng)
    order = np.array([2, 0, 3, 1])
    other = velocities(net, {**told, "craft": told["craft"][:, order]})
    np.testing.assert_allclose(other, velocities(net, told)[:, order], atol=1e-9)


def test_a_scene_that_is_turned_turns_the_velocities():
    rng = np.random.default_rng(5)
    told = situation(rng)
    turn = rotations.exp(np.array([0.0, 0.0, 1.1]))
    both = np.kron(np.eye(2), turn)
    turned: dict[str, Any] = {
        **told,
        "rotation": turn @ told["rotation"],
        "translation": told["translation"] @ turn.T,
        "covariance": both @ told["covariance"] @ both.T,
        "twist": told["twist"] @ both.T,
        "craft": told["craft"] @ turn.T,
    }
    # The orbit begins at a craft that world axes single out: only its direction may differ.
    seen, again = (craft_tokens.craft_tokens(**one) for one in (told, turned))
    np.testing.assert_allclose(again.own[..., :-2], seen.own[..., :-2], atol=1e-9)
    np.testing.assert_allclose(again.pairs, seen.pairs, atol=1e-9)
    np.testing.assert_allclose(again.frames @ turn[:2, :2], seen.frames, atol=1e-9)


def test_craft_that_are_not_there_change_nothing():
    rng = np.random.default_rng(6)
    net, told = network("craft"), situation(rng, m=5)
    told["mask"][:, 3:] = 0.0
    few = {**told, "craft": told["craft"][:, :3], "mask": told["mask"][:, :3]}
    np.testing.assert_allclose(velocities(net, told)[:, :3], velocities(net, few), atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "task"), [("craft", "mobile-hard"), ("craft", "craft"), ("sight", "halls")]
)
def test_scalar_worlds_are_played_as_in_the_vector_environment(kind, task):
    worlds = rl_task(task)
    envs = worlds.make(3, "Disabled")
    alone = [gym.make(f"rbl_gym:{worlds.env_id}", **worlds.arguments) for _ in range(3)]
    policy = set_policy(kind)
    policies.check_fit(policy, "mine", envs)
    play, plays = policy.player(), [policy.player() for _ in alone]
    seen, _ = envs.reset(seed=3)
    own = [env.reset(seed=3 + i)[0] for i, env in enumerate(alone)]
    for _ in range(4):
        actions = play(envs.unwrapped, seen)
        for i, env in enumerate(alone):
            action = plays[i](env.unwrapped, own[i])
            size = len(action)
            np.testing.assert_allclose(actions[i, :size], action, atol=1e-6)
            own[i] = env.step(action.astype(np.float32))[0]
        seen = envs.step(actions)[0]
    other = rl_task("auv_buoys").make(1)
    with pytest.raises(ValueError, match="does not fit"):
        policies.check_fit(policy, "mine", other)


@pytest.mark.parametrize("m", [2, 3, 5])
def test_three_craft_or_more_stay_near_the_orbit(m):
    scene = {"name": "auv_craft", "n_anchors": m}
    envs: Any = gym.make_vec("rbl_gym:RBL/MobileAnchors-v0", num_envs=16, scene=scene)
    seen, _ = envs.reset(seed=4)
    net = network("craft")
    loud = DeepSets(net.inner, (*net.outer[:-1], (100 * net.outer[-1][0], net.outer[-1][1])))
    actions = SetPolicy(loud, "craft", {}).player()(envs.unwrapped, seen)
    orbit = MOBILE["orbit"](envs.unwrapped, np.random.default_rng(0))
    change = np.linalg.norm((actions - orbit).reshape(16, m, 2), axis=-1)
    # Cutting to the largest speed brings two velocities together, never apart.
    assert (change.max() > 0.5) if m == 2 else (0.1 < change.max() < 0.2 + 1e-6)


# --- sight ------------------------------------------------------------------------------------


def test_memory_keeps_what_is_new():
    """Against a list for one anchor of one world."""
    rng = np.random.default_rng(7)
    memory, kept, place = sight_tokens.forgotten(1, 1), [], np.zeros(3)
    for step in range(40):
        place = place + rng.uniform(-0.2, 0.9, 3)
        seen, chosen = rng.choice([-1.0, 1.0], p=[0.2, 0.8]), rng.random() < 0.7
        kept = [(where, sight, age + 1) for where, sight, age in kept]
        if chosen:
            shift = len(kept) < 2 or kept[0][1] != seen
            shift = shift or np.linalg.norm(kept[0][0] - kept[1][0]) > 2.0
            kept = [(place, seen, 0), *(kept if shift else kept[1:])][: sight_tokens.KEPT]
        memory = sight_tokens.remember(
            memory, np.array([[chosen]]), place[None], np.array([[seen]])
        )
        for k, (where, sight, age) in enumerate(kept):
            np.testing.assert_array_equal(memory.place[0, 0, k], where)
            assert (memory.sight[0, 0, k], memory.age[0, 0, k]) == (sight, age), step
        assert not memory.sight[0, 0, len(kept) :].any()


def test_lines_of_sight_that_cross():
    """One above the other: where they cross, and by how much."""
    anchors = np.array([[[0.0, 0, 4], [5, -5, 2]]])
    memory = sight_tokens.remember(
        sight_tokens.forgotten(1, 2), np.array([[False, True]]), np.array([[5.0, 5, 2]]),
        np.array([[1.0, -1.0]]),
    )  # fmt: skip
    body, middle, half = np.array([[10.0, 0, 2]]), np.zeros((1, 3)), np.full((1, 3), 10.0)
    query, event, there = sight_tokens.sight_tokens(anchors, body, memory, middle, half)
    assert query.shape == (1, 2, sight_tokens.QUERY)
    assert event.shape == (1, 2, 2 * sight_tokens.KEPT, sight_tokens.EVENT)
    assert np.flatnonzero(there[0, 0]).tolist() == [sight_tokens.KEPT]
    told = event[0, 0, sight_tokens.KEPT]
    x, y, x0, y0 = told[:4] * (20, 10, 20, 10)
    np.testing.assert_allclose([x, y, x0, y0], [5, 5, 5, -5], atol=1e-9)
    # Half-way of both; the line from the first anchor is at 3 m there, the other at 2 m.
    np.testing.assert_allclose(told[[6, 7, 9, 10, 11]], [-1, 0, 0.5, 0.5, 0], atol=1e-9)
    np.testing.assert_allclose(told[13], -1 / 3, atol=1e-9)


def test_a_network_that_expects_all_to_be_seen_is_the_blind_greedy_choice():
    worlds = rl_task("halls").make(4, "Disabled")
    seen, _ = worlds.reset(seed=1)
    net = network("sight")
    *rest, (weight, bias) = net.outer
    sure = DeepSets(net.inner, (*rest, (0 * weight, bias + 50.0)))
    actions = SetPolicy(sure, "sight", {}).player()(worlds.unwrapped, seen)
    for rows, one in situations(worlds.unwrapped):
        m = one.scene.n_anchors
        np.testing.assert_array_equal(actions[rows, :m], greedy(one, np.ones((len(rows), m))))

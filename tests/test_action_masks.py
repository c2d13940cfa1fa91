"""Action masks of `action_masks()`, as MaskablePPO of sb3-contrib uses them."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers import needs

HALLS: list[Any] = [{"name": "hall", "n_anchors": {"integers": [3, 6]}, "steps": 4}]
ROOMS: list[Any] = [
    {"name": "uwb_room", "n_anchors": {"integers": [2, 4]}, "racks": {"integers": [0, 2]}}
]
ENVS: dict[str, tuple[str, dict[str, Any]]] = {
    "subset": ("AnchorSelection", {"scenes": HALLS, "mode": "subset", "k": 2}),
    "priced": ("AnchorSelection", {"scenes": HALLS, "mode": "priced"}),
    "subset of one hall": ("AnchorSelection", {"mode": "subset", "k": 2}),
    "mounts": ("AnchorPlacement", {"scene": "uwb_room", "mode": "mounts"}),
    "drawn mounts": ("AnchorPlacement", {"scenes": ROOMS, "mode": "mounts"}),
}
every_env = pytest.mark.parametrize("kind", ENVS)


def made(kind: str, num_envs: int = 0, **more: Any) -> Any:
    name, arguments = ENVS[kind]
    if num_envs:
        return gym.make_vec(f"rbl_gym:RBL/{name}-v0", num_envs, **arguments, **more)
    return gym.make(f"rbl_gym:RBL/{name}-v0", **arguments, **more)


def size_of(space: Any) -> int:
    return 2 * space.shape[0] if isinstance(space, gym.spaces.MultiBinary) else int(space.n)


@every_env
def test_masks_of_many_worlds_are_those_of_each(kind):
    envs: Any = made(kind, 4)
    alone = [made(kind) for _ in range(4)]
    envs.reset(seed=3)
    [env.reset(seed=3 + i) for i, env in enumerate(alone)]
    masks = envs.action_masks()
    assert masks.shape == (4, size_of(envs.single_action_space))
    assert masks.dtype == np.bool_
    for mask, env in zip(masks, alone, strict=True):
        np.testing.assert_array_equal(mask, env.get_wrapper_attr("action_masks")())


def test_subsets_are_masked_where_an_anchor_is_not_there():
    env, seen = made("subset"), set()
    subsets = list(itertools.combinations(range(6), 2))
    for seed in range(12):
        env.reset(seed=seed)
        m = env.unwrapped.world.n_anchors
        seen.add(m)
        mask = env.unwrapped.action_masks()
        assert mask.tolist() == [max(one) < m for one in subsets]
        action = int(np.flatnonzero(mask)[-1])
        info = env.step(action)[-1]
        assert tuple(np.flatnonzero(info["chosen"])) == subsets[action]
        info = env.step(14)[-1]
        assert tuple(np.flatnonzero(info["chosen"])) == tuple(k for k in subsets[14] if k < m)
    assert seen == {3, 4, 5, 6}


def test_a_price_is_paid_for_anchors_that_are_there():
    env = made("priced", price=1.0)
    env.reset(seed=1)
    m = env.unwrapped.world.n_anchors
    assert m < 6
    mask = env.unwrapped.action_masks().reshape(6, 2)
    np.testing.assert_array_equal(mask, np.stack([np.ones(6), np.arange(6) < m], axis=1))
    _, reward, *_, info = env.step(np.ones(6, np.int8))
    assert reward == pytest.approx(-np.log(info["score_m"]) - m)


def test_what_has_no_masks_says_so():
    env = gym.make("rbl_gym:RBL/AnchorSelection-v0")
    env.reset(seed=1)
    with pytest.raises(ValueError, match="mode must be 'subset' or 'priced' for action masks"):
        env.unwrapped.action_masks()  # pyrefly: ignore[missing-attribute]
    with pytest.raises(gym.error.ResetNeeded):
        made("priced").unwrapped.action_masks()
    many = {"scene": {"name": "hall", "n_anchors": 40}, "mode": "subset", "k": 8}
    with pytest.raises(
        ValueError, match="at most 10000 subsets, but 8 of 40 anchors can be chosen in 76904685"
    ):
        gym.make("rbl_gym:RBL/AnchorSelection-v0", **many)


@needs("sb3_contrib")
@pytest.mark.parametrize("kind", ["subset", "priced", "drawn mounts"])
@pytest.mark.parametrize("vector", [False, True])
def test_maskable_ppo_trains_and_honours_the_masks(kind, vector):
    from sb3_contrib import MaskablePPO

    from rbl_gym.wrappers.sb3 import Sb3VecEnv

    chosen = []

    def watched(env: Any) -> Any:
        """Keeps what was chosen in each step beside the mask."""
        step, masks = env.step, env.action_masks

        def stepped(action: Any) -> Any:
            chosen.append((np.array(masks()), np.array(action)))
            return step(action)

        env.step = stepped
        return env

    if vector:
        env = Sb3VecEnv(watched(made(kind, 4, autoreset_mode="SameStep")))
    else:
        env = watched(made(kind).unwrapped)
    agent = MaskablePPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=1)
    agent.learn(200)
    assert len(chosen) >= (50 if vector else 200)
    for mask, action in chosen:
        masks, actions = (mask, action) if vector else (mask[None], action[None])
        for allowed, taken in zip(masks, actions, strict=True):
            if np.ndim(taken):
                assert allowed.reshape(-1, 2)[np.arange(len(taken)), taken.astype(int)].all()
            else:
                assert allowed[int(taken)]

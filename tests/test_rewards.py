"""Rewards of `EstimatePose`: names, options, functions of one's own, scalar and vector alike."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.estimators import PoseBelief
from rbl_gym.metrics import Figures
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from rbl_gym.wrappers.observations import Seen
from rbl_gym.wrappers.rewards import REWARDS, Outcome, reward_of
from tests.test_tracking_vector_env import ID, short


def far_anchors(outcome: Outcome):
    """Minus the distance of the farthest anchor from the true body, and the speed told."""
    away = outcome.observation["anchors"] - outcome.translation[..., None, :]
    speed = np.linalg.norm(outcome.observation["twist"][..., 3:], axis=-1)
    return -np.linalg.norm(away, axis=-1).max(axis=-1) - speed


def step_of(scene, reward, action: Any = 0, world="bound"):
    env = EstimatePose(TrackingEnv(scene, world), reward=reward)
    env.reset(seed=4)
    observation, got, *_, info = env.step(action)
    return observation, got, info


def test_worst_tag_is_the_largest_of_the_tags_own():
    scene = short("uwb_room", 4)
    observation, got, info = step_of(scene, "worst-tag")
    Q, P = observation["belief_rotation"], observation["belief_covariance"]
    squares = []
    for c in TrackingEnv(scene).scene.body:
        x, y, z = Q @ c
        J = np.hstack([-np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(3)])
        squares.append(np.trace(J @ P @ J.T))
    assert got == pytest.approx(-0.5 * math.log(max(squares)), rel=1e-12)
    # The mean is below the largest.
    assert -math.log(info["score_m"]) > got


@pytest.mark.parametrize("factor", [0.99, 1.01])
@pytest.mark.parametrize("name", ["position_error_m", "rotation_error_rad"])
def test_requirement_is_met_by_the_real_errors(name, factor):
    *_, info = step_of(short("uwb_room", 4), "belief")
    limits = {"position_error_m": "position_m", "rotation_error_rad": "rotation_deg"}
    limit = factor * (info[name] if "_m" in name else math.degrees(info[name]))
    reward = {"kind": "requirement", limits[name]: limit}
    assert step_of(short("uwb_room", 4), reward)[1] == float(factor > 1)


def test_an_action_has_its_price():
    action = np.linspace(-1, 1, 12).astype(np.float32)
    plain = step_of(short("auv_buoys", 4), "belief", action)[1]
    reward = {"kind": "belief", "action_price": 0.25}
    priced = step_of(short("auv_buoys", 4), reward, action)[1]
    assert plain - priced == pytest.approx(0.25 * np.square(action.astype(float)).sum(), rel=1e-12)


def test_the_bound_is_told_where_the_environment_computes_it():
    def gap(outcome: Outcome):
        assert outcome.bound_m is not None
        return np.log(outcome.bound_m / outcome.figures.score_m)

    _, got, info = step_of(short("uwb_room", 4), gap)
    assert got == pytest.approx(math.log(info["bound_m"] / info["score_m"]))
    assert step_of(short("uwb_room", 4), lambda o: float(o.bound_m is None), world="none")[1] == 1


@pytest.mark.parametrize("name", ["RBL/MobileAnchors-v0", "RBL/AnchorSelection-v0"])
def test_tasks_take_a_reward(name):
    env: Any = gym.make(f"rbl_gym:{name}", reward=far_anchors)
    env.reset(seed=1)
    # The scalar form hands over what the function makes of the same step.
    assert env.step(np.zeros(env.action_space.shape, env.action_space.dtype))[1] < 0
    envs: Any = gym.make_vec(f"rbl_gym:{name}", num_envs=2, reward="error")
    envs.reset(seed=1)
    _, reward, *_, infos = envs.step(np.zeros(envs.action_space.shape, envs.action_space.dtype))
    np.testing.assert_array_equal(reward, -infos["tag_error_m"])


def test_a_named_reward_survives_the_spec_as_json():
    import json

    from gymnasium.envs.registration import EnvSpec

    reward = {"kind": "requirement", "position_m": 0.2}
    env = gym.make(ID, scene="uwb_room", reward="none")
    env = EstimatePose(env, reward=reward)
    assert env.spec is not None
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert json.loads(env.spec.to_json()) == json.loads(again.spec.to_json())  # pyrefly: ignore[missing-attribute]
    _ = env.reset(seed=1), again.reset(seed=1)
    assert env.step(0)[1] == again.step(0)[1]


def no_bound(outcome: Outcome):
    """Needs the bound of the environment."""
    return -np.log(outcome.bound_m)  # pyrefly: ignore[no-matching-overload]


def test_a_missing_bound_is_named():
    with pytest.raises(ValueError, match=r"bound_m of the Outcome is None, because .*='none'"):
        step_of("uwb_room", no_bound, world="none")


@pytest.mark.parametrize(
    ("reward", "named"),
    [
        ("gold", "reward must be one of 'belief', 'error', 'worst-tag', 'requirement', .*'gold'"),
        ("requirement", "reward 'requirement' needs limits"),
        ({"kind": "requirement"}, "needs position_m or rotation_deg, or both"),
        ({"position_m": 1.0}, "reward must have a kind, one of .*, got None"),
        ({"kind": "belief", "position_m": 1.0}, "reward 'belief' has no option 'position_m'"),
        ({"kind": "belief", "action_price": -1.0}, "reward.action_price must be .*got -1"),
        ({"kind": "requirement", "position_m": math.nan}, "reward.position_m must be"),
        ("nowhere:at_all", "reward 'nowhere:at_all' cannot be imported"),
        ("math:pi", "reward 'math:pi' must be callable"),
        (3, "reward must be one of .*, got 3"),
    ],
)
def test_wrong_rewards_are_named(reward, named):
    with pytest.raises(ValueError, match=named):
        reward_of(reward)


@pytest.mark.parametrize(
    ("reward", "named"),
    [
        (lambda _: math.nan, "reward .*<lambda> must be finite, got nan$"),
        (lambda _: np.zeros(2), r"one number for each world, shape \(\), got shape \(2,\)"),
        (lambda _: None, r"reward .*<lambda> must return one number .* shape \(\), got None$"),
        (lambda _: "high", "got 'high'$"),
    ],
)
def test_what_a_function_returns_is_checked(reward, named):
    with pytest.raises(ValueError, match=named):
        step_of(short("uwb_room", 4), reward)


def one_nan(outcome):
    return np.where(np.arange(3) == 1, math.nan, outcome.figures.score_m)


@pytest.mark.parametrize(
    ("reward", "named"),
    [
        (lambda _: 1.0, r"shape \(3,\), got shape \(\)\. .*\.mean\(axis=-1\)"),
        (lambda _: None, r"shape \(3,\), got None$"),
        (one_nan, "reward one_nan must be finite, got nan in 1 of 3 worlds, first world 1$"),
    ],
)
def test_what_a_function_returns_for_many_worlds_is_checked(reward, named):
    envs = gym.make_vec(ID, num_envs=3, scene=short("uwb_room", 4), reward="none")
    envs = VectorEstimatePose(envs, "iekf", reward=reward)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=named):
        envs.step(np.zeros(3, int))


def test_every_name_is_documented():
    assert all(function.__doc__ for function in REWARDS.values())


def table_of(name: str) -> dict[str, str]:
    """Return the second column of the table of the fields of `name`, by the first column."""
    page = Path(__file__).parents[1] / "docs/environments/wrappers.md"
    table = page.read_text(encoding="utf-8").split(f"| field of `{name}` |")[1].split("\n\n")[0]
    rows = [line.split("|") for line in table.splitlines()[2:]]
    return {row[1].strip(" `"): row[2].strip() for row in rows}


def test_the_page_has_every_field_of_an_outcome_with_its_shape():
    seen: list[Outcome] = []
    step_of(short("uwb_room", 4), lambda outcome: seen.append(outcome) or 0.0)
    table = table_of("Outcome")
    whole = {"figures": Figures, "belief": PoseBelief}
    names = [f"{f}.{part}" for f in whole for part in whole[f]._fields]
    assert {*table} == {*names, *Outcome._fields} - {*whole}
    for field, shape in table.items():
        value: Any = seen[0]
        for part in field.split("."):
            value = getattr(value, part)
        if shape.startswith("("):
            assert str(np.shape(value)) == shape, field
    assert {*table_of("Seen")} == {*Seen._fields} <= {*Outcome._fields}

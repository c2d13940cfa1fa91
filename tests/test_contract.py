"""Every environment by its contract: checker, specs, seeds, copies, scalar against vector."""

from __future__ import annotations

import copy
import functools
import pickle
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from rbl_gym.envs.base_station import BaseStationEnv, BaseStationVectorEnv
from rbl_gym.envs.network import PlanarNetworkEnv, PlanarNetworkVectorEnv
from rbl_gym.envs.placement import AnchorPlacementEnv, AnchorPlacementVectorEnv
from rbl_gym.envs.placement_family import PlacementFamilyEnv, PlacementFamilyVectorEnv
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.wrappers import (
    EstimateNetwork,
    EstimatePose,
    SelectAnchors,
    VectorEstimateNetwork,
    VectorEstimatePose,
    VectorSelectAnchors,
)
from rbl_gym.wrappers.filter_reward import anchor_placement, anchor_placement_vector
from rbl_gym.wrappers.shared_anchors import SharedAnchorsEnv, SharedAnchorsVectorEnv
from tests import (
    test_base_station_env,
    test_families,
    test_filter_reward,
    test_network_family,
    test_placement_env,
    test_placement_family,
    test_select_anchors,
    test_shared_anchors,
    test_tasks,
)
from tests.helpers import assert_same
from tests.side_by_side import (
    actions_of,
    assert_masks_alike,
    assert_memory_is_not_shared,
    assert_mixes_alike,
    assert_steps_alike,
    assert_twins_go_on_alike,
    episode,
    of_its_spec,
    peer_of,
)


class World(NamedTuple):
    """An environment with short episodes, scalar and vector, and how alike the two are.

    Of worlds reset by a mask the infos `known` are compared; only their resets have `at_reset`.
    """

    env_id: str
    scalar: Any
    vector: Any
    arguments: dict[str, Any]
    rtol: float = 1e-9
    atol: float = 1e-9
    known: tuple[str, ...] = ()
    at_reset: tuple[str, ...] = ()
    wrap: tuple[Any, Any] = (None, None)

    def make(self) -> Any:
        """The scalar environment by its id, in its wrapper."""
        env = gym.make(self.env_id, **self.arguments)
        return env if self.wrap[0] is None else self.wrap[0](env)

    def alone(self) -> Any:
        """The scalar environment itself, in its wrapper."""
        env = self.scalar(**self.arguments)
        return env if self.wrap[0] is None else self.wrap[0](env)

    @property
    def tolerance(self) -> dict[str, float]:
        """What rounding may change, and what a filter makes of it."""
        return {"rtol": self.rtol, "atol": self.atol}

    def vectors(self, mode: AutoresetMode, n: int = 3) -> tuple[Any, Any]:
        """The native vector environment, and Gymnasium's own around scalar ones."""
        native = self.vector(num_envs=n, autoreset_mode=mode, **self.arguments)
        native = native if self.wrap[1] is None else self.wrap[1](native)
        return native, peer_of(self.alone, mode, n, {})


PRIORS = ("prior_rotation", "prior_translation", "prior_covariance")
LOSSY = {"drop_probability": 0.2, "nlos_probability": 0.1, "reach_m": 500.0}
PLACEMENT = "rbl_gym:RBL/AnchorPlacement-v0"
WORLDS: dict[str, World] = {}
for kind, arguments in {
    "fixed": {"scene": {"name": "uwb_room", "steps": 5}},
    "lossy": {"scene": {"name": "auv_buoys", "links": LOSSY, "steps": 5}},
    "of the paper": {"scene": {"name": "camsap2013", "steps": 5}, "reward": "none"},
    "racks": {"scene": {"name": "hall", "steps": 5}},
    "drawn": {"scenes": test_families.MIXED},
    "inertial": {"scene": {"name": "uwb_room", "inertial": "consumer", "steps": 5}},
    "offsets": {"scene": {"name": "uwb_room", "links": {"offset": "tag"}, "steps": 5}},
}.items():
    WORLDS[f"tracking, {kind}"] = World(
        "rbl_gym:RBL/Tracking-v0", TrackingEnv, TrackingVectorEnv, arguments,
        known=("rotation", "epoch"), at_reset=PRIORS,
    )  # fmt: skip
for kind in test_tasks.WORLDS:
    scalar, vector, arguments = test_tasks.short(kind)
    WORLDS[f"task, {kind}"] = World(
        test_tasks.WORLDS[kind][0], scalar, vector, arguments, 2e-5, 2e-6, ("score_m",)
    )
for number, (env_id, arguments) in enumerate(test_families.TASKS, 1):
    scalar, vector = test_tasks.CLASSES[f"rbl_gym:{env_id}"]
    WORLDS[f"task, drawn, {number}"] = World(
        f"rbl_gym:{env_id}", scalar, vector, arguments, 2e-5, 2e-6, ("score_m",), ("scene",)
    )
for kind, arguments in test_placement_env.WORLDS.items():
    WORLDS[f"placement, {kind}"] = World(
        PLACEMENT, AnchorPlacementEnv, AnchorPlacementVectorEnv, arguments,
        known=("region", "racks", "anchors"),
    )  # fmt: skip
for kind, arguments in test_placement_family.WORLDS.items():
    WORLDS[f"placement, drawn, {kind}"] = World(
        PLACEMENT, PlacementFamilyEnv, PlacementFamilyVectorEnv, arguments,
        known=("region", "racks", "anchor_mask"), at_reset=("scene",),
    )  # fmt: skip
for kind in test_filter_reward.WORLDS:
    WORLDS[f"placement by a filter, {kind}"] = World(
        PLACEMENT, anchor_placement, anchor_placement_vector, test_filter_reward.arguments_of(kind),
        1e-7, known=("tag_error_m", "score_m"),
    )  # fmt: skip
for kind, arguments in test_base_station_env.WORLDS.items():
    WORLDS[f"base station, {kind}"] = World(
        "rbl_gym:RBL/BaseStation-v0", BaseStationEnv, BaseStationVectorEnv, arguments
    )
for kind, arguments in {
    "bearings": {"n_nodes": 6},
    "lengths": {"n_nodes": 5, "lengths": "all", "reward": "none"},
    "drawn": {"scenes": test_network_family.DRAWN},
    "drawn, one length": {"scenes": test_network_family.DRAWN, "lengths": "one"},
    "drawn, all lengths": {"scenes": test_network_family.DRAWN, "lengths": "all"},
}.items():
    WORLDS[f"network, {kind}"] = World(
        "rbl_gym:RBL/PlanarNetwork-v0", PlanarNetworkEnv, PlanarNetworkVectorEnv,
        {"steps": 4, **arguments},
    )  # fmt: skip
for kind, arguments in {
    "worst": {"combine": "worst"},
    "flat": {"filter": "uc-kf", "observation": "flat"},
    "error": {"reward": "error"},
}.items():
    WORLDS[f"shared anchors, {kind}"] = World(
        "rbl_gym:RBL/SharedAnchors-v0", SharedAnchorsEnv, SharedAnchorsVectorEnv,
        {**test_shared_anchors.TWO, **arguments}, 2e-5, 2e-6,
    )  # fmt: skip
RAW = dict(WORLDS)


def wrapped(world: World, scalar: Any, vector: Any) -> World:
    """An environment in a wrapper that runs a filter, and in its vector twin."""
    return world._replace(rtol=2e-5, atol=2e-6, known=(), wrap=(scalar, vector))


def estimated(world: World, **options: Any) -> World:
    """`EstimatePose` and its vector twin."""
    wrappers = EstimatePose, VectorEstimatePose
    return wrapped(world, *(functools.partial(wrapper, **options) for wrapper in wrappers))


def tracking(**arguments: Any) -> World:
    """`RBL/Tracking-v0` without a bound."""
    arguments = {"reward": "none", **arguments}
    return World("rbl_gym:RBL/Tracking-v0", TrackingEnv, TrackingVectorEnv, arguments)


for name, fields, options in (
    ("auv_buoys", {"links": LOSSY}, {}),
    ("auv_buoys", {}, {"reward": {"kind": "requirement", "position_m": 0.5, "action_price": 0.1}}),
    ("auv_buoys", {}, {"filter": "kf", "reward": "tests.test_rewards:far_anchors"}),
    ("drone_yard", {"links": LOSSY}, {"filter": "uc-kf", "reward": "error"}),
    ("drone_yard", {}, {"filter": "iekf-bank/robust=true"}),
    ("drone_yard", {"links": LOSSY}, {"filter": "iekf-cv"}),
    ("drone_yard", {}, {"filter": "iekf-bias"}),
    ("uwb_room", {}, {"filter": "kf-ortho", "observation": "flat"}),
    ("uwb_room", {"inertial": "consumer"}, {"filter": "iekf-imu"}),
    ("camsap2013", {}, {"filter": "et-kf", "options": {"threshold": 0.2}}),
    ("satellite", {}, {"options": {"robust": True}, "observation": "flat"}),
    ("hall", {}, {"observation": "tokens"}),
):
    scene = {"name": name, "steps": 4, **fields}
    WORLDS[f"estimated, {name}, {options}"] = estimated(tracking(scene=scene), **options)
for options in (
    {}, {"reward": "worst-tag", "observation": "flat"},
    # A filter that takes no tags of each world.
    {"filter": "uc-kf"},
):  # fmt: skip
    world = tracking(scenes=test_families.VARIED, reward="bound")._replace(at_reset=("scene",))
    WORLDS[f"estimated, drawn, {options}"] = estimated(world, **options)
for kind, view in (("default", "dict"), ("drawn", "flat"), ("drawn", "tokens")):
    world = RAW[f"base station, {kind}"]
    WORLDS[f"estimated, base station, {kind}, {view}"] = estimated(world, observation=view)
for kind, options in (
    ("bearings", {}),
    ("lengths", {"reward": "belief", "order": "asynchronous", "cycles": "paton", "steps": 3}),
):
    wrappers = EstimateNetwork, VectorEstimateNetwork
    WORLDS[f"estimated, network, {kind}"] = wrapped(
        RAW[f"network, {kind}"], *(functools.partial(wrapper, **options) for wrapper in wrappers)
    )
for kind, scene in (("hall", test_select_anchors.HALL), ("movable", test_select_anchors.MOVABLE)):
    WORLDS[f"selected, {kind}"] = wrapped(
        tracking(scene=scene),
        lambda env: EstimatePose(SelectAnchors(env)),
        lambda envs: VectorEstimatePose(VectorSelectAnchors(envs)),
    )
every_world = pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)
# Those of which no episode is a single step, and not every filter.
LONG = {
    kind: world
    for kind, world in WORLDS.items()
    if not any(part in kind for part in ("at once", "one anchor", "placement, drawn", "estimated"))
    or kind.startswith("estimated, auv_buoys")
}


@every_world
@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version")
def test_gymnasiums_checker_has_no_complaint(world):
    env = world.make()
    # Below what Gymnasium adds by itself: order enforcing and its passive checker.
    check_env(env.env.env if world.wrap[0] is None else env, skip_render_check=True)


@every_world
def test_specs_copies_and_seeds_give_the_same_episode(world):
    env = world.make()
    want = episode(env, 3, 8)
    # By the length in the spec Gymnasium adds its limit, which speaks at the end.
    again = episode(of_its_spec(env), 3, 8)
    assert_same([step[:3] for step in again], [step[:3] for step in want])
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env)), env):
        assert_same(episode(twin, 3, 8), want)
    for other in (env.reset(), env.reset(seed=4)):
        with pytest.raises(AssertionError):
            assert_same(other[0], want[0][0])


@every_world
def test_a_step_needs_a_reset_before_the_first_and_after_the_last(world):
    env = world.alone()
    with pytest.raises(ResetNeeded):
        env.step(env.action_space.sample())
    *_, (_, _, terminated, truncated, _) = episode(env, 1, 20)
    assert terminated or truncated
    with pytest.raises(ResetNeeded):
        env.step(env.action_space.sample())
    envs, _ = world.vectors(AutoresetMode.DISABLED)
    with pytest.raises(ResetNeeded):
        envs.step(envs.action_space.sample())


@every_world
def test_twins_in_mid_episode_go_on_alike(world):
    env, _ = world.vectors(AutoresetMode.NEXT_STEP)
    env.reset(seed=1)
    env.step(actions_of(env, np.random.default_rng(1)))
    assert_twins_go_on_alike(env, 7)


@every_world
def test_the_same_seed_gives_the_same_bytes_and_memory_is_never_shared(world):
    assert_memory_is_not_shared(lambda: world.vectors(AutoresetMode.SAME_STEP)[0], 7)


@every_world
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_equals_scalar_environments(world: World, mode):
    """With final observation and info where the reset is in the same step."""
    steps = assert_steps_alike(*world.vectors(mode), 14, [5, 3, 8], world.tolerance)
    ends = [info for *_, terminated, truncated, info in steps if (terminated | truncated).any()]
    assert len(ends) >= 2
    assert all(("final_obs" in info) == (mode is AutoresetMode.SAME_STEP) for info in ends)


@every_world
def test_disabled_resets_what_the_mask_says_and_clocks_may_differ(world: World):
    both = world.vectors(AutoresetMode.DISABLED)
    assert_masks_alike(*both, 12, world.known, world.tolerance, world.at_reset)


@pytest.mark.parametrize("world", LONG.values(), ids=LONG)
def test_next_step_mixes_resets_and_steps(world: World):
    """Worlds that were reset half way stand at other epochs, or anchors, than the others."""
    assert_mixes_alike(*world.vectors(AutoresetMode.NEXT_STEP), 10, world.tolerance)


@pytest.mark.parametrize("world", RAW.values(), ids=RAW)
def test_make_vec_gives_the_native_environment_and_a_limit_truncates_it(world):
    env = gym.make_vec(
        world.env_id, num_envs=2, max_episode_steps=2, autoreset_mode="SameStep", **world.arguments
    )
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.spec is not None
    assert_same(gym.make_vec(env.spec).reset(seed=2)[0], env.reset(seed=2)[0])
    rng, ends = np.random.default_rng(2), []
    for _ in range(4):
        *_, terminated, truncated, _ = env.step(actions_of(env, rng))
        ends.append((terminated | truncated).tolist())
    # Every second step, or every one where a single step is an episode.
    assert all(first or second for first, second in zip(ends[0], ends[1], strict=True))
    assert ends[2:] == ends[:2] or "scenes" in world.arguments

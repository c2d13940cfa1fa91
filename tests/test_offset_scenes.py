"""Scenes whose ranges have an unknown offset in common: environments, wrappers, bounds."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from rbl_gym import bounds, ranging
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.measurements import offsets
from rbl_gym.placement import PlacementTask
from rbl_gym.studies import monte_carlo
from rbl_gym.worlds import scenes, simulation
from rbl_gym.wrappers import EstimatePose
from tests.helpers import over_bound

every_offset = pytest.mark.parametrize("offset", offsets.OFFSETS)


def spec(offset: str, **links):
    return {"name": "uwb_room", "steps": 8, "links": {"offset": offset, **links}}


@every_offset
def test_a_scene_checks_and_its_ranges_have_any_sign(offset):
    env = gym.make("rbl_gym:RBL/Tracking-v0", scene=spec(offset, drop_probability=0.2))
    check_env(env.unwrapped, skip_render_check=True)
    seen = env.reset(seed=1)[0]
    lost = seen["links"] == 0
    assert lost.any()
    assert (seen["ranges"][lost] == 0).all()
    assert any((env.step(0)[0]["ranges"] < 0).any() for _ in range(8))


@every_offset
def test_offsets_are_those_of_their_groups(offset):
    plain = scenes.get({"name": "uwb_room", "steps": 8})
    scene = scenes.get(spec(offset))
    rng = np.random.default_rng(0)
    episode = simulation.draw_episode(scene, rng, (4,))
    at = simulation.epoch_of(episode, 3)
    got = simulation.measure_epoch(scene, at, episode.anchors).ranges
    added = got - simulation.measure_epoch(plain, at, episode.anchors).ranges
    assert np.abs(added).max() > 1.0
    np.testing.assert_allclose(offsets.centred(added, np.ones_like(added), offset), 0.0, atol=1e-9)


def test_the_bound_of_an_episode_knows_the_offset():
    env = TrackingEnv(scene=spec("tag"))
    info = env.reset(seed=3)[1]
    at = bounds.range_information(
        env._anchors, env.scene.body, info["rotation"], info["translation"],
        env.scene.noise, offset="tag",
    )  # fmt: skip
    information = np.linalg.inv(info["prior_covariance"]) + at
    want = bounds.score(np.linalg.inv(information), info["rotation"], env.scene.body)
    np.testing.assert_allclose(info["score_m"], want, rtol=1e-9)


def test_estimate_pose_tells_its_filter():
    env = EstimatePose(gym.make("rbl_gym:RBL/Tracking-v0", scene=spec("tag")))
    env.reset(seed=2)
    infos = [env.step(0)[-1] for _ in range(8)]
    assert max(info["position_error_m"] for info in infos) < 0.5
    np.testing.assert_allclose(infos[-1]["score_m"], infos[-1]["bound_m"], rtol=0.1)
    with pytest.raises(ValueError, match="offset"):
        EstimatePose(gym.make("rbl_gym:RBL/Tracking-v0", scene=spec("tag")), "uc-kf")


def test_the_filter_of_a_scene_stands_at_its_bound():
    """300 trials: the ratio of all epochs after the third has a deviation of about 2 %."""
    scene = scenes.get(spec("tag"))
    trials = monte_carlo.simulate_trials(scene, 300, np.random.default_rng(4))
    trace = monte_carlo.track_trials(trials, "iekf", {})
    assert max(over_bound(trace.error[3:], trials.bound[3:])) < 1.05
    assert abs(trace.nees[3:].mean() - 6) < 0.3


def test_simulated_ranges_have_the_offset():
    rng = np.random.default_rng(0)
    model = ranging.LinkModel(offset="anchor", offset_std_m=100.0)
    anchors, tags = rng.uniform(-5, 5, (6, 3)), rng.normal(0, 0.3, (4, 3))
    got = ranging.simulate(
        anchors, tags, np.eye(3), np.zeros(3), ranging.RangeNoise(1e-6), rng, model
    )
    added = got.ranges - ranging.distances(anchors, tags)
    assert np.ptp(added, axis=1).max() < 1e-4
    assert np.ptp(added[:, 0]) > 10


def test_what_is_no_offset_is_refused():
    with pytest.raises(ValueError, match="offset must be one of"):
        TrackingEnv(scene=spec("tags"))
    with pytest.raises(ValueError, match="offset_std_m"):
        TrackingEnv(scene=spec("tag", offset_std_m=-1.0))
    with pytest.raises(ValueError, match="without an offset"):
        PlacementTask(scenes.get(spec("tag")), 4)

"""Scenes whose body carries an inertial sensor: motion, environments, wrappers."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import motion
from rbl_gym.geometry import rotations
from rbl_gym.measurements import inertial
from rbl_gym.motion import navigation
from rbl_gym.studies import monte_carlo
from rbl_gym.worlds import scenes, simulation
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose

ID = "rbl_gym:RBL/Tracking-v0"
SCENE = {"name": "uwb_room", "inertial": "consumer", "steps": 6}
NAMES = ["uwb_room", "drone_yard", "hall", "satellite", "auv_buoys", "icassp2013"]
# Nothing but the truth.
EXACT = inertial.InertialSensor(
    rate_hz=100, gyro_noise=1e-12, accel_noise=1e-12, gyro_walk=0.0, accel_walk=0.0,
    gyro_bias_rad_s=1e-12, accel_bias_m_s2=1e-12,
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_exact_readings_lead_from_epoch_to_epoch(name):
    scene = scenes.get({"name": name, "inertial": EXACT, "steps": 12})
    episode: Any = simulation.draw_episode(scene, np.random.default_rng(0), (3,))
    samples = EXACT.samples(scene.dt)
    assert episode.readings.shape == (3, 13, samples, 6)
    assert (episode.readings[:, 0] == 0).all()
    down = navigation.gravity([0.0, 0.0], inertial.GRAVITY_M_S2)
    T = scene.dt
    for k in range(12):
        moved = navigation.preintegrate(episode.readings[:, k + 1], T / samples, np.zeros(6), EXACT)
        Q, t, v = episode.rotation[:, k], episode.translation[:, k], episode.velocity[:, k]
        turn = rotations.error(Q @ moved.rotation, episode.rotation[:, k + 1])
        place = t + T * v + 0.5 * T**2 * down + (Q @ moved.translation[..., None])[..., 0]
        speed = v + T * down + (Q @ moved.velocity[..., None])[..., 0]
        scale = 1 + scene.speed_m_s * T
        np.testing.assert_allclose(turn, 0, atol=1e-6)
        np.testing.assert_allclose(place, episode.translation[:, k + 1], atol=1e-4 * scale)
        np.testing.assert_allclose(speed, episode.velocity[:, k + 1], atol=1e-4 * scale)


def test_the_told_twist_is_off_by_the_process_noise():
    scene = scenes.get({"name": "uwb_room", "inertial": "consumer", "steps": 40})
    episode: Any = simulation.draw_episode(scene, np.random.default_rng(1), (200,))
    true = motion.twists_between(episode.rotation, episode.translation, scene.dt)
    error = (true - episode.twists[:, 1:]) * np.sqrt(scene.dt)
    # 8000 values of each axis: 0.8 %, 5 sigma.
    np.testing.assert_allclose(error.std(axis=(0, 1)), scene.process.std(), rtol=0.04)


def test_filters_that_are_told_the_twist_are_honest_on_it():
    scene = scenes.get({"name": "uwb_room", "inertial": "consumer", "steps": 30})
    trials = monte_carlo.simulate_trials(scene, 100, np.random.default_rng(2))
    trace = monte_carlo.track_trials(trials, "iekf", {})
    assert trace.nees.mean() / 6 == pytest.approx(1, abs=0.1)
    better = monte_carlo.track_trials(trials, "iekf-imu", {})
    assert monte_carlo.rms(better.error[..., 3:]) < 0.95 * monte_carlo.rms(trace.error[..., 3:])


def test_the_body_stays_near_the_line_and_its_force_is_bearable():
    scene = scenes.get({"name": "drone_yard", "inertial": "consumer"})
    episode: Any = simulation.draw_episode(scene, np.random.default_rng(3), (20,))
    low, high = scene.volume.bounds()
    assert (episode.translation >= low - 1).all()
    assert (episode.translation <= high + 1).all()
    force = episode.readings[:, 1:, :, 3:] - episode.bias[:, 1:, None, 3:]
    assert np.abs(force).max() < 30


def test_a_scene_without_a_sensor_draws_what_it_drew():
    plain = simulation.draw_episode(scenes.get("uwb_room"), np.random.default_rng(4))
    assert plain.readings is None
    sensed = simulation.draw_episode(
        scenes.get({"name": "uwb_room", "inertial": "consumer"}), np.random.default_rng(4)
    )
    np.testing.assert_array_equal(plain.normals, sensed.normals)
    np.testing.assert_array_equal(plain.prior_covariance, sensed.prior_covariance)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inertial": "best"}, "scene: inertial.kind must be one of"),
        ({"inertial": {"gyro_noise": -1}}, "scene: gyro_noise must be a finite number"),
        ({"inertial": {"rate_hz": 33}}, "scene: rate_hz must give a whole number of samples"),
        ({"name": "camsap2013", "inertial": "consumer"}, "prior must be 'drawn' in a scene with"),
    ],
)
def test_what_is_no_scene(changes, message):
    with pytest.raises(ValueError, match=message):
        scenes.get({**SCENE, **changes})


def test_dicts_of_json_make_the_scene():
    changes = {"name": "drone_yard", "inertial": {"kind": "tactical", "rate_hz": 200}}
    scene: Any = scenes.get(json.loads(json.dumps(changes)))
    assert scene.inertial.rate_hz == 200
    assert scene.inertial.gyro_noise == inertial.SENSORS["tactical"].gyro_noise
    assert scenes.get({"name": "drone_yard", "inertial": None}).inertial is None


# --- environments ----------------------------------------------------------------------------


def test_the_readings_of_an_epoch_are_a_copy():
    env: Any = gym.make(ID, scene=SCENE)
    env.reset(seed=0)
    observation, *_ = env.step(0)
    kept = observation["inertial"].copy()
    observation["inertial"][:] = 0
    assert env.unwrapped._episode.readings[1].tobytes() == kept.tobytes()
    env.close()


def test_the_inertial_filter_beats_the_told_twist_in_the_environment():
    errors = {}
    for filter in ("iekf", "iekf-imu"):
        scene = {**SCENE, "steps": 40}
        envs = VectorEstimatePose(gym.make_vec(ID, num_envs=40, scene=scene, reward="none"), filter)
        envs.reset(seed=0)
        squares = []
        for _ in range(40):
            *_, info = envs.step(np.zeros(40, dtype=int))
            squares.append(np.mean(info["position_error_m"] ** 2))
        errors[filter] = np.sqrt(np.mean(squares))
        envs.close()
    assert errors["iekf-imu"] < 0.95 * errors["iekf"]


def test_the_bound_of_the_environment_is_of_readings_and_ranges():
    told = {}
    for sensor in (None, "consumer"):
        env = gym.make(ID, scene={**SCENE, "inertial": sensor, "steps": 20})
        env.reset(seed=0)
        for _ in range(20):
            *_, info = env.step(0)
        told[sensor] = info["score_m"]
        env.close()
    assert told["consumer"] < 0.95 * told[None]


def test_a_scene_without_a_sensor_has_nothing_for_the_filter():
    with pytest.raises(ValueError, match="filter 'iekf-imu' reads an inertial sensor, scene"):
        EstimatePose(gym.make(ID, scene="uwb_room"), "iekf-imu")
    trials = monte_carlo.simulate_trials(scenes.get("uwb_room"), 2, np.random.default_rng(0))
    with pytest.raises(ValueError, match="reads an inertial sensor"):
        monte_carlo.track_trials(trials, "iekf-imu", {})
    with pytest.raises(ValueError, match="filter must be one that takes the twist"):
        gym.make("rbl_gym:RBL/AnchorPlacement-v0", reward="filter", filter="iekf-imu",
                 scene={"name": "uwb_room", "inertial": "consumer"})  # fmt: skip
    readings = monte_carlo.told_readings(trials.scene, trials.episode, trials.measurements)
    from rbl_gym import estimators
    from rbl_gym.studies.epochs import track_epochs

    scene = trials.scene
    filter = estimators.make("iekf-imu", tags=scene.body, noise=scene.noise, process=scene.process)
    prior = (
        trials.episode.prior_rotation, trials.episode.prior_translation,
        trials.episode.prior_covariance,
    )  # fmt: skip
    with pytest.raises(ValueError, match="the readings have none"):
        list(track_epochs(filter, prior, readings))

"""The iterated EKF with directions of arrival, and with ranges besides."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import bounds, estimators, metrics, motion
from rbl_gym.bounds import doa
from rbl_gym.envs.base_station import BaseStationVectorEnv
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import bearing, ranging

TAGS = bodies.doa2019()
NOISE = bearing.AngleNoise(np.deg2rad(0.1))
RANGES = ranging.RangeNoise(0.1)
PROCESS = motion.ProcessNoise(0.05, 0.3)


def make(tags=TAGS, noise: Any = NOISE, process=PROCESS, **options) -> Any:
    return estimators.make(
        "iekf", tags=tags, noise=noise, process=process, measurement="doa", **options
    )


@pytest.fixture(scope="module")
def tracked():
    """RMSE over the bound, RMSE and NEES of three filters on 300 episodes of 30 steps."""
    trials = 300
    env = BaseStationVectorEnv(trials, scene={"steps": 30}, reward="none")
    tags, process = np.array(env.scene.tags), env.scene.process
    law = {"tags": tags, "process": process}
    filters: dict[str, Any] = {
        "angles": make(noise=env.noise, **law),
        "both": make(noise=env.noise, range_noise=RANGES, **law),
        "ranges": estimators.make("iekf", noise=RANGES, **law),
    }
    observation, info = env.reset(seed=0)
    rng = np.random.default_rng(1)
    prior = tuple(info[f"prior_{name}"] for name in ("rotation", "translation", "covariance"))
    states = {name: filter.initial(*prior) for name, filter in filters.items()}
    J = {name: np.linalg.inv(prior[2]) for name in filters}
    squares = {name: [] for name in filters}
    variances = {name: [] for name in filters}
    nees = {name: [] for name in filters}
    for epoch in range(31):
        pose, station = (info["rotation"], info["translation"]), observation["station"]
        anchors = station[:, None]
        ranges = ranging.simulate(anchors, tags, *pose, RANGES, rng).ranges
        of_angles = doa.doa_information(tags, *pose, env.noise, station)
        of_ranges = bounds.range_information(anchors, tags, *pose, RANGES)
        for name, filter in filters.items():
            state = states[name]
            if epoch:
                step = observation["twist"], env.scene.dt
                state = filter.predict(state, *step)
                J[name] = bounds.predict_information(J[name], *step, process)
            if name == "ranges":
                state = filter.update(state, ranges, anchors)
            else:
                also = {"ranges": ranges} if name == "both" else {}
                state = filter.update(state, observation["angles"], anchors, **also)
            J[name] = J[name] + {"angles": of_angles, "ranges": of_ranges}.get(
                name, of_angles + of_ranges
            )
            states[name] = state
            error = metrics.pose_error(state.rotation, state.translation, *pose)
            squares[name].append(error**2)
            variances[name].append(np.diagonal(np.linalg.inv(J[name]), axis1=1, axis2=2))
            nees[name].append(metrics.nees(error, state.covariance))
        observation, _, _, _, info = env.step(rng.uniform(-1, 1, (trials, 3)))

    def rms(values):
        means = np.mean(values, axis=(0, 1))
        return np.sqrt([means[:3].sum(), means[3:].sum()])

    return {
        name: (rms(squares[name]) / rms(variances[name]), rms(squares[name]), np.mean(nees[name]))
        for name in filters
    }


@pytest.mark.parametrize("name", ["angles", "both"])
def test_tracking_reaches_the_posterior_bound_and_is_consistent(tracked, name):
    ratio, _, nees = tracked[name]
    assert (ratio < 1.05).all()
    assert abs(nees - 6) < 0.4


def test_ranges_and_angles_together_beat_each_alone(tracked):
    both = tracked["both"][1]
    assert (both < tracked["angles"][1]).all()
    assert (both < tracked["ranges"][1]).all()


def test_a_vague_prior_starts_from_the_global_solution():
    rng = np.random.default_rng(3)
    rotation = rotations.random(rng, (60,))
    place = np.array([6.0, 8.0, 2.0]) + rng.normal(size=(60, 3))
    station = np.array([1.0, -1.0, 0.5])
    angles = bearing.simulate(TAGS, rotation, place, NOISE, rng, station)
    filter = make()
    vague = filter.initial(np.eye(3), [5.0, 5.0, 5.0], np.diag([50.0] * 3 + [100.0] * 3))
    state = filter.update(vague, angles, station)
    error = metrics.pose_error(state.rotation, state.translation, rotation, place)
    assert (metrics.nees(error, state.covariance) < 40).mean() > 0.95
    single = filter.update(vague, angles[0], station)
    np.testing.assert_allclose(single.translation, state.translation[0], atol=1e-6)
    both = make(range_noise=RANGES)
    ranges = ranging.simulate(station[None], TAGS, rotation, place, RANGES, rng).ranges
    state = both.update(vague, angles, station, ranges=ranges)
    error = metrics.pose_error(state.rotation, state.translation, rotation, place)
    assert (metrics.nees(error, state.covariance) < 40).mean() > 0.95


def test_tags_that_were_not_heard_tell_nothing():
    rng = np.random.default_rng(4)
    rotation, place = np.tile(np.eye(3), (5, 1, 1)), np.tile([5.0, 5.0, 3.0], (5, 1))
    angles = bearing.simulate(TAGS, rotation, place, NOISE, rng)
    filter, fewer = make(), make(TAGS[:3])
    prior = (rotation, place + 0.1, np.diag([0.01] * 3 + [0.1] * 3))
    heard = np.array([True, True, True, False])
    masked = filter.update(
        filter.initial(*prior), np.where(heard, angles, np.nan), place[0] * 0, heard
    )
    alone = fewer.update(fewer.initial(*prior), angles[..., :3], place[0] * 0)
    for got, want in zip(masked, alone, strict=True):
        np.testing.assert_allclose(got, want, atol=1e-9)


def test_huber_shrugs_off_a_wrong_direction():
    rng = np.random.default_rng(5)
    tags = bodies.octahedron(3.0)
    rotation, place = rotations.random(rng, (100,)), np.tile([5.0, 7.0, 3.0], (100, 1))
    angles = bearing.simulate(tags, rotation, place, NOISE, rng)
    angles[:, 0, 0] += 0.2
    error = {}
    for robust in (False, True):
        filter = make(tags, robust=robust, iterations=8)
        state = filter.initial(rotation, place, np.diag([0.01] * 3 + [0.1] * 3))
        state = filter.update(state, angles, np.zeros(3))
        error[robust] = np.median(np.linalg.norm(state.translation - place, axis=-1))
    assert error[True] < 0.5 * error[False]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f, s: f.update(s, np.full((2, 4), np.nan), np.zeros(3)), "angles must be finite"),
        (lambda f, s: f.update(s, np.ones((2, 3)), np.zeros(3)), "angles must have shape"),
        (lambda f, s: f.update(s, np.ones((2, 4)), np.zeros(2)), "station must have shape"),
        (lambda f, s: f.update(s, np.ones((2, 4)), np.zeros(3), np.ones(3)), "links must have"),
        (lambda f, s: f.update(s, np.ones((2, 4)), np.zeros(3), ranges=np.ones((1, 4))),
         "range_noise must be given"),
        (lambda f, s: make(noise=RANGES), "noise must be a bearing"),
        (lambda f, s: estimators.make("iekf", tags=TAGS, noise=RANGES, process=PROCESS,
                                      range_noise=RANGES), "range_noise must be None"),
        (lambda f, s: estimators.make("iekf", tags=TAGS, noise=RANGES, process=PROCESS,
                                      measurement="sight"), "measurement must be one of"),
    ],
)  # fmt: skip
def test_bad_input_is_named(call, message):
    filter = make()
    state = filter.initial(np.eye(3), [5.0, 5.0, 3.0], 0.01 * np.eye(6))
    with pytest.raises(ValueError, match=message):
        call(filter, state)


@pytest.mark.parametrize("vague", [False, True])
def test_bodies_of_their_own_are_a_loop(vague):
    rng, station = np.random.default_rng(0), np.zeros(3)
    tags = bodies.centred(bodies.doa2019()) * np.array([1.0, 1.1, 1.2])[:, None, None]
    rotation = rotations.exp(0.1 * rng.standard_normal((3, 3)))
    translation = np.array([5, 12, 3.0]) + rng.standard_normal((3, 3))
    noise, process = bearing.AngleNoise(0.002), motion.ProcessNoise(0.05, 0.1)
    angles = bearing.simulate(tags, rotation, translation, noise, rng)
    P = np.diag([np.pi**2] * 3 + [100.0] * 3) if vague else 0.01 * np.eye(6)

    def updated(tags, angles):
        filter = estimators.make("iekf", tags=tags, noise=noise, process=process, measurement="doa")
        return filter.update(filter.initial(np.eye(3), [5, 12, 3], P), angles, station)

    together = updated(tags, angles)
    for i in range(3):
        alone = updated(tags[i], angles[i])
        for all_of_them, one in zip(together, alone, strict=True):
            np.testing.assert_allclose(all_of_them[i], one, atol=1e-12)

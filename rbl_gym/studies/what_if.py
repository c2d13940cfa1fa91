"""Compute bounds along a track with an inertial sensor, a better survey or calibrated links.

The posterior Cramer-Rao bound is computed on one set of episodes for each model of the motion and
each set of unknowns. No filter is run: no filter can be more accurate than the bound.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.bounds import inertial
from rbl_gym.bounds.motions import Motion
from rbl_gym.bounds.nuisances import information_of, with_epoch
from rbl_gym.checks import FloatArray, check_count
from rbl_gym.measurements.inertial import SENSORS
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.motion.kinematics import ProcessNoise, twists_between
from rbl_gym.motion.unknown_twist import WanderingTwist
from rbl_gym.studies import monte_carlo
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.worlds import scenes, simulation
from rbl_gym.worlds.scene import Scene
from rbl_gym.worlds.scene_bounds import felt_motion

__all__ = ["SURVEYS_M", "UNCALIBRATED", "what_if"]

# Standard deviations of surveys (m), per axis.
SURVEYS_M = (0.01, 0.03, 0.1)
# Biases of uncalibrated links: of each link, and common to all.
UNCALIBRATED = LinkBias(0.05, None, 0.1)


def what_if(
    scene: str | Mapping[str, Any] | Scene, trials: int, seed: int, advance: Advance = silent
) -> dict[str, Any]:
    """Return pose bounds along episodes of a scene, by the motion model and the unknowns.

    The body flies smoothly, as in a scene with an inertial sensor (`worlds.inertial_motion`).

    Parameters
    ----------
    scene
        As in `scenes.get`. Its own offset and survey are part of every row. A scene without an
        inertial sensor gets a ``"consumer"`` one.
    trials, seed
        Number of episodes, and the seed of their randomness.
    advance
        Called after each row.

    Returns
    -------
    Plain numbers: ``rows``, each with `motion`, `unknown`, and root mean squares over trials and
    epochs of `position_m`, `rotation_deg` and `tags_m` (b), and the same for the second half of
    the episode (``late_position_m``, ...), when constants have been estimated.

    Raises
    ------
    ValueError
        If the scene supports no inertial sensor, or its ranges do not determine the pose.
    """
    base, trials = scenes.get(scene), check_count("trials", trials)
    flown = base
    if base.inertial is None:
        flown = dataclasses.replace(base, inertial=SENSORS["consumer"])
    drawn = monte_carlo.simulate_trials(flown, trials, np.random.default_rng(seed))
    motions, unknowns = _motions(drawn), _unknowns(base)
    advance(0, more=len(motions) * len(unknowns))
    rows = []
    for motion, law in motions.items():
        for unknown, nuisances in unknowns.items():
            figures = _track_bound(drawn, law, nuisances)
            rows.append({"motion": motion, "unknown": unknown, **figures})
            advance()
    return {
        "scene": base.name,
        "trials": trials,
        "seed": seed,
        "epochs": base.steps + 1,
        "seconds": base.steps * base.dt,
        "uncalibrated": dataclasses.asdict(UNCALIBRATED),
        "rows": rows,
    }


def _unknowns(scene: Scene) -> dict[str, bounds.Nuisances]:
    """Return the sets of unknowns, by name; all include the offset and survey of the scene."""
    offset, survey = scene.links.offset, scene.survey_std_m
    found = {"none": bounds.Nuisances(offset, survey)}
    for std in SURVEYS_M:
        if std > survey:
            found[f"anchors to {100 * std:g} cm"] = bounds.Nuisances(offset, std)
    found["biases of links"] = bounds.Nuisances(offset, survey, UNCALIBRATED)
    if offset is None:
        found["offset of each tag"] = bounds.Nuisances("tag", survey)
    return found


class _Law(NamedTuple):
    """A motion model: information of the prior, its states, the motion of each epoch."""

    prior: FloatArray
    states: int
    motion_at: Callable[[simulation.Epoch, int], Motion]


def _motions(drawn: monte_carlo.SimulatedTrials) -> dict[str, _Law]:
    """Return the motion models, by name."""
    scene, episode = drawn.scene, drawn.episode
    pose = np.linalg.inv(episode.prior_covariance)
    law, true = _wandering(drawn)
    free = np.zeros((*pose.shape[:-2], 12, 12))
    free[..., :6, :6] = pose
    free[..., range(6, 12), range(6, 12)] = law.prior_std() ** -2.0
    still = ProcessNoise()
    found = {
        "ranges alone": _Law(
            free, 12, lambda _, k: bounds.UnknownTwist(true[:, k - 1], scene.dt, still, law)
        ),
        "known twist": _Law(
            pose, 6, lambda at, _: bounds.KnownTwist(at.twist, scene.dt, scene.process)
        ),
    }
    sensors = SENSORS if scene.inertial in SENSORS.values() else {**SENSORS, "own": scene.inertial}
    for name, sensor in sensors.items():
        assert sensor is not None
        prior = inertial.prior_information(episode.prior_covariance, sensor, scene.speed_std_m_s)
        found[f"{name} IMU"] = _Law(
            prior, 15, lambda at, _, sensor=sensor: felt_motion(at, scene.dt, sensor)
        )
    return found


def _wandering(drawn: monte_carlo.SimulatedTrials) -> tuple[WanderingTwist, FloatArray]:
    """Return a law fitted to the twists of the episodes, and the twists (B, T, 6)."""
    episode, dt = drawn.episode, drawn.scene.dt
    true = twists_between(episode.rotation, episode.translation, dt)
    rate, change = true.reshape(-1, 2, 3), np.diff(true, axis=-2).reshape(-1, 2, 3) / np.sqrt(dt)
    std = [np.sqrt((x**2).mean(axis=(0, 2))) if len(x) else np.zeros(2) for x in (rate, change)]
    # A body that never turns, or never accelerates, has no law.
    (turn, speed), (turning, speeding) = np.maximum(std, 1e-4).tolist()
    return WanderingTwist(turn, speed, turning, speeding), true


def _track_bound(
    drawn: monte_carlo.SimulatedTrials, law: _Law, nuisances: bounds.Nuisances
) -> dict[str, float]:
    """Return root mean squares over trials and epochs, for all epochs and for the second half."""
    scene, episode = drawn.scene, drawn.episode
    J = bounds.with_nuisances(law.prior, nuisances.count(scene.n_anchors, len(scene.tags)))
    variance, b = [], []
    for k, measured in enumerate(drawn.measurements):
        at = simulation.epoch_of(episode, k)
        if k:
            motion = law.motion_at(at, k)
            J = motion.predict(J, law.states, at.rotation)
        share = simulation.shares(scene, at, episode.anchors, measured.links)
        epoch = bounds.RangeEpoch(
            episode.anchors, scene.body, at.rotation, at.translation, scene.noise
        )
        J = with_epoch(J, information_of(epoch, nuisances, share), law.states)
        if not np.isfinite(J).all():
            raise ValueError(f"the ranges of scene {scene.name!r} do not determine the pose")
        P = np.linalg.inv(J)[..., :6, :6]
        variance.append(np.diagonal(P, axis1=-2, axis2=-1))
        b.append(bounds.score(P, at.rotation, scene.body))
    figures: dict[str, float] = {}
    half = len(b) // 2
    for label, rows in (("", slice(None)), ("late_", slice(half, None))):
        part = np.array(variance)[rows]
        figures[f"{label}position_m"] = float(np.sqrt(part[..., 3:].sum(axis=-1).mean()))
        turn = np.sqrt(part[..., :3].sum(axis=-1).mean())
        figures[f"{label}rotation_deg"] = float(np.rad2deg(turn))
        figures[f"{label}tags_m"] = float(monte_carlo.rms(np.array(b)[rows]))
    return figures

"""Reference policies of the tasks with a filter in the loop: what learned ones are measured by.

A controller is a function ``(env, rng) -> actions`` of a vector environment of `tasks`; it reads
the belief and the model, never the truth. Only `greedy_with_map` knows where the racks stand.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray
from rbl_gym.motion.kinematics import propagate
from rbl_gym.wrappers.selection import AnchorSelectionVectorEnv
from rbl_gym.wrappers.tasks import MobileAnchorsVectorEnv

__all__ = [
    "MOBILE", "SELECTION", "greedy_blind", "greedy_with_map", "nearest", "orbit",
    "receding_horizon", "ring",
]  # fmt: skip

Controller = Callable[[Any, np.random.Generator], np.ndarray]

# Radius of ring and orbit in units of the vehicle's depth, and the angle between two craft (more
# are spread evenly): tuned on the task's own worlds. Two craft see the vehicle from one side
# only, and do best close above it, where they go around it fastest.
RING_DEPTHS, ORBIT_DEPTHS = 0.9, 0.9
PAIR_RING_DEPTHS, PAIR_ORBIT_DEPTHS, PAIR_ANGLE = 0.25, 0.14, 2.6
# Receding horizon: steps ahead, samples, elites, rounds.
_HORIZON, _SAMPLES, _ELITES, _ROUNDS = 6, 64, 8, 3


# --- surface craft ----------------------------------------------------------------------------


def random_velocities(env: MobileAnchorsVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Uniform actions."""
    return rng.uniform(-1, 1, (env.num_envs, 2 * env.scene.n_anchors))


def ring(env: MobileAnchorsVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Keep a ring about the estimate, about as wide as the vehicle is deep."""
    pair = env.scene.n_anchors == 2
    return _towards(env, _around(env, PAIR_RING_DEPTHS if pair else RING_DEPTHS, 0.0))


def orbit(env: MobileAnchorsVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Circle the estimate as fast as the craft go."""
    pair = env.scene.n_anchors == 2
    return _towards(env, _around(env, PAIR_ORBIT_DEPTHS if pair else ORBIT_DEPTHS, 1.0))


def _around(env: MobileAnchorsVectorEnv, depths: float, ahead: float) -> FloatArray:
    """Targets (B, M, 2) on a ring, the craft in the order of their bearings.

    `ahead`: how many steps of travel along the ring they lie before the craft.
    """
    centre = env.belief.translation[:, None, :2] + env.twist[:, None, 3:5] * env.scene.dt
    radius = depths * np.maximum(np.abs(env.belief.translation[:, 2]), 10.0)[:, None]
    gap = env.anchors[..., :2] - centre
    angle = np.arctan2(gap[..., 1], gap[..., 0])
    rank = np.argsort(np.argsort(angle, axis=-1), axis=-1)
    n_anchors = env.scene.n_anchors
    slot = (PAIR_ANGLE if n_anchors == 2 else 2 * np.pi / n_anchors) * rank
    # The turn of the ring that fits the craft best.
    turn = np.angle(np.exp(1j * (angle - slot)).mean(axis=-1))[:, None]
    travel = ahead * env.scene.anchor_speed_m_s * env.scene.dt / radius
    place = turn + slot + travel
    return centre + radius[..., None] * np.stack([np.cos(place), np.sin(place)], axis=-1)


def _towards(env: MobileAnchorsVectorEnv, targets: FloatArray) -> np.ndarray:
    """Actions that bring the craft to targets (B, M, 2), or as near as one step allows."""
    reach = env.scene.anchor_speed_m_s * env.scene.dt
    return _ordered(env, (targets - env.anchors[..., :2]) / reach)


def _ordered(env: MobileAnchorsVectorEnv, velocity: FloatArray) -> np.ndarray:
    """Actions (B, 2 M) of velocities (B, M, 2) of the craft by number, in units of the limit."""
    length = np.linalg.norm(velocity, axis=-1, keepdims=True)
    velocity = velocity / np.maximum(length, 1.0)
    return np.take_along_axis(velocity, env.order[..., None], axis=1).reshape(env.num_envs, -1)


def receding_horizon(env: MobileAnchorsVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Plan six steps ahead by the cross-entropy method on the predicted bound, do the first.

    The vehicle is predicted by its present twist; the plan is a velocity of each craft at each
    step. The orbit is among the first samples.
    """
    n, n_anchors = env.num_envs, env.scene.n_anchors
    first = np.empty((n, n_anchors, 2))
    np.put_along_axis(first, env.order[..., None], orbit(env, rng).reshape(n, n_anchors, 2), axis=1)
    mean = np.repeat(first[:, None], _HORIZON, axis=1)
    std = np.full(mean.shape, 0.6)
    poses = _predicted(env)
    for _ in range(_ROUNDS):
        plans = mean[:, None] + std[:, None] * rng.standard_normal((n, _SAMPLES, *mean.shape[1:]))
        plans[:, 0] = mean
        plans /= np.maximum(np.linalg.norm(plans, axis=-1, keepdims=True), 1.0)
        cost = _plan_cost(env, plans, poses)
        elite = np.argsort(cost, axis=-1)[:, :_ELITES, None, None, None]
        chosen = np.take_along_axis(plans, elite, axis=1)
        mean, std = chosen.mean(axis=1), chosen.std(axis=1) + 0.02
    return _ordered(env, mean[:, 0])


def _predicted(env: MobileAnchorsVectorEnv) -> list[tuple[FloatArray, FloatArray]]:
    """Poses (B, 1, ...) of the next steps if the twist stays what it is."""
    pose = env.belief.rotation[:, None], env.belief.translation[:, None]
    poses = []
    for _ in range(_HORIZON):
        pose = propagate(*pose, env.twist[:, None], env.scene.dt)
        poses.append(pose)
    return poses


def _plan_cost(
    env: MobileAnchorsVectorEnv, plans: FloatArray, poses: list[tuple[FloatArray, FloatArray]]
) -> FloatArray:
    """Mean log b (B, S) of plans (B, S, H, M, 2) along the predicted poses."""
    scene, tags = env.scene, np.asarray(env.scene.tags)
    information = np.linalg.inv(env.belief.covariance)[:, None]
    anchors = np.broadcast_to(env.anchors[:, None], (*plans.shape[:2], *env.anchors.shape[1:]))
    cost = np.zeros(plans.shape[:2])
    for k, (rotation, translation) in enumerate(poses):
        step = np.zeros(anchors.shape)
        step[..., :2] = plans[:, :, k] * (scene.anchor_speed_m_s * scene.dt)
        anchors = scene.anchor_region.project(anchors + step)
        information = bounds.predict_information(
            information, env.twist[:, None], scene.dt, scene.process
        )
        information = information + bounds.information_at(
            anchors, tags, rotation, translation, scene.noise, offset=scene.links.offset
        )
        cost += np.log(bounds.score(np.linalg.inv(information), rotation, tags))
    return cost / len(poses)


# --- choosing anchors -------------------------------------------------------------------------


def random_anchors(env: AnchorSelectionVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """k of them, or in the priced form each with probability 1/2."""
    scores = rng.uniform(-1, 1, (env.num_envs, env.scene.n_anchors))
    return scores if env.mode == "top-k" else (scores > 0).astype(np.int8)


def nearest(env: AnchorSelectionVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """The k nearest to the estimate."""
    distance = np.linalg.norm(env.anchors - env.belief.translation[:, None], axis=-1)
    scores = 1 - 2 * np.argsort(np.argsort(distance, axis=-1), axis=-1) / env.scene.n_anchors
    if env.mode == "top-k":
        return scores
    return (np.argsort(np.argsort(distance, axis=-1), axis=-1) < env.k).astype(np.int8)


def greedy_blind(env: AnchorSelectionVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """One after the other where it helps the predicted belief most, as if nothing blocked sight."""
    return _greedy(env, np.ones((env.num_envs, env.scene.n_anchors)))


def greedy_with_map(env: AnchorSelectionVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """As `greedy_blind`, with the racks known."""
    _, translation = propagate(env.belief.rotation, env.belief.translation, env.twist, env.scene.dt)
    return _greedy(env, env.scene.obstruction.share(env.anchors, translation[:, None])[:, 0])


def _greedy(env: AnchorSelectionVectorEnv, quality: FloatArray) -> np.ndarray:
    """Actions that choose greedily, links weighted by `quality` (B, M)."""
    scene, tags = env.scene, np.asarray(env.scene.tags)
    rows = np.arange(env.num_envs)
    pose = propagate(env.belief.rotation, env.belief.translation, env.twist, scene.dt)
    covariance = bounds.predict_covariance(
        env.belief.covariance, env.twist, scene.dt, scene.process
    )
    rotation, translation = pose[0][:, None], pose[1][:, None]
    parts = (
        bounds.information_at(env.anchors[:, :, None], tags, rotation, translation, scene.noise)
        * quality[..., None, None]
    )
    total = np.linalg.inv(covariance)
    best = np.log(bounds.score(covariance, pose[0], tags))
    chosen = np.zeros(quality.shape, dtype=np.bool_)
    for _ in range(env.k if env.mode == "top-k" else scene.n_anchors):
        trial = np.linalg.inv(total[:, None] + parts)
        value = np.log(bounds.score(trial, rotation, tags))
        value[chosen] = np.inf
        pick = value.argmin(axis=-1)
        if env.mode == "top-k":
            take = np.ones(env.num_envs, dtype=np.bool_)
        else:
            take = value[rows, pick] < best - env.price
        chosen[rows[take], pick[take]] = True
        total[take] += parts[rows[take], pick[take]]
        best = np.where(take, value[rows, pick], best)
    return np.where(chosen, 1.0, -1.0) if env.mode == "top-k" else chosen.astype(np.int8)


MOBILE: dict[str, Controller] = {
    "random": random_velocities,
    "ring": ring,
    "orbit": orbit,
    "receding-horizon": receding_horizon,
}
SELECTION: dict[str, Controller] = {
    "random": random_anchors,
    "nearest": nearest,
    "greedy-blind": greedy_blind,
    "greedy-with-map": greedy_with_map,
}

"""Reference policies for the tasks with a filter in the loop.

A controller is a function ``(env, rng) -> actions`` of a vector environment with one scene. `rng`
is a Generator; controllers without random numbers do not use it. A controller reads the belief and
the model, never the truth. Only `greedy_with_map` knows the positions of the racks. The controllers
in `MOBILE` and `SELECTION` also accept families of scenes.
"""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray
from rbl_gym.motion.kinematics import propagate
from rbl_gym.wrappers.selection import AnchorSelectionVectorEnv
from rbl_gym.wrappers.situations import Controller, Situation, craft_by_number, in_each_scene
from rbl_gym.wrappers.tasks import MobileAnchorsVectorEnv

__all__ = [
    "MOBILE", "SELECTION", "greedy_blind", "greedy_with_map", "nearest", "orbit",
    "receding_horizon", "ring",
]  # fmt: skip

# Radius of ring and orbit in units of the vehicle's depth, and the angle between two craft (more
# than two are spread evenly). These were tuned on the task's own worlds. Two craft see the vehicle
# from one side only. They do best close above it, where they circle it fastest.
RING_DEPTHS, ORBIT_DEPTHS = 0.9, 0.9
PAIR_RING_DEPTHS, PAIR_ORBIT_DEPTHS, PAIR_ANGLE = 0.25, 0.14, 2.6
# Receding horizon: steps ahead, samples, elites, iterations.
_HORIZON, _SAMPLES, _ELITES, _ROUNDS = 6, 64, 8, 3


# --- surface craft ----------------------------------------------------------------------------


def random_velocities(env: MobileAnchorsVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Return uniform actions."""
    return rng.uniform(-1, 1, (env.num_envs, 2 * env.scene.n_anchors))


def ring(env: MobileAnchorsVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Keep the craft on a ring around the estimate, with radius `RING_DEPTHS` times the depth.

    Two craft: `PAIR_RING_DEPTHS`.
    """
    pair = env.scene.n_anchors == 2
    return _towards(env, _around(env, PAIR_RING_DEPTHS if pair else RING_DEPTHS, 0.0))


def orbit(env: MobileAnchorsVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Circle the estimate at full speed."""
    pair = env.scene.n_anchors == 2
    return _towards(env, _around(env, PAIR_ORBIT_DEPTHS if pair else ORBIT_DEPTHS, 1.0))


def _around(env: MobileAnchorsVectorEnv, depths: float, ahead: float) -> FloatArray:
    """Return targets (B, M, 2) on a ring around the estimate, see `on_ring`."""
    reach = np.full(env.num_envs, env.scene.anchor_speed_m_s * env.scene.dt)
    centre = env.belief.translation + env.twist[:, 3:] * (env.scene.dt, env.scene.dt, 0.0)
    return on_ring(centre, craft_by_number(env), reach, depths, ahead)


def on_ring(
    centre: FloatArray, craft: FloatArray, reach_m: FloatArray, depths: float, ahead: float
) -> FloatArray:
    """Return targets (B, M, 2) of craft on a ring, in the order of their bearings.

    The ring's centre (B, 3) is at the vehicle's depth, its radius in units of that depth; craft (B,
    M, 3) move at most `reach_m` (B,) in a step, and targets are `ahead` steps along the ring.
    """
    n_craft = craft.shape[-2]
    radius = depths * np.maximum(np.abs(centre[:, 2]), 10.0)[:, None]
    gap = craft[..., :2] - centre[:, None, :2]
    angle = np.arctan2(gap[..., 1], gap[..., 0])
    rank = np.argsort(np.argsort(angle, axis=-1), axis=-1)
    slot = (PAIR_ANGLE if n_craft == 2 else 2 * np.pi / n_craft) * rank
    # The rotation of the ring that fits the craft best.
    turn = np.angle(np.exp(1j * (angle - slot)).mean(axis=-1))[:, None]
    place = turn + slot + ahead * reach_m[:, None] / radius
    around = radius[..., None] * np.stack([np.cos(place), np.sin(place)], axis=-1)
    return centre[:, None, :2] + around


def _towards(env: MobileAnchorsVectorEnv, targets: FloatArray) -> np.ndarray:
    """Return actions that move craft to targets (B, M, 2), or as close as one step allows."""
    reach = env.scene.anchor_speed_m_s * env.scene.dt
    return _ordered(env, (targets - craft_by_number(env)[..., :2]) / reach)


def _ordered(env: MobileAnchorsVectorEnv, velocity: FloatArray) -> np.ndarray:
    """Return actions (B, 2 M) of velocities (B, M, 2) by craft number, in units of the limit."""
    length = np.linalg.norm(velocity, axis=-1, keepdims=True)
    velocity = velocity / np.maximum(length, 1.0)
    return np.take_along_axis(velocity, env.order[..., None], axis=1).reshape(env.num_envs, -1)


def receding_horizon(env: MobileAnchorsVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Plan six steps by the cross-entropy method on the predicted bound; return the first.

    The vehicle is predicted with its present twist. A plan is a velocity of each craft at each
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
    """Return poses (B, 1, ...) of the next steps, with the present twist."""
    pose = env.belief.rotation[:, None], env.belief.translation[:, None]
    poses = []
    for _ in range(_HORIZON):
        pose = propagate(*pose, env.twist[:, None], env.scene.dt)
        poses.append(pose)
    return poses


def _plan_cost(
    env: MobileAnchorsVectorEnv, plans: FloatArray, poses: list[tuple[FloatArray, FloatArray]]
) -> FloatArray:
    """Return the mean log b (B, S) of plans (B, S, H, M, 2) along the predicted poses."""
    scene, tags = env.scene, np.asarray(env.scene.tags)
    information = np.linalg.inv(env.belief.covariance)[:, None]
    craft = craft_by_number(env)
    anchors = np.broadcast_to(craft[:, None], (*plans.shape[:2], *craft.shape[1:]))
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
    """Choose k random anchors, or in the priced form each with probability 1/2."""
    scores = rng.uniform(-1, 1, (env.num_envs, env.scene.n_anchors))
    return scores if env.mode == "top-k" else (scores > 0).astype(np.int8)


def nearest(env: AnchorSelectionVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Choose the k anchors nearest to the estimate."""
    distance = np.linalg.norm(env.anchors - env.belief.translation[:, None], axis=-1)
    scores = 1 - 2 * np.argsort(np.argsort(distance, axis=-1), axis=-1) / env.scene.n_anchors
    if env.mode == "top-k":
        return scores
    return (np.argsort(np.argsort(distance, axis=-1), axis=-1) < env.k).astype(np.int8)


def greedy_blind(env: AnchorSelectionVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Choose anchors greedily by the predicted belief, as if nothing blocked the line of sight."""
    return greedy(env, np.ones((env.num_envs, env.scene.n_anchors)))


def greedy_with_map(env: AnchorSelectionVectorEnv, rng: np.random.Generator) -> np.ndarray:
    """As `greedy_blind`, with known racks."""
    _, translation = propagate(env.belief.rotation, env.belief.translation, env.twist, env.scene.dt)
    return greedy(env, env.scene.obstruction.share(env.anchors, translation[:, None])[:, 0])


def greedy(env: AnchorSelectionVectorEnv | Situation, quality: FloatArray) -> np.ndarray:
    """Return actions that choose greedily, with links weighted by `quality` (B, M)."""
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
    "random": in_each_scene(random_velocities),
    "ring": in_each_scene(ring),
    "orbit": in_each_scene(orbit),
    "receding-horizon": in_each_scene(receding_horizon),
}
SELECTION: dict[str, Controller] = {
    "random": in_each_scene(random_anchors),
    "nearest": in_each_scene(nearest),
    "greedy-blind": in_each_scene(greedy_blind),
    "greedy-with-map": in_each_scene(greedy_with_map),
}

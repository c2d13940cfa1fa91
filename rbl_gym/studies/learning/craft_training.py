"""PPO of a policy for any number of craft; it starts as the orbit.

Proximal policy optimisation (Schulman et al., 2017) with networks over sets. All craft share one
policy and one critic, and the critic's outputs are averaged. stable-baselines3 has no such
networks. Worlds with the same number of craft are trained together, so that nothing is computed for
padding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch

from rbl_gym.checks import FloatArray
from rbl_gym.studies.learning.rl_tasks import SEED_STRIDE, RlTask
from rbl_gym.studies.learning.set_networks import SetNetwork
from rbl_gym.studies.learning.set_policies import craft_actions, craft_seen
from rbl_gym.wrappers.craft_tokens import OWN, PAIR

__all__ = ["train_craft"]

# Passes over a rollout, samples of an update, limit of the ratio, maximum norm of a gradient.
_EPOCHS, _SAMPLES, _LIMIT, _CLIP = 4, 640, 0.2, 0.5
_LEARNING_RATE, _CRITICS_RATE, _STD = 6e-4, 1e-3, 0.3


class _Rollout(NamedTuple):
    """Steps of all worlds (T, B, ...) with M craft each, single precision.

    `velocity` is in the frames of the craft, before clipping; `chance` is its log density; `value`
    is from the critic; `last` is whether the episode ended with the step.
    """

    own: np.ndarray
    pairs: np.ndarray
    others: np.ndarray
    orbit: np.ndarray
    there: np.ndarray
    velocity: np.ndarray
    chance: np.ndarray
    value: np.ndarray
    reward: np.ndarray
    last: np.ndarray


class _Learner(NamedTuple):
    """Networks, the log standard deviation of velocities, and the optimiser."""

    actor: SetNetwork
    critic: SetNetwork
    log_std: Any
    optimizer: Any

    @classmethod
    def new(cls) -> _Learner:
        """Return a learner whose policy is the orbit."""
        actor = SetNetwork(OWN, PAIR, 2)
        critic = SetNetwork(OWN, PAIR, 1, inner=(32, 32), outer=(64, 64))
        with torch.no_grad():
            actor.outer[-1].weight *= 0.0
            actor.outer[-1].bias *= 0.0
        log_std = torch.nn.Parameter(torch.full((2,), float(np.log(_STD))))
        groups = [
            {"params": [*actor.parameters(), log_std], "lr": _LEARNING_RATE},
            {"params": list(critic.parameters()), "lr": _CRITICS_RATE},
        ]
        return cls(actor, critic, log_std, torch.optim.Adam(groups))


def train_craft(
    task: RlTask, steps: int, seed: int, advance: Callable[[int], None]
) -> tuple[SetNetwork, list[dict[str, float]]]:
    """Train the network of a policy for craft.

    Parameters
    ----------
    task
        A task of `RBL/MobileAnchors-v0`. Its `gamma`, `gae_lambda`, `num_envs` and `rollout` are
        used.
    steps
        Steps of all worlds together.
    seed
        Seed of worlds, networks and actions.
    advance
        Called with the steps of each rollout.

    Returns
    -------
    The network, and the learning curve: steps, and the mean reward of the rollouts since the
    previous point.
    """
    torch.manual_seed(seed)
    rng, learner = np.random.default_rng(seed), _Learner.new()
    rates = [group["lr"] for group in learner.optimizer.param_groups]
    settings = task.training
    env = task.make(settings.num_envs)
    env.reset(seed=seed * SEED_STRIDE)
    each = settings.num_envs * settings.rollout
    curve, rewards, every = [], [], max(1, -(-steps // each) // 50)
    for done in range(0, steps, each):
        for group, rate in zip(learner.optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * max(0.05, 1 - done / steps)
        rollout, beyond = _rolled_out(env, learner, settings.rollout, rng)
        advantage, target = _advantages(rollout, beyond, settings.gamma, settings.gae_lambda)
        _learn(learner, rollout, advantage, target, rng)
        rewards.append(float(rollout.reward.mean()))
        if len(rewards) == every:
            curve.append({"steps": done + each, "mean_reward": float(np.mean(rewards))})
            rewards = []
        advance(each)
    return learner.actor, curve


def _by_count(there: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Return numbers of craft, and for each the rows of the masks (S, M) that have it."""
    counts = there.sum(axis=-1).astype(int)
    for count in np.unique(counts).tolist():
        yield count, np.flatnonzero(counts == count)


def _trimmed(count: int, rows: np.ndarray, *arrays: np.ndarray) -> tuple[Any, ...]:
    """Return own tokens, pairs and masks of some rows with `count` craft each, in torch."""
    own, pairs, others = (array[rows, :count] for array in arrays)
    return tuple(map(torch.from_numpy, (own, pairs[:, :, :count], others[:, :, :count])))


def _rolled_out(
    env: Any, learner: _Learner, steps: int, rng: np.random.Generator
) -> tuple[_Rollout, np.ndarray]:
    """Run some steps of the worlds; return them and the values of the final states."""
    std, rows = np.exp(learner.log_std.detach().numpy()), []
    value = np.zeros(0, np.float32)
    for k in range(steps + 1):
        seen = craft_seen(env)
        told = [one.astype(np.float32) for one in (seen.own, seen.pairs, seen.others)]
        there = env.inner_observation.get("anchor_mask", np.ones(seen.own.shape[:2], np.int8))
        mean, value = seen.orbit.astype(np.float32), np.zeros(len(there), np.float32)
        for count, which in _by_count(there):
            own = _trimmed(count, which, *told)
            with torch.no_grad():
                mean[which, :count] += learner.actor(*own).numpy()
                value[which] = learner.critic(*own)[..., 0].mean(-1).numpy()
        if k == steps:
            break
        normal = rng.standard_normal(mean.shape).astype(np.float32)
        velocity = mean + std * normal
        density = (-0.5 * normal**2 - np.log(std)) * there[..., None]
        _, reward, terminated, truncated, _ = env.step(craft_actions(env, seen, velocity))
        rows.append(
            (*told, seen.orbit.astype(np.float32), there, velocity, density.sum(axis=(-1, -2)))
            + (value, reward.astype(np.float32), terminated | truncated)
        )
    return _Rollout(*(np.stack(field) for field in zip(*rows, strict=True))), value


def _advantages(
    rollout: _Rollout, beyond: np.ndarray, gamma: float, mixing: float
) -> tuple[FloatArray, FloatArray]:
    """Return generalised advantages (T, B) and targets of the critic, in units of a reward.

    The critic predicts values times 1 - gamma. Episodes end by their length, so the value of the
    end is taken from the step before.
    """
    scale = 1 / (1 - gamma)
    value = scale * rollout.value
    following = np.concatenate([value[1:], scale * beyond[None]])
    following = np.where(rollout.last, value, following)
    error = rollout.reward + gamma * following - value
    advantage, total = np.zeros_like(error), np.zeros(error.shape[1])
    for t in range(len(error) - 1, -1, -1):
        total = error[t] + gamma * mixing * np.where(rollout.last[t], 0.0, total)
        advantage[t] = total
    return advantage, (advantage + value) / scale


def _learn(
    learner: _Learner,
    rollout: _Rollout,
    advantage: FloatArray,
    target: FloatArray,
    rng: np.random.Generator,
) -> None:
    """Make some passes over a rollout."""
    flat = _Rollout(*(field.reshape(-1, *field.shape[2:]) for field in rollout))
    advantage, target = advantage.ravel(), target.ravel()
    groups = list(_by_count(flat.there))
    for _, rows in groups:
        own = advantage[rows]
        advantage[rows] = (own - own.mean()) / (own.std() + 1e-6)
    actors = learner.optimizer.param_groups[0]["params"]
    for _ in range(_EPOCHS):
        parts = [
            (count, part)
            for count, rows in groups
            for part in np.array_split(rng.permutation(rows), -(-len(rows) // _SAMPLES))
        ]
        for index in rng.permutation(len(parts)):
            count, rows = parts[index]
            told = _trimmed(count, rows, flat.own, flat.pairs, flat.others)
            orbit, velocity = (
                torch.from_numpy(one[rows, :count]) for one in (flat.orbit, flat.velocity)
            )
            chance, gain, wanted = (
                torch.from_numpy(one[rows].astype(np.float32))
                for one in (flat.chance, advantage, target)
            )
            gap = (velocity - learner.actor(*told) - orbit) / learner.log_std.exp()
            density = (-0.5 * gap**2 - learner.log_std).sum((-1, -2))
            ratio = torch.exp(density - chance)
            kept = torch.clamp(ratio, 1 - _LIMIT, 1 + _LIMIT)
            loss = -torch.minimum(ratio * gain, kept * gain).mean()
            loss = loss + ((learner.critic(*told)[..., 0].mean(-1) - wanted) ** 2).mean()
            learner.optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(actors, _CLIP)
            learner.optimizer.step()

"""Training on a learning task by PPO, its variants, or a method of the task; writes a file.

PPO is from stable-baselines3; `MaskablePPO` and `RecurrentPPO` are from sb3-contrib.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym.checks import check_one_of
from rbl_gym.extras import require
from rbl_gym.studies.learning.policies import AnyPolicy, Policy, kind_and_outputs
from rbl_gym.studies.learning.rl_tasks import HELD_OUT_SEED, SEED_STRIDE, RlTask, Training
from rbl_gym.studies.learning.sb3_models import policy_of
from rbl_gym.studies.learning.set_policies import SetPolicy

__all__ = ["ALGORITHMS", "check_training", "train"]

# The algorithms, and the kinds of policies that they train.
ALGORITHMS = {
    "ppo": "a multilayer perceptron",
    "maskable-ppo": "a multilayer perceptron with masks of the actions that are allowed",
    "recurrent-ppo": "a recurrent network (LSTM)",
    "set-ppo": "one network for any number of craft, which starts as the policy 'orbit'",
    "supervised": "a choice of any number of anchors by the links that it predicts to be in sight",
}
# Units of the memory, and of the layer after it.
_MEMORY, _BEHIND = 64, 64


def train(
    name: str,
    task: RlTask,
    steps: int,
    seed: int,
    advance: Callable[[int], None] = lambda steps: None,
    algorithm: str | None = None,
) -> tuple[AnyPolicy, dict[str, Any]]:
    """Train a policy, and return it with figures of the training.

    Parameters
    ----------
    name, task
        The task, and its name in the policy's file.
    steps, seed
        Number of environment steps, and the seed of worlds, networks and actions.
    advance
        Called after every rollout, with its environment steps.
    algorithm
        A name of `ALGORITHMS`; None: the task's own.

    Returns
    -------
    The deterministic policy, and figures: steps in whole rollouts, learning curve (environment
    steps, mean return of the episodes since the previous point), seconds, and the environment's
    share of them (None if it cannot be measured).

    Raises
    ------
    ValueError, MissingExtraError
        As `check_training`.
    """
    algorithm = check_training(task, seed, algorithm)
    import torch

    # One thread: small networks gain nothing from more, and the sums would vary.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    learn = _taught if algorithm in _TAUGHT else _explored
    begin, cpu = time.perf_counter(), time.process_time()
    done = 0

    def tell(more: int) -> None:
        # Whole rollouts may end after the number of steps, or before it.
        nonlocal done
        advance(min(done + more, steps) - min(done, steps))
        done += more

    try:
        make, figures = learn(algorithm, task, steps, seed, tell)
    finally:
        torch.set_num_threads(threads)
    advance(max(steps - done, 0))
    meta = {"task": name, "seed": seed, "steps": steps, "algorithm": algorithm}
    seconds = {"seconds": time.perf_counter() - begin, "cpu_seconds": time.process_time() - cpu}
    return make(meta), {**meta, "steps": done, **seconds, **figures}


def check_training(task: RlTask, seed: int, algorithm: str | None = None) -> str:
    """Return the algorithm of a training, if it can begin.

    Raises
    ------
    ValueError
        If the worlds of the seed are held out for evaluations, or the algorithm cannot learn the
        task.
    MissingExtraError
        If torch, stable-baselines3 or sb3-contrib is missing (extra ``rl``).
    """
    if seed * SEED_STRIDE >= HELD_OUT_SEED:
        raise ValueError(
            f"seed must be below {HELD_OUT_SEED // SEED_STRIDE}, got {seed}: the worlds of larger "
            "seeds are held out for evaluations"
        )
    algorithm = check_one_of("algorithm", algorithm or task.training.algorithm, list(ALGORITHMS))
    _check_goes_with(algorithm, task)
    libraries = ["torch"]
    if algorithm not in _TAUGHT:
        libraries += ["stable_baselines3"] if algorithm == "ppo" else ["sb3_contrib"]
    for library in libraries:
        require(library, "rl", "training")
    return algorithm


def _check_goes_with(algorithm: str, task: RlTask) -> None:
    """Raise ValueError if an algorithm cannot learn a task."""
    if algorithm in _TAUGHT:
        if task.env_id != _TAUGHT[algorithm]:
            raise ValueError(
                f"algorithm {algorithm!r} is for {_TAUGHT[algorithm]}, got a task of {task.env_id}"
            )
    elif algorithm == "maskable-ppo":
        kind, _ = kind_and_outputs(task.make(1).single_action_space)
        if kind == "box":
            raise ValueError(
                "algorithm 'maskable-ppo' is for tasks with discrete actions, those of "
                f"{task.env_id} are continuous here: use ppo or recurrent-ppo"
            )


# # --- supervised policies ----------------------------------------------------------------------

# Algorithms for policies with any number of anchors, and the environments that they fit.
_TAUGHT = {"set-ppo": "RBL/MobileAnchors-v0", "supervised": "RBL/AnchorSelection-v0"}


def _taught(
    algorithm: str, task: RlTask, steps: int, seed: int, advance: Callable[[int], None]
) -> tuple[Callable[[dict[str, Any]], SetPolicy], dict[str, Any]]:
    if algorithm == "set-ppo":
        from rbl_gym.studies.learning.craft_training import train_craft

        kind = "craft"
        network, curve = train_craft(task, steps, seed, advance)
    else:
        from rbl_gym.studies.learning.sight_training import train_sight

        kind = "sight"
        k = int(task.arguments.get("k", 3))
        network, curve = train_sight(task.scene_family(), k, steps, seed, advance)
    figures = {"env_share": None, "curve": curve}
    return lambda meta: SetPolicy(network.arrays(), kind, meta), figures


# # --- reinforcement learning -------------------------------------------------------------------


def _explored(
    algorithm: str, task: RlTask, steps: int, seed: int, advance: Callable[[int], None]
) -> tuple[Callable[[dict[str, Any]], Policy], dict[str, Any]]:
    import torch

    from rbl_gym.wrappers.sb3 import Sb3VecEnv

    settings = task.training
    envs = _Timed(Sb3VecEnv(task.make(settings.num_envs)))
    model = _model(algorithm, settings, envs.venv, seed)
    if settings.gamma < 1:
        # Rewards without an end have a sum far from zero. A critic that starts at this value learns
        # the differences, which matter, from the first update on.
        with torch.no_grad():
            model.policy.value_net.bias.fill_(_mean_reward(task, seed) / (1 - settings.gamma))
    # Seed again after PPO, whose own seeds overlap between neighbouring trainings.
    envs.venv.seed(seed * SEED_STRIDE)
    curve, cpu = _Curve(advance), time.process_time()
    model.learn(steps, callback=curve.callback())
    figures = {"env_share": envs.seconds / (time.process_time() - cpu), "curve": curve.points}
    policy = policy_of(model)
    return lambda meta: policy._replace(meta=meta), figures


def _model(algorithm: str, settings: Training, envs: Any, seed: int) -> Any:
    """Return the algorithm of stable-baselines3 or sb3-contrib with these settings."""
    kind = kind_and_outputs(envs.action_space)[0]
    network: dict[str, Any] = {"net_arch": list(settings.hidden)}
    if kind == "box":
        network["log_std_init"] = settings.log_std_init
    policy = "MlpPolicy"
    if algorithm == "maskable-ppo":
        from sb3_contrib import MaskablePPO

        form = MaskablePPO
    elif algorithm == "recurrent-ppo":
        from sb3_contrib import RecurrentPPO

        form, policy = RecurrentPPO, "MlpLstmPolicy"
        network |= {"lstm_hidden_size": _MEMORY, "net_arch": [_BEHIND]}
    else:
        from stable_baselines3 import PPO

        form = PPO
    with warnings.catch_warnings():
        # The last batch of a rollout may be smaller.
        warnings.filterwarnings("ignore", "You have specified a mini-batch size")
        return form(
            policy,
            envs,
            n_steps=settings.rollout,
            batch_size=settings.batch_size,
            n_epochs=settings.epochs,
            gamma=settings.gamma,
            gae_lambda=settings.gae_lambda,
            learning_rate=lambda remaining: settings.learning_rate * remaining,
            policy_kwargs=network,
            seed=seed,
            device="cpu",
        )


def _mean_reward(task: RlTask, seed: int) -> float:
    """Return the mean reward of a step under random actions, over a short rollout."""
    envs = task.make(16)
    envs.reset(seed=seed * SEED_STRIDE)
    envs.action_space.seed(seed)
    steps = range(task.training.rollout)
    return float(np.mean([envs.step(envs.action_space.sample())[1] for _ in steps]))


class _Timed:
    """A vector environment that measures the process time of its steps."""

    def __init__(self, venv: Any) -> None:
        self.venv = venv
        self.seconds = 0.0
        step = venv.step_wait

        def timed() -> Any:
            begin = time.process_time()
            result = step()
            self.seconds += time.process_time() - begin
            return result

        venv.step_wait = timed


class _Curve:
    """Mean returns during the training."""

    def __init__(self, advance: Callable[[int], None]) -> None:
        self.points: list[dict[str, float]] = []
        self._advance = advance
        self._seen = 0
        self._returns: list[float] = []

    def callback(self) -> Any:
        from stable_baselines3.common.callbacks import BaseCallback

        curve = self

        class Callback(BaseCallback):
            def _on_step(self) -> bool:
                curve._returns += [i["episode"]["r"] for i in self.locals["infos"] if i]
                return True

            def _on_rollout_end(self) -> None:
                curve._advance(self.num_timesteps - curve._seen)
                curve._seen = self.num_timesteps
                if len(curve._returns) >= 1000:
                    mean = float(np.mean(curve._returns))
                    curve.points.append({"steps": self.num_timesteps, "mean_return": mean})
                    curve._returns = []

        return Callback()

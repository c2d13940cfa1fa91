"""PPO (stable-baselines3) on a learning task; the result is a small policy in numpy."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym.studies.learning.policies import Policy, kind_and_outputs
from rbl_gym.studies.learning.rl_tasks import HELD_OUT_SEED, SEED_STRIDE, RlTask

__all__ = [
    "train",
]


def train(
    name: str,
    task: RlTask,
    steps: int,
    seed: int,
    advance: Callable[[int], None] = lambda steps: None,
) -> tuple[Policy, dict[str, Any]]:
    """Train a policy by PPO, and say how it went.

    Parameters
    ----------
    name, task
        What is learned, and the name that the policy's file gives it.
    steps, seed
        Environment steps, and the seed of worlds, networks and actions.
    advance
        Called after every rollout, with its environment steps.

    Returns
    -------
    The deterministic policy, and figures: learning curve (environment steps, mean return of the
    episodes since the point before), seconds, and the share that the environment took of them.

    Raises
    ------
    ValueError
        On a seed whose worlds are held out for evaluations.
    ModuleNotFoundError
        Without stable-baselines3 (extra ``rl``).
    """
    if seed * SEED_STRIDE >= HELD_OUT_SEED:
        raise ValueError(
            f"seed must be below {HELD_OUT_SEED // SEED_STRIDE}, got {seed}: the "
            "worlds of larger ones are held out for evaluations"
        )
    import torch  # pyright: ignore[reportMissingImports]

    # Small networks: threads cost more than they give, and vary the sums.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _train(name, task, steps, seed, advance)
    finally:
        torch.set_num_threads(threads)


def _train(
    name: str, task: RlTask, steps: int, seed: int, advance: Callable[[int], None]
) -> tuple[Policy, dict[str, Any]]:
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]

    from rbl_gym.wrappers.sb3 import Sb3VecEnv

    envs = _Timed(Sb3VecEnv(task.make(task.num_envs)))
    continuous = kind_and_outputs(envs.venv.action_space)[0] == "box"
    log_std = {"log_std_init": task.log_std_init} if continuous else {}
    with warnings.catch_warnings():
        # The last batch of a rollout may be a smaller one.
        warnings.filterwarnings("ignore", "You have specified a mini-batch size")
        model = PPO(
            "MlpPolicy",
            envs.venv,
            n_steps=task.rollout,
            batch_size=task.batch_size,
            n_epochs=task.epochs,
            gamma=task.gamma,
            gae_lambda=task.gae_lambda,
            learning_rate=lambda remaining: task.learning_rate * remaining,
            policy_kwargs={"net_arch": list(task.hidden), **log_std},
            seed=seed,
            device="cpu",
        )
    if task.gamma < 1:
        # Rewards that never end sum to far from zero: a critic that starts there learns what
        # matters, the differences, from the first update on.
        with torch.no_grad():
            model.policy.value_net.bias.fill_(_mean_reward(task, seed) / (1 - task.gamma))
    # After PPO has seeded the worlds itself, with seeds that neighbouring trainings share.
    envs.venv.seed(seed * SEED_STRIDE)
    curve = _Curve(advance)
    begin, cpu = time.perf_counter(), time.process_time()
    model.learn(steps, callback=curve.callback())
    figures = {
        "task": name,
        "seed": seed,
        "steps": int(model.num_timesteps),
        "seconds": time.perf_counter() - begin,
        "cpu_seconds": time.process_time() - cpu,
        "env_share": envs.seconds / (time.process_time() - cpu),
        "curve": curve.points,
    }
    meta = {
        "task": name,
        "seed": seed,
        "steps": steps,
        "command": f"rbl-gym train {name} --steps {steps} --seed {seed}",
    }
    return _policy(model, meta), figures


def _mean_reward(task: RlTask, seed: int) -> float:
    """Mean reward of a step under random actions, over a short rollout."""
    envs = task.make(16)
    envs.reset(seed=seed * SEED_STRIDE)
    envs.action_space.seed(seed)
    return float(np.mean([envs.step(envs.action_space.sample())[1] for _ in range(task.rollout)]))


class _Timed:
    """A vector environment whose steps are timed (process time)."""

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
    """Mean returns along the training."""

    def __init__(self, advance: Callable[[int], None]) -> None:
        self.points: list[dict[str, float]] = []
        self._advance = advance
        self._seen = 0
        self._returns: list[float] = []

    def callback(self) -> Any:
        from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]

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


def _policy(model: Any, meta: dict[str, Any]) -> Policy:
    """The policy network of a PPO model as arrays."""
    import torch  # pyright: ignore[reportMissingImports]

    layers = [m for m in model.policy.mlp_extractor.policy_net if isinstance(m, torch.nn.Linear)]
    layers.append(model.policy.action_net)
    return Policy(
        tuple(layer.weight.detach().numpy().astype(float) for layer in layers),
        tuple(layer.bias.detach().numpy().astype(float) for layer in layers),
        kind_and_outputs(model.action_space)[0],
        meta,
    )

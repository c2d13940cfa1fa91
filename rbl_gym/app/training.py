"""PPO (stable-baselines3) on a learning task; the result is a small policy in numpy."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym.app.policies import Policy
from rbl_gym.app.rl_tasks import RlTask


def train(
    name: str, task: RlTask, steps: int, seed: int, advance: Callable[[int], None]
) -> tuple[Policy, dict[str, Any]]:
    """Train, and say how it went.

    Returns
    -------
    The deterministic policy, and figures: learning curve (environment steps, mean return of the
    episodes since the point before), seconds, and the share that the environment took of them.

    Raises
    ------
    ModuleNotFoundError
        Without stable-baselines3 (extra ``rl``).
    """
    import torch
    from stable_baselines3 import PPO

    from rbl_gym.wrappers.sb3 import Sb3VecEnv

    # Small networks: threads cost more than they give, and vary the sums.
    torch.set_num_threads(1)
    envs = _Timed(Sb3VecEnv(task.make(task.num_envs)))
    envs.venv.seed(seed * 1_000_000)
    model = PPO(
        "MlpPolicy",
        envs.venv,
        n_steps=task.rollout,
        batch_size=task.batch_size,
        n_epochs=task.epochs,
        gamma=task.gamma,
        gae_lambda=task.gae_lambda,
        learning_rate=lambda remaining: task.learning_rate * remaining,
        policy_kwargs={"net_arch": list(task.hidden), **_log_std(task)},
        seed=seed,
        device="cpu",
        **task.options,
    )
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


def _log_std(task: RlTask) -> dict[str, float]:
    import gymnasium as gym

    continuous = isinstance(task.make(1).single_action_space, gym.spaces.Box)
    return {"log_std_init": task.log_std_init} if continuous else {}


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


def _policy(model: Any, meta: dict[str, Any]) -> Policy:
    """The policy network of a PPO model as arrays."""
    import gymnasium as gym
    import torch

    layers = [m for m in model.policy.mlp_extractor.policy_net if isinstance(m, torch.nn.Linear)]
    layers.append(model.policy.action_net)
    kinds = {gym.spaces.Discrete: "discrete", gym.spaces.MultiBinary: "multi-binary"}
    return Policy(
        tuple(layer.weight.detach().numpy().astype(float) for layer in layers),
        tuple(layer.bias.detach().numpy().astype(float) for layer in layers),
        kinds.get(type(model.action_space), "box"),
        meta,
    )

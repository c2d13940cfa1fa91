"""PPO on scalar environments, as most people make them, against the native vector environments.

    python benchmarks/training_loops.py [--repeats 3] [--steps 8192] [--rllib 1] [--json F]

Takes the extra rl. One thread, process time, the whole training: environment and PPO. Learners,
each on several forms of the same worlds:

- stable-baselines3's PPO: `Sb3VecEnv` on the native environment; `make_vec_env` (DummyVecEnv and
  Monitor) on scalar ones.
- the loop of examples/ppo_single_file.py, which is CleanRL's: the native environment;
  `SyncVectorEnv` of scalar ones, each in `RecordEpisodeStatistics`; and
  ``gym.make_vec(vectorization_mode="sync")``.
- with --rllib 1 also RLlib's PPO, one local runner of 16 worlds: its own vector of scalar ones, and
  the native environment.

All have 1024 steps between updates, batches of 512, 10 epochs and two layers of 128. Smaller
batches would make PPO slower and the ratios smaller.
"""

from __future__ import annotations

import side_by_side  # sets the number of threads

# isort: split

import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from rbl_gym.wrappers.sb3 import Sb3VecEnv

SIZES, RLLIB_SIZE = (8, 16, 64), 16
ROLLOUT, BATCH, EPOCHS, LEARNING_RATE = 1024, 512, 10, 1e-3
BELIEF = {"filter": "iekf", "observation": "flat"}


class Worlds(NamedTuple):
    """An environment by its id; with `belief`, `EstimatePose` around it."""

    env_id: str
    arguments: dict[str, Any]
    belief: bool = False

    def native(self, n: int, mode: str = "SameStep") -> VectorEnv[Any, Any, Any]:
        envs = gym.make_vec(self.env_id, num_envs=n, autoreset_mode=mode, **self.arguments)
        return VectorEstimatePose(envs, **BELIEF) if self.belief else envs

    def native_next_step(self, n: int) -> VectorEnv[Any, Any, Any]:
        """As RLlib resets."""
        return self.native(n, "NextStep")

    def scalar(self) -> gym.Env[Any, Any]:
        env = gym.make(self.env_id, **self.arguments)
        return EstimatePose(env, **BELIEF) if self.belief else env

    def sync(self, n: int) -> VectorEnv[Any, Any, Any]:
        """As CleanRL makes them."""
        made = [lambda: RecordEpisodeStatistics(self.scalar())] * n
        return SyncVectorEnv(made, autoreset_mode=AutoresetMode.SAME_STEP)

    def make_vec_sync(self, n: int) -> VectorEnv[Any, Any, Any]:
        return gym.make_vec(
            self.env_id,
            num_envs=n,
            vectorization_mode="sync",
            vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
            wrappers=[lambda env: EstimatePose(env, **BELIEF)] if self.belief else [],
            **self.arguments,
        )

    def sb3(self, n: int) -> Any:
        """As stable-baselines3's pages make them."""
        wrapper = {"wrapper_class": EstimatePose, "wrapper_kwargs": BELIEF} if self.belief else {}
        return make_vec_env(self.env_id, n, env_kwargs=self.arguments, **wrapper)


TASKS = {
    "AnchorPlacement auv_buoys": Worlds("rbl_gym:RBL/AnchorPlacement-v0", {"scene": "auv_buoys"}),
    "MobileAnchors easy": Worlds("rbl_gym:RBL/MobileAnchors-v0", {"difficulty": "easy"}),
    "AnchorSelection": Worlds("rbl_gym:RBL/AnchorSelection-v0", {}),
    "Tracking, EstimatePose iekf": Worlds(
        "rbl_gym:RBL/Tracking-v0",
        {"scene": {"name": "drone_yard", "anchor_speed_m_s": 3.0}, "reward": "none"},
        belief=True,
    ),
}
Cost = tuple[float, float]


def main() -> None:
    options = side_by_side.arguments(__doc__, repeats=3, steps=8192, rllib=0)
    torch.set_num_threads(1)
    example = example_ppo()
    result: dict[str, dict[str, dict[str, float]]] = {}
    for task, worlds in TASKS.items():
        for n in SIZES:
            with_rllib = bool(options.rllib) and n == RLLIB_SIZE
            rows = measured(worlds, n, options.steps, options.repeats, example, with_rllib)
            result[f"{task}, {n}"] = rows
            for form, row in rows.items():
                print(
                    f"{task:<28} {n:>3} {form:<26} {row['seconds']:7.2f} s  "
                    f"{row['environment_share']:4.0%} of it the environment's  "
                    f"{row['ratio']:5.2f} x native",
                    flush=True,
                )
    side_by_side.write({"steps": options.steps, "trainings": result}, options.json)


def measured(
    worlds: Worlds, n: int, steps: int, repeats: int, example: ModuleType, with_rllib: bool
) -> dict[str, dict[str, float]]:
    """Seconds of every form, the share of the environment, and the ratio to the native form."""

    def job(learn: Callable[[Any, int], Cost], make: Callable[[int], Any]) -> Callable[[], Cost]:
        return lambda: learn(make(n), steps)

    def loop(envs: Any, steps: int) -> Cost:
        return train_example(example, envs, steps)

    learners = {
        "sb3": {
            "native": job(train_sb3, lambda n: Sb3VecEnv(worlds.native(n))),
            "make_vec_env": job(train_sb3, worlds.sb3),
        },
        "cleanrl": {
            "native": job(loop, worlds.native),
            "SyncVectorEnv": job(loop, worlds.sync),
            "make_vec sync": job(loop, worlds.make_vec_sync),
        },
    }
    if with_rllib:
        learners["rllib"] = {
            "native": lambda: train_rllib(worlds.native_next_step, "vector_entry_point", steps),
            "its own vector": lambda: train_rllib(lambda _: worlds.scalar(), "sync", steps),
        }
    rows = {}
    for learner, forms in learners.items():
        # The first run of each form compiles, and fills caches.
        costs: dict[str, list[Cost]] = {form: [] for form in forms}
        for repeat in range(repeats + 1):
            for form, run in forms.items():
                cost = run()
                if repeat:
                    costs[form].append(cost)
        native = np.array(costs["native"])[:, 0]
        for form, found in costs.items():
            seconds, environment = np.array(found).T
            rows[f"{learner}: {form}"] = {
                "seconds": float(np.median(seconds)),
                "environment_share": float(np.median(environment / seconds)),
                "ratio": float(np.median(seconds / native)),
            }
    return rows


class Clock:
    """Process time spent in a method of an object, which is replaced on it."""

    def __init__(self, held: Any, name: str) -> None:
        self.seconds = 0.0
        inner = getattr(held, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            begin = time.process_time()
            result = inner(*arguments, **options)
            self.seconds += time.process_time() - begin
            return result

        setattr(held, name, timed)


def train_sb3(envs: Any, steps: int) -> Cost:
    """Process time of a training by stable-baselines3's PPO, and what the steps took of it."""
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=ROLLOUT // envs.num_envs,
        batch_size=BATCH,
        n_epochs=EPOCHS,
        learning_rate=LEARNING_RATE,
        policy_kwargs={"net_arch": [128, 128]},
        seed=0,
        device="cpu",
    )
    clock = Clock(envs, "step_wait")
    begin = time.process_time()
    model.learn(steps)
    return time.process_time() - begin, clock.seconds


def train_rllib(make: Callable[[int], Any], mode: str, steps: int) -> Cost:
    """The same of RLlib's PPO with one local runner."""
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.tune.registry import register_env

    register_env("worlds", lambda config: make(config.get("num_envs", 1)))
    config = (
        PPOConfig()
        .environment("worlds")
        .env_runners(
            num_env_runners=0, num_envs_per_env_runner=RLLIB_SIZE, gym_env_vectorize_mode=mode
        )
        .training(
            lr=LEARNING_RATE,
            train_batch_size_per_learner=ROLLOUT,
            minibatch_size=BATCH,
            num_epochs=EPOCHS,
        )
        .rl_module(model_config={"fcnet_hiddens": [128, 128], "fcnet_activation": "tanh"})
    )
    algorithm = config.build_algo()
    clock = Clock(algorithm.env_runner.env, "step")
    begin = time.process_time()
    for _ in range(steps // ROLLOUT):
        algorithm.train()
    cost = time.process_time() - begin, clock.seconds
    algorithm.stop()
    return cost


def example_ppo() -> ModuleType:
    """examples/ppo_single_file.py as a module."""
    path = Path(__file__).parents[1] / "examples" / "ppo_single_file.py"
    spec = importlib.util.spec_from_file_location("ppo_single_file", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def train_example(ppo: ModuleType, envs: VectorEnv[Any, Any, Any], steps: int) -> Cost:
    """The same of the loop of the example."""
    torch.manual_seed(0)
    agent = ppo.Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    clock = Clock(envs, "step")
    begin = time.process_time()
    observation = torch.as_tensor(envs.reset(seed=0)[0])
    for _ in range(steps // ROLLOUT):
        rollout, observation = ppo.collect(envs, agent, observation, [], ROLLOUT // envs.num_envs)
        ppo.update(agent, optimizer, rollout, ppo.advantages(agent, *rollout[3:], observation))
    return time.process_time() - begin, clock.seconds


if __name__ == "__main__":
    main()

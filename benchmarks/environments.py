"""Environment speed as ratios, side by side in one run.

Process time of one thread, medians over interleaved repeats (the environments of one world have
short rounds of their own, since the clock of a processor drifts):

- the native vector environment against the time of generating its normals alone;
- the vector environment against the scalar one, whole episodes with their resets on both sides,
  per epoch (an episode of T steps has T + 1, that of the reset among them);
- the scalar environment beside Gymnasium's CartPole, steps alone, no resets on either side;
- every environment of one world as `gym.make` makes it, with its resets, in steps of CartPole-v1
  with its resets (environments under `EstimatePose` with ``reward="none"``);
- vector environment + iterated EKF + belief observation + reward, in steps per CPU second;
- ``import rbl_gym`` against ``import gymnasium``.

    python benchmarks/environments.py [--json F] [--repeats 5] [--rounds 60] [--num-envs 1024]
"""

from __future__ import annotations

import side_by_side  # isort: skip

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.worlds import scenes
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose

SCENES = ("camsap2013", "auv_buoys", "uwb_room")


CART_POLE = "CartPole-v1, resets too"


def tracking(scene: str, **arguments: Any) -> gym.Env[Any, Any]:
    return gym.make("RBL/Tracking-v0", scene=scene, **arguments)


def estimated(scene: str, filter: str, **options: Any) -> gym.Env[Any, Any]:
    return EstimatePose(tracking(scene, reward="none"), filter, options)


ONE_WORLD: dict[str, Callable[[], gym.Env[Any, Any]]] = {
    CART_POLE: lambda: gym.make("CartPole-v1"),
    "Tracking, bound, auv_buoys": lambda: tracking("auv_buoys"),
    "Tracking, bound, uwb_room": lambda: tracking("uwb_room"),
    "EstimatePose, iekf, auv_buoys": lambda: estimated("auv_buoys", "iekf"),
    "EstimatePose, iekf, uwb_room": lambda: estimated("uwb_room", "iekf"),
    "EstimatePose, kf batched, auv_buoys": lambda: estimated("auv_buoys", "kf", engine="batched"),
    "EstimatePose, kf batched, uwb_room": lambda: estimated("uwb_room", "kf", engine="batched"),
    "EstimatePose, kf on filterpy, uwb_room": lambda: estimated("uwb_room", "kf"),
    "MobileAnchors": lambda: gym.make("RBL/MobileAnchors-v0"),
    "AnchorSelection": lambda: gym.make("RBL/AnchorSelection-v0"),
    "BaseStation": lambda: gym.make("RBL/BaseStation-v0"),
    "AnchorPlacement": lambda: gym.make("RBL/AnchorPlacement-v0"),
    "AnchorPlacement, racks": lambda: gym.make("RBL/AnchorPlacement-v0", scene="uwb_room", racks=2),
}


def main() -> None:
    options = side_by_side.arguments(__doc__, repeats=5, rounds=60, num_envs=1024)
    jobs: dict[str, Callable[[], float]] = {"CartPole-v1 steps": steps_job(cart_pole())}
    for scene in SCENES:
        jobs[f"{scene} normals alone"] = normals_job(scene, options.num_envs)
        for reward in ("none", "bound"):
            jobs[f"{scene} vector {reward}"] = vector_job(scene, reward, options.num_envs)
            jobs[f"{scene} scalar {reward}"] = scalar_job(scene, reward)
        jobs[f"{scene} scalar steps"] = steps_job(TrackingEnv(scene, "none"))
        jobs[f"{scene} vector iekf"] = belief_job(scene, options.num_envs)
    micro = medians({name: made_job(make()) for name, make in ONE_WORLD.items()}, options.rounds)
    micro |= medians(jobs, options.repeats)
    result: dict[str, Any] = {"microseconds_per_env_step": micro, "ratios": {}}
    for scene in SCENES:
        result["ratios"][scene] = {
            "vector to normals": micro[f"{scene} vector none"] / micro[f"{scene} normals alone"],
            "scalar to vector": micro[f"{scene} scalar none"] / micro[f"{scene} vector none"],
            "scalar to CartPole": micro[f"{scene} scalar steps"] / micro["CartPole-v1 steps"],
            "env + iekf steps per CPU second": 1e6 / micro[f"{scene} vector iekf"],
        }
    cart_poles = {name: micro[name] / micro[CART_POLE] for name in ONE_WORLD}
    result["in_steps_of_CartPole"] = cart_poles
    result["import_seconds"] = import_times(options.repeats)
    for name, value in micro.items():
        print(f"{name:<28} {value:9.2f} us per environment step")
    for scene, ratios in result["ratios"].items():
        print(scene, ", ".join(f"{name} {value:,.4g}" for name, value in ratios.items()))
    for name, ratio in cart_poles.items():
        print(f"{name:<44} {ratio:6.2f} steps of CartPole-v1")
    print("import", result["import_seconds"])
    side_by_side.write(result, options.json)


def medians(jobs: dict[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """Return the median microseconds of every job over interleaved rounds."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            times[name].append(job())
    return {name: 1e6 * float(np.median(values)) for name, values in times.items()}


def cart_pole() -> gym.Env[Any, Any]:
    return gym.make("CartPole-v1").unwrapped


def timed(work: Callable[[], None], steps: int) -> float:
    """Process time of `work` per step."""
    begin = time.process_time()
    work()
    return (time.process_time() - begin) / steps


def normals_job(scene: str, num_envs: int) -> Callable[[], float]:
    """The normals of a whole episode of every world, by one generator for each."""
    world = scenes.get(scene)
    size = 13 + 6 * world.steps + (world.steps + 1) * world.n_anchors * len(world.tags)
    rng = np.random.default_rng(0)
    block = np.empty((num_envs, size))

    def work() -> None:
        for row in block:
            rng.standard_normal(out=row)

    return lambda: timed(work, num_envs * (world.steps + 1))


def vector_job(scene: str, reward: str, num_envs: int) -> Callable[[], float]:
    """Whole episodes with their resets."""
    envs = TrackingVectorEnv(num_envs, scene, reward)
    return whole_episode(envs, envs.scene.steps + 1, num_envs)


def belief_job(scene: str, num_envs: int) -> Callable[[], float]:
    """The same with the iterated EKF (2 iterations), beliefs and rewards."""
    envs = TrackingVectorEnv(num_envs, scene, "none")
    wrapped = VectorEstimatePose(envs, "iekf", options={"iterations": 2})
    return whole_episode(wrapped, envs.scene.steps + 1, num_envs)


def whole_episode(envs: Any, steps: int, num_envs: int) -> Callable[[], float]:
    envs.reset(seed=0)
    actions = np.zeros(envs.action_space.shape, envs.action_space.dtype)

    def work() -> None:
        for _ in range(steps):
            envs.step(actions)

    return lambda: timed(work, steps * num_envs)


def zero_action(env: gym.Env[Any, Any]) -> Any:
    space = env.action_space
    return np.zeros(space.shape, space.dtype) if space.shape else 0


def scalar_job(scene: str, reward: str, epochs: int = 400) -> Callable[[], float]:
    """Whole episodes with their resets, of one world."""
    env = TrackingEnv(scene, reward)
    steps, action = env.scene.steps, zero_action(env)
    episodes = -(-epochs // (steps + 1))
    env.reset(seed=0)

    def work() -> None:
        for _ in range(episodes):
            env.reset()
            for _ in range(steps):
                env.step(action)

    return lambda: timed(work, episodes * (steps + 1))


def steps_job(env: gym.Env[Any, Any], steps: int = 400) -> Callable[[], float]:
    """Steps alone, resets left out."""
    action = zero_action(env)

    def job() -> float:
        total, done = 0.0, 0
        while done < steps:
            env.reset(seed=done)
            begin = time.process_time()
            for _ in range(min(20, steps - done)):
                _, _, terminated, truncated, _ = env.step(action)
                done += 1
                if terminated or truncated:
                    break
            total += time.process_time() - begin
        return total / done

    return job


def made_job(env: gym.Env[Any, Any], steps: int = 100) -> Callable[[], float]:
    """Steps of one world with their resets; in 100 of them most worlds reset equally often."""
    env.reset(seed=0)
    action = zero_action(env)

    def work() -> None:
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return lambda: timed(work, steps)


def import_times(repeats: int) -> dict[str, float]:
    """Median wall seconds of a fresh interpreter that imports a module, less an empty one."""

    def once(statement: str) -> float:
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", statement], check=True)
        return time.perf_counter() - begin

    empty = np.median([once("pass") for _ in range(repeats)])
    return {
        module: float(np.median([once(f"import {module}") for _ in range(repeats)]) - empty)
        for module in ("gymnasium", "rbl_gym")
    }


if __name__ == "__main__":
    main()

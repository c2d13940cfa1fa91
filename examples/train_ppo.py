"""Train a policy that places four buoys with PPO of stable-baselines3; compare it with layouts.

    python examples/train_ppo.py          (pip install 'rbl-gym[rl]')

`rbl-gym train auv_buoys` does the same with more steps. Measured: the program takes 23 s of
processor time, including the searches. The score b of the layouts:

==========================  =======
policy, 100,000 steps       0.109 m
random layouts              0.42 m
CMA-ES for each problem     0.105 m
==========================  =======
"""

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO

from rbl_gym import placement
from rbl_gym.placement import layouts, search
from rbl_gym.wrappers.sb3 import Sb3VecEnv

STEPS, HELD_OUT = 100_000, 64
ID = "rbl_gym:RBL/AnchorPlacement-v0"

torch.set_num_threads(1)  # small networks: more threads cost more than they give
envs = Sb3VecEnv(gym.make_vec(ID, num_envs=64, scene="auv_buoys", autoreset_mode="SameStep"))
model = PPO("MlpPolicy", envs, n_steps=16, batch_size=512, gamma=1.0, gae_lambda=1.0,
            learning_rate=lambda remaining: 1e-3 * remaining,
            policy_kwargs={"net_arch": [128, 128], "log_std_init": -1.5}, seed=0)  # fmt: skip
model.learn(STEPS)

# Problems that the training did not see: the policy places one anchor after the other.
problems = gym.make_vec(ID, num_envs=HELD_OUT, scene="auv_buoys", autoreset_mode="Disabled")
observation, info = problems.reset(seed=1_000_000_000)
done = np.zeros(HELD_OUT, dtype=bool)
while not done.all():
    action, _ = model.predict(observation, deterministic=True)
    observation, reward, done, _, info = problems.step(action)

task, contexts = problems.unwrapped.task, problems.unwrapped.contexts
rng = np.random.default_rng(0)
found = {
    "random": layouts.random(task, contexts, rng),
    "corners": layouts.corners(task, contexts, rng),
    "ring": layouts.ring(task, contexts, rng),
    "greedy": search.greedy(task, contexts, rng),
    f"PPO, {STEPS:,} steps": info["anchors"],
    "CMA-ES per problem": search.cma_es(task, contexts, rng),
}
for name, anchors in found.items():
    log_score = np.log(placement.score(task, contexts, anchors)).mean()
    print(f"{name:20s} accuracy (geometric mean) {np.exp(log_score):.4f} m")

"""Train a policy that places four buoys: PPO in one file, with torch only.

    python examples/ppo_single_file.py [--steps 300000] [--seed 0] [--out out/ppo.npz]

The program trains in 64 placement problems of the scene auv_buoys at once, with the native vector
environment and autoreset SAME_STEP. At the end it compares the policy with reference layouts on
held-out problems. The reference CMA-ES needs the extra rl or placement.

Measured: 299,008 steps with seed 0 take 46 s of processor time on one core. The table has the gain
in log b over random layouts, divided by the gain of CMA-ES for each problem. The program prints
scores relative to the best known layouts, which are better than those of CMA-ES.

====  =================  =====  ================
seed  held-out problems  gain   95 % interval
====  =================  =====  ================
0     64                 1.000  0.996 to 1.005
1     12                 0.997  0.983 to 1.016
====  =================  =====  ================
"""

import argparse
import itertools
import time

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

from rbl_gym.studies.learning import evaluation, policies
from rbl_gym.studies.learning.rl_tasks import rl_task

ENVS, ROLLOUT, EPOCHS, BATCH = 64, 16, 10, 512
LEARNING_RATE, GAMMA, LAMBDA = 1e-3, 1.0, 1.0
CLIP, VALUE_WEIGHT, MAX_GRADIENT = 0.2, 0.5, 0.5


def network(n_in: int, n_out: int, last_gain: float) -> nn.Sequential:
    sizes = [n_in, 128, 128, n_out]
    layers = [nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
    for layer, gain in zip(layers, (2**0.5, 2**0.5, last_gain), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


class Agent(nn.Module):
    def __init__(self, n_observation: int, n_action: int):
        super().__init__()
        self.mean = network(n_observation, n_action, 0.01)
        self.value = network(n_observation, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((n_action,), -0.5))

    def policy(self, observation: torch.Tensor) -> Normal:
        return Normal(self.mean(observation), self.log_std.exp())


def collect(envs, agent, observation, returns, rollout=ROLLOUT):
    """A rollout (T, B, ...) and the observation after it; `returns` gets those of the episodes."""
    steps = []
    for _ in range(rollout):
        with torch.no_grad():
            policy, value = agent.policy(observation), agent.value(observation)[:, 0]
            action = policy.sample()
            log_probability = policy.log_prob(action).sum(-1)
        new, reward, terminated, truncated, info = envs.step(action.clip(-1, 1).numpy())
        reward = torch.as_tensor(reward, dtype=torch.float32)
        done = torch.as_tensor(terminated | truncated)
        returns += reward[done].tolist()  # only the last anchor is paid
        if truncated.any():  # cut short: what was still to come is estimated
            last = torch.as_tensor(np.stack(info["final_obs"][truncated]))
            with torch.no_grad():
                reward[torch.as_tensor(truncated)] += GAMMA * agent.value(last)[:, 0]
        steps.append((observation, action, log_probability, value, reward, done))
        # SAME_STEP: where an episode ended, this is already the next one's first observation.
        observation = torch.as_tensor(new)
    return [torch.stack(part) for part in zip(*steps, strict=True)], observation


def advantages(agent, value, reward, done, observation):
    """Generalized advantage estimation."""
    with torch.no_grad():
        next_value = agent.value(observation)[:, 0]
    result, running = torch.zeros_like(reward), torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        alive = (~done[t]).float()
        delta = reward[t] + GAMMA * next_value * alive - value[t]
        running = delta + GAMMA * LAMBDA * alive * running
        result[t], next_value = running, value[t]
    return result


def update(agent, optimizer, rollout, advantage):
    """Ten passes over the rollout in shuffled batches."""
    rollout = [*rollout, advantage, advantage + rollout[3]]
    flat = [part.reshape(-1, *part.shape[2:]) for part in rollout]
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(flat[0])).split(BATCH):
            observation, action, old, _, _, _, advantage, target = (part[batch] for part in flat)
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            ratio = (agent.policy(observation).log_prob(action).sum(-1) - old).exp()
            gain = torch.min(ratio * advantage, ratio.clip(1 - CLIP, 1 + CLIP) * advantage)
            miss = (agent.value(observation)[:, 0] - target).square().mean()
            loss = VALUE_WEIGHT * miss - gain.mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), MAX_GRADIENT)
            optimizer.step()


def as_arrays(agent: Agent, seed: int) -> policies.Policy:
    """The mean network in numpy, as `rbl-gym evaluate auv_buoys --policy` reads it."""
    layers = [layer for layer in agent.mean if isinstance(layer, nn.Linear)]
    weights = tuple(layer.weight.detach().double().numpy() for layer in layers)
    biases = tuple(layer.bias.detach().double().numpy() for layer in layers)
    return policies.Policy(weights, biases, "box", {"task": "auv_buoys", "seed": seed})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=64, help="held-out problems")
    parser.add_argument("--out", default="out/ppo_single_file.npz")
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)
    envs = gym.make_vec(
        "rbl_gym:RBL/AnchorPlacement-v0",
        num_envs=ENVS,
        scene="auv_buoys",
        autoreset_mode="SameStep",
    )
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    observation = torch.as_tensor(envs.reset(seed=options.seed * 1_000_000)[0])
    n_updates, begin, returns = max(1, options.steps // (ROLLOUT * ENVS)), time.process_time(), []
    for k in range(n_updates):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1 - k / n_updates)
        rollout, observation = collect(envs, agent, observation, returns)
        update(agent, optimizer, rollout, advantages(agent, *rollout[3:], observation))
        if (k + 1) % 50 == 0 or k + 1 == n_updates:
            print(
                f"{(k + 1) * ROLLOUT * ENVS:>8,} steps  mean return {np.mean(returns):.4f}  "
                f"{time.process_time() - begin:.0f} s of processor time",
                flush=True,
            )
            returns.clear()
    policy = as_arrays(agent, options.seed)
    policies.save(policy, options.out)
    result = evaluation.evaluate(
        rl_task("auv_buoys"), {"ppo": policy}, ["corners", "ring"], options.worlds, 0
    )
    for name, row in sorted(result["methods"].items(), key=lambda item: item[1]["loss"]):
        print(
            f"{name:12s} score {row['score_m']:.4f} m  normalised {row['normalised']:.3f} "
            f"({row['normalised_low']:.3f} to {row['normalised_high']:.3f})"
        )


if __name__ == "__main__":
    main()

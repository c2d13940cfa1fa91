"""EstimateNetwork: the cycle consensus on the bearings of a network environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from rbl_gym.checks import BoolArray, FloatArray, check_one_of
from rbl_gym.envs.network import PRIOR_STD_RAD, PlanarNetworkEnv, PlanarNetworkVectorEnv
from rbl_gym.estimators.networks.consensus import cycle_iteration
from rbl_gym.estimators.networks.orientations import along_tree
from rbl_gym.networks.bounds import linked_covariance
from rbl_gym.networks.graphs import components
from rbl_gym.networks.sensing import edge_angles, proj
from rbl_gym.rendering import tell
from rbl_gym.rendering.network import Headings

REWARDS = ("belief", "error")
_TOL = 1e-9
_MAX_STEPS = 5000


class EstimateNetwork(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Turns bearings into orientations by the cycle consensus, and their accuracy into reward.

    Wraps `RBL/PlanarNetwork-v0`; its own reward is replaced. For vector environments:
    `VectorEstimateNetwork`. Each epoch is estimated from its own bearings; the last estimate
    says which multiple of 2 pi a cycle sums to, so that long cycles do not slip.

    Parameters
    ----------
    env
        The environment.
    reward
        ``"belief"``: ``-log`` of the root mean square standard deviation of the orientations, as
        the bearings' noise promises, radians. ``"error"``: minus the real root mean square error.

    Observation
    -----------
    The environment's, with `orientations` (n,) relative to node 0, radians in [-pi, pi], and
    `orientation_std` (n,). A node that has no path to node 0 keeps its last estimate (0 before
    the first) and the standard deviation of its prior.

    Info
    ----
    `orientation_error_rad` (root mean square over all nodes but node 0), `belief_rad` and
    `consensus_steps`, beside what the environment says.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from rbl_gym.wrappers import EstimateNetwork
    >>> env = EstimateNetwork(gym.make("rbl_gym:RBL/PlanarNetwork-v0"))
    >>> observation, info = env.reset(seed=1)
    >>> info["orientation_error_rad"] < 0.2
    True
    """

    def __init__(self, env: gym.Env[Any, Any], reward: str = "belief") -> None:
        RecordConstructorArgs.__init__(self, reward=reward)
        gym.Wrapper.__init__(self, env)
        if not isinstance(env.unwrapped, PlanarNetworkEnv):
            raise ValueError(f"env must be RBL/PlanarNetwork-v0, got {env.unwrapped}")
        self._reward = check_one_of("reward", reward, REWARDS)
        self._sigma = env.unwrapped.bearing_std_rad
        self._theta: FloatArray | None = None
        self.observation_space = _space(env.observation_space)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start without an estimate and give it the first epoch."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._theta = None
        return self._estimate(observation, info), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the environment, estimate, reward."""
        observation, _, terminated, truncated, info = self.env.step(action)
        observation = self._estimate(observation, info)
        return observation, float(_rewarded(self._reward, info)), terminated, truncated, info

    def _estimate(self, observation: dict[str, np.ndarray], info: dict[str, Any]) -> Any:
        links = observation["links"].astype(np.bool_)
        self._theta, steps = consensus(links, observation["bearings"], self._theta)
        figures, std = _judge(links, self._sigma, self._theta, info["orientations"])
        info.update({name: float(value) for name, value in figures.items()})
        info["consensus_steps"] = steps
        tell(self.env, Headings(self._theta, std), single=True)
        return {**observation, "orientations": self._theta.copy(), "orientation_std": std}


class VectorEstimateNetwork(VectorWrapper, RecordConstructorArgs):
    """`EstimateNetwork` for the vector environment, in every autoreset mode.

    Parameters, observations, rewards and infos are those of `EstimateNetwork`, stacked.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from rbl_gym.wrappers import VectorEstimateNetwork
    >>> envs = VectorEstimateNetwork(gym.make_vec("rbl_gym:RBL/PlanarNetwork-v0", num_envs=4))
    >>> observation, info = envs.reset(seed=1)
    >>> observation["orientations"].shape
    (4, 12)
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], reward: str = "belief") -> None:
        RecordConstructorArgs.__init__(self, reward=reward)
        VectorWrapper.__init__(self, env)
        if not isinstance(env.unwrapped, PlanarNetworkVectorEnv):
            raise ValueError(f"env must be RBL/PlanarNetwork-v0, got {env.unwrapped}")
        self._reward = check_one_of("reward", reward, REWARDS)
        self._sigma = env.unwrapped.bearing_std_rad
        self._theta: list[FloatArray | None] = [None] * env.num_envs
        self._over = np.zeros(env.num_envs, dtype=np.bool_)
        self.single_observation_space = _space(env.single_observation_space)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Start the worlds that reset without an estimate."""
        observation, info = self.env.reset(seed=seed, options=options)
        fresh = np.ones(self.num_envs, dtype=np.bool_)
        if options is not None and "reset_mask" in options:
            fresh = np.asarray(options["reset_mask"])
        self._over = self._over & ~fresh
        return self._estimate(observation, info, fresh), info

    def step(self, actions: Any) -> tuple[Any, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Step the worlds, estimate, reward; worlds that begin anew forget their estimate."""
        observation, _, terminated, truncated, info = self.env.step(actions)
        ended, same_step = terminated | truncated, \
            self.env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP  # fmt: skip
        reward = np.zeros(self.num_envs)
        if same_step and ended.any():
            reward[ended] = self._end(info, ended)
        fresh = ended if same_step else self._over
        observation = self._estimate(observation, info, fresh)
        reward[~fresh] = _rewarded(self._reward, info)[~fresh]
        self._over = ended & (not same_step)
        return observation, reward, terminated, truncated, info

    def _end(self, info: dict[str, Any], ended: BoolArray) -> FloatArray:
        """Estimate the last epoch of the worlds that ended; their rewards."""
        final, last = info["final_obs"], info["final_info"]
        for world in np.flatnonzero(ended):
            links = final[world]["links"].astype(np.bool_)
            theta, steps = consensus(links, final[world]["bearings"], self._theta[world])
            figures, std = _judge(links, self._sigma, theta, last["orientations"][world])
            final[world] = {**final[world], "orientations": theta, "orientation_std": std}
            for name, value in {**figures, "consensus_steps": steps}.items():
                column = last.setdefault(name, np.zeros(self.num_envs, np.asarray(value).dtype))
                column[world] = value
                last[f"_{name}"] = ended.copy()
        return _rewarded(self._reward, last)[ended]

    def _estimate(
        self, observation: dict[str, np.ndarray], info: dict[str, Any], fresh: BoolArray
    ) -> dict[str, np.ndarray]:
        links = observation["links"].astype(np.bool_)
        steps = np.zeros(self.num_envs, dtype=np.int64)
        for world in range(self.num_envs):
            before = None if fresh[world] else self._theta[world]
            found = consensus(links[world], observation["bearings"][world], before)
            self._theta[world], steps[world] = found
        theta = np.array(self._theta)
        figures, std = _judge(links, self._sigma, theta, info["orientations"])
        tell(self.env, Headings(theta, std))
        for name, value in {**figures, "consensus_steps": steps}.items():
            info[name], info[f"_{name}"] = value, np.ones(self.num_envs, dtype=np.bool_)
        return {**observation, "orientations": theta, "orientation_std": std}


def consensus(
    links: BoolArray, bearings: FloatArray, before: FloatArray | None = None
) -> tuple[FloatArray, int]:
    """Orientations (n,) of one network by the cycle iteration, and how many steps it took.

    Parameters
    ----------
    links, bearings
        (n, n) symmetric; (n, n) of j in the frame of i, radians.
    before
        Orientations (n,) that are near: edge angles are then taken within pi of theirs, and
        cycles sum to what they should.
    """
    n_nodes = len(links)
    theta = np.zeros(n_nodes) if before is None else before.copy()
    edges = np.argwhere(np.triu(links))
    label = components(edges, n_nodes)
    near = label == label[0]
    if near.sum() < 2:
        return theta, 0
    edges = edges[near[edges[:, 0]]]
    i, j = edges.T
    y = edge_angles(np.column_stack([bearings[i, j], bearings[j, i]]))
    if before is not None:
        # Around any cycle the expected angles sum to 0, and so must those that are near them.
        expected = before[j] - before[i]
        y = expected + proj(y - expected)
    named = (np.cumsum(near) - 1)[edges]
    size = int(near.sum())
    branch = None if before is None else np.zeros(len(edges) - size + 1)
    run = cycle_iteration(named, y, size, tol=_TOL, max_steps=_MAX_STEPS, branch=branch)
    theta[near] = proj(along_tree(named, run.psi, size))
    return theta, run.steps


def _judge(
    links: BoolArray, sigma: float, theta: FloatArray, truth: FloatArray
) -> tuple[dict[str, FloatArray], FloatArray]:
    """Figures (...) of estimates (..., n), and the standard deviations (..., n)."""
    covariance = linked_covariance(links, sigma, PRIOR_STD_RAD)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    error = proj(theta - truth)[..., 1:]
    figures = {
        "orientation_error_rad": np.sqrt(np.mean(error**2, axis=-1)),
        "belief_rad": np.sqrt(variance.mean(axis=-1)),
    }
    known = np.zeros((*variance.shape[:-1], 1))
    return figures, np.sqrt(np.concatenate([known, variance], axis=-1))


def _rewarded(reward: str, info: dict[str, Any]) -> Any:
    if reward == "belief":
        # Zeros stand where a world has no last epoch.
        return -np.log(np.maximum(info["belief_rad"], 1e-300))
    return -np.asarray(info["orientation_error_rad"])


def _space(inner: spaces.Space[Any]) -> spaces.Dict:
    assert isinstance(inner, spaces.Dict)
    size = inner["bearings"].shape[:1]  # pyright: ignore[reportOptionalSubscript]
    return spaces.Dict(
        {
            **inner.spaces,
            "orientations": spaces.Box(-np.pi, np.pi, size, np.float64),
            "orientation_std": spaces.Box(0.0, 2 * PRIOR_STD_RAD, size, np.float64),
        }
    )

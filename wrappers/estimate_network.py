"""EstimateNetwork: estimate the poses of a network by cycle consensus."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs, seeding
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from rbl_gym.checks import BoolArray, FloatArray, check_one_of
from rbl_gym.envs.batch import seeds_of
from rbl_gym.envs.network import PlanarNetworkEnv, PlanarNetworkVectorEnv
from rbl_gym.estimators.networks.beliefs import (
    Consensus,
    NetworkBelief,
    check_consensus,
    consensus,
    network_belief,
)
from rbl_gym.networks.bounds import Sensing
from rbl_gym.networks.sensing import proj
from rbl_gym.rendering import tell
from rbl_gym.rendering.network import Headings
from rbl_gym.wrappers.forms import check_single, check_vector

REWARDS = ("belief", "error")
# Separates the wrapper's random numbers from those of the environment with the same seed.
_STREAM = 1


class EstimateNetwork(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Estimate orientations from bearings, and poses if lengths are observed; compute rewards.

    Wraps `RBL/PlanarNetwork-v0` and replaces its reward. For vector environments use
    `VectorEstimateNetwork`. Each epoch is estimated from its own measurements. The cycle iteration,
    equation (14) of the network paper (N in docs/glossary.md), corrects the edge angles so that
    those of each cycle sum to a multiple of 2 pi. Noise can change this multiple in long cycles, so
    the estimate of the previous epoch selects it. Sums of the edge angles along a tree are the
    orientations. If lengths are observed, maximum likelihood starts from these orientations and
    estimates orientations and positions.

    Parameters
    ----------
    env
        The environment.
    reward
        ``"error"``: minus the actual root mean square error. ``"belief"``: ``-log`` of the error
        that the belief expects. Errors are those of the orientations in radians. If lengths are
        observed, they are those of the poses in metres: the error of a point 1 m away from its
        node.
    cycles, kappa, order
        As in `estimators.cycle_iteration`: the cycles by name, the step or its rule, and
        ``"synchronous"`` or ``"asynchronous"``. If the step is too large for the cycles of an
        epoch, this epoch raises an error.
    steps
        Maximum number of iterations in an epoch. If it is too small, residuals are larger than the
        noise, and the belief is wider.

    Observation
    -----------
    The environment's observation, with `orientations` (n,) relative to node 0, radians in [-pi,
    pi], and `orientation_std` (n,). If lengths are observed, also `positions` (n, 2) in the frame
    of node 0, metres, and `pose_covariance` (n, 3, 3) of each node's orientation, x and y.

    All variances are scaled by max(1, chi-square per degree of freedom of the residuals), and
    limited to those of the prior. A node without a path to node 0 keeps its last estimate (0 before
    the first) and has the standard deviations of its prior.

    Info
    ----
    In addition to the environment's info:

    * `orientation_error_rad`: root mean square error over all nodes except node 0; `belief_rad`:
      its prediction by the belief.
    * `chi_square`: per degree of freedom; 0 without degrees of freedom.
    * `consensus_steps`, `consensus_converged`: of the cycle iteration.
    * With lengths `position_error_m`, `pose_error_m` and `belief_m`, the prediction of the pose
      error by the belief.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from rbl_gym.wrappers import EstimateNetwork
    >>> env = EstimateNetwork(gym.make("rbl_gym:RBL/PlanarNetwork-v0", lengths="all"))
    >>> observation, info = env.reset(seed=1)
    >>> info["orientation_error_rad"] < 0.2
    True
    >>> observation["positions"].shape, observation["pose_covariance"].shape
    ((12, 2), (12, 3, 3))
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        reward: str = "error",
        cycles: str = "bfs",
        kappa: float | str | None = None,
        order: str = "synchronous",
        steps: int = 5000,
    ) -> None:
        RecordConstructorArgs.__init__(
            self, reward=reward, cycles=cycles, kappa=kappa, order=order, steps=steps
        )
        check_single(env, "VectorEstimateNetwork")
        gym.Wrapper.__init__(self, env)
        if not isinstance(env.unwrapped, PlanarNetworkEnv):
            raise ValueError(f"env must be RBL/PlanarNetwork-v0, got {env.unwrapped}")
        self._reward = check_one_of("reward", reward, REWARDS)
        self._options = check_consensus(cycles, kappa, order, steps)
        self._sensing = env.unwrapped.sensing
        self._rng = seeding.np_random()[0]
        self._theta: FloatArray | None = None
        self._places: FloatArray = np.zeros((env.unwrapped.n_nodes, 2))
        self.observation_space = _space(env.observation_space, self._sensing)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start without an estimate and estimate the first epoch."""
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = _generator(seed)
        self._theta, self._places = None, np.zeros_like(self._places)
        return self._estimate(observation, info), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the environment, estimate, reward."""
        observation, _, terminated, truncated, info = self.env.step(action)
        observation = self._estimate(observation, info)
        return observation, float(_rewarded(self._reward, info)), terminated, truncated, info

    def _estimate(self, observation: dict[str, np.ndarray], info: dict[str, Any]) -> Any:
        run = _run(observation, self._theta, self._options, self._rng)
        found = _believe(observation, run[0], self._places, self._sensing)
        self._theta = found.orientations
        self._places = self._places if found.positions is None else found.positions
        for name, value in {**_judge(found, info), **_progress(run)}.items():
            info[name] = np.asarray(value).item()
        tell(self.env, _shown(found), single=True)
        return {**observation, **_observed(found)}


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

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        reward: str = "error",
        cycles: str = "bfs",
        kappa: float | str | None = None,
        order: str = "synchronous",
        steps: int = 5000,
    ) -> None:
        RecordConstructorArgs.__init__(
            self, reward=reward, cycles=cycles, kappa=kappa, order=order, steps=steps
        )
        check_vector(env, "EstimateNetwork")
        VectorWrapper.__init__(self, env)
        if not isinstance(env.unwrapped, PlanarNetworkVectorEnv):
            raise ValueError(f"env must be RBL/PlanarNetwork-v0, got {env.unwrapped}")
        self._reward = check_one_of("reward", reward, REWARDS)
        self._options = check_consensus(cycles, kappa, order, steps)
        self._sensing = env.unwrapped.sensing
        self._rngs = [seeding.np_random()[0] for _ in range(env.num_envs)]
        shape = (env.num_envs, env.unwrapped.n_nodes)
        self._theta: FloatArray = np.zeros(shape)
        self._places: FloatArray = np.zeros((*shape, 2))
        self._over = np.zeros(env.num_envs, dtype=np.bool_)
        self.single_observation_space = _space(env.single_observation_space, self._sensing)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Start the worlds that reset without an estimate."""
        observation, info = self.env.reset(seed=seed, options=options)
        fresh = np.ones(self.num_envs, dtype=np.bool_)
        if options is not None and "reset_mask" in options:
            fresh = np.asarray(options["reset_mask"])
        for world, one in enumerate(seeds_of(seed, self.num_envs)):
            if fresh[world] and one is not None:
                self._rngs[world] = _generator(one)
        self._over = self._over & ~fresh
        return self._estimate(observation, info, fresh), info

    def step(self, actions: Any) -> tuple[Any, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Step the worlds, estimate, reward; worlds that restart discard their estimate."""
        observation, _, terminated, truncated, info = self.env.step(actions)
        ended, same_step = (
            terminated | truncated,
            self.env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP,
        )
        reward = np.zeros(self.num_envs)
        if same_step and ended.any():
            reward[ended] = self._end(info, ended)
        fresh = ended if same_step else self._over
        observation = self._estimate(observation, info, fresh)
        reward[~fresh] = _rewarded(self._reward, info)[~fresh]
        self._over = ended & (not same_step)
        return observation, reward, terminated, truncated, info

    def _end(self, info: dict[str, Any], ended: BoolArray) -> FloatArray:
        """Estimate the last epoch of the worlds that ended; return their rewards."""
        final, last = info["final_obs"], info["final_info"]
        for world in np.flatnonzero(ended):
            run = _run(final[world], self._theta[world], self._options, self._rngs[world])
            found = _believe(final[world], run[0], self._places[world], self._sensing)
            truth = {name: last[name][world] for name in ("orientations", "positions")}
            final[world] = {**final[world], **_observed(found)}
            for name, value in {**_judge(found, truth), **_progress(run)}.items():
                column = last.setdefault(name, np.zeros(self.num_envs, np.asarray(value).dtype))
                column[world] = value
                last[f"_{name}"] = ended.copy()
        return _rewarded(self._reward, last)[ended]

    def _estimate(
        self, observation: dict[str, np.ndarray], info: dict[str, Any], fresh: BoolArray
    ) -> dict[str, np.ndarray]:
        runs = []
        for world in range(self.num_envs):
            one = {name: value[world] for name, value in observation.items()}
            before = None if fresh[world] else self._theta[world]
            runs.append(_run(one, before, self._options, self._rngs[world]))
        theta, steps, converged = (np.array(part) for part in zip(*runs, strict=True))
        self._places = np.where(fresh[:, None, None], 0.0, self._places)
        found = _believe(observation, theta, self._places, self._sensing)
        self._theta = found.orientations
        self._places = self._places if found.positions is None else found.positions
        tell(self.env, _shown(found))
        for name, value in {**_judge(found, info), **_progress((theta, steps, converged))}.items():
            info[name], info[f"_{name}"] = value, np.ones(self.num_envs, dtype=np.bool_)
        return {**observation, **_observed(found)}


def _generator(seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, _STREAM])


def _run(
    observation: dict[str, np.ndarray],
    before: FloatArray | None,
    options: Consensus,
    rng: np.random.Generator,
) -> tuple[FloatArray, int, bool]:
    links = observation["links"].astype(np.bool_)
    return consensus(links, observation["bearings"], before, options, rng)


def _progress(run: tuple[Any, Any, Any]) -> dict[str, Any]:
    return {"consensus_steps": run[1], "consensus_converged": run[2]}


def _believe(
    observation: dict[str, np.ndarray], theta: FloatArray, places: FloatArray, sensing: Sensing
) -> NetworkBelief:
    links, lengths = observation["links"].astype(np.bool_), observation.get("lengths")
    found = network_belief(links, observation["bearings"], lengths, theta, places, sensing)
    if found.positions is None:
        return found
    limit = _farthest(sensing)
    return found._replace(positions=np.clip(found.positions, -limit, limit))


def _observed(found: NetworkBelief) -> dict[str, FloatArray]:
    observed = {
        "orientations": found.orientations.copy(),
        "orientation_std": np.sqrt(found.covariance[..., 0, 0]),
    }
    if found.positions is not None:
        observed["positions"] = found.positions.copy()
        observed["pose_covariance"] = found.covariance.copy()
    return observed


def _shown(found: NetworkBelief) -> Headings:
    std = np.sqrt(found.covariance[..., 0, 0])
    spread = None if found.positions is None else found.covariance[..., 1:, 1:]
    return Headings(found.orientations, std, found.positions, spread)


def _judge(found: NetworkBelief, truth: dict[str, Any]) -> dict[str, FloatArray]:
    """Return errors (...) of estimates and beliefs over all nodes except node 0."""
    error = proj(found.orientations - truth["orientations"])[..., 1:] ** 2
    variance = np.diagonal(found.covariance[..., 1:, :, :], axis1=-2, axis2=-1)
    figures = {
        "orientation_error_rad": np.sqrt(error.mean(axis=-1)),
        "belief_rad": np.sqrt(variance[..., 0].mean(axis=-1)),
        "chi_square": found.chi_square,
    }
    if found.positions is not None:
        places = truth["positions"] - truth["positions"][..., :1, :]
        away = ((found.positions - places)[..., 1:, :] ** 2).sum(axis=-1)
        figures["position_error_m"] = np.sqrt(away.mean(axis=-1))
        # Error of a point 1 m away from its node: a rotation error in radians moves it by as many
        # metres.
        figures["pose_error_m"] = np.sqrt((away + error).mean(axis=-1))
        figures["belief_m"] = np.sqrt(variance.sum(axis=-1).mean(axis=-1))
    return figures


def _rewarded(reward: str, info: dict[str, Any]) -> Any:
    of_poses = "pose_error_m" in info
    if reward == "belief":
        # Worlds without a last epoch have zeros.
        return -np.log(np.maximum(info["belief_m" if of_poses else "belief_rad"], 1e-300))
    return -np.asarray(info["pose_error_m" if of_poses else "orientation_error_rad"])


def _farthest(sensing: Sensing) -> float:
    """Return a limit for the coordinates of estimates, twice the square's side."""
    return 2 * math.sqrt(6) * sensing.prior_std_m


def _space(inner: spaces.Space[Any], sensing: Sensing) -> spaces.Dict:
    assert isinstance(inner, spaces.Dict)
    size = inner["bearings"].shape[:1]  # pyrefly: ignore[unsupported-operation]
    added: dict[str, spaces.Space[Any]] = {
        "orientations": spaces.Box(-np.pi, np.pi, size, np.float64),
        "orientation_std": spaces.Box(0.0, 2 * sensing.prior_std_rad, size, np.float64),
    }
    if "lengths" in inner.spaces:
        limit, most = _farthest(sensing), max(sensing.prior_std_rad, sensing.prior_std_m) ** 2
        added["positions"] = spaces.Box(-limit, limit, (*size, 2), np.float64)
        added["pose_covariance"] = spaces.Box(-2 * most, 2 * most, (*size, 3, 3), np.float64)
    return spaces.Dict({**inner.spaces, **added})

"""RBL/PlanarNetwork-v0: nodes measure each other's bearings and move to estimate orientations."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym.checks import BoolArray, FloatArray, check_count, check_one_of
from rbl_gym.envs.batch import BatchEnv
from rbl_gym.envs.network_plans import (
    COLUMNS,
    PRIOR_STD_RAD,
    NetworkFamily,
    NetworkPlan,
    network_family,
    numbers_of,
    sensing_of,
)
from rbl_gym.envs.scalar import ScalarEnv
from rbl_gym.networks.bounds import Sensing, linked_covariance, linked_pose_covariance
from rbl_gym.networks.graphs import components
from rbl_gym.networks.sensing import proj
from rbl_gym.rendering import network as rendering

REWARDS = ("bound", "none")
_REWARD_ADVICE = (
    "the wrapper EstimateNetwork(env, reward=...), or VectorEstimateNetwork, has the rewards "
    "'belief' and 'error' (docs/environments/wrappers.md); for a reward of your own write a "
    "gymnasium.Wrapper"
)
LENGTHS = ("none", "one", "all")
# Standard deviation of the known length, as a fraction of the square's side: small enough to be
# practically exact, and large enough for iterations to converge.
_KNOWN = 1e-4
# Number of layouts tried to find one that is connected at the start.
_TRIES = 64


class PlanarNetworkVectorEnv(BatchEnv):
    """`num_envs` independent `PlanarNetworkEnv` networks of equal n in arrays.

    Created by ``gym.make_vec("rbl_gym:RBL/PlanarNetwork-v0", num_envs=64)``. The arguments are
    those of `PlanarNetworkEnv`. Seeding and autoreset work as in `BatchEnv`.
    """

    render_fps = 10

    def __init__(
        self,
        num_envs: int = 1,
        n_nodes: int = 12,
        side_m: float = 10.0,
        radius_m: float = 4.0,
        blind_m: float = 0.5,
        bearing_std_rad: float = 0.05,
        lengths: str = "none",
        length_std_m: float = 0.1,
        step_m: float = 0.5,
        reward: str = "bound",
        steps: int = 50,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        scenes: Any = None,
    ) -> None:
        steps = check_count("steps", steps)
        self.lengths = check_one_of("lengths", lengths, LENGTHS)
        plan = NetworkPlan(
            n_nodes, side_m, radius_m, blind_m, bearing_std_rad, length_std_m, step_m
        )
        self.family = None if scenes is None else network_family(scenes, plan)
        # Largest values of all networks.
        most = self._plan = self._known(plan if self.family is None else self.family.highest)
        self.n_nodes = most.n_nodes
        self._rewarded = check_one_of("reward", reward, REWARDS, _REWARD_ADVICE) == "bound"
        square = (self.n_nodes, self.n_nodes)
        observed: dict[str, spaces.Space[Any]] = {
            "bearings": spaces.Box(-math.pi, math.pi, square, np.float64),
            "links": spaces.Box(0, 1, square, np.int8),
        }
        if lengths != "none":
            observed["lengths"] = spaces.Box(0.0, most.longest_m, square, np.float64)
        if self.family is not None:
            observed["node_mask"] = spaces.MultiBinary(self.n_nodes)
            observed["network"] = spaces.Box(0.0, np.array(numbers_of(most)), dtype=np.float64)
        self.single_observation_space = spaces.Dict(observed)
        self.single_action_space = spaces.Box(-1.0, 1.0, (2 * self.n_nodes,), np.float32)
        self.film = rendering.film_of(render_mode, most.side_m, self.n_nodes, steps)
        self._configure(num_envs, render_mode, steps, max_episode_steps, autoreset_mode)
        self._plans = [most] * num_envs
        self._there = np.ones((num_envs, self.n_nodes), dtype=np.bool_)
        # Numbers of the networks, in the order of `NetworkPlan` without the number of nodes.
        self._numbers = np.tile(numbers_of(most), (num_envs, 1))
        self._positions = np.zeros((num_envs, self.n_nodes, 2))
        self._orientations = np.zeros((num_envs, self.n_nodes))
        self._links = np.zeros((num_envs, *square), dtype=np.bool_)
        self._bearings = np.zeros((num_envs, *square))
        self._lengths = np.zeros((num_envs, *square))
        self._std = np.zeros((num_envs, self.n_nodes))
        self._score_rad = np.zeros(num_envs)
        self._score_m = np.zeros(num_envs)

    @property
    def sensing(self) -> Sensing:
        """What an estimator may know besides the observation; only without `scenes`."""
        if self.family is not None:
            raise ValueError("scenes must be left out: EstimateNetwork needs a single network")
        return self._plan.sensing

    @property
    def bearing_std_rad(self) -> float:
        """Standard deviation of a bearing; the largest of a family."""
        return self._plan.bearing_std_rad

    def _known(self, plan: NetworkPlan) -> NetworkPlan:
        """Return a plan with the standard deviation of the known length, if it is known."""
        if self.lengths != "one":
            return plan
        return dataclasses.replace(plan, length_std_m=_KNOWN * plan.side_m)

    def _restart(
        self, chosen: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, np.ndarray] | None:
        told = np.empty(len(chosen), dtype=object)
        for index, (world, generator) in enumerate(zip(chosen, generators, strict=True)):
            if self.family is not None:
                plan, fields = self.family.draw(generator)
                self._begin_plan(world, self._known(plan))
                told[index] = json.dumps(fields)
            plan = self._plans[world]
            self._positions[world, : plan.n_nodes] = _layout(plan, generator)
            theta = generator.uniform(-np.pi, np.pi, plan.n_nodes)
            self._orientations[world, : plan.n_nodes] = proj(theta - theta[0])
        self._measure(chosen, generators)
        return None if self.family is None else {"scene": told}

    def _begin_plan(self, world: int, plan: NetworkPlan) -> None:
        self._plans[world], self._numbers[world] = plan, numbers_of(plan)
        self._there[world] = np.arange(self.n_nodes) < plan.n_nodes
        for field in (self._positions, self._orientations, self._std):
            field[world] = 0.0

    def _column(self, name: str, rows: np.ndarray) -> FloatArray:
        """Return a number of some worlds as (R, 1, 1)."""
        return self._numbers[rows, COLUMNS.index(name), None, None]

    def _normals(self, rows: np.ndarray, generators: Sequence[np.random.Generator]) -> FloatArray:
        """Return standard normal variates (R, n, n) for the pairs of nodes of some worlds."""
        normals = np.zeros((len(rows), self.n_nodes, self.n_nodes))
        for index, (row, generator) in enumerate(zip(rows, generators, strict=True)):
            n = self._plans[row].n_nodes
            normals[index, :n, :n] = generator.standard_normal((n, n))
        return normals

    def _measure(self, rows: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        """Measure links, bearings and the bound of some worlds."""
        there, std = self._there[rows], self._column("bearing_std_rad", rows)
        links, apart = _links_of(
            self._positions[rows], self._column("radius_m", rows), self._column("blind_m", rows)
        )
        links &= there[:, None] & there[..., None]
        toward = np.arctan2(apart[..., 1], apart[..., 0])
        normals = self._normals(rows, generators)
        seen = toward - self._orientations[rows][..., None] + std * normals
        self._links[rows] = links
        self._bearings[rows] = np.where(links, proj(seen), 0.0)
        # Missing nodes have no links: they keep their prior and change no other node's bound.
        others = there[:, 1:]
        count = others.sum(axis=-1)
        if self.lengths == "none":
            covariance = linked_covariance(links, std, PRIOR_STD_RAD)
        else:
            distance = np.linalg.norm(apart, axis=-1)
            self._lengths[rows] = lengths = self._measured(rows, links, distance, generators)
            covariance = linked_pose_covariance(
                self._positions[rows],
                links,
                lengths > 0,
                sensing_of([self._plans[i] for i in rows]),
            )
            each = np.diagonal(covariance, axis1=-2, axis2=-1)
            trace = (each * np.concatenate([others, np.repeat(others, 2, axis=1)], axis=1)).sum(-1)
            self._score_m[rows] = np.sqrt(trace / count)
        variance = np.diagonal(covariance, axis1=-2, axis2=-1)[..., : self.n_nodes - 1] * others
        self._std[rows, 1:] = np.sqrt(variance)
        self._score_rad[rows] = np.sqrt(variance.sum(axis=-1) / count)

    def _measured(
        self,
        rows: np.ndarray,
        links: BoolArray,
        distance: FloatArray,
        generators: Sequence[np.random.Generator],
    ) -> FloatArray:
        """Return the observed lengths (..., n, n), 0 where no length is measured."""
        if self.lengths == "one":
            # Use the longest link of node 0: it gives the smallest errors of scale.
            other = np.where(links[:, 0], distance[:, 0], 0.0).argmax(axis=-1)
            known = np.zeros(links.shape, dtype=np.bool_)
            worlds = np.arange(len(links))
            known[worlds, 0, other] = known[worlds, other, 0] = True
            return np.where(known & links, distance, 0.0)
        normals = np.triu(self._normals(rows, generators), 1)
        noise = self._column("length_std_m", rows) * (normals + normals.swapaxes(-1, -2))
        longest = np.array([self._plans[i].longest_m for i in rows])[:, None, None]
        # A measured length is positive: 0 means no length.
        return np.where(links, np.clip(distance + noise, 1e-9, longest), 0.0)

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        rows = np.flatnonzero(moving)
        if len(rows):
            theta = self._orientations[rows]
            ahead = np.clip(actions[rows], -1, 1).reshape(len(rows), -1, 2)
            ahead = self._column("step_m", rows) * ahead * self._there[rows][..., None]
            turn = np.exp(1j * theta) * (ahead[..., 0] + 1j * ahead[..., 1])
            moved = self._positions[rows] + np.stack([turn.real, turn.imag], axis=-1)
            self._positions[rows] = np.clip(moved, 0.0, self._column("side_m", rows))
            self._measure(rows, [self._generators[i] for i in rows])
        score = self._score_rad if self.lengths == "none" else self._score_m
        reward = -np.log(score) if self._rewarded else np.zeros(self.num_envs)
        return reward, np.zeros(self.num_envs, dtype=np.bool_)

    def _observe(self) -> dict[str, np.ndarray]:
        links = self._links.astype(np.int8)
        seen: dict[str, np.ndarray] = {"bearings": self._bearings.copy(), "links": links}
        if self.lengths != "none":
            seen["lengths"] = self._lengths.copy()
        if self.family is not None:
            seen["node_mask"] = self._there.astype(np.int8)
            seen["network"] = self._numbers.copy()
        return seen

    def _inform(self) -> dict[str, np.ndarray]:
        told = {
            "positions": self._positions.copy(),
            "orientations": self._orientations.copy(),
            "score_rad": self._score_rad.copy(),
        }
        return told if self.lengths == "none" else {**told, "score_m": self._score_m.copy()}

    def _shot(self) -> tuple[Any, None]:
        return rendering.Network(self._positions, self._orientations, self._links, self._std), None


def _layout(plan: NetworkPlan, generator: np.random.Generator) -> FloatArray:
    """Draw uniform positions in the square, with a connected graph if one is found in time."""
    positions = np.zeros((plan.n_nodes, 2))
    for _ in range(_TRIES):
        positions = generator.uniform(0, plan.side_m, (plan.n_nodes, 2))
        links, _ = _links_of(positions, plan.radius_m, plan.blind_m)
        if not components(np.argwhere(np.triu(links)), plan.n_nodes).any():
            break
    return positions


def _links_of(positions: FloatArray, radius_m: Any, blind_m: Any) -> tuple[BoolArray, FloatArray]:
    """Return which nodes see each other (..., n, n), and their displacements (..., n, n, 2)."""
    apart = positions[..., None, :, :] - positions[..., :, None, :]
    distance = np.linalg.norm(apart, axis=-1)
    return (distance <= radius_m) & (distance >= blind_m), apart


class PlanarNetworkEnv(ScalarEnv):
    """Move the nodes of a planar network so that their orientations become known.

    ## Description
    n nodes are in a square, each with an unknown orientation. Two nodes see each other if their
    distance is between `blind_m` and `radius_m`. Each then measures the bearing of the other in its
    own frame, with noise. The bearings of the edges determine the orientations relative to node 0
    (`rbl_gym.networks.sensing`). The orientations become more accurate with more edges and better
    connected networks. Nodes move without turning.

    ## Action space
    ``Box(-1, 1, (2 n,))``: displacement of each node in its own frame, in units of `step_m`:
    (forward, left) of node 0, then of node 1, and so on. Nodes stay in the square.

    ## Observation space
    A ``Dict``:

    | key | shape | type | meaning |
    |---|---|---|---|
    | `bearings` | (n, n) | float64 | (i, j): bearing of node j in the frame of node i, in [-pi, pi], 0 without a link |
    | `links` | (n, n) | int8 | (i, j): 1 if i and j see each other |
    | `lengths` | (n, n) | float64 | metres, symmetric, 0 without a length. Only with the argument `lengths` |

    ``lengths="one"`` gives the exact length of one link, the longest of node 0. ``lengths="all"``
    gives the lengths of all links, with noise `length_std_m`. Bearings alone do not determine the
    scale of the network. With a length they determine the positions.

    ## Reward
    ``-log b``, where b is the Cramer-Rao bound of the root mean square orientation error in radians
    of all nodes except node 0. The bound uses only the bearings of this epoch, and a prior with the
    standard deviation pi / sqrt(3) of a uniform angle. With `lengths`, b is the bound of the pose
    error in metres: the error of a point 1 m away from its node, in the frame of node 0. This bound
    uses the bearings and lengths of this epoch, and the known limits of the length of a link,
    `blind_m` and `radius_m`. ``reward="none"``: 0.

    ## Starting state
    Positions are uniform in the square, drawn again until the network is connected (at most 64
    times). Orientations are uniform; that of node 0 is the reference.

    ## Episode end
    Never terminates; truncates after `steps` steps.

    ## Info
    * `positions` (n, 2), `orientations` (n,): the truth, in a frame with the orientation of node 0.
    * `score_rad`: the bound of the orientations.
    * `score_m`: the bound of the poses, with `lengths`.

    ## Rendering
    ``render_mode="rgb_array"``: nodes, links and headings, with the orientations estimated by
    `EstimateNetwork` (with `lengths` also the positions). Without this wrapper the frame shows the
    bound.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/PlanarNetwork-v0", n_nodes=20, radius_m=3.0)
    ```

    * `n_nodes`: number of nodes.
    * `side_m`: side of the square.
    * `radius_m`, `blind_m`: sensing radius and blind zone.
    * `bearing_std_rad`: standard deviation of a bearing.
    * `lengths`: ``"none"``, ``"one"`` or ``"all"``; `length_std_m`: standard deviation of a length
      with ``"all"``.
    * `step_m`: longest displacement along an axis.
    * `reward`: ``"bound"`` or ``"none"``.
    * `steps`: length of an episode.
    * `scenes`: a family of networks, a list of dicts (or one dict) with the numbers above from
      `n_nodes` to `step_m`. Every reset draws one of them. A value may be a random law, see
      `rbl_gym.worlds.families.SceneFamily`. Fields that a dict does not set have the value of the
      argument with the same name:
    ```python
    env = gym.make(
        "rbl_gym:RBL/PlanarNetwork-v0",
        scenes={"n_nodes": {"integers": [6, 20]}, "radius_m": {"uniform": [3.0, 6.0]}},
    )
    ```

    With `scenes` n is the largest number of nodes. Rows of missing nodes are zeros, and missing
    nodes have no links. The observation has two more keys: `node_mask` (n,), int8, 1 for existing
    nodes, and `network` (6,), float64: `side_m`, `radius_m`, `blind_m`, `bearing_std_rad`,
    `length_std_m`, `step_m` of the drawn network. `info["scene"]` of the reset has its fields as
    JSON text. `EstimateNetwork` does not support `scenes` and raises ValueError.

    ## Version history
    * v0: first version.
    """  # noqa: E501 (a table row cannot be broken)

    batch_class = PlanarNetworkVectorEnv

    def __init__(
        self,
        n_nodes: int = 12,
        side_m: float = 10.0,
        radius_m: float = 4.0,
        blind_m: float = 0.5,
        bearing_std_rad: float = 0.05,
        lengths: str = "none",
        length_std_m: float = 0.1,
        step_m: float = 0.5,
        reward: str = "bound",
        steps: int = 50,
        render_mode: str | None = None,
        scenes: Any = None,
    ) -> None:
        self._configure(
            render_mode, n_nodes=n_nodes, side_m=side_m, radius_m=radius_m, blind_m=blind_m,
            bearing_std_rad=bearing_std_rad, lengths=lengths, length_std_m=length_std_m,
            step_m=step_m, reward=reward, steps=steps, scenes=scenes,
        )  # fmt: skip

    @property
    def family(self) -> NetworkFamily | None:
        """The family from which every reset draws a network, if there is one."""
        return self._batch.family

    @property
    def n_nodes(self) -> int:
        """Number of nodes; the largest of a family."""
        return self._batch.n_nodes

    @property
    def bearing_std_rad(self) -> float:
        """Standard deviation of a bearing."""
        return self._batch.bearing_std_rad

    @property
    def sensing(self) -> Sensing:
        """The sensor models, which an estimator may know besides the observation."""
        return self._batch.sensing

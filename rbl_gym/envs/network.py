"""RBL/PlanarNetwork-v0: nodes measure each other's bearings and move to estimate orientations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym.checks import BoolArray, FloatArray, check_count, check_number, check_one_of
from rbl_gym.envs.batch import BatchEnv
from rbl_gym.envs.scalar import ScalarEnv
from rbl_gym.networks.bounds import Sensing, linked_covariance, linked_pose_covariance
from rbl_gym.networks.graphs import components
from rbl_gym.networks.sensing import proj
from rbl_gym.rendering import network as rendering

REWARDS = ("bound", "none")
LENGTHS = ("none", "one", "all")
# Standard deviation of an unknown orientation, uniform on the circle.
PRIOR_STD_RAD = math.pi / math.sqrt(3)
# Standard deviation of the known length, as a fraction of the square's side: small enough to be
# practically exact, and large enough for iterations to converge.
_KNOWN = 1e-4
# Bounds below a millionth of a radian and of the side are not reliable in double precision.
_SHARPEST = 1e-6
# Limit of the observation space: the longest link plus this many standard deviations.
_TAIL = 8.0
# Number of layouts tried to find one that is connected at the start.
_TRIES = 64
# Limit of n: the bound inverts n x n matrices.
MOST_NODES = 10_000


def _ring(low: float, high: float) -> tuple[float, float]:
    """Return mean and standard deviation of the distance of points spread evenly over a ring."""
    high = max(high, 1.001 * low)
    mean = 2 / 3 * (high**3 - low**3) / (high**2 - low**2)
    return mean, math.sqrt((high**2 + low**2) / 2 - mean**2)


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
    ) -> None:
        steps = check_count("steps", steps)
        self.n_nodes = n_nodes = check_count("n_nodes", n_nodes, least=2, most=MOST_NODES)
        self.side_m = check_number("side_m", side_m, low=1e-6)
        self.radius_m = check_number("radius_m", radius_m, low=0.0)
        self.blind_m = check_number("blind_m", blind_m, low=1e-9)
        self.bearing_std_rad = check_number("bearing_std_rad", bearing_std_rad, low=1e-9)
        self.lengths = check_one_of("lengths", lengths, LENGTHS)
        self.length_std_m = check_number("length_std_m", length_std_m, low=1e-9)
        if lengths == "one":
            self.length_std_m = _KNOWN * self.side_m
        reach = min(self.radius_m, self.side_m * math.sqrt(2))
        self.sensing = Sensing(
            bearing_std_rad=max(self.bearing_std_rad, _SHARPEST),
            length_std_m=max(self.length_std_m, _SHARPEST * self.side_m),
            typical_length_m=_ring(self.blind_m, reach),
            prior_std_rad=PRIOR_STD_RAD,
            prior_std_m=self.side_m / math.sqrt(6),
        )
        self.step_m = check_number("step_m", step_m, low=0.0)
        self._rewarded = check_one_of("reward", reward, REWARDS) == "bound"
        square = (n_nodes, n_nodes)
        observed: dict[str, spaces.Space[Any]] = {
            "bearings": spaces.Box(-math.pi, math.pi, square, np.float64),
            "links": spaces.Box(0, 1, square, np.int8),
        }
        self._longest = reach + _TAIL * self.length_std_m
        if lengths != "none":
            observed["lengths"] = spaces.Box(0.0, self._longest, square, np.float64)
        self.single_observation_space = spaces.Dict(observed)
        self.single_action_space = spaces.Box(-1.0, 1.0, (2 * n_nodes,), np.float32)
        self.film = rendering.film_of(render_mode, self.side_m, n_nodes, steps)
        self._configure(num_envs, render_mode, steps, max_episode_steps, autoreset_mode)
        self._positions = np.zeros((num_envs, n_nodes, 2))
        self._orientations = np.zeros((num_envs, n_nodes))
        self._links = np.zeros((num_envs, *square), dtype=np.bool_)
        self._bearings = np.zeros((num_envs, *square))
        self._lengths = np.zeros((num_envs, *square))
        self._std = np.zeros((num_envs, n_nodes))
        self._score_rad = np.zeros(num_envs)
        self._score_m = np.zeros(num_envs)

    def _restart(self, chosen: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        for world, generator in zip(chosen, generators, strict=True):
            self._positions[world] = self._layout(generator)
            theta = generator.uniform(-np.pi, np.pi, self.n_nodes)
            self._orientations[world] = proj(theta - theta[0])
        self._measure(chosen, generators)

    def _layout(self, generator: np.random.Generator) -> FloatArray:
        """Draw uniform positions in the square, with a connected graph if one is found in time."""
        positions = np.zeros((self.n_nodes, 2))
        for _ in range(_TRIES):
            positions = generator.uniform(0, self.side_m, (self.n_nodes, 2))
            edges = np.argwhere(np.triu(self._links_of(positions)[0]))
            if not components(edges, self.n_nodes).any():
                break
        return positions

    def _links_of(self, positions: FloatArray) -> tuple[BoolArray, FloatArray]:
        """Return which nodes see each other (..., n, n), and their displacements (..., n, n, 2)."""
        apart = positions[..., None, :, :] - positions[..., :, None, :]
        distance = np.linalg.norm(apart, axis=-1)
        return (distance <= self.radius_m) & (distance >= self.blind_m), apart

    def _measure(self, rows: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        """Measure links, bearings and the bound of some worlds."""
        links, apart = self._links_of(self._positions[rows])
        toward = np.arctan2(apart[..., 1], apart[..., 0])
        size = (self.n_nodes, self.n_nodes)
        normals = np.array([generator.standard_normal(size) for generator in generators])
        seen = toward - self._orientations[rows][..., None] + self.bearing_std_rad * normals
        self._links[rows] = links
        self._bearings[rows] = np.where(links, proj(seen), 0.0)
        if self.lengths == "none":
            covariance = linked_covariance(links, self.bearing_std_rad, PRIOR_STD_RAD)
        else:
            distance = np.linalg.norm(apart, axis=-1)
            self._lengths[rows] = lengths = self._measured(links, distance, generators)
            covariance = linked_pose_covariance(
                self._positions[rows], links, lengths > 0, self.sensing
            )
            trace = np.trace(covariance, axis1=-2, axis2=-1)
            self._score_m[rows] = np.sqrt(trace / (self.n_nodes - 1))
        variance = np.diagonal(covariance, axis1=-2, axis2=-1)[..., : self.n_nodes - 1]
        self._std[rows, 1:] = np.sqrt(variance)
        self._score_rad[rows] = np.sqrt(variance.mean(axis=-1))

    def _measured(
        self, links: BoolArray, distance: FloatArray, generators: Sequence[np.random.Generator]
    ) -> FloatArray:
        """Return the observed lengths (..., n, n), 0 where no length is measured."""
        if self.lengths == "one":
            # Use the longest link of node 0: it gives the smallest errors of scale.
            other = np.where(links[:, 0], distance[:, 0], 0.0).argmax(axis=-1)
            known = np.zeros(links.shape, dtype=np.bool_)
            worlds = np.arange(len(links))
            known[worlds, 0, other] = known[worlds, other, 0] = True
            return np.where(known & links, distance, 0.0)
        size = (self.n_nodes, self.n_nodes)
        normals = np.array([np.triu(g.standard_normal(size), 1) for g in generators])
        noisy = distance + self.length_std_m * (normals + normals.swapaxes(-1, -2))
        # A measured length is positive: 0 means no length.
        return np.where(links, np.clip(noisy, 1e-9, self._longest), 0.0)

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        rows = np.flatnonzero(moving)
        if len(rows):
            theta = self._orientations[rows]
            ahead = self.step_m * np.clip(actions[rows], -1, 1).reshape(len(rows), -1, 2)
            turn = np.exp(1j * theta) * (ahead[..., 0] + 1j * ahead[..., 1])
            moved = self._positions[rows] + np.stack([turn.real, turn.imag], axis=-1)
            self._positions[rows] = np.clip(moved, 0.0, self.side_m)
            self._measure(rows, [self._generators[i] for i in rows])
        score = self._score_rad if self.lengths == "none" else self._score_m
        reward = -np.log(score) if self._rewarded else np.zeros(self.num_envs)
        return reward, np.zeros(self.num_envs, dtype=np.bool_)

    def _observe(self) -> dict[str, np.ndarray]:
        seen = {"bearings": self._bearings.copy(), "links": self._links.astype(np.int8)}
        return seen if self.lengths == "none" else {**seen, "lengths": self._lengths.copy()}

    def _inform(self) -> dict[str, np.ndarray]:
        told = {
            "positions": self._positions.copy(),
            "orientations": self._orientations.copy(),
            "score_rad": self._score_rad.copy(),
        }
        return told if self.lengths == "none" else {**told, "score_m": self._score_m.copy()}

    def _shot(self) -> tuple[Any, None]:
        return rendering.Network(self._positions, self._orientations, self._links, self._std), None


class PlanarNetworkEnv(ScalarEnv):
    """Move the nodes of a network so that each of them learns its orientation.

    ## Description
    n nodes lie in a square, each with an unknown orientation. Nodes within the sensing radius (and
    not nearer than the blind zone) measure each other's bearing in their own frames, with noise.
    Orientations relative to node 0 follow from the bearings of each edge
    (`rbl_gym.networks.sensing`). They become more exact with more edges and with better connected
    networks. Nodes move without turning.

    ## Action space
    ``Box(-1, 1, (2 n,))``: displacement of each node in its OWN frame, in units of `step_m`:
    (forward, left) of node 0, then of node 1, and so on. Nodes stay in the square.

    ## Observation space
    A ``Dict``:

    | key | shape | type | meaning |
    |---|---|---|---|
    | `bearings` | (n, n) | float64 | (i, j): bearing of node j in the frame of node i, in [-pi, pi], 0 without a link |
    | `links` | (n, n) | int8 | (i, j): 1 if i and j see each other |
    | `lengths` | (n, n) | float64 | metres, symmetric, 0 without a length. Only with the argument `lengths` |

    ``lengths="one"`` gives the exact length of one link, the longest of node 0. ``lengths="all"``
    gives those of all links, with their own noise. Bearings and a length determine the scale, and
    with it the positions.

    ## Reward
    ``-log b``, where b is the Cramer-Rao bound of the root mean square orientation error in radians
    of all nodes except node 0. It uses the bearings of this epoch alone and a prior with the
    standard deviation pi / sqrt(3) of a uniform angle. With `lengths`, b is the bound of the pose
    error in metres: that of a point 1 m away from its node, in the frame of node 0. It uses the
    bearings and lengths of this epoch and the known limits of every link length, `blind_m` and
    `radius_m`. ``reward="none"``: 0.

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
    ) -> None:
        self._configure(
            render_mode, n_nodes=n_nodes, side_m=side_m, radius_m=radius_m, blind_m=blind_m,
            bearing_std_rad=bearing_std_rad, lengths=lengths, length_std_m=length_std_m,
            step_m=step_m, reward=reward, steps=steps,
        )  # fmt: skip

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return self._batch.n_nodes

    @property
    def bearing_std_rad(self) -> float:
        """Standard deviation of a bearing."""
        return self._batch.bearing_std_rad

    @property
    def sensing(self) -> Sensing:
        """The sensor models, which an estimator may know besides the observation."""
        return self._batch.sensing

"""RBL/AnchorPlacement-v0: place M anchors for a work region, one by one or all at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym import placement
from rbl_gym.checks import BoolArray, FloatArray, check_one_of
from rbl_gym.envs.batch import BatchEnv
from rbl_gym.envs.episodes import rows_of
from rbl_gym.envs.scalar import ScalarEnv
from rbl_gym.geometry.regions import Region
from rbl_gym.placement.problem import Context, information_of_fixed, score_of_checked
from rbl_gym.rendering import placement as rendering

# Mirror signs of a problem: neither, x, y, both.
_MIRRORS = ((1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, 1))
# Axes that may be mirrored.
_LEVEL = np.array([1.0, 1.0, 0.0])
MODES = ("sequential", "one-shot", "mounts")
# Initial score of the shaped reward with ``mode="mounts"``, metres.
EMPTY_SCORE_M = 3.0


class AnchorPlacementVectorEnv(BatchEnv):
    """`num_envs` independent `AnchorPlacementEnv` problems in arrays.

    Created by ``gym.make_vec("rbl_gym:RBL/AnchorPlacement-v0", num_envs=64, scene=...)``. The
    arguments are those of `AnchorPlacementEnv`. Seeding and autoreset work as in `BatchEnv`.
    """

    render_fps = 2

    def __init__(
        self,
        num_envs: int = 1,
        scene: str | Mapping[str, Any] = "auv_buoys",
        mode: str = "sequential",
        racks: int = 0,
        n_anchors: int | None = None,
        mirror: bool = True,
        sight: bool = False,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.task = placement.task(scene, n_anchors, racks)
        if not isinstance(mirror, bool):
            raise ValueError(f"mirror must be True or False, got {mirror!r:.80}")
        self.mirror = mirror and is_symmetric(self.task)
        self.mode = check_one_of("mode", mode, MODES)
        self.sight = check_sight(sight, self.task) or mode == "mounts"
        self.single_action_space = self._action_space()
        size = observation_size(self.task, self.mode, self.sight)
        self.single_observation_space = spaces.Box(-1.0, 1.0, (size,), np.float32)
        steps = 1 if mode == "one-shot" else self.task.n_anchors
        self.film = rendering.film_of(render_mode, self.task)
        # An episode terminates with the last anchor.
        self._configure(num_envs, render_mode, steps + 1, max_episode_steps, autoreset_mode)
        self._placements = steps
        uniforms = np.zeros((num_envs, placement.context_uniforms(self.task)))
        self._contexts = placement.build_contexts(self.task, uniforms)
        # Mirror signs of the axes as each problem is observed.
        self._signs = np.ones((num_envs, 3))
        # The observed problem, in the type of the observation.
        self._view = _View(self.task)
        self._features = self._view.features(self._contexts).astype(np.float32)
        self._actions = np.zeros((num_envs, self.task.n_anchors, 3), np.float32)
        self._next = np.eye(self.task.n_anchors + 1, self.task.n_anchors, dtype=np.float32)
        self._anchors = np.zeros((num_envs, self.task.n_anchors, 3))
        self._score_m = np.zeros(num_envs)
        if self.sight:
            self._mounts = placement.mounts(self.task)
            self._mirrored = mirrored_mounts(self.task, self._mounts)
            self._seen = np.zeros((num_envs, len(self._mounts)))
        if self.mode == "mounts":
            self._taken = np.zeros((num_envs, len(self._mounts)), dtype=np.bool_)
            self._information = np.zeros((num_envs, self.task.n_poses, 6, 6))
            self._log_score = np.zeros(num_envs)

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode: one for each anchor that is placed separately."""
        return min(self._placements, self.steps_limit)

    def _shot(self) -> tuple[Any, None]:
        share = self.task.n_anchors // self._placements
        return rendering.Layout(self._contexts, self._anchors, share * self._epochs), None

    def _action_space(self) -> spaces.Space[Any]:
        if self.mode == "mounts":
            return spaces.Discrete(len(placement.mounts(self.task)))
        size = 3 * self.task.n_anchors if self.mode == "one-shot" else 3
        return spaces.Box(-1.0, 1.0, (size,), np.float32)

    @property
    def contexts(self) -> Context:
        """The problems of the current episodes."""
        return Context(*(field.copy() for field in self._contexts))

    def _restart(self, chosen: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        size = placement.context_uniforms(self.task)
        uniforms = np.array([generator.random(size) for generator in generators])
        fresh = placement.build_contexts(self.task, uniforms)
        rows = rows_of(chosen)
        for held, new in zip(self._contexts, fresh, strict=True):
            held[rows] = new
        shown = fresh
        if self.mirror:
            self._signs[rows] = signs = self._view.signs(fresh)
            shown = self._view.mirrored(fresh, signs)
        self._features[rows] = self._view.features(shown)
        self._actions[rows] = 0.0
        self._anchors[rows] = 0.0
        self._score_m[rows] = 0.0
        if self.sight:
            self._seen[rows] = placement.sight_fractions(self.task, fresh, self._mounts)
        if self.mode == "mounts":
            self._taken[rows] = False
            self._information[rows] = information_of_fixed(self.task, fresh)
            self._log_score[rows] = math.log(EMPTY_SCORE_M)

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        complete = moving & (self._epochs == self._placements)
        if self.mode == "mounts":
            rows = np.flatnonzero(moving)
            return self._mount(actions, rows, self._epochs[rows] - 1, complete), complete
        # One-shot: all anchors of a world; otherwise the next one.
        rows, step = self._places(moving)
        new = rows if self.mode == "one-shot" else (rows, step)
        placed = np.minimum(np.maximum(actions[rows], -1.0), 1.0)
        signs = self._signs[rows]
        if self.mode == "one-shot":
            placed, signs = placed.reshape((len(placed), -1, 3)), signs[:, None]
        self._actions[new] = placed
        self._anchors[new] = self.task.scene.anchor_region.place(signs * placed)
        reward = np.zeros(self.num_envs)
        if count := np.count_nonzero(complete):
            problems, anchors = self._contexts, self._anchors
            if count < self.num_envs:
                problems = Context(*(field[complete] for field in problems))
                anchors = anchors[complete]
            score_m = score_of_checked(self.task, problems, anchors)
            self._score_m[complete] = score_m
            reward[complete] = -np.log(score_m)
        return reward, complete

    def _places(self, moving: BoolArray) -> tuple[Any, Any]:
        """Return indices of the worlds of the mask, and of the anchor that each places."""
        epochs = self._epochs
        if self.num_envs == 1 or (moving.all() and (epochs == epochs[0]).all()):
            # Views are faster than copies.
            return slice(None), epochs[0] - 1
        rows = np.flatnonzero(moving)
        return rows, epochs[rows] - 1

    def _mount(
        self, actions: np.ndarray, rows: np.ndarray, step: np.ndarray, complete: BoolArray
    ) -> FloatArray:
        """Place anchors on mounts; return the decrease of the log score as reward."""
        # Action k is the k-th mount of the observation.
        chosen = self._shown()[rows, actions[rows].astype(int)]
        anchors = self._mounts[chosen]
        self._anchors[rows, step] = anchors
        self._taken[rows, chosen] = True
        problems = Context(*(field[rows] for field in self._contexts))
        # Information is a sum over the anchors: each step adds that of its anchor.
        self._information[rows] += placement.information(self.task, problems, anchors[:, None])
        log_score = self._log_score.copy()
        log_score[rows] = np.log(placement.score_of(self.task, self._information[rows]))
        reward, self._log_score = self._log_score - log_score, log_score
        self._score_m[complete] = np.exp(log_score[complete])
        return reward

    def _shown(self) -> np.ndarray:
        """Return the mount (B, 57) at each entry of the observation."""
        which = (self._signs[:, :2] < 0) @ np.array([1, 2])
        return self._mirrored[which]

    def _observe(self) -> np.ndarray:
        parts: list[np.ndarray] = [self._features]
        if self.mode == "sequential":
            parts.append(self._actions.reshape(self.num_envs, -1))
        if self.sight:
            parts.append(np.take_along_axis(self._seen, self._shown(), axis=-1))
        if self.mode == "mounts":
            parts.append(np.take_along_axis(self._taken, self._shown(), axis=-1))
        if self.mode != "one-shot":
            parts.append(self._next[self._epochs])
        return np.concatenate(parts, axis=-1, dtype=np.float32)

    def _inform(self) -> dict[str, np.ndarray]:
        contexts = self._contexts
        info: dict[str, np.ndarray] = {
            "anchors": self._anchors.copy(),
            "score_m": self._score_m.copy(),
            "region": np.concatenate([contexts.centre, contexts.half], axis=-1),
            "racks": contexts.racks.copy(),
        }
        if self.mode == "mounts":
            info["action_mask"] = self.action_masks().astype(np.int8)
        return info

    def action_masks(self) -> BoolArray:
        """Return the free mounts (B, 57) in the order of the actions; only with ``mode="mounts"``.

        Used by ``MaskablePPO`` of sb3-contrib.
        """
        if self.mode != "mounts":
            raise ValueError(f"mode must be 'mounts' for action masks, got {self.mode!r}")
        return ~np.take_along_axis(self._taken, self._shown(), axis=-1)


class AnchorPlacementEnv(ScalarEnv):
    """Place anchors so that a body in a given work region is localized well.

    ## Description
    Every episode draws a problem: a work region, which is a box inside the scene's volume, and in
    rooms up to two racks that block sight, in addition to the scene's obstacles. The agent places M
    anchors on the scene's legal surfaces. The score of a layout is the root mean square tag error
    in metres, from position and orientation together, that the Cramer-Rao bound gives over 32 fixed
    poses in the region (`rbl_gym.placement.score`).

    ## Action space
    * ``mode="sequential"``: ``Box(-1, 1, (3,))``, the next anchor, projected onto the legal
      surfaces (`Region.place`).
    * ``mode="one-shot"``: ``Box(-1, 1, (3 M,))``, all anchors at once.
    * ``mode="mounts"`` (rooms only): ``Discrete(57)``, one of the mount points of
      `rbl_gym.placement.mounts`. A mount that is already taken gets a second anchor.

    ## Observation space
    ``Box(-1, 1, (n,), float32)``, in this order:

    * centre and size of the region, scaled to the volume (6);
    * position and half size of each rack, scaled to the room (6 each);
    * ``"sequential"``: the actions so far (3 M);
    * ``"mounts"``, or ``sight=True``: the fraction of the poses that each mount of
      `rbl_gym.placement.mounts` sees (57);
    * ``"mounts"``: whether each mount is taken (57);
    * except in ``"one-shot"``: the one-hot number of the next anchor (M).

    If the legal space and the volume have the same centre, problems are observed mirrored in x and
    y, so that the region lies towards +x and +y. Racks are then in the order of x, and actions are
    mirrored back. ``mirror=False`` turns this off.

    ## Reward
    ``-log score`` with the last anchor, 0 before. ``mode="mounts"``: the decrease of the log score
    with every anchor, starting from a score of 3 m. ``gym.make(..., reward="filter")`` rewards the
    accuracy of a filter instead (the wrapper `FilterReward`).

    ## Episode end
    Terminates with the last anchor. `env.spec.max_episode_steps` gives the number of steps. (In an
    environment made from that spec Gymnasium's `TimeLimit` also truncates at that step.)

    ## Info
    * `anchors` (M, 3): positions, zeros for anchors not yet placed.
    * `region`: centre and half size, metres.
    * `racks` (K, 6): centre and half size, metres; the scene's own obstacles first.
    * `score_m`: score of the complete layout, 0 before.
    * `action_mask` (57), with ``mode="mounts"``; `action_masks()` gives it as booleans.

    ## Rendering
    ``render_mode="rgb_array"``: the problem and its anchors in 3-D and in plan, the expected tag
    error at the poses of the region, and its root mean square against the number of anchors.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/AnchorPlacement-v0", scene="uwb_room", racks=2, sight=True)
    env = gym.make("rbl_gym:RBL/AnchorPlacement-v0", scene="uwb_room", mode="mounts", n_anchors=4)
    env = gym.make("rbl_gym:RBL/AnchorPlacement-v0", reward="filter", filter="iekf")
    ```

    ## Version history
    * v0: first version.
    """

    batch_class = AnchorPlacementVectorEnv

    def __init__(
        self,
        scene: str | Mapping[str, Any] = "auv_buoys",
        mode: str = "sequential",
        racks: int = 0,
        n_anchors: int | None = None,
        mirror: bool = True,
        sight: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self._configure(
            render_mode, scene=scene, mode=mode, racks=racks, n_anchors=n_anchors, mirror=mirror,
            sight=sight,
        )  # fmt: skip

    @property
    def task(self) -> placement.PlacementTask:
        """The family of problems."""
        return self._batch.task

    def action_masks(self) -> BoolArray:
        """Return the free mounts (57,) in the order of the actions; only with ``mode="mounts"``.

        Used by ``MaskablePPO`` of sb3-contrib.
        """
        return self._batch.action_masks()[0]


def check_sight(sight: bool, task: placement.PlacementTask) -> bool:
    """Return whether the mounts' sight is observed: only if racks can block it."""
    if not isinstance(sight, bool):
        raise ValueError(f"sight must be True or False, got {sight!r:.80}")
    if sight and not task.racks and not task.scene.obstruction:
        raise ValueError("sight must be False without racks, which alone block it, got racks=0")
    return sight


def observation_size(task: placement.PlacementTask, mode: str, sight: bool) -> int:
    """Return the length of the observation."""
    size = 6 + 6 * task.racks
    if mode != "one-shot":
        size += task.n_anchors
    if mode == "sequential":
        size += 3 * task.n_anchors
    of_mounts = sight + (mode == "mounts")
    return size + of_mounts * len(placement.mounts(task)) if of_mounts else size


def is_symmetric(task: placement.PlacementTask) -> bool:
    """Return whether problems may be mirrored: legal space and volume share their x-y centre."""
    centres = [_centre(region)[:2] for region in (task.scene.volume, task.scene.anchor_region)]
    # Permanent obstacles would have to be mirrored as well.
    return bool(np.allclose(*centres, atol=1e-9)) and not task.scene.weakens


def _centre(region: Region) -> FloatArray:
    low, high = region.bounds()
    return 0.5 * (low + high)


def mirrored_mounts(task: placement.PlacementTask, mounts: FloatArray) -> np.ndarray:
    """Return indices (4, 57) of the mounts mirrored in neither, x, y, both."""
    middle = _centre(task.scene.anchor_region) * [1, 1, 0]
    moved = middle + np.array(_MIRRORS)[:, None] * (mounts - middle)
    return np.abs(moved[:, :, None] - mounts).sum(axis=-1).argmin(axis=-1)


class _View:
    """How a task presents the problems of B worlds: mirrored, and scaled to [-1, 1]."""

    def __init__(self, task: placement.PlacementTask) -> None:
        self._own = len(task.scene.obstacles)
        self._centre = _centre(task.scene.volume)
        self._middle = _centre(task.scene.anchor_region) * _LEVEL
        low, high = task.scene.volume.bounds()
        half = np.maximum(0.5 * (high - low), 1e-9)
        # Of the region: the half size lies between zero and that of the volume.
        self._shift = np.concatenate([self._centre, 0.5 * half])
        self._scale = np.concatenate([half, 0.5 * half])
        # Racks stand on the floor.
        floor, ceiling = task.scene.anchor_region.bounds()
        room = 0.5 * (ceiling - floor)
        self._rack_shift = np.concatenate([floor + room, np.zeros(3)])
        self._rack_scale = np.concatenate([room, room])

    def signs(self, context: Context) -> FloatArray:
        """Return the signs (B, 3) of the axes that move the region's centre towards +x and +y."""
        signs = np.where(context.centre < self._centre, -1.0, 1.0)
        signs[..., 2] = 1.0
        return signs

    def mirrored(self, context: Context, signs: FloatArray) -> Context:
        """Return the problem mirrored by signs (B, 3), with its racks in descending order of x."""
        centre, racks = self._middle + signs * (context.centre - self._middle), context.racks
        if not racks.shape[-2]:
            return Context(centre, context.half, racks)
        racks = racks.copy()
        racks[..., :3] = self._middle + signs[:, None] * (racks[..., :3] - self._middle)
        if racks.shape[-2] > 1:
            order = (-racks[..., 0]).argsort(axis=-1)
            racks = racks[np.arange(len(racks))[:, None], order]
        return Context(centre, context.half, racks)

    def features(self, context: Context) -> FloatArray:
        """Return a problem as numbers (B, 6 + 6 K) in [-1, 1]: the region, then the drawn racks."""
        region = np.concatenate([context.centre, context.half], axis=-1)
        parts = [(region - self._shift) / self._scale]
        drawn = context.racks[..., self._own :, :]
        if drawn.shape[-2]:
            racks = (drawn - self._rack_shift) / self._rack_scale
            parts.append(racks.reshape(len(racks), -1))
        return np.minimum(np.maximum(np.concatenate(parts, axis=-1), -1.0), 1.0)

"""RBL/AnchorPlacement-v0 with `scenes=`: every episode places anchors in a different world."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym import placement
from rbl_gym.checks import BoolArray, FloatArray, check_count, check_one_of
from rbl_gym.envs.batch import BatchEnv
from rbl_gym.envs.placement import EMPTY_SCORE_M, MODES, is_symmetric, mirrored_mounts
from rbl_gym.envs.scalar import ScalarEnv
from rbl_gym.geometry.regions import Walls
from rbl_gym.placement.families import (
    DESCRIBED,
    StackedTasks,
    TaskFamily,
    described,
    task_family,
)
from rbl_gym.placement.problem import Context
from rbl_gym.rendering import placement as rendering


class PlacementFamilyVectorEnv(BatchEnv):
    """`num_envs` independent `PlacementFamilyEnv` in arrays; seeding and autoreset as `BatchEnv`.

    Created by ``gym.make_vec("rbl_gym:RBL/AnchorPlacement-v0", num_envs=64, scenes=...)``.
    """

    render_fps = 2

    def __init__(
        self,
        num_envs: int = 1,
        scenes: Any = ("auv_buoys",),
        mode: str = "sequential",
        racks: int = 0,
        n_anchors: int | None = None,
        mirror: bool = True,
        sight: bool = False,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.family = task_family(scenes, n_anchors, racks)
        for name, value in (("mirror", mirror), ("sight", sight)):
            if not isinstance(value, bool):
                raise ValueError(f"{name} must be True or False, got {value!r:.80}")
        self.mirror, self.mode = mirror, check_one_of("mode", mode, MODES)
        self.sight = sight or mode == "mounts"
        corners = self.family.corners
        if self.sight and not all(isinstance(t.scene.anchor_region, Walls) for t in corners):
            raise ValueError("scenes must be rooms with walls for mount points and their sight")
        m, k = self.family.most_anchors, self.family.most_boxes
        shown = placement.mounts(corners[0]) if self.sight else np.empty((0, 3))
        self._n_mounts = len(shown)
        self.single_action_space = self._action_space(m)
        size = 6 + 7 * k + DESCRIBED + m + self._n_mounts
        size += {"sequential": 4 * m, "one-shot": 0, "mounts": m + self._n_mounts}[mode]
        self.single_observation_space = spaces.Box(-1.0, 1.0, (size,), np.float32)
        self._longest = 1 if mode == "one-shot" else m
        self.film = rendering.film_of_many(render_mode, self._task_of, self._longest)
        num_envs = check_count("num_envs", num_envs)
        self._configure(num_envs, render_mode, self._longest + 1, max_episode_steps, autoreset_mode)
        self.stack = StackedTasks(self.family, num_envs)
        self._signs = np.ones((num_envs, 3))
        self._features = np.zeros((num_envs, 6 + 7 * k + DESCRIBED), np.float32)
        self._actions = np.zeros((num_envs, m, 3), np.float32)
        self._next = np.eye(m + 1, m, dtype=np.float32)
        self._anchors = np.zeros((num_envs, m, 3))
        self._score_m = np.zeros(num_envs)
        self._log_score = np.zeros(num_envs)
        if self.sight:
            # The same for all rooms: their mounts are at the same fractions of the walls.
            self._mirrored = mirrored_mounts(corners[0], shown)
            self._mounts = np.zeros((num_envs, self._n_mounts, 3))
            self._seen = np.zeros((num_envs, self._n_mounts))
            self._taken = np.zeros((num_envs, self._n_mounts), dtype=np.bool_)

    def _action_space(self, m: int) -> spaces.Space[Any]:
        if self.mode == "mounts":
            return spaces.Discrete(self._n_mounts)
        return spaces.Box(-1.0, 1.0, (3 * m if self.mode == "one-shot" else 3,), np.float32)

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode, in the worlds with most anchors."""
        return min(self._longest, self.steps_limit)

    @property
    def tasks(self) -> tuple[placement.PlacementTask, ...]:
        """The present tasks of the worlds."""
        return tuple(self.stack.tasks)

    def problem(self, world: int) -> Context:
        """Return the present problem of a world."""
        return self.stack.problem(world)

    def _task_of(self, world: int) -> placement.PlacementTask:
        return self.stack.tasks[world]

    def _shot(self) -> tuple[Any, None]:
        counts = self.stack.arrays.n_anchors
        placed = counts * self._epochs if self.mode == "one-shot" else self._epochs
        layout = rendering.Layout(self.stack.contexts, self._anchors, np.minimum(placed, counts))
        return layout, None

    def _restart(
        self, chosen: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, np.ndarray]:
        told = np.empty(len(chosen), dtype=object)
        for index, (world, generator) in enumerate(zip(chosen.tolist(), generators, strict=True)):
            told[index] = json.dumps(self.stack.begin(world, generator))
            self._show(world)
        self._actions[chosen] = 0.0
        self._anchors[chosen] = 0.0
        self._score_m[chosen] = 0.0
        self._log_score[chosen] = math.log(EMPTY_SCORE_M)
        return {"scene": told}

    def _show(self, world: int) -> None:
        """Write the constant part of the observation of problems that have just begun."""
        one, problem = self.stack.tasks[world], self.stack.problem(world)
        if self.sight:
            self._mounts[world] = placement.mounts(one)
            self._seen[world] = placement.sight_fractions(one, problem, self._mounts[world])
            self._taken[world] = False
        middle, signs = _middles(one)
        if self.mirror and is_symmetric(one):
            signs = np.where(problem.centre < middle[0], -1.0, 1.0) * [1, 1, 0] + [0, 0, 1]
            problem = _mirrored(problem, middle[1] * [1, 1, 0], signs)
        self._signs[world] = signs
        most = self.family.most_boxes
        boxes = np.zeros((most, 7))
        boxes[: len(problem.racks), :6] = _scaled_boxes(one, problem.racks)
        boxes[: len(problem.racks), 6] = 1.0
        parts = _scaled_region(one, problem), boxes.ravel(), described(one)
        self._features[world] = np.clip(np.concatenate(parts), -1.0, 1.0)

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        rows, counts = np.flatnonzero(moving), self.stack.arrays.n_anchors
        last = np.ones_like(counts) if self.mode == "one-shot" else counts
        complete = moving & (self._epochs == last)
        step = self._epochs[rows] - 1
        if self.mode == "mounts":
            # Action k is the k-th mount of the observation.
            which = self._order()[rows, actions[rows].astype(int)]
            self._anchors[rows, step] = self._mounts[rows, which]
            self._taken[rows, which] = True
            scored = rows
        else:
            self._place(rows, step, actions[rows])
            scored = np.flatnonzero(complete)
        reward = np.zeros(self.num_envs)
        if len(scored):
            placed = counts if self.mode == "one-shot" else self._epochs
            counted = np.arange(self.family.most_anchors) < placed[scored, None]
            log_score = np.log(self.stack.score(scored, self._anchors[scored], counted))
            paid = self._log_score[scored] if self.mode == "mounts" else 0.0
            reward[scored] = paid - log_score
            self._log_score[scored] = log_score
        self._score_m[complete] = np.exp(self._log_score[complete])
        return reward, complete

    def _place(self, rows: np.ndarray, step: np.ndarray, actions: np.ndarray) -> None:
        """Place the next anchor, or all anchors, of the worlds of some rows."""
        placed = np.clip(actions, -1.0, 1.0).reshape(len(rows), -1, 3)
        anchors = self.stack.place(rows, self._signs[rows, None] * placed)
        if self.mode == "one-shot":
            there = self.stack.anchor_mask[rows, :, None]
            self._actions[rows], self._anchors[rows] = placed * there, anchors * there
        else:
            self._actions[rows, step], self._anchors[rows, step] = placed[:, 0], anchors[:, 0]

    def _order(self) -> np.ndarray:
        """Return the mount (B, 57) at each entry of the observation."""
        return self._mirrored[(self._signs[:, :2] < 0) @ np.array([1, 2])]

    def _observe(self) -> np.ndarray:
        parts: list[np.ndarray] = [self._features, self.stack.anchor_mask]
        if self.mode == "sequential":
            parts.append(self._actions.reshape(self.num_envs, -1))
        if self.sight:
            parts.append(np.take_along_axis(self._seen, self._order(), axis=-1))
        if self.mode == "mounts":
            parts.append(np.take_along_axis(self._taken, self._order(), axis=-1))
        if self.mode != "one-shot":
            parts.append(self._next[self._epochs] * self.stack.anchor_mask)
        return np.concatenate(parts, axis=-1, dtype=np.float32)

    def _inform(self) -> dict[str, np.ndarray]:
        contexts, boxes = self.stack.contexts, self.stack.box_mask
        info: dict[str, np.ndarray] = {
            "anchors": self._anchors.copy(),
            "score_m": self._score_m.copy(),
            "region": np.concatenate([contexts.centre, contexts.half], axis=-1),
            "racks": np.where(boxes[..., None] > 0, contexts.racks, 0.0),
            "anchor_mask": self.stack.anchor_mask,
            "rack_mask": boxes,
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
        return ~np.take_along_axis(self._taken, self._order(), axis=-1)


class PlacementFamilyEnv(ScalarEnv):
    """`AnchorPlacementEnv` with `scenes` instead of `scene`; this page lists the differences.

    Every reset draws a world: its scene, the number of anchors, the racks. M and K are the largest
    numbers of anchors and boxes in the family. `scenes` is as in `TaskFamily`.

    ## Observation space
    ``Box(-1, 1, (n,), float32)``, in this order:

    * centre and size of the region, scaled to the volume of the drawn scene (6);
    * for each of the scene's own obstacles and the racks its position and half size, scaled to the
      scene, and a 1; zeros for unused rows (7 K);
    * a description of the world (18), see `rbl_gym.placement.families.described`;
    * 1 for every anchor of this world (M);
    * the rest as in `AnchorPlacementEnv`: actions so far (3 M), sight and taken mounts (57 each),
      one-hot number of the next anchor (M).

    ``mode="mounts"`` and `sight` need rooms in all scenes.

    ## Episode end
    Terminates with the last anchor of the drawn world.

    ## Info
    As in `AnchorPlacementEnv`, padded with zeros, with `anchor_mask` (M,) and `rack_mask` (K,). The
    info of a reset also has `scene`, the drawn overrides as JSON.
    """

    batch_class = PlacementFamilyVectorEnv

    def __init__(
        self,
        scenes: Any = ("auv_buoys",),
        mode: str = "sequential",
        racks: int = 0,
        n_anchors: int | None = None,
        mirror: bool = True,
        sight: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self._configure(
            render_mode, scenes=scenes, mode=mode, racks=racks, n_anchors=n_anchors,
            mirror=mirror, sight=sight,
        )  # fmt: skip

    @property
    def family(self) -> TaskFamily:
        """The family from which every reset draws a task."""
        return self._batch.family

    @property
    def task(self) -> placement.PlacementTask:
        """The task of this episode."""
        return self._batch.tasks[0]

    def action_masks(self) -> BoolArray:
        """Return the free mounts (57,) in the order of the actions; only with ``mode="mounts"``.

        Used by ``MaskablePPO`` of sb3-contrib.
        """
        return self._batch.action_masks()[0]


# --- observation of a problem ----------------------------------------------------------------


def _middles(one: placement.PlacementTask) -> tuple[tuple[FloatArray, FloatArray], FloatArray]:
    """Return centres of the volume and of the legal space, and the signs without mirroring."""
    regions = one.scene.volume, one.scene.anchor_region
    a, b = (0.5 * np.add(*region.bounds()) for region in regions)
    return (a, b), np.ones(3)


def _mirrored(problem: Context, middle: FloatArray, signs: FloatArray) -> Context:
    """Return a problem mirrored about a centre, with its racks in descending order of x."""
    racks = problem.racks.copy()
    racks[:, :3] = middle + signs * (racks[:, :3] - middle)
    racks = racks[np.argsort(-racks[:, 0], kind="stable")]
    return Context(middle + signs * (problem.centre - middle), problem.half, racks)


def _scaled_region(one: placement.PlacementTask, problem: Context) -> FloatArray:
    """Return centre and half size of the region (6,), scaled to the volume."""
    low, high = one.scene.volume.bounds()
    half = np.maximum(0.5 * (high - low), 1e-9)
    centre = (problem.centre - 0.5 * (low + high)) / half
    return np.concatenate([centre, (problem.half - 0.5 * half) / (0.5 * half)])


def _scaled_boxes(one: placement.PlacementTask, boxes: FloatArray) -> FloatArray:
    """Return boxes (K, 6) scaled to the box around the volume and the legal space."""
    corners = np.array([one.scene.volume.bounds(), one.scene.anchor_region.bounds()])
    low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    half = np.maximum(0.5 * (high - low), 1e-9)
    return np.concatenate([(boxes[:, :3] - 0.5 * (low + high)) / half, boxes[:, 3:] / half], axis=1)

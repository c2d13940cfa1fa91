"""RBL/AnchorPlacement-v0 with `scenes=`: every episode places anchors in a different world."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from rbl_gym import placement
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.envs.placement_batch import PlacementBatchEnv, PlacementScalarEnv, View, is_symmetric
from rbl_gym.envs.placement_views import PlacementViewLike
from rbl_gym.geometry.regions import Walls
from rbl_gym.placement.families import DESCRIBED, StackedTasks, TaskFamily, described, task_family
from rbl_gym.placement.problem import Context


class PlacementFamilyVectorEnv(PlacementBatchEnv):
    """`num_envs` independent `PlacementFamilyEnv` in arrays; seeding and autoreset as `BatchEnv`.

    Created by ``gym.make_vec("rbl_gym:RBL/AnchorPlacement-v0", num_envs=64, scenes=...)``.
    """

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
        observation: PlacementViewLike = "flat",
    ) -> None:
        self.family = task_family(scenes, n_anchors, racks)
        self._check_flags(mode, mirror, sight)
        corners = self.family.corners
        if self.sight and not all(isinstance(t.scene.anchor_region, Walls) for t in corners):
            names = sorted(
                {t.scene.name for t in corners if not isinstance(t.scene.anchor_region, Walls)}
            )
            raise ValueError(
                "scenes must be rooms with walls, as mode='mounts' and sight=True use their mount "
                f"points; got {', '.join(names)}"
            )
        m, k = self.family.most_anchors, self.family.most_boxes
        self._plan(corners[0], m, 6 + 7 * k + DESCRIBED + m)
        steps = self._placements + 1
        self._configure(num_envs, render_mode, steps, max_episode_steps, autoreset_mode)
        # The mounts of each world.
        self._mounts = np.zeros((num_envs, *self._mounts.shape))
        self.stack = StackedTasks(self.family, num_envs)
        self._contexts, self._counts = self.stack.contexts, self.stack.arrays.n_anchors
        self._look_by(observation)

    @property
    def tasks(self) -> tuple[placement.PlacementTask, ...]:
        """The present tasks of the worlds."""
        return tuple(self.stack.tasks)

    def problem(self, world: int) -> Context:
        """Return the present problem of a world."""
        return self.stack.problem(world)

    def _task_of(self, world: int) -> placement.PlacementTask:
        return self.stack.tasks[world]

    def _restart(
        self, chosen: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, np.ndarray]:
        told = np.empty(len(chosen), dtype=object)
        for index, (world, generator) in enumerate(zip(chosen.tolist(), generators, strict=True)):
            told[index] = json.dumps(self.stack.begin(world, generator))
            self._show(world)
        self._clear(chosen)
        return {"scene": told}

    def _show(self, world: int) -> None:
        """Write the constant part of the observation of problems that have just begun."""
        one, problem = self.stack.tasks[world], self.stack.problem(world)
        if self.sight:
            self._mounts[world] = placement.mounts(one)
            self._seen[world] = placement.sight_fractions(one, problem, self._mounts[world])
        corners = np.array([one.scene.volume.bounds(), one.scene.anchor_region.bounds()])
        view = View(one, corners[:, 0].min(axis=0), corners[:, 1].max(axis=0))
        shown = Context(*(field[None] for field in problem))
        self._signs[world] = 1.0
        if self.mirror and is_symmetric(one):
            self._signs[world] = signs = view.signs(shown)
            shown = view.mirrored(shown, signs)
        self._remember([world], shown, view, one)
        boxes, count = np.zeros((self.family.most_boxes, 7)), len(problem.racks)
        boxes[:count, :6], boxes[:count, 6] = view.boxes(shown.racks[0]), 1.0
        parts = view.region(shown)[0], boxes.ravel(), described(one), self.stack.anchor_mask[world]
        self._features[world] = np.clip(np.concatenate(parts), -1.0, 1.0)

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        rows, counts = np.flatnonzero(moving), self._counts
        last = np.ones_like(counts) if self.mode == "one-shot" else counts
        complete = moving & (self._epochs == last)
        step = self._epochs[rows] - 1
        if self.mode == "mounts":
            # Action k is the k-th mount of the observation.
            which = self._shown()[rows, actions[rows].astype(int)]
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

    def _next_anchor(self) -> np.ndarray:
        return super()._next_anchor() * self.stack.anchor_mask

    def _inform(self) -> dict[str, np.ndarray]:
        info, boxes = super()._inform(), self.stack.box_mask
        info["racks"] *= boxes[..., None]
        return {**info, "anchor_mask": self.stack.anchor_mask, "rack_mask": boxes}


class PlacementFamilyEnv(PlacementScalarEnv):
    """`AnchorPlacementEnv` with `scenes` instead of `scene`; these are the differences.

    Every reset draws a world: its scene, the number of anchors, the racks. M and K are the largest
    numbers of anchors and boxes in the family. `scenes` is as in `TaskFamily`.

    ## Observation space
    ``Box(-1, 1, (n,), float32)``, in this order:

    * centre and size of the region, scaled to the volume of the drawn scene (6);
    * a row for each obstacle of the scene and each rack: position and half size, scaled to the
      scene, then a 1; unused rows are zeros (7 K);
    * a description of the world (18), see `rbl_gym.placement.families.described`;
    * 1 for every anchor of this world (M);
    * as in `AnchorPlacementEnv`: actions so far (3 M), sight and taken mounts (57 each), which
      anchor is next, one-hot (M).

    ``mode="mounts"`` and `sight` need rooms in all scenes.

    ## Episode end
    Terminates with the last anchor of the drawn world.

    ## Info
    As in `AnchorPlacementEnv`, padded with zeros, and the masks `anchor_mask` (M,) and `rack_mask`
    (K,) of the existing anchors and boxes. The info of a reset also has `scene`, the drawn
    overrides as JSON text.
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
        observation: PlacementViewLike = "flat",
    ) -> None:
        self._configure(
            render_mode, scenes=scenes, mode=mode, racks=racks, n_anchors=n_anchors,
            mirror=mirror, sight=sight, observation=observation,
        )  # fmt: skip

    @property
    def family(self) -> TaskFamily:
        """The family from which every reset draws a task."""
        return self._batch.family

    @property
    def task(self) -> placement.PlacementTask:
        """The task of this episode."""
        return self._batch.tasks[0]

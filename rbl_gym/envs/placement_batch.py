"""Base classes of the environments that place anchors: spaces, episode arrays, views."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from rbl_gym import placement
from rbl_gym.checks import BoolArray, FloatArray, check_one_of
from rbl_gym.envs.batch import BatchEnv
from rbl_gym.envs.placement_views import PlacementViewer, PlacementViewLike, Placing
from rbl_gym.envs.scalar import ScalarEnv
from rbl_gym.geometry.regions import Region
from rbl_gym.placement.families import DESCRIBED, described
from rbl_gym.placement.problem import Context, PlacementTask
from rbl_gym.rendering import placement as rendering

# Mirror signs of a problem: neither, x, y, both.
_MIRRORS = ((1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, 1))
# Axes that may be mirrored.
_LEVEL = np.array([1.0, 1.0, 0.0])
MODES = ("sequential", "one-shot", "mounts")
# Initial score of the shaped reward with ``mode="mounts"``, metres.
EMPTY_SCORE_M = 3.0


class PlacementBatchEnv(BatchEnv):
    """Base of `AnchorPlacementVectorEnv` and `PlacementFamilyVectorEnv`.

    The ``__init__`` of a subclass calls `_check_flags`, `_plan` and `_configure`, then sets
    `_contexts` and `_counts`, and ends with `_look_by`.
    """

    render_fps = 2
    # The problems of the worlds, and their numbers of anchors (B,).
    _contexts: Context
    _counts: np.ndarray
    # None: the flat observation.
    _viewer: PlacementViewer | None = None

    def _check_flags(self, mode: str, mirror: bool, sight: bool) -> None:
        for name, value in (("mirror", mirror), ("sight", sight)):
            if not isinstance(value, bool):
                raise ValueError(f"{name} must be True or False, got {value!r:.80}")
        self.mode, self.mirror = check_one_of("mode", mode, MODES), mirror
        self.sight = sight or mode == "mounts"

    def _plan(self, task: PlacementTask, n_anchors: int, n_features: int) -> None:
        """Set the spaces for up to M anchors and a description of the problem by F numbers.

        The mirrored mounts of `task` are valid for all tasks, because mounts are at the same
        fractions of the walls in all rooms.
        """
        self._mounts = placement.mounts(task) if self.sight else np.empty((0, 3))
        mounts = len(self._mounts)
        if mounts:
            self._mirrored = _mirrored_mounts(task, self._mounts)
        size = n_features + mounts
        size += {"sequential": 4 * n_anchors, "one-shot": 0, "mounts": n_anchors + mounts}[
            self.mode
        ]
        self._shape = n_anchors, n_features
        self.single_observation_space = spaces.Box(-1.0, 1.0, (size,), np.float32)
        length = 3 * n_anchors if self.mode == "one-shot" else 3
        self.single_action_space = (
            spaces.Discrete(mounts)
            if self.mode == "mounts"
            else spaces.Box(-1.0, 1.0, (length,), np.float32)
        )
        self._placements = 1 if self.mode == "one-shot" else n_anchors

    def _configure(
        self,
        num_envs: int,
        render_mode: str | None,
        steps: int,
        max_episode_steps: int | None,
        autoreset_mode: str | AutoresetMode,
    ) -> None:
        self.film = rendering.film_of(render_mode, self._task_of, self._placements)
        super()._configure(num_envs, render_mode, steps, max_episode_steps, autoreset_mode)
        n_anchors, n_features = self._shape
        # Mirror signs of the axes as each problem is observed.
        self._signs = np.ones((num_envs, 3))
        # The observed problem, in the type of the observation.
        self._features = np.zeros((num_envs, n_features), np.float32)
        self._actions = np.zeros((num_envs, n_anchors, 3), np.float32)
        self._next = np.eye(n_anchors + 1, n_anchors, dtype=np.float32)
        self._anchors = np.zeros((num_envs, n_anchors, 3))
        self._score_m = np.zeros(num_envs)
        self._log_score = np.zeros(num_envs)
        self._seen = np.zeros((num_envs, len(self._mounts)))
        self._taken = np.zeros((num_envs, len(self._mounts)), dtype=np.bool_)

    def _look_by(self, observation: PlacementViewLike) -> None:
        """Set the observation to one of `PLACEMENT_OBSERVATIONS` or a custom view."""
        viewer = PlacementViewer(observation)
        if viewer.kind == "flat":
            return
        # The problems as they are observed, and the fixed points of their mirroring.
        self._observed = Context(*(np.zeros_like(field) for field in self._contexts))
        self._middle = np.zeros((self.num_envs, 3))
        self._description = np.zeros((self.num_envs, DESCRIBED))
        self._viewer = viewer
        example = copy.deepcopy(self)
        example._generators = []
        example._viewer = PlacementViewer("dict")
        example.reset(seed=0)
        self.single_observation_space = viewer.space_of(example._placing())
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def _remember(self, rows: Any, shown: Context, view: View, task: PlacementTask) -> None:
        """Store the observed problems of worlds that have just begun, for the viewer."""
        if self._viewer is not None:
            self._description[rows] = described(task)
            self._observed.centre[rows], self._observed.half[rows] = shown.centre, shown.half
            self._observed.racks[rows] = 0.0
            self._observed.racks[rows, : shown.racks.shape[-2]] = shown.racks
            self._middle[rows] = view.middle

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode, in the worlds with most anchors."""
        return min(self._placements, self.steps_limit)

    def _task_of(self, world: int) -> PlacementTask:
        """Return the present task of a world."""
        raise NotImplementedError

    def _shot(self) -> tuple[Any, None]:
        return rendering.Layout(self._contexts, self._anchors, self._placed()), None

    def _placed(self) -> np.ndarray:
        """Return the number of anchors (B,) that are placed."""
        placed = self._counts * self._epochs if self.mode == "one-shot" else self._epochs
        return np.minimum(placed, self._counts)

    def _clear(self, rows: Any) -> None:
        """Remove all anchors of some worlds."""
        self._actions[rows] = 0.0
        self._anchors[rows] = 0.0
        self._score_m[rows] = 0.0
        if self.mode == "mounts":
            self._taken[rows] = False
            self._log_score[rows] = math.log(EMPTY_SCORE_M)

    def _shown(self) -> np.ndarray:
        """Return the mount (B, 57) at each entry of the observation."""
        return self._mirrored[(self._signs[:, :2] < 0) @ np.array([1, 2])]

    def _next_anchor(self) -> np.ndarray:
        """Return the one-hot number (B, M) of the next anchor."""
        return self._next[self._epochs]

    def _observe(self) -> Any:
        return self._flat() if self._viewer is None else self._viewer(self._placing())

    def _flat(self) -> np.ndarray:
        parts: list[np.ndarray] = [self._features]
        if self.mode == "sequential":
            parts.append(self._actions.reshape(self.num_envs, -1))
        if self.sight:
            parts.append(np.take_along_axis(self._seen, self._shown(), axis=-1))
        if self.mode == "mounts":
            parts.append(np.take_along_axis(self._taken, self._shown(), axis=-1))
        if self.mode != "one-shot":
            parts.append(self._next_anchor())
        return np.concatenate(parts, axis=-1, dtype=np.float32)

    def _placing(self) -> Placing:
        """Return what a viewer converts; positions are mirrored as the problem is."""
        number = np.arange(self._shape[0])
        there = number < self._counts[:, None]
        placed = number < self._placed()[:, None]
        middle, signs = self._middle[:, None], self._signs[:, None]
        told = {
            "region": np.concatenate(self._observed[:2], axis=-1),
            "anchors": np.where(placed[..., None], middle + signs * (self._anchors - middle), 0.0),
            "anchor_mask": there.astype(np.int8),
            "placed": placed.astype(np.int8),
            "next": np.zeros_like(placed, np.int8),
        }
        if self.mode != "one-shot":
            told["next"] = self._next_anchor().astype(np.int8)
        if self._observed.racks.shape[-2]:
            mask = self._observed.racks[..., 3] > 0
            told["racks"], told["rack_mask"] = self._observed.racks.copy(), mask.astype(np.int8)
        if self.sight:
            order = self._shown()
            told["mounts"] = np.broadcast_to(self._mounts, (*order.shape, 3)).copy()
            told["sight"] = np.take_along_axis(self._seen, order, axis=-1)
            told["taken"] = np.take_along_axis(self._taken, order, axis=-1).astype(np.int8)
        tasks = tuple(map(self._task_of, range(self.num_envs)))
        return Placing(told, self._flat(), self._description.copy(), tasks)

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


class PlacementScalarEnv(ScalarEnv):
    """Base of `AnchorPlacementEnv` and `PlacementFamilyEnv`."""

    def action_masks(self) -> BoolArray:
        """Return the free mounts (57,) in the order of the actions; only with ``mode="mounts"``.

        Used by ``MaskablePPO`` of sb3-contrib.
        """
        return self._batch.action_masks()[0]


# --- views of a problem ----------------------------------------------------------------------


def is_symmetric(task: PlacementTask) -> bool:
    """Return whether problems may be mirrored: legal space and volume share their x-y centre."""
    centres = [_centre(region)[:2] for region in (task.scene.volume, task.scene.anchor_region)]
    # Permanent obstacles would have to be mirrored as well.
    return bool(np.allclose(*centres, atol=1e-9)) and not task.scene.weakens


def _centre(region: Region) -> FloatArray:
    low, high = region.bounds()
    return 0.5 * (low + high)


def _mirrored_mounts(task: PlacementTask, mounts: FloatArray) -> np.ndarray:
    """Return indices (4, 57) of the mounts mirrored in neither, x, y, both."""
    middle = _centre(task.scene.anchor_region) * _LEVEL
    moved = middle + np.array(_MIRRORS)[:, None] * (mounts - middle)
    return np.abs(moved[:, :, None] - mounts).sum(axis=-1).argmin(axis=-1)


class View:
    """How a task presents the problems of B worlds: mirrored, and scaled to about [-1, 1].

    Boxes are scaled to the space of the corners `low` and `high` (3,). `middle` (3,) is the fixed
    point of the mirroring.
    """

    def __init__(self, task: PlacementTask, low: FloatArray, high: FloatArray) -> None:
        volume = task.scene.volume
        self._centre = _centre(volume)
        self.middle = _centre(task.scene.anchor_region) * _LEVEL
        half = _half(*volume.bounds())
        # The half size of the region lies between zero and the half size of the volume.
        self._shift = np.concatenate([self._centre, 0.5 * half])
        self._scale = np.concatenate([half, 0.5 * half])
        self._box_shift = np.concatenate([0.5 * (low + high), np.zeros(3)])
        self._box_scale = np.tile(_half(low, high), 2)

    def signs(self, context: Context) -> FloatArray:
        """Return the signs (B, 3) of the axes that move the region's centre towards +x and +y."""
        signs = np.where(context.centre < self._centre, -1.0, 1.0)
        signs[..., 2] = 1.0
        return signs

    def mirrored(self, context: Context, signs: FloatArray) -> Context:
        """Return the problem mirrored by signs (B, 3), with its racks in descending order of x."""
        centre, racks = self.middle + signs * (context.centre - self.middle), context.racks
        if not racks.shape[-2]:
            return Context(centre, context.half, racks)
        racks = racks.copy()
        racks[..., :3] = self.middle + signs[:, None] * (racks[..., :3] - self.middle)
        if racks.shape[-2] > 1:
            order = (-racks[..., 0]).argsort(axis=-1, kind="stable")
            racks = racks[np.arange(len(racks))[:, None], order]
        return Context(centre, context.half, racks)

    def region(self, context: Context) -> FloatArray:
        """Return centre and half size of the region (B, 6), scaled to the volume."""
        return (np.concatenate([context.centre, context.half], axis=-1) - self._shift) / self._scale

    def boxes(self, boxes: FloatArray) -> FloatArray:
        """Return scaled boxes (B, K, 6)."""
        return (boxes - self._box_shift) / self._box_scale


def _half(low: FloatArray, high: FloatArray) -> FloatArray:
    return np.maximum(0.5 * (high - low), 1e-9)

"""Families of placement tasks: drawn scenes, numbers of anchors and racks."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Box, Shell, Walls, place_on_walls
from rbl_gym.measurements import ranging
from rbl_gym.placement.problem import (
    Context,
    PlacementTask,
    build_contexts,
    context_uniforms,
    mean_square,
    positions,
    root_of,
    task,
)
from rbl_gym.worlds import field_laws, scenes
from rbl_gym.worlds.families import members_of, padded

__all__ = ["TaskFamily", "described"]

# Position of missing boxes, which have no size and block nothing.
_NOWHERE = np.array([1e12, 1e12, 1e12, 0.0, 0.0, 0.0])
_KINDS = (Box, Walls, Shell)


@dataclass(frozen=True, eq=False)
class TaskFamily:
    """A family of placement tasks; every episode draws one of them.

    Parameters
    ----------
    members
        Scenes as in `rbl_gym.worlds.families.SceneFamily`. A dict may also have the key `racks`, a
        number or a random law. Its `n_anchors` is the number of anchors to place.
    n_anchors, racks
        Defaults for members that do not set them, see `rbl_gym.placement.task`.

    Raises
    ------
    ValueError
        If the list is empty, a law is invalid, or a task is invalid.
    """

    members: tuple[Any, ...]
    n_anchors: int | None = None
    racks: int = 0

    @functools.cached_property
    def corners(self) -> tuple[PlacementTask, ...]:
        """Tasks with all choices and both ends of all integers; other numbers are midpoints."""
        found: list[PlacementTask] = []
        for index, member in enumerate(self.members):
            found += [
                self._made(index, one) for one in field_laws.corners(member, f"scenes[{index}]")
            ]
        return tuple(found)

    @property
    def smallest(self) -> tuple[PlacementTask, ...]:
        """For each member a task with the fewest anchors."""
        found = []
        for index, member in enumerate(self.members):
            made = [
                self._made(index, one) for one in field_laws.corners(member, f"scenes[{index}]")
            ]
            found.append(min(made, key=lambda one: one.n_anchors))
        return tuple(found)

    @functools.cached_property
    def most_anchors(self) -> int:
        """Largest number of anchors of a task."""
        return max(one.n_anchors for one in self.corners)

    @functools.cached_property
    def most_boxes(self) -> int:
        """Largest number of boxes in a problem."""
        return max(len(one.scene.obstacles) + one.racks for one in self.corners)

    @functools.cached_property
    def most_tags(self) -> int:
        """Largest number of tags of a body."""
        return max(len(one.scene.tags) for one in self.corners)

    def draw(self, rng: np.random.Generator) -> tuple[PlacementTask, dict[str, Any]]:
        """Draw a task; return it with its overrides."""
        index = int(rng.integers(len(self.members))) if len(self.members) > 1 else 0
        member = field_laws.draw(self.members[index], rng)
        made = self._made(index, member)
        told = dict(member) if isinstance(member, Mapping) else {"name": made.scene.name}
        return made, {**told, "n_anchors": made.n_anchors, "racks": made.racks}

    def _made(self, index: int, member: Any) -> PlacementTask:
        try:
            if not isinstance(member, Mapping):
                return task(member, self.n_anchors, self.racks)
            fields = {key: value for key, value in member.items() if key != "racks"}
            n_anchors = member.get("n_anchors", self.n_anchors)
            return task(scenes.get(fields), n_anchors, member.get("racks", self.racks))
        except ValueError as error:
            raise ValueError(f"scenes[{index}]: {error}") from error


def task_family(value: Any, n_anchors: int | None = None, racks: int = 0) -> TaskFamily:
    """Return the family of a list of scenes, of one scene with laws, or of one scene."""
    if isinstance(value, TaskFamily):
        return value
    found = TaskFamily(members_of(value), n_anchors, racks)
    for one in found.corners:
        if len(one.scene.prisms) or one.scene.gain or one.scene.fixed:
            raise ValueError(
                "scenes must have no walls, no limits of range or view and no fixed anchors, but "
                f"{one.scene.name!r} (a building file) has; give a building as scene="
            )
    return found


# --- stacked tasks ----------------------------------------------------------------------------


class _Arrays(NamedTuple):
    """Numbers of tasks, each with a leading axis (B,)."""

    n_anchors: np.ndarray
    n_tags: np.ndarray
    n_boxes: np.ndarray
    tags: FloatArray
    laws: FloatArray
    prior: FloatArray
    blocked: FloatArray
    kind: np.ndarray
    low: FloatArray
    high: FloatArray


class StackedTasks:
    """The stacked tasks of B worlds, and their problems; the first of the family until `begin`."""

    def __init__(self, family: TaskFamily, num_envs: int) -> None:
        self.family = family
        first = family.corners[0]
        self.tasks = [first] * num_envs
        self._poses = first.poses
        self.arrays = _Arrays(*(np.stack([field] * num_envs) for field in _numbers(family, first)))
        shape = num_envs, family.most_boxes, 6
        self.contexts = Context(
            np.zeros((num_envs, 3)),
            np.zeros((num_envs, 3)),
            np.broadcast_to(_NOWHERE, shape).copy(),
        )

    def begin(self, world: int, rng: np.random.Generator) -> dict[str, Any]:
        """Draw a task and a problem of it; return the overrides of the task."""
        one, overrides = self.family.draw(rng)
        self.tasks[world] = one
        for held, field in zip(self.arrays, _numbers(self.family, one), strict=True):
            held[world] = field
        problem = build_contexts(one, rng.random(context_uniforms(one)))
        self.contexts.centre[world], self.contexts.half[world] = problem.centre, problem.half
        self.contexts.racks[world] = _NOWHERE
        self.contexts.racks[world, : len(problem.racks)] = problem.racks
        return overrides

    def problem(self, world: int) -> Context:
        """Return the problem of a world, without padding."""
        centre, half, racks = (field[world].copy() for field in self.contexts)
        return Context(centre, half, racks[: self.arrays.n_boxes[world]])

    @property
    def anchor_mask(self) -> np.ndarray:
        """(B, M), 1 for the anchors of a world."""
        return _mask(self.arrays.n_anchors, self.family.most_anchors)

    @property
    def box_mask(self) -> np.ndarray:
        """(B, K), 1 for the boxes of a world."""
        return _mask(self.arrays.n_boxes, self.family.most_boxes)

    def place(self, rows: np.ndarray, actions: FloatArray) -> FloatArray:
        """Return legal positions (R, K, 3) of actions (R, K, 3) of the worlds of some rows."""
        kinds = self.arrays.kind[rows]
        low, high = self.arrays.low[rows, None], self.arrays.high[rows, None]
        actions = np.clip(actions, -1.0, 1.0, dtype=np.float64)
        placed = 0.5 * (low + high) + actions * (0.5 * (high - low))
        walls = np.flatnonzero(kinds == _KINDS.index(Walls))
        if len(walls):
            placed[walls] = place_on_walls(actions[walls], low[walls], high[walls])
        for row in np.flatnonzero(kinds > _KINDS.index(Walls)):
            placed[row] = self.tasks[rows[row]].scene.anchor_region.place(actions[row])
        return placed

    def score(self, rows: np.ndarray, anchors: FloatArray, counted: np.ndarray) -> FloatArray:
        """Return `placement.score` (R,) of layouts (R, M, 3), of the anchors in a mask (R, M)."""
        square = np.empty(len(rows))
        for count in np.unique(self.arrays.n_tags[rows]).tolist():
            alike = self.arrays.n_tags[rows] == count
            own = rows[alike]
            problem = Context(*(field[own] for field in self.contexts))
            places = positions(self.family.corners[0], problem)
            share = np.broadcast_to(
                counted[alike, None].astype(np.float64), (*places.shape[:2], counted.shape[-1])
            )
            if self.family.most_boxes:
                blocked = self.arrays.blocked[own]
                share = share * Obstacles(problem.racks, blocked).share(anchors[alike], places)
            square[alike] = mean_square(
                anchors[alike], self._poses[0], places, self.arrays.tags[own, :count],
                self.arrays.prior[own], self.arrays.laws[own], share,
            )  # fmt: skip
        return root_of(square)


def _mask(counts: np.ndarray, most: int) -> np.ndarray:
    return (np.arange(most) < counts[:, None]).astype(np.int8)


def _numbers(family: TaskFamily, one: PlacementTask) -> tuple[Any, ...]:
    """Return the numbers of a task in the order of `_Arrays`."""
    scene = one.scene
    low, high = scene.anchor_region.bounds()
    kinds = (index for index, kind in enumerate(_KINDS) if isinstance(scene.anchor_region, kind))
    return (
        np.int64(one.n_anchors),
        np.int64(len(scene.tags)),
        np.int64(len(scene.obstacles) + one.racks),
        padded(scene.body, (family.most_tags, 3)),
        ranging.numbers_of(scene.noise, len(scene.tags)),
        one.prior_information,
        np.full((1, 1), scene.blocked_information),
        np.int64(next(kinds, len(_KINDS))),
        low,
        high,
    )


# --- description of a task for a policy -------------------------------------------------------

DESCRIBED = 18


def described(one: PlacementTask) -> FloatArray:
    """Return a description (18,) of a task's world, in [-1, 1].

    In this order:

    * kind of the permitted region, one-hot: box, walls, shell or other (4);
    * half sizes of the volume and of the permitted region, and the offset from the centre of the
      volume to that of the region, divided by the scene's extent (9); the extent is half the
      diagonal of the box around volume and anchors;
    * decimal logarithms, divided by 4, of three quantities (3): the extent in metres; sigma /
      radius; radius / extent. Here sigma is the noise of a range that is as long as the extent,
      and radius is that of the body;
    * number of tags divided by 16 (1);
    * fraction of the information that a blocked link keeps (1).
    """
    scene, extent = one.scene, float(one.scene.scales.extent)
    kinds = [isinstance(scene.anchor_region, kind) for kind in _KINDS]
    (a, b), (c, d) = scene.volume.bounds(), scene.anchor_region.bounds()
    radius = max(float(np.linalg.norm(scene.body, axis=-1).max()), 1e-6)
    noise = np.sqrt(scene.noise.variance(np.full((1, len(scene.tags)), extent)).mean())
    sizes = np.concatenate([b - a, d - c, (c + d) - (a + b)]) / (2 * extent)
    told = np.array([extent, max(noise, 1e-9) / radius, radius / extent])
    rest = [len(scene.tags) / 16, scene.blocked_information]
    return np.clip([*kinds, not any(kinds), *sizes, *np.log10(told) / 4, *rest], -1.0, 1.0)

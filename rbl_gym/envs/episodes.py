"""The running episodes of many worlds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.worlds import simulation
from rbl_gym.worlds.families import SceneFamily, padded
from rbl_gym.worlds.scene import Scene
from rbl_gym.worlds.stacked import StackedScenes

# Number of worlds built together, so that their intermediate results do not fill the memory.
_BLOCK = 1024


class EpisodeStore:
    """The running episodes of B worlds, as arrays with axes (T + 1, B, ...).

    The random numbers of the ranges stay where they were drawn, world by world; all other fields
    are stored epoch by epoch. A reset overwrites the arrays and does not allocate new ones, because
    fresh memory is slow.
    """

    def __init__(self, scene: Scene, num_envs: int) -> None:
        self._scene = scene
        self._num_envs = num_envs
        self._draws = simulation.empty_draws(scene, num_envs)
        # The fields of `simulation.Epoch`; the first ones are views of the motion.
        self._timed: list[FloatArray | None] = []
        self._moved: list[FloatArray] = []

    @property
    def empty(self) -> bool:
        """Whether no episode has begun yet."""
        return not self._timed

    def begin(
        self, worlds: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, FloatArray]:
        """Draw new episodes of some worlds, each from its own generator.

        Returns the fields of `simulation.Episode` without a time axis, of these worlds.
        """
        starts: list[Any] = []
        simulation.draw_each(self._draws, worlds, generators)
        for first in range(0, len(worlds), _BLOCK):
            block = worlds[first : first + _BLOCK]
            rows = rows_of(block)
            draws = simulation.Draws(*(field[rows] for field in self._draws))
            episode = simulation.build_episode(self._scene, draws, self._motion_of(rows))
            self._write(block, simulation.whole(episode))
            starts.append(episode[len(simulation.Epoch._fields) :])
        names = simulation.Episode._fields[len(simulation.Epoch._fields) :]
        return {
            # Copies: fields that are not random may be views of the scene's arrays.
            name: np.concatenate(parts)
            for name, parts in zip(names, zip(*starts, strict=True), strict=True)
        }

    def _motion_of(self, rows: slice | np.ndarray) -> simulation.Motion | None:
        """Return arrays for the motion of b worlds, (b, ...); of a slice, views."""
        if not self._timed:
            return None
        return simulation.Motion(*[np.swapaxes(field[:, rows], 0, 1) for field in self._moved])

    def _write(self, worlds: np.ndarray, fields: simulation.Epoch) -> None:
        """Store the epochs of some worlds; NumPy skips the assignment of a view to itself."""
        if not self._timed:
            self._moved = [self._empty(shape) for shape in simulation.motion_shapes(self._scene)]
            epochs = len(self._moved[2])
            self._timed = [
                *(held[-epochs:] for held in self._moved),
                *(
                    None if drawn is None else np.swapaxes(drawn, 0, 1)
                    for drawn in simulation.of_ranges(self._scene, self._draws)
                ),
                *(None if one is None else self._empty(one.shape[1:]) for one in fields[5:]),
            ]
        rows = rows_of(worlds)
        for stored, field in zip(self._timed, fields, strict=True):
            # Motion and random numbers are in place already: if the worlds are contiguous, and the
            # store is not a copy of another, whose arrays are no longer views of each other.
            if stored is not None and field is not None:
                stored[:, rows] = np.swapaxes(field, 0, 1)

    def _empty(self, shape: tuple[int, ...]) -> FloatArray:
        # Without the spare worlds, epochs of 1024 worlds would share lines of the cache.
        room = self._num_envs + self._num_envs // 256
        return np.empty((shape[0], room, *shape[1:]))[:, : self._num_envs]

    def at(self, epochs: np.ndarray) -> simulation.Epoch:
        """Return the epochs (B,) of all worlds; the random numbers must not be written to."""
        where = self._where(epochs)
        random = [None if field is None else field[where] for field in self._timed[3:]]
        return simulation.Epoch(*self._motion(where), *random)  # pyrefly: ignore[bad-argument-type]

    def motion_at(self, epochs: np.ndarray) -> simulation.Motion:
        """Return copies of the motion of all worlds at their epochs (B,)."""
        return self._motion(self._where(epochs))

    def _motion(self, where: Any) -> simulation.Motion:
        return simulation.Motion(*[np.array(field[where]) for field in self._timed[:3]])  # pyrefly: ignore[unsupported-operation]

    def _where(self, epochs: np.ndarray) -> Any:
        if self._num_envs == 1 or (epochs == epochs[0]).all():
            return epochs[0]
        return epochs, np.arange(self._num_envs)


class FamilyStore:
    """The running episodes of B worlds with different scenes, see `EpisodeStore`.

    World i draws its scene, then its episode, in the same order as the scalar environment. With
    `in_turn` worlds take the members of the family in turn instead. `stack` has the scenes.
    """

    def __init__(self, family: SceneFamily, num_envs: int, in_turn: bool = False) -> None:
        self._family = family
        self._in_turn = in_turn
        first = family.corners[0]
        self.stack = StackedScenes.of(family, [first] * num_envs)
        m, n, epochs = family.n_anchors, family.n_tags, family.steps + 1
        shapes = (3, 3), (3,), (6,), (m, n), (2, m, n)
        self._timed = [np.zeros((epochs, num_envs, *shape)) for shape in shapes]
        self._survey = np.zeros((epochs, num_envs, m, 3)) if family.is_surveyed else None

    def begin(
        self, worlds: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, np.ndarray]:
        """Draw new episodes as `EpisodeStore.begin`; return also the drawn overrides."""
        drawn, starts, scenes = [], [], []
        for world, generator in zip(worlds.tolist(), generators, strict=True):
            member = world % len(self._family.members) if self._in_turn else None
            scene, overrides = self._family.draw(generator, member)
            episode = simulation.draw_episode(scene, generator)
            self._write(world, simulation.whole(episode))
            anchors = padded(episode.anchors, (self._family.n_anchors, 3))
            starts.append((*episode[-4:-1], anchors))
            scenes.append(scene)
            drawn.append(json.dumps(overrides))
        self.stack = self.stack.replaced(worlds, scenes)
        names = simulation.Episode._fields[-4:]
        told = {
            name: np.stack(parts)
            for name, parts in zip(names, zip(*starts, strict=True), strict=True)
        }
        overrides = np.empty(len(drawn), dtype=object)
        overrides[:] = drawn
        return {**told, "scene": overrides}

    def _write(self, world: int, fields: simulation.Epoch) -> None:
        for stored, field in zip(self._timed, fields, strict=False):
            row = stored[:, world]
            row[...] = 0.0
            if field is not None:
                row[tuple(slice(size) for size in field.shape)] = field
        if self._survey is not None:
            self._survey[:, world] = 0.0
            if fields.survey is not None:
                steps, m, _ = fields.survey.shape
                self._survey[:steps, world, :m] = fields.survey

    def motion_at(self, epochs: np.ndarray) -> simulation.Motion:
        """Return copies of the motion of all worlds at their epochs (B,)."""
        where = epochs, np.arange(len(epochs))
        return simulation.Motion(*(field[where] for field in self._timed[:3]))

    def at(self, epochs: np.ndarray) -> simulation.Epoch:
        """Return the epochs (B,) of all worlds; the random numbers must not be written to."""
        where = epochs, np.arange(len(epochs))
        survey = None if self._survey is None else self._survey[where]
        return simulation.Epoch(*(field[where] for field in self._timed), survey=survey)


def rows_of(worlds: np.ndarray) -> slice | np.ndarray:
    """Return ascending indices, as a slice if they are contiguous."""
    first, last = worlds[0], worlds[-1]
    return slice(first, last + 1) if last - first + 1 == len(worlds) else worlds

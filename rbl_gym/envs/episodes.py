"""Episodes of many worlds in arrays that a step reads contiguous memory of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rbl_gym import simulation
from rbl_gym.checks import FloatArray
from rbl_gym.scenes import Scene

# Worlds that are drawn and built together: what they need on the way fits the cache.
_BLOCK = 128
# Fields of an episode that have a time axis.
_TIMED = simulation.Epoch._fields


class EpisodeStore:
    """The running episodes of B worlds, epochs first and worlds last: (T + 1, ..., B).

    Its arrays are written anew by every reset, not made anew: fresh memory is slow.
    """

    def __init__(self, scene: Scene, num_envs: int) -> None:
        self._scene = scene
        self._num_envs = num_envs
        self._timed: list[FloatArray | None] = []

    @property
    def empty(self) -> bool:
        """Whether no episode was ever begun."""
        return not self._timed

    def begin(
        self, worlds: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, FloatArray]:
        """New episodes of some worlds, each from its own generator.

        Returns the fields of `simulation.Episode` that have no time axis, of these worlds.
        """
        starts: list[list[FloatArray]] = []
        for first in range(0, len(worlds), _BLOCK):
            block = slice(first, first + _BLOCK)
            draws = simulation.draw_each(self._scene, generators[block])
            episode = simulation.build_episode(self._scene, draws)
            self._write(worlds[block], episode)
            starts.append(list(episode[len(_TIMED) :]))
        names = simulation.Episode._fields[len(_TIMED) :]
        return {
            name: np.concatenate(parts)
            for name, parts in zip(names, zip(*starts, strict=True), strict=True)
        }

    def _write(self, worlds: np.ndarray, episode: simulation.Episode) -> None:
        fields = episode[: len(_TIMED)]
        if not self._timed:
            self._timed = [
                None if field is None else np.empty((*field.shape[1:], self._num_envs))
                for field in fields
            ]
        first, last = worlds[0], worlds[-1]
        where = slice(first, last + 1) if last - first + 1 == len(worlds) else worlds
        for stored, field in zip(self._timed, fields, strict=True):
            if stored is not None:
                stored[..., where] = np.moveaxis(field, 0, -1)

    def at(self, epochs: np.ndarray) -> simulation.Epoch:
        """All worlds, each at its epoch (B,): views of the store where all clocks agree."""
        if (epochs == epochs[0]).all():
            fields = [f if f is None else np.moveaxis(f[epochs[0]], -1, 0) for f in self._timed]
        else:
            index = np.arange(self._num_envs)
            fields = [f if f is None else f[epochs, ..., index] for f in self._timed]
        return simulation.Epoch(*fields)  # pyright: ignore[reportArgumentType]

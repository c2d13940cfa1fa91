"""Films: what an environment showed at every epoch, and frames of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.rendering.drawing import Image

RENDER_MODES = ["rgb_array"]
# Shots beyond an episode's own: resets of some worlds repeat the epochs of the others.
_SPARE = 50


def check_mode(render_mode: str | None) -> str | None:
    """Return the render mode; raises ValueError if it is unknown."""
    if render_mode is not None and not (
        isinstance(render_mode, str) and render_mode in RENDER_MODES
    ):
        raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
    return render_mode


class Film:
    """The episodes of B worlds so far, as shown.

    Parameters
    ----------
    paint
        Draws a frame from the epochs of one world's episode: its shots and beliefs.
    steps
        Number of steps of an episode.
    """

    def __init__(self, paint: Callable[..., Image], steps: int) -> None:
        self._paint = paint
        self._taken: deque[list[Any]] = deque(maxlen=steps + _SPARE)

    def take(self, epochs: ArrayLike, shot: Any, belief: Any = None) -> None:
        """Store a copy of an epoch: fields have a leading axis of worlds."""
        self._taken.append([np.array(epochs), mapped(np.array, shot), mapped(np.array, belief)])

    def believe(self, belief: Any) -> None:
        """Store the beliefs after the last stored epoch."""
        self._taken[-1][2] = mapped(np.array, belief)

    def select(self, chosen: np.ndarray) -> None:
        """Set the anchors that measure in the last shot, in its field `measuring` (B, M).

        `chosen` may be padded.
        """
        shot = self._taken[-1][1]
        chosen = chosen[..., : shot.measuring.shape[-1]]
        self._taken[-1][1] = shot._replace(measuring=shot.measuring & chosen)

    def frame(self, world: int) -> Image:
        """Return a picture of a world at its present epoch.

        A wrapper gets an epoch after the environment. In between, the picture shows the last epoch
        with a known belief.
        """
        if not self._taken:
            raise gym.error.ResetNeeded("there is nothing to render yet: call reset() first")
        episode: list[tuple[int, Any, Any]] = []
        for epochs, shot, belief in reversed(self._taken):
            at = int(epochs[world])
            # Worlds that wait while others reset are stored again at the same epoch.
            if not episode or at != episode[-1][0]:
                episode.append((at, shot, belief))
            if at == 0:
                break
        episode.reverse()
        if episode[-1][2] is None and any(belief is not None for *_, belief in episode):
            episode.pop()
        epochs, shots, beliefs = zip(*episode, strict=True)
        return self._paint(world, np.array(epochs), shots, beliefs)


def mapped(function: Callable[[Any], Any], part: Any) -> Any:
    """Apply a function to every array of nested named tuples; None does not change."""
    if isinstance(part, tuple):
        return type(part)(*[mapped(function, field) for field in part])
    return None if part is None else function(part)


def picture(film: Film | None, num_envs: int | None = None) -> Any:
    """Return the result of ``render()``: a frame, a tuple of frames, or None without a film."""
    if film is None:
        gym.logger.warn(
            "render() was called without a render mode; give one to gym.make: "
            'render_mode="rgb_array"'
        )
        return None
    if num_envs is None:
        return film.frame(0)
    return tuple(film.frame(world) for world in range(num_envs))


def tell(env: Any, belief: Any, single: bool = False) -> None:
    """Show a belief, a named tuple of arrays, in the frames of an environment with rendering."""
    film = getattr(env.unwrapped, "film", None)
    if film is not None:
        film.believe(mapped(lambda field: field[None], belief) if single else belief)


def select(env: Any, chosen: np.ndarray) -> None:
    """Show only some anchors (..., M) as measuring, in an environment with rendering."""
    film = getattr(env.unwrapped, "film", None)
    if film is not None:
        film.select(chosen)

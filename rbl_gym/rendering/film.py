"""Films: what an environment showed, epoch by epoch, and frames of it."""

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
    """The render mode, or a ValueError."""
    if render_mode is not None and not (
        isinstance(render_mode, str) and render_mode in RENDER_MODES
    ):
        raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
    return render_mode


class Film:
    """The episodes of B worlds so far, as they were shown.

    Parameters
    ----------
    paint
        Draws a frame of the epochs of one world's episode, its shots, and the beliefs beside them.
    steps
        Of an episode.
    """

    def __init__(self, paint: Callable[..., Image], steps: int) -> None:
        self._paint = paint
        self._taken: deque[list[Any]] = deque(maxlen=steps + _SPARE)

    def take(self, epochs: ArrayLike, shot: Any, belief: Any = None) -> None:
        """Keep a copy of an epoch: fields have a leading axis of worlds."""
        self._taken.append([np.array(epochs), mapped(np.array, shot), mapped(np.array, belief)])

    def believe(self, belief: Any) -> None:
        """The beliefs after the last epoch that was taken."""
        self._taken[-1][2] = mapped(np.array, belief)

    def select(self, chosen: np.ndarray) -> None:
        """Of the last shot, which has a field `measuring` (B, M), only these anchors measure.

        `chosen` may be padded.
        """
        shot = self._taken[-1][1]
        chosen = chosen[..., : shot.measuring.shape[-1]]
        self._taken[-1][1] = shot._replace(measuring=shot.measuring & chosen)

    def frame(self, world: int) -> Image:
        """A picture of a world as it is now.

        A wrapper learns of an epoch after the environment; whoever asks in between sees the last
        epoch of which the belief is known.
        """
        if not self._taken:
            raise gym.error.ResetNeeded("nothing to render yet: call reset()")
        episode: list[tuple[int, Any, Any]] = []
        for epochs, shot, belief in reversed(self._taken):
            at = int(epochs[world])
            # Worlds that wait while others reset are taken again at the same epoch.
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
    """A function on every array of nested named tuples; None stays."""
    if isinstance(part, tuple):
        return type(part)(*[mapped(function, field) for field in part])
    return None if part is None else function(part)


def picture(film: Film | None, num_envs: int | None = None) -> Any:
    """What ``render()`` returns: a frame, of many worlds a tuple of them, None without a film."""
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
    """Show a belief, a named tuple of arrays, in the frames of an environment that is rendered."""
    film = getattr(env.unwrapped, "film", None)
    if film is not None:
        film.believe(mapped(lambda field: field[None], belief) if single else belief)


def select(env: Any, chosen: np.ndarray) -> None:
    """Show that only some anchors (..., M) of an environment that is rendered measure."""
    film = getattr(env.unwrapped, "film", None)
    if film is not None:
        film.select(chosen)

"""One world of a vector environment, as a scalar environment."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import rendering
from rbl_gym.envs.batch import BatchEnv, Observation, StatedLength, check_actions, check_options

# Index of the only world, and its mask.
_FIRST, _ALONE = np.zeros(1, dtype=np.intp), np.ones(1, dtype=np.bool_)


class ScalarEnv(StatedLength, gym.Env[Any, Any]):
    """One world of a `BatchEnv`, as a scalar environment.

    A subclass sets its `batch_class`. Its ``__init__`` passes the arguments to `_configure`.
    """

    batch_class: ClassVar[Any]
    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own form)
        "render_modes": rendering.RENDER_MODES,
        "render_fps": BatchEnv.render_fps,
    }

    def _configure(self, render_mode: str | None, **arguments: Any) -> None:
        self.render_mode = render_mode
        self._batch: Any = self.batch_class(
            num_envs=1, render_mode=render_mode, autoreset_mode="Disabled", **arguments
        )
        self.observation_space = self._batch.single_observation_space
        self.action_space = self._batch.single_action_space
        self.metadata = {**self.metadata, "render_fps": self._batch.render_fps}

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode."""
        return self._batch.episode_steps

    @property
    def film(self) -> rendering.Film | None:
        """The source of the frames, if there is a render mode."""
        return self._batch.film

    def render(self) -> Any:
        """Return a frame, (height, width, 3), uint8."""
        return rendering.picture(self.film)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; `options` must be empty."""
        check_options(options)
        super().reset(seed=seed)
        batch = self._batch
        batch._generators = [self.np_random]
        batch._epochs[0], batch._done[0] = 0, False
        start = batch._restart(_FIRST, batch._generators) or {}
        batch._shoot()
        info = {**scalars_of(batch._inform()), **scalars_of(start)}
        return first_of(batch._observe()), info

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one step."""
        # As `BatchEnv.step`, without the masks of many worlds.
        batch = self._batch
        if not batch._generators or batch._done[0]:
            raise gym.error.ResetNeeded("the episode is over or has not begun: call reset()")
        actions = check_actions("action", action, self.action_space)[None]
        batch._epochs[0] += 1
        reward, over = batch._advance(actions, _ALONE)
        terminated = bool(over[0])
        truncated = not terminated and bool(batch._epochs[0] >= batch.steps_limit)
        batch._done[0] = terminated or truncated
        batch._shoot()
        observation, info = first_of(batch._observe()), scalars_of(batch._inform())
        return observation, float(reward[0]), terminated, truncated, info


def first_of(observation: Observation) -> Observation:
    """Return the observation of the first world, not copied."""
    if isinstance(observation, dict):
        return {key: value[0] for key, value in observation.items()}
    return observation[0]


def scalars_of(info: dict[str, Any]) -> dict[str, Any]:
    """Return infos of the only world, with Python numbers."""
    return {key: value.item(0) if value.ndim == 1 else value[0] for key, value in info.items()}

"""Many worlds in arrays: seeding, autoreset and infos of the native vector environments.

Subclasses of `BatchEnv` implement four methods on arrays with a leading axis of worlds. `ScalarEnv`
runs the same code with one world. The scalar environment and world i of a vector environment
therefore always agree.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from rbl_gym import rendering
from rbl_gym.checks import BoolArray, FloatArray, as_array, check_count, check_one_of

Observation = Any
# More environments than any machine holds.
MOST_ENVS = 10**8


class StatedLength:
    """An environment whose `spec` states the length of its episodes.

    The length depends on the arguments of ``make``. A `max_episode_steps` in the registration would
    be the same for all of them, and its `TimeLimit` would cut the longer episodes.
    """

    _spec: EnvSpec | None = None

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode."""
        raise NotImplementedError

    @property
    def spec(self) -> EnvSpec | None:
        """The specification from which ``make`` made this, with the length of its episodes."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Store a specification and set the episode length in it."""
        if spec is not None:
            # `make_vec` passes fields of the specification again as arguments.
            kwargs = dict(spec.kwargs)
            kwargs.pop("max_episode_steps", None)
            spec = dataclasses.replace(spec, max_episode_steps=self.episode_steps, kwargs=kwargs)
        self._spec = spec


class BatchEnv(StatedLength, VectorEnv[Any, Any, Any]):
    """Base class of environments with many worlds in arrays.

    Seeding: ``reset(seed=s)`` seeds world i with ``s + i``. A list gives each world its own seed.
    Every world has its own generator and draws from it as the scalar environment does. World i
    therefore equals the scalar environment with the same seed in all episodes.

    Autoreset: with ``"NextStep"`` (default) the step after the end of an episode resets the world,
    ignores its action and returns reward 0. With ``"SameStep"`` the last step already returns the
    first observation of the next episode, and `info` has ``final_obs`` and ``final_info``. With
    ``"Disabled"`` the user calls ``reset(options={"reset_mask": mask})``.

    Subclasses call `_configure` at the end of their ``__init__``. Subclasses with rendering make
    their `film` before that.
    """

    single_observation_space: gym.Space[Any]
    single_action_space: gym.Space[Any]
    render_fps: ClassVar[int] = 20
    film: rendering.Film | None = None

    def _configure(
        self,
        num_envs: int,
        render_mode: str | None,
        steps: int,
        max_episode_steps: int | None,
        autoreset_mode: str | AutoresetMode,
    ) -> None:
        num_envs = check_count("num_envs", num_envs, most=MOST_ENVS)
        rendering.check_mode(render_mode)
        if max_episode_steps is not None:
            max_episode_steps = check_count("max_episode_steps", max_episode_steps)
        modes = [mode.value for mode in AutoresetMode]
        if not isinstance(autoreset_mode, AutoresetMode):
            autoreset_mode = AutoresetMode(check_one_of("autoreset_mode", autoreset_mode, modes))
        self.num_envs = num_envs
        self.render_mode = render_mode
        # One for all worlds; environments of families make it an array.
        self.steps_limit: Any = min(steps, max_episode_steps or steps)
        self.metadata = {
            "render_modes": rendering.RENDER_MODES,
            "render_fps": self.render_fps,
            "autoreset_mode": autoreset_mode,
        }
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.autoreset_mode = autoreset_mode
        self._generators: list[np.random.Generator] = []
        self._done = np.zeros(num_envs, dtype=np.bool_)
        self._epochs = np.zeros(num_envs, dtype=np.int64)

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode."""
        return self.steps_limit

    # --- methods of a subclass -------------------------------------------------------------------

    def _restart(
        self, chosen: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, np.ndarray] | None:
        """Start new episodes in the worlds with these indices.

        May return infos of these worlds that exist only at the start of an episode; the caller may
        keep and change them."""
        raise NotImplementedError

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Step the worlds of the mask; return new arrays of rewards and terminations of all worlds.

        At least one world is stepped."""
        raise NotImplementedError

    def _observe(self) -> Observation:
        """Return observations of all worlds; the caller may keep and change them.

        Called once after each `_restart` or `_advance`, as is `_inform`."""
        raise NotImplementedError

    def _inform(self) -> dict[str, np.ndarray]:
        """Return infos of all worlds; the caller may keep and change them."""
        raise NotImplementedError

    def _shot(self) -> tuple[Any, Any]:
        """Return what the film stores of an epoch, and the beliefs if the worlds have their own."""
        raise NotImplementedError

    # --- the Gymnasium interface -----------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start all episodes, or those of the mask in ``options={"reset_mask": mask}``."""
        mask = reset_mask(options, self.num_envs)
        seeds = seeds_of(seed, self.num_envs)
        if not self._generators:
            if not mask.all():
                raise gym.error.ResetNeeded(
                    "call reset() for all environments before resetting some of them"
                )
            self._generators = [seeding.np_random(one)[0] for one in seeds]
        else:
            for i in np.flatnonzero(mask):
                if seeds[i] is not None:
                    self._generators[i] = seeding.np_random(seeds[i])[0]
        start = self._begin(mask)
        self._shoot()
        return self._observe(), {**self._masked_info(), **start}

    def step(
        self, actions: ArrayLike
    ) -> tuple[Observation, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Step every world; the autoreset mode says what happens after the end of an episode."""
        if not self._generators:
            raise gym.error.ResetNeeded("call reset() before step()")
        checked = check_actions("actions", actions, self.single_action_space, self.num_envs)
        moving = ~self._done
        all_move = moving.all()
        if not all_move and self.autoreset_mode is AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded(
                "some episodes are over: call reset(), with options={'reset_mask': mask} to "
                "reset only these"
            )
        self._epochs += moving
        if all_move:
            reward, terminated = self._advance(checked, moving)
        else:
            reward, terminated = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=np.bool_)
            if moving.any():
                advanced, over = self._advance(checked, moving)
                reward, terminated = np.where(moving, advanced, 0.0), over & moving
        truncated = moving & ~terminated & (self._epochs >= self.steps_limit)
        self._done = terminated | truncated
        start = {} if all_move else self._begin(~moving)
        self._shoot()
        if self.autoreset_mode is not AutoresetMode.SAME_STEP or not self._done.any():
            info = {**self._masked_info(), **start}
            return self._observe(), reward, terminated, truncated, info
        last = self._done.copy()
        final = {
            "final_obs": _rows_as_objects(self._observe(), last),
            "final_info": self._masked_info(last),
        }
        start = self._begin(last)
        self._shoot()
        info = {**self._masked_info(), **start}
        for name, value in final.items():
            info[name], info[f"_{name}"] = value, last.copy()
        return self._observe(), reward, terminated, truncated, info

    def render(self) -> Any:
        """Return a frame of every world, (height, width, 3), uint8."""
        return rendering.picture(self.film, self.num_envs)

    def _shoot(self) -> None:
        if self.film is not None:
            self.film.take(self._epochs, *self._shot())

    def _begin(self, mask: BoolArray) -> dict[str, np.ndarray]:
        """Start new episodes in the worlds of the mask; return their start infos with masks."""
        chosen = np.flatnonzero(mask)
        self._epochs[chosen] = 0
        self._done[chosen] = False
        info: dict[str, np.ndarray] = {}
        told = self._restart(chosen, [self._generators[i] for i in chosen])
        for name, value in (told or {}).items():
            info[name] = value
            if len(chosen) < self.num_envs:
                nothing = None if value.dtype == np.object_ else 0
                info[name] = np.full((self.num_envs, *value.shape[1:]), nothing, value.dtype)
                info[name][chosen] = value
            info[f"_{name}"] = mask.copy()
        return info

    def _masked_info(self, where: BoolArray | None = None) -> dict[str, Any]:
        """Return infos with Gymnasium's masks ``_key``; values outside of `where` are zero."""
        info: dict[str, Any] = {}
        told = np.ones(self.num_envs, dtype=np.bool_) if where is None else where
        for name, value in self._inform().items():
            if where is not None:
                value[~where] = 0
            info[name], info[f"_{name}"] = value, told.copy()
        return info


def check_actions(
    name: str, actions: ArrayLike, space: gym.Space[Any], num_envs: int | None = None
) -> np.ndarray:
    """Return actions of a space, for `num_envs` worlds if given, as a finite array.

    Raises ValueError for anything else. Actions of a box are float64 and may lie outside of the
    box.
    """
    shape = space.shape or ()
    shape = shape if num_envs is None else (num_envs, *shape)
    array = actions if isinstance(actions, np.ndarray) else as_array(name, actions)
    # Learners pass binary choices as floating-point zeros and ones.
    whole = isinstance(space, gym.spaces.Discrete)
    if array.shape != shape or array.dtype.kind not in ("iub" if whole else "fiub"):
        kind = "integers" if whole else "numbers"
        raise ValueError(
            f"{name} must be {kind} of shape {shape}, got shape {array.shape} and dtype "
            f"{array.dtype}"
        )
    # One product usually shows that all values are finite. It may overflow.
    if array.dtype.kind == "f" and not (
        math.isfinite(np.vdot(array, array)) or np.isfinite(array).all()
    ):
        raise ValueError(f"{name} must be finite, got {array[~np.isfinite(array)][0]}")
    if isinstance(space, gym.spaces.Box):
        return array.astype(np.float64)
    if array.dtype.kind == "b" and not whole:
        return array.astype(space.dtype)
    # Check before the cast: a narrow type would wrap large numbers into the space.
    if isinstance(space, gym.spaces.Discrete):
        legal = (array >= space.start) & (array < space.start + space.n)
    else:
        legal = (array == 0) | (array == 1)
    if not legal.all():
        raise ValueError(f"{name} must lie in {space}, got {array!r:.120}")
    return array.astype(space.dtype)


def reset_mask(options: dict[str, Any] | None, num_envs: int) -> BoolArray:
    """Return the worlds that ``options={"reset_mask": mask}`` resets; all worlds without a mask."""
    check_options(options, ("reset_mask",))
    if not options:
        return np.ones(num_envs, dtype=np.bool_)
    mask = as_array("reset_mask", options["reset_mask"])
    if mask.shape != (num_envs,) or mask.dtype != np.bool_ or not mask.any():
        raise ValueError(
            f"reset_mask must be ({num_envs},) booleans, at least one True, "
            f"got shape {mask.shape} of {mask.dtype}"
        )
    return mask


def check_options(options: Any, known: tuple[str, ...] = ()) -> None:
    """Raise ValueError if options of a reset are not a dict or have an unknown key."""
    if options is None:
        return
    if not isinstance(options, Mapping):
        raise ValueError(f"options must be a dict or None, got {options!r:.80}")
    for key in options:
        if key not in known:
            raise ValueError(
                f"options may only have the keys {', '.join(known)}, got {key!r:.80}"
                if known
                else f"options must be empty or None, got {key!r:.80}"
            )


def seeds_of(seed: int | Sequence[int | None] | None, num_envs: int) -> list[int | None]:
    """Return a seed for each world: s, s + 1, ... for a number s; a list is returned unchanged."""
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, int | np.integer):
        return [_seed(int(seed) + i) for i in range(num_envs)]
    if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str | bytes):
        raise ValueError(f"seed must be an int, a list of ints or None, got {seed!r:.80}")
    if np.shape(seed)[:1] != (num_envs,) if isinstance(seed, np.ndarray) else len(seed) != num_envs:
        raise ValueError(f"seed must have {num_envs} seeds, one for each world, got {seed!r:.80}")
    return [_seed(one) for one in seed]


def _seed(seed: Any) -> int | None:
    if seed is not None and (not isinstance(seed, int | np.integer) or seed < 0):
        raise ValueError(f"seed must be a non-negative int or None, got {seed!r:.80}")
    return None if seed is None else int(seed)


def _rows_as_objects(observation: Observation, where: BoolArray) -> np.ndarray:
    """Return Gymnasium's ``final_obs``: an object array with the observations of ended worlds."""
    rows = np.full(len(where), None, dtype=object)
    for i in np.flatnonzero(where):
        rows[i] = _row(observation, int(i))
    return rows


def _row(observation: Observation, i: int) -> Observation:
    if isinstance(observation, dict):
        return {key: value[i].copy() for key, value in observation.items()}
    return observation[i].copy()

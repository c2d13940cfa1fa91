"""Custom functions as observations and rewards: import by path, spaces, checks of values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from rbl_gym.checks import all_finite, did_you_mean, imported

# Values without bounds. These bounds are finite and never reached.
FAR = 1e9


def chosen_view(observation: Any, names: tuple[str, ...]) -> tuple[str, Any]:
    """Return the kind of an argument `observation`, and its function.

    The kind is one of `names`, with None; or ``"own"``, with the function itself or that of
    ``"module:function"``. Otherwise raises ValueError.
    """
    if callable(observation):
        return "own", observation
    if isinstance(observation, str) and observation in names:
        return observation, None
    if isinstance(observation, str) and ":" in observation:
        return "own", imported("observation", observation)
    raise ValueError(
        f"observation must be one of {', '.join(map(repr, names))}, 'module:function' or a "
        f"function, got {observation!r:.80}{did_you_mean(observation, names)}"
    )


def space_like(value: Any) -> spaces.Space[Any]:
    """Return the space of arrays like this one, or of dicts of such arrays."""
    if isinstance(value, Mapping):
        return spaces.Dict({key: _box_like(one) for key, one in value.items()})
    return _box_like(value)


def _box_like(value: Any) -> spaces.Box:
    """Return a box for arrays like this one: floating-point numbers become float32."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"observation must return numbers, got {value!r:.80}")
    if array.dtype.kind == "f":
        return spaces.Box(-FAR, FAR, array.shape, np.float32)
    info = np.iinfo(np.int8 if array.dtype.kind == "b" else array.dtype)
    return spaces.Box(info.min, info.max, array.shape, info.dtype.type)


def fitted(shown: Any, batch: tuple[int, ...], space: spaces.Space[Any] | None) -> Any:
    """Return an observation of worlds with leading axes `batch` as copies in the types of a space.

    Raises ValueError if it does not fit the space.
    """
    if not isinstance(space, spaces.Dict):
        return _fitted("observation", shown, batch, space)
    if not isinstance(shown, Mapping) or set(shown) != set(space):
        raise ValueError(
            f"observation must return a dict with {', '.join(space)}, got {shown!r:.80}"
        )
    return {
        key: _fitted(f"observation[{key!r}]", shown[key], batch, one) for key, one in space.items()
    }


def _fitted(name: str, value: Any, batch: tuple[int, ...], space: Any) -> np.ndarray:
    array = np.array(value)
    shape = (*batch, *space.shape)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if array.dtype.kind not in "fiub" or not all_finite(array.astype(np.float64)):
        raise ValueError(f"{name} must hold finite numbers, got {value!r:.80}")
    return array.astype(space.dtype)

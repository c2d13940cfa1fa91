"""Observations of `RBL/AnchorPlacement-v0` other than the flat vector."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from rbl_gym.envs.custom import FAR, chosen_view, fitted, space_like
from rbl_gym.placement.problem import PlacementTask

__all__ = ["PLACEMENT_OBSERVATIONS", "Placing", "placement_tokens"]

PLACEMENT_OBSERVATIONS = ("flat", "dict", "tokens")
# Tokens are of order one. Values far outside carry no more information.
_LIMIT = 10.0


class Placing(NamedTuple):
    """A placement in progress as input of a view. All arrays have a leading axis (B,) of worlds.

    In the scalar environment B is 1. The result of the view must have this axis, too. If the
    environment mirrors the problem (`AnchorPlacementEnv`), positions are mirrored in the same way.

    Attributes
    ----------
    observation
        The ``"dict"`` observation.
    flat
        The ``"flat"`` observation.
    description
        Descriptions of the worlds (B, 18), see `rbl_gym.placement.families.described`.
    tasks
        The tasks of the worlds, with their `scene`.
    """

    observation: Mapping[str, np.ndarray]
    flat: np.ndarray
    description: np.ndarray
    tasks: tuple[PlacementTask, ...]


PlacementView = Callable[[Placing], Any]
PlacementViewLike = str | PlacementView


def placement_tokens(placing: Placing) -> dict[str, np.ndarray]:
    """Return tokens of the problem and of each anchor, obstacle and mount, with masks; float32.

    For policies with attention. Padded rows are tokens of zeros with a mask of 0. Positions are
    relative to the centre of the work region and divided by the scene's extent.

    - `problem` (..., 24): centre and size of the region, scaled to the volume (6); the
      description of the world (18).
    - `anchor_tokens` (..., M, 5): position (3); whether it is placed; whether it is the next.
      Anchors that are not placed have the position 0.
    - `obstacle_tokens` (..., K, 6), if there are any: centre and half size.
    - `mount_tokens` (..., 57, 5), with ``mode="mounts"`` or `sight`: position (3); fraction of the
      poses that it sees; whether it is taken.
    - `anchor_mask` (..., M), `obstacle_mask` (..., K), int8.
    """
    told, tasks = placing.observation, placing.tasks
    extent = np.array([float(task.scene.scales.extent) for task in tasks])[:, None, None]
    centre = told["region"][..., None, :3]
    placed = told["placed"][..., None]
    there = (told["anchors"] - centre) / extent
    shown = {
        "problem": [placing.flat[..., :6], placing.description],
        "anchor_tokens": [there * placed, placed, told["next"][..., None]],
    }
    tokens = {"anchor_mask": told["anchor_mask"]}
    if "racks" in told:
        boxes, mask = told["racks"], told["rack_mask"]
        middle = (boxes[..., :3] - centre) / extent * mask[..., None]
        shown["obstacle_tokens"] = [middle, boxes[..., 3:] / extent]
        tokens["obstacle_mask"] = mask
    if "mounts" in told:
        places = (told["mounts"] - centre) / extent
        shown["mount_tokens"] = [places, told["sight"][..., None], told["taken"][..., None]]
    for name, parts in shown.items():
        tokens[name] = np.clip(np.concatenate(parts, axis=-1), -_LIMIT, _LIMIT).astype(np.float32)
    return tokens


class PlacementViewer:
    """Converts placements in progress to observations.

    Parameters
    ----------
    observation
        ``"dict"``, ``"tokens"``, ``"module:function"`` or a function.
    """

    def __init__(self, observation: PlacementViewLike) -> None:
        self.kind, self._function = chosen_view(observation, PLACEMENT_OBSERVATIONS)
        self.space: spaces.Space[Any] | None = None

    def space_of(self, placing: Placing) -> spaces.Space[Any]:
        """Return the observation space of one world; `placing` is an example of worlds."""
        declared = getattr(self._function, "space", None)
        if isinstance(declared, spaces.Space):
            self.space = declared
        else:
            shown = self._shown(placing)
            rows = shown if isinstance(shown, Mapping) else {"": shown}
            for key, value in rows.items():
                if np.shape(value)[:1] != (len(placing.tasks),):
                    name = f"observation[{key!r}]" if key else "observation"
                    raise ValueError(
                        f"{name} must have a leading axis of worlds, ({len(placing.tasks)}, ...), "
                        f"got shape {np.shape(value)}"
                    )
            first = {key: np.asarray(value)[0] for key, value in rows.items()}
            if self.kind == "own":
                self.space = space_like(first if isinstance(shown, Mapping) else first[""])
            else:
                self.space = spaces.Dict({key: self._named(one) for key, one in first.items()})
        return self.space

    def __call__(self, placing: Placing) -> Any:
        """Return observations; the caller may keep them."""
        shown = self._shown(placing)
        return shown if self.kind != "own" else fitted(shown, (len(placing.tasks),), self.space)

    def _shown(self, placing: Placing) -> Any:
        if self.kind == "tokens":
            return placement_tokens(placing)
        return dict(placing.observation) if self.kind == "dict" else self._function(placing)

    def _named(self, value: np.ndarray) -> spaces.Space[Any]:
        if value.dtype == np.int8:
            return spaces.MultiBinary(value.shape)
        limit = _LIMIT if self.kind == "tokens" else FAR
        return spaces.Box(-limit, limit, value.shape, value.dtype.type)

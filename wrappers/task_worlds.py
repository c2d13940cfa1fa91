"""The worlds of learning tasks: one scene, or a family of scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rbl_gym.worlds import scenes
from rbl_gym.worlds.families import SceneFamily, family
from rbl_gym.worlds.scene import Scene
from rbl_gym.worlds.scene_source import changes_in
from rbl_gym.wrappers.estimate import FilterLike, check_options_of, named_filter

# Observations are of order one. Values far outside carry no more information.
LIMIT = 10.0
# Iterations of the iterated EKF. Two are as accurate as four here, and faster.
_ITERATIONS = 2


Defaults = Callable[[Mapping[str, Any]], Mapping[str, Any]]


def world_of(scene: Any, defaults: Defaults) -> Scene:
    """Return the scene; `defaults` of its overrides apply to fields that it does not set."""
    return scenes.get(_with(defaults, scene))


def _with(defaults: Defaults, scene: Any) -> Any:
    changes = {"name": scene} if isinstance(scene, str) else scene
    if not isinstance(changes, Mapping):
        return changes
    name = changes.get("name")
    file = changes_in(name) if isinstance(name, str) else None
    told = changes if file is None else {**file, **changes, "name": file["name"]}
    usual = defaults(told)
    return {**{key: usual[key] for key in usual if key not in told}, **changes}


def family_of_task(value: Any, scene: Any, usual: Any, defaults: Defaults) -> SceneFamily | None:
    """Return the family of `scenes` (None without one); `defaults` as in `world_of`.

    Raises ValueError if it comes with a `scene` other than the `usual` one.
    """
    if value is None:
        return None
    if scene != usual:
        raise ValueError(f"scene must be left out if scenes is given, got {scene!r:.80}")
    return family([_with(defaults, one) for one in family(value).members])


class Usual:
    """Usual values of a scene, or the largest of a family: variances of the prior, speed."""

    def __init__(self, *worlds: Scene) -> None:
        self.variance = np.max([np.diagonal(one.prior_covariance) for one in worlds], axis=0)
        speeds = [(one.speed_m_s, float(np.abs(one.twist[3:]).max())) for one in worlds]
        self.speed = max(np.max(speeds), 1e-3)


def filter_of_task(
    filter: FilterLike, options: Mapping[str, Any] | None
) -> tuple[FilterLike, Mapping[str, Any] | None]:
    """Return filter and options; the task's own if none are given."""
    name, told = named_filter(filter, options)
    usual = {"iterations": _ITERATIONS} if isinstance(name, str) and name == "iekf" else {}
    return name, {**usual, **check_options_of(told)}


def worlds_of(batch: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Return indices to put before those (B, M) of each world's anchors."""
    return tuple(np.arange(n)[:, None] for n in batch)

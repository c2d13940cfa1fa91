"""Families of scenes: a list of scenes, or scenes with fields that are drawn anew."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbl_gym.checks import check_array, check_number
from rbl_gym.worlds import scenes
from rbl_gym.worlds.scene import Scene

__all__ = ["SceneFamily", "family"]

# Every combination of choices and ends of integers is tried when a family is made, up to so many.
_MOST_CORNERS = 10_000


@dataclass(frozen=True, eq=False)
class SceneFamily:
    """Scenes of which one is drawn for every episode.

    Parameters
    ----------
    members
        One of them is drawn, each as likely as the others: a name, a `Scene`, or a dict of
        overrides (`rbl_gym.worlds.scenes.get`). In a dict any value, at any depth, may be a law
        to draw it by:

        - ``{"uniform": [low, high]}`` and ``{"log-uniform": [low, high]}``: a number;
        - ``{"integers": [low, high]}``: a whole number, both ends included;
        - ``{"choice": [a, b, ...]}``: one of these values, each as likely as the others.

    Raises
    ------
    ValueError
        On an empty list, a law that is none, or a scene that cannot be made.
    """

    members: tuple[Any, ...]

    def __post_init__(self) -> None:
        if not self.members:
            raise ValueError("scenes must hold at least one scene, got none")
        for scene in self.corners:
            if scene.inertial is not None:
                raise ValueError(
                    "scenes must have no inertial sensor: its readings have a shape of their own "
                    f"in every scene, got one in {scene.name!r}"
                )
            if scene.survey_std_m > 0:
                raise ValueError(
                    "scenes must have survey_std_m = 0, got "
                    f"{scene.survey_std_m:g} in {scene.name!r}"
                )
            if scene.links.offset is not None:
                raise ValueError(
                    "scenes must have ranges without an offset, got links.offset "
                    f"{scene.links.offset!r} in {scene.name!r}"
                )

    @functools.cached_property
    def corners(self) -> tuple[Scene, ...]:
        """A scene of every choice and of both ends of all integers; other numbers in the middle."""
        found: list[Scene] = []
        for index, member in enumerate(self.members):
            if not isinstance(member, Mapping):
                found.append(_made(index, member))
                continue
            laws = list(_laws_in(member, f"scenes[{index}]"))
            ends = [law.ends for law in laws]
            if math.prod(map(len, ends)) > _MOST_CORNERS:
                raise ValueError(
                    f"scenes[{index}] must have at most {_MOST_CORNERS} combinations of choices, "
                    f"got {math.prod(map(len, ends))}"
                )
            for values in itertools.product(*ends):
                found.append(_made(index, _filled(member, iter(values))))
        return tuple(found)

    @functools.cached_property
    def n_anchors(self) -> int:
        """The most anchors of a scene."""
        return max(scene.n_anchors for scene in self.corners)

    @functools.cached_property
    def n_tags(self) -> int:
        """The most tags of a body."""
        return max(len(scene.tags) for scene in self.corners)

    @functools.cached_property
    def n_boxes(self) -> int:
        """The most obstacles of a scene."""
        return max(len(scene.obstacles) for scene in self.corners)

    @property
    def steps(self) -> int:
        """Steps of the longest episode."""
        return max(scene.steps for scene in self.corners)

    @property
    def anchor_speed_m_s(self) -> float:
        """The highest speed of an anchor; 0: they are fixed in all scenes."""
        return max(scene.anchor_speed_m_s for scene in self.corners)

    @functools.cached_property
    def fields(self) -> dict[str, tuple[tuple[int, ...], type]]:
        """Shapes and types of what `RBL/Tracking-v0` observes of any of the scenes."""
        m, n = self.n_anchors, self.n_tags
        fields: dict[str, tuple[tuple[int, ...], type]] = {
            "anchors": ((m, 3), np.float64),
            "twist": ((6,), np.float64),
            "ranges": ((m, n), np.float64),
            "links": ((m, n), np.int8),
            "tags": ((n, 3), np.float64),
            "anchor_mask": ((m,), np.int8),
            "tag_mask": ((n,), np.int8),
        }
        if any(scene.obstacles for scene in self.corners):
            fields["quality"] = ((m,), np.float64)
        return fields

    def padded(self, told: Mapping[str, np.ndarray], scene: Scene) -> dict[str, np.ndarray]:
        """What a scene of the family observes, in arrays of the family's shapes, and its masks."""
        told = {
            **told,
            "tags": scene.body,
            "anchor_mask": np.ones(scene.n_anchors, np.int8),
            "tag_mask": np.ones(len(scene.tags), np.int8),
        }
        if "quality" in self.fields and "quality" not in told:
            told["quality"] = np.ones(scene.n_anchors)
        return {key: padded(told[key], shape) for key, (shape, _) in self.fields.items()}

    def draw(
        self, rng: np.random.Generator, index: int | None = None
    ) -> tuple[Scene, dict[str, Any]]:
        """A scene, and the overrides that make it (`rbl_gym.worlds.scenes.get` takes them).

        Of the member with this index; None: of any. A member that is a `Scene` is told by its name
        alone.
        """
        if index is None:
            index = int(rng.integers(len(self.members))) if len(self.members) > 1 else 0
        member = self.members[index]
        if isinstance(member, Mapping):
            laws = _laws_in(member, f"scenes[{index}]")
            member = _filled(member, (law.draw(rng) for law in laws))
        scene = _made(index, member)
        return scene, dict(member) if isinstance(member, Mapping) else {"name": scene.name}


def family(value: Any) -> SceneFamily:
    """The family of a list of scenes, of one scene with laws, or of one scene alone."""
    if isinstance(value, SceneFamily):
        return value
    alone = isinstance(value, str | Mapping | Scene)
    if not alone and not isinstance(value, Sequence):
        raise ValueError(
            f"scenes must be a list of scenes, a name or a dict of overrides, got {value!r:.80}"
        )
    return SceneFamily((value,) if alone else tuple(value))


def padded(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The array in the corner of zeros of a shape, a copy."""
    result = np.zeros(shape, array.dtype)
    result[tuple(slice(size) for size in array.shape)] = array
    return result


# --- laws -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Law:
    """How a value is drawn, and the values that stand for all of them in the corners."""

    draw: Callable[[np.random.Generator], Any]
    ends: tuple[Any, ...]


def _uniform(path: str, value: Any) -> _Law:
    low, high = _limits(path, value)
    return _Law(lambda rng: float(rng.uniform(low, high)), (0.5 * (low + high),))


def _log_uniform(path: str, value: Any) -> _Law:
    low, high = _limits(path, value)
    check_number(f"{path}[0]", low, low=1e-300)
    a, b = math.log(low), math.log(high)
    return _Law(lambda rng: math.exp(rng.uniform(a, b)), (math.exp(0.5 * (a + b)),))


def _integers(path: str, value: Any) -> _Law:
    low, high = _limits(path, value)
    if low != int(low) or high != int(high):
        raise ValueError(f"{path} must be two whole numbers, got {value!r:.80}")
    ends = (int(low), int(high))
    return _Law(lambda rng: int(rng.integers(ends[0], ends[1] + 1)), tuple(dict.fromkeys(ends)))


def _choice(path: str, value: Any) -> _Law:
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ValueError(f"{path} must be a list of values, got {value!r:.80}")
    values = tuple(value)
    return _Law(lambda rng: values[int(rng.integers(len(values)))], values)


_LAWS: dict[str, Callable[[str, Any], _Law]] = {
    "uniform": _uniform,
    "log-uniform": _log_uniform,
    "integers": _integers,
    "choice": _choice,
}


def _limits(path: str, value: Any) -> tuple[float, float]:
    low, high = check_array(path, value, (2,)).tolist()
    if low > high:
        raise ValueError(f"{path} must be [low, high], got {value!r:.80}")
    return low, high


def _law_of(value: Any, path: str) -> _Law | None:
    """The law that a dict with one key of `_LAWS` is; None of what is none."""
    if not isinstance(value, Mapping) or len(value) != 1:
        return None
    kind = next(iter(value))
    return _LAWS[kind](f"{path}.{kind}", value[kind]) if kind in _LAWS else None


def _laws_in(value: Any, path: str) -> Iterator[_Law]:
    """The laws of a nested dict, in its order."""
    if not isinstance(value, Mapping):
        return
    law = _law_of(value, path)
    if law is not None:
        yield law
        return
    for key, item in value.items():
        yield from _laws_in(item, f"{path}.{key}")


def _filled(value: Any, values: Iterator[Any]) -> Any:
    """The nested dict with `values` in place of its laws, in its order."""
    if not isinstance(value, Mapping):
        return value
    if _law_of(value, "") is not None:
        return next(values)
    return {key: _filled(item, values) for key, item in value.items()}


def _made(index: int, member: Any) -> Scene:
    try:
        return scenes.get(member)
    except ValueError as error:
        raise ValueError(f"scenes[{index}]: {error}") from error

"""Families of scenes: a list of scenes, or scenes with fields that are drawn anew."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbl_gym.worlds import laws, scenes
from rbl_gym.worlds.scene import Scene

__all__ = ["SceneFamily", "family"]


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
        - ``{"choice": [a, b, ...]}``: one of these values, each as likely as the others;
        - ``{"repeat": {"count": [low, high], "of": value}}``: a list of so many values, a whole
          number drawn as by `integers`.

        Lists, choices and repeated values may hold laws too.

    Raises
    ------
    ValueError
        On an empty list, a law that is none, or a scene that cannot be made.
    """

    members: tuple[Any, ...]

    def __post_init__(self) -> None:
        members_of(self.members)
        for scene in self.corners:
            if scene.inertial is not None:
                raise ValueError(
                    "scenes must have no inertial sensor: its readings have a shape of their own "
                    f"in every scene, got one in {scene.name!r}"
                )
            first = self.corners[0]
            alike = scene.prisms == first.prisms and scene.gain == first.gain
            if not alike or (scene.gain and scene.anchor_region != first.anchor_region):
                raise ValueError(
                    "scenes of building files with walls, or limits of range and view, must all be "
                    f"of one file, got {scene.name!r} beside {first.name!r}"
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
            found += [_made(index, one) for one in laws.corners(member, f"scenes[{index}]")]
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
    def is_surveyed(self) -> bool:
        """Whether anchors of any scene are off by their survey."""
        return any(scene.survey_std_m > 0 for scene in self.corners)

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
        if any(scene.weakens for scene in self.corners):
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
        member = laws.draw(self.members[index], rng)
        scene = _made(index, member)
        return scene, dict(member) if isinstance(member, Mapping) else {"name": scene.name}


def family(value: Any) -> SceneFamily:
    """The family of a list of scenes, of one scene with laws, or of one scene alone."""
    if isinstance(value, SceneFamily):
        return value
    return SceneFamily(members_of(value))


def members_of(value: Any) -> tuple[Any, ...]:
    """The members of a family: of a list those in it, of one scene this; or a ValueError."""
    if isinstance(value, str | Mapping | Scene):
        return (value,)
    if not isinstance(value, Sequence):
        raise ValueError(
            f"scenes must be a list of scenes, a name or a dict of overrides, got {value!r:.80}"
        )
    if not value:
        raise ValueError("scenes must hold at least one scene, got none")
    return tuple(value)


def padded(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The array in the corner of zeros of a shape, a copy."""
    result = np.zeros(shape, array.dtype)
    result[tuple(slice(size) for size in array.shape)] = array
    return result


def _made(index: int, member: Any) -> Scene:
    try:
        return scenes.get(member)
    except ValueError as error:
        raise ValueError(f"scenes[{index}]: {error}") from error

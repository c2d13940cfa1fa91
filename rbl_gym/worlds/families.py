"""Families of scenes: lists of scenes, or scenes with fields drawn from laws."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbl_gym.worlds import field_laws, scenes
from rbl_gym.worlds.scene import Scene

__all__ = ["SceneFamily", "family"]


@dataclass(frozen=True, eq=False)
class SceneFamily:
    """A family of scenes; every episode draws one of them.

    Parameters
    ----------
    members
        Members, drawn with equal probability. Each is a name, a `Scene`, or a dict of overrides
        (`rbl_gym.worlds.scenes.get`). In a dict any value, at any depth, may be a law from which it
        is drawn:

        - ``{"uniform": [low, high]}`` and ``{"log-uniform": [low, high]}``: a number;
        - ``{"integers": [low, high]}``: an integer, both ends included;
        - ``{"choice": [a, b, ...]}``: one of these values, with equal probability;
        - ``{"repeat": {"count": [low, high], "of": value}}``: a list with a drawn
          number of values, as by `integers`.

        Lists, choices and repeated values may themselves contain laws.

    Raises
    ------
    ValueError
        If the list is empty, a law is invalid, or a scene is invalid.
    """

    members: tuple[Any, ...]

    def __post_init__(self) -> None:
        members_of(self.members)
        for scene in self.corners:
            if scene.inertial is not None:
                raise ValueError(
                    "scenes must have no inertial sensor, as the shape of its readings differs "
                    f"between scenes; got one in {scene.name!r}"
                )
            first = self.corners[0]
            alike = scene.prisms == first.prisms and scene.gain == first.gain
            if not alike or (scene.gain and scene.anchor_region != first.anchor_region):
                raise ValueError(
                    "scenes of building files that have walls, or limits of range or view, must "
                    f"all come from one file, got {scene.name!r} beside {first.name!r}"
                )
            if scene.links.offset is not None:
                raise ValueError(
                    "scenes must have ranges without an offset, got links.offset "
                    f"{scene.links.offset!r} in {scene.name!r}"
                )

    @functools.cached_property
    def corners(self) -> tuple[Scene, ...]:
        """Scenes with all choices and both ends of all integers; other numbers are midpoints."""
        found: list[Scene] = []
        for index, member in enumerate(self.members):
            found += [_made(index, one) for one in field_laws.corners(member, f"scenes[{index}]")]
        return tuple(found)

    @functools.cached_property
    def n_anchors(self) -> int:
        """Largest number of anchors of a scene."""
        return max(scene.n_anchors for scene in self.corners)

    @functools.cached_property
    def n_tags(self) -> int:
        """Largest number of tags of a body."""
        return max(len(scene.tags) for scene in self.corners)

    @functools.cached_property
    def n_boxes(self) -> int:
        """Largest number of obstacles of a scene."""
        return max(len(scene.obstacles) for scene in self.corners)

    @property
    def steps(self) -> int:
        """Number of steps of the longest episode."""
        return max(scene.steps for scene in self.corners)

    @property
    def anchor_speed_m_s(self) -> float:
        """Highest speed of an anchor; 0 if anchors are fixed in all scenes."""
        return max(scene.anchor_speed_m_s for scene in self.corners)

    @functools.cached_property
    def is_surveyed(self) -> bool:
        """Whether any scene has survey errors of its anchors."""
        return any(scene.survey_std_m > 0 for scene in self.corners)

    @functools.cached_property
    def fields(self) -> dict[str, tuple[tuple[int, ...], type]]:
        """Return shapes and types of what `RBL/Tracking-v0` observes in any of the scenes."""
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

    def pad(self, told: Mapping[str, np.ndarray], scene: Scene) -> dict[str, np.ndarray]:
        """Return the observation of a scene, padded to the family's shapes, with its masks."""
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
        """Draw a scene; return it with its overrides (for `rbl_gym.worlds.scenes.get`).

        `index` is that of the member to draw from; None draws the member too. The overrides of a
        member that is a `Scene` are only its name.
        """
        if index is None:
            index = int(rng.integers(len(self.members))) if len(self.members) > 1 else 0
        member = field_laws.draw(self.members[index], rng)
        scene = _made(index, member)
        return scene, dict(member) if isinstance(member, Mapping) else {"name": scene.name}


def family(value: Any) -> SceneFamily:
    """Return the family of a list of scenes, of one scene with laws, or of one scene."""
    if isinstance(value, SceneFamily):
        return value
    return SceneFamily(members_of(value))


def members_of(value: Any) -> tuple[Any, ...]:
    """Return the members of a family; a single scene is one member. May raise ValueError."""
    if isinstance(value, str | Mapping | Scene):
        return (value,)
    if not isinstance(value, Sequence):
        raise ValueError(
            f"scenes must be a list of scenes, a name or a dict of changes, got {value!r:.80}"
        )
    if not value:
        raise ValueError("scenes must hold at least one scene, got none")
    return tuple(value)


def padded(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of the array, padded with zeros at the end of every axis."""
    result = np.zeros(shape, array.dtype)
    result[tuple(slice(size) for size in array.shape)] = array
    return result


def _made(index: int, member: Any) -> Scene:
    try:
        return scenes.get(member)
    except ValueError as error:
        raise ValueError(f"scenes[{index}]: {error}") from error

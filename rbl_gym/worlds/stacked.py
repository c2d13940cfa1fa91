"""Many scenes of a family as arrays: the data for an epoch of a vector environment.

`StackedScenes` has those attributes of a `Scene` that `simulation.measure_epoch`, the posterior
bound and the filters use, with a leading axis (B,). Missing anchors and tags of a scene are padded;
their links never measure.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Region
from rbl_gym.measurements.gain import Gain
from rbl_gym.measurements.noise_laws import StackedNoise, numbers_of
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.worlds import simulation
from rbl_gym.worlds.families import SceneFamily, padded
from rbl_gym.worlds.scene import FlatScales, Scene

# Position of missing boxes, which have no size and block nothing.
_NOWHERE = np.array([1e12, 1e12, 1e12, 0.0, 0.0, 0.0])


class StackedLinks(NamedTuple):
    """Link models of many worlds: those fields of a `LinkModel` that determine a link.

    The first three are (B, 1, 1). `reach_m` (B, M, N) is -1 for missing anchors or tags.
    """

    drop_probability: FloatArray
    nlos_probability: FloatArray
    nlos_bias_m: FloatArray
    reach_m: FloatArray
    is_random: bool
    never_fails: bool = False
    offset: None = None
    options: dict[str, str] = {}  # noqa: RUF012 (never written to)


class _Arrays(NamedTuple):
    """Numbers of scenes, each with a leading axis (B,)."""

    body: FloatArray
    tags: FloatArray
    anchor_mask: np.ndarray
    tag_mask: np.ndarray
    laws: FloatArray
    process: FloatArray
    dt: FloatArray
    steps: np.ndarray
    speed: FloatArray
    range_limit_m: FloatArray
    blocked: FloatArray
    boxes: FloatArray
    drop: FloatArray
    nlos: FloatArray
    bias: FloatArray
    reach: FloatArray
    scales: FloatArray


@dataclass(frozen=True, eq=False)
class StackedScenes:
    """The stacked scenes of B worlds, drawn from a family, and their numbers as arrays."""

    family: SceneFamily
    scenes: tuple[Scene, ...]
    arrays: _Arrays
    inertial: None = None
    survey_std_m: float = 0.0
    name: str = "a family of scenes"

    @classmethod
    def of(cls, family: SceneFamily, scenes: Sequence[Scene]) -> StackedScenes:
        """Stack scenes of a family."""
        rows = [_numbers(family, scene) for scene in scenes]
        return cls(family, tuple(scenes), _Arrays(*map(np.stack, zip(*rows, strict=True))))

    def replaced(self, rows: np.ndarray, scenes: Sequence[Scene]) -> StackedScenes:
        """Return the stack with other scenes in some rows."""
        new, kept = StackedScenes.of(self.family, scenes).arrays, list(self.scenes)
        fields = []
        for old, field in zip(self.arrays, new, strict=True):
            copy = old.copy()
            copy[rows] = field
            fields.append(copy)
        for row, scene in zip(rows.tolist(), scenes, strict=True):
            kept[row] = scene
        return StackedScenes(self.family, tuple(kept), _Arrays(*fields))

    def rows(self, where: np.ndarray) -> StackedScenes:
        """Return the scenes of some rows, a mask or indices."""
        chosen = np.arange(len(self.scenes))[where]
        arrays = _Arrays(*(field[chosen] for field in self.arrays))
        return StackedScenes(self.family, tuple(self.scenes[i] for i in chosen), arrays)

    def with_tags(self, count: int) -> StackedScenes:
        """Return the scenes with only the first tags, for bodies with this number of tags."""
        arrays = self.arrays._replace(
            body=self.arrays.body[:, :count], reach=self.arrays.reach[:, :, :count]
        )
        return StackedScenes(self.family, self.scenes, arrays)

    # --- attributes of a scene ------------------------------------------------------------

    @property
    def n_anchors(self) -> int:
        """Largest number of anchors of a scene of the family."""
        return self.family.n_anchors

    @property
    def body(self) -> FloatArray:
        """Tags (B, N, 3); missing tags of a body repeat its first tag."""
        return self.arrays.body

    @property
    def tags(self) -> FloatArray:
        """Same as `body`."""
        return self.arrays.body

    @property
    def dt(self) -> FloatArray:
        """Duration of a step (B,), seconds."""
        return self.arrays.dt

    @property
    def range_limit_m(self) -> FloatArray:
        """Range limits (B,), metres."""
        return self.arrays.range_limit_m

    @property
    def weakens(self) -> bool:
        """Whether any scene of the family has obstacles."""
        return "quality" in self.family.fields

    @property
    def blocked_information(self) -> FloatArray:
        """Information fractions of blocked links (B, 1, 1)."""
        return self.arrays.blocked

    @property
    def gain(self) -> Gain:
        """Reach and view of the anchors, the same in all scenes."""
        return self.scenes[0].gain

    @property
    def anchor_region(self) -> Region:
        """Region of the anchors; the same in all scenes if their view is limited."""
        return self.scenes[0].anchor_region

    @functools.cached_property
    def obstruction(self) -> Obstacles:
        """The boxes of all scenes, (B, K, 6)."""
        prisms, blocked = self.scenes[0].prisms, self.arrays.blocked
        if len(prisms):
            blocked = blocked[:, 0, 0]
        return Obstacles(self.arrays.boxes, blocked, prisms)  # pyrefly: ignore[bad-argument-type]

    @functools.cached_property
    def noise(self) -> StackedNoise:
        """The noise laws of all scenes."""
        return StackedNoise(self.arrays.laws)

    @functools.cached_property
    def process(self) -> ProcessNoise:
        """The process noise of each scene."""
        std = self.arrays.process
        return ProcessNoise(std[:, :3], std[:, 3:])  # pyrefly: ignore[bad-argument-type]

    @functools.cached_property
    def links(self) -> StackedLinks:
        """The link models of each scene."""
        drop, nlos = self.arrays.drop, self.arrays.nlos
        random = bool(drop.any() or nlos.any())
        return StackedLinks(drop, nlos, self.arrays.bias, self.arrays.reach, random)

    @property
    def scales(self) -> FlatScales:
        """`Scene.scales` of each scene, (B, ...)."""
        return FlatScales.split(self.arrays.scales)

    # --- groups of scenes -----------------------------------------------------------------

    def move_anchors(self, anchors: FloatArray, action: FloatArray) -> FloatArray:
        """Return `simulation.move_anchors` of each, for anchors (B, M, 3) and actions (B, 3 M)."""
        moved = anchors.copy()
        for scene, rows in self._alike("anchor_region", "anchor_speed_m_s", "dt", "n_anchors"):
            if scene.anchor_speed_m_s > 0:
                m = scene.n_anchors
                own = anchors[rows, :m], action[rows, : 3 * m]
                moved[rows, :m] = simulation.move_anchors(scene, *own)
        return moved

    def bodies(self) -> Iterator[tuple[int, BoolArray]]:
        """Return each number of tags, with the mask (B,) of the worlds that have it."""
        counts = self.arrays.tag_mask.sum(axis=-1)
        for count in np.unique(counts).tolist():
            yield count, counts == count

    def _alike(self, *names: str) -> Iterator[tuple[Scene, np.ndarray]]:
        """Group scenes that agree in some fields: one scene, and the rows, of each group."""
        found: dict[Any, list[int]] = {}
        for row, scene in enumerate(self.scenes):
            found.setdefault(tuple(getattr(scene, name) for name in names), []).append(row)
        for rows in found.values():
            yield self.scenes[rows[0]], np.array(rows)


def _numbers(family: SceneFamily, scene: Scene) -> tuple[Any, ...]:
    """Return the numbers of a scene in the order of `_Arrays`."""
    m, n, links = scene.n_anchors, len(scene.tags), scene.links
    anchor_mask = padded(np.ones(m, np.int8), (family.n_anchors,))
    tag_mask = padded(np.ones(n, np.int8), (family.n_tags,))
    reach = np.inf if links.reach_m is None else links.reach_m
    boxes = np.tile(_NOWHERE, (family.n_boxes, 1))
    boxes[: len(scene.obstacles)] = scene.obstruction.boxes
    return (
        np.concatenate([scene.body, np.tile(scene.body[:1], (family.n_tags - n, 1))]),
        padded(scene.body, (family.n_tags, 3)),
        anchor_mask,
        tag_mask,
        numbers_of(scene.noise, n),
        scene.process.std(),
        np.float64(scene.dt),
        np.int64(scene.steps),
        np.float64(scene.anchor_speed_m_s),
        np.array(scene.range_limit_m),
        np.full((1, 1), scene.blocked_information),
        boxes,
        np.full((1, 1), links.drop_probability),
        np.full((1, 1), links.nlos_probability),
        np.full((1, 1), links.nlos_bias_m),
        np.where(anchor_mask[:, None] & tag_mask, reach, -1.0),
        scene.scales.joined(),
    )

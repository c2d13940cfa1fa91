"""The problem of anchor placement: contexts, legal positions, scores.

A task is a scene, a number of anchors and a number of racks. A context is what varies between
problems: the work region, a box inside the body's volume, and the racks. A layout is an array (...,
M, 3) of anchors. Its score on a context is the root mean square tag error in metres that the
Cramer-Rao bound gives over fixed poses in the work region. Everything broadcasts: layouts and
contexts of one call may have any leading axes.

`layouts` and `search` have solutions.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import (
    FloatArray,
    all_finite,
    as_float,
    check_array,
    check_count,
    check_finite,
)
from rbl_gym.geometry import rotations
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Walls
from rbl_gym.kernels import compiled
from rbl_gym.measurements import ranging
from rbl_gym.placement.racks import RACK_UNIFORMS, drawn_racks, limits_of_racks
from rbl_gym.worlds import scenes
from rbl_gym.worlds.scene import Scene

__all__ = [
    "Context", "PlacementTask", "draw_contexts",
    "information", "mounts", "positions", "score", "score_of", "sight_fractions",
    "task", "whole_volume",
]  # fmt: skip

# Default numbers of anchors: the scene's own, and one fewer with racks.
MAX_RACKS = 2
# Limit of the numbers of anchors and poses.
_MOST_PLACES = 10**6
# Rotation of the prior that regularizes the bound.
_PRIOR_ROTATION_RAD = math.radians(60)
# The poses of a task are always the same, so that scores can be compared.
_POSE_SEED = 20130821
# Range of the work region's half size as a fraction of the volume's, (x, y, z).
_LEAST, _MOST = np.array([0.15, 0.15, 0.3]), np.array([0.6, 0.6, 1.0])
_SPAN = _MOST - _LEAST
# Number of uniforms of a work region.
_REGION_UNIFORMS = 6


class Context(NamedTuple):
    """One placement problem of a task, with leading batch axes.

    Attributes
    ----------
    centre, half
        Work region (..., 3), metres.
    racks
        Centre and half size (..., K, 6) of all boxes that block sight: first the scene's own, then
        those of the problem.
    """

    centre: FloatArray
    half: FloatArray
    racks: FloatArray


@dataclass(frozen=True)
class PlacementTask:
    """A family of placement problems.

    Parameters
    ----------
    scene
        Scene with the body, its volume, the noise, the legal anchor positions, obstacles and the
        information fraction of a blocked link (the line of sight is that from the anchor to the
        body's centre).
    n_anchors
        Number of placed anchors, in addition to the scene's `fixed` ones.
    racks
        Number of boxes on the floor that every problem draws, 0 to 2; only in rooms (scenes with
        walls).
    n_poses
        Number of poses in the work region for the score.
    """

    scene: Scene
    n_anchors: int
    racks: int = 0
    n_poses: int = 32

    def __post_init__(self) -> None:
        if not isinstance(self.scene, Scene):
            raise ValueError(
                f"scene must be a Scene such as scenes.get('hall'), got {self.scene!r:.80}"
            )
        for name, least, most in (
            ("n_anchors", 1, _MOST_PLACES),
            ("racks", 0, MAX_RACKS),
            ("n_poses", 1, _MOST_PLACES),
        ):
            value = check_count(name, getattr(self, name), least=least, most=most)
            object.__setattr__(self, name, value)
        if not np.ptp(self.scene.volume.bounds(), axis=0).any():
            raise ValueError(f"scene must have a volume, that of {self.scene.name!r} is a point")
        if self.scene.links.offset is not None:
            raise ValueError(
                f"scene must have ranges without an offset (links.offset None), got "
                f"{self.scene.links.offset!r}"
            )
        if self.racks and not isinstance(self.scene.anchor_region, Walls):
            raise ValueError(
                f"racks must be 0 outside a named room, got {self.racks} in {self.scene.name!r}"
            )

    @property
    def blocked_information(self) -> float:
        """Information fraction of a link without line of sight, from the scene."""
        return self.scene.blocked_information

    def obstacles_in(self, context: Context) -> Obstacles:
        """Return the obstacles of a context."""
        own = self.scene.obstruction
        if context.racks is own.boxes:
            return own  # with its grid
        return Obstacles(context.racks, own.blocked_information, own.prisms)

    @functools.cached_property
    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Return rotations (P, 3, 3) and offsets (P, 3) in units of the work region's half size.

        The arrays are read-only, as are all arrays of a task.
        """
        rng = np.random.default_rng(_POSE_SEED)
        offsets = rng.uniform(-1, 1, (self.n_poses, 3))
        return _read_only(rotations.random(rng, (self.n_poses,))), _read_only(offsets)

    @functools.cached_property
    def rack_limits(self) -> tuple[FloatArray, FloatArray]:
        """`limits_of_racks` of the anchor region."""
        least, span = limits_of_racks(*self.scene.anchor_region.bounds())
        return _read_only(least), _read_only(span)

    @functools.cached_property
    def prior_information(self) -> FloatArray:
        """Prior information (6, 6): 60 degrees, and half of the volume's largest extent."""
        extent = float(np.ptp(self.scene.volume.bounds(), axis=0).max())
        diagonal = [_PRIOR_ROTATION_RAD**-2] * 3 + [(0.5 * extent) ** -2] * 3
        return _read_only(np.diag(diagonal))


def _read_only(array: FloatArray) -> FloatArray:
    array.flags.writeable = False
    return array


def task(scene: Any = "auv_buoys", n_anchors: int | None = None, racks: int = 0) -> PlacementTask:
    """Return the task of a scene (a name or overrides, see `scenes.get`).

    `n_anchors` None: as many as in the scene, and one fewer if racks are drawn.

    Raises
    ------
    ValueError
        If the scene is unknown, there are racks outside a room, or a number is invalid.
    """
    scene = scenes.get(scene)
    racks = check_count("racks", racks, least=0, most=MAX_RACKS)
    usual = scene.n_anchors - len(scene.fixed) - bool(racks)
    return PlacementTask(scene, usual if n_anchors is None else n_anchors, racks)


# --- contexts --------------------------------------------------------------------------------


def context_uniforms(task: PlacementTask) -> int:
    """Return the number of uniforms of a context."""
    return _REGION_UNIFORMS + RACK_UNIFORMS * task.racks


def draw_contexts(
    task: PlacementTask, rng: np.random.Generator, batch: tuple[int, ...] = ()
) -> Context:
    """Draw contexts: work regions in the volume, and racks besides the scene's obstacles."""
    return build_contexts(task, rng.random((*batch, context_uniforms(task))))


def build_contexts(task: PlacementTask, uniforms: FloatArray) -> Context:
    """Return the contexts of uniforms (..., `context_uniforms`)."""
    low, high = task.scene.volume.bounds()
    half = (_LEAST + _SPAN * uniforms[..., :3]) * (0.5 * (high - low))
    least = low + half
    centre = least + uniforms[..., 3:6] * ((high - half) - least)
    of_racks = uniforms[..., _REGION_UNIFORMS:]
    of_racks = of_racks.reshape((*uniforms.shape[:-1], task.racks, RACK_UNIFORMS))
    drawn = drawn_racks(task.rack_limits, of_racks) if task.racks else of_racks
    own = task.scene.obstruction.boxes
    if not len(own):
        return Context(centre, half, drawn)
    own = np.broadcast_to(own, (*uniforms.shape[:-1], *own.shape))
    return Context(centre, half, np.concatenate([own, drawn], axis=-2))


def whole_volume(task: PlacementTask) -> Context:
    """Return the context whose work region is the whole volume, with the scene's obstacles."""
    low, high = task.scene.volume.bounds()
    return Context(0.5 * (low + high), 0.5 * (high - low), task.scene.obstruction.boxes.copy())


def positions(task: PlacementTask, context: Context) -> FloatArray:
    """Return positions (..., P, 3) of the body's centre at the task's poses."""
    return context.centre[..., None, :] + task.poses[1] * context.half[..., None, :]


# --- scores ----------------------------------------------------------------------------------


def information(task: PlacementTask, context: Context, anchors: FloatArray) -> FloatArray:
    """Return Fisher information (..., P, 6, 6) at the task's poses, without the prior.

    It is a sum over the anchors: the information of a layout is the sum of that of its parts. It
    does not include the scene's fixed anchors.
    """
    places = positions(task, context)
    share = link_shares(task.scene, task.obstacles_in(context), anchors, places)[..., None]
    return bounds.information_at(
        anchors[..., None, :, :], task.scene.body, task.poses[0], places, task.scene.noise, share
    )


def information_of_fixed(task: PlacementTask, context: Context) -> FloatArray:
    """Return `information` (..., P, 6, 6) of the scene's fixed anchors."""
    batch = context.centre.shape[:-1]
    if not task.scene.fixed:
        return np.zeros((*batch, task.n_poses, 6, 6))
    fixed = np.broadcast_to(task.scene.fixed, (*batch, len(task.scene.fixed), 3))
    return information(task, context, fixed)


def link_shares(
    scene: Scene, in_the_way: Obstacles, anchors: FloatArray, places: FloatArray
) -> FloatArray:
    """Return the information fraction (..., P, M) of links from each anchor to each position.

    It depends on the obstacles between them, and on the anchors' reach and field of view.
    """
    gain = scene.gain
    if not in_the_way and not gain:
        # Several times as fast as np.broadcast_shapes and np.broadcast_to.
        batch = np.broadcast(anchors[..., :1, 0], places[..., :1, 0]).shape[:-1]
        return np.ones((*batch, places.shape[-2], anchors.shape[-2]))
    share = in_the_way.share(anchors, places)
    if not gain:
        return share
    normals = scene.anchor_region.normal(anchors)[..., None, :, :]
    return share * gain.share(places[..., None, :] - anchors[..., None, :, :], normals)


def score(task: PlacementTask, context: Context, anchors: FloatArray) -> FloatArray:
    """Return the score (...) of layouts (..., M, 3) in metres: small is good.

    The score is the root mean square over the poses of b, ``b^2 = mean_n tr(J_n P J_n^T)`` with ``P
    = (F + prior)^-1``. With the prior, layouts without sight have finite scores. A pseudo-inverse
    is not used, because it would favour coincident anchors.
    """
    anchors, context = check_array("anchors", anchors, ("M", 3)), checked_context(context)
    return score_of_checked(task, context, anchors)


def score_of_checked(task: PlacementTask, context: Context, anchors: FloatArray) -> FloatArray:
    """Return `score` of arrays that the caller has checked."""
    return root_of(mean_square(*arguments(task, context, anchors)))


def arguments(task: PlacementTask, context: Context, anchors: FloatArray) -> tuple[FloatArray, ...]:
    """Return the arguments of `mean_square` for the score."""
    if task.scene.fixed:
        fixed = np.broadcast_to(task.scene.fixed, (*anchors.shape[:-2], len(task.scene.fixed), 3))
        anchors = np.concatenate([fixed, anchors], axis=-2)
    places = positions(task, context)
    share = link_shares(task.scene, task.obstacles_in(context), anchors, places)
    law = ranging.numbers_of(task.scene.noise, len(task.scene.tags))
    assert law is not None  # the laws of scenes have numbers
    return anchors, task.poses[0], places, task.scene.body, task.prior_information, law, share


@compiled("layout_score:mean_square")
def mean_square(
    anchors: FloatArray,
    rotation: FloatArray,
    places: FloatArray,
    tags: FloatArray,
    prior: FloatArray,
    law: FloatArray,
    share: FloatArray,
) -> FloatArray:
    """Return the mean (...) of b^2 over poses (..., P, 3, 3), (..., P, 3), shares (..., P, M)."""
    told = bounds.information_at(
        anchors[..., None, :, :],
        tags[..., None, :, :],
        rotation,
        places,
        ranging.law_of(law if law.ndim == 1 else law[..., None, :]),
        share[..., None],
    )
    weight = np.full(rotation.shape[-3], 1 / rotation.shape[-3])
    return weighted_square.textbook(told + prior[..., None, :, :], rotation, tags, weight)


@compiled("layout_score:weighted_square")
def weighted_square(
    information: FloatArray, rotation: FloatArray, tags: FloatArray, weight: FloatArray
) -> FloatArray:
    """Return the sum (...) of b^2, weighted by (..., P), for information (..., P, 6, 6)."""
    J = bounds.tag_jacobian(rotation, tags[..., None, :, :])
    S = np.einsum("...nia,...nib->...ab", J, J) / tags.shape[-2]
    return (weight * np.einsum("...ab,...ba->...", S, np.linalg.inv(information))).sum(axis=-1)


def checked_context(context: Context) -> Context:
    """Return the context with finite arrays of correct shapes; may raise ValueError."""
    centre, half = (check_array(name, getattr(context, name), (3,)) for name in ("centre", "half"))
    racks = check_finite("racks", as_float("racks", context.racks))
    if racks.ndim < 2 or racks.shape[-1] != 6:
        raise ValueError(f"racks must have shape (..., K, 6), got {racks.shape}")
    return Context(centre, half, racks)


def score_of(task: PlacementTask, information: FloatArray) -> FloatArray:
    """Return the score (...) of an information (..., P, 6, 6) at the task's poses."""
    told = information + task.prior_information
    weight = np.full(task.n_poses, 1 / task.n_poses)
    return root_of(weighted_square(told, task.poses[0], task.scene.body, weight))


def root_of(square: FloatArray) -> FloatArray:
    """Return scores (...) from their squares; raises ValueError if they are not finite."""
    if np.count_nonzero(square > 0) < square.size or not all_finite(square):  # NaN is not > 0
        error = f"got the mean square tag error {square.max():g}"
        raise ValueError(f"information must be positive definite and finite, {error}")
    return np.sqrt(square)


# --- mounts ----------------------------------------------------------------------------------


def mounts(task: PlacementTask) -> FloatArray:
    """Return mount points (57, 3) of a room: three heights on the walls, nine on the ceiling.

    Raises
    ------
    ValueError
        If the scene is not a room.
    """
    region = task.scene.anchor_region
    if not isinstance(region, Walls):
        raise ValueError(f"scene must have walls for mount points, got {task.scene.name!r}")
    low, high = region.bounds()
    x, y, _ = (np.linspace(low, high, 5)).T
    # Half of the height, rounded to a decimetre.
    heights = (low[2], np.round(0.5 * (low[2] + high[2]) - 1e-9, 1), high[2])
    points = [(a, b, z) for z in heights for b in (low[1], high[1]) for a in x]
    points += [(a, b, z) for z in heights for a in (low[0], high[0]) for b in y[1:-1]]
    points += [(a, b, high[2]) for a in x[1:-1] for b in y[1:-1]]
    return np.array(points)


def sight_fractions(task: PlacementTask, context: Context, anchors: FloatArray) -> FloatArray:
    """Return the fraction (..., M) of the task's poses that each anchor sees."""
    in_the_way = task.obstacles_in(context)
    if not in_the_way:
        return np.ones(np.broadcast_shapes(anchors.shape[:-1], (*context.centre.shape[:-1], 1)))
    return in_the_way.sees(anchors, positions(task, context)).mean(axis=-2)

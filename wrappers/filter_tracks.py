"""Tracking errors of a filter with a layout, along tracks through a work region."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rbl_gym import metrics, motion, placement
from rbl_gym.checks import FloatArray, check_array
from rbl_gym.estimators import Filter, PoseBelief
from rbl_gym.estimators.filter import belief_of
from rbl_gym.geometry import rotations
from rbl_gym.placement import Context, PlacementTask
from rbl_gym.worlds import simulation
from rbl_gym.wrappers.estimate import update

__all__ = ["Tracks", "track_error", "tracks"]

TRACKS, EPOCHS = 8, 20
# A filter is tried on this many random layouts, on this many tracks each, from two priors. The
# standard deviations of one are `_WIDER` times those of the other. If a layout determines the pose,
# the filter forgets the prior: measured ratios at the end are 0.9 to 1.2. They are above 1.6 for
# what a layout does not determine.
_LAYOUTS, _TRIED_TRACKS, _WIDER, _FORGOTTEN = 4, 2, 2.0, 1.4


class Tracks(NamedTuple):
    """Tracks through work regions, with leading axes (..., 8) of problems and tracks.

    Attributes
    ----------
    rotation, translation
        True poses (..., 20, 3, 3) and (..., 20, 3).
    twists
        Known twist (..., 20, 6) of the interval that ends at each epoch; 0 at the first.
    prior_rotation, prior_translation
        Prior mean (..., 3, 3) and (..., 3).
    normals, uniforms
        Random numbers of the ranges (..., 20, M, N) and of the links (..., 20, 2, M, N).
    """

    rotation: FloatArray
    translation: FloatArray
    twists: FloatArray
    prior_rotation: FloatArray
    prior_translation: FloatArray
    normals: FloatArray
    uniforms: FloatArray


def tracks(task: PlacementTask, context: Context) -> Tracks:
    """Draw the 8 tracks of each problem (...,): the same problem has the same tracks.

    The body moves at the scene's speed and spin between way-points that are uniform in the work
    region, with the scene's process noise. All random numbers come from a generator seeded with the
    numbers of the problem. Layouts of one problem are therefore compared on the same tracks.
    """
    scene, links = task.scene, (task.n_anchors, len(task.scene.tags))
    batch = context.centre.shape[:-1]
    travel = scene.speed_m_s * scene.dt * (EPOCHS - 1)
    smallest = 0.15 * float(np.linalg.norm(np.ptp(scene.volume.bounds(), axis=0)))
    # The average length of a leg is more than a quarter of the region's extent.
    n_points = 8 + math.ceil(16 * travel / smallest)
    shapes = ((13,), (EPOCHS - 1, 6), (EPOCHS, *links))
    sizes = [math.prod(shape) for shape in shapes]
    normals = np.empty((*batch, TRACKS, sum(sizes)))
    points = np.empty((*batch, TRACKS, n_points, 3))
    uniforms = np.empty((*batch, TRACKS, EPOCHS, 2, *links))
    for at, rng in _generators(context):
        rng.standard_normal(out=normals[at])
        rng.random(out=points[at])
        rng.random(out=uniforms[at])
    start, process, noise = (
        part.reshape((*batch, TRACKS, *shape))
        for part, shape in zip(
            np.split(normals, np.cumsum(sizes)[:-1], axis=-1), shapes, strict=True
        )
    )
    centre, half = (field[..., None, None, :] for field in (context.centre, context.half))
    trajectory = motion.waypoints(
        rotations.from_quaternion(start[..., :4]),
        centre + (2 * points - 1) * half,
        scene.speed_m_s,
        scene.dt,
        EPOCHS - 1,
        scene.spin_rad_s * start[..., 4:7],
    )
    path = motion.simulate(trajectory, scene.dt, scene.process, process)
    twists = np.zeros((*batch, TRACKS, EPOCHS, 6))
    twists[..., 1:, :] = trajectory.twists
    turn = rotations.exp(scene.initial_rotation_rad * start[..., 7:10])
    shift = scene.initial_translation_m * start[..., 10:]
    first = path.rotation[..., 0, :, :], path.translation[..., 0, :]
    return Tracks(*path, twists, turn @ first[0], first[1] + shift, noise, uniforms)


def _generators(context: Context) -> Iterator[tuple[tuple[int, ...], np.random.Generator]]:
    """Yield the index of each problem in the batch, and the generator seeded with its numbers."""
    batch = context.centre.shape[:-1]
    for at in np.ndindex(batch):
        numbers = [np.ravel(field[at]) for field in context]
        yield at, np.random.default_rng(np.concatenate(numbers).view(np.uint32))


def track_error(
    task: PlacementTask, context: Context, anchors: FloatArray, filter: Filter
) -> FloatArray:
    """Return the root mean square tag error (...) of a filter over each problem's tracks, metres.

    A layout that the filter does not accept (for example with coincident anchors) counts as a
    layout without ranges.

    Parameters
    ----------
    task
        The family of problems.
    context
        Problems (...,).
    anchors
        Their layouts (..., M, 3), metres.
    filter
        The filter, made with the scene's tags, noise and process.

    Raises
    ------
    ValueError
        If shapes do not fit or numbers are not finite.
    """
    context = placement.checked_context(context)
    anchors = check_array("anchors", anchors, (task.n_anchors, 3))
    batch = np.broadcast_shapes(context.centre.shape[:-1], anchors.shape[:-2])
    anchors = np.broadcast_to(anchors, (*batch, task.n_anchors, 3))
    cores = (3,), (3,), context.racks.shape[-2:]
    fields = zip(context, cores, strict=True)
    context = Context(*(np.broadcast_to(field, (*batch, *core)) for field, core in fields))
    try:
        return _track_error(task, context, anchors, filter)
    except ValueError:
        if not batch:
            return _track_error(task, context, anchors, filter, measures=False)
    each = (Context(*(field[i] for field in context)) for i in range(batch[0]))
    return np.array([track_error(task, *one, filter) for one in zip(each, anchors, strict=True)])


def _track_error(
    task: PlacementTask,
    context: Context,
    anchors: FloatArray,
    filter: Filter,
    measures: bool = True,
) -> FloatArray:
    course = tracks(task, context)
    beliefs = list(follow(task, context, anchors, filter, course, measures=measures))
    rotation, translation = (
        np.stack([belief[i] for belief in beliefs], axis=axis) for i, axis in ((0, -3), (1, -2))
    )
    truth = course.rotation, course.translation
    error = metrics.tag_error(rotation, translation, *truth, task.scene.body)
    return np.sqrt(np.mean(error**2, axis=(-2, -1)))


def follow(
    task: PlacementTask,
    context: Context,
    anchors: FloatArray,
    filter: Filter,
    course: Tracks,
    wider: float = 1.0,
    measures: bool = True,
) -> Iterator[PoseBelief]:
    """Return the beliefs (..., 8) of a filter at every epoch of the tracks.

    The layouts (..., M, 3) are of problems (...). The `filter` has the scene's tags, noise and
    process. `course` is from `tracks`; `wider` a factor on the scene's initial standard deviations;
    `measures` whether there are ranges.
    """
    scene, shape = task.scene, course.normals.shape[:-3]
    anchors = np.broadcast_to(anchors[..., None, :, :], (*shape, *anchors.shape[-2:]))
    obstacles = task.obstacles_in(context._replace(racks=context.racks[..., None, :, :]))
    covariance = wider**2 * scene.prior_covariance
    state = filter.initial(course.prior_rotation, course.prior_translation, covariance)
    for k in range(EPOCHS):
        at = simulation.Epoch(
            course.rotation[..., k, :, :],
            course.translation[..., k, :],
            course.twists[..., k, :],
            course.normals[..., k, :, :],
            course.uniforms[..., k, :, :, :],
        )
        if k:
            state = filter.predict(state, at.twist, scene.dt)
        if measures:
            quality = None
            if obstacles:
                quality = obstacles.share(anchors, at.translation[..., None, :])[..., 0, :]
            ranges, links, _ = simulation.measure_epoch(scene, at, anchors, quality)
            epoch = {"ranges": ranges, "links": links, "anchors": anchors}
            epoch |= {} if quality is None else {"quality": quality}
            state = update(filter, state, epoch, scene)
        yield belief_of(filter, state)


def check_determined(task: PlacementTask, name: object, filter: Filter) -> None:
    """Raise ValueError if no layout lets the filter find the pose without the prior.

    The filter follows the tracks through the whole volume, without racks, on random layouts. It
    starts from two priors, one of them twice as wide. Quantities determined by the ranges end with
    the same variance.
    """
    scene, rng = task.scene, np.random.default_rng(0)
    free = placement.whole_volume(task)._replace(racks=np.empty((0, 6)))
    context = Context(*(np.broadcast_to(field, (_LAYOUTS, *field.shape)) for field in free))
    anchors = scene.anchor_region.draw(rng.random((_LAYOUTS, task.n_anchors, 3)))
    course = Tracks(*(field[:, :_TRIED_TRACKS] for field in tracks(task, context)))
    # This checks the width of the belief, not its mean: every track starts from its true pose.
    course = course._replace(
        prior_rotation=course.rotation[..., 0, :, :],
        prior_translation=course.translation[..., 0, :],
    )
    ends = [
        list(follow(task, context, anchors, filter, course, wider))[-1].covariance
        for wider in (1.0, _WIDER)
    ]
    narrow, wide = (np.sqrt(np.diagonal(P, axis1=-2, axis2=-1)) for P in ends)
    ratio = (wide / narrow).mean(axis=1)
    best = ratio[ratio.max(axis=-1).argmin()]
    if not best.max() < _FORGOTTEN:
        axis = ("rotation about x", "rotation about y", "rotation about z", "x", "y", "z")
        raise ValueError(
            f"filter {name!r} does not determine {axis[int(best.argmax())]} with {task.n_anchors} "
            f"anchors and the {len(scene.tags)} tags of scene {scene.name!r}, where it only "
            "repeats the prior: choose another filter"
        )

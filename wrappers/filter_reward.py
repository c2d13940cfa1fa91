"""A layout paid by how well a filter tracks with it, in place of the bound."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from rbl_gym import metrics, motion, placement
from rbl_gym.checks import BoolArray, FloatArray, check_array, check_one_of
from rbl_gym.envs.placement import AnchorPlacementEnv, AnchorPlacementVectorEnv
from rbl_gym.estimators import Filter, PoseBelief
from rbl_gym.estimators.filter import check_takes_noise
from rbl_gym.geometry import rotations
from rbl_gym.placement import Context, PlacementTask
from rbl_gym.worlds import simulation
from rbl_gym.wrappers.estimate import make_filter, update

REWARDS = ("bound", "filter")
TRACKS, EPOCHS = 8, 20
# A filter is tried on so many random layouts, on so many tracks each, from two priors of which one
# has `_WIDER` times the standard deviations of the other. What a layout determines forgets the
# prior: measured ratios at the end are 0.9 to 1.2, and above 1.6 of what it does not determine.
_LAYOUTS, _TRIED_TRACKS, _WIDER, _FORGOTTEN = 4, 2, 2.0, 1.4


# --- tracks -----------------------------------------------------------------------------------


class Tracks(NamedTuple):
    """Tracks through work regions, with leading axes (..., 8) of problems and tracks.

    Attributes
    ----------
    rotation, translation
        True poses (..., 20, 3, 3) and (..., 20, 3).
    twists
        Known twist (..., 20, 6) of the interval that ends at each epoch; 0 at the first.
    prior_rotation, prior_translation
        Mean (..., 3, 3) and (..., 3) of the prior.
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
    """The 8 tracks of each problem (...,): the same problem has the same tracks.

    The body moves at the scene's speed and spin between way-points that are uniform in the work
    region, with the scene's process noise. All randomness comes from a generator seeded by the
    numbers of the problem, so that layouts of one problem are compared on the same tracks.
    """
    scene, links = task.scene, (task.n_anchors, len(task.scene.tags))
    batch = context.centre.shape[:-1]
    travel = scene.speed_m_s * scene.dt * (EPOCHS - 1)
    smallest = 0.15 * float(np.linalg.norm(np.ptp(scene.volume.bounds(), axis=0)))
    # Legs average above a quarter of the region's extent.
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
        rotations.from_quaternion(start[..., :4]), centre + (2 * points - 1) * half,
        scene.speed_m_s, scene.dt, EPOCHS - 1, scene.spin_rad_s * start[..., 4:7],
    )  # fmt: skip
    path = motion.simulate(trajectory, scene.dt, scene.process, process)
    twists = np.zeros((*batch, TRACKS, EPOCHS, 6))
    twists[..., 1:, :] = trajectory.twists
    turn = rotations.exp(scene.initial_rotation_rad * start[..., 7:10])
    shift = scene.initial_translation_m * start[..., 10:]
    first = path.rotation[..., 0, :, :], path.translation[..., 0, :]
    return Tracks(*path, twists, turn @ first[0], first[1] + shift, noise, uniforms)


def _generators(context: Context) -> Iterator[tuple[tuple[int, ...], np.random.Generator]]:
    """Of each problem its index in the batch, and the generator that its numbers seed."""
    batch = context.centre.shape[:-1]
    for at in np.ndindex(batch):
        numbers = [np.ravel(field[at]) for field in context]
        yield at, np.random.default_rng(np.concatenate(numbers).view(np.uint32))


def track_error(
    task: PlacementTask, context: Context, anchors: FloatArray, filter: Filter
) -> FloatArray:
    """Root mean square tag error (...) of a filter over the tracks of each problem, metres.

    A layout that the filter refuses (coincident anchors, say) counts as one that gives no range.

    Parameters
    ----------
    task
        The family of problems.
    context
        Problems (...,).
    anchors
        Their layouts (..., M, 3), metres.
    filter
        The filter; it knows the scene's tags, noise and process.

    Raises
    ------
    ValueError
        On wrong shapes or numbers that are not finite.
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
    """Beliefs (..., 8) of the filter at every epoch of the tracks.

    `wider`: times the scene's initial standard deviations; `measures`: whether there are ranges.
    """
    scene, shape = task.scene, course.normals.shape[:-3]
    anchors = np.broadcast_to(anchors[..., None, :, :], (*shape, *anchors.shape[-2:]))
    obstacles = task.obstacles(context._replace(racks=context.racks[..., None, :, :]))
    covariance = wider**2 * scene.prior_covariance
    state = filter.initial(course.prior_rotation, course.prior_translation, covariance)
    for k in range(EPOCHS):
        at = simulation.Epoch(
            course.rotation[..., k, :, :], course.translation[..., k, :], course.twists[..., k, :],
            course.normals[..., k, :, :], course.uniforms[..., k, :, :, :],
        )  # fmt: skip
        if k:
            state = filter.predict(state, at.twist, scene.dt)
        if measures:
            quality = None
            if obstacles:
                quality = obstacles.share(anchors, at.translation[..., None, :])[..., 0, :]
            ranges, links, _ = simulation.measure(scene, at, anchors, quality)
            epoch = {"ranges": ranges, "links": links, "anchors": anchors}
            epoch |= {} if quality is None else {"quality": quality}
            state = update(filter, state, epoch, scene)
        yield filter.belief(state)


def check_determined(task: PlacementTask, name: str, filter: Filter) -> None:
    """A ValueError where no layout lets the filter find the pose without the prior.

    The filter follows the tracks through the whole volume, without racks, from two priors of
    which one is twice as wide, on random layouts. What it finds out by itself ends alike.
    """
    scene, rng = task.scene, np.random.default_rng(0)
    free = placement.whole_volume(task)._replace(racks=np.empty((0, 6)))
    context = Context(*(np.broadcast_to(field, (_LAYOUTS, *field.shape)) for field in free))
    anchors = scene.anchor_region.draw(rng.random((_LAYOUTS, task.n_anchors, 3)))
    course = Tracks(*(field[:, :_TRIED_TRACKS] for field in tracks(task, context)))
    # What is asked is how wide the belief is, not where: every track starts from its true pose.
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
            f"filter must be one that {task.n_anchors} anchors and the {len(scene.tags)} tags of "
            f"scene {scene.name!r} determine, got {name!r}: {axis[int(best.argmax())]} stays what "
            "the prior says"
        )


def filter_of(env: Any, name: str, options: Mapping[str, Any] | None) -> Filter:
    """The filter of a placement environment, or a ValueError where the scene does not do."""
    task = getattr(env.unwrapped, "task", None)
    if not isinstance(task, PlacementTask):
        raise ValueError(f"env must be RBL/AnchorPlacement-v0, got {env.unwrapped}")
    filter = make_filter(env, task.scene, name, options)
    if task.racks:
        check_takes_noise(name, filter, "the racks give every epoch its own noise")
    check_determined(task, name, filter)
    return filter


# --- wrappers ---------------------------------------------------------------------------------


class FilterReward(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Pays the layout of `RBL/AnchorPlacement-v0` by how well a filter tracks with it.

    With the last anchor the reward is ``-log`` of the root mean square tag error in metres over
    8 tracks of 20 epochs through the work region, 0 before; in every mode. The body moves between
    way-points in the region at the scene's speed, with the scene's process noise, and the filter
    starts from the scene's initial uncertainty. The tracks and the noise are drawn from a
    generator that the problem's own numbers seed: the same layout of the same problem has the
    same reward, another problem other tracks.

    ``gym.make("rbl_gym:RBL/AnchorPlacement-v0", reward="filter", filter="iekf")`` makes it.

    Parameters
    ----------
    env
        The environment.
    filter, options
        Name of a filter and its options, as `EstimatePose`. One that the anchors cannot
        determine is refused: the filters of the Kalman family on the water's surface, say.

    Info
    ----
    `tag_error_m`, that error with the last anchor, 0 before; `score_m` stays the bound's.

    Examples
    --------
    >>> import gymnasium as gym
    >>> env = gym.make("rbl_gym:RBL/AnchorPlacement-v0", scene="uwb_room", reward="filter")
    >>> observation, info = env.reset(seed=1)
    >>> terminated = False
    >>> while not terminated:
    ...     observation, reward, terminated, _, info = env.step(env.action_space.sample())
    >>> abs(reward + np.log(info["tag_error_m"])) < 1e-12
    True
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        filter: str = "iekf",
        options: Mapping[str, Any] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, filter=filter, options=options)
        gym.Wrapper.__init__(self, env)
        self._filter = filter_of(env, filter, options)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, "tag_error_m": 0.0}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Place an anchor; the last one is paid."""
        observation, _, terminated, truncated, info = self.env.step(action)
        error, reward = 0.0, 0.0
        if terminated:
            error = float(_errors(self.env, self._filter, info))
            reward = -math.log(error)
        return observation, reward, terminated, truncated, {**info, "tag_error_m": error}


class VectorFilterReward(VectorWrapper, RecordConstructorArgs):
    """`FilterReward` for the vector environment, in every autoreset mode."""

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        filter: str = "iekf",
        options: Mapping[str, Any] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, filter=filter, options=options)
        VectorWrapper.__init__(self, env)
        self._filter = filter_of(env, filter, options)
        self._error_m = np.zeros(env.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes."""
        observation, info = self.env.reset(seed=seed, options=options)
        # Worlds that go on have not placed their last anchor, or are over and keep its error.
        self._error_m = np.where(info["score_m"] > 0, self._error_m, 0.0)
        return observation, self._told(info)

    def step(self, actions: Any) -> tuple[Any, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Place anchors; the last one of each world is paid."""
        observation, _, terminated, truncated, info = self.env.step(actions)
        error, reward = np.zeros(self.num_envs), np.zeros(self.num_envs)
        final = info.get("final_info", info)
        if terminated.any():
            complete = {key: final[key][terminated] for key in ("region", "racks", "anchors")}
            error[terminated] = _errors(self.env, self._filter, complete)
            reward[terminated] = -np.log(error[terminated])
        if final is not info:
            final["tag_error_m"], final["_tag_error_m"] = error, info["_final_info"].copy()
            error = np.zeros(self.num_envs)
        self._error_m = error
        return observation, reward, terminated, truncated, self._told(info)

    def _told(self, info: dict[str, Any]) -> dict[str, Any]:
        told = {
            "tag_error_m": self._error_m.copy(),
            "_tag_error_m": np.ones(self.num_envs, dtype=np.bool_),
        }
        return {**info, **told}


def _errors(env: Any, filter: Filter, info: Mapping[str, np.ndarray]) -> FloatArray:
    """Errors (...) of the filter in complete layouts, as the infos describe them."""
    region = info["region"]
    context = Context(region[..., :3], region[..., 3:], info["racks"])
    return track_error(env.unwrapped.task, context, info["anchors"], filter)


# --- what the id makes ------------------------------------------------------------------------


def anchor_placement(
    *,
    reward: str = "bound",
    filter: str = "iekf",
    options: Mapping[str, Any] | None = None,
    **arguments: Any,
) -> gym.Env[Any, Any]:
    """`RBL/AnchorPlacement-v0`: `AnchorPlacementEnv`, with ``reward="filter"`` in `FilterReward`.

    Parameters
    ----------
    reward
        ``"bound"`` or ``"filter"``.
    filter, options
        As `FilterReward`; only with ``reward="filter"``.
    **arguments
        As `AnchorPlacementEnv`.

    Raises
    ------
    ValueError
        On a reward, or a filter, that does not go with the scene.
    """
    env = AnchorPlacementEnv(**arguments)
    return FilterReward(env, filter, options) if _is_filtered(reward, filter, options) else env


def anchor_placement_vector(
    *,
    reward: str = "bound",
    filter: str = "iekf",
    options: Mapping[str, Any] | None = None,
    **arguments: Any,
) -> VectorEnv[Any, Any, Any]:
    """`anchor_placement` of many problems, with `AnchorPlacementVectorEnv`."""
    envs = AnchorPlacementVectorEnv(**arguments)
    filtered = _is_filtered(reward, filter, options)
    return VectorFilterReward(envs, filter, options) if filtered else envs


def _is_filtered(reward: str, filter: Any, options: Any) -> bool:
    if check_one_of("reward", reward, REWARDS) == "filter":
        return True
    if not isinstance(filter, str) or filter != "iekf" or options is not None:
        raise ValueError(
            "filter and options need reward='filter', got reward='bound' with filter = "
            f"{filter!r:.80}, options = {options!r:.80}"
        )
    return False


# Where Gymnasium looks for render modes.
anchor_placement.metadata = AnchorPlacementEnv.metadata  # pyright: ignore[reportFunctionMemberAccess]

"""Small worlds and single checks of `rbl_gym.testing`; each check raises AssertionError."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import metrics, motion
from rbl_gym.checks import FloatArray, imported, parse_filter
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import inertial, ranging

# Not coplanar, even if any one of them is left out.
ANCHORS = np.array([[-6, -5, 0.5], [6, -5, 4], [6, 5, 0], [-6, 5, 3.5], [0, -6, 2], [1, 6, 5.0]])
TAGS = bodies.octahedron(1.0)
NOISE, PROCESS = ranging.RangeNoise(0.05), motion.ProcessNoise(0.1, 0.1)
DT = 0.1
SENSOR = inertial.InertialSensor()
_PRIOR_STD = np.array([0.1, 0.1, 0.1, 0.2, 0.2, 0.2])
# Tolerance between results computed in different order, relative.
_SAME = 1e-6
# Largest acceptable average NEES per degree of freedom, without any model error.
_NEES = (1 / 3, 3.0)
FIELDS = ("rotation", "translation", "covariance")


class Epochs(NamedTuple):
    """A batch of bodies over some epochs, (K, B, ...), except for the prior (B, ...).

    `twists` is the input of `predict`: twists (K, B, 6), or inertial readings (K, B, S, 6).
    """

    rotation: FloatArray
    translation: FloatArray
    twists: FloatArray
    ranges: FloatArray
    prior: tuple[FloatArray, FloatArray, FloatArray]


# End of the message of a filter that accepts NaN.
NAN_ADVICE = (
    ". The page 'Your own estimator' names the functions that check the arguments of each method; "
    'or leave this check out: check_filter(..., skip=["nan"])'
)


def draw_epochs(
    rng: np.random.Generator, batch: tuple[int, ...], count: int, sensed: bool = False
) -> Epochs:
    """Draw bodies that move among `ANCHORS`, their ranges, and a prior around their poses.

    With `sensed` they have an inertial sensor, and the process noise does not move them.
    """
    twists = np.zeros((*batch, count, 6))
    twists[..., 1:, :] = 0.5 * rng.standard_normal((*batch, 1, 6))
    start = rotations.random(rng, batch), rng.uniform(-2, 2, (*batch, 3))
    # No motion leads to the first epoch, so its twist belongs to no interval.
    trajectory = motion.Trajectory(*start, twists[..., 1:, :])
    normals = None if sensed else rng.standard_normal((*batch, count - 1, 6))
    path = motion.simulate(trajectory, DT, PROCESS, normals)
    if sensed:
        twists = _sensed(rng, path, twists)
    ranges = ranging.simulate(
        ANCHORS, TAGS, path.rotation, path.translation, NOISE, rng
    ).ranges  # fmt: skip
    offset = _PRIOR_STD * rng.standard_normal((*batch, 6))
    covariance = np.broadcast_to(np.diag(_PRIOR_STD**2), (*batch, 6, 6)).copy()
    prior = rotations.exp(offset[..., :3]) @ start[0], start[1] + offset[..., 3:], covariance
    rotation, translation, twists, measured = (
        np.ascontiguousarray(np.moveaxis(array, len(batch), 0))
        for array in (path.rotation, path.translation, twists, ranges)
    )
    return Epochs(rotation, translation, twists, measured, prior)


def _sensed(rng: np.random.Generator, path: motion.Path, twists: FloatArray) -> FloatArray:
    """Return readings (..., K, S, 6) of the intervals that end at the epochs; zeros at first."""
    *batch, count, _ = twists.shape
    first = np.zeros((*batch, 1, SENSOR.samples(DT), 6))
    if count == 1:
        return first
    step = DT / SENSOR.samples(DT)
    # Within an interval the body rotates about a fixed axis of the world frame.
    middle = step * (np.arange(SENSOR.samples(DT)) + 0.5)[:, None]
    turns = rotations.exp(middle * twists[..., 1:, None, :3])
    at = turns @ path.rotation[..., :-1, None, :, :]
    rate = (np.swapaxes(at, -1, -2) @ twists[..., 1:, None, :3, None])[..., 0]
    force = inertial.specific_force(at, np.zeros(3))
    rate, force = (field.reshape((*batch, -1, 3)) for field in (rate, force))
    read = inertial.simulate(SENSOR, rate, force, rng, step).readings
    read = read.reshape((*batch, count - 1, -1, 6))
    return np.concatenate([first, read], axis=-3)


def require(condition: Any, message: str) -> None:
    """Raise AssertionError with the message if false, also under ``python -O``."""
    if not condition:
        raise AssertionError(message)


def factory_of(make_filter: str | Callable[..., Any]) -> Callable[..., Any]:
    """Return the factory of a path ``"module:factory"`` with options, or the factory itself."""
    if not isinstance(make_filter, str):
        return make_filter
    if ":" not in make_filter:
        raise ValueError(
            "make_filter must be a class, a function or 'module:factory'; for a filter with a name "
            f"write functools.partial(estimators.make, {make_filter!r:.80})"
        )
    path, options = parse_filter(make_filter)
    return partial(imported("make_filter", path), **options)


@contextmanager
def batched(batch: tuple[int, ...]) -> Iterator[None]:
    """Say in a failed check of a filter with leading axes `batch` what can be done about it."""
    try:
        yield
    except AssertionError as error:
        if not batch:
            raise
        raise AssertionError(
            f"{error}. A filter must accept leading batch axes (here {batch}), and this one "
            "accepts a single body: write its formulas for arrays (..., 3, 3), or use "
            "rbl_gym.estimators.one_by_one(factory), which loops over the bodies"
        ) from error


def call(name: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Return a function's result; an exception for valid arguments is a failure."""
    try:
        return function(*arguments, **options)
    except Exception as error:
        shapes = ", ".join(str(np.shape(a)) for a in arguments if isinstance(a, np.ndarray))
        raise AssertionError(
            f"{name} must accept valid arguments, raised {error!r}"
            + (f" on shapes {shapes}" if shapes else "")
        ) from error


def trial(epochs: Epochs, index: int) -> Epochs:
    """Return one trial of a batch with one axis."""
    rotation, translation, covariance = (array[index] for array in epochs.prior)
    rows = [array[:, index] for array in epochs[:4]]
    return Epochs(rows[0], rows[1], rows[2], rows[3], (rotation, translation, covariance))


def take(pose: Any, index: int) -> dict[str, FloatArray]:
    """Return one trial of a belief."""
    return {name: np.asarray(getattr(pose, name))[index] for name in FIELDS}


def moved_world(rng: np.random.Generator, level: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return a rotation (3, 3), only about the vertical if `level`, and a translation (3,)."""
    turn = rotations.random(rng)
    if level:
        turn = rotations.exp(rotations.log(turn) * np.array([0.0, 0.0, 1.0]))
    return turn, np.array([30.0, -20.0, 10.0])


def moved(pose: Any, turn: FloatArray, shift: FloatArray) -> dict[str, FloatArray]:
    """Return a belief in the rotated and translated world."""
    both = np.kron(np.eye(2), turn)
    return {
        "rotation": turn @ pose.rotation,
        "translation": pose.translation @ turn.T + shift,
        "covariance": both @ pose.covariance @ both.T,
    }


def check_state(state: Any, batch: tuple[int, ...]) -> None:
    """Check that a state is a NamedTuple of arrays with the leading axes of its batch."""
    require(
        isinstance(state, tuple)
        and hasattr(state, "_fields")
        and all(np.shape(field)[: len(batch)] == batch for field in state),
        "a state must be a NamedTuple of arrays whose leading axes are those of the prior, got "
        f"{type(state).__name__}: commands and vector environments index its arrays",
    )


def check_shapes(
    name: str, pose: Any, batch: tuple[int, ...], fields: Sequence[str] = (*FIELDS, "matrix")
) -> None:
    """Check for float arrays with the shapes for leading axes `batch`."""
    cores = {"rotation": (3, 3), "translation": (3,), "covariance": (6, 6), "matrix": (3, 3)}
    for field in fields:
        value = getattr(pose, field, None)
        want = (*batch, *cores[field])
        require(
            isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == want,
            f"{name}.{field} must be a float64 array of shape {want}, got "
            + (f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else f"{value!r}"),
        )


def check_pose(name: str, pose: Any) -> None:
    """Check for a proper rotation, and a symmetric positive definite covariance."""
    Q, P = np.asarray(pose.rotation), np.asarray(pose.covariance)
    require(np.isfinite(Q).all(), f"{name}.rotation must be finite, got {Q}")
    defect = np.abs(Q @ np.swapaxes(Q, -1, -2) - np.eye(3)).max()
    require(
        defect < _SAME,
        f"{name}.rotation must be orthogonal, but Q @ Q.T differs from I by {defect:.3g}",
    )
    worst = np.linalg.det(Q).min()
    require(worst > 0, f"{name}.rotation must be proper, got a reflection (det {worst:.3g})")
    require(np.isfinite(P).all(), f"{name}.covariance must be finite, got {P}")
    skew = np.abs(P - np.swapaxes(P, -1, -2)).max() / np.abs(P).max()
    require(
        skew < _SAME,
        f"{name}.covariance must be symmetric, but its relative asymmetry is {skew:.3g}",
    )
    least = np.linalg.eigvalsh(P).min()
    require(least > 0, f"{name}.covariance must be positive definite, least eigenvalue {least:.3g}")


def check_same(rule: str, expected: Any, found: Any, tolerance: float = _SAME) -> None:
    """Check for equal pose and covariance up to a relative tolerance (0: the same bytes)."""
    for field in FIELDS:
        want = np.asarray(expected[field] if isinstance(expected, dict)
                          else getattr(expected, field))  # fmt: skip
        got = np.asarray(getattr(found, field))
        require(got.shape == want.shape, f"{rule}: {field} has shape {got.shape}, not {want.shape}")
        scale = np.abs(want).max() if field == "covariance" else 1.0
        gap = np.abs(got - want).max(initial=0.0) / scale
        require(gap <= tolerance, f"{rule}: {field} differs by {gap:.3g}")


def check_pure(name: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Return a function's result, after checking that its arguments did not change."""
    before = [pickle.dumps(value) for value in (*arguments, *options.values())]
    result = call(name, function, *arguments, **options)
    for k, (value, old) in enumerate(zip((*arguments, *options.values()), before, strict=True)):
        require(
            pickle.dumps(value) == old,
            f"{name} must not change its arguments, but changed argument {k}",
        )
    return result


def check_links(estimate: Callable[[FloatArray, FloatArray, Any], Any], ranges: FloatArray) -> None:
    """Check that `estimate` (ranges, anchors, links) gives no weight to a link that is False."""
    full = np.ones(ranges.shape, dtype=np.bool_)
    plain = estimate(ranges, ANCHORS, None)
    check_same(
        "links all True must give the same as links=None", plain, estimate(ranges, ANCHORS, full)
    )
    links = full.copy()
    links[..., 2, :] = False
    without = estimate(np.delete(ranges, 2, axis=-2), np.delete(ANCHORS, 2, axis=0), None)
    for value in (0.0, 7.0, 1e3):
        behind = np.where(links, ranges, value)
        check_same(
            f"an anchor whose links are all False must have no influence, even with {value:g} as "
            "its ranges",
            without, estimate(behind, ANCHORS, links),
        )  # fmt: skip


def check_refuses_nan(
    name: str,
    function: Callable[..., Any],
    arguments: Sequence[str],
    values: Sequence[Any],
    advice: str = "",
) -> None:
    """Check that NaN in any one of the arguments raises ValueError; `advice` ends the message."""
    for k, argument in enumerate(arguments):
        wrong = [np.array(value, dtype=np.float64) for value in values]
        wrong[k].flat[0] = math.nan
        try:
            function(*wrong)
        except ValueError:
            continue
        except Exception as error:
            raise AssertionError(
                f"{name} must raise a ValueError on NaN in {argument}, raised {error!r}{advice}"
            ) from error
        raise AssertionError(
            f"{name} must raise a ValueError on NaN in {argument}, raised nothing{advice}"
        )


def check_nees(poses: Sequence[Any], rotation: FloatArray, translation: FloatArray) -> None:
    """Check that the average NEES per degree of freedom is acceptable."""
    values = []
    for k, pose in enumerate(poses):
        error = metrics.pose_error(pose.rotation, pose.translation, rotation[k], translation[k])
        values.append(metrics.nees(error, pose.covariance))
    average = float(np.mean(values)) / 6
    low, high = _NEES
    require(
        low <= average <= high,
        f"beliefs must be consistent, with NEES per degree of freedom between {low:.2g} and "
        f"{high:.2g}, got {average:.3g}: errors are {'larger' if average > high else 'smaller'} "
        "than claimed",
    )

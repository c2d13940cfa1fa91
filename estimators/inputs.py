"""Checks of the inputs of a filter: priors, and epochs of ranges with their links."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import (
    HUGE,
    BoolArray,
    FloatArray,
    at,
    check_array,
    check_finite,
    check_links,
    check_shape,
)
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import offsets
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

State = TypeVar("State", bound=tuple[Any, ...])
_FLOAT64 = np.dtype(np.float64)
# Largest accepted asymmetry of a covariance, in units of its largest entry.
_SYMMETRIC = 1e-8

# Variance of an entry of a uniformly random rotation: the variance of an uninformative prior.
VAGUE_ENTRY_VARIANCE = 1 / 3


def check_prior(
    rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike, sizes: tuple[int, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a checked prior: rotation, translation, and covariance of one of the sizes.

    The rotation is (..., 3, 3) and the translation (..., 3). Leading axes may differ, but must
    broadcast. Raises ValueError if an array is invalid.
    """
    if _is_plain_prior(rotation, translation, covariance, sizes):
        # Fast path for one body. Invalid input takes the slow path, which names the error.
        return rotation, translation, covariance  # pyrefly: ignore[bad-return]
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    return rotation, translation, check_covariance(covariance, sizes)


def _is_plain_prior(
    rotation: Any, translation: Any, covariance: Any, sizes: tuple[int, ...]
) -> bool:
    """Return whether the arguments are valid arrays of one body."""
    return (
        type(rotation) is type(translation) is type(covariance) is np.ndarray
        and rotation.dtype == translation.dtype == covariance.dtype == _FLOAT64
        and rotation.shape == (3, 3)
        and translation.shape == (3,)
        and covariance.shape in [(n, n) for n in sizes]
        and np.vdot(translation, translation) < HUGE
        and np.vdot(covariance, covariance) < HUGE
        and bool(is_sound(rotation, covariance, rotations.ORTHOGONAL, _SYMMETRIC))
    )


@compiled("priors:is_sound")
def is_sound(
    rotation: FloatArray, covariance: FloatArray, off_orthogonal: float, off_symmetric: float
) -> BoolArray:
    """Return whether rotations are proper, and covariances symmetric and positive definite (...).

    `off_orthogonal` is the largest accepted difference of ``Q Q^T`` and the identity.
    `off_symmetric` is that of the covariance and its transpose, in units of its largest entry.
    """
    Q, P = rotation, covariance
    defect = np.abs(Q @ np.swapaxes(Q, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    variance = np.diagonal(P, axis1=-2, axis2=-1).max(axis=-1)
    skew = np.abs(P - np.swapaxes(P, -1, -2)).max(axis=(-2, -1))
    proper = (defect <= off_orthogonal) & (np.linalg.det(Q) > 0)
    finite = np.asarray(np.isfinite(P).all(axis=(-2, -1)))
    smallest = np.linalg.eigvalsh(np.where(finite[..., None, None], P, 0.0))[..., 0]
    return proper & (skew <= off_symmetric * variance) & (smallest > 1e-14 * variance)


def check_covariance(covariance: ArrayLike, sizes: tuple[int, ...]) -> FloatArray:
    """Return a symmetric positive definite covariance of one of the sizes, or raise ValueError."""
    covariance = check_array("covariance", covariance, ("n", "n"))
    if covariance.shape[-1] not in sizes or covariance.shape[-2] != covariance.shape[-1]:
        wanted = " or ".join(f"(..., {n}, {n})" for n in sizes)
        raise ValueError(f"covariance must have shape {wanted}, got {covariance.shape}")
    skew = np.abs(covariance - np.swapaxes(covariance, -1, -2)).max()
    if skew > _SYMMETRIC * np.abs(covariance).max():
        raise ValueError(f"covariance must be symmetric, but its asymmetry is {skew:.3g}")
    smallest = np.linalg.eigvalsh(covariance).min()
    if smallest <= 0:
        raise ValueError(
            f"covariance must be positive definite, but its smallest eigenvalue is {smallest:g}"
        )
    return covariance


# What to do about a link without a range.
_NO_RANGE = "if the link has no range, set it to False in links"


def check_epoch(
    ranges: ArrayLike,
    anchors: ArrayLike,
    links: ArrayLike | None,
    tags: FloatArray,
    signed: bool = False,
) -> tuple[FloatArray, FloatArray, BoolArray | None]:
    """Return an epoch as (ranges, anchors, links); links are None if all were measured.

    Ranges behind a False link become 0. With `signed`, ranges may be zero and negative, as with an
    offset. ValueError if shapes do not match, or a range behind a True link is NaN, infinite or not
    positive.
    """
    if (
        links is None
        and not signed
        and links_of_plain_epoch(ranges, anchors, tags, ()) is not None
        and np.vdot(anchors, anchors) < HUGE  # pyrefly: ignore[no-matching-overload]
        and are_positive(ranges)  # pyrefly: ignore[bad-argument-type]
    ):
        # Fast path for one body. Invalid input takes the slow path, which names the error.
        return ranges, anchors, None  # pyrefly: ignore[bad-return]
    anchors = check_array("anchors", anchors, ("M", 3))
    shape = (anchors.shape[-2], tags.shape[-2])
    mask = check_links(links, shape)
    ranges = check_shape("ranges", ranges, shape)
    if mask is not None:
        try:
            ranges = np.where(mask, ranges, 0.0)
        except ValueError as error:
            raise ValueError(
                f"links and ranges must broadcast, got {mask.shape} and {ranges.shape}"
            ) from error
        if mask.all():
            mask = None
    check_batches(ranges=ranges.shape[:-2], anchors=anchors.shape[:-2])
    if signed:
        check_finite("ranges", ranges, _NO_RANGE)
    else:
        check_ranges(ranges, mask)
    return ranges, anchors, mask


class OffsetEpoch(NamedTuple):
    """An epoch of ranges with offsets: ranges (..., M, N) less the group means, and links."""

    ranges: FloatArray
    anchors: FloatArray
    links: BoolArray


def check_offset_epoch(
    ranges: ArrayLike, anchors: ArrayLike, links: ArrayLike | None, tags: FloatArray, offset: str
) -> OffsetEpoch:
    """Check an epoch of ranges with an unknown common offset of a kind, as `check_epoch`.

    Subtracting the means removes the offsets. A link that shares its offset with no other carries
    no information, and counts as missing.
    """
    ranges, anchors, mask = check_epoch(ranges, anchors, links, tags, signed=True)
    there = offsets.paired(np.broadcast_to(True if mask is None else mask, ranges.shape), offset)
    means = offsets.common(ranges, there.astype(np.float64), offset)
    return OffsetEpoch(np.where(there, ranges - means, 0.0), anchors, there)


def links_of_plain_epoch(
    ranges: Any, anchors: Any, tags: FloatArray, batch: tuple[int, ...]
) -> FloatArray | None:
    """Return read-only ones (M, N) if these are float64 arrays of trials (*batch), else None.

    Ranges (*batch, M, N), anchors (*batch, M, 3), tags of one body (N, 3); their values are not
    checked.
    """
    if (
        type(ranges) is type(anchors) is np.ndarray
        # Not by identity, because pickled arrays have their own dtype object.
        and ranges.dtype == anchors.dtype == _FLOAT64
    ):
        return _links_of_shapes(ranges.shape, anchors.shape, tags.shape, batch)
    return None


@functools.lru_cache(256)
def _links_of_shapes(
    ranges: tuple[int, ...], anchors: tuple[int, ...], tags: tuple[int, ...], batch: tuple[int, ...]
) -> FloatArray | None:
    if not (
        len(anchors) > 1
        and anchors == (*batch, anchors[-2], 3)
        and ranges == (*batch, anchors[-2], tags[0])
        and len(tags) == 2
        and math.prod(ranges) > 0
    ):
        return None
    ones = np.ones(ranges[-2:])
    ones.flags.writeable = False
    return ones


def check_batches(**batches: tuple[int, ...]) -> None:
    """Raise ValueError if the leading axes of the named arguments do not broadcast."""
    if not any(batches.values()):
        return
    try:
        np.broadcast_shapes(*batches.values())
    except ValueError as error:
        raise ValueError(
            f"leading axes of {' and '.join(batches)} must broadcast, got "
            f"{' and '.join(map(str, batches.values()))}"
        ) from error


def check_ranges(ranges: FloatArray, links: BoolArray | None = None) -> None:
    """Raise ValueError if a range behind a True link is NaN, infinite or not positive."""
    if links is None and are_positive(ranges):
        return
    check_finite("ranges", ranges, _NO_RANGE)
    wrong = ranges <= 0 if links is None else (ranges <= 0) & links
    if wrong.any():
        index = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(f"ranges must be positive where measured, got {ranges[index]}{at(index)}")


def are_positive(values: FloatArray) -> bool:
    """Return whether all values are positive and finite; NaN fails both comparisons."""
    positive = np.count_nonzero(values > 0) == values.size
    return positive and bool(np.vdot(values, values) < HUGE or values.max() < HUGE)


def epoch_variance(
    noise: NoiseLaw | None,
    own: NoiseLaw,
    ranges: FloatArray,
    links: BoolArray | None,
    squared: bool = False,
) -> FloatArray:
    """Return the checked variances of an epoch's ranges.

    They come from the noise model of the epoch; None: from the filter's `own`. With `squared` they
    are those of the squared ranges. Variances that no link uses are 1. ValueError if the argument
    is not a noise model of ranges, or does not match these ranges.
    """
    law = law_of(noise, own)
    try:
        variance = (law.squared_range_variance if squared else law.variance)(ranges, links)
        if variance.shape != ranges.shape:
            np.broadcast_shapes(variance.shape, ranges.shape)
    except ValueError as error:
        raise ValueError(f"noise must fit ranges of shape {ranges.shape}: {error}") from error
    return check_variance(variance, links)


def check_variance(variance: FloatArray, links: BoolArray | None) -> FloatArray:
    """Return the variances, 1 if no link uses them, or raise ValueError if not positive."""
    if links is not None:
        used = links if variance.shape[-1] == links.shape[-1] else links.any(-1, keepdims=True)
        variance = np.where(used, variance, 1.0)
    # NaN also gives False.
    if np.count_nonzero(variance > 0) < variance.size:
        raise ValueError(f"noise must have positive variance at the ranges, got {variance.min()}")
    return variance


def plain(state: State) -> State:
    """Return a state with arrays in C order, so that results do not depend on memory layout."""
    for field in state:
        if type(field) is not np.ndarray or not field.flags.c_contiguous:
            return type(state)(*(np.asarray(field, order="C") for field in state))
    return state


def law_of(noise: NoiseLaw | None, own: NoiseLaw) -> NoiseLaw:
    """Return the checked noise model of an epoch; None gives that of the filter.

    ValueError if the argument is not a noise model of ranges.
    """
    if noise is None:
        return own
    if not callable(getattr(noise, "variance", None)) or not callable(
        getattr(noise, "squared_range_variance", None)
    ):
        raise ValueError(
            "noise must be a noise law such as ranging.RangeNoise (with variance and "
            f"squared_range_variance), or None, got {noise!r:.80}"
        )
    return noise


def spanned_dimensions(points: FloatArray) -> np.ndarray:
    """Return the dimension (...) of points (..., N, 3): 0 point, 1 line, 2 plane, 3 space."""
    return matrix_rank(points - points.mean(axis=-2, keepdims=True))


def matrix_rank(rows: FloatArray) -> np.ndarray:
    """Return the rank (...) of matrices (..., m, n): singular values above 1e-9 of the largest."""
    values = np.linalg.svd(rows, compute_uv=False)
    return (values > 1e-9 * np.maximum(values[..., :1], 1e-300)).sum(axis=-1)


def check_one_process(process: ProcessNoise) -> ProcessNoise:
    """Return the process noise, or raise ValueError if each trial has its own."""
    if np.ndim(process.std()) > 1:
        raise ValueError(
            "process must be the same for all trials, got leading axes "
            f"{process.std().shape[:-1]}; only the filter 'iekf' takes a process for each trial"
        )
    return process

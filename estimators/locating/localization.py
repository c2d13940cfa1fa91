"""Static localization: estimate a pose and its covariance from one epoch of ranges.

`locate` is the entry point; its methods are in `locators`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import bounds
from rbl_gym.checks import (
    BoolArray,
    FloatArray,
    are_finite,
    check_array,
    check_number,
    check_one_of,
    did_you_mean,
    kernel,
)
from rbl_gym.estimators.inputs import (
    check_batches,
    check_epoch,
    check_offset_epoch,
    check_variance,
    spanned_dimensions,
)
from rbl_gym.estimators.linear.least_squares import RETRACTIONS
from rbl_gym.estimators.locating.locators import METHODS, Fit, StaticEpoch
from rbl_gym.estimators.locating.maximum_likelihood import Alternatives, no_alternatives
from rbl_gym.measurements import offsets, ranging
from rbl_gym.measurements.ranging import NoiseLaw

# Called without input checks, because an unknown pose is NaN.
_DISTANCES = kernel(ranging.distances)

ENTRY_POINT_GROUP = "rbl_gym.locators"
# Trials of a block: their arrays fit in the processor's cache.
_BLOCK = 512


class PoseEstimate(NamedTuple):
    """A pose from one epoch of ranges, with leading batch axes.

    Attributes
    ----------
    rotation, translation
        (..., 3, 3), always a proper rotation, and (..., 3) in metres. NaN if the links of a trial
        are not enough for the method.
    covariance
        (..., 6, 6) of the error (w, v), ``rotation = exp(w) Q``, ``translation = t + v``, as
        predicted for the method. Very large along directions that the ranges do not determine.
    cost
        (...), half the sum of squared whitened range residuals at the pose. For `robust`, only of
        the inliers.
    converged
        (...), whether the method converged to a solution of its own problem.
    rank
        (...), number of the 6 degrees of freedom that the ranges determine. Below 6 the pose is not
        unique.
    alternatives
        Other poses that fit the ranges about as well (within 3 sigma of the cost), such as mirror
        poses. ``ml`` and ``robust`` search for them if the geometry is poor. The search can miss
        the mirror pose of a body near the plane of its anchors; `geometry.mirror.mirror_pose`
        computes it.
    matrix
        (..., 3, 3), the raw matrix of ``ls``; for all other methods the rotation.
    iterations
        (...), number of steps until ``nia``, ``pso`` and ``psa`` converged; 0 for all other
        methods.
    """

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    cost: FloatArray
    converged: BoolArray
    rank: np.ndarray
    alternatives: Alternatives
    matrix: FloatArray
    iterations: np.ndarray


def locate(
    ranges: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
    noise: NoiseLaw,
    method: str = "ml",
    links: ArrayLike | None = None,
    tag_std_m: float = 0.0,
    retraction: str = "exponential",
    offset: str | None = None,
) -> PoseEstimate:
    """Estimate the pose of a body from one epoch of ranges; batched.

    Parameters
    ----------
    ranges
        (..., M, N), metres.
    anchors, tags
        (..., M, 3) in the world frame and (..., N, 3) in the body frame, metres.
    noise
        Noise model of the ranges; variances are evaluated at the measured ranges.
    method
        One of these names, or a name from the entry-point group ``rbl_gym.locators`` of another
        package:

        * ``"ml"``: maximum likelihood of the raw ranges, with a global search if the geometry is
          poor.
        * ``"robust"``: for ranges with outliers. ``"robust-late"``: for radio ranges, whose
          outliers are mostly too long. Weights fall with the square of the residual, and are halved
          for every range longer than predicted.
        * ``"two-step"``: ``cls``, then two Gauss-Newton steps on the raw ranges.
        * ``"ls"``: least squares on the squared ranges without the constraint (static paper, (14)).
        * ``"ls-projected"``: projects the matrix of ``ls`` onto SO(3), then computes the
          translation (slides).
        * ``"cls"`` (alias ``"ctls"``): the position of each tag, then an orthogonal Procrustes fit
          (static paper, (17)-(21), Lemmas 1 and 2, Algorithm 1).
        * ``"procrustes"`` (alias ``"uc-ls"``): weighted orthogonal Procrustes fit by Newton's
          method, the optimum of the constrained least squares (static paper, Remark 2; slides,
          appendix).
    links
        Mask (..., M, N), True = measured.
    tag_std_m
        Standard deviation of the errors of the tag positions on the body, per axis. ``ml``
        marginalises these errors; the other methods ignore them.
    retraction
        How Newton's method of ``procrustes`` maps a step to a rotation: ``"exponential"`` or
        ``"cayley"`` (slides). Both converge to the same pose.
    offset
        Which ranges share an unknown offset. ``"tag"``: all ranges of a tag (uplink time
        differences). ``"anchor"``: all ranges of an anchor. ``"epoch"``: all ranges of the epoch.
        None: no offset. With an offset, ranges may be negative, variances are evaluated at the
        distances from the pose, and `rank` accounts for the offset. Each tag then needs one more
        anchor. The squared-range methods need five anchors, because they estimate an offset for
        each tag.

    Raises
    ------
    ValueError
        If shapes are wrong, values are NaN, ranges are not positive, or the method is unknown.
        If `retraction` is not ``"exponential"`` and the method is not ``procrustes``. If `offset`
        is given with `tag_std_m`, or is ``"anchor"`` for a squared-range method. If a squared-range
        method has too few anchors or tags: it needs four anchors that are not coplanar, and tags
        that are not collinear (``ls``: not coplanar).
    """
    fit = _method(method)
    check_one_of("retraction", retraction, list(RETRACTIONS))
    if retraction != "exponential" and fit is not METHODS["procrustes"]:
        raise ValueError(
            f"retraction {retraction!r} is for the methods 'procrustes' and 'uc-ls', "
            f"got method {method!r}"
        )
    ranging.check_law("noise", noise)
    tags = check_array("tags", tags, ("N", 3))
    tag_std_m = check_number("tag_std_m", tag_std_m, low=0.0, high=1e5)
    offsets.check_offset(offset)
    if offset is not None:
        _check_offset(method, offset, tag_std_m)
        ranges, anchors, mask = check_offset_epoch(ranges, anchors, links, tags, offset)
    else:
        ranges, anchors, mask = check_epoch(ranges, anchors, links, tags)
    check_batches(ranges=ranges.shape[:-2], tags=tags.shape[:-2])
    if offset is None:
        epoch, batch = _epoch(ranges, anchors, tags, noise, mask, tag_std_m)
        return _in_blocks(fit, method, epoch._replace(retraction=retraction), batch)
    # Variances at the centre of the anchors first, then at the pose.
    distance = _DISTANCES(anchors, anchors.mean(axis=-2, keepdims=True))
    epoch, batch = _epoch(ranges, anchors, tags, noise, mask, tag_std_m, distance)
    found = _in_blocks(fit, method, epoch._replace(retraction=retraction, offset=offset), batch)
    there = _DISTANCES(
        anchors, tags @ np.swapaxes(found.rotation, -1, -2) + found.translation[..., None, :]
    )
    distance, weights = np.where(np.isfinite(there), there, distance), epoch.weights
    epoch, batch = _epoch(ranges, anchors, tags, noise, mask, tag_std_m, distance)
    if np.array_equal(epoch.weights, weights):
        return found
    return _in_blocks(fit, method, epoch._replace(retraction=retraction, offset=offset), batch)


def _in_blocks(
    fit: Callable[[StaticEpoch], Fit], method: str, epoch: StaticEpoch, batch: tuple[int, ...]
) -> PoseEstimate:
    blocks = [
        _solve(fit, _rows(epoch, slice(start, start + _BLOCK)))
        for start in range(0, len(epoch.ranges), _BLOCK)
    ]
    if method in _NEEDS and not all(np.isfinite(block[1]).all() for block in blocks):
        _check_geometry(method, epoch)
    fields = joined(blocks, batch)
    return PoseEstimate(
        *fields[:6],
        alternatives=Alternatives(*fields[6:9]),
        matrix=fields[9],
        iterations=np.zeros(batch, int),
    )


def joined(blocks: list[tuple[np.ndarray, ...]], batch: tuple[int, ...]) -> list[np.ndarray]:
    """Return the fields of all blocks of trials, with the leading axes of the trials."""
    fields = blocks[0] if len(blocks) == 1 else map(np.concatenate, zip(*blocks, strict=True))
    return [field.reshape((*batch, *field.shape[1:])) for field in fields]


def _solve(fit: Callable[[StaticEpoch], Fit], epoch: StaticEpoch) -> tuple[np.ndarray, ...]:
    """Return the fields of a `PoseEstimate` (three for alternatives) of one block of trials."""
    found = fit(epoch)
    rotation, translation = found.rotation, found.translation
    known = are_finite(translation, 1) & are_finite(rotation, 2)
    cost, information = found.cost, found.information
    if cost is None or information is None:
        cost = _range_cost_of(epoch, rotation, translation, known)
        rank = _rank_of_tags(epoch.tags)
    else:
        rank = bounds.information_rank(information)
    return (
        rotation,
        translation,
        found.covariance,
        cost,
        found.converged,
        np.where(known, rank, 0),
        *(found.alternatives or no_alternatives(len(known))),
        rotation if found.matrix is None else found.matrix,
    )


def _range_cost_of(
    epoch: StaticEpoch, rotation: FloatArray, translation: FloatArray, known: BoolArray
) -> FloatArray:
    """Return half the sum of squared whitened range residuals (B,); infinite without a pose."""
    turned = epoch.tags @ np.swapaxes(rotation, -1, -2)
    residual = _DISTANCES(epoch.anchors, turned + translation[:, None]) - epoch.ranges
    if epoch.offset is not None:
        residual = offsets.centred(residual, epoch.weights, epoch.offset)
    cost = 0.5 * np.einsum("bmn,bmn,bmn->b", epoch.weights, residual, residual)
    return np.where(known, cost, np.inf)


def _rank_of_tags(tags: FloatArray) -> np.ndarray:
    """Return the rank of the pose if every tag is located: 3 for a point, 5 for a line, else 6."""
    if tags.strides[0] == 0:
        tags = tags[:1]
    gram = np.einsum("bni,bnj->bij", *[tags - tags.mean(axis=1, keepdims=True)] * 2)
    values = np.linalg.eigvalsh(gram)
    spans = (values > 1e-18 * np.maximum(values[:, 2:], 1e-300)).sum(axis=-1)
    return np.array([3, 5, 6, 6])[spans]


def _rows(epoch: StaticEpoch, rows: slice) -> StaticEpoch:
    """Return some of the trials."""
    ranges, anchors, tags, weights, squared_weights = (array[rows] for array in epoch[:5])
    return StaticEpoch(ranges, anchors, tags, weights, squared_weights, *epoch[5:])


def _epoch(
    ranges: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    noise: NoiseLaw,
    mask: BoolArray | None,
    tag_std_m: float,
    distance: FloatArray | None = None,
) -> tuple[StaticEpoch, tuple[int, ...]]:
    """Return one flat batch of all leading axes, and their shape.

    Variances are evaluated at the ranges, or at a `distance` (..., M, N).
    """
    told = ranges if distance is None else np.broadcast_to(distance, ranges.shape)
    variance = check_variance(noise.variance(told, mask), mask)
    squared = check_variance(noise.squared_range_variance(told, mask), mask)
    masks = () if mask is None else (mask.shape[:-2],)
    batch = np.broadcast_shapes(
        ranges.shape[:-2], anchors.shape[:-2], tags.shape[:-2], variance.shape[:-2], *masks
    )

    def flat(array: Any, shape: tuple[int, ...]) -> Any:
        if array.shape != (*batch, *shape):
            array = np.broadcast_to(array, (*batch, *shape))
        return array.reshape(-1, *shape)

    links, tag_rows = ranges.shape[-2:], tags.shape[-2:]
    weights, squared_weights = 1 / variance, 1 / squared
    if mask is not None:
        weights, squared_weights = (np.where(mask, w, 0.0) for w in (weights, squared_weights))
    epoch = StaticEpoch(
        flat(ranges, links), flat(anchors, anchors.shape[-2:]), flat(tags, tag_rows),
        flat(weights, links), flat(squared_weights, squared_weights.shape[-2:]), tag_std_m,
    )  # fmt: skip
    return epoch, batch


# Rank of the anchors and of the tags that the squared-range methods need.
_NEEDS = {"ls": (3, 3), "ls-projected": (3, 3)} | dict.fromkeys(
    ("cls", "ctls", "procrustes", "uc-ls"), (3, 2)
)


def _check_offset(method: str, offset: str, tag_std_m: float) -> None:
    """Raise ValueError if a method does not support the ranges' offsets."""
    if method not in METHODS:
        raise ValueError(f"offset needs one of the methods {', '.join(METHODS)}, got {method!r}")
    if tag_std_m != 0:
        raise ValueError(f"offset needs tag_std_m = 0, got {tag_std_m!r}")
    if offset == "anchor" and method not in ("ml", "robust"):
        raise ValueError(f"offset 'anchor' needs method 'ml' or 'robust', got {method!r}")


def _check_geometry(method: str, epoch: StaticEpoch) -> None:
    anchors, tags = epoch.anchors, epoch.tags
    if epoch.offset is not None and anchors.shape[-2] < 5:
        raise ValueError(
            f"method {method!r} needs 5 anchors for ranges with an unknown offset, got "
            f"{anchors.shape[-2]}; method 'ml' takes any geometry and returns its rank"
        )
    needs = zip(("anchors", "tags"), (anchors, tags), _NEEDS[method], strict=True)
    for name, points, needed in needs:
        rank = spanned_dimensions(points).min()
        if rank < needed:
            raise ValueError(
                f"method {method!r} needs {name} that span {needed} dimensions, got "
                f"{points.shape[-2]} of rank {rank}; method 'ml' takes any geometry and returns "
                "its rank"
            )


def methods() -> list[str]:
    """Return the names of all methods, built in or of installed packages (``rbl_gym.locators``)."""
    return sorted({*METHODS, *(entry.name for entry in entry_points(group=ENTRY_POINT_GROUP))})


def _method(name: str) -> Callable[[StaticEpoch], Fit]:
    if isinstance(name, str) and name in METHODS:
        return METHODS[name]
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name == name:
            return entry.load()
    raise ValueError(
        f"method must be one of {', '.join(map(repr, methods()))}, got {name!r:.80}"
        f"{did_you_mean(name, methods())}"
    )

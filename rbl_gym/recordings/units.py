"""Check that the units of a recording fit together, by triangle inequalities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray

# Oldest range of a link (s) that is still used. The body moves little in this time compared with
# its distance to an anchor.
_STALE_S = 0.5
# Largest number of epochs and of pairs of points that are checked.
_EPOCHS, _PAIRS = 500, 200
# With fewer pairs of ranges, all may be wrong by chance.
_FEWEST = 12
# Points are too far apart if the sum of two ranges is below this share of their distance. They
# are too close if ranges differ by more than this multiple of their distance.
_SUM, _TOO_NEAR = 0.9, 20.0
# Differences of ranges below this share of a range may be noise.
_NOISE = 0.03
# Tags are too far apart if nine in ten differences of ranges are below this share of their
# distance. All anchors would then lie broadside to all pairs of tags, within three degrees.
_BROADSIDE = 0.05
# Below this ratio the unit is more likely a thousandth than a hundredth.
_MILLI = 3e-3
# Points with a spread below this share of their size, or of the range, count as flat.
_FLAT = 0.1
# The median range over the mean distance of the anchors from their centre, or its inverse.
_MAX_SCALE_RATIO = 50.0


def check_units(
    paths: tuple[str, str, str],
    times: FloatArray,
    ranges: FloatArray,
    links: BoolArray,
    anchors: FloatArray,
    tags: FloatArray,
    anchors_are: str = "stand",
) -> None:
    """Raise ValueError if ranges (K, M, N), anchors (M, 3) and tags (N, 3) cannot be in one unit.

    A range r of a point p obeys ``|r - r'| <= |p - p'| <= r + r'`` for two anchors of one tag and
    for two tags of one anchor; noise adds to the left side. Most pairs must obey it. `paths` are
    the files of the ranges, the anchors and the tags, for the message. `anchors_are`: ``"stand"``
    if they are fixed around the body, ``"carried"`` if they are on another body, which may be far
    away, ``"move"`` if they move around these positions.
    """
    typical = float(np.median(ranges[links]))
    layout = np.linalg.norm(anchors - anchors.mean(axis=0), axis=-1).mean()
    # A single anchor, or anchors at one position, contain no information on the scale.
    scale = typical / layout if layout > 1e-6 and anchors_are == "stand" else 1.0
    if not 1 / _MAX_SCALE_RATIO <= scale <= _MAX_SCALE_RATIO:
        hint = (
            "are the ranges in cm or mm? set --unit"
            if scale > 1
            else f"are the positions in {paths[1]} in cm or mm{_remedy(paths, 'anchors')}, or is "
            "the unit of the ranges wrong?"
        )
        raise ValueError(
            f"{paths[0]}: units look inconsistent, the median range is {typical:.4g} m and "
            f"the anchors lie {layout:.4g} m from their centre: {hint}"
        )
    newest, fresh = _held(times, ranges, links)
    _check_spread(paths, tags, anchors, newest, fresh, typical)
    if anchors_are != "move":
        _check_pairs(paths, "anchors", anchors, ranges.swapaxes(1, 2), links.swapaxes(1, 2),
                 newest.swapaxes(1, 2), fresh.swapaxes(1, 2), typical)  # fmt: skip
    _check_pairs(paths, "tags", tags, ranges, links, newest, fresh, typical)


def _remedy(paths: Sequence[str], kind: str) -> str:
    """Return how to state another unit of positions; they may be in the file of the ranges."""
    before = "a" if paths[0] == paths[1] and kind == "anchors" else f"{kind}."
    names = ",".join(f"{before}{axis}=NAME[mm]" for axis in "xyz")
    return f' (then give --columns "{names}")'


def _held(times: FloatArray, ranges: FloatArray, links: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return the last range of every link at some epochs, and whether it is recent enough.

    Radios that measure one link at a time never have two ranges in one epoch.
    """
    count = len(times)
    last = np.where(links, np.arange(count)[:, None, None], -1)
    last = np.maximum.accumulate(last, axis=0)[:: 1 + count // _EPOCHS]
    now = times[:: 1 + count // _EPOCHS, None, None]
    fresh = (last >= 0) & (now - times[last] <= _STALE_S)
    return np.take_along_axis(ranges, np.maximum(last, 0), axis=0), fresh


def _pairs(points: FloatArray) -> tuple[np.ndarray, np.ndarray, FloatArray]:
    """Return indices of pairs of distinct points, and their distances."""
    one, other = np.triu_indices(len(points), 1)
    distance = np.linalg.norm(points[one] - points[other], axis=-1)
    far = np.flatnonzero(distance > 1e-9)[:: 1 + len(one) // _PAIRS]
    return one[far], other[far], distance[far]


def _check_pairs(
    paths: tuple[str, str, str],
    name: str,
    points: FloatArray,
    ranges: FloatArray,
    links: BoolArray,
    newest: FloatArray,
    fresh: BoolArray,
    typical: float,
) -> None:
    """Raise ValueError if points (P, 3), last axis of the ranges, break a triangle inequality."""
    path = paths[1 if name == "anchors" else 2]
    one, other, distance = _pairs(points)
    both = fresh[..., one] & fresh[..., other]
    if both.sum() >= _FEWEST:
        total = (newest[..., one] + newest[..., other])[both]
        apart = np.broadcast_to(distance, both.shape)[both]
        if np.median(total / apart) < _SUM:
            raise ValueError(
                f"{path}: units look inconsistent, {name} are {np.median(apart):.4g} m apart, "
                f"but the ranges to two of them have a sum of only {np.median(total):.4g} m: are "
                f"the positions of the {name} in cm or mm?{_remedy(paths, name)} "
                f"Or is the unit of the ranges in {paths[0]} wrong (--unit)?"
            )
    some = slice(None, None, 1 + len(ranges) // _EPOCHS)
    ranges, links = ranges[some], links[some]
    both = links[..., one] & links[..., other]
    if both.sum() >= _FEWEST:
        gap = np.abs(ranges[..., one] - ranges[..., other])[both]
        apart = np.broadcast_to(distance, both.shape)[both]
        if np.median(gap / apart) > _TOO_NEAR and np.median(gap) > _NOISE * typical:
            raise ValueError(
                f"{path}: units look inconsistent, {name} are {np.median(apart):.4g} m apart, "
                f"but the ranges to them differ by {np.median(gap):.4g} m: are the positions and "
                "the ranges in the same unit?"
            )


def _check_spread(
    paths: tuple[str, str, str],
    tags: FloatArray,
    anchors: FloatArray,
    newest: FloatArray,
    fresh: BoolArray,
    typical: float,
) -> None:
    """Raise ValueError if tags are so far apart that all anchors would lie broadside to them."""
    one, other, distance = _pairs(tags)
    both = fresh[..., one] & fresh[..., other]
    if both.sum() < _FEWEST:
        return
    # For points on a line, the directions broadside to all pairs fill a plane. For a flat body
    # they form a line. For a solid there are none.
    size = _extents(tags)
    solid = int((size > _FLAT * size[0]).sum())
    reach = np.append(_extents(anchors), np.inf)[[2, 1, 3][solid - 1]]
    if reach < _FLAT * typical:
        return
    share = (np.abs(newest[..., one] - newest[..., other]) / distance)[both]
    seen = float(np.quantile(share, 0.9))
    if seen < _BROADSIDE:
        unit = "mm" if seen < _MILLI else "cm"
        raise ValueError(
            f"{paths[2]}: units look inconsistent, tags are up to {distance.max():.4g} m apart, "
            "but the ranges of an anchor to two tags differ by at most "
            f"{100 * seen:.2g} % of this: are the positions of the tags in "
            f"{unit}?{_remedy(paths, 'tags').replace('mm', unit)}"
        )


def _extents(points: FloatArray) -> FloatArray:
    """Return the root mean squares (3,) of points (P, 3) along their principal axes, descending."""
    spread = (points - points.mean(axis=0)) / np.sqrt(len(points))
    values = np.linalg.svd(spread, compute_uv=False)
    return np.pad(values, (0, 3 - len(values)))

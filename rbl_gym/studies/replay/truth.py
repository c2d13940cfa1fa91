"""Match truth to a track, and find constant faults of the truth that would explain the errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import motion, recordings
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.recordings.truth import Truth

# A fault is reported if the errors exceed this multiple of their expectation (mean squares), and
# its correction leaves less than this share of them.
_LARGE, _EXPLAINED = 0.5, 0.25
# A constant transform explains any error of a body at rest. For a body that moves further than the
# error, it must explain more, or the errors must exceed this multiple of their expectation.
_MOST_EXPLAINED, _HUGE = 0.1, 4.0
# The first listed fault is preferred unless another one leaves fewer errors by this factor.
_AS_GOOD = 1.5
# Fewest poses that determine a fault; the tested time shifts (s), then those around the best.
_FEWEST = 4
_SHIFTS, _FINE_SHIFTS = np.linspace(-3.0, 3.0, 31), np.linspace(-0.15, 0.15, 7)
# Angle within which a turn is taken for a half turn, and its axis for horizontal or diagonal.
_NEAR_RAD = math.radians(15.0)
# Variance above which a rotation is undetermined.
_OPEN_RAD2 = 1.0
# Begins the hint at a reflection of planar motion.
MIRROR_IMAGE = (
    "the track is a mirror image of the truth: x and y of the anchors (or of the truth) look "
    "swapped, or one of their axes inverted"
)


def matched(
    truth: Truth, times: FloatArray, rotation: FloatArray, translation: FloatArray, gap_s: float
) -> tuple[FloatArray | None, FloatArray, BoolArray]:
    """Return truth at the epochs of a track: rotation (K, 3, 3), translation (K, 3), known (K,).

    The rotation is None if the truth has none. The truth is interpolated between two poses that are
    at most `gap_s` apart. A pose of the truth without such a neighbour is compared with the track
    at its own time. It counts for the nearest epoch, and is moved there along the track.
    """
    turned, moved, known = recordings.truth_at(truth, times, gap_s)
    turned = None if turned is None else turned.copy()
    moved, known = moved.copy(), known.copy()
    alone = np.diff(truth.times, prepend=-np.inf, append=np.inf) > gap_s
    at = np.flatnonzero(alone[:-1] & alone[1:])
    after = np.clip(np.searchsorted(times, truth.times[at]), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    inside = (truth.times[at] >= times[before]) & (truth.times[at] <= times[after])
    near = np.minimum(
        np.abs(truth.times[at] - times[before]), np.abs(times[after] - truth.times[at])
    )
    bridged = inside & ((times[after] - times[before] <= gap_s) | (near == 0))
    if not bridged.any():
        return turned, moved, known
    at, before, after = at[bridged], before[bridged], after[bridged]
    later = times[after] - truth.times[at] <= truth.times[at] - times[before]
    epoch = np.where(later, after, before)
    path = motion.interpolate(times, rotation, translation, truth.times[at])
    if turned is not None and truth.rotation is not None:
        onward = rotation[epoch] @ np.swapaxes(path.rotation, -1, -2)
        turned[epoch] = onward @ truth.rotation[at]
    moved[epoch] = truth.translation[at] + translation[epoch] - path.translation
    known[epoch] = True
    return turned, moved, known


class Judged(NamedTuple):
    """Estimates and truth (L, ...) at the epochs with truth, and the variances of the beliefs.

    `turn_variance` and `place_variance` (L,) are the traces of the rotation and position
    covariances. Without `has_rotation`, the true rotations are those of the estimates and have no
    meaning.
    """

    times: FloatArray
    rotation: FloatArray
    translation: FloatArray
    true_rotation: FloatArray
    true_translation: FloatArray
    turn_variance: FloatArray
    place_variance: FloatArray
    has_rotation: bool = True

    def excess(self) -> float:
        """Return mean squared errors over their expectation: 1 if the beliefs are consistent."""
        if not self.has_rotation:
            return self.place_excess()
        turn = (rotations.error(self.rotation, self.true_rotation) ** 2).sum(axis=-1)
        return 0.5 * (float((turn / self.turn_variance).mean()) + self.place_excess())

    def place_excess(self) -> float:
        """Return `excess` of the positions alone."""
        place = ((self.translation - self.true_translation) ** 2).sum(axis=-1)
        return float((place / self.place_variance).mean())

    def rmse(self) -> str:
        """Return the root mean square errors of position and determined rotation, as text."""
        turn = rotations.error(self.rotation, self.true_rotation)
        place = self.translation - self.true_translation
        turn_deg, place_m = (np.sqrt((a**2).sum(-1).mean()) for a in (np.rad2deg(turn), place))
        known = self.has_rotation and np.median(self.turn_variance) < _OPEN_RAD2
        return f"{place_m:.3g} m" + (f" and {turn_deg:.3g} deg" if known else "")


def fault_hints(
    at: Callable[[float, bool], Judged], seen: Callable[[FloatArray], FloatArray], planar: bool,
    told_s: float = 0.0,
) -> list[str]:  # fmt: skip
    """Return at most two constant faults of the truth that explain most of the errors.

    Tested are the order and the direction of the quaternions, the unit of the positions, a time
    shift, and, alone or in addition, a rigid transform of the world frame or of the body frame.

    ``at(delay, rotations)`` returns the compared poses at some epochs: `delay`, in seconds,
    corrects the time stamps of the truth; with `rotations` the result has those of the file,
    otherwise none. `seen` converts rotations (L, 3, 3) of the file to those that are compared; if
    `planar`, the position has only x and y. `told_s` is the time offset by which the truth has been
    corrected.
    """

    def mended(judged: Judged) -> Judged:
        if not judged.has_rotation:
            return judged
        return judged._replace(true_rotation=seen(judged.true_rotation))

    as_read = at(0.0, True)
    if len(as_read.times) < _FEWEST:
        return []
    judged = mended(as_read)
    late = [(text, mended(other)) for text, other in _late(at, told_s)]
    # Cautious beliefs hide a shift that explains most of the position errors.
    shifts = [
        f"{text}: the errors would be {other.rmse()} instead of {judged.rmse()}"
        for text, other in late
        if other.place_excess() < _EXPLAINED * judged.place_excess()
    ]
    if judged.excess() < _LARGE:
        return shifts
    faults = [(text, mended(other)) for text, other in _faults(as_read)] + late
    hints: list[str] = []
    while judged.excess() >= _LARGE and len(hints) < 2:
        best: tuple[float, str, Judged] | None = None
        # A frame may be wrong alone or together with another fault, where neither explains the
        # errors.
        most = _EXPLAINED * judged.excess()
        tried = [(text, other, most) for text, other in faults]
        for text, other in (("", judged), *faults):
            limit = min(most, _share_of_frames(other) * other.excess())
            tried += [
                (f"{text}, with {frame}" if text else frame, both, limit)
                for frame, both in _frames(other, planar)
            ]
        for text, other, limit in tried:
            left = other.excess()
            if left < limit and (best is None or left * _AS_GOOD < best[0]):
                best = left, text, other
        if best is None:
            break
        hints.append(f"{best[1]}: the errors would be {best[2].rmse()} instead of {judged.rmse()}")
        if best[1].startswith(MIRROR_IMAGE):
            break  # an offset of the body would only turn its mirrored tags
        judged, faults = best[2], []
    return hints or shifts


def _share_of_frames(judged: Judged) -> float:
    """Return the share of the mean square errors below which a constant transform is reported."""
    if judged.excess() >= _HUGE:
        return _EXPLAINED
    place = judged.true_translation
    moved = ((place - place.mean(axis=0)) ** 2).sum(axis=-1).mean()
    off = ((judged.translation - place) ** 2).sum(axis=-1).mean()
    return _MOST_EXPLAINED if moved > off else 0.0


def _faults(judged: Judged) -> Iterator[tuple[str, Judged]]:
    """Yield quaternions in another order, inverted rotations, positions in another unit."""
    Q = judged.true_rotation
    q = rotations.quaternion(Q)
    turned: list[tuple[str, FloatArray]] = []
    # Rotations about z alone are headings, or quaternions in the right order.
    if judged.has_rotation and (np.abs(q[..., 1:3]) > 1e-6).any():
        turned += [
            (
                "the truth's quaternions look like x, y, z, w in columns named w, x, y, z",
                rotations.from_quaternion(q[..., [3, 0, 1, 2]]),
            ),
            (
                "the truth's quaternions look like w, x, y, z in columns named x, y, z, w",
                rotations.from_quaternion(q[..., [1, 2, 3, 0]]),
            ),
        ]
    if judged.has_rotation:
        turned.append(
            (
                "the truth's rotations look inverted (from the world to the body)",
                np.swapaxes(Q, 1, 2),
            )
        )
    for text, other in turned:
        yield text, judged._replace(true_rotation=other)
    spread = [np.ptp(a, axis=0).max() for a in (judged.translation, judged.true_translation)]
    for scale, unit in ((0.01, "centimetres"), (0.001, "millimetres")):
        moved = scale * judged.true_translation
        # A path that shrinks to a point fits any track.
        if scale * spread[1] < 0.3 * spread[0]:
            continue
        yield f"the truth's positions look like {unit}", judged._replace(true_translation=moved)


def _late(at: Callable[[float, bool], Judged], told_s: float) -> Iterator[tuple[str, Judged]]:
    """Yield the time shift with the smallest position errors, if it is not about zero."""

    def left(shift: float) -> float:
        other = at(shift, False)
        if len(other.times) < _FEWEST:
            return np.inf
        return other.place_excess()

    best = min(_SHIFTS, key=left)
    best = min(best + _FINE_SHIFTS, key=left)
    if abs(best) > 0.01:
        side = "ahead" if best > 0 else "behind (or the filter lags: see --walk-m)"
        yield (
            f"the truth's clock looks about {abs(best):.2f} s {side}; see --time-offset "
            f"{best + told_s:.2f}",
            at(best, True),
        )


def _frames(judged: Judged, planar: bool) -> Iterator[tuple[str, Judged]]:
    """Yield the rigid transforms of the world and of the body with the smallest errors.

    Planar motion may also be mirrored: in the plane, a half turn about a horizontal axis is a
    reflection.
    """
    p, q, Q = judged.translation, judged.true_translation, judged.true_rotation
    # Beliefs at the start, which are uncertain, have less weight.
    w, u = (1 / np.maximum(a, np.median(a)) for a in (judged.place_variance, judged.turn_variance))
    w, u = w / w.sum(), u / u.sum()
    spread = [a - w @ a for a in (p, q)]
    turns = np.einsum("k,kij,klj->il", u, judged.rotation, Q) * judged.has_rotation
    # Weight of the path relative to the rotations; a path that does not move has none.
    trust = np.median(judged.turn_variance) / np.median(judged.place_variance)
    moves = trust * np.einsum("k,ki,kj->ij", w, *spread)
    R = _turn_about_z(turns + moves) if planar else rotations.nearest(turns + moves)
    shift = w @ (p - q @ R.T)
    yield (
        f"a constant offset of the truth's world frame, {_words(R, shift)}{_mirrored(R)}; "
        "see --align",
        judged._replace(true_rotation=R @ Q, true_translation=q @ R.T + shift),
    )
    if planar:
        yield _mirror_image(judged, u, w, moves)
    if not judged.has_rotation:
        return
    turned = np.swapaxes(Q, 1, 2)
    C = rotations.nearest(np.einsum("k,kij->ij", u, turned @ judged.rotation))
    arm = w @ (turned @ (p - q)[..., None])[..., 0]
    if planar:
        arm[2] = 0.0
    yield (
        f"a constant offset of the truth's body frame, {_words(C, arm)}",
        judged._replace(true_rotation=Q @ C, true_translation=q + Q @ arm),
    )


def _turn_about_z(correlation: FloatArray) -> FloatArray:
    """Return the rotation about z nearest to a matrix (3, 3)."""
    angle = np.arctan2(correlation[1, 0] - correlation[0, 1], correlation[0, 0] + correlation[1, 1])
    return rotations.exp([0.0, 0.0, angle])


def _mirror_image(
    judged: Judged, u: FloatArray, w: FloatArray, moves: FloatArray
) -> tuple[str, Judged]:
    """Return planar truth reflected in the line that leaves the smallest errors."""
    p, q = judged.translation, judged.true_translation
    across = np.diag([1.0, -1.0, 1.0])
    yaws = [rotations.yaw(Q) for Q in (judged.rotation, judged.true_rotation)]
    # A reflection is one in the x axis, then a turn; it changes the sign of a heading.
    turns = np.zeros((3, 3))
    turns[:2, :2] = np.einsum(
        "k,ki,kj->ij", u, *(np.stack([np.cos(a), np.sin(a)], axis=-1) for a in (yaws[0], -yaws[1]))
    )
    turn = _turn_about_z(turns * judged.has_rotation + moves @ across)
    F = turn @ across
    image = turn @ rotations.exp(-yaws[1][:, None] * [0.0, 0.0, 1.0])
    return MIRROR_IMAGE, judged._replace(
        true_rotation=image, true_translation=q @ F.T + w @ (p - q @ F.T)
    )


def _words(rotation: FloatArray, shift: FloatArray) -> str:
    turn, place = (
        ", ".join(f"{x:.{n}f}" for x in a)
        for a, n in ((np.rad2deg(rotations.log(rotation)), 1), (shift, 3))
    )
    return f"turned by ({turn}) deg about x, y, z and shifted by ({place}) m"


def _mirrored(rotation: FloatArray) -> str:
    """Return words on a half turn about a horizontal axis, which a mirrored layout looks like."""
    vector = rotations.log(rotation)
    x, y, z = vector / max(float(np.linalg.norm(vector)), 1e-12)
    if np.linalg.norm(vector) < math.pi - _NEAR_RAD or abs(z) > math.sin(_NEAR_RAD):
        return ""
    swapped = abs(math.remainder(math.atan2(y, x) - math.pi / 4, math.pi)) < _NEAR_RAD
    if swapped:
        return (
            ", as if x and y of the anchors (or of the truth) were swapped, or the truth in "
            "north-east-down"
        )
    return ", as if the layout of the anchors (or the truth) were mirrored"


def judged_of(
    truth: tuple[FloatArray | None, FloatArray, BoolArray],
    track: Any,
    planar: bool,
    counts: BoolArray,
) -> Judged:
    """Return the input of `fault_hints` for a truth at the counted epochs (K,) of a track.

    Planar: only x and y of the position are compared.
    """
    rotation, translation, known = truth
    known = known & counts
    place = translation[known].copy()
    if planar:
        place[:, 2] = track.translation[known, 2]
    variance = np.einsum("kii->ki", track.covariance)[known]
    estimated = track.rotation[known]
    return Judged(
        track.times[known],
        estimated,
        track.translation[known],
        estimated if rotation is None else rotation[known],
        place,
        variance[:, 2 if planar else 0 : 3].sum(axis=-1),
        variance[:, 3 : 5 if planar else 6].sum(axis=-1),
        rotation is not None,
    )

"""Suppose faults of a log: each supposition is the log as it would be without the fault."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy

from rbl_gym.checks import FloatArray
from rbl_gym.measurements import ranging
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.evidence import Evidence, Trial, evidence, std_of
from rbl_gym.studies.replay.place import own_std
from rbl_gym.studies.replay.settings import DEFAULT_RANGE_STD_M
from rbl_gym.studies.replay.tracking import accel_of, recording_filter, robust_of

# Maximum number of anchors or tags that are tried in pairs.
_IN_PAIRS = 12
_UNITS = ((0.01, "centimetres"), (0.001, "millimetres"), (0.3048, "feet"))
_WIDER = (3.0, 10.0, 30.0)
_NOISIER = (1.5, 2.0, 3.0, 5.0, 10.0)
_BIASES_M = (-1.0, -0.5, -0.25, -0.1, 0.1, 0.25, 0.5, 1.0, 2.0)
_HEIGHTS_M = (-2.0, -1.0, -0.5, -0.25, -0.1, 0.1, 0.25, 0.5, 1.0, 2.0)
# Number of links, those with the largest residuals, that are tried for a bias.
_LINKS = 4
# Least walk, also in place of zero, from which larger ones are derived.
_LEAST_WALK_M, _LEAST_WALK_DEG = 0.03, 2.0
# Number of values that are tried between two previous values.
_STEPS = 4
# Fewest ranges from which a bias is estimated.
_FEWEST = 6
# Prior standard deviation of an anchor position (m), and number of ranges used to estimate it.
_MOVED_M, _FIXES = 3.0, 600


class Supposition(NamedTuple):
    """A fault: its kind, its description, the trial without it, and the fitted numbers.

    `parameters` is the number of fitted values, for which the likelihood is penalised. `scale` is
    the factor on the ranges; smaller ranges have a larger density.
    """

    kind: str
    text: str
    trial: Trial
    parameters: int = 1
    scale: float = 1.0


def first_suppositions(trial: Trial) -> Iterator[Supposition]:
    """Yield the faults that can be tested without previous results."""
    recording, settings = trial
    yield from _of_settings(trial)
    # A reflection of the tags is the same up to a rigid motion.
    crossed = recording._replace(anchors=recording.anchors[..., [1, 0, 2]])
    text = "x and y of the anchors look swapped, or the layout of anchors or tags mirrored"
    yield Supposition("mirrored", text, _with(trial, crossed))
    for kind, ids, axis in (("anchors", recording.anchor_ids, 1), ("tags", recording.tag_ids, 2)):
        for i, j in itertools.combinations(_most_active(recording, axis), 2):
            text = f"{kind} {ids[i]} and {ids[j]} look swapped"
            changed = _with(trial, _swapped(recording, i, j, axis))
            yield Supposition(f"{kind}-swapped", text, changed)
    for scale, unit in _UNITS:
        shrunk = recording._replace(ranges=scale * recording.ranges)
        text = f"the ranges look like {unit}"
        yield Supposition("units", text, _with(trial, shrunk), scale=scale)
        for field in ("anchors", "tags"):
            changed = recording._replace(**{field: scale * getattr(recording, field)})
            text = f"the positions of the {field} look like {unit}"
            yield Supposition("units", text, _with(trial, changed))
    halved = _with(trial, recording._replace(ranges=0.5 * recording.ranges))
    text = "the ranges look like distances there and back, twice too long"
    yield Supposition("units", text, halved, scale=0.5)
    for bias in _BIASES_M:
        yield _common_bias(trial, bias)
    if settings.knowledge.planar:
        for step in _HEIGHTS_M:
            yield _height(trial, step)


def likely_height(trial: Trial, least: float) -> tuple[Supposition, float]:
    """Return the most likely other height of a planar body, and the log-likelihood it gains.

    The search ends early if no tested height gains more than `least`.
    """
    steps = list(_HEIGHTS_M)
    gains = _gains(trial, steps)
    if max(gains) > least:
        finer = _about([*steps, 0.0], [*gains, 0.0]).tolist()
        steps, gains = steps + finer, gains + _gains(trial, finer)
    best = int(np.argmax(gains))
    return _height(trial, steps[best]), gains[best]


def _gains(trial: Trial, steps: list[float]) -> list[float]:
    trials = [trial, *(_height(trial, step).trial for step in steps)]
    likelihood = evidence(trials).log_likelihood.sum(axis=1)
    return np.nan_to_num(likelihood[1:] - likelihood[0], nan=-np.inf).tolist()


def left_out(trial: Trial) -> list[Trial]:
    """Return the trial without each of the anchors, then without each of the tags."""
    links = trial.recording.links
    result = []
    for axis in (1, 2):
        for k in range(links.shape[axis]):
            kept = links.copy()
            np.moveaxis(kept, axis, 0)[k] = False
            # If it is the only one, keep it: no range would be left.
            kept = kept if kept.any() else links
            result.append(_with(trial, trial.recording._replace(links=kept)))
    return result


def second_suppositions(
    trial: Trial, first: list[Supposition], here: Evidence, without: Evidence
) -> Iterator[Supposition]:
    """Yield the faults whose size is estimated from the first results.

    `here` are the results of the log followed by those of the first suppositions, `without` the
    results of `left_out`.
    """
    recording = trial.recording
    M, N = shape = recording.links.shape[1:]
    likelihood = here.log_likelihood.sum(axis=1)
    for kind, steps, scale_of_none, make in (
        ("common-bias", _BIASES_M, 0.0, _common_bias),
        ("height", _HEIGHTS_M, 0.0, _height),
        ("range-std", _NOISIER, 1.0, _noisier),
    ):
        chosen = [k for k, s in enumerate(first) if s.kind == kind]
        values = [*likelihood[1:][chosen], likelihood[0]]
        for value in _about([*steps, scale_of_none], values) if chosen else ():
            yield make(trial, value)
    for k in range(M + N):
        # Residuals of the omitted ranges, at poses estimated from the others.
        poses = without.rotation[k], without.translation[k]
        what, ids = ("anchor", recording.anchor_ids) if k < M else ("tag", recording.tag_ids)
        i = k if k < M else k - M
        mine = np.zeros(shape, np.bool_)
        mine[(i, slice(None)) if k < M else (slice(None), i)] = True
        off = _residual(recording, *poses)[recording.links & mine]
        if len(off) < _FEWEST or not np.isfinite(off).all():
            continue
        if k < M:
            yield _moved(trial, *poses, i)
        bias = float(np.median(off))
        yield _biased(trial, f"{what}-bias", f"the ranges of {what} {ids[i]}", mine, bias)
    middle = np.zeros(shape)
    for m, n in zip(*np.nonzero(recording.links.any(axis=0)), strict=True):
        middle[m, n] = np.median(here.residual[0, recording.links[:, m, n], m, n])
    worst = np.argsort(-np.abs(middle).ravel())[:_LINKS]
    for m, n in zip(*np.unravel_index(worst, shape), strict=True):
        mine = np.zeros(shape, np.bool_)
        mine[m, n] = True
        name = f"the ranges from anchor {recording.anchor_ids[m]} to tag {recording.tag_ids[n]}"
        # The estimated pose absorbs a part of the bias.
        for share in (1.0, 1.4):
            yield _biased(trial, "link-bias", name, mine, share * float(middle[m, n]))


def _with(trial: Trial, recording: Recording) -> Trial:
    return trial._replace(recording=recording)


def _of_settings(trial: Trial) -> Iterator[Supposition]:
    """Yield a faster motion, larger noise, and a robust loss."""
    recording, settings = trial

    def supposed(kind: str, text: str, **fields: float | bool) -> Supposition:
        return Supposition(kind, text, Trial(recording, settings.changed(**fields)))

    motion = settings.motion
    if settings.filter == "iekf-imu":
        pass  # the sensor measures the motion
    elif getattr(recording_filter(recording, settings), "twist", None) is not None:
        accel_m, accel_deg = accel_of(settings)
        for wider in _WIDER:
            changed = {"accel_m": wider * accel_m, "accel_deg": wider * accel_deg}
            yield supposed("acceleration", _moves("acceleration", changed), **changed)
    else:
        walk = max(motion.walk_m, _LEAST_WALK_M), max(motion.walk_deg, _LEAST_WALK_DEG)
        for m, deg in (*((f, f) for f in _WIDER), (3, 1), (10, 1), (30, 1), (1, 3), (1, 10)):
            changed = {"walk_m": m * walk[0], "walk_deg": min(deg * walk[1], 360.0)}
            yield supposed("walk", _moves("walk", changed), **changed)
    for more in _NOISIER:
        yield _noisier(trial, more)
    if not robust_of(settings):
        yield supposed("outliers", "some ranges are far off: leave out robust=false", robust=True)


def _noisier(trial: Trial, more: float) -> Supposition:
    recording, settings = trial
    std = settings.range_std_m
    own = own_std(recording, settings)
    if std is None and own is not None:
        std = float(np.median(own[recording.links]))
    value = more * (std or DEFAULT_RANGE_STD_M)
    text = f"the ranges scatter more than assumed: try --range-std-m {value:.2g}"
    return Supposition(
        "range-std", text, trial._replace(settings=settings.changed(range_std_m=value))
    )


def _moves(what: str, changed: dict[str, float]) -> str:
    options = " ".join(f"--{name.replace('_', '-')} {value:.3g}" for name, value in changed.items())
    return f"the body moves more than the {what} allows: try {options}"


def _most_active(recording: Recording, axis: int) -> np.ndarray:
    """Return the anchors or tags with the most ranges, which are tried in pairs."""
    other = tuple(k for k in range(3) if k != axis)
    ranges = recording.links.sum(axis=other)
    return np.sort(np.argsort(-ranges, kind="stable")[:_IN_PAIRS])


def _swapped(recording: Recording, i: int, j: int, axis: int) -> Recording:
    order = np.arange(recording.links.shape[axis])
    order[[i, j]] = order[[j, i]]
    std = recording.range_std
    return recording._replace(
        ranges=recording.ranges.take(order, axis),
        links=recording.links.take(order, axis),
        range_std=None if std is None else std.take(order, axis),
    )


def _biased(trial: Trial, kind: str, name: str, mine: np.ndarray, bias: float) -> Supposition:
    recording = trial.recording
    # Keep corrected ranges positive, so that no link is lost.
    ranges = np.where(mine, np.maximum(recording.ranges - bias, 1e-3), recording.ranges)
    side = "long" if bias > 0 else "short"
    changed = recording._replace(ranges=np.where(recording.links, ranges, 0.0))
    learned = " (--raw estimates constant biases)" if trial.settings.filter == "iekf" else ""
    text = f"{name} look {abs(bias):.2f} m too {side}{learned}"
    return Supposition(kind, text, _with(trial, changed))


def _common_bias(trial: Trial, bias: float) -> Supposition:
    everything = np.ones(trial.recording.links.shape[1:], np.bool_)
    return _biased(trial, "common-bias", "all ranges", everything, bias)


def _height(trial: Trial, step: float) -> Supposition:
    known = trial.settings.knowledge
    if known.height_m is None:
        told = {"height_offset_m": (known.height_offset_m or 0.0) + step}
    else:
        told = {"height_m": known.height_m - step}
    ((name, value),) = told.items()
    text = f"the tags look to be at another height: try --{name.replace('_', '-')}={value:.2f}"
    return Supposition("height", text, trial._replace(settings=trial.settings.changed(**told)))


def _about(places: list[float], values: list[float]) -> FloatArray:
    """Return positions between the highest value and its neighbours."""
    order = np.argsort(places)
    x, y = np.array(places)[order], np.array(values)[order]
    best = int(np.argmax(y))
    low, high = x[max(best - 1, 0)], x[min(best + 1, len(x) - 1)]
    return np.concatenate(
        [np.linspace(a, b, _STEPS + 2)[1:-1] for a, b in ((low, x[best]), (x[best], high)) if a < b]
    )


def _residual(recording: Recording, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the ranges (K, M, N) minus the distances at poses (K, ...)."""
    points = ranging.tag_positions(rotation, translation, recording.tags)
    return recording.ranges - ranging.distances(recording.anchors, points)


def _moved(trial: Trial, rotation: FloatArray, translation: FloatArray, m: int) -> Supposition:
    """Move an anchor to where it fits the poses estimated from the others."""
    recording = trial.recording
    points = ranging.tag_positions(rotation, translation, recording.tags)
    place = recording.anchors[..., m, :]
    start = np.broadcast_to(place, (len(points), 3))[:, None]
    k, n = np.nonzero(recording.links[:, m])
    some = slice(None, None, max(1, len(k) // _FIXES))
    k, n = k[some], n[some]
    away, ranges = (start - points)[k, n], recording.ranges[k, m, n]
    std = std_of(*trial)[k, m, n]
    step = scipy.optimize.least_squares(
        lambda step: np.concatenate(
            [(np.linalg.norm(away + step, axis=-1) - ranges) / std, step / _MOVED_M]
        ),
        np.zeros(3),
        loss="soft_l1",
    ).x
    anchors = recording.anchors.copy()
    anchors[..., m, :] += step
    words = ", ".join(f"{x:+.2f}" for x in step)
    text = (
        f"anchor {recording.anchor_ids[m]} looks misplaced: it fits the ranges if moved by "
        f"({words}) m"
    )
    return Supposition("anchor-moved", text, _with(trial, recording._replace(anchors=anchors)), 3)

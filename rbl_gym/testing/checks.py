"""Conformance tests of estimators, for packages that bring their own.

`check_filter` and `check_locator` run an estimator in small worlds. They raise an AssertionError
that says what the estimator did and what it should do. They import no estimator.

>>> from rbl_gym import estimators
>>> from rbl_gym.testing import check_filter, check_locator
>>> check_filter(lambda **laws: estimators.make("uc-kf", **laws))
>>> check_locator(estimators.locate)
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from rbl_gym import metrics
from rbl_gym.checks import FloatArray
from rbl_gym.measurements import ranging
from rbl_gym.testing.worlds import (
    ANCHORS,
    DT,
    FIELDS,
    NAN_ADVICE,
    NOISE,
    PROCESS,
    TAGS,
    Epochs,
    batched,
    call,
    check_links,
    check_nees,
    check_pose,
    check_pure,
    check_refuses_nan,
    check_same,
    check_shapes,
    check_state,
    draw_epochs,
    factory_of,
    moved,
    moved_world,
    require,
    take,
    trial,
)

__all__ = ["check_filter", "check_locator"]

_EPOCHS, _TRIALS = 12, 64


def check_filter(
    make_filter: str | Callable[..., Any], *, skip: Sequence[str] = (), seed: int = 0
) -> None:
    """Check that a filter conforms to `rbl_gym.estimators.Filter`.

    Parameters
    ----------
    make_filter
        Called as ``make_filter(tags=..., noise=..., process=...)``; the factory that is registered
        or of an entry point of ``rbl_gym.filters``; or its path ``"module:factory/option=1.5"``. A
        filter with ``reads = "inertial"`` gets the readings of an `InertialSensor`, not twists.
    skip
        Checks to leave out, by the names below.
    seed
        Seed of the test worlds.

    Raises
    ------
    AssertionError
        If a check fails. The checks are ``interface``, ``shapes`` (of beliefs and states, for no,
        one and two leading axes), ``pose`` (proper rotations, covariances symmetric and positive
        definite), ``batching`` (a batch gives the same as a loop), ``purity`` (arguments and states
        are never changed), ``determinism``, ``pickling``, ``invariance`` (to translation and
        rotation of the world), ``links`` (a missing link has no weight), ``noise`` (the noise law
        of an epoch is an argument of `update`, only for that epoch), ``nan`` (raises ValueError),
        ``nees`` (the belief is consistent and better than the prior).
    """
    _try_all(_FILTER_CHECKS, factory_of(make_filter), skip, seed)


def check_locator(locate: Callable[..., Any], *, skip: Sequence[str] = (), seed: int = 0) -> None:
    """Check that a static estimator conforms to `rbl_gym.estimators.locate`.

    Parameters
    ----------
    locate
        Called as ``locate(ranges, anchors, tags, noise, links=...)``; its result has the attributes
        `rotation`, `translation` and `covariance`. A method of the entry-point group
        ``rbl_gym.locators`` is checked as ``functools.partial(estimators.locate,
        method="its-name")``.
    skip, seed
        As in `check_filter`.

    Raises
    ------
    AssertionError
        If a check fails; the checks are those of `check_filter`.
    """
    _try_all(_LOCATOR_CHECKS, locate, skip, seed)


def _try_all(
    checks: Mapping[str, Callable[[Any, np.random.Generator], None]],
    subject: Callable[..., Any],
    skip: Sequence[str],
    seed: int,
) -> None:
    for name in set(skip) - set(checks):
        raise ValueError(f"skip must be names of checks, {', '.join(checks)}; got {name!r}")
    for name, check in checks.items():
        if name not in skip:
            check(subject, np.random.default_rng(seed))


# --- filters --------------------------------------------------------------------------------


def _filter_interface(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    for name in ("initial", "predict", "update", "belief"):
        require(
            callable(getattr(filter, name, None)),
            f"a filter must have the method {name!r}, but {type(filter).__name__} has none",
        )


def _filter_shapes(make_filter: Any, rng: np.random.Generator) -> None:
    for batch in ((), (3,), (2, 2)):
        filter = _made(make_filter)
        with batched(batch):
            check_shapes("belief", _beliefs(filter, _drawn(filter, rng, batch, 2))[-1], batch)
            if batch:  # a filter of one body gets the message of its beliefs
                check_state(filter.initial(*_drawn(filter, rng, batch, 1).prior), batch)


def _filter_pose(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    for belief in _beliefs(filter, _drawn(filter, rng, (8,), 4)):
        check_pose("belief", belief)


def _filter_batching(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    epochs = _drawn(filter, rng, (4,), 3)
    together = _beliefs(filter, epochs)[-1]
    for index in range(4):
        alone = _beliefs(filter, trial(epochs, index))[-1]
        check_same(
            f"a batch must give the same as each trial alone; trial {index}",
            take(together, index), alone,
        )  # fmt: skip
    each = np.broadcast_to(ANCHORS, (4, *ANCHORS.shape)).copy()
    apart = _beliefs(filter, epochs, anchors=each)[-1]
    check_same("anchors (M, 3) must give the same as (B, M, 3) with equal entries", together, apart)


def _filter_purity(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    epochs = _drawn(filter, rng, (3,), 2)
    anchors, links = ANCHORS, np.ones(epochs.ranges.shape[1:], dtype=np.bool_)
    links[..., 0, 0] = False
    prior = tuple(array.copy() for array in epochs.prior)
    state = check_pure("initial", filter.initial, *prior)
    moved = check_pure("predict", filter.predict, state, epochs.twists[1].copy(), DT)
    updated = check_pure("update", filter.update, moved, epochs.ranges[1].copy(), anchors, links)
    check_pure("belief", filter.belief, updated)


def _filter_determinism(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    epochs = _drawn(filter, rng, (3,), 3)
    first = _beliefs(filter, epochs)[-1]
    for label, other in (("a second run", filter), ("an equal filter", _made(make_filter))):
        check_same(f"{label} must give the same bytes", first, _beliefs(other, epochs)[-1], 0.0)


def _filter_pickling(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    epochs = _drawn(filter, rng, (3,), 2)
    state = call("initial", filter.initial, *epochs.prior)
    copies = []
    for label, thing in (("filter", filter), ("state", state)):
        try:
            copies.append(pickle.loads(pickle.dumps(thing)))
        except Exception as error:
            raise AssertionError(f"the {label} must be picklable, raised {error!r}") from error
    copy, copied = copies
    after = filter.belief(filter.update(state, epochs.ranges[0], ANCHORS))
    again = copy.belief(copy.update(copied, epochs.ranges[0], ANCHORS))
    check_same("an unpickled filter and state must give the same bytes", after, again, 0.0)


def _filter_invariance(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    epochs = _drawn(filter, rng, (3,), 3)
    # The sensor moves with the body, and gravity is vertical in both worlds.
    sensed = _reads_sensor(filter)
    turn, shift = moved_world(rng, level=sensed)
    both = np.kron(np.eye(2), turn)
    rotation, translation, covariance = epochs.prior
    elsewhere = epochs._replace(
        twists=epochs.twists if sensed else epochs.twists @ both.T,
        prior=(turn @ rotation, translation @ turn.T + shift, both @ covariance @ both.T),
    )
    expected = moved(_beliefs(filter, epochs)[-1], turn, shift)
    found = _beliefs(filter, elsewhere, anchors=ANCHORS @ turn.T + shift)[-1]
    check_same("moving and turning the world must move and turn the belief", expected, found)


def _filter_links(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    epochs = _drawn(filter, rng, (3,), 1)
    anchors, ranges = ANCHORS, epochs.ranges[0]
    state = call("initial", filter.initial, *epochs.prior)

    def update(ranges: FloatArray, anchors: FloatArray, links: Any) -> Any:
        return filter.belief(call("update", filter.update, state, ranges, anchors, links))

    full = np.ones(ranges.shape, dtype=np.bool_)
    check_links(update, ranges)
    nothing = update(np.zeros_like(ranges), anchors, ~full)
    check_same("an epoch without links must not change the belief", filter.belief(state), nothing)


def _filter_noise(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    epochs = _drawn(filter, rng, (3,), 2)
    links = np.ones(epochs.ranges.shape[1:], dtype=np.bool_)
    links[..., 1, 0] = False
    state = call("initial", filter.initial, *epochs.prior)

    def belief(filter: Any, state: Any, noise: Any = None) -> Any:
        name = f"update(..., noise={'None' if noise is None else type(noise).__name__})"
        update = partial(filter.update, noise=noise)
        return filter.belief(call(name, update, state, epochs.ranges[0], ANCHORS, links))

    own = filter.belief(filter.update(state, epochs.ranges[0], ANCHORS, links))
    check_same("update(..., noise=None) must use the law with which the filter was made",
               own, belief(filter, state))  # fmt: skip
    each = ranging.LinkNoise(NOISE.floor_m * rng.uniform(0.5, 3.0, epochs.ranges.shape[1:]))
    for law in (ranging.RangeNoise(3 * NOISE.floor_m), each):
        other = _made(make_filter, law)
        twin = call("initial", other.initial, *epochs.prior)
        check_same(
            "update(..., noise=law) must give the same as a filter made with this "
            f"{type(law).__name__}",
            belief(other, twin), belief(filter, state, law),
        )  # fmt: skip
    check_same("the noise of one update must not be used in the next",
               own, belief(filter, state))  # fmt: skip


def _filter_nan(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    epochs = _drawn(filter, rng, (3,), 1)
    state = call("initial", filter.initial, *epochs.prior)
    calls = {
        "initial": (filter.initial, ("rotation", "translation", "covariance"), epochs.prior),
        "predict": (
            lambda twist: filter.predict(state, twist, DT),
            ("readings" if _reads_sensor(filter) else "twist",),
            (epochs.twists[0],),
        ),
        "update": (
            lambda ranges, anchors: filter.update(state, ranges, anchors),
            ("ranges", "anchors"), (epochs.ranges[0], ANCHORS),
        ),
    }  # fmt: skip
    for name, (function, arguments, values) in calls.items():
        check_refuses_nan(name, function, arguments, values, NAN_ADVICE)


def _filter_nees(make_filter: Any, rng: np.random.Generator) -> None:
    filter = _made(make_filter)
    epochs = _drawn(filter, rng, (_TRIALS,), _EPOCHS)
    beliefs = _beliefs(filter, epochs)
    check_nees(beliefs, epochs.rotation, epochs.translation)
    last, first = ((epochs.rotation[k], epochs.translation[k], TAGS) for k in (-1, 0))
    found = metrics.tag_error(beliefs[-1].rotation, beliefs[-1].translation, *last)
    prior = metrics.tag_error(*epochs.prior[:2], *first)
    require(
        np.median(found) < np.median(prior),
        f"after {_EPOCHS} epochs the median tag error must be smaller than that of the prior, got "
        f"{np.median(found):.3g} m and {np.median(prior):.3g} m for the prior",
    )


def _reads_sensor(filter: Any) -> bool:
    """Return whether `predict` takes inertial readings instead of the twist."""
    return getattr(filter, "reads", "twist") == "inertial"


def _drawn(filter: Any, rng: np.random.Generator, batch: tuple[int, ...], count: int) -> Epochs:
    return draw_epochs(rng, batch, count, _reads_sensor(filter))


def _made(make_filter: Callable[..., Any], noise: ranging.NoiseLaw = NOISE) -> Any:
    laws = {"tags": TAGS, "noise": noise, "process": PROCESS}
    return call("make_filter(tags=, noise=, process=)", make_filter, **laws)


def _beliefs(filter: Any, epochs: Epochs, anchors: FloatArray = ANCHORS) -> list[Any]:
    """Return the belief after every epoch."""
    state = call("initial", filter.initial, *epochs.prior)
    beliefs = []
    for k, ranges in enumerate(epochs.ranges):
        if k:
            state = call("predict", filter.predict, state, epochs.twists[k], DT)
        state = call("update", filter.update, state, ranges, anchors)
        beliefs.append(call("belief", filter.belief, state))
    return beliefs


# --- locators -------------------------------------------------------------------------------


def _locator_shapes(locate: Any, rng: np.random.Generator) -> None:
    for batch in ((), (3,), (2, 2)):
        ranges = draw_epochs(rng, batch, 1).ranges[0]
        check_shapes("estimate", _located(locate, ranges), batch, FIELDS)


def _locator_pose(locate: Any, rng: np.random.Generator) -> None:
    check_pose("estimate", _located(locate, draw_epochs(rng, (8,), 1).ranges[0]))


def _locator_batching(locate: Any, rng: np.random.Generator) -> None:
    ranges = draw_epochs(rng, (4,), 1).ranges[0]
    together = _located(locate, ranges)
    for index in range(4):
        check_same(
            f"a batch must give the same as each trial alone; trial {index}",
            take(together, index), _located(locate, ranges[index]),
        )  # fmt: skip


def _locator_purity(locate: Any, rng: np.random.Generator) -> None:
    ranges = draw_epochs(rng, (3,), 1).ranges[0]
    links = np.ones(ranges.shape, dtype=np.bool_)
    links[..., 0, 0] = False
    check_pure("locate", locate, ranges.copy(), ANCHORS, TAGS, NOISE, links=links)


def _locator_determinism(locate: Any, rng: np.random.Generator) -> None:
    ranges = draw_epochs(rng, (3,), 1).ranges[0]
    first, second = _located(locate, ranges), _located(locate, ranges)
    check_same("a second call must give the same bytes", first, second, 0.0)


def _locator_invariance(locate: Any, rng: np.random.Generator) -> None:
    ranges = draw_epochs(rng, (3,), 1).ranges[0]
    turn, shift = moved_world(rng)
    expected = moved(_located(locate, ranges), turn, shift)
    found = _located(locate, ranges, ANCHORS @ turn.T + shift)
    check_same("moving and turning the world must move and turn the estimate", expected, found)


def _locator_links(locate: Any, rng: np.random.Generator) -> None:
    ranges = draw_epochs(rng, (3,), 1).ranges[0]
    check_links(lambda ranges, anchors, links: _located(locate, ranges, anchors, links), ranges)


def _locator_nan(locate: Any, rng: np.random.Generator) -> None:
    check_refuses_nan(
        "locate",
        lambda ranges, anchors, tags: locate(ranges, anchors, tags, NOISE),
        ("ranges", "anchors", "tags"),
        (draw_epochs(rng, (3,), 1).ranges[0], ANCHORS, TAGS),
    )


def _locator_nees(locate: Any, rng: np.random.Generator) -> None:
    epochs = draw_epochs(rng, (4 * _TRIALS,), 1)
    check_nees([_located(locate, epochs.ranges[0])], epochs.rotation, epochs.translation)


def _located(
    locate: Any, ranges: FloatArray, anchors: FloatArray = ANCHORS, links: Any = None
) -> Any:
    return call("locate", locate, ranges, anchors, TAGS, NOISE, links=links)


_FILTER_CHECKS = {
    "interface": _filter_interface, "shapes": _filter_shapes, "pose": _filter_pose,
    "batching": _filter_batching, "purity": _filter_purity, "determinism": _filter_determinism,
    "pickling": _filter_pickling, "invariance": _filter_invariance, "links": _filter_links,
    "noise": _filter_noise, "nan": _filter_nan, "nees": _filter_nees,
}  # fmt: skip
_LOCATOR_CHECKS = {
    "shapes": _locator_shapes, "pose": _locator_pose, "batching": _locator_batching,
    "purity": _locator_purity, "determinism": _locator_determinism,
    "invariance": _locator_invariance, "links": _locator_links, "nan": _locator_nan,
    "nees": _locator_nees,
}  # fmt: skip

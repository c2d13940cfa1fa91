"""The conformance tests: our own estimators pass, broken ones fail the expected check."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest

from rbl_gym import estimators
from rbl_gym.measurements import ranging
from rbl_gym.testing import check_filter, check_locator
from rbl_gym.testing import checks as testing


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *((name, {}) for name in estimators.names()),
        ("iekf", {"robust": True}),
        ("uc-kf", {"coupled": True}),
    ],
    ids=str,
)
def test_our_filters_pass(name, options):
    check_filter(partial(estimators.make, name, **options))


@pytest.mark.parametrize("method", estimators.methods())
def test_our_locators_pass(method):
    check_locator(partial(estimators.locate, method=method))


class Wrapped:
    """An iterated EKF that a test breaks in one place."""

    def __init__(self, **laws: Any) -> None:
        self.inner = estimators.make("iekf", **laws)

    def initial(self, rotation, translation, covariance):
        return self.inner.initial(rotation, translation, covariance)

    def predict(self, state, twist, dt):
        return self.inner.predict(state, twist, dt)

    def update(self, state, ranges, anchors, links=None, noise=None):
        return self.inner.update(state, ranges, anchors, links, noise)

    def belief(self, state):
        return self.inner.belief(state)


def test_what_is_wrapped_passes_before_it_is_broken():
    check_filter(Wrapped)


class NoBelief:
    def __init__(self, **laws: Any) -> None: ...

    def initial(self, *prior): ...
    def predict(self, *step): ...
    def update(self, *epoch): ...


class OneBody(Wrapped):
    def initial(self, rotation, translation, covariance):
        if np.ndim(translation) > 1:
            raise IndexError("too many bodies")
        return super().initial(rotation, translation, covariance)


class FlatCovariance(Wrapped):
    def belief(self, state):
        belief = super().belief(state)
        return belief._replace(covariance=belief.covariance.reshape(*belief[1].shape[:-1], 36))


class Single(Wrapped):
    def belief(self, state):
        belief = super().belief(state)
        return belief._replace(translation=belief.translation.astype(np.float32))


class Skewed(Wrapped):
    def belief(self, state):
        belief = super().belief(state)
        matrix = 1.01 * belief.rotation
        return belief._replace(rotation=matrix, matrix=matrix)


class Reflected(Wrapped):
    def belief(self, state):
        belief = super().belief(state)
        return belief._replace(rotation=-belief.rotation)


class Lopsided(Wrapped):
    def belief(self, state):
        belief = super().belief(state)
        belief.covariance[..., 0, 5] += 0.01
        return belief


class Negative(Wrapped):
    def belief(self, state):
        belief = super().belief(state)
        return belief._replace(covariance=belief.covariance - 1e-3 * np.eye(6))


class MixesTrials(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        if np.ndim(ranges) > 2:
            ranges = np.roll(ranges, 1, axis=0)
        return super().update(state, ranges, anchors, links, noise)


class InPlace(Wrapped):
    def predict(self, state, twist, dt):
        state.translation[...] += twist[..., 3:] * dt
        return super().predict(state, np.zeros_like(twist), dt)


class EatsRanges(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        state = super().update(state, ranges, anchors, links, noise)
        ranges[...] = 0.0
        return state


class Remembers(Wrapped):
    seen = 0

    def update(self, state, ranges, anchors, links=None, noise=None):
        self.seen += 1
        return super().update(state, ranges * (1 + 1e-9 * self.seen), anchors, links, noise)


class HoldsALambda(Wrapped):
    def __init__(self, **laws: Any) -> None:
        super().__init__(**laws)
        self.hook = lambda: None


class LikesTheOrigin(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        state = super().update(state, ranges, anchors, links, noise)
        return state._replace(translation=0.999 * state.translation)


class IgnoresLinks(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        return super().update(state, np.maximum(ranges, 1.0), anchors, None, noise)


class ForgetsWhereNothingIs(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        after = super().update(state, ranges, anchors, links, noise)
        if links is not None and not np.any(links):
            return after._replace(covariance=2 * after.covariance)
        return after


class OfTheOldInterface(Wrapped):
    def update(self, state, ranges, anchors, links=None):  # pyrefly: ignore[bad-override]
        return super().update(state, ranges, anchors, links)


class DeafToNoise(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        return super().update(state, ranges, anchors, links)


class TakesTheMeanNoise(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        if noise is not None:
            noise = ranging.RangeNoise(np.sqrt(noise.variance(ranges).mean()))
        return super().update(state, ranges, anchors, links, noise)


class KeepsTheNoise(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        self.kept = noise or getattr(self, "kept", None)
        return super().update(state, ranges, anchors, links, self.kept)


class SwallowsNan(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        return super().update(state, np.nan_to_num(ranges, nan=5.0), anchors, links, noise)


class WrongErrorOnNan(Wrapped):
    def predict(self, state, twist, dt):
        if np.isnan(twist).any():
            raise RuntimeError("nan")
        return super().predict(state, twist, dt)


class Boastful(Wrapped):
    def belief(self, state):
        belief = super().belief(state)
        return belief._replace(covariance=belief.covariance / 10)


class Standstill(Wrapped):
    def update(self, state, ranges, anchors, links=None, noise=None):
        super().update(state, ranges, anchors, links, noise)
        return state


@pytest.mark.parametrize(
    ("broken", "check", "message"),
    [
        (NoBelief, "interface", "must have the method 'belief', but NoBelief has none"),
        (OneBody, "shapes", r"initial must accept .* raised IndexError\('too many bodies'\)"),
        (FlatCovariance, "shapes", r"belief.covariance must be .* \(6, 6\), got float64 \(36,\)"),
        (Single, "shapes", r"belief.translation must be a float64 array .* got float32"),
        (
            Skewed,
            "pose",
            "belief.rotation must be orthogonal, but Q @ Q.T differs from I by 0.0201",
        ),
        (Reflected, "pose", r"proper, got a reflection \(det -1\)"),
        (Lopsided, "pose", "belief.covariance must be symmetric"),
        (Negative, "pose", "belief.covariance must be positive definite, least eigenvalue -"),
        (MixesTrials, "batching", "trial 0: rotation differs"),
        (InPlace, "purity", r"predict must not change its arguments, but changed argument 0"),
        (EatsRanges, "purity", r"update must not change its arguments, but changed argument 1"),
        (Remembers, "determinism", "a second run must give the same bytes"),
        (HoldsALambda, "pickling", "the filter must be picklable, raised"),
        (
            LikesTheOrigin,
            "invariance",
            "moving and turning the world must move and turn the belief",
        ),
        (
            IgnoresLinks,
            "links",
            "an anchor whose links are all False must have no influence, even with 0",
        ),
        (ForgetsWhereNothingIs, "links", "an epoch without links must not change the belief"),
        (OfTheOldInterface, "noise", r"update\(..., noise=None\) must accept .* raised TypeError"),
        (DeafToNoise, "noise", "the same as a filter made with this RangeNoise: .* differs by"),
        (
            TakesTheMeanNoise,
            "noise",
            "the same as a filter made with this LinkNoise: .* differs by",
        ),
        (KeepsTheNoise, "noise", "the noise of one update must not be used in the next"),
        (SwallowsNan, "nan", "on NaN in ranges, raised nothing. The page .*skip=..nan"),
        (WrongErrorOnNan, "nan", r"NaN in twist, raised RuntimeError\('nan'\)"),
        (Boastful, "nees", "got [0-9.]+: errors are larger than claimed"),
        (Standstill, "nees", "beliefs must be consistent|smaller than that of the prior"),
    ],
)
def test_a_broken_filter_fails_its_check(broken, check, message):
    with pytest.raises(AssertionError, match=message):
        check_filter(broken, skip=[name for name in testing._FILTER_CHECKS if name != check])


@pytest.mark.parametrize("broken", [Reflected, IgnoresLinks, Boastful])
def test_a_broken_filter_does_not_pass_the_whole_kit(broken):
    with pytest.raises(AssertionError):
        check_filter(broken)


def test_what_is_skipped_is_not_checked_and_must_exist():
    check_filter(Boastful, skip=["nees"])
    with pytest.raises(
        ValueError, match=r"skip must be names of checks, interface, .*; got 'honesty'"
    ):
        check_filter(Boastful, skip=["honesty"])


def test_a_factory_that_takes_no_laws_is_told_so():
    with pytest.raises(AssertionError, match=r"make_filter\(tags=, noise=, process=\) must accept"):
        check_filter(lambda tags: None)


class Pose(NamedTuple):
    rotation: np.ndarray
    translation: np.ndarray
    covariance: np.ndarray


def located(ranges, anchors, tags, noise, links=None, change=None):
    """The maximum-likelihood pose, changed by a test."""
    found = estimators.locate(ranges, anchors, tags, noise, links=links)
    pose = Pose(found.rotation, found.translation, found.covariance)
    return change(pose) if change else pose


def forgets_links(ranges, anchors, tags, noise, links=None):
    return located(np.maximum(ranges, 1.0), anchors, tags, noise)


def cannot_batch(ranges, anchors, tags, noise, links=None):
    found = located(ranges, anchors, tags, noise, links)
    return found._replace(translation=found.translation.mean(axis=0) + 0 * found.translation)


def swallows_nan(ranges, anchors, tags, noise, links=None):
    return located(ranges, np.nan_to_num(anchors), tags, noise, links)


def writes_links(ranges, anchors, tags, noise, links=None):
    found = located(ranges, anchors, tags, noise, links)
    if links is not None:
        links[...] = True
    return found


@pytest.mark.parametrize(
    ("broken", "check", "message"),
    [
        (partial(located, change=lambda p: p._replace(covariance=p.covariance[..., :3, :3])),
         "shapes", r"estimate.covariance must be a float64 array of shape \(6, 6\)"),
        (partial(located, change=lambda p: p._replace(rotation=-p.rotation)),
         "pose", "got a reflection"),
        (cannot_batch, "batching", "trial 0: translation differs"),
        (writes_links, "purity", r"locate must not change its arguments, but changed argument 4"),
        (partial(located, change=lambda p: p._replace(translation=0.9 * p.translation)),
         "invariance", "must move and turn the estimate: translation differs"),
        (forgets_links, "links", "an anchor whose links are all False"),
        (swallows_nan, "nan", "locate must raise a ValueError on NaN in anchors"),
        (partial(located, change=lambda p: p._replace(covariance=10 * p.covariance)),
         "nees", "errors are smaller than claimed"),
    ],
)  # fmt: skip
def test_a_broken_locator_fails_its_check(broken, check, message):
    with pytest.raises(AssertionError, match=message):
        check_locator(broken, skip=[name for name in testing._LOCATOR_CHECKS if name != check])


def test_a_locator_is_as_deterministic_as_it_should_be():
    rng = np.random.default_rng(1)
    shaken = partial(
        located, change=lambda p: p._replace(translation=p.translation + 1e-9 * rng.random(3))
    )
    with pytest.raises(AssertionError, match="a second call must give the same bytes"):
        check_locator(shaken, skip=[n for n in testing._LOCATOR_CHECKS if n != "determinism"])


def test_states_that_commands_cannot_take_apart_are_named():
    plain: Any = estimators.IteratedEkf

    class Wrapped(plain):
        """Its state is a dict."""

        def initial(self, *prior):
            return {"state": super().initial(*prior)}

        def predict(self, state, *args):
            return {"state": super().predict(state["state"], *args)}

        def update(self, state, *args, **options):
            return {"state": super().update(state["state"], *args, **options)}

        def belief(self, state):
            return super().belief(state["state"])

    with pytest.raises(AssertionError, match="got dict: commands"):
        check_filter(Wrapped)


def test_a_path_may_have_options():
    check_filter("tests.fragile:stumbles/epoch=100000", skip=["pickling", "noise"])
    with pytest.raises(AssertionError, match=r"update must accept valid arguments.*stumbled"):
        check_filter("tests.fragile:stumbles/epoch=1")

"""Figures of a filter in the benchmark: errors, efficiency, consistency, failures, differences."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.studies.epochs import nees_interval
from rbl_gym.studies.monte_carlo import rms

PARTS = ("position_m", "rotation_deg", "tags_m")
# A trial is lost if its tag error at the end exceeds this multiple of the bound, and the expected
# error of the prior.
LOST_BOUNDS = 10.0
# A pose with a larger rotation error (degrees) at the end is on the wrong side.
FLIPPED_DEG = 90.0
LEVEL = 0.95
RESAMPLES = 2000
# Digits of a figure that are kept; further digits are rounding errors.
_DIGITS = 9


class BenchErrors(NamedTuple):
    """Errors of a filter over K epochs and B trials, (K, B) each.

    `position_m`, `rotation_deg` and `tags_m` (root mean square over the tags) are norms of errors;
    `nees` has `dof` degrees of freedom.
    """

    position_m: FloatArray
    rotation_deg: FloatArray
    tags_m: FloatArray
    nees: FloatArray
    dof: int = 6


class Reference(NamedTuple):
    """References for errors.

    The expected errors (K, B) by the posterior Cramer-Rao bound, by part; the expected tag error
    (B,) of the prior; the distance (B,) of the last position to the image of the truth in the plane
    of the anchors, None if they have no plane.
    """

    bound: dict[str, FloatArray]
    prior_tags_m: FloatArray
    mirror_m: FloatArray | None


def error_figures(errors: BenchErrors, reference: Reference | None) -> dict[str, Any]:
    """Return all figures of a filter under a condition, as plain numbers; None if not finite.

    Without a reference (a recording, whose trials are segments of it), figures relative to the
    bound and of single epochs are absent.
    """
    result: dict[str, Any] = {"per_trial": {}}
    for part in PARTS:
        values = _finite_or_inf(getattr(errors, part))
        rows = {
            "rmse": rms(values),
            "median": np.quantile(values, 0.5, method="higher"),
            "p95": np.quantile(values, 0.95, method="higher"),
        }
        if reference is not None:
            bound = rms(reference.bound[part])
            rows |= {"bound": bound, "to_bound": rows["rmse"] / bound}
        result[part] = {key: json_number(value) for key, value in rows.items()}
        result["per_trial"][part] = json_number(rms(values, axis=0))
    result |= consistency(errors.nees, errors.dof)
    if reference is not None:
        lost = is_lost(errors.tags_m, reference)
        result["lost"] = json_number(lost.mean())
        result["flipped"] = json_number(is_flipped(errors, reference).mean())
        result["per_epoch"] = {
            "tags_m": json_number(rms(_finite_or_inf(errors.tags_m), axis=1)),
            "bound_tags_m": json_number(rms(reference.bound["tags_m"], axis=1)),
            "anees": json_number(_finite_or_inf(errors.nees).mean(axis=1) / errors.dof),
        }
    return result


def consistency(nees: FloatArray, dof: int) -> dict[str, Any]:
    """Return the average NEES per degree of freedom (K, B), and the consistency of the filter.

    It is 1 for consistent beliefs. At one epoch, the sum over B trials is chi-square distributed
    with ``dof B`` degrees of freedom. The average over dependent epochs varies no more than that,
    so the interval of one epoch is a conservative one. Above it the filter is ``"optimistic"`` (its
    errors are larger than its covariance says), below it ``"pessimistic"``. `within` is the share
    of epochs whose average lies in the interval.
    """
    nees = _finite_or_inf(nees)
    low, high = (end / dof for end in nees_interval(nees.shape[1], dof, LEVEL))
    anees = nees.mean() / dof
    verdict = "optimistic" if anees > high else "pessimistic" if anees < low else "consistent"
    per_epoch = nees.mean(axis=1) / dof
    return {
        "anees": json_number(anees),
        "anees_interval": [json_number(low), json_number(high)],
        "verdict": verdict,
        "within": json_number(((per_epoch >= low) & (per_epoch <= high)).mean()),
    }


def is_lost(tags_m: FloatArray, reference: Reference) -> np.ndarray:
    """Return the trials (B,) that end worse than the prior and far from the bound."""
    last = slice(-max(1, len(tags_m) // 4), None)
    end = rms(_finite_or_inf(tags_m)[last], axis=0)
    bound = rms(reference.bound["tags_m"][last], axis=0)
    return end > np.maximum(LOST_BOUNDS * bound, reference.prior_tags_m)


def is_flipped(errors: BenchErrors, reference: Reference) -> np.ndarray:
    """Return the trials (B,) whose last pose is on the wrong side.

    It is rotated by more than 90 degrees, or nearer to the mirror image of the truth behind the
    plane of the anchors than to the truth.
    """
    flipped = ~(errors.rotation_deg[-1] <= FLIPPED_DEG)
    if reference.mirror_m is not None:
        flipped |= ~(errors.position_m[-1] <= reference.mirror_m)
    return flipped


def differences(
    per_trial: dict[str, dict[str, list[float | None]]], seed: int
) -> dict[str, dict[str, Any]]:
    """Return how much worse each filter is than the best one, by root mean squares over the trials.

    `per_trial` has, by filter and by part in `PARTS`, the root mean square error of every trial;
    all filters run on the same trials. The resamples of `seed` are the same for all filters. For
    each filter and part: `best` (the filter with the smallest error), `difference`, and the limits
    `low` and `high` of its 95 % interval by the paired bootstrap over trials; None if an error is
    not finite.
    """
    names = list(per_trial)
    result: dict[str, dict[str, Any]] = {name: {} for name in names}
    count = min((len(per_trial[name][PARTS[0]]) for name in names), default=0)
    if not count:
        return result
    resamples = np.random.default_rng([seed, count]).multinomial(
        count, np.full(count, 1 / count), RESAMPLES
    )
    for part in PARTS:
        rows = np.array([per_trial[name][part] for name in names], dtype=np.float64)
        rmse = rms(rows, axis=1)
        if not np.isfinite(rmse).any():
            continue
        best = int(np.nanargmin(rmse))
        # Trials without a figure are None, here NaN, which propagates through the sums.
        drawn = np.sqrt((resamples @ np.square(rows).T) / count)
        for k, name in enumerate(names):
            difference = drawn[:, k] - drawn[:, best]
            low, high = np.quantile(difference, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
            result[name][part] = {
                "best": names[best],
                "difference": json_number(rmse[k] - rmse[best]),
                "low": json_number(low),
                "high": json_number(high),
            }
    return result


def _finite_or_inf(values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(values), values, np.inf)


def json_number(value: Any) -> Any:
    """Convert numbers for JSON, to nine digits; None if not finite."""
    if value is None:
        return None
    if np.ndim(value):
        return [json_number(item) for item in value]
    value = float(value)
    return float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None

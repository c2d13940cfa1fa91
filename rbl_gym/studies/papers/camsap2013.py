"""Run the experiment of the tracking paper (Section V): Figs 2 and 3, and each of its statements.

Source: S. P. Chepuri, A. Simonetto, G. Leus, A.-J. van der Veen, "Tracking position and
orientation of a mobile rigid body", CAMSAP 2013.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import metrics
from rbl_gym.checks import FloatArray
from rbl_gym.estimators import PoseBelief
from rbl_gym.studies import monte_carlo
from rbl_gym.studies.epochs import stack_beliefs
from rbl_gym.studies.monte_carlo import SimulatedTrials, Trace, rms
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.worlds import scenes
from rbl_gym.worlds.scene import Scene

__all__ = ["FILTERS", "Claim", "Example", "example", "paper_scene", "tracking_experiment"]

Filters = Mapping[str, tuple[str, dict[str, Any]]]

FILTERS: Filters = {
    "KF": ("kf", {}),
    "KF-ortho": ("kf-ortho", {}),
    "ET-KF": ("et-kf", {"threshold": 0.15}),
    "UC-KF": ("uc-kf", {}),
    "iterated EKF": ("iekf", {}),
}
_CONSISTENT_KF = ("kf", {"sigma_q_scale": math.sqrt(2 / 3)})
STEPS = 20
THRESHOLDS = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)
# Values that the paper does not give.
ASSUMED = (
    "sampling time 1 s",
    "one draw of the four anchors for all trials",
    "sensor positions relative to their mean",
)
# Number of standard errors that a step may deviate from an equality or order of means.
_SIGMAS = 4.0


class Example(NamedTuple):
    """One trial of K steps, and the results of some filters by label.

    Attributes
    ----------
    trials
        The trial, a batch of one.
    beliefs
        Beliefs, arrays (K, ...).
    errors
        Pose errors (K, 6) of the beliefs.
    """

    trials: SimulatedTrials
    beliefs: dict[str, PoseBelief]
    errors: dict[str, FloatArray]


class Claim(NamedTuple):
    """A statement, its source (``"paper"`` or ``"ours"``), whether it holds, and its figures."""

    statement: str
    source: str
    holds: bool
    figures: str


def paper_scene() -> Scene:
    """Return the world of the paper, with its 20 epochs."""
    return scenes.get({"name": "camsap2013", "steps": STEPS - 1})


def tracking_experiment(
    trials: int,
    seed: int,
    advance: Advance = silent,
    *,
    trade: bool = False,
    world: Scene | None = None,
    filters: Filters = FILTERS,
) -> dict[str, Any]:
    """Run the experiment of the tracking paper.

    Parameters
    ----------
    trials, seed
        Number of trials, and the random seed.
    advance
        Called after every epoch of every filter.
    trade
        Also run ET-KF over `THRESHOLDS`: its error versus its rate of projections.
    world
        Another scene instead of `paper_scene`.
    filters
        Label -> name and options. KF, KF-ortho, UC-KF and the iterated EKF must be among them.

    Returns
    -------
    A dict of plain numbers and lists: ``filters`` (with the series of Figs 2 and 3 in
    ``per_step``), ``bound``, ``claims``, ``assumed``, and ``trade`` if requested.
    """
    simulated = monte_carlo.simulate_trials(
        world or paper_scene(), trials, np.random.default_rng([seed, 0])
    )
    advance(0, more=(len(filters) + 1 + trade * len(THRESHOLDS)) * STEPS)
    traces = {
        label: monte_carlo.track_trials(simulated, name, options, advance)
        for label, (name, options) in filters.items()
    }
    consistent = monte_carlo.track_trials(simulated, *_CONSISTENT_KF, advance)
    bound = bound_per_step(simulated)
    result = {
        "experiment": "camsap2013",
        "trials": trials,
        "seed": seed,
        "assumed": list(ASSUMED),
        "bound": {key: value.tolist() for key, value in bound.items()},
        "filters": {label: filter_figures(trace, bound) for label, trace in traces.items()},
        "claims": [claim._asdict() for claim in claims(traces, consistent, bound)],
    }
    if trade:
        result["trade"] = _trade(simulated, advance)
    return result


def _trade(trials: SimulatedTrials, advance: Advance) -> list[dict[str, float]]:
    rows = []
    for threshold in THRESHOLDS:
        trace = monte_carlo.track_trials(trials, "et-kf", {"threshold": threshold}, advance)
        rows.append(
            {
                "threshold": threshold,
                "trigger_rate": float(trace.constrained.mean()),
                "rotation_rmse": float(rms(trace.frobenius)),
            }
        )
    return rows


def bound_per_step(trials: SimulatedTrials) -> dict[str, FloatArray]:
    """Return the posterior bound of each step: rotation (Frobenius) and translation RMSE (K,)."""
    variance = np.diagonal(trials.bound, axis1=-2, axis2=-1).mean(axis=1)
    return {
        "rotation_rmse": np.sqrt(2 * variance[:, :3].sum(axis=-1)),
        "translation_rmse_m": np.sqrt(variance[:, 3:].sum(axis=-1)),
    }


def filter_figures(trace: Trace, bound: dict[str, FloatArray]) -> dict[str, Any]:
    """Return the figures of a filter over all steps, and per step."""
    rotation, translation = rms(trace.frobenius, axis=1), _translation_rmse(trace)
    ratios = rotation / bound["rotation_rmse"], translation / bound["translation_rmse_m"]
    return {
        "rotation_rmse": float(rms(rotation)),
        "translation_rmse_m": float(rms(translation)),
        "mean_angular_error_deg": float(np.rad2deg(trace.angular.mean())),
        "rotation_to_bound": float(ratios[0].mean()),
        "translation_to_bound": float(ratios[1].mean()),
        "worst_step_to_bound": float(max(ratio.max() for ratio in ratios)),
        "nees": float(trace.nees.mean()),
        "reward": float(-np.log(trace.score).mean()),
        "trigger_rate": float(trace.constrained.mean()),
        "microseconds_per_step": 1e6 * trace.seconds,
        "per_step": {
            "rotation_rmse": rotation.tolist(),
            "estimated_rotation_rmse": _root_mean(trace.own_rotation).tolist(),
            "translation_rmse_m": translation.tolist(),
            "estimated_translation_rmse_m": _root_mean(trace.own_translation).tolist(),
            "mean_angular_error_deg": np.rad2deg(trace.angular.mean(axis=1)).tolist(),
            "nees": trace.nees.mean(axis=1).tolist(),
        },
    }


def _translation_rmse(trace: Trace) -> FloatArray:
    return rms(np.linalg.norm(trace.error[..., 3:], axis=-1), axis=1)


def _root_mean(variance: FloatArray) -> FloatArray:
    return np.sqrt(variance.mean(axis=1))


def claims(
    traces: dict[str, Trace], consistent: Trace, bound: dict[str, FloatArray]
) -> list[Claim]:
    """Test the statements of the paper (Section V), and ours, on the filters at each step."""
    rotation = {label: rms(trace.frobenius, axis=1) for label, trace in traces.items()}
    translation = {label: _translation_rmse(trace) for label, trace in traces.items()}
    angle = {label: trace.angular.mean(axis=1) for label, trace in traces.items()}
    kf, uc = traces["KF"], traces["UC-KF"]

    def to_kf(label: str) -> FloatArray:
        return rotation[label] / rotation["KF"]

    followed = np.array(
        [
            _root_mean(kf.own_rotation) / rotation["KF"],
            _root_mean(kf.own_translation) / translation["KF"],
        ]
    )
    follows = np.abs(followed - 1).max() < 0.12 and np.abs(followed.mean(axis=1) - 1).max() < 0.05
    covered = _root_mean(uc.own_rotation) / rotation["UC-KF"]
    linear = [label for label in ("KF-ortho", "ET-KF", "UC-KF") if label in traces]
    spread = np.max([np.abs(translation[label] / translation["KF"] - 1) for label in linear])
    found = [
        _of_paper(
            "KF's estimated RMSE within 12 % of its RMSE, rotation and translation; 5 % on average",
            follows,
            followed,
        ),
        _of_paper(
            "UC-KF's RMSE below KF's at every step", to_kf("UC-KF").max() < 1, to_kf("UC-KF")
        ),
        _of_paper(
            "KF-ortho's RMSE below KF's at every step",
            to_kf("KF-ortho").max() < 1,
            to_kf("KF-ortho"),
        ),
    ]
    if "ET-KF" in traces:
        found += _claims_of_et_kf(traces, to_kf("ET-KF"), rotation)
    in_angle = np.array([angle[label] / angle["KF"] for label in linear])
    found += [
        _of_paper(
            f"mean angle of {', '.join(linear)} below KF's, averaged over the steps",
            in_angle.mean(axis=1).max() < 1,
            in_angle,
        ),
        Claim(
            f"translation of KF, {', '.join(linear)} equal within 1 %",
            "paper",
            bool(spread < 0.01),
            f"largest difference {100 * spread:.2g} %",
        ),
        _of_paper("UC-KF's covariance an overestimate at every step", covered.min() > 1, covered),
    ]
    return found + _claims_of_ours(traces, consistent, bound, rotation, translation)


def _claims_of_et_kf(
    traces: dict[str, Trace], to_kf: FloatArray, rotation: dict[str, FloatArray]
) -> list[Claim]:
    noise = _standard_error_of_ratio(traces["ET-KF"].frobenius, traces["KF"].frobenius)
    beyond = ((to_kf - 1) / noise).max()
    above = rotation["ET-KF"] / rotation["KF-ortho"]
    return [
        _of_paper(
            "ET-KF(0.15)'s RMSE below KF's, averaged over the steps", to_kf.mean() < 1, to_kf
        ),
        Claim(
            f"ET-KF(0.15)'s RMSE at no step above KF's by more than {_SIGMAS:.0f} standard errors",
            "paper",
            bool(beyond <= _SIGMAS),
            f"largest excess {beyond:.1f} standard errors",
        ),
        _of_paper("ET-KF(0.15)'s RMSE above KF-ortho's at every step", above.min() > 1, above),
    ]


def _claims_of_ours(
    traces: dict[str, Trace],
    consistent: Trace,
    bound: dict[str, FloatArray],
    rotation: dict[str, FloatArray],
    translation: dict[str, FloatArray],
) -> list[Claim]:
    scaled = _root_mean(consistent.own_rotation) / rms(consistent.frobenius, axis=1)
    ratios = np.array(
        [
            rotation["iterated EKF"] / bound["rotation_rmse"],
            translation["iterated EKF"] / bound["translation_rmse_m"],
        ]
    )
    average = ratios.mean(axis=1).max()
    nees = float(traces["iterated EKF"].nees.mean())
    return [
        Claim(
            "KF within 3 % of its estimate with sigma_q_scale = sqrt(2/3), mean over the steps",
            "ours",
            bool(abs(scaled.mean() - 1) < 0.03),
            _range_of(scaled),
        ),
        Claim(
            "iterated EKF <= 1.08 of the bound at each step, <= 1.03 on average",
            "ours",
            bool(ratios.max() <= 1.08 and average <= 1.03),
            f"worst step {ratios.max():.3f}, average {average:.3f}",
        ),
        Claim("iterated EKF's NEES 6 +- 0.4", "ours", bool(abs(nees - 6) <= 0.4), f"{nees:.2f}"),
    ]


def _standard_error_of_ratio(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the standard error (K,) of the ratio of two paired RMSEs (K, B), for ratios near 1."""
    a, b = one**2, other**2
    parts = a / a.mean(axis=1, keepdims=True) - b / b.mean(axis=1, keepdims=True)
    return np.maximum(0.5 * parts.std(axis=1) / np.sqrt(parts.shape[1]), 1e-12)


def _of_paper(statement: str, holds: Any, ratio: FloatArray) -> Claim:
    return Claim(statement, "paper", bool(holds), _range_of(ratio))


def _range_of(ratio: FloatArray) -> str:
    return f"ratio {ratio.min():.3f} to {ratio.max():.3f}, mean {ratio.mean():.3f}"


def example(seed: int) -> Example:
    """Return one trial, for the figure."""
    trial = monte_carlo.simulate_trials(paper_scene(), 1, np.random.default_rng([seed, 1]))
    truth = trial.episode.rotation[0], trial.episode.translation[0]
    found = Example(trial, {}, {})
    for label in ("KF", "iterated EKF"):
        name, options = FILTERS[label]
        filter = monte_carlo.scene_filter(trial.scene, name, options)
        steps = monte_carlo.trial_steps(trial, filter)
        belief = PoseBelief(*(part[:, 0] for part in stack_beliefs(s.belief for s in steps)))
        found.beliefs[label] = belief
        found.errors[label] = metrics.pose_error(*belief[:2], *truth)
    return found

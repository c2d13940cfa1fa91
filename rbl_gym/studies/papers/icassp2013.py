"""Run the experiment of the static paper (Section 4): one epoch, every method, the bound.

Source: S. P. Chepuri, G. Leus, A.-J. van der Veen, "Position and orientation estimation of a
rigid body: rigid body localization", ICASSP 2013.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds, estimators, metrics
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import bodies
from rbl_gym.measurements import ranging
from rbl_gym.studies.monte_carlo import rms
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.worlds import scenes

__all__ = ["METHODS", "Setting", "static_experiment", "static_settings"]

METHODS = {
    "LS": "ls",
    "LS-projected": "ls-projected",
    "CLS = CTLS": "ctls",
    "UC-LS": "uc-ls",
    "two-step": "two-step",
    "ML": "ml",
}
REFERENCE_RANGES_DB = tuple(range(40, 101, 10))
FIGURES = ("mean_angular_error_deg", "rotation_rmse", "translation_rmse_m")
PERTURBATION_M = 1e-3


class Setting(NamedTuple):
    """One variant of the experiment.

    Attributes
    ----------
    low, high
        Corners of the cube from which the anchors are drawn, metres.
    anchors
        None: drawn again in every trial; an int: this number, drawn once; or positions (M, 3).
    perturbation_m
        Standard deviation of the tag positions.
    tags
        Tag positions (N, 3) known to the estimators.
    """

    low: float
    high: float
    anchors: FloatArray | int | None
    perturbation_m: float
    tags: FloatArray


N_ANCHORS = 10


def static_settings() -> dict[str, Setting]:
    """Return the settings of Figs 2 and 3.

    Anchors are in one of two regions, redrawn or fixed; (a) without, (b) with perturbed tags.
    """
    body = bodies.icassp2013()
    return {
        "[0, 100]^3": Setting(0, 100, None, 0.0, body),
        "[0, 100]^3, fixed": Setting(0, 100, N_ANCHORS, 0.0, body),
        "[0, 100]^3, 1 mm": Setting(0, 100, None, PERTURBATION_M, body),
        "[-50, 50]^3": Setting(-50, 50, None, 0.0, body),
        "[-50, 50]^3, 1 mm": Setting(-50, 50, None, PERTURBATION_M, body),
    }


def static_experiment(
    name: str, settings: dict[str, Setting], trials: int, seed: int, advance: Advance = silent
) -> dict[str, Any]:
    """Run every method at every reference range of every setting, and compute the bounds.

    Parameters
    ----------
    name
        Name of the result.
    settings
        Settings by label: `static_settings`, or others.
    trials, seed
        Number of trials of each setting and reference range, and the random seed.
    advance
        Called after every reference range of every setting.

    Returns
    -------
    A dict of plain numbers: ``settings[label]`` has ``reference_range_db``, ``bound`` (raw
    ranges), ``bound_squared`` (|s|^2 projected out) and ``methods``, each with the three
    figures per reference range and their mean ratio to the bound.
    """
    result: dict[str, Any] = {"experiment": name, "trials": trials, "seed": seed, "settings": {}}
    advance(0, more=len(settings) * len(REFERENCE_RANGES_DB))
    for index, (label, setting) in enumerate(settings.items()):
        if isinstance(setting.anchors, int):
            rng = np.random.default_rng([seed, index])
            places = rng.uniform(setting.low, setting.high, (setting.anchors, 3))
            setting = setting._replace(anchors=places)
        rows = [
            _epoch(setting, db, trials, np.random.default_rng([seed, index, db]), advance)
            for db in REFERENCE_RANGES_DB
        ]
        labels = rows[0]
        table = {key: _columns([row[key] for row in rows]) for key in labels}
        bound = table.pop("bound")
        for method in table.values():
            method["ratio"] = {
                figure: float(np.mean(np.divide(method[figure], bound[figure])))
                for figure in FIGURES
            }
        result["settings"][label] = {
            "reference_range_db": list(REFERENCE_RANGES_DB),
            "bound": bound,
            "bound_squared": table.pop("bound_squared"),
            "methods": table,
        }
    return result


def _columns(rows: list[dict[str, float]]) -> dict[str, Any]:
    return {key: [row[key] for row in rows] for key in rows[0]}


def _epoch(
    setting: Setting, db: int, trials: int, rng: np.random.Generator, advance: Advance
) -> dict[str, dict[str, float]]:
    """Return the figures of all methods and bounds at one reference range."""
    scene = scenes.SCENES["icassp2013"]
    rotation, translation = np.array(scene.start_rotation), np.array(scene.start_translation)
    anchors = rng.uniform(setting.low, setting.high, (trials, N_ANCHORS, 3))
    if setting.anchors is not None:
        anchors = np.broadcast_to(setting.anchors, (trials, *np.shape(setting.anchors)))
    noise = ranging.RangeNoise.from_reference_range_db(db)
    tags = np.broadcast_to(setting.tags, (trials, *setting.tags.shape))
    true_tags = tags
    if setting.perturbation_m > 0:
        true_tags = bodies.perturb(tags, setting.perturbation_m, rng)
    ranges = ranging.simulate(anchors, true_tags, rotation, translation, noise, rng).ranges
    truth = (anchors, setting.tags, rotation, translation, noise)
    std = setting.perturbation_m
    rows = {
        "bound": _expected(bounds.pose_crb(*truth, tag_std_m=std), rotation),
        "bound_squared": _expected(
            bounds.pose_crb(*truth, model="squared", tag_std_m=std), rotation
        ),
    }
    methods = {label: (method, 0.0) for label, method in METHODS.items()}
    if std > 0:
        methods["ML, marginalised"] = ("ml", std)
    for label, (method, tag_std) in methods.items():
        found = estimators.locate(ranges, anchors, tags, noise, method, tag_std_m=tag_std)
        rows[label] = _achieved(found, rotation, translation)
    advance()
    return rows


def _achieved(
    found: estimators.PoseEstimate, rotation: FloatArray, translation: FloatArray
) -> dict[str, float]:
    error = metrics.pose_error(found.rotation, found.translation, rotation, translation)
    return {
        "mean_angular_error_deg": float(
            np.rad2deg(metrics.mean_angular_error(found.matrix, rotation).mean())
        ),
        "rotation_rmse": float(rms(np.linalg.norm(found.matrix - rotation, axis=(-2, -1)))),
        "translation_rmse_m": float(rms(np.linalg.norm(error[:, 3:], axis=-1))),
        "nees": float(metrics.nees(error, found.covariance).mean()),
    }


def _expected(covariance: FloatArray, rotation: FloatArray) -> dict[str, float]:
    """Return the root of the mean trace of a bound over trials, and the mean expected angle."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1).reshape(-1, 6).mean(axis=0)
    angle = metrics.expected_mean_angular_error(covariance, rotation).mean()
    return {
        "mean_angular_error_deg": float(np.rad2deg(angle)),
        "rotation_rmse": float(np.sqrt(2 * variance[:3].sum())),
        "translation_rmse_m": float(np.sqrt(variance[3:].sum())),
    }

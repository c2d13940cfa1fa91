"""Run the experiment of the DOA paper: one base station, four tags, Newton's iteration and others.

The body has R = I and t = (5, 5, 3) m as in the paper, or a random rotation in every trial. Angles
have 0.01, 0.1 and 1 degree of noise. The body is known to be on the side y > 0.

Source: S. Wu, L. Ai, J. Zhan, L. Yang, Q. Wu, B. Zhou, "An efficient approach for rigid body
localization via a single base station using direction of arrive measurement". It counts successes
without a definition. We use two: ``near``, both errors within 6 times the bound of the trial, and
``within_half_metre``, a translation error below 0.5 m.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from rbl_gym import estimators, metrics
from rbl_gym.bounds import doa
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import bearing
from rbl_gym.studies.monte_carlo import rms
from rbl_gym.studies.progress import Advance, silent

__all__ = ["doa_experiment"]

METHODS = {"NIA + UQ": "nia", "ML": "ml", "PSO": "pso", "PSA": "psa"}
SIGMAS_DEG = (0.01, 0.1, 1.0)
SETTINGS = ("R = I", "random R")
TRANSLATION = np.array([5.0, 5.0, 3.0])
# Table 1 of the paper, in the order of SIGMAS_DEG: seconds to convergence, successes in percent.
TABLE_1 = {
    "NIA + UQ": {"seconds": [1.1e-3, 0.9e-3, 1.8e-3], "success_percent": [100, 100, 76]},
    "PSO": {"seconds": [7.9, 7.3, 10.4], "success_percent": [100, 95, 51]},
    "PSA": {"seconds": [5.3, 5.9, 8.9], "success_percent": [100, 100, 70]},
}
_HALF_METRE = 0.5
# A trial with larger errors, in multiples of the bound, has found another optimum or none.
_NEAR = 6.0


def doa_experiment(trials: int, seed: int, advance: Advance = silent) -> dict[str, Any]:
    """Run every method at every noise level of both settings, and compute the bound.

    Returns
    -------
    A dict of plain numbers. ``settings[label]`` has ``sigma_deg``, ``bound`` and ``methods``. Each
    method has figures per noise level: `rotation_rmse` (Frobenius) and `translation_rmse_m` of the
    trials near the truth (both errors within 6 times the bound of the trial), their ratios to the
    bound, the shares `near`, `within_half_metre` (of t) and `converged`, the median and largest
    number of iterations (0: not counted), and the processor time per trial, absolute and relative
    to NIA. ``table_1`` holds the values of the paper.
    """
    result: dict[str, Any] = {"experiment": "doa2019", "trials": trials, "seed": seed}
    result["table_1"] = TABLE_1
    result["settings"] = {}
    advance(0, more=len(SETTINGS) * len(SIGMAS_DEG) * len(METHODS))
    for index, label in enumerate(SETTINGS):
        rows = [
            _noise(label, sigma, trials, np.random.default_rng([seed, index, k]), advance)
            for k, sigma in enumerate(SIGMAS_DEG)
        ]
        table = {key: {f: [row[key][f] for row in rows] for f in rows[0][key]} for key in rows[0]}
        result["settings"][label] = {
            "sigma_deg": list(SIGMAS_DEG),
            "bound": table.pop("bound"),
            "methods": table,
        }
    return result


def _noise(
    label: str, sigma_deg: float, trials: int, rng: np.random.Generator, advance: Advance
) -> dict[str, dict[str, float]]:
    """Return the figures of all methods and the bound at one noise level."""
    tags, noise = bodies.doa2019(), bearing.AngleNoise(np.deg2rad(sigma_deg))
    rotation = np.tile(np.eye(3), (trials, 1, 1))
    if label == "random R":
        rotation = rotations.random(rng, (trials,))
    angles = bearing.simulate(tags, rotation, TRANSLATION, noise, rng)
    bound = _of_covariance(doa.doa_crb(tags, rotation, TRANSLATION, noise))
    rows: dict[str, dict[str, float]] = {
        "bound": {"rotation_rmse": float(rms(bound[0])), "translation_rmse_m": float(rms(bound[1]))}
    }
    for name, method in METHODS.items():
        start = time.process_time()
        found = estimators.locate_doa(
            angles, tags, method, noise, "y>0", rng=np.random.default_rng(rng.integers(2**32))
        )
        seconds = time.process_time() - start
        rows[name] = _judged(found, rotation, bound)
        rows[name]["microseconds_per_trial"] = 1e6 * seconds / trials
        rows[name]["time_ratio"] = (
            rows[name]["microseconds_per_trial"] / rows["NIA + UQ"]["microseconds_per_trial"]
        )
        advance()
    return rows


def _of_covariance(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviation of every trial: of R (Frobenius norm), and of t in metres."""
    variance = np.diagonal(P, axis1=-2, axis2=-1)
    return np.sqrt(2 * variance[..., :3].sum(-1)), np.sqrt(variance[..., 3:].sum(-1))


def _judged(
    found: estimators.PoseEstimate, rotation: FloatArray, bound: tuple[FloatArray, FloatArray]
) -> dict[str, float]:
    turn = np.linalg.norm(found.rotation - rotation, axis=(-2, -1))
    shift = np.linalg.norm(found.translation - TRANSLATION, axis=-1)
    # False for trials without a pose, whose errors are NaN.
    near = (turn < _NEAR * bound[0]) & (shift < _NEAR * bound[1])
    of_near = [float(rms(error[near])) if near.any() else 0.0 for error in (turn, shift)]
    expected = [float(rms(std[near])) if near.any() else 1.0 for std in bound]
    counted = found.iterations[found.converged] if found.converged.any() else np.zeros(1)
    nees = 0.0
    if near.any():
        error = metrics.pose_error(
            found.rotation[near], found.translation[near], rotation[near], TRANSLATION
        )
        nees = float(metrics.nees(error, found.covariance[near]).mean())
    return {
        "rotation_rmse": of_near[0],
        "translation_rmse_m": of_near[1],
        "rotation_to_bound": of_near[0] / expected[0],
        "translation_to_bound": of_near[1] / expected[1],
        "nees": nees,
        "near": float(near.mean()),
        "within_half_metre": float((shift < _HALF_METRE).mean()),
        "converged": float(found.converged.mean()),
        "iterations": float(np.median(counted)),
        "most_iterations": float(counted.max(initial=0)),
    }

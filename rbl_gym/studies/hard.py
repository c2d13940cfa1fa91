"""Compare filters with bounds under hard conditions: bad links, wrong starts, outages."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.studies import monte_carlo
from rbl_gym.studies.monte_carlo import SimulatedTrials
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.worlds import scenes
from rbl_gym.worlds.scene import Scene

__all__ = ["compare_hard_conditions"]

LINK_SCENES = ("uwb_room", "drone_yard")
CONDITIONS: dict[str, dict[str, float]] = {
    "all links": {},
    "10 % NLOS": {"nlos_probability": 0.1},
    "20 % NLOS": {"nlos_probability": 0.2},
    "50 % lost": {"drop_probability": 0.5},
    "50 % lost, 10 % NLOS": {"drop_probability": 0.5, "nlos_probability": 0.1},
}
FILTERS = ("iekf", "iekf/robust=true", "iekf-bank/robust=true")
START_SCENES = ("uwb_room", "drone_yard", "satellite", "auv_buoys")
STARTS = ("wrong", "nothing", "outage", "wrong, 10 % NLOS")
START_FILTERS = ("iekf", "iekf-bank")
# For coplanar anchors, which leave a mirror pose, a bank that knows the side: the option `volume`
# is set to the limits of the scene.
_WITH_VOLUME = "iekf-bank, volume"
_COPLANAR = ("auv_buoys",)
# An error whose square, normalised by the bound, exceeds this value is not random (mean 6).
LOST = 100.0
# Epochs after a start, and epochs of an outage without links and odometry.
_START_STEPS, _GONE = 20, range(5, 50)
_WRONG_RAD, _WRONG_M = np.pi, 10.0
# Epochs after a wrong start, or after an outage, at which recovery is evaluated.
AFTER = (0, 1, 2, 5, 10)


class _Case(NamedTuple):
    """Trials, information of the bound, and the epoch at which links return."""

    trials: SimulatedTrials
    information: FloatArray
    back: int


def _start_filters(scene: str) -> tuple[str, ...]:
    return (*START_FILTERS, _WITH_VOLUME) if scene in _COPLANAR else START_FILTERS


def compare_hard_conditions(trials: int, seed: int, advance: Advance = silent) -> dict[str, Any]:
    """Run all filters under all conditions, and from all starts.

    Returns
    -------
    A dict of plain numbers. ``links[scene][condition]`` has `share_good`, the share of links with a
    range on the direct path, and `filters`. Each filter has its RMSE relative to two posterior
    Cramer-Rao bounds, averaged over the epochs (``clean``: all links on direct paths; ``good``:
    only the available direct ones), NEES, the largest errors, `lost` (share of trials with a
    normalised squared error above `LOST`, at the end or ever), and microseconds per step.
    ``starts[scene][start][filter]`` is the share of recovered trials, by number of epochs
    (`AFTER`).
    """
    result: dict[str, Any] = {"experiment": "hard", "trials": trials, "seed": seed}
    links = len(LINK_SCENES) * len(CONDITIONS) * len(FILTERS)
    starts = len(STARTS) * sum(len(_start_filters(name)) for name in START_SCENES)
    advance(0, more=links + starts)
    result["links"] = {}
    for i, name in enumerate(LINK_SCENES):
        table = result["links"][name] = {}
        for k, (condition, model) in enumerate(CONDITIONS.items()):
            scene = scenes.get({"name": name, "links": model})
            rng = np.random.default_rng([seed, 0, i, k])
            table[condition] = _links(scene, trials, rng, advance)
    result["starts"] = {"after": list(AFTER), "scenes": {}}
    for i, name in enumerate(START_SCENES):
        rows = result["starts"]["scenes"][name] = {}
        for k, start in enumerate(STARTS):
            case = _start(name, start, trials, np.random.default_rng([seed, 1, i, k]))
            rows[start] = {
                label: _back(case, label, "NLOS" in start, advance)
                for label in _start_filters(name)
            }
    return result


# --- links ---------------------------------------------------------------------------------------


def _links(scene: Scene, count: int, rng: np.random.Generator, advance: Advance) -> dict[str, Any]:
    """Run all filters on the same episodes of one scene, under each condition."""
    trials = monte_carlo.simulate_trials(scene, count, rng)
    good = np.array([m.links & ~m.nlos for m in trials.measurements])
    clean = monte_carlo.bound_of(scene, trials.episode, np.ones_like(good))
    straight = monte_carlo.bound_of(scene, trials.episode, good)
    row: dict[str, Any] = {"share_good": float(np.mean(good)), "filters": {}}
    for label in FILTERS:
        trace = monte_carlo.track_trials(trials, label, {})
        distance = _squared_distance(trace.error, straight)
        row["filters"][label] = {
            "clean": _ratios(trace.error, clean),
            "good": _ratios(trace.error, straight),
            "nees": float(trace.nees.mean()),
            "largest_error_m": float(np.linalg.norm(trace.error[..., 3:], axis=-1).max()),
            "largest_error_deg": float(
                np.rad2deg(np.linalg.norm(trace.error[..., :3], axis=-1).max())
            ),
            "lost_at_the_end": float((distance[-1] > LOST).mean()),
            "lost_ever": float((distance > LOST).any(axis=0).mean()),
            "microseconds_per_step": 1e6 * trace.seconds,
        }
        advance()
    return row


def _ratios(error: FloatArray, bound: FloatArray) -> dict[str, float]:
    """Return the RMSE over that of the bound, averaged over epochs: rotation and translation."""
    variance = np.diagonal(bound, axis1=-2, axis2=-1).mean(axis=1)
    square = np.square(error).mean(axis=1)
    return {
        name: float(np.sqrt(square[:, axes].sum(-1) / variance[:, axes].sum(-1)).mean())
        for name, axes in (("rotation", slice(0, 3)), ("translation", slice(3, 6)))
    }


def _squared_distance(error: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.einsum("...i,...i->...", error, np.linalg.solve(covariance, error[..., None])[..., 0])


# --- starts --------------------------------------------------------------------------------------


def _start(name: str, start: str, trials: int, rng: np.random.Generator) -> _Case:
    """Return episodes with a wrong start, without start information, or with an outage."""
    links = {"nlos_probability": 0.1} if "NLOS" in start else {}
    back = _GONE.stop if start == "outage" else 0
    scene = scenes.get({"name": name, "links": links, "steps": back + _START_STEPS})
    simulated = monte_carlo.simulate_trials(scene, trials, rng)
    information = np.linalg.inv(simulated.bound)
    episode = simulated.episode
    if start == "outage":
        twists = episode.twists.copy()
        twists[:, _GONE.start : _GONE.stop + 1] = 0.0
        measurements = [
            m._replace(links=np.zeros_like(m.links)) if epoch in _GONE else m
            for epoch, m in enumerate(simulated.measurements)
        ]
        return _Case(
            simulated._replace(episode=episode._replace(twists=twists), measurements=measurements),
            information,
            back,
        )
    if start == "nothing":
        low, high = scene.volume.bounds()
        std = [np.pi] * 3 + [float(np.ptp([low, high], axis=0).max())] * 3
        rotation = np.broadcast_to(np.eye(3), (trials, 3, 3))
        translation = np.broadcast_to(0.5 * (low + high), (trials, 3))
        covariance = np.broadcast_to(np.diag(np.square(std)), (trials, 6, 6))
    else:
        units = rng.standard_normal((2, trials, 3))
        turn, shift = units / np.linalg.norm(units, axis=-1, keepdims=True)
        rotation = rotations.exp(_WRONG_RAD * turn) @ episode.rotation[:, 0]
        translation = episode.translation[:, 0] + _WRONG_M * shift
        covariance = episode.prior_covariance
    episode = episode._replace(
        prior_rotation=rotation, prior_translation=translation, prior_covariance=covariance
    )
    return _Case(simulated._replace(episode=episode), information, back)


def _back(case: _Case, label: str, robust: bool, advance: Advance) -> dict[str, Any]:
    """Return the recovery of filters over epochs, and the time of a step."""
    options: dict[str, Any] = {"robust": robust}
    if label == _WITH_VOLUME:
        options["volume"] = case.trials.scene.volume.bounds()
    trace = monte_carlo.track_trials(case.trials, label.partition(",")[0], options)
    distance = np.einsum("...i,...ij,...j->...", trace.error, case.information, trace.error)
    share = (distance < LOST).mean(axis=1)
    advance()
    return {
        "back": [float(share[case.back + k]) for k in AFTER],
        "microseconds_per_step": 1e6 * trace.seconds,
    }

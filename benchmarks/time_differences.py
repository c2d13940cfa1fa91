"""What an unknown offset of the ranges costs, and whether the estimators stand at their bounds.

The room of ``uwb_room`` with its six anchors and others besides; offsets of 30 m (100 ns), new at
every epoch. `locate` on one epoch of bodies anywhere in the room, the iterated EKF and the
smoother on tracks of 31 epochs, against their Cramer-Rao bounds.

    python benchmarks/time_differences.py [--trials 1000] [--seed 0] [--plot F.png]
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from rbl_gym import bounds, estimators, metrics
from rbl_gym.bounds import smoothing as smoothing_bound
from rbl_gym.estimators import smoothing
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.studies import monte_carlo
from rbl_gym.worlds import scenes

OFFSETS = (None, "epoch", "tag", "anchor")
LABELS = {
    None: "none: ranges", "epoch": "one for all", "tag": "one per tag", "anchor": "one per anchor",
}  # fmt: skip
COUNTS = (4, 5, 6, 8, 10)
BLOCKS = (slice(0, 3), slice(3, 6))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("--trials", 1000), ("--seed", 0)):
        parser.add_argument(name, type=int, default=default)
    parser.add_argument("--plot", help="picture of the first table")
    options = parser.parse_args()
    curves = {o: one_epoch(o, options.trials, options.seed) for o in OFFSETS}
    print("one epoch: position (m) of locate, its bound, by the number of anchors")
    print(f"{'':18s}" + "".join(f"{m:14d}" for m in COUNTS))
    for offset, (found, bound) in curves.items():
        cells = (f"{a:7.3f} {b:6.3f}" for a, b in zip(found, bound, strict=True))
        print(f"{LABELS[offset]:18s}" + "".join(cells))
    print("\n31 epochs: error over bound (rotation, position), NEES/6, position (m)")
    for offset in OFFSETS:
        for name, figures in tracks(offset, options.trials, options.seed).items():
            print(f"{LABELS[offset]:18s}{name:10s}" + " ".join(f"{x:7.3f}" for x in figures))
    if options.plot:
        plot(curves, options.plot)


def scene_of(offset: str | None) -> Any:
    links = {} if offset is None else {"offset": offset}
    return scenes.get({"name": "uwb_room", "steps": 30, "links": links})


def one_epoch(offset: str | None, trials: int, seed: int) -> tuple[list[float], list[float]]:
    """Root mean square position error of `locate` and of its bound, by number of anchors."""
    scene = scene_of(offset)
    found, limit = [], []
    for count in COUNTS:
        rng = np.random.default_rng(seed)
        # The same anchors for every kind of offset: six of the scene, then drawn on the walls.
        drawn = scene.anchor_region.draw(np.random.default_rng(1).random((max(COUNTS), 3)))
        anchors = np.concatenate([np.array(scene.anchors or drawn), drawn])[:count]
        low, high = scene.volume.bounds()
        rotation = rotations.random(rng, (trials,))
        place = low + rng.random((trials, 3)) * (high - low)
        measured = ranging.simulate(
            anchors, scene.body, rotation, place, scene.noise, rng, scene.links
        )
        pose = estimators.locate(measured.ranges, anchors, scene.body, scene.noise, offset=offset)
        P = bounds.pose_crb(anchors, scene.body, rotation, place, scene.noise, offset=offset)
        square = np.square(pose.translation - place).sum(axis=-1)
        of_bound = np.trace(P[:, 3:, 3:], axis1=-2, axis2=-1)
        # Without the tenth of the bodies that stand worst, which would rule the mean.
        kept = of_bound <= np.quantile(of_bound, 0.9)
        found.append(float(np.sqrt(square[kept].mean())))
        limit.append(float(np.sqrt(of_bound[kept].mean())))
    return found, limit


def tracks(offset: str | None, trials: int, seed: int) -> dict[str, list[float]]:
    """Ratios to the bound, NEES/6 and position error of filter and smoother."""
    scene = scene_of(offset)
    world = monte_carlo.simulate_trials(scene, trials, np.random.default_rng(seed))
    trace = monte_carlo.track_trials(world, "iekf", {})
    figures = {"iekf": judged(trace.error[5:], world.bound[5:], trace.nees[5:])}
    few = monte_carlo.simulate_trials(scene, max(trials // 10, 10), np.random.default_rng(seed))
    told = monte_carlo.told_readings(scene, few.episode, few.measurements)
    episode = few.episode
    times = np.cumsum([reading.dt for reading in told])
    twists = np.stack([reading.twist for reading in told[1:]], axis=1)
    ranges = np.stack([reading.ranges for reading in told], axis=1)
    log = smoothing.RangeLog(times, ranges, episode.anchors[:, None])
    prior = episode.prior_rotation, episode.prior_translation, episode.prior_covariance
    filter = monte_carlo.scene_filter(scene, "iekf", {})
    start = smoothing.causal_track(filter, log, prior, twists)
    motion = smoothing.KnownTwist(scene.process, twists)
    model = smoothing.LogModel(scene.body, scene.noise, motion, offset=offset)
    smooth = estimators.smooth(log, model, prior, start)
    error = metrics.pose_error(
        smooth.rotation, smooth.translation, episode.rotation, episode.translation
    )
    limit = smoothing_bound.smoothing_crb(
        bounds.RangeEpoch(
            episode.anchors[:, None], scene.body, episode.rotation, episode.translation, scene.noise
        ),
        bounds.KnownTwist(twists, scene.dt, scene.process),
        scene.prior_covariance,
        offset=offset,
    )
    figures["smoother"] = judged(error, limit, metrics.nees(error, smooth.covariance))
    return figures


def judged(error: np.ndarray, bound: np.ndarray, nees: np.ndarray) -> list[float]:
    squares = [np.square(error[..., block]).sum(axis=-1).mean() for block in BLOCKS]
    limits = [np.trace(bound[..., b, b], axis1=-2, axis2=-1).mean() for b in BLOCKS]
    ratios = [float(np.sqrt(a / b)) for a, b in zip(squares, limits, strict=True)]
    return [*ratios, float(nees.mean() / 6), float(np.sqrt(squares[1]))]


def plot(curves: dict[str | None, tuple[list[float], list[float]]], path: str) -> None:
    """Bounds as lines, `locate` as dots."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.subplots()
    for k, (offset, (found, bound)) in enumerate(curves.items()):
        axes.plot(COUNTS, bound, f"C{k}-", label=LABELS[offset])
        axes.plot(COUNTS, found, f"C{k}o")
    axes.set(
        xlabel="anchors", ylabel="position error (m)", yscale="log",
        title="One epoch: bound (lines) and locate (dots)",
    )  # fmt: skip
    axes.grid(alpha=0.3, which="both")
    axes.legend(title="unknown offset")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()

"""Pictures, by matplotlib without a display."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from rbl_gym.app.papers import Example
from rbl_gym.app.replay import Errors, Track
from rbl_gym.checks import FloatArray
from rbl_gym.recordings import Recording, truth_at

COLOURS = {
    "KF": "#d1495b",
    "KF-ortho": "#e8a33d",
    "ET-KF": "#8d6cab",
    "UC-KF": "#2e86ab",
    "iterated EKF": "#1b7f5c",
}
# A belief is centimetres wide on a track of hundreds of metres.
_MAGNIFY = 200


def _new(width: float, height: float) -> Figure:
    matplotlib.rcParams.update({"font.size": 9, "axes.spines.top": False,
                                "axes.spines.right": False})  # fmt: skip
    return Figure(figsize=(width, height), layout="constrained")


def save(figure: Figure, path: str) -> None:
    """Write a figure, making its folder."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def camsap2013(result: dict[str, Any], example: Example) -> Figure:
    """One trajectory with its beliefs, and the error curves of both readings with the bound."""
    figure = _new(13, 7.2)
    grid = figure.add_gridspec(2, 3, width_ratios=[1.15, 1, 1])
    _trajectory(figure.add_subplot(grid[:, 0]), example)
    for row, (reading, data) in enumerate(result["readings"].items()):
        for column, (key, label) in enumerate(
            (("rotation_rmse", "rotation RMSE (Frobenius)"),
             ("translation_rmse_m", "translation RMSE [m]"))
        ):  # fmt: skip
            axes = figure.add_subplot(grid[row, column + 1])
            steps = np.arange(1, len(data["bound"][key]) + 1)
            for name, filter in data["filters"].items():
                axes.semilogy(steps, filter["per_step"][key], color=COLOURS[name], label=name,
                              lw=1.6, ls="--" if name == "KF-ortho" else "-")  # fmt: skip
            axes.semilogy(steps, data["bound"][key], "k.", ms=5, label="posterior CRB")
            axes.set_ylabel(label)
            axes.set_xlabel("step")
            axes.set_title(f"turn noise {reading}/s", fontsize=9)
            axes.grid(alpha=0.25, which="both", lw=0.5)
            if row == 0 and column == 0:
                axes.legend(frameon=False, fontsize=8, ncols=2)
    return figure


def _trajectory(axes: Any, example: Example) -> None:
    """The track seen from above, the beliefs of a magnified error around it."""
    truth = example.world.episode.translation[0]
    axes.plot(truth[:, 0], truth[:, 1], color="0.6", lw=1, zorder=1)
    axes.plot(truth[:, 0], truth[:, 1], "k.", ms=3, label="true position", zorder=2)
    for name in ("KF", "iterated EKF"):
        for k, belief in enumerate(example.beliefs[name]):
            error = belief.translation[0, :2] - truth[k, :2]
            ring = ellipse(belief.covariance[0, 3:5, 3:5]) + error
            places = truth[k, :2] + _MAGNIFY * ring
            axes.plot(*places.T, color=COLOURS[name], lw=1.1, label=name if k == 0 else None)
    arrows = example.world.episode.rotation[0][:, :2, 0]
    axes.quiver(*truth[:, :2].T, *arrows.T, angles="xy", scale_units="xy", scale=0.09,
                width=0.003, color="0.3", zorder=3)  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(f"one trial: 95 % beliefs and their errors, magnified {_MAGNIFY} times",
                   fontsize=9)  # fmt: skip
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def ellipse(covariance: FloatArray, points: int = 60) -> FloatArray:
    """Outline (points, 2) of the 95 % region of a zero-mean Gaussian in the plane."""
    angle = np.linspace(0, 2 * np.pi, points)
    values, vectors = np.linalg.eigh(covariance)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return (vectors @ (np.sqrt(5.991 * values)[:, None] * circle)).T


def replay(recording: Recording, track: Track, found: Errors | None) -> Figure:
    """The track from above with the anchors, and, where truth exists, the errors over time."""
    figure = _new(12, 5.2 if found is not None else 6)
    grid = figure.add_gridspec(
        2, 2 if found is not None else 1, width_ratios=[1, 1.2][: 1 + (found is not None)]
    )
    axes = figure.add_subplot(grid[:, 0])
    axes.plot(*recording.anchors[:, :2].T, "k^", ms=7, label="anchors")
    for place, name in zip(recording.anchors, recording.anchor_ids, strict=True):
        axes.annotate(name, place[:2], xytext=(4, 4), textcoords="offset points", fontsize=8)
    if recording.truth is not None and found is not None:
        true = truth_at(recording.truth, track.times)[1][found.known]
        axes.plot(*true[:, :2].T, color="0.55", lw=2.2, label="truth")
    axes.plot(*track.translation[:, :2].T, color=COLOURS["iterated EKF"], lw=0.8, label="estimate")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(frameon=False, fontsize=8)
    if found is None:
        return figure
    curves = (("position error [m]", found.position), ("yaw error [deg]", np.rad2deg(found.yaw)))
    for row, (label, values) in enumerate(curves):
        axes = figure.add_subplot(grid[row, 1])
        axes.plot(track.times[found.known], values[found.known], color=COLOURS["UC-KF"], lw=0.7)
        axes.set_ylabel(label)
        axes.set_xlabel("time [s]")
        axes.grid(alpha=0.25, lw=0.5)
    return figure

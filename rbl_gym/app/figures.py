"""Pictures, drawn by matplotlib without a display."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from rbl_gym.app.consistency import draw_nis
from rbl_gym.app.reports import turn_open
from rbl_gym.checks import FloatArray
from rbl_gym.recordings.recording import Recording
from rbl_gym.rendering.drawing import outline
from rbl_gym.studies.epochs import nees_interval
from rbl_gym.studies.papers.camsap2013 import Example
from rbl_gym.studies.replay import Replayed, truth_path
from rbl_gym.studies.replay.figures import gaps_of

COLOURS = {
    "KF": "#d1495b",
    "KF-ortho": "#e8a33d",
    "ET-KF": "#8d6cab",
    "UC-KF": "#2e86ab",
    "iterated EKF": "#1b7f5c",
}
STATIC_COLOURS = {
    "LS": "#d1495b",
    "LS-projected": "#e8a33d",
    "CLS = CTLS": "#8d6cab",
    "UC-LS": "#2e86ab",
    "two-step": "#6c757d",
    "ML": "#1b7f5c",
    "ML, marginalised": "#7fb800",
}
# Beliefs are centimetres wide on a track of tens of metres.
_MAGNIFY = 20


# Decorator of drawing functions: the user's matplotlib settings do not change outside.
styled = matplotlib.rc_context(
    {
        "font.size": 9, "axes.titlesize": 9, "axes.spines.top": False, "axes.spines.right": False,
        "legend.frameon": False, "legend.fontsize": 8, "grid.alpha": 0.25, "grid.linewidth": 0.5,
    }
)  # fmt: skip


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure."""
    return Figure(figsize=(width, height), layout="constrained")


@styled
def save_figure(figure: Figure, path: str) -> None:
    """Write a figure; create its folder."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


@styled
def camsap2013_figure(result: dict[str, Any], example: Example) -> Figure:
    """Draw Figs 2 and 3 of the tracking paper, NEES, and one trial or the trade-off of ET-KF."""
    figure = new_figure(14, 7.2)
    axes = figure.subplots(2, 3, width_ratios=[1.05, 1, 1])
    _trajectory(axes[0, 0], example)
    if "trade" in result:
        _trade(axes[1, 0], result["trade"])
    else:
        _errors(axes[1, 0], example)
    tracking_curves([axes[0, 1], axes[0, 2], axes[1, 1], axes[1, 2]], result)
    return figure


def tracking_curves(axes: Sequence[Any], result: dict[str, Any], *, of_paper: bool = True) -> None:
    """Draw RMSE of rotation and translation (Fig. 2), MAE (Fig. 3), mean NEES over the steps."""
    panels = (
        ("rotation_rmse", "rotation RMSE (Frobenius)", "rotation, Fig. 2 of CAMSAP 2013: "),
        ("translation_rmse_m", "translation RMSE [m]", "translation, Fig. 2 of CAMSAP 2013: "),
        ("mean_angular_error_deg", "mean angular error [deg]", "angle, Fig. 3 of CAMSAP 2013: "),
        ("nees", "mean NEES", ""),
    )
    steps = np.arange(1, len(result["bound"]["rotation_rmse"]) + 1)
    for ax, (key, label, title) in zip(axes, panels, strict=True):
        for name, filter in result["filters"].items():
            ax.plot(
                steps,
                filter["per_step"][key],
                color=COLOURS[name],
                label=name,
                lw=1.6,
                ls="--" if name == "KF-ortho" else "-",
            )
        if f"estimated_{key}" in result["filters"]["KF"]["per_step"]:
            estimated = result["filters"]["KF"]["per_step"][f"estimated_{key}"]
            ax.plot(steps, estimated, "x", color="0.25", ms=5, label="estimated by KF")
            ax.plot(steps, result["bound"][key], "k.", ms=5, label="posterior CRB")
        if key == "nees":
            low, high = nees_interval(result["trials"])
            ax.axhspan(low, high, color="0.85", zorder=0)
            title = "grey: 95 % of a consistent filter, "
        else:
            ax.set_yscale("log")
            ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
            ax.yaxis.set_major_formatter("{x:g}")
            ax.yaxis.set_minor_formatter(NullFormatter())
        ax.set(xlabel="time step", ylabel=label)
        ax.set_xticks([1, 5, 10, 15, 20])
        prefix = title if of_paper or key == "nees" else "tracking: "
        ax.set_title(f"{prefix}{result['trials']} trials")
        ax.grid(True, which="both")
    axes[0].legend(ncols=2)
    axes[3].legend(ncols=2, loc="upper left")
    family = ", ".join(name for name in result["filters"] if name != "iterated EKF")
    axes[1].text(
        0.98,
        0.72,
        f"{family} coincide",
        transform=axes[1].transAxes,
        ha="right",
        fontsize=8,
        color=COLOURS["UC-KF"],
    )


def _trajectory(axes: Any, example: Example) -> None:
    """Draw the track in plan, with enlarged beliefs around it."""
    episode = example.trials.episode
    truth = episode.translation[0]
    axes.plot(*truth[:, :2].T, color="0.6", lw=1, zorder=1)
    axes.plot(*truth[:, :2].T, "k.", ms=4, label="true position", zorder=4)
    for name, belief in example.beliefs.items():
        for k, error in enumerate(example.errors[name]):
            ring = ellipse(belief.covariance[k, 3:5, 3:5]) + error[3:5]
            places = truth[k, :2] + _MAGNIFY * ring
            axes.plot(*places.T, color=COLOURS[name], lw=1.2, label=name if k == 0 else None)
    heading = episode.rotation[0][:, :2, 0]
    axes.quiver(
        *truth[:, :2].T,
        *heading.T,
        angles="xy",
        scale_units="xy",
        scale=0.5,
        width=0.004,
        color="0.3",
        zorder=3,
    )
    axes.set_aspect("equal", adjustable="box")
    axes.set(
        xlabel="x [m]",
        ylabel="y [m]",
        title=f"one trial: 95 % regions and errors, enlarged x {_MAGNIFY}",
    )
    axes.legend(loc="upper left")


def _trade(axes: Any, trade: list[dict[str, float]]) -> None:
    """Draw ET-KF's error against how often it projects, a point for every threshold."""
    rates = [100 * row["trigger_rate"] for row in trade]
    errors = [row["rotation_rmse"] for row in trade]
    axes.plot(rates, errors, "o-", ms=4, lw=1.2, color=COLOURS["ET-KF"])
    for row, rate, error in zip(trade, rates, errors, strict=True):
        if 0 < rate < 97:
            axes.annotate(
                f"{row['threshold']:g}",
                (rate, error),
                xytext=(3, 4),
                textcoords="offset points",
                fontsize=7,
            )
    axes.set(
        xlabel="updates that project [%]",
        ylabel="rotation RMSE (Frobenius)",
        title="ET-KF: accuracy against projections, labelled by threshold",
    )
    axes.grid(True)


def _errors(axes: Any, example: Example) -> None:
    """Draw the same trial's rotation error about one axis within its 3-sigma band."""
    steps = np.arange(1, len(example.trials.measurements) + 1)
    for name, belief in example.beliefs.items():
        errors = np.rad2deg(example.errors[name][:, 2])
        band = 3 * np.rad2deg(np.sqrt(belief.covariance[:, 2, 2]))
        axes.fill_between(steps, -band, band, color=COLOURS[name], alpha=0.15, lw=0)
        axes.plot(steps, errors, color=COLOURS[name], lw=1.5, label=name)
    axes.axhline(0, color="0.5", lw=0.6)
    axes.set_xlabel("step")
    axes.set_xticks([1, 5, 10, 15, 20])
    axes.set(
        ylabel="rotation error about z [deg]",
        title="the same trial: error and claimed 3-sigma band",
    )
    axes.legend()


@styled
def static_figure(result: dict[str, Any]) -> Figure:
    """Draw Figs 2 and 3 of the static paper over the reference range, a column per setting."""
    settings = result["settings"]
    figure = new_figure(3.4 * len(settings) + 1.2, 6.6)
    axes = figure.subplots(2, len(settings), squeeze=False, sharex=True)
    _static_panels(axes, settings, ("Fig. 2, ICASSP 2013: ", "Fig. 3, ICASSP 2013: "))
    _common_legend(figure, axes)
    return figure


@styled
def slides2013_figure(result: dict[str, Any]) -> Figure:
    """Draw the static part in the first columns, the dynamic part in the last two."""
    settings = result["settings"]
    count = len(settings)
    figure = new_figure(3.8 * (count + 2), 7.2)
    axes = figure.subplots(2, count + 2)
    _static_panels(axes[:, :count], settings)
    _common_legend(figure, axes[:, :count])
    panels = [axes[0, count], axes[0, count + 1], axes[1, count], axes[1, count + 1]]
    tracking_curves(panels, result["dynamic"], of_paper=False)
    return figure


def _static_panels(
    axes: Any, settings: dict[str, Any], prefixes: tuple[str, str] = ("", "")
) -> None:
    rows = (
        ("mean_angular_error_deg", "mean angular error [deg]"),
        ("translation_rmse_m", "translation RMSE [m]"),
    )
    for column, (label, data) in enumerate(settings.items()):
        for row, (key, title) in enumerate(rows):
            ax = axes[row, column]
            for name, method in data["methods"].items():
                ax.semilogy(
                    data["reference_range_db"],
                    method[key],
                    label=name,
                    lw=1.3,
                    color=STATIC_COLOURS[name],
                    ls="--" if name in ("two-step", "LS-projected") else "-",
                )
            ax.semilogy(data["reference_range_db"], data["bound"][key], "k.", label="CRB")
            ax.semilogy(
                data["reference_range_db"],
                data["bound_squared"][key],
                "k+",
                label="CRB, squared ranges",
            )
            ax.grid(True)
            ax.set(
                xlabel="reference range [dB]" if row == 1 else "",
                ylabel=prefixes[row] + title if column == 0 else "",
                title=f"anchors in {label}" if row == 0 else "",
            )


def _common_legend(figure: Figure, axes: Any) -> None:
    handles = {
        text: handle
        for ax in axes.flat
        for handle, text in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5)


def ellipse(covariance: FloatArray) -> FloatArray:
    """Return the outline (K, 2) of the 95 % region of a planar zero-mean Gaussian."""
    return outline(np.eye(2), covariance, 5.991**0.5)


@styled
def replay_figure(recording: Recording, replayed: Replayed) -> Figure:
    """Draw the track in plan with anchors, and over time errors (with truth) and NIS."""
    track, found = replayed.track, replayed.errors
    labels = []
    if found is not None:
        labels = ["position error [m]"] + ["yaw error [deg]"] * (found.yaw is not None)
    rows = len(labels) + (track.innovations is not None)
    figure = new_figure(12, 5.2 if found is None else 6.4)
    grid = figure.add_gridspec(
        max(rows, 1), 2 if rows else 1, width_ratios=[1, 1.2][: 2 if rows else 1]
    )
    axes = figure.add_subplot(grid[:, 0])
    axes.plot(*recording.last_anchors[:, :2].T, "k^", ms=7, label="anchors")
    for place, name in zip(recording.last_anchors, recording.anchor_ids, strict=True):
        axes.annotate(name, place[:2], xytext=(4, 4), textcoords="offset points", fontsize=8)
    if found is not None:
        true = truth_path(recording, track, replayed.settings)
        align = replayed.settings.comparison.align
        label = "truth" if align == "none" else f"truth, aligned ({align})"
        axes.plot(*true[:, :2].T, color="0.55", lw=2.2, label=label)
    gaps = gaps_of(track.times) + 1

    def cut(values: np.ndarray) -> FloatArray:
        """Break a curve of the epochs at gaps without ranges."""
        return np.insert(values.astype(float), gaps, np.nan, axis=0)

    path = cut(track.translation)
    axes.plot(*path[:, :2].T, color=COLOURS["iterated EKF"], lw=0.8, label="estimate")
    if replayed.smoothed is not None:
        smoothed = cut(replayed.smoothed.track.translation)
        axes.plot(*smoothed[:, :2].T, color=COLOURS["KF"], lw=0.8, label="smoothed")
    axes.set_aspect("equal", adjustable="box")  # datalim would cut off the label
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    drawn = ((found, "iterated EKF"), (replayed.smoothed_errors, "KF"))
    for row, label in enumerate(labels):
        axes = figure.add_subplot(grid[row, 1])
        unknown = row > 0 and turn_open(replayed.figures)
        if unknown:
            axes.text(0.5, 0.5, "undetermined", ha="center", va="center", transform=axes.transAxes)
            axes.set(xlim=(0, track.times[-1] - track.times[0]), yticks=[])
        for errors, colour in drawn:
            if errors is not None and not unknown:
                values = errors.position
                if row and errors.yaw is not None:
                    values = np.rad2deg(errors.yaw)
                known, times = cut(errors.known) != 0, cut(track.times - track.times[0])
                axes.plot(times[known], cut(values)[known], color=COLOURS[colour], lw=0.8)
        axes.set(xlabel="time since the start [s]", ylabel=label)
        axes.grid(True)
    if track.innovations is not None:
        draw_nis(figure.add_subplot(grid[-1, 1]), replayed)
    return figure

"""Pictures of rbl-gym calibrate."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rbl_gym.app.figures import ellipse, new_figure, styled
from rbl_gym.studies.calibrate import CalibratedLinks, SurveyedAnchors

_MOST_POINTS = 20_000
# Letters and spaces of the labels that fit below a panel side by side.
_LABEL_LETTERS = 60


@styled
def figure_of(found: CalibratedLinks | SurveyedAnchors) -> Figure:
    """Return the picture of either kind of calibration."""
    return _links_figure(found) if isinstance(found, CalibratedLinks) else _anchors_figure(found)


def _anchors_figure(found: SurveyedAnchors) -> Figure:
    """Draw anchors with enlarged ellipses, and the body's path; residuals by anchor."""
    figure = new_figure(12, 5.6)
    left, right = figure.subplots(1, 2, width_ratios=[1.2, 1])
    state, cov = found.survey.state, found.survey.covariance
    left.plot(*state.translation[:, :2].T, ".", ms=1.5, color="0.6", label="body")
    left.plot(*state.anchors[:, :2].T, "k^", ms=6, label="anchors")
    size = float(np.ptp(state.anchors[:, :2], axis=0).max())
    widest = 2.5 * float(np.sqrt(max(np.diag(cov)[:-1].max(), 1e-12)))
    magnify = 10.0 ** np.floor(np.log10(max(0.15 * size / widest, 1.0)))
    for m, name in enumerate(found.anchor_ids):
        ring = magnify * ellipse(cov[3 * m : 3 * m + 2, 3 * m : 3 * m + 2])
        left.plot(*(ring + state.anchors[m, :2]).T, color="#1b7f5c", lw=1.2)
        left.annotate(name, state.anchors[m, :2], xytext=(5, 5), textcoords="offset points")
    left.set_aspect("equal", adjustable="datalim")
    left.set(xlabel="x [m]", ylabel="y [m]", title=f"95 % ellipses x {magnify:g}")
    left.legend()
    left.grid(True)
    e = found.survey.residuals
    by_anchor = [e[:, m][e[:, m] != 0] for m in range(len(found.anchor_ids))]
    if any(len(values) for values in by_anchor):
        right.boxplot(by_anchor, showfliers=False, whis=(2.5, 97.5))
        ticks = range(1, len(by_anchor) + 1)
        right.set_xticks(ticks, found.anchor_ids, **_turned(found.anchor_ids))
    right.axhline(0, color="0.4", lw=0.6)
    right.set(xlabel="anchor", ylabel="residual [m]: quartiles, 95 %")
    right.grid(True)
    return figure


def _links_figure(found: CalibratedLinks) -> Figure:
    """Draw link biases, residuals over distance, their histogram, and tags in the body frame."""
    ends = []
    if found.directions is not None:
        law = found.directions.law
        ends = [end for end, field in (("tag", law.tags), ("anchor", law.anchors)) if field.any()]
    figure = new_figure(16 if ends else 12, 7.2)
    panels = [_biases, _over_distance, _histogram, _tags]
    panels += [partial(_directions, end=end) for end in ends]
    axes = figure.subplots(2, 3 if ends else 2).ravel()
    for axis, panel in zip(axes, panels, strict=False):
        panel(axis, found)
    for axis in axes[len(panels) :]:
        axis.remove()
    return figure


def _turned(labels: tuple[str, ...]) -> dict[str, Any]:
    """Return how labels below an axis are drawn: turned if together they are too long for it."""
    if sum(len(label) + 2 for label in labels) <= _LABEL_LETTERS:
        return {}
    return {"rotation": 30, "ha": "right", "rotation_mode": "anchor", "fontsize": 7}


def _biases(axes: Any, found: CalibratedLinks) -> None:
    fit = found.fit
    for n, tag in enumerate(found.tag_ids):
        at = np.arange(len(found.anchor_ids)) + 0.12 * (n - 0.5 * (len(found.tag_ids) - 1))
        told = fit.counts[:, n] > 0
        axes.errorbar(
            at[told], fit.bias_m[told, n], 2 * fit.bias_std_m[told, n], fmt="o", ms=4, label=tag
        )
    axes.set_xticks(range(len(found.anchor_ids)), found.anchor_ids, **_turned(found.anchor_ids))
    axes.set(xlabel="anchor", ylabel="bias [m], 2 standard deviations")
    axes.grid(True)
    if len(found.tag_ids) <= 12:
        axes.legend(title="tag", ncols=4)


def _over_distance(axes: Any, found: CalibratedLinks) -> None:
    d, e = found.distances.ravel(), found.fit.residuals.ravel()
    at = np.flatnonzero(np.isfinite(d) & (e != 0))
    at = at[:: max(1, len(at) // _MOST_POINTS)]
    limit = 4 * float(np.median(found.fit.noise_std_m[found.fit.counts > 0]))
    axes.plot(d[at], np.clip(e[at], -limit, limit), ".", ms=1, color="#2e86ab", alpha=0.4)
    axes.axhline(0, color="0.4", lw=0.6)
    axes.set(xlabel="distance [m]", ylabel=f"residual [m], cut at {limit:.2g}")
    axes.grid(True)


def _histogram(axes: Any, found: CalibratedLinks) -> None:
    e = found.fit.residuals[found.fit.residuals != 0]
    std = float(np.median(found.fit.noise_std_m[found.fit.counts > 0]))
    edges = np.linspace(-6, 6, 97) * std
    counts, _ = np.histogram(np.clip(e, edges[0], edges[-1]), edges)
    axes.stairs(np.maximum(counts, 0.5), edges, color="#2e86ab", fill=True, alpha=0.5)
    middle = 0.5 * (edges[1:] + edges[:-1])
    width = edges[1] - edges[0]
    bell = len(e) * width / std / np.sqrt(2 * np.pi) * np.exp(-0.5 * (middle / std) ** 2)
    axes.plot(middle, np.maximum(bell, 0.5), color="#d1495b", label=f"Gaussian, {std:.3f} m")
    axes.set_yscale("log")
    axes.set(xlabel="residual [m], larger ones in the outermost bins", ylabel="ranges")
    axes.legend()


def _directions(axes: Any, found: CalibratedLinks, end: str) -> None:
    """Draw the bias over the bearing of the ray at one end, a line per node."""
    assert found.directions is not None
    law = found.directions.law
    field = law.anchors if end == "anchor" else law.tags
    names = found.anchor_ids if end == "anchor" else found.tag_ids
    frame = "anchors' frame" if end == "anchor" else "body"
    bearing = np.linspace(-180, 180, 181)
    angle = np.radians(bearing)[:, None] * (1 + np.arange(field.shape[1] // 2))
    for name, row in zip(names, field, strict=True):
        curve = np.cos(angle) @ row[::2] + np.sin(angle) @ row[1::2]
        axes.plot(bearing, curve, lw=1.4, label=name)
    axes.set_xlim(-180, 180)
    axes.set_xticks(range(-180, 181, 60))
    axes.set(
        xlabel=f"bearing of the ray at the {end} [deg], in the {frame}",
        ylabel="bias by direction [m]",
    )
    axes.grid(True)
    if len(names) <= 12:
        axes.legend(title=end, ncols=4)


def _tags(axes: Any, found: CalibratedLinks) -> None:
    tags, std = found.fit.tags, found.fit.tags_std_m
    axes.errorbar(*tags[:, :2].T, xerr=2 * std[:, 0], yerr=2 * std[:, 1], fmt="o", ms=4)
    for place, name in zip(tags, found.tag_ids, strict=True):
        axes.annotate(name, place[:2], xytext=(5, 5), textcoords="offset points", fontsize=8)
    axes.plot(0, 0, "k+", ms=9)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(
        xlabel="x in the truth's body frame [m]",
        ylabel="y [m]",
        title="tags, 2 standard deviations; +: origin",
    )
    axes.grid(True)

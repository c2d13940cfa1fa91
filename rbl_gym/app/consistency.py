"""Consistency of a log, NIS and residuals: on the terminal, in pictures and in pages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rbl_gym.app.tables import new_table
from rbl_gym.checks import FloatArray
from rbl_gym.studies.replay import Replayed, nis_curve
from rbl_gym.studies.replay.figures import gaps_of
from rbl_gym.studies.replay.tuning import MOST_EPOCHS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Largest number of rows of a terminal table: those with the largest residuals.
_ROWS = 12
_HONEST, _BAND = "#1c7ed6", "#868e96"
_HEADINGS = ("ranges", "mean (m)", "spread (m)", "rejected (%)")


def print_consistency(console: Any, result: dict[str, Any]) -> None:
    """Print NIS and a table of the residuals of anchors and tags, if they were computed."""
    if "tuned" in result:
        console.print(tuned_text(result["tuned"]))
    found = result.get("consistency")
    if found is None:
        return
    console.print(
        f"NIS per degree of freedom {found['nis_per_dof']:.2f} (1: consistent), log-likelihood "
        f"{found['log_likelihood']:.2f} per range, {100 * found['rejected_share']:.1f} % rejected"
    )
    table = new_table("residuals after the update", [""], _HEADINGS)
    for kind in ("anchor", "tag"):
        rows = found["residuals"][f"{kind}s"]
        if len(rows) > _ROWS:
            rows = sorted(rows, key=_size, reverse=True)[:_ROWS]
        for row in rows:
            table.add_row(f"{kind} {row[kind]}", *_cells(row))
    console.print(table)


def tuned_text(found: dict[str, Any]) -> str:
    """Return the tuned values as command line options."""
    most = " (the most that are used)" if found["epochs"] == MOST_EPOCHS else ""
    return (
        f"tuned on {found['epochs']} epochs{most} of the first {found['seconds']:.1f} s: "
        f"{found['options']} (log-likelihood per range {found['log_likelihood']:.3f}, "
        f"{found['log_likelihood_before']:.3f} before tuning)"
    )


def _size(row: dict[str, Any]) -> float:
    return row["rejected_share"] + abs(row["mean_m"] or 0.0) + row["spread_m"]


def _cells(row: dict[str, Any]) -> list[str]:
    mean = "-" if row["mean_m"] is None else f"{row['mean_m']:+.3f}"
    return [
        str(row["ranges"]),
        mean,
        f"{row['spread_m']:.3f}",
        f"{100 * row['rejected_share']:.1f}",
    ]


def draw_nis(axes: Axes, replayed: Replayed) -> None:
    """Draw NIS per degree of freedom over time, with the band of a consistent filter."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    found = replayed.track.innovations
    assert found is not None
    times = replayed.track.times
    when, ratio, low, high = _broken(nis_curve(times - times[0], found))
    axes.fill_between(when, low, high, color="0.85", lw=0, label="95 % of a consistent filter")
    ratio = np.clip(ratio, 1e-3, 1e6)
    axes.plot(when, ratio, color=_HONEST, lw=0.8)
    axes.axhline(1.0, color="0.5", lw=0.6)
    axes.set_yscale("log")
    axes.set_ylim(min(0.2, float(np.nanmin(ratio))), max(5.0, 1.1 * float(np.nanmax(ratio))))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set(xlabel="time since the start [s]", ylabel="NIS / dof")
    # Above the panel, where no curve is.
    axes.legend(fontsize=7, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.2)
    axes.grid(True)


def _broken(curve: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the arrays of a curve, times first, with NaN in each gap without ranges."""
    gaps = gaps_of(curve[0]) + 1
    return [np.insert(values, gaps, np.nan) for values in curve]


def consistency_parts(replayed: Replayed) -> list[str]:
    """Return page parts: NIS over time, heat maps of the links, tables; empty without data."""
    from rbl_gym.app import page

    found = replayed.figures.get("consistency")
    if found is None:
        return []
    causes = [
        [cause["text"], cause["nis_per_dof"], 100 * cause["mended"]] for cause in found["causes"]
    ]
    headings = ["likely cause", "NIS per dof without it", "share of the excess NIS explained (%)"]
    residuals = found["residuals"]
    tuned = replayed.figures.get("tuned")
    parts = [
        "<h2>Does the filter fit its data?</h2>",
        page.note(
            "Normalised innovation squared (NIS) per degree of freedom "
            f"{found['nis_per_dof']:.2f} (1: consistent; far above: the filter assumes too little "
            f"noise or motion, or wrong positions), log-likelihood {found['log_likelihood']:.2f} "
            f"per range, {100 * found['rejected_share']:.1f} % of the ranges rejected. Residuals "
            "are those after the update: mean of the ranges used, spread of all (1.48 times the "
            "median distance from the median)."
        ),
        page.plot(_charts(replayed), "consistency", first=False),
    ]
    if tuned is not None:
        parts.append(page.note(f"{tuned_text(tuned)}.".capitalize()))
    if causes:
        parts.append(page.table("likely causes", headings, causes))
    for kind, names in (("anchors", ["anchor"]), ("tags", ["tag"]), ("links", ["anchor", "tag"])):
        rows = [
            [
                *(row[name] for name in names),
                row["ranges"],
                row["mean_m"],
                row["spread_m"],
                100 * row["rejected_share"],
            ]
            for row in residuals[kind]
        ]
        parts.append(page.table(f"residuals of {kind}", [*names, *_HEADINGS], rows))
    return parts


def _charts(replayed: Replayed) -> Any:
    """Return charts of NIS over time, mean residual and rejected fraction of every link."""
    from plotly.subplots import make_subplots

    track, found = replayed.track, replayed.track.innovations
    assert found is not None
    when, ratio, low, high = _broken(nis_curve(track.times - track.times[0], found))
    shown = make_subplots(
        1,
        3,
        column_widths=[0.46, 0.27, 0.27],
        horizontal_spacing=0.13,
        subplot_titles=["NIS per degree of freedom", "mean residual (m)", "rejected (%)"],
    )
    # The area between two curves ignores breaks: one closed area for each part.
    for part in np.split(np.arange(len(when)), np.flatnonzero(np.isnan(when))):
        part = part[np.isfinite(when[part])]
        around = np.concatenate([part, part[::-1]])
        edge = np.concatenate([high[part], low[part[::-1]]])
        style: dict[str, Any] = {"mode": "lines", "line": {"color": _BAND, "width": 0}}
        shown.add_scatter(
            x=when[around], y=edge, fill="toself", hoverinfo="skip", row=1, col=1, **style
        )
    line = {"color": _HONEST, "width": 1.2}
    shown.add_scatter(x=when, y=np.maximum(ratio, 1e-3), mode="lines", line=line, row=1, col=1)
    shown.update_yaxes(type="log", dtick=1, row=1, col=1)
    shown.update_xaxes(title_text="time since the start (s)", title_standoff=4, row=1, col=1)
    rows = replayed.figures["consistency"]["residuals"]["links"]
    anchors, tags = (list(dict.fromkeys(row[kind] for row in rows)) for kind in ("anchor", "tag"))
    mean, refused = np.full((2, len(anchors), len(tags)), np.nan)
    for row in rows:
        at = anchors.index(row["anchor"]), tags.index(row["tag"])
        mean[at] = np.nan if row["mean_m"] is None else row["mean_m"]
        refused[at] = 100 * row["rejected_share"]
    largest = max(float(np.nanmax(np.abs(mean), initial=0.0)), 0.01)
    layout: Any = shown.layout
    for column, values, scale, ends, axis in (
        (2, mean, "RdBu", (-largest, largest), "xaxis2"),
        (3, refused, "Reds", (0.0, max(float(np.nanmax(refused, initial=0.0)), 1.0)),
         "xaxis3"),
    ):  # fmt: skip
        shown.add_heatmap(
            z=values,
            x=[f"tag {tag}" for tag in tags],
            y=[f"anchor {anchor}" for anchor in anchors],
            colorscale=scale,
            reversescale=scale == "RdBu",
            zmin=ends[0],
            zmax=ends[1],
            colorbar={"x": layout[axis].domain[1], "thickness": 10, "len": 0.9},
            hovertemplate="%{y}, %{x}: %{z:.3f}<extra></extra>",
            row=1,
            col=column,
        )
        shown.update_yaxes(autorange="reversed", row=1, col=column)
    shown.update_annotations(font_size=13)
    shown.update_layout(
        height=max(340, 24 * len(anchors) + 110),
        template="plotly_white",
        showlegend=False,
        margin={"l": 50, "r": 10, "t": 40, "b": 40},
    )
    return shown

"""Pictures of a placement: plan and side view with maps of accuracy, layouts side by side."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.regions import Shell
from rbl_gym.studies.placing.accuracy import Map, accuracy_map
from rbl_gym.studies.placing.answer import Placed

ANCHOR, REGION, OBSTACLE, DESIGNED, USUAL = "#d1495b", "#222222", "#6c757d", "#1b7f5c", "#9db4c0"
# Anchors further out than so many half sizes of the region leave its map too small to read.
_FAR = 4.0
# A map that hardly varies must not look as if it did: its colours span at least this ratio.
_LEAST_CONTRAST = 1.15
_NAMES = "xyz"
Plane = tuple[int, int]
_PLAN: Plane = (0, 1)
_SIDE: Plane = (0, 2)


@matplotlib.rc_context({"font.size": 9, "axes.titlesize": 10})
def place_figure(placed: Placed) -> Figure:
    """Maps of position and orientation, a side view, the usual layouts or the number's curve."""
    problem, anchors = placed.problem, placed.design.anchors
    low, high = problem.corners()
    plan = accuracy_map(problem, anchors)
    side = accuracy_map(problem, anchors, up=2) if high[2] > low[2] else None
    far = _is_far(placed)
    width, height = np.ptp(_limits(placed, _PLAN, far), axis=0)
    tall = float(np.clip(6.0 * height / width, 2.6, 6.0))
    shown = Figure(figsize=(14, tall + 4.6), layout="constrained")
    grid = shown.add_gridspec(2, 2, height_ratios=[tall, 3.4])
    for column, (values, label) in enumerate(
        ((plan.position, "position, 1 sigma [m]"), (plan.rotation, "orientation, 1 sigma [deg]"))
    ):
        axes = shown.add_subplot(grid[0, column])
        _draw_map(axes, plan, values, label)
        _draw_world(axes, placed, _PLAN, far, heights=column == 0)
        axes.set_aspect("equal", adjustable="box")
        axes.set_title(f"{label.split(',')[0]} accuracy at z = {plan.at:.3g} m")
    axes = shown.add_subplot(grid[1, 0])
    _draw_world(axes, placed, _SIDE, far=False, heights=False)
    if side is None or far:
        axes.set_aspect("equal", adjustable="box")
        axes.set_title("from the side")
    else:
        _draw_map(axes, side, side.position, "position, 1 sigma [m]")
        axes.set_title(f"position accuracy from the side, at y = {side.at:.3g} m (z stretched)")
    axes = shown.add_subplot(grid[1, 1])
    if "against_number" in placed.result:
        _draw_numbers(axes, placed.result["against_number"])
    else:
        _draw_layouts(axes, placed.result["layouts"])
    shown.suptitle(_headline(placed.result), fontsize=12)
    shown.supxlabel(
        "triangles: anchors     dashed: work region     grey line: edge of where anchors may "
        "stand     grey: obstacles (dotted: off the map's plane)",
        fontsize=8,
        color="0.35",
    )
    return shown


def _headline(result: dict[str, Any]) -> str:
    predicted = result["predicted"]
    position, rotation = predicted["position_m"], predicted["rotation_deg"]
    return (
        f"{result['scene']}, {result['n_anchors']} anchors:  position {position['median']:.3g} m "
        f"(p95 {position['p95']:.3g}),  orientation {rotation['median']:.2g} deg "
        f"(p95 {rotation['p95']:.2g}),  from one epoch of ranges"
    )


def _is_far(placed: Placed) -> bool:
    low, high = placed.problem.corners()
    reach = np.abs(placed.design.anchors - 0.5 * (low + high))[:, :2].max()
    return bool(reach > _FAR * 0.5 * (high - low)[:2].max())


def _limits(placed: Placed, axes: Plane, far: bool) -> FloatArray:
    """Lower and upper corner (2, 2) of what is shown: the region alone, or all that there is."""
    low, high = placed.problem.corners()
    corners = [low, high]
    if not far:
        corners += [*placed.design.anchors]
        region = placed.problem.mounts
        if not isinstance(region, Shell):
            corners += [*region.bounds()]
        corners += [
            box[:3] + sign * box[3:] for box in placed.problem.obstacles.boxes for sign in (-1, 1)
        ]
    points = np.array(corners)[:, list(axes)]
    extent = np.ptp(points, axis=0)
    margin = (0.22 if far else 0.06) * np.maximum(extent, 0.1 * extent.max())
    return np.array([points.min(axis=0) - margin, points.max(axis=0) + margin])


def _draw_map(axes: Any, plane: Map, values: FloatArray, label: str) -> None:
    low, top = float(np.nanmin(values)), float(np.nanquantile(values, 0.99))
    mesh = axes.pcolormesh(
        plane.columns,
        plane.rows,
        values,
        cmap="viridis_r",
        shading="nearest",
        zorder=0,
        vmin=low,
        vmax=max(top, _LEAST_CONTRAST * low),
    )
    # Inside the axes' own box: as high as the map, whatever its aspect.
    bar = axes.figure.colorbar(
        mesh,
        cax=axes.inset_axes((1.02, 0.0, 0.025, 1.0)),
        label=label,
        extend="max" if np.nanmax(values) > 1.001 * mesh.norm.vmax else "neither",
    )
    bar.outline.set_visible(False)


def _draw_world(axes: Any, placed: Placed, plane: Plane, far: bool, heights: bool) -> None:
    """Legal space, region, obstacles and anchors in two of the three axes."""
    problem = placed.problem
    low, high = problem.corners()
    pair = list(plane)
    third = 3 - sum(pair)
    region = problem.mounts
    limits = _limits(placed, plane, far)
    if not far and not isinstance(region, Shell):
        _draw_box(axes, *(corner[pair] for corner in region.bounds()), fill=False, ec="0.45", lw=2)
    at = 0.5 * (low + high)[third]
    for box in problem.obstacles.boxes:
        # Cut by the map's plane, or only an outline before or behind it.
        cut = abs(box[third] - at) <= box[3 + third]
        style = {"fc": OBSTACLE, "alpha": 0.9} if cut else {"fill": False, "ls": ":"}
        _draw_box(
            axes, (box[:3] - box[3:])[pair], (box[:3] + box[3:])[pair], ec="0.25", lw=0.9, **style
        )
    _draw_box(axes, low[pair], high[pair], fill=False, ec=REGION, lw=1.2, ls=(0, (4, 2)))
    centre = 0.5 * (low + high)
    shown: list[tuple[FloatArray, list[str]]] = []
    for index, anchor in enumerate(placed.design.anchors):
        place, outside = _shown_place(anchor[pair], limits, centre[pair])
        text = f"{index + 1}"
        if outside:
            text += f" ({np.linalg.norm(anchor - centre):.3g} m away)"
        elif heights:
            text += f"  z {anchor[2]:.3g}"
        axes.plot(
            *place, marker="^", ms=10, color=ANCHOR, mec="white", mew=1.0, zorder=5, clip_on=False
        )
        close = (
            np.abs((place - other) / np.ptp(limits, axis=0)).max() < 0.05 for other, _ in shown
        )
        group = next((k for k, is_close in enumerate(close) if is_close), None)
        if group is None:
            shown.append((place, [text]))
        else:
            shown[group][1].append(text)
    for place, texts in shown:
        inward = place[0] > limits[0, 0] + 0.7 * np.ptp(limits[:, 0])
        axes.annotate(
            ", ".join(texts),
            place,
            xytext=(-9 if inward else 9, 3),
            textcoords="offset points",
            fontsize=8,
            ha="right" if inward else "left",
            zorder=6,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
        )
    axes.set_xlim(*limits[:, 0])
    axes.set_ylim(*limits[:, 1])
    axes.set_xlabel(f"{_NAMES[plane[0]]} [m]")
    axes.set_ylabel(f"{_NAMES[plane[1]]} [m]")
    axes.spines[["top", "right", "left", "bottom"]].set_visible(False)


def _shown_place(
    place: FloatArray, limits: FloatArray, centre: FloatArray
) -> tuple[FloatArray, bool]:
    """Where an anchor is drawn: itself, or on the way to it at the edge of what is shown."""
    if (place >= limits[0]).all() and (place <= limits[1]).all():
        return place, False
    away = place - centre
    edge = 0.93 * np.where(away > 0, limits[1] - centre, centre - limits[0])
    share = (edge / np.maximum(np.abs(away), 1e-12)).min()
    return centre + share * away, True


def _draw_box(axes: Any, low: FloatArray, high: FloatArray, **style: Any) -> None:
    axes.add_patch(Rectangle(tuple(low), *(high - low), zorder=3, **style))


def _draw_layouts(axes: Any, rows: dict[str, dict[str, Any]]) -> None:
    """Typical and worst position error of every layout, the best on top."""
    names = list(rows)[::-1]
    places = np.arange(len(names))
    for key, alpha, label in (
        ("worst", 0.35, "worst"),
        ("p95", 0.65, "p95"),
        ("median", 1.0, "median"),
    ):
        values = [rows[name][f"position_{key}_m"] for name in names]
        colours = [DESIGNED if name == "designed" else USUAL for name in names]
        axes.barh(places, values, color=colours, alpha=alpha, height=0.72, label=label)
    # A layout that is bad somewhere must not hide how the good ones differ.
    limit = 3.2 * rows["designed"]["position_worst_m"]
    worst = max(row["position_worst_m"] for row in rows.values())
    axes.set_xlim(0, min(limit, 1.05 * worst))
    for place, name in zip(places, names, strict=True):
        row = rows[name]
        axes.text(
            0.985,
            place,
            f"b {row['score_m']:.3g} m  x{row['ratio']:.2f}",
            va="center",
            ha="right",
            fontsize=8,
            transform=axes.get_yaxis_transform(),
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85},
        )
    axes.set_yticks(places, names)
    axes.set_xlabel("position, 1 sigma [m]: median, p95, worst place from dark to light")
    axes.set_title("the usual layouts (b: root mean square tag error)")
    axes.spines[["top", "right"]].set_visible(False)


def _draw_numbers(axes: Any, rows: list[dict[str, float]]) -> None:
    """Accuracy against the number of anchors."""
    numbers = [int(row["n_anchors"]) for row in rows]
    other = axes.twinx()
    for ax, key, unit, colour in (
        (axes, "position", "m", DESIGNED),
        (other, "rotation", "deg", ANCHOR),
    ):
        for what, style in (("median", "o-"), ("p95", "s--"), ("worst", "^:")):
            values = [row[f"{key}_{what}_{unit}"] for row in rows]
            ax.plot(
                numbers,
                values,
                style,
                color=colour,
                ms=4.5,
                lw=1.4,
                label=what if ax is axes else None,
            )
        name = "orientation" if key == "rotation" else key
        ax.set_ylabel(f"{name}, 1 sigma [{unit}]", color=colour)
        ax.set_ylim(bottom=0)
        ax.spines[["top"]].set_visible(False)
    axes.set_xticks(numbers)
    axes.set_xlabel("anchors")
    axes.grid(alpha=0.25, lw=0.5)
    axes.legend(frameon=False, fontsize=8)
    axes.set_title("accuracy against the number of anchors")

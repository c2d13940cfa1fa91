"""Plan of a building by matplotlib: walls, zones, mounts, anchors, accuracy maps."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Patch, PathPatch, Polygon
from matplotlib.path import Path as Outline

from rbl_gym.app import place_shapes as shapes
from rbl_gym.checks import FloatArray
from rbl_gym.geometry.polygons import area
from rbl_gym.placement.scene_files import Problem
from rbl_gym.studies.placing.tape import slabs_of

MOUNT, ANCHOR, KEPT, ZONE, SLAB = "#7b3294", "#111111", "#6b6b6b", "#222222", "#8a4b08"
COLOURS = "viridis_r"
# Labels of more anchors than this are without heights, so that they fit; the list has the heights.
_MOST_HEIGHTS = 16
_WHITE = {"boxstyle": "round,pad=0.18", "fc": "white", "ec": "0.75", "lw": 0.5, "alpha": 0.92}


def draw_building(axes: Any, problem: Problem, anchors: FloatArray, names: bool = True) -> None:
    """Draw backdrop, obstacles, zones, and mounts; axes in metres."""
    edges = shapes.limits(problem, anchors)
    axes.set_xlim(*edges[:, 0])
    axes.set_ylim(*edges[:, 1])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.spines[["top", "right", "left", "bottom"]].set_visible(False)
    axes.tick_params(length=2, labelsize=7)
    _draw_backdrop(axes, problem)
    found = shapes.solids_in_plan(problem)
    over = [shapes.is_overhead(problem, solid) for solid in found]
    axes.add_collection(
        PolyCollection(
            [solid.corners for solid in found],
            facecolors=[
                "none" if above else shapes.grey(solid.share)
                for solid, above in zip(found, over, strict=True)
            ],
            edgecolors="0.2",
            linewidths=0.5,
            linestyles=[":" if above else "-" for above in over],
            zorder=3,
        ),
        autolim=False,
    )
    _draw_slabs(axes, problem, names)
    if not shapes.is_far(problem, anchors):
        lines, areas = shapes.mount_shapes(problem)
        axes.add_collection(
            PolyCollection(areas, facecolors="#ede3f1", edgecolors="#ede3f1", lw=0.4, zorder=-2),
            autolim=False,
        )
        axes.add_collection(
            LineCollection(lines, colors=MOUNT, lw=1.1, alpha=0.8, zorder=3.5), autolim=False
        )
        dots = np.array([line[0] for line in lines if (line[0] == line[1]).all()]).reshape(-1, 2)
        axes.plot(*dots.T, "o", ms=3, mfc="none", color=MOUNT, zorder=3.5)
    for zone in problem.zones:
        sides = LineCollection(
            shapes.sides_of(zone.polygon), colors=ZONE, lw=1.1, ls=(0, (4, 2)), zorder=4
        )
        axes.add_collection(sides, autolim=False)
    if names and len(problem.zones) > 1:
        for text, at in shapes.zone_labels(problem, anchors):
            axes.text(*at, text, fontsize=8, ha="center", va="center", zorder=6, bbox=_WHITE)


def _draw_slabs(axes: Any, problem: Problem, names: bool) -> None:
    """Draw the outlines of slabs, with their names and heights at the upper left corner."""
    taken: list[FloatArray] = []
    for ring, low, high, name in slabs_of(problem):
        axes.add_patch(Polygon(ring, fill=False, ec=SLAB, lw=1.2, ls=":", zorder=3.2))
        if not names:
            continue
        corner = ring[(ring[:, 1] - ring[:, 0]).argmax()]
        below = sum(bool(np.abs(corner - other).max() < 1.0) for other in taken)
        taken.append(corner)
        axes.annotate(
            f"{name}, z {low:g} to {high:g} m",
            corner,
            xytext=(5, -5 - 9 * below),
            textcoords="offset points",
            fontsize=6.5,
            color=SLAB,
            ha="left",
            va="top",
            zorder=6,
            bbox=_WHITE | {"boxstyle": "square,pad=0.05", "ec": "none"},
        )


def _draw_backdrop(axes: Any, problem: Problem) -> None:
    plan = problem.plan
    if plan is None or plan.image is None:
        return
    from matplotlib.image import imread

    image = imread(plan.image)
    height, width = image.shape[:2]
    x, y = plan.origin
    right, top = x + width * plan.metres_per_pixel, y + height * plan.metres_per_pixel
    axes.imshow(
        image,
        extent=(x, right, y, top),
        cmap="gray" if image.ndim == 2 else None,
        alpha=0.55,
        zorder=-3,
        aspect="equal",
    )


def draw_anchors(
    axes: Any, problem: Problem, anchors: FloatArray, names: list[str], heights: bool = False
) -> list[Any]:
    """Draw markers of the anchors; return labels for `settle_labels`."""
    edges = shapes.limits(problem, anchors)
    low, high = problem.corners()
    texts = []
    for text, anchor in zip(names, anchors, strict=True):
        place, outside = shapes.shown_place(anchor[:2], edges)
        marker, colour = ("s", KEPT) if shapes.is_kept(problem, anchor) else ("^", ANCHOR)
        axes.plot(*place, marker, ms=8, color=colour, mec="white", mew=0.9, zorder=7, clip_on=False)
        if outside:
            text += f"  {np.linalg.norm(anchor - 0.5 * (low + high)):.3g} m away"
        elif heights and len(anchors) <= _MOST_HEIGHTS:
            text += f"  z {anchor[2]:.3g}"
        note = axes.annotate(
            text,
            place,
            xytext=place,
            fontsize=7.5,
            fontweight="bold",
            ha="center",
            va="center",
            zorder=8,
            bbox=_WHITE,
            annotation_clip=False,
        )
        texts.append(note)
    return texts


def settle_labels(figure: Any, groups: list[tuple[Any, list[Any]]]) -> None:
    """Move the labels of each axes next to their markers without overlaps, after layout."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    # The layout is fixed from here on.
    figure.set_layout_engine("none")
    unit = figure.dpi / 72
    for axes, texts in groups:
        if not texts:
            continue
        to_pixels = axes.transData
        points = np.array([to_pixels.transform(text.xy) for text in texts])
        sizes = []
        for text in texts:
            box = text.get_window_extent(renderer)
            sizes.append([box.width + 3 * unit, box.height + 3 * unit])
        names = [text for text in axes.texts if text not in texts]
        taken = [np.array(text.get_window_extent(renderer).get_points()) for text in names]
        boxes = [(box.mean(axis=0), 0.5 * np.ptp(box, axis=0) + 2 * unit) for box in taken]
        edges = np.array(axes.get_window_extent(renderer).get_points())
        edges += np.array([[-14.0], [14.0]]) * unit
        found = shapes.spread_labels(points, np.array(sizes), edges, 4.0 * unit, boxes)
        for text, place, point, size in zip(texts, found, points, np.array(sizes), strict=True):
            text.set_position(to_pixels.inverted().transform(place))
            if shapes.needs_leader(place, size, point, points, 10 * unit):
                axes.plot(
                    *to_pixels.inverted().transform([place, point]).T,
                    color="0.25",
                    lw=0.6,
                    zorder=6.5,
                    clip_on=False,
                )


# --- maps ------------------------------------------------------------------------------------


def draw_map(axes: Any, shown: list[shapes.Layer], quantity: shapes.Quantity) -> None:
    """Draw accuracy over the zones with a colour bar; hatched where a limit is exceeded."""
    limits = [quantity.limit_of(layer.zone) for layer in shown]
    given = [limit for limit in limits if limit is not None]
    low, high = shapes.colour_range(shown, max(given, default=None))
    image, beyond = None, False
    for layer, limit in zip(shown, limits, strict=True):
        image = axes.imshow(
            layer.values,
            extent=(layer.left, layer.right, layer.bottom, layer.top),
            origin="lower",
            cmap=COLOURS,
            vmin=low,
            vmax=high,
            interpolation="bilinear",
            zorder=1,
            aspect="equal",
        )
        _clip(axes, image, layer)
        if limit is not None:
            beyond |= _hatch(axes, layer, limit)
    largest = max(float(layer.values[layer.free].max(initial=0.0)) for layer in shown)
    bar = axes.figure.colorbar(
        image,
        cax=axes.inset_axes((1.02, 0.0, 0.025, 1.0)),
        extend="max" if largest > 1.001 * high else "neither",
    )
    bar.set_label(f"{quantity.name}, one sigma [{quantity.unit}]", fontsize=8)
    bar.ax.tick_params(labelsize=7, length=2)
    bar.outline.set_visible(False)
    for limit in sorted({limit for limit in given if low <= limit <= high}):
        bar.ax.axhline(limit, color="white", lw=2.2)
        bar.ax.axhline(limit, color="black", lw=1.0)


def draw_verdict(axes: Any, shown: list[shapes.Layer]) -> None:
    """Draw where the zones' requirements are met and where not: colours and hatches."""
    for layer in shown:
        colour = shapes.WITHIN if layer.free.any() else shapes.NOTHING
        axes.add_patch(Polygon(layer.zone.polygon, fc=colour, ec="none", zorder=1))
        if layer.free.any():
            _hatch(axes, layer, 1.0, shapes.BEYOND)


def verdict_handles(shown: list[shapes.Layer]) -> list[Patch]:
    """Return the legend of `draw_verdict`."""
    handles = [
        Patch(fc=shapes.WITHIN, ec="0.4", label="within the requirement"),
        Patch(fc=shapes.BEYOND, ec="white", hatch="////", label="not within"),
    ]
    if not all(layer.free.any() for layer in shown):
        handles.append(Patch(fc=shapes.NOTHING, ec="0.4", label="no requirement"))
    return handles


def _clip(axes: Any, artist: Any, layer: shapes.Layer) -> None:
    polygon = layer.zone.polygon
    if abs(area(polygon)) > 0:
        closed = np.concatenate([polygon, polygon[:1]])
        artist.set_clip_path(PathPatch(Outline(closed, closed=True), transform=axes.transData))


def _hatch(axes: Any, layer: shapes.Layer, limit: float, colour: str = "none") -> bool:
    """Hatch what exceeds a limit; return whether anything does."""
    values = np.pad(layer.values, 1, mode="edge")
    if values.max() <= limit or min(layer.values.shape) < 2:
        return False
    columns, rows = (
        np.concatenate([[a], a + (np.arange(n) + 0.5) * (b - a) / n, [b]])
        for a, b, n in (
            (layer.left, layer.right, layer.values.shape[1]),
            (layer.bottom, layer.top, layer.values.shape[0]),
        )
    )
    with matplotlib.rc_context({"hatch.color": "white", "hatch.linewidth": 0.8}):
        found = axes.contourf(
            columns,
            rows,
            values,
            levels=[limit, max(float(values.max()), limit) * 1.01],
            colors=[colour],
            hatches=["////"],
            zorder=1.5,
        )
    _clip(axes, found, layer)
    edge = axes.contour(
        columns, rows, values, levels=[limit], colors="black", linewidths=0.9, zorder=1.6
    )
    _clip(axes, edge, layer)
    return True

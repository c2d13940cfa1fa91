"""Frames of a placement: region, racks and anchors in 3-D and in plan, the score so far."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds, placement
from rbl_gym.checks import FloatArray
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.geometry.polygons import rectangle
from rbl_gym.placement.problem import Context, PlacementTask
from rbl_gym.rendering import panels
from rbl_gym.rendering.body import limits_of
from rbl_gym.rendering.drawing import (
    ANCHOR,
    INK,
    OBSTACLES,
    Image,
    Panel,
    box_edges,
    box_faces,
    gapped,
    plan_axes,
    prism_faces,
    space,
    view_of,
    write,
)
from rbl_gym.rendering.film import Film, check_mode

# Colours of the expected error, from metres to centimetres, two per decade.
_STEPS_M = np.array([0.03, 0.1, 0.3, 1.0, 3.0])
_COLOURS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#d7c51a", "#f2a05c")
_NAMES = ("to 3 cm", "10 cm", "30 cm", "1 m", "3 m", "more")


class Layout(NamedTuple):
    """B problems, their anchors (B, M, 3), and the numbers of anchors placed so far."""

    context: Context
    anchors: FloatArray
    placed: np.ndarray


def film_of(
    render_mode: str | None, task_of: Callable[[int], PlacementTask], steps: int
) -> Film | None:
    """Return a film of the tasks of worlds, whose anchors and boxes are padded; or None."""
    if check_mode(render_mode) is None:
        return None
    return Film(functools.partial(_frame, task_of), steps)


def _frame(
    task_of: Callable[[int], PlacementTask],
    world: int,
    epochs: np.ndarray,
    shots: Sequence[Layout],
    beliefs: Any,
) -> Image:
    last, task = shots[-1], task_of(world)
    centre, half, boxes = (field[world] for field in last.context)
    context = Context(centre, half, boxes[boxes[:, 3] > 0])
    anchors = last.anchors[world, : int(last.placed[world])]
    errors = _errors(task, context, anchors)
    # One-shot tasks place all anchors at once: the curve adds them in their order.
    counts = np.arange(1, len(anchors) + 1)
    scores = np.array([placement.score(task, context, anchors[:k]) for k in counts])
    headline = f"{len(anchors)} of {task.n_anchors} anchors"
    if len(anchors):
        headline += f"      expected tag error {scores[-1]:.3g} m"
    picture, left, upper, lower = panels.empty()
    places = placement.positions(task, context)
    _world(task).paint(context, anchors, places, errors, headline, left)
    _plan(task).paint(context, anchors, places, errors, upper)
    nothing = np.full(len(counts), np.nan)
    strips = panels.strips(
        task.n_anchors,
        (limits_of(nothing, scores),),
        ("tag error [m]",),
        ("expected tag error, RMS over the region", ""),
        "anchors placed",
    )
    strips.paint(counts, scores[None], nothing[None], lower)
    return picture


def _errors(task: PlacementTask, context: Context, anchors: FloatArray) -> FloatArray:
    """Return expected tag errors b (P,) at the task's poses."""
    information = task.prior_information
    if len(anchors):
        information = information + placement.information(task, context, anchors)
    covariance = np.linalg.inv(np.broadcast_to(information, (task.n_poses, 6, 6)))
    return bounds.score(covariance, task.poses[0], np.asarray(task.scene.tags))


def _boxes(task: PlacementTask) -> int:
    """Return the number of boxes that block sight in every problem."""
    return len(task.scene.obstacles) + task.racks


class _Points:
    """Positions coloured by their error: a line of markers for every colour."""

    def __init__(self, panel: Panel, axes: Any = None) -> None:
        self.lines = [
            panel.line(axes, color=colour, marker="o", ms=4.5, ls="", mec="white", mew=0.4)
            for colour in _COLOURS
        ]

    def set(self, places: FloatArray, errors: FloatArray) -> None:
        """Set positions (P, 2) and errors (P,)."""
        which = np.searchsorted(_STEPS_M, errors)
        for index, line in enumerate(self.lines):
            line.set_data(*places[which == index].T)


class _World:
    """The problem and its anchors in 3-D."""

    def __init__(self, task: PlacementTask) -> None:
        from matplotlib.lines import Line2D

        low, high = _corners(task)
        self.panel = panel = Panel(panels.LEFT, panels.HEIGHT)
        axes = space(panel, (0.02, 0.08, 0.98, 0.9), low, high)
        title = f"{task.scene.name}: where do the anchors go?"
        panel.figure.text(0.025, 0.955, title, fontsize=12, weight="bold", color=INK)
        handles = [
            Line2D([], [], color=ANCHOR, marker="^", ms=8, ls="", label="anchor"),
            Line2D([], [], color=INK, lw=1.2, ls=(0, (4, 2)), label="work region"),
            *(
                Line2D([], [], color=colour, marker="o", ms=4.5, ls="", label=name)
                for colour, name in zip(_COLOURS, _NAMES, strict=True)
            ),
        ]
        panel.figure.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.5, 0.01),
                            ncols=8, columnspacing=0.9, handletextpad=0.2, fontsize=7.5,
                            frameon=False, borderaxespad=0.0)  # fmt: skip
        panel.figure.text(0.5, 0.062, "expected tag error at poses of the region:", fontsize=7.5,
                          ha="center", color="#495057")  # fmt: skip
        panel.freeze()
        self._view, self._floor = view_of(axes), low[2]
        panel.obstacles(self._view(prism_faces(task.scene.prisms)), 0.35)
        panel.freeze()
        self._racks = [panel.patch(alpha=0.35, **OBSTACLES) for _ in range(6 * _boxes(task))]
        self._stems = panel.line(color="#b4bac0", lw=0.8, ls=(0, (2, 2)))
        self._region = panel.line(color=INK, lw=1.1, ls=(0, (4, 2)))
        self._points = _Points(panel)
        self._anchors = panel.line(color=ANCHOR, marker="^", ms=10, ls="", mec="white", mew=1.0)

    def paint(
        self,
        context: Context,
        anchors: FloatArray,
        places: FloatArray,
        errors: FloatArray,
        headline: str,
        picture: Image,
    ) -> None:
        """Draw a problem, the placed anchors (K, 3), and errors (P,) at its positions (P, 3)."""
        view = self._view
        low, high = context.centre - context.half, context.centre + context.half
        feet = anchors.copy()
        feet[:, 2] = self._floor
        self._stems.set_data(*gapped(view(np.stack([anchors, feet], axis=1))).T)
        self._region.set_data(*gapped(view(box_edges(low, high))).T)
        self._points.set(view(places), errors)
        self._anchors.set_data(*view(anchors).T)
        faces = [face for box in context.racks for face in view(box_faces(*box_bounds(box)))]
        for patch, face in zip(self._racks, faces, strict=False):
            patch.set_xy(face)
        artists = [*self._racks[: len(faces)], self._stems, self._region, *self._points.lines]
        self.panel.paint([*artists, self._anchors], picture)
        write(picture, 34, 14, headline)


class _Plan:
    """The problem and its anchors in plan."""

    def __init__(self, task: PlacementTask) -> None:
        low, high = _corners(task)
        self.panel = panel = Panel(panels.WIDTH - panels.LEFT, panels.TOP)
        margin = 0.05 * (high - low).max()
        axes = plan_axes(panel, (0.145, 0.145, 0.825, 0.82), low - margin, high + margin)
        panel.obstacles(task.scene.prisms.corners, 0.5, axes)
        panel.freeze()
        self._racks = [panel.patch(axes, alpha=0.5, **OBSTACLES) for _ in range(_boxes(task))]
        self._region = panel.line(axes, color=INK, lw=1.1, ls=(0, (4, 2)))
        self._points = _Points(panel, axes)
        style = {"ls": "", "mec": "white", "mew": 0.8}
        self._anchors = panel.line(axes, color=ANCHOR, marker="^", ms=10, **style)
        self._anchors.set_clip_on(False)
        self._pixels = axes.transData

    def paint(
        self,
        context: Context,
        anchors: FloatArray,
        places: FloatArray,
        errors: FloatArray,
        picture: Image,
    ) -> None:
        """Draw as `_World.paint`, with the numbers of the anchors."""
        low, high = context.centre - context.half, context.centre + context.half
        self._region.set_data(*rectangle(low, high)[[0, 1, 2, 3, 0]].T)
        self._points.set(places[:, :2], errors)
        self._anchors.set_data(*anchors[:, :2].T)
        for patch, ring in zip(self._racks, rectangle(*box_bounds(context.racks)), strict=False):
            patch.set_xy(ring)
        artists = [*self._racks[: len(context.racks)], self._region, *self._points.lines]
        self.panel.paint([*artists, self._anchors], picture)
        for k, (x, y) in enumerate(self._pixels.transform(anchors[:, :2])):
            row = int(np.clip(panels.TOP - y - 8, 0, panels.TOP - 17))
            column = int(np.clip(x + 8, 0, panels.WIDTH - panels.LEFT - 24))
            write(picture, row, column, str(k + 1), ANCHOR)


def _corners(task: PlacementTask) -> tuple[FloatArray, FloatArray]:
    """Return the corners of the view: the body's volume and the legal anchor positions."""
    corners = np.array([*task.scene.volume.bounds(), *task.scene.anchor_region.bounds()])
    return corners.min(axis=0), corners.max(axis=0)


_world = functools.lru_cache(maxsize=4)(_World)
_plan = functools.lru_cache(maxsize=4)(_Plan)

"""The panels of a frame: the world, a close-up of the body, errors over epochs."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from rbl_gym import metrics
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.rendering.drawing import (
    ANCHOR,
    AXES,
    BELIEF,
    ERROR,
    INK,
    RADIUS_95,
    Image,
    Panel,
    body_edges,
    box_faces,
    chain,
    gapped,
    outline,
    prism_faces,
    rings,
    round_number,
    space,
    view_at,
    view_of,
    write,
)
from rbl_gym.rendering.shots import Pose, Shot, Stage

WIDTH, HEIGHT = 960, 540
LEFT, TOP = 576, 270  # width of the world's panel, height of the close-up
_LEGEND: dict[str, Any] = {"fontsize": 8, "frameon": False, "borderaxespad": 0.0}


class _World:
    """Anchors, body, trail and obstacles in the whole scene."""

    def __init__(self, stage: Stage) -> None:
        self.panel = panel = Panel(LEFT, HEIGHT)
        axes = space(panel, (0.02, 0.06, 0.98, 0.9), stage.low, stage.high)
        panel.figure.text(0.025, 0.955, stage.name, fontsize=12, weight="bold", color=INK)
        self._legend()
        panel.freeze()
        self._view = view = view_of(axes)
        self._floor = min(stage.low[2], stage.high[2])
        self._length = 0.07 * float(np.max(np.subtract(stage.high, stage.low)))
        for box in np.asarray(stage.obstacles, float).reshape(-1, 6):
            panel.obstacles(view(box_faces(*box_bounds(box))), 0.35)
        panel.obstacles(view(prism_faces(stage.prisms)), 0.35)
        panel.freeze()
        self._shadow = panel.line(color="#c3c9ce", lw=1.2)
        self._stems = panel.line(color="#b4bac0", lw=0.7, ls=(0, (2, 2)))
        self._links = panel.line(color=ANCHOR, lw=0.8, alpha=0.45)
        self._trail = panel.line(color="#495057", lw=1.3)
        self._ellipsoid = panel.patch(fc=BELIEF, ec=BELIEF, lw=0.8, alpha=0.35)
        self._anchors = panel.line(color=ANCHOR, marker="^", ms=8, ls="", mec="white", mew=0.8)
        self._idle = panel.line(color="white", marker="^", ms=7, ls="", mec=ANCHOR, mew=1.0)
        self._axes = [panel.line(color=colour, lw=2.2) for colour in AXES]
        self._body = panel.line(color=INK, marker="o", ms=4.5, ls="", mec="white", mew=0.6)

    def _legend(self) -> None:
        from matplotlib.lines import Line2D

        handles = [
            Line2D(
                [], [], color=ANCHOR, marker="^", ms=7, ls="", label="anchor (hollow: no range)"
            ),
            Line2D([], [], color=ANCHOR, lw=0.8, alpha=0.6, label="measures"),
            Line2D([], [], color=INK, marker="o", ms=4.5, ls="", label="body, enlarged axes"),
            Line2D([], [], color="#495057", lw=1.3, label="path, shadow"),
        ]
        self.panel.figure.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.5, 0.012),
                                 ncols=4, columnspacing=1.2, handletextpad=0.4, handlelength=1.5,
                                 **_LEGEND)  # fmt: skip

    def paint(
        self, path: FloatArray, last: Shot, shown: Pose | None, headline: str, picture: Image
    ) -> None:
        """Draw `path` (K, 3) up to now, and the ellipsoid of `shown`."""
        view, body = self._view, last.truth.translation
        stands = np.concatenate([last.anchors, body[None]])
        feet, flat = stands.copy(), path.copy()
        feet[:, 2] = flat[:, 2] = self._floor
        measuring = last.anchors[last.measuring]
        sights = np.stack([measuring, np.broadcast_to(body, measuring.shape)], axis=1)
        for line, places in (
            (self._shadow, flat),
            (self._stems, gapped(np.stack([stands, feet], axis=1))),
            (self._links, gapped(sights)),
            (self._trail, path),
            (self._anchors, measuring),
            (self._idle, last.anchors[~last.measuring]),
            (self._body, body[None]),
            *(
                (line, np.stack([body, body + self._length * axis]))
                for line, axis in zip(self._axes, last.truth.rotation.T, strict=True)
            ),
        ):
            line.set_data(*view(places).T)
        artists = [self._shadow, self._stems, self._links, self._trail]
        if shown is not None and shown.covariance is not None:
            around = outline(view.matrix, shown.covariance[3:, 3:], RADIUS_95)
            self._ellipsoid.set_xy(view(shown.translation) + around)
            artists.append(self._ellipsoid)
        self.panel.paint([*artists, self._idle, self._anchors, *self._axes, self._body], picture)
        write(picture, 34, 14, headline)


class _CloseUp:
    """The body at its true and its estimated pose, around its true position."""

    def __init__(self, stage: Stage, source: str) -> None:
        from matplotlib.transforms import Bbox

        self.panel = panel = Panel(WIDTH - LEFT, TOP)
        self._tags = np.asarray(stage.tags)
        self._edges = body_edges(self._tags)
        # A body with one tag has no size.
        radius = float(np.linalg.norm(self._tags, axis=-1).max()) or 1.0
        self._radius = radius
        self._legend(source)
        scale = 0.36 * TOP / radius
        self._view = view_at((0.5 * (WIDTH - LEFT), 0.48 * TOP), scale)
        self._bar = round_number(1.2 * radius)
        ruler = panel.line(color=INK, lw=1.5)
        ruler.set_data([12, 12 + self._bar * scale], [12, 12])
        ruler.set_animated(False)
        panel.freeze()
        self._trail = panel.line(color="#adb5bd", lw=1.2)
        # Between the legend and the ruler: a path is longer than the view.
        self._trail.set_clip_box(Bbox([[12, 36], [WIDTH - LEFT - 12, TOP - 26]]))
        self._outline = panel.patch(fc=BELIEF, ec=BELIEF, lw=1.0, alpha=0.22)
        self._rings = panel.line(color=BELIEF, lw=0.8, alpha=0.8)
        self._body = panel.line(color=INK, lw=1.3)
        self._points = panel.line(color=INK, marker="o", ms=4, ls="")
        self._ghost = panel.line(color=BELIEF, lw=1.3, ls=(0, (4, 2)))
        self._ghosts = panel.line(color=BELIEF, marker="o", ms=4, ls="")
        self._axes = [panel.line(color=colour, lw=2.4) for colour in AXES]

    def _legend(self, source: str) -> None:
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch

        handles: list[Any] = [Line2D([], [], color=INK, marker="o", ms=4, lw=1.3, label="true")]
        if source == "belief":
            handles.append(
                Line2D(
                    [], [], color=BELIEF, marker="o", ms=4, lw=1.3, ls=(0, (4, 2)), label="believed"
                )
            )
        if source:
            label = "95 % region" if source == "belief" else "95 % region at the bound"
            handles.append(Patch(fc=BELIEF, alpha=0.3, label=label))
        self.panel.figure.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.985),
                                 ncols=3, columnspacing=1.2, **_LEGEND)  # fmt: skip

    def paint(
        self, path: FloatArray, true: Pose, belief: Pose | None, shown: Pose | None, picture: Image
    ) -> None:
        """Draw `path` (K, 3) up to now, the pose and its belief; `shown` scales both."""
        place = true.translation
        factor, size = self._scales(shown, place)

        def view(points: FloatArray) -> FloatArray:
            return self._view(size * points)

        body = self._tags @ true.rotation.T
        self._trail.set_data(*view(path - place).T)
        self._body.set_data(*gapped(view(body[self._edges])).T)
        self._points.set_data(*view(body).T)
        for line, axis in zip(self._axes, true.rotation.T, strict=True):
            line.set_data(*view(np.stack([np.zeros(3), 0.6 * self._radius * axis])).T)
        artists, note = [self._trail], ""
        if shown is not None and shown.covariance is not None:
            covariance = shown.covariance[3:, 3:]
            off = factor * (shown.translation - place)
            around = outline(self._view.matrix, covariance, size * factor * RADIUS_95)
            self._outline.set_xy(view(off) + around)
            self._rings.set_data(*view(off + chain(rings(covariance, factor * RADIUS_95))).T)
            artists += [self._outline, self._rings]
            note = f"      errors x {factor:g}" if factor != 1 else "      errors to scale"
            if belief is not None:
                turn = metrics.pose_error(*belief[:2], *true[:2])[:3]
                ghost = off + body @ rotations.exp(factor * turn).T
                self._ghost.set_data(*gapped(view(ghost[self._edges])).T)
                self._ghosts.set_data(*view(ghost).T)
                artists += [self._ghost, self._ghosts]
        self.panel.paint([*artists, self._body, self._points, *self._axes], picture)
        write(picture, TOP - 32, 12, f"{self._bar / size:g} m{note}")

    def _scales(self, shown: Pose | None, place: FloatArray) -> tuple[float, float]:
        """Return the magnification of errors, or the reduction of the view, so that both fit."""
        if shown is None or shown.covariance is None:
            return 1.0, 1.0
        widest = RADIUS_95 * math.sqrt(float(np.linalg.eigvalsh(shown.covariance[3:, 3:])[-1]))
        factor = max(1.0, round_number(0.6 * self._radius / max(widest, 1e-12)))
        if factor > 1:
            return factor, 1.0
        off = float(np.linalg.norm(shown.translation - place))
        needed = off + max(self._radius, widest)
        return 1.0, min(1.0, round_number(1.3 * self._radius / needed))


class _Strips:
    """Errors within three standard deviations, over the epochs."""

    def __init__(
        self,
        steps: int,
        limits: tuple[tuple[float, float], ...],
        labels: tuple[str, ...],
        legend: tuple[str, str],
        along: str = "epoch",
    ) -> None:
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch
        from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

        height = HEIGHT - TOP
        self.panel = panel = Panel(WIDTH - LEFT, height)
        self._bands, self._errors = [], []
        foot, head = 36.0 / height, 1 - 26.0 / height
        share = (head - foot) / len(limits)
        for row, ((low, high), label) in enumerate(zip(limits, labels, strict=True)):
            bottom = foot + (len(limits) - 1 - row) * share
            axes: Any = panel.figure.add_axes((0.145, bottom, 0.825, share - 14.0 / height))
            axes.set_yscale("log")
            axes.set_xlim(0, max(steps, 1))
            axes.set_ylim(low, high)
            axes.spines[["top", "right"]].set_visible(False)
            axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0,), numticks=4))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_locator(NullLocator())
            axes.tick_params(labelsize=7, labelbottom=row == len(limits) - 1, length=2.5)
            axes.grid(alpha=0.3, lw=0.5)
            axes.set_ylabel(label, fontsize=8)
            self._bands.append(panel.patch(axes, fc=BELIEF, ec="none", alpha=0.22))
            # Few points need markers.
            mark = {"marker": "o", "ms": 4} if steps <= 16 else {}
            self._errors.append(panel.line(axes, color=ERROR, lw=1.4, **mark))
            if row == len(limits) - 1:
                axes.set_xlabel(along, fontsize=8, labelpad=1)
        error, band = legend
        handles: list[Any] = []
        if error:
            handles.append(Line2D([], [], color=ERROR, lw=1.4, label=error))
        if band:
            handles.append(Patch(fc=BELIEF, alpha=0.3, label=band))
        top = 1 - 2.0 / height
        panel.figure.legend(
            handles=handles, loc="upper center", bbox_to_anchor=(0.55, top), ncols=2, **_LEGEND
        )
        panel.freeze()
        self._floor = [low for low, _ in limits]

    def paint(
        self, epochs: np.ndarray, errors: FloatArray, bands: FloatArray, picture: Image
    ) -> None:
        """Draw errors and bands (R, K), a row for each strip, at epochs (K,)."""
        for row, (low, patch, line) in enumerate(
            zip(self._floor, self._bands, self._errors, strict=True)
        ):
            known = np.isfinite(bands[row])
            if known.any():
                # Half an epoch longer, so that the first one is an area too.
                x = np.append(epochs[known], epochs[known][-1] + 0.5)
                top = np.append(bands[row][known], bands[row][known][-1])
                edge = np.append(top, np.full(len(x), low))
                patch.set_xy(np.column_stack([np.append(x, x[::-1]), edge]))
            patch.set_visible(bool(known.any()))
            # Draw an error below the axis along the axis, not out of sight.
            line.set_data(epochs, np.maximum(errors[row], low))
        self.panel.paint([*self._bands, *self._errors], picture)


def empty() -> tuple[Image, Image, Image, Image]:
    """Return an empty frame and its three parts: left, upper right, lower right."""
    picture = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
    return picture, picture[:, :LEFT], picture[:TOP, LEFT:], picture[TOP:, LEFT:]


# Few are in use at a time: those of a scene, and of the last limits of its axes.
world = functools.lru_cache(maxsize=8)(_World)
close_up = functools.lru_cache(maxsize=8)(_CloseUp)
strips = functools.lru_cache(maxsize=16)(_Strips)

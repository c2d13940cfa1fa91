"""Drawing tools of frames: panels with a cached static part, and a flat view of 3-D space.

Functions that need Matplotlib import it; importing this module does not.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.obstacles import Prisms

Image = NDArray[np.uint8]
# Colours of truth, belief and bound, anchors, error, obstacles.
INK, BELIEF, ANCHOR, ERROR, OBSTACLE = "#222222", "#1b7f5c", "#d1495b", "#2e86ab", "#6c757d"
OBSTACLES: dict[str, Any] = {"fc": OBSTACLE, "ec": "#495057", "lw": 0.5}
AXES = ("#c0392b", "#27964f", "#2f5fb3")  # of a body: x, y, z
_DPI = 100
_ELEVATION, _AZIMUTH = 24.0, -58.0  # view direction of 3-D space, degrees
# Radius in standard deviations of the 95 % region of a 3-D Gaussian (chi-square, 3).
RADIUS_95 = math.sqrt(7.814727903251179)
# The twelve edges of a box by its corners (z fastest), and its faces with four corners each.
_BOX_EDGES = np.array(
    [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)]
)
_BOX_FACES = np.array(
    [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
)


class Panel:
    """A figure of given pixel size; a picture is its static part with artists drawn over it.

    Drawing axes and labels takes tens of milliseconds, copying their pixels less than one.
    """

    def __init__(self, width: int, height: int) -> None:
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        with matplotlib.rc_context({"font.size": 8, "axes.linewidth": 0.6}):
            self.figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
            self._canvas: Any = FigureCanvasAgg(self.figure)

    def freeze(self) -> None:
        """Draw the static part; animated artists are left out."""
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self.figure.bbox)

    def paint(self, artists: Iterable[Any], picture: Image) -> None:
        """Return the static part with these artists over it, as (height, width, 3)."""
        self._canvas.restore_region(self._still)
        renderer = self._canvas.get_renderer()
        for artist in artists:
            artist.draw(renderer)
        pixels = np.asarray(self._canvas.buffer_rgba())
        # Channel by channel: six times as fast as all three at once.
        for channel in range(3):
            picture[..., channel] = pixels[..., channel]

    def line(self, axes: Any = None, **style: Any) -> Any:
        """Return a moving line, in data coordinates of some axes or in pixels of the panel."""
        from matplotlib.lines import Line2D

        return self._moving(Line2D([], [], **style), axes)

    def patch(self, axes: Any = None, **style: Any) -> Any:
        """Return a moving polygon, as `line`."""
        from matplotlib.patches import Polygon

        return self._moving(Polygon(np.zeros((1, 2)), closed=True, **style), axes)

    def obstacles(self, faces: Iterable[FloatArray], alpha: float, axes: Any = None) -> None:
        """Add polygons (V, 2) of obstacles to the static part, as `line`."""
        for face in faces:
            patch = self.patch(axes, alpha=alpha, **OBSTACLES)
            patch.set_xy(face)
            patch.set_animated(False)

    def _moving(self, artist: Any, axes: Any) -> Any:
        from matplotlib.transforms import IdentityTransform

        artist.set_transform(IdentityTransform() if axes is None else axes.transData)
        artist.set_animated(True)
        self.figure.add_artist(artist)
        if axes is not None:
            artist.set_clip_path(axes.patch)
        return artist


def write(picture: Image, row: int, column: int, text: str, colour: str = "#495057") -> None:
    """Write a text of 9 points on white into a picture, with its upper left corner at a pixel.

    Glyphs are copied from a cache: matplotlib takes ten milliseconds for a text that changes.
    """
    for character in text:
        glyph = _glyph(character, colour)
        height, width, _ = glyph.shape
        picture[row : row + height, column : column + width] = glyph
        column += width


@functools.lru_cache(maxsize=256)
def _glyph(character: str, colour: str) -> Image:
    panel = Panel(40, 16)
    text = panel.figure.text(0, 0.3, f"{character}||", fontsize=9, color=colour)
    whole = text.get_window_extent().width
    text.set_text("||")
    width = max(1, round(whole - text.get_window_extent().width))
    text.set_text(character)
    panel.freeze()
    picture = np.empty((16, 40, 3), dtype=np.uint8)
    panel.paint([], picture)
    return picture[:, :width]


def plan_axes(
    panel: Panel, area: tuple[float, float, float, float], low: FloatArray, high: FloatArray
) -> Any:
    """Return axes of a plan between two corners. `area`: left, bottom, width, height, to 1."""
    axes: Any = panel.figure.add_axes(area)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("x [m]", fontsize=8, labelpad=1)
    axes.set_ylabel("y [m]", fontsize=8, labelpad=1)
    axes.tick_params(labelsize=7, length=2.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.3, lw=0.5)
    return axes


class View:
    """A parallel projection of 3-D space: points (..., 3) to pixels (..., 2)."""

    def __init__(self, origin: FloatArray, matrix: FloatArray) -> None:
        self._origin, self.matrix = origin, matrix

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return pixels (..., 2) of points (..., 3)."""
        return self._origin + np.asarray(points) @ self.matrix.T


def view_of(axes: Any) -> View:
    """Return the view of 3-D axes that have been drawn."""
    from mpl_toolkits.mplot3d import proj3d

    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    x, y, _ = proj3d.proj_transform(corners[:, 0], corners[:, 1], corners[:, 2], axes.get_proj())
    seen = axes.transData.transform(np.column_stack([x, y]))
    return View(seen[0], (seen[1:] - seen[0]).T)


def view_at(place: tuple[float, float], scale: float) -> View:
    """Return the same view direction with the origin at a pixel, and `scale` pixels per metre."""
    up, around = math.radians(_ELEVATION), math.radians(_AZIMUTH)
    right = [-math.sin(around), math.cos(around), 0.0]
    above = [-math.cos(around) * math.sin(up), -math.sin(around) * math.sin(up), math.cos(up)]
    return View(np.array(place), scale * np.array([right, above]))


def space(panel: Panel, area: tuple[float, float, float, float], low: Any, high: Any) -> Any:
    """Return 3-D axes with equal scales between two corners, as large as an area allows.

    `area`: left, bottom, right, top, from 0 to 1.
    """
    from matplotlib.ticker import MaxNLocator

    low, high = np.asarray(low, float), np.asarray(high, float)
    axes: Any = panel.figure.add_axes((0, 0, 1, 1), projection="3d", proj_type="ortho")
    extent = high - low
    # A flat scene still needs some height to be drawn.
    extent = np.maximum(extent, 0.02 * extent.max())
    for name, middle, size in zip("xyz", 0.5 * (low + high), extent, strict=True):
        getattr(axes, f"set_{name}lim")(middle - 0.5 * size, middle + 0.5 * size)
        # Ticks at the corners of the box would overlap with those of the next axis.
        few = max(2 if name == "z" else 3, round(6 * size / extent.max()))
        ticks = MaxNLocator(few, prune="lower" if name == "z" else "both")
        axis = getattr(axes, f"{name}axis")
        axis.set_major_locator(ticks)
        axis.set_tick_params(labelsize=7, pad=0)
        axis.set_label_text(f"{name} [m]", fontsize=8)
        axis.labelpad = 3 if size > 0.3 * extent.max() else -3
        axis.pane.set_facecolor("#f7f8f9")
        axis._axinfo["grid"].update(color="#dfe3e6", linewidth=0.5)
    axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    target = np.array(area).reshape(2, 2) * panel.figure.bbox.size
    zoom = 0.8
    for _ in range(3):
        axes.set_box_aspect(extent, zoom=zoom)
        box = _seen(panel, axes, low, high)
        zoom *= float((np.ptp(target, axis=0) / np.ptp(box, axis=0)).min())
    left, bottom = (target.mean(axis=0) - box.mean(axis=0)) / panel.figure.bbox.size
    axes.set_position((left, bottom, 1, 1))
    return axes


def _seen(panel: Panel, axes: Any, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return corners (2, 2), pixels, of the area of 3-D axes: box, ticks and labels."""
    panel.freeze()
    points = [view_of(axes)(box_corners(low, high))]
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        points.append(axis.get_tightbbox().get_points())
    covered = np.concatenate(points)
    return np.array([covered.min(axis=0), covered.max(axis=0)])


def chain(strokes: Iterable[FloatArray]) -> FloatArray:
    """Return lines (K, d) as one line with NaN gaps."""
    parts: list[FloatArray] = []
    for stroke in strokes:
        parts += [stroke, np.full((1, stroke.shape[-1]), np.nan)]
    return np.concatenate(parts) if parts else np.empty((0, 2))


def gapped(segments: FloatArray) -> FloatArray:
    """Return segments (S, 2, d) as one line with gaps."""
    gap = np.full((len(segments), 1, segments.shape[-1]), np.nan)
    return np.concatenate([segments, gap], axis=1).reshape(-1, segments.shape[-1])


def box_corners(low: Any, high: Any) -> FloatArray:
    """Return the eight corners (8, 3) of a box, z fastest."""
    grid = np.meshgrid(*np.stack([low, high], axis=-1), indexing="ij")
    return np.stack(grid, axis=-1).reshape(8, 3)


def box_edges(low: Any, high: Any) -> FloatArray:
    """Return the edges (12, 2, 3) of a box."""
    return box_corners(low, high)[_BOX_EDGES]


def box_faces(low: Any, high: Any) -> FloatArray:
    """Return the faces (6, 4, 3) of a box."""
    return box_corners(low, high)[_BOX_FACES]


def prism_faces(prisms: Prisms) -> FloatArray:
    """Return the vertical faces (F, 4, 3) of prisms."""
    start, end = prisms.corners, np.roll(prisms.corners, -1, axis=1)
    heights = (z[:, None, None] for z in (prisms.low_m, prisms.high_m))
    low, high = (np.broadcast_to(z, (*start.shape[:2], 1)) for z in heights)
    rings = [(start, low), (end, low), (end, high), (start, high)]
    return np.stack([np.concatenate(one, axis=-1) for one in rings], axis=-2).reshape(-1, 4, 3)


def body_edges(tags: Any) -> NDArray[np.intp]:
    """Return pairs (E, 2) of tags that outline a body: edges of the hull; if flat, all pairs.

    Edges between coplanar faces are left out.
    """
    from scipy.spatial import ConvexHull, QhullError

    tags = np.asarray(tags, float)
    pairs = np.array([(i, j) for i in range(len(tags)) for j in range(i)], dtype=np.intp)
    spread = np.linalg.svd(tags - tags.mean(axis=0), compute_uv=False)
    if len(tags) < 4 or spread[2] < 1e-9 * spread[0]:
        return pairs.reshape(-1, 2)
    try:
        hull = ConvexHull(tags)
    except QhullError:
        return pairs
    normals: dict[tuple[int, int], list[FloatArray]] = {}
    for corners, plane in zip(hull.simplices, hull.equations, strict=True):
        for k in range(3):
            i, j = sorted((int(corners[k]), int(corners[k - 1])))
            normals.setdefault((i, j), []).append(plane[:3])
    sharp = [pair for pair, (one, other) in normals.items() if one @ other < 1 - 1e-6]
    return np.array(sorted(sharp), dtype=np.intp)


def outline(matrix: FloatArray, covariance: FloatArray, radius: float) -> FloatArray:
    """Return the outline (K, 2) of an ellipsoid of `radius` std, projected by `matrix` (2, n)."""
    values, vectors = np.linalg.eigh(matrix @ covariance @ matrix.T)
    circle = _circle()
    return radius * (circle * np.sqrt(np.maximum(values, 0))) @ vectors.T


def rings(covariance: FloatArray, radius: float) -> list[FloatArray]:
    """Return the three circles (K, 3) of an ellipsoid in the planes of its axes."""
    values, vectors = np.linalg.eigh(covariance)
    half = radius * vectors * np.sqrt(np.maximum(values, 0))
    return [_circle() @ half[:, [i, j]].T for i, j in ((0, 1), (0, 2), (1, 2))]


def _circle() -> FloatArray:
    angle = np.linspace(0, 2 * np.pi, 49)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def round_number(value: float) -> float:
    """Return the largest of 1, 2, 5, 10, ... and their tenths not above a positive value."""
    decade = 10.0 ** math.floor(math.log10(value))
    return max(step * decade for step in (1, 2, 5) if step * decade <= value * (1 + 1e-12))

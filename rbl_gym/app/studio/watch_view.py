"""The moving parts in 3-D: the true body, the filters' estimates, links, anchors and paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from rbl_gym.app.studio.moving_view import ANCHOR
from rbl_gym.app.studio.scene_view import lines
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.measurements.ranging import tag_positions
from rbl_gym.rendering.drawing import body_edges
from rbl_gym.studies.watching.frames import LINKS, Frame, Tracked, link_kinds

TRUTH = (33, 37, 41)
# Colours of the filters, in order; and of other layouts.
FILTERS = ((28, 126, 214), (174, 62, 201), (12, 133, 153))
GHOSTS = ((232, 89, 12), (12, 133, 153), (92, 148, 13))
WRONG = (224, 49, 49)
# Colours of links by kind: lost, used, reflected, rejected, weak.
LINK_COLOURS = ((206, 212, 218), (64, 160, 90), (224, 49, 49), (245, 159, 0), (140, 170, 225))
LINK_WIDTHS = (0.6, 1.2, 1.8, 1.8, 0.8)
# Minimum size of the body and size of anchors, as shares of the largest extent.
_BODY, _ANCHOR = 0.045, 0.006
# Scale of the axes of a 95 % ellipsoid of a position.
_RADIUS = float(np.sqrt(special.chdtri(3, 0.05)))
# Maximum number of epochs of the drawn paths.
_WAY = 150


class Ellipsoid(NamedTuple):
    """Half axes (3,) in metres, and the rotation (3, 3) from x, y, z to them."""

    half: FloatArray
    rotation: FloatArray


def ellipsoid(covariance: FloatArray) -> Ellipsoid | None:
    """Return the 95 % ellipsoid of position of a pose covariance (6, 6); None if not finite."""
    if not np.isfinite(covariance).all():
        return None
    values, axes = np.linalg.eigh(covariance[3:, 3:])
    if np.linalg.det(axes) < 0:
        axes = axes * [1.0, 1.0, -1.0]
    return Ellipsoid(_RADIUS * np.sqrt(np.maximum(values, 0.0)), axes)


def link_lines(
    frame: Frame, which: int, tags: FloatArray, enlarged: float
) -> dict[str, FloatArray]:
    """Return links (S, 2, 3) by kind, from the anchors to the tags of the enlarged body.

    Rejections are those of the filter `which`. Without truth the links end at the first filter's
    estimate.
    """
    kinds = link_kinds(frame.links, frame.tracks[which].rejected if frame.tracks else None)
    pose: Any = frame.truth
    if pose is None or pose.rotation is None:
        pose = frame.tracks[0].belief if frame.tracks else None
    if pose is None or not kinds.size:
        return {}
    ends = tag_positions(pose.rotation, pose.translation, enlarged * tags)
    shape = (*kinds.shape, 3)
    pairs = np.stack(
        [np.broadcast_to(frame.anchors[:, None], shape), np.broadcast_to(ends[None], shape)], -2
    )
    return {name: pairs[kinds == number] for number, name in enumerate(LINKS)}


def letterbox(picture: np.ndarray, aspect: float) -> np.ndarray:
    """Add white margins to a picture (height, width, 3) to reach an aspect ratio."""
    height, width = picture.shape[:2]
    missing = max(0, round(width / aspect) - height), max(0, round(height * aspect) - width)
    sides = [(size // 2, size - size // 2) for size in missing]
    return np.pad(picture, [*sides, (0, 0)], constant_values=255)


class WatchView:
    """Draws frames in the scene of a viser server; `extent` is its largest side, metres."""

    def __init__(self, scene: Any, extent: float, tags: FloatArray) -> None:
        self._scene, self._extent, self._tags = scene, extent, tags
        size = max(float(np.ptp(tags, axis=0).max()), 1e-9)
        self.enlarged = max(1.0, _BODY * extent / size) if len(tags) > 1 else 1.0
        self.radius = max(0.5 * self.enlarged * size if len(tags) > 1 else 0.0, 0.02 * extent)
        self._handles: dict[str, Any] = {}
        self._bodies: list[str] = []
        self._places: dict[str, FloatArray] = {}

    def show(self, past: Sequence[Frame], which: int, aspect: float | None = None) -> None:
        """Draw the last of the frames, the paths up to it, and the links as a filter uses them.

        `aspect` is the aspect ratio of the window, for pictures; None if it is not known.
        """
        frame = past[-1]
        if frame.picture is not None:
            picture = frame.picture if aspect is None else letterbox(frame.picture, aspect)
            self._scene.set_background_image(picture, format="png")
            return
        self._show_anchors("/anchors", frame.anchors, ANCHOR, labels=True)
        wrong = frame.told[np.abs(frame.told - frame.anchors).max(axis=1) > 1e-6]
        self._show_anchors("/told", wrong, WRONG)
        for k, (name, anchors) in enumerate(frame.ghosts.items()):
            self._show_anchors(f"/ghosts/{name}", anchors, GHOSTS[k % len(GHOSTS)], ghost=True)
        truth = frame.truth
        self._show_body("/truth", truth, TRUTH, 2.5)
        for k, track in enumerate(frame.tracks):
            self._show_body(f"/filter-{k}", track.belief, FILTERS[k], 2.0)
            self._show_ellipsoid(k, track)
        links = link_lines(frame, which, self._tags, self.enlarged)
        for number, name in enumerate(LINKS):
            found = links.get(name, np.empty((0, 2, 3)))
            self._lines(f"/links/{number}", found, LINK_COLOURS[number], LINK_WIDTHS[number])
        self._show_ways(past[-_WAY:])

    def clear(self) -> None:
        """Remove all drawn objects."""
        for handle in self._handles.values():
            handle.remove()
        self._handles.clear()
        self._places.clear()
        self._bodies.clear()

    def centre(self, frame: Frame) -> FloatArray | None:
        """Return the target of a camera that follows the body."""
        poses = [frame.truth, *(track.belief for track in frame.tracks)]
        return next((np.array(pose.translation) for pose in poses if pose is not None), None)

    def _show_anchors(
        self, name: str, anchors: FloatArray, colour: Any, labels: bool = False, ghost: bool = False
    ) -> None:
        shown = self._places.get(name)
        if shown is not None and shown.shape == anchors.shape and (shown == anchors).all():
            return
        self._places[name] = anchors.copy()
        if not len(anchors):
            self._remove(name)
            return
        size = _ANCHOR * self._extent
        self._handles[name] = self._scene.add_point_cloud(
            name, anchors.astype(np.float32), colour, point_size=(1.6 if ghost else 2) * size,
            point_shape="diamond" if ghost else "circle", precision="float32",
        )  # fmt: skip
        for k, place in enumerate(anchors if labels else ()):
            self._handles[f"{name}-names/{k}"] = self._scene.add_label(
                f"{name}-names/{k}", f"{k + 1}", position=tuple(place + [0, 0, 1.5 * size]),
                anchor="bottom-center",
            )  # fmt: skip

    def _show_body(self, name: str, pose: Any, colour: Any, width: float) -> None:
        if name not in self._bodies:
            self._bodies.append(name)
            self._handles[name] = self._scene.add_frame(
                name, axes_length=1.2 * self.radius, axes_radius=0.025 * self.radius,
                show_axes=name != "/truth" and len(self._tags) > 1, origin_radius=0.0,
            )  # fmt: skip
            spots = self.enlarged * self._tags
            edges = spots[body_edges(self._tags)] if len(spots) > 1 else np.empty((0, 2, 3))
            lines(self._scene, f"{name}/edges", edges, colour, width)
            self._scene.add_point_cloud(
                f"{name}/tags", spots.astype(np.float32), colour,
                point_size=0.12 * self.radius, point_shape="circle", precision="float32",
            )  # fmt: skip
        handle = self._handles[name]
        handle.visible = pose is not None and bool(np.isfinite(pose.translation).all())
        if pose is not None and handle.visible:
            handle.position = tuple(pose.translation)
            if pose.rotation is not None and np.isfinite(pose.rotation).all():
                handle.wxyz = tuple(rotations.quaternion(pose.rotation))

    def _show_ellipsoid(self, k: int, track: Tracked) -> None:
        name = f"/ellipsoid-{k}"
        found = ellipsoid(track.belief.covariance)
        if found is None or not np.isfinite(track.belief.translation).all():
            self._remove(name)
            return
        # Keep flat bodies visible, and limit the size to that of the scene.
        half = np.clip(found.half, 1e-3 * self._extent, self._extent)
        if name not in self._handles:
            self._handles[name] = self._scene.add_icosphere(
                name, 1.0, FILTERS[k], opacity=0.35, subdivisions=3,
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        handle = self._handles[name]
        handle.scale = tuple(half.tolist())
        handle.position = tuple(track.belief.translation)
        handle.wxyz = tuple(rotations.quaternion(found.rotation))

    def _show_ways(self, way: Sequence[Frame]) -> None:
        paths: dict[str, tuple[list[FloatArray], Any]] = {
            "/way/truth": ([f.truth.translation for f in way if f.truth is not None], TRUTH)
        }
        for k in range(len(way[-1].tracks)):
            paths[f"/way/{k}"] = ([f.tracks[k].belief.translation for f in way], FILTERS[k])
        for name, (places, colour) in paths.items():
            path = np.array(places).reshape(-1, 3)
            path = path[np.isfinite(path).all(axis=1)]
            self._lines(name, np.stack([path[:-1], path[1:]], axis=1), colour, 1.2)

    def _lines(self, name: str, segments: FloatArray, colour: Any, width: float) -> None:
        if len(segments):
            self._handles[name] = lines(self._scene, name, segments, colour, width)
        else:
            self._remove(name)

    def _remove(self, name: str) -> None:
        if (handle := self._handles.pop(name, None)) is not None:
            handle.remove()


def swatches(names: Mapping[str, Any]) -> str:
    """Return a legend (HTML) of names and their colours."""
    return "".join(
        f'<span style="white-space:nowrap"><span style="display:inline-block;width:14px;height:3px;'
        f'background:rgb{colour};margin:0 4px 3px 0"></span>{name}</span> &ensp;'
        for name, colour in names.items()
    )

"""The moving parts in 3-D: the map, zones in the colours of their verdicts, the body, anchors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym.app.studio.figures import ZoneFigures
from rbl_gym.app.studio.maps import SliceMap, picture
from rbl_gym.app.studio.scene_view import lines
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.polygons import prism_edges
from rbl_gym.placement.building import Zone

ANCHOR, SELECTED, FIXED = (24, 100, 171), (232, 89, 12), (73, 80, 87)
BODY, FREE, BLOCKED = (33, 37, 41), (43, 138, 62), (224, 49, 49)
# Colours of zones: requirement met, not met, undecided, no requirement.
VERDICTS = {
    "pass": (47, 158, 68),
    "fail": (201, 42, 42),
    "undecided": (230, 145, 0),
    "no requirement": (73, 80, 87),
}
SIGNS = {"pass": "\u2713", "fail": "\u2717", "undecided": "?", "no requirement": ""}
# Radius of an anchor as a share of the room's largest extent.
_ANCHOR = 0.013
# Anchors are drawn smaller above this number.
_FEW = 16
# A link that keeps this share of its information counts as in sight.
SEEN = 0.5

Dragged = Callable[[int, str, FloatArray, FloatArray], None]


class MapView:
    """The map on its plane. Only the picture is sent while the plane is the same."""

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._handle: Any = None
        self._at: Any = None
        self._shown: Any = None

    def show(self, found: SliceMap) -> None:
        """Draw a map. An unchanged map is not sent again."""
        if found is self._shown:
            return
        image, at = picture(found), (*found.low, *found.high, found.up)
        if at == self._at:
            self._handle.image = image
        else:
            size = (found.high - found.low)[[0, found.up]]
            # The picture's axes are x to the right and y down.
            turn = (0.0, 1.0, 0.0, 0.0) if found.up == 1 else (0.5**0.5, -(0.5**0.5), 0.0, 0.0)
            self._handle = self._scene.add_image(
                "/map", image, float(size[0]), float(size[1]), format="png",
                wxyz=turn, position=tuple(0.5 * (found.low + found.high)),
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        self._at, self._shown = at, found


class ZoneView:
    """The edges of zones in the colours of their verdicts, with names and shares if known."""

    def __init__(self, scene: Any, zones: tuple[Zone, ...]) -> None:
        self._scene, self._zones = scene, zones
        self._labels: list[Any] = []
        self._verdicts: list[str | None] = [None] * len(zones)
        for index, zone in enumerate(zones):
            corner = (*zone.polygon[zone.polygon.sum(axis=1).argmin()], zone.high_m)
            name = f"/zone-names/{index}"
            self._labels.append(
                scene.add_label(name, "", position=corner, anchor="bottom-left", visible=False)
            )

    def show(self, found: tuple[ZoneFigures, ...]) -> None:
        """Draw the zones with their figures."""
        for index, (zone, figures) in enumerate(zip(self._zones, found, strict=True)):
            if self._verdicts[index] != figures.verdict:
                self._verdicts[index] = figures.verdict
                edges = prism_edges(zone.polygon, zone.low_m, zone.high_m)
                lines(self._scene, f"/zones/{index}", edges, VERDICTS[figures.verdict], 2)
            text = f"{SIGNS[figures.verdict]} {figures.name}".strip()
            if np.isfinite(figures.share):
                text += f"  {100 * figures.share:.0f} %"
            label = self._labels[index]
            if label.text != text:
                label.text = text
                label.visible = len(found) > 1 or figures.verdict != "no requirement"


class BodyView:
    """The body with its tags, and a line to every anchor: green if in sight, else red.

    It is drawn at least `least_m` large. `dragged` is called as by `AnchorView`, with index 0.
    """

    def __init__(self, scene: Any, least_m: float, dragged: Dragged) -> None:
        self._scene, self._least_m, self._dragged = scene, least_m, dragged
        self._frame = scene.add_frame("/body", show_axes=False)
        self._tags: Any = None
        self._links: Any = None

    def show(self, tags: FloatArray, place: FloatArray, anchors: FloatArray, seen: Any) -> None:
        """Draw tags (N, 3) about a position (3,), and links to anchors (M, 3) with shares (M,)."""
        if tags is not self._tags:
            self._tags = tags
            self._add(tags)
        self._frame.position = tuple(place)
        ends = np.stack([np.broadcast_to(place, anchors.shape), anchors], axis=1)
        colours = np.where((seen >= SEEN)[:, None], FREE, BLOCKED).astype(np.uint8)
        colours = np.repeat(colours[:, None], 2, axis=1)
        self._links = self._scene.add_line_segments(
            "/links", ends.astype(np.float32), colours, thickness=1.2, thickness_units="screen"
        )

    def _add(self, tags: FloatArray) -> None:
        size = float(np.ptp(tags, axis=0).max())
        spots = max(1.0, self._least_m / max(size, 1e-9)) * tags
        arms = np.stack([np.zeros_like(spots), spots], axis=1)
        lines(self._scene, "/body/arms", arms, BODY, 2.5)
        radius = 0.5 * max(self._least_m, size)
        self._scene.add_point_cloud(
            "/body/tags", spots.astype(np.float32), BODY, point_size=0.3 * radius,
            point_shape="circle", precision="float32",
        )  # fmt: skip
        ball = self._scene.add_icosphere(
            "/body/hand", radius=radius, color=(255, 212, 59), opacity=0.45, subdivisions=2,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

        @ball.on_drag
        async def _(event: Any) -> None:
            camera = np.array(event.client.camera.position)
            self._dragged(0, event.phase, camera, np.array(event.end_position))


class AnchorView:
    """The anchors as balls that a user can drag.

    `dragged` is called with the anchor's index, the phase (``"start"``, ``"update"``, ``"end"``),
    the camera's position (3,) and a point (3,) under the pointer; `clicked` with the index.
    `extent` is the largest extent of the room, metres.
    """

    def __init__(
        self, scene: Any, extent: float, dragged: Dragged, clicked: Callable[[int], None]
    ) -> None:
        self._scene, self._radius = scene, _ANCHOR * extent
        self._dragged, self._clicked = dragged, clicked
        self.balls: list[Any] = []
        self._labels: list[Any] = []
        self._looks: list[Any] = []

    def show(self, anchors: FloatArray, fixed: BoolArray, selected: int | None) -> None:
        """Draw the anchors at their positions (M, 3). Only the changes are sent."""
        while len(self.balls) > len(anchors):
            self.balls.pop().remove()
            self._labels.pop().remove()
            self._looks.pop()
        while len(self.balls) < len(anchors):
            self._add(len(self.balls))
        # Many anchors are drawn smaller.
        size = round(min(1.0, (_FEW / len(anchors)) ** 0.5), 2)
        up = np.array([0.0, 0.0, 1.3 * size * self._radius])
        for k, place in enumerate(anchors):
            ball, label = self.balls[k], self._labels[k]
            if ball.scale != size:
                ball.scale, label.font_screen_scale = size, max(size, 0.75)
            if (np.asarray(ball.position) != place).any():
                ball.position = tuple(place)
                label.position = tuple(place + up)
            colour = SELECTED if k == selected else FIXED if fixed[k] else ANCHOR
            text = f"{k + 1} fixed" if fixed[k] else f"{k + 1}"
            if self._looks[k] != (colour, text):
                self._looks[k] = colour, text
                ball.color, label.text = colour, text

    def _add(self, index: int) -> None:
        ball = self._scene.add_icosphere(
            f"/anchors/{index + 1}", radius=self._radius, color=ANCHOR, subdivisions=2
        )
        label = self._scene.add_label(f"/anchor-names/{index + 1}", "", anchor="bottom-center")

        # Coroutines keep the order of the phases; threads would not.
        @ball.on_drag
        async def _(event: Any) -> None:
            camera = np.array(event.client.camera.position)
            self._dragged(index, event.phase, camera, np.array(event.end_position))

        @ball.on_click
        async def _(event: Any) -> None:
            self._clicked(index)

        self.balls.append(ball)
        self._labels.append(label)
        self._looks.append(None)

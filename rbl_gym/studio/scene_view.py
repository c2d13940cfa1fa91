"""The room in 3-D: walls, obstacles, zones, the body, anchors and the map, as viser draws them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.polygons import ears
from rbl_gym.geometry.regions import Walls
from rbl_gym.placement.building import Problem
from rbl_gym.studio.figures import ZoneFigures
from rbl_gym.studio.maps import SliceMap, picture

INK = (52, 58, 64)
WALL, FLOOR, RACK = (206, 212, 218), (241, 243, 245), (134, 142, 150)
ANCHOR, SELECTED, FIXED, BODY = (31, 97, 141), (230, 119, 0), (73, 80, 87), (25, 113, 60)
# Of a zone: meets what it asks, does not, too close to tell, asks nothing.
VERDICTS = {
    "pass": (47, 158, 68),
    "fail": (201, 42, 42),
    "undecided": (230, 145, 0),
    "no requirement": (73, 80, 87),
}
SIGNS = {"pass": "✓", "fail": "✗", "undecided": "?", "no requirement": ""}
# Sizes as shares of the largest extent: anchors, lines.
_ANCHOR, _LINE = 0.010, 0.0016
_FOV_RAD = 0.75


def corners(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Corners (3,) of the smallest box around mounts, zones and obstacles, metres."""
    lows, highs = zip(problem.corners(), problem.mounts.bounds(), strict=True)
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    boxes, prisms = problem.obstacles.boxes, problem.obstacles.prisms
    if len(boxes):
        low = np.minimum(low, (boxes[:, :3] - boxes[:, 3:]).min(axis=0))
        high = np.maximum(high, (boxes[:, :3] + boxes[:, 3:]).max(axis=0))
    if len(prisms):
        plan = prisms.corners.reshape(-1, 2)
        low = np.minimum(low, [*plan.min(axis=0), prisms.low_m.min()])
        high = np.maximum(high, [*plan.max(axis=0), prisms.high_m.max()])
    return low, high


def extent_of(problem: Problem) -> float:
    """The largest side of `corners`, metres."""
    return float(np.ptp(corners(problem), axis=0).max())


def set_camera(server: Any, problem: Problem) -> None:
    """A view from the south and above, in which all of it can be seen."""
    low, high = corners(problem)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    away = np.array([-0.25, -1.0, 0.85])
    away /= np.linalg.norm(away)
    reach = max(half[0], 1.6 * half[1], 1.6 * half[2])
    camera = server.initial_camera
    camera.fov = _FOV_RAD
    camera.near, camera.far = reach / 200, reach * 60
    # The panel covers the right side.
    middle = middle + np.array([0.22 * reach, 0.0, -0.1 * reach])
    camera.look_at = middle
    camera.position = middle + 1.45 * reach / np.tan(0.5 * _FOV_RAD) * away


# --- what stands still -----------------------------------------------------------------------


def draw_room(server: Any, problem: Problem) -> None:
    """Floor, walls, obstacles and where anchors may stand."""
    scene, extent = server.scene, extent_of(problem)
    low, high = corners(problem)
    flat = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    floor = np.column_stack([flat, np.full(4, low[2] - 0.002 * extent)])
    scene.add_mesh_simple(
        "/room/floor", floor, np.array([[0, 1, 2], [0, 2, 3]]), color=FLOOR, side="double",
        cast_shadow=False, receive_shadow=False,
    )  # fmt: skip
    step = next(s for s in (1, 2, 5, 10, 50, 100, 1000, 1e9) if extent / s < 50)
    _lines(scene, "/room/grid", _grid(low, high, step, floor[0, 2] + 3e-4 * extent), FLOOR_LINE, 1)
    if isinstance(problem.mounts, Walls):
        faces = _room_faces(*problem.mounts.bounds())
        # Seen from the inside alone: the walls between camera and room are left out.
        scene.add_mesh_simple(
            "/room/walls", *faces, color=WALL, opacity=0.35, side="back",
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        _lines(scene, "/room/edges", box_edges(*problem.mounts.bounds()), INK, 1.5)
    elif isinstance(problem.mounts, Mounts):
        vertices, triangles = _mount_faces(problem.mounts)
        if len(triangles):
            scene.add_mesh_simple(
                "/room/mounts", vertices, triangles, color=(116, 143, 252), opacity=0.3,
                side="double", cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
    else:
        _lines(scene, "/room/edges", box_edges(*problem.mounts.bounds()), (173, 181, 189), 1)
    solids = obstacle_mesh(problem)
    if solids is not None:
        scene.add_mesh_simple(
            "/room/obstacles", *solids, color=RACK, opacity=0.8, flat_shading=True, side="double"
        )


FLOOR_LINE = (222, 226, 230)


def _lines(scene: Any, name: str, segments: FloatArray, colour: Any, width: float) -> Any:
    return scene.add_line_segments(
        name, np.asarray(segments, np.float32), colour, thickness=width, thickness_units="screen"
    )


def _grid(low: FloatArray, high: FloatArray, step: float, z: float) -> FloatArray:
    """Lines (S, 2, 3) at whole multiples of a step."""
    found = []
    for axis in (0, 1):
        for at in np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1) * step:
            ends = np.array([[low[0], low[1], z], [high[0], high[1], z]])
            ends[:, axis] = at
            found.append(ends)
    return np.array(found).reshape(-1, 2, 3)


def box_edges(low: FloatArray, high: FloatArray) -> FloatArray:
    """The twelve edges (12, 2, 3) of a box."""
    ring = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return prism_edges(ring, low[2], high[2])


def prism_edges(ring: FloatArray, low: float, high: float) -> FloatArray:
    """The edges (3 V, 2, 3) of a prism over corners (V, 2)."""
    bottom, top = (np.insert(ring, 2, z, axis=1) for z in (low, high))
    around = [np.stack([one, np.roll(one, -1, axis=0)], axis=1) for one in (bottom, top)]
    return np.concatenate([*around, np.stack([bottom, top], axis=1)])


def _room_faces(low: FloatArray, high: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Walls and ceiling of a room, their front outwards."""
    x, y, z = zip(low, high, strict=True)
    points = np.array([[x[i], y[j], z[k]] for k in (0, 1) for j in (0, 1) for i in (0, 1)])
    quads = [(0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6), (4, 5, 7, 6)]
    return points, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def _mount_faces(mounts: Mounts) -> tuple[FloatArray, np.ndarray]:
    """Pieces of mounts as triangles: strips of walls, parts of ceilings; points are left out."""
    vertices: list[Any] = []
    triangles: list[Any] = []
    for a0, a1, b0, b1, c0, c1, low, high in mounts.pieces.tolist():
        count = len(vertices)
        if (b0, b1) != (c0, c1):
            vertices += [(a0, a1, high), (b0, b1, high), (c0, c1, high)]
            triangles.append((count, count + 1, count + 2))
        elif (a0, a1) != (b0, b1) and high > low:
            vertices += [(a0, a1, low), (b0, b1, low), (b0, b1, high), (a0, a1, high)]
            triangles += [(count, count + 1, count + 2), (count, count + 2, count + 3)]
    return np.array(vertices).reshape(-1, 3), np.array(triangles, int).reshape(-1, 3)


def obstacle_mesh(problem: Problem) -> tuple[FloatArray, np.ndarray] | None:
    """All obstacles as vertices and triangles; None where there are none."""
    boxes, prisms = problem.obstacles.boxes, problem.obstacles.prisms
    turns = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    found = [(box[:2] + turns * box[3:5], box[2] - box[5], box[2] + box[5]) for box in boxes]
    found += zip(prisms.corners, prisms.low_m, prisms.high_m, strict=True)
    if not found:
        return None
    points, triangles, count = [], [], 0
    for ring, low, high in found:
        # Corners of prisms are repeated up to a common number.
        ring = ring[np.append(True, (np.diff(ring, axis=0) != 0).any(axis=1))]
        size, here = len(ring), np.arange(len(ring))
        there, caps = (here + 1) % size, ears(ring)
        points += [np.insert(ring, 2, z, axis=1) for z in (low, high)]
        faces = [
            caps[:, ::-1],
            caps + size,
            np.stack([here, there, there + size], axis=1),
            np.stack([here, there + size, here + size], axis=1),
        ]
        triangles.append(np.concatenate(faces) + count)
        count += 2 * size
    return np.concatenate(points), np.concatenate(triangles)


# --- what changes ----------------------------------------------------------------------------


def draw_zones(server: Any, problem: Problem, zones: tuple[ZoneFigures, ...]) -> None:
    """The edges of zones in the colours of their verdicts; names and shares where there is one."""
    for index, (zone, found) in enumerate(zip(problem.zones, zones, strict=True)):
        edges = prism_edges(zone.polygon, zone.low_m, zone.high_m)
        _lines(server.scene, f"/zones/{index}", edges, VERDICTS[found.verdict], 2)
        if found.verdict == "no requirement" and len(zones) == 1:
            continue
        text = f"{SIGNS[found.verdict]} {found.name}".strip()
        if np.isfinite(found.share):
            text += f"  {100 * found.share:.0f} %"
        corner = (*zone.polygon[zone.polygon.sum(axis=1).argmin()], zone.high_m)
        server.scene.add_label(f"/zones/{index}/name", text, position=corner, anchor="bottom-left")


def draw_map(server: Any, found: SliceMap, handle: Any = None) -> Any:
    """The map on its plane; with a handle of the same plane its picture alone is changed.

    Returns
    -------
    The handle of the picture.
    """
    image = picture(found)
    if handle is not None:
        handle.image = image
        return handle
    size = (found.high - found.low)[[0, found.up]]
    # The picture's own axes are x to the right and y down.
    turn = (0.0, 1.0, 0.0, 0.0) if found.up == 1 else (0.5**0.5, -(0.5**0.5), 0.0, 0.0)
    return server.scene.add_image(
        "/map", image, float(size[0]), float(size[1]), format="png",
        wxyz=turn, position=tuple(0.5 * (found.low + found.high)),
        cast_shadow=False, receive_shadow=False,
    )  # fmt: skip


def draw_body(server: Any, tags: FloatArray, place: FloatArray, extent: float) -> None:
    """The body: its tags about a place, joined to its middle; not smaller than can be seen."""
    grown = max(1.0, 0.02 * extent / max(float(np.ptp(tags, axis=0).max()), 1e-9))
    spots = place + grown * tags
    lines = np.stack([np.broadcast_to(place, spots.shape), spots], axis=1)
    _lines(server.scene, "/body/arms", lines, BODY, 3)
    server.scene.add_point_cloud(
        "/body/tags", spots.astype(np.float32), BODY, point_size=0.005 * extent,
        point_shape="circle", precision="float32",
    )  # fmt: skip


class AnchorView:
    """The anchors as balls that can be taken by the hand.

    Parameters
    ----------
    server, extent
        Where they are drawn, and the largest extent of the room, metres.
    dragged
        Called with the number of the anchor, the phase (``"start"``, ``"update"``, ``"end"``),
        the camera's place (3,) and a point (3,) under the pointer.
    clicked
        Called with the number of the anchor.
    """

    def __init__(
        self,
        server: Any,
        extent: float,
        dragged: Callable[[int, str, FloatArray, FloatArray], None],
        clicked: Callable[[int], None],
    ) -> None:
        self._server, self._radius = server, _ANCHOR * extent
        self._dragged, self._clicked = dragged, clicked
        self.balls: list[Any] = []
        self._labels: list[Any] = []
        self._colours: list[Any] = []

    def show(self, anchors: FloatArray, fixed: np.ndarray, selected: int | None) -> None:
        """Draw them where they are (M, 3); only what changed is sent."""
        while len(self.balls) > len(anchors):
            self.balls.pop().remove()
            self._labels.pop().remove()
            self._colours.pop()
        while len(self.balls) < len(anchors):
            self._add(len(self.balls))
        up = np.array([0.0, 0.0, 1.6 * self._radius])
        for k, place in enumerate(anchors):
            ball, label = self.balls[k], self._labels[k]
            if (np.asarray(ball.position) != place).any():
                ball.position = tuple(place)
                label.position = tuple(place + up)
            colour = SELECTED if k == selected else FIXED if fixed[k] else ANCHOR
            text = f"{k + 1} fixed" if fixed[k] else f"{k + 1}"
            if self._colours[k] != (colour, text):
                self._colours[k] = colour, text
                ball.color, label.text = colour, text

    def _add(self, index: int) -> None:
        scene = self._server.scene
        ball = scene.add_icosphere(
            f"/anchors/{index + 1}", radius=self._radius, color=ANCHOR, subdivisions=2
        )
        label = scene.add_label(f"/anchor-names/{index + 1}", "", anchor="bottom-center")

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
        self._colours.append(None)

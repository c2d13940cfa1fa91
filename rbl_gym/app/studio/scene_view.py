"""The static parts in 3-D: floor, walls, obstacles and mounts; and the camera."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from rbl_gym.app.place_shapes import solids
from rbl_gym.checks import FloatArray
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.geometry.polygons import prism_mesh, rectangle
from rbl_gym.geometry.regions import Shell, Walls
from rbl_gym.placement.building import Problem
from rbl_gym.rendering.drawing import box_edges

# Width of the panel, pixels.
PANEL = 310
INK = (52, 58, 64)
WALL, FLOOR, GRID, RACK = (206, 212, 218), (241, 243, 245), (222, 226, 230), (173, 181, 189)
EDGE = (173, 181, 189)
# Direction of the camera, its vertical field of view, and the filled share of the window.
_TOWARDS = np.array([-0.25, -1.0, 0.85])
_FOV_RAD, _FILLED = 0.7, 0.92
# An obstacle above this share of the height is a wall and drawn transparent.
_TALL = 0.8


def corners(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return the corners (3,) of the bounding box of mounts, zones and obstacles, metres."""
    lows, highs = zip(problem.corners(), problem.mounts.bounds(), strict=True)
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    boxes, prisms = problem.obstacles.boxes, problem.obstacles.prisms
    if len(boxes):
        lows, highs = box_bounds(boxes)
        low, high = np.minimum(low, lows.min(axis=0)), np.maximum(high, highs.max(axis=0))
    if len(prisms):
        plan = prisms.corners.reshape(-1, 2)
        low = np.minimum(low, [*plan.min(axis=0), prisms.low_m.min()])
        high = np.maximum(high, [*plan.max(axis=0), prisms.high_m.max()])
    return low, high


def extent_of(problem: Problem) -> float:
    """Return the largest side of `corners`, metres."""
    return float(np.ptp(corners(problem), axis=0).max())


def set_camera(server: Any, problem: Problem, panels: int = PANEL) -> None:
    """Show the complete problem from the south and above, in every new browser.

    `panels` is the total width of all panels in pixels.
    """
    camera = server.initial_camera
    camera.fov = _FOV_RAD
    reach = extent_of(problem)
    camera.near, camera.far = reach / 500, reach * 50
    camera.look_at, camera.position = view_of(problem, 1.2)

    @server.on_client_connect
    async def _(client: Any) -> None:
        look(client, problem, panels)


def look(client: Any, problem: Problem, panels: int = PANEL) -> None:
    """Set the camera of a browser so that the complete problem is visible."""
    view = client.camera
    # Width of the window without the panels.
    aspect = max(view.image_width - panels, 0.4 * view.image_width) / view.image_height
    look_at, position = view_of(problem, aspect)
    # Setting the position also moves the target point, so set the target last.
    client.camera.position = position
    client.camera.look_at = look_at


def view_of(problem: Problem, aspect: float) -> tuple[FloatArray, FloatArray]:
    """Return target and position (3,) of a camera that shows the complete problem.

    `aspect` is the width of the window over its height.
    """
    low, high = corners(problem)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    axes = view_axes(-_TOWARDS)
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    across, up, ahead = axes @ (signs * half).T
    limit = math.tan(0.5 * _FOV_RAD)
    # Distances at which each corner reaches the edge of the window.
    needed = np.maximum(np.abs(across) / aspect, np.abs(up)) / (_FILLED * limit) - ahead
    return middle, middle - needed.max() * axes[2]


def view_axes(forward: FloatArray) -> FloatArray:
    """Return axes (3, 3) of a camera that looks along a direction (3,): right, up, forward."""
    right = np.cross(forward, [0.0, 0.0, 1.0])
    axes = np.stack([right, np.cross(right, forward), forward])
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


# # --- static parts ----------------------------------------------------------------------------


def draw_room(server: Any, problem: Problem, floor_opacity: float | None = None) -> None:
    """Draw floor, walls, obstacles and mounts.

    If `floor_opacity` is None, nothing below the floor is visible.
    """
    scene = server.scene
    scene.configure_default_lights(cast_shadow=False)
    scene.add_light_ambient("/light", intensity=1.2)
    low, high = corners(problem)
    if not isinstance(problem.mounts, Shell):
        _draw_floor(scene, low, high, floor_opacity)
    if isinstance(problem.mounts, Walls):
        faces = _room_faces(*problem.mounts.bounds())
        # Visible from the inside only: the walls between camera and room are hidden.
        scene.add_mesh_simple(
            "/room/walls", *faces, color=WALL, opacity=0.35, side="back",
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        lines(scene, "/room/edges", box_edges(*problem.mounts.bounds()), INK, 1.5)
    elif isinstance(problem.mounts, Mounts):
        vertices, triangles = _mount_faces(problem.mounts)
        if len(triangles):
            scene.add_mesh_simple(
                "/room/mounts", vertices, triangles, color=(116, 143, 252), opacity=0.3,
                side="double", cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
    elif isinstance(problem.mounts, Shell):
        for name in ("inner_m", "outer_m"):
            circles = _circles(getattr(problem.mounts, name))
            lines(scene, f"/room/{name}", circles, EDGE, 1)
    else:
        lines(scene, "/room/edges", box_edges(*problem.mounts.bounds()), EDGE, 1)
    tall = low[2] + _TALL * (high - low)[2]
    for name, opacity, which in (("racks", 0.85, False), ("walls-within", 0.3, True)):
        shown = [s[:3] for s in solids(problem) if (s.high_m > tall) == which]
        if shown:
            faces = prism_mesh(*zip(*shown, strict=True))
            scene.add_mesh_simple(
                f"/room/{name}", *faces, color=RACK, opacity=opacity, flat_shading=True,
                side="double",
            )  # fmt: skip


def _draw_floor(scene: Any, low: FloatArray, high: FloatArray, opacity: float | None) -> None:
    """Draw a floor with a grid of whole metres, below everything else."""
    extent = float((high - low).max())
    floor = np.column_stack([rectangle(low, high), np.full(4, low[2] - 0.002 * extent)])
    scene.add_mesh_simple(
        "/room/floor", floor, np.array([[0, 1, 2], [0, 2, 3]]), color=FLOOR, side="double",
        opacity=opacity, cast_shadow=False, receive_shadow=False,
    )  # fmt: skip
    step = next(s for s in (1, 2, 5, 10, 50, 100, 1000, 1e9) if extent / s < 50)
    lines(scene, "/room/grid", _grid(low, high, step, floor[0, 2] + 3e-4 * extent), GRID, 1)


def _circles(radius: float) -> FloatArray:
    """Return segments (S, 2, 3) of three great circles of a sphere about the origin."""
    angle = np.linspace(0, 2 * np.pi, 97)
    found = []
    for axis in range(3):
        points = np.insert(np.stack([np.cos(angle), np.sin(angle)], axis=1), axis, 0.0, axis=1)
        found.append(np.stack([points[:-1], points[1:]], axis=1))
    return radius * np.concatenate(found)


def lines(scene: Any, name: str, segments: FloatArray, colour: Any, width: float) -> Any:
    """Draw segments (S, 2, 3) with a width in pixels."""
    return scene.add_line_segments(
        name, np.asarray(segments, np.float32), colour, thickness=width, thickness_units="screen"
    )


def _grid(low: FloatArray, high: FloatArray, step: float, z: float) -> FloatArray:
    """Return lines (S, 2, 3) at whole multiples of a step."""
    found = []
    for axis in (0, 1):
        for at in np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1) * step:
            ends = np.array([[low[0], low[1], z], [high[0], high[1], z]])
            ends[:, axis] = at
            found.append(ends)
    return np.array(found).reshape(-1, 2, 3)


def _room_faces(low: FloatArray, high: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Return walls and ceiling of a room, with their front sides outwards."""
    x, y, z = zip(low, high, strict=True)
    points = np.array([[x[i], y[j], z[k]] for k in (0, 1) for j in (0, 1) for i in (0, 1)])
    quads = [(0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6), (4, 5, 7, 6)]
    return points, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def _mount_faces(mounts: Mounts) -> tuple[FloatArray, np.ndarray]:
    """Return mounts as triangles: strips of walls, parts of ceilings; points are left out."""
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

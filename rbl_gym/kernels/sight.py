"""Information of links behind boxes and prisms; textbook forms in `rbl_gym.geometry.obstacles`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels.jit import gufunc, helper, inlined

# As in the textbook form, metres.
_TOUCH_M, _LEAST_WAY_M, _VERTICAL_M = 1e-9, 1e-6, 1e-12


@gufunc("(m,d),(p,d),(k,b)->(p,m)", "fffb")
def in_sight(anchors: Any, points: Any, boxes: Any, free: Any) -> None:
    """Compute whether no box of centres and half sizes is between each point and each anchor."""
    for p in range(points.shape[0]):
        for m in range(anchors.shape[0]):
            free[p, m] = True
            start, end = anchors[m], points[p]
            west, east = min(start[0], end[0]), max(start[0], end[0])
            south, north = min(start[1], end[1]), max(start[1], end[1])
            for k in range(boxes.shape[0]):
                if _is_beside(boxes, k, west, east, south, north):
                    continue
                if _blocks(boxes[k], start, end):
                    free[p, m] = False
                    break


@inlined
def _is_beside(boxes: Any, k: int, west: float, east: float, south: float, north: float) -> bool:
    """Return whether a segment between these limits certainly misses a box, as most do."""
    reach = boxes[k, 3] + _TOUCH_M
    if west > boxes[k, 0] + reach or east < boxes[k, 0] - reach:
        return True
    reach = boxes[k, 4] + _TOUCH_M
    return south > boxes[k, 1] + reach or north < boxes[k, 1] - reach


@helper
def _blocks(box: Any, start: Any, end: Any) -> bool:
    """Return whether a segment passes through the inside of a box; touching does not count."""
    enter, leave = 0.0, 1.0
    for i in range(3):
        along, away = end[i] - start[i], box[i] - start[i]
        low, high = (away - box[3 + i]) / along, (away + box[3 + i]) / along
        # Along a face the quotients are 0/0, and NaN never blocks.
        if low != low or high != high:
            return False
        enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
    return enter < leave


@gufunc("(d),(k,b),(q,v,e),(q,l)->()", "ffffb")
def held_by(point: Any, boxes: Any, corners: Any, limits: Any, held: Any) -> None:
    """Compute whether a box or a prism contains a point."""
    x, y, z = point[0], point[1], point[2]
    held[0] = False
    for k in range(boxes.shape[0]):
        if (
            abs(x - boxes[k, 0]) - boxes[k, 3] <= _TOUCH_M
            and abs(y - boxes[k, 1]) - boxes[k, 4] <= _TOUCH_M
            and abs(z - boxes[k, 2]) - boxes[k, 5] <= _TOUCH_M
        ):
            held[0] = True
            return
    for q in range(corners.shape[0]):
        if x < limits[q, 0] or x > limits[q, 1] or y < limits[q, 2] or y > limits[q, 3]:
            continue
        if z <= limits[q, 4] + _LEAST_WAY_M or z >= limits[q, 5] - _LEAST_WAY_M:
            continue
        if _holds(corners[q], x, y, _LEAST_WAY_M):
            held[0] = True
            return


@gufunc("(m,d),(p,d),(k,b),(q,v,e),(q,l),(),(g),(c),(n)->(p,m)", "fffffffiif")
def share_behind(
    anchors: Any,
    points: Any,
    boxes: Any,
    corners: Any,
    limits: Any,
    blocked: Any,
    cells: Any,
    starts: Any,
    members: Any,
    share: Any,
) -> None:
    """Compute the information fraction of each link behind boxes and prisms, cell by cell."""
    n_boxes, n_corners = boxes.shape[0], corners.shape[1]
    crossings = np.empty((2, n_corners))
    stops = np.empty(2 * n_corners + 2)
    # The last link that was tested against each obstacle.
    asked = np.full(n_boxes + corners.shape[0], -1)
    left, bottom, side = cells[0], cells[1], cells[2]
    n_columns, n_rows = int(cells[3]), int(cells[4])
    for p in range(points.shape[0]):
        for m in range(anchors.shape[0]):
            start, end = anchors[m], points[p]
            free, own, link = True, 1.0, p * anchors.shape[0] + m
            ax, ay, dx, dy = start[0], start[1], end[0] - start[0], end[1] - start[1]
            first = _cell_of(min(ax, end[0]), left, side, n_columns)
            last = _cell_of(max(ax, end[0]), left, side, n_columns)
            for column in range(first, last + 1):
                enter, leave = 0.0, 1.0
                if first < last:
                    # The part of the link in this column.
                    near, far = (
                        (left + column * side - ax) / dx,
                        (left + (column + 1) * side - ax) / dx,
                    )
                    if column > first:
                        enter = max(enter, near) if dx > 0.0 else enter
                        leave = min(leave, near) if dx < 0.0 else leave
                    if column < last:
                        leave = min(leave, far) if dx > 0.0 else leave
                        enter = max(enter, far) if dx < 0.0 else enter
                low = _cell_of(min(ay + enter * dy, ay + leave * dy), bottom, side, n_rows)
                high = _cell_of(max(ay + enter * dy, ay + leave * dy), bottom, side, n_rows)
                for row in range(low, high + 1):
                    cell = row * n_columns + column
                    for i in range(starts[cell], starts[cell + 1]):
                        k = members[i]
                        if asked[k] == link:
                            continue
                        asked[k] = link
                        q = k - n_boxes
                        if q < 0:
                            if free and _blocks(boxes[k], start, end):
                                free = False
                            continue
                        common = limits[q, 6] != limits[q, 6]
                        if (common and not free) or _is_past(limits, q, start, end, dx, dy):
                            continue
                        if _meets(start, end, corners, limits, q, crossings, stops):
                            if common:
                                free = False
                            else:
                                own *= limits[q, 6]
            share[p, m] = own if free else own * blocked


@inlined
def _cell_of(place: float, origin: float, side: float, count: int) -> int:
    """Return the row or column of cells that contains a coordinate."""
    cell = int(min(max((place - origin) / side, 0.0), count - 0.5))
    # NaN gets some cell.
    return min(max(cell, 0), count - 1)


@inlined
def _is_past(limits: Any, q: int, start: Any, end: Any, dx: float, dy: float) -> bool:
    """Return whether a segment certainly misses the bounding box of a prism."""
    ax, bx, ay, by = start[0], end[0], start[1], end[1]
    if min(ax, bx) >= limits[q, 1] or max(ax, bx) <= limits[q, 0]:
        return True
    if min(ay, by) >= limits[q, 3] or max(ay, by) <= limits[q, 2]:
        return True
    if min(start[2], end[2]) >= limits[q, 5] or max(start[2], end[2]) <= limits[q, 4]:
        return True
    # Or all of it is on one side of the segment's line in plan.
    off = dx * (limits[q, 2] + limits[q, 3] - 2.0 * ay)
    off -= dy * (limits[q, 0] + limits[q, 1] - 2.0 * ax)
    half = abs(dx) * (limits[q, 3] - limits[q, 2]) + abs(dy) * (limits[q, 1] - limits[q, 0])
    return abs(off) > half


@helper
def _meets(
    start: Any, end: Any, corners: Any, limits: Any, q: int, crossings: Any, stops: Any
) -> bool:
    """Return whether a segment passes through a prism; the last two arguments are overwritten."""
    dx, dy, dz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    enter, leave = 0.0, 1.0
    if dz != 0.0:
        low, high = (limits[q, 4] - start[2]) / dz, (limits[q, 5] - start[2]) / dz
        enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
    if not (leave - enter) * length > _LEAST_WAY_M:
        return False
    if dx * dx + dy * dy < _VERTICAL_M * _VERTICAL_M:
        return _holds(corners[q], start[0], start[1], _TOUCH_M)
    left, right = crossings[0], crossings[1]
    count = _crossings(start, dx, dy, corners, q, left, right)
    n_stops = 2
    stops[0], stops[1] = enter, leave
    for i in range(count):
        for side in range(2):
            at = crossings[side, i]
            if enter < at < leave:
                # Insert it in order.
                k = n_stops
                while k > 0 and stops[k - 1] > at:
                    stops[k] = stops[k - 1]
                    k -= 1
                stops[k] = at
                n_stops += 1
    for k in range(n_stops - 1):
        if (stops[k + 1] - stops[k]) * length > _LEAST_WAY_M:
            middle = 0.5 * (stops[k + 1] + stops[k])
            if _is_odd(left, middle, count) and _is_odd(right, middle, count):
                return True
    return False


@inlined
def _crossings(
    start: Any, dx: float, dy: float, corners: Any, q: int, left: Any, right: Any
) -> int:
    """Find where a line in plan crosses the edges, moved slightly to its left and to its right.

    Infinity if only one of the two crosses. Returns how many crossings there are.
    """
    ax, ay, reach = start[0], start[1], math.sqrt(dx * dx + dy * dy)
    last = corners.shape[1] - 1
    x, y = corners[q, last, 0] - ax, corners[q, last, 1] - ay
    ahead, side = dx * x + dy * y, dx * y - dy * x
    if abs(side) <= _TOUCH_M * reach:
        side = 0.0
    count = 0
    for i in range(corners.shape[1]):
        x, y = corners[q, i, 0] - ax, corners[q, i, 1] - ay
        next_ahead, next_side = dx * x + dy * y, dx * y - dy * x
        if abs(next_side) <= _TOUCH_M * reach:
            next_side = 0.0
        by_left, by_right = (side > 0) != (next_side > 0), (side >= 0) != (next_side >= 0)
        if by_left or by_right:
            if abs(side) <= abs(next_side):
                at = ahead + side / (side - next_side) * (next_ahead - ahead)
            else:
                at = next_ahead + next_side / (next_side - side) * (ahead - next_ahead)
            at /= reach * reach
            left[count] = at if by_left else math.inf
            right[count] = at if by_right else math.inf
            count += 1
        ahead, side = next_ahead, next_side
    return count


@inlined
def _is_odd(crossings: Any, place: float, count: int) -> bool:
    """Return whether an odd number of the crossings lies before a position."""
    odd = False
    for i in range(count):
        if crossings[i] < place:
            odd = not odd
    return odd


@helper
def _holds(polygon: Any, px: float, py: float, margin: float) -> bool:
    """Return whether a point in plan lies inside a polygon, and not within a margin of its edge."""
    odd = False
    last = polygon.shape[0] - 1
    ax, ay = polygon[last, 0] - px, polygon[last, 1] - py
    for i in range(polygon.shape[0]):
        bx, by = polygon[i, 0] - px, polygon[i, 1] - py
        dx, dy = bx - ax, by - ay
        square = dx * dx + dy * dy
        share = 0.0 if square == 0.0 else min(max(-(ax * dx + ay * dy) / square, 0.0), 1.0)
        if math.hypot(ax + share * dx, ay + share * dy) <= margin:
            return False
        if (ay > 0.0) != (by > 0.0) and ax - ay / dy * dx > 0.0:
            odd = not odd
        ax, ay = bx, by
    return odd

"""Which points anchors see past boxes; the textbook form is `rbl_gym.geometry.obstacles`."""

from __future__ import annotations

from typing import Any

from rbl_gym.kernels.jit import gufunc, helper


@gufunc("(m,d),(p,d),(k,b)->(p,m)", "fffb")
def in_sight(anchors: Any, points: Any, boxes: Any, free: Any) -> None:
    """Whether no box of centres and half sizes stands between each point and each anchor."""
    for p in range(points.shape[0]):
        for m in range(anchors.shape[0]):
            free[p, m] = True
            for k in range(boxes.shape[0]):
                if _blocks(boxes[k], anchors[m], points[p]):
                    free[p, m] = False
                    break


@helper
def _blocks(box: Any, start: Any, end: Any) -> bool:
    """Whether a segment runs inside a box; touching it is not enough."""
    enter, leave = 0.0, 1.0
    for i in range(3):
        along, away = end[i] - start[i], box[i] - start[i]
        low, high = (away - box[3 + i]) / along, (away + box[3 + i]) / along
        # Along a face the quotients are 0/0, and NaN never blocks.
        if low != low or high != high:
            return False
        enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
    return enter < leave

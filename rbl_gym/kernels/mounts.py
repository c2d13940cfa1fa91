"""The nearest point of mounts; the textbook form is `rbl_gym.geometry.mounts`."""

from __future__ import annotations

from typing import Any

from rbl_gym.kernels.jit import gufunc


@gufunc("(d),(k,c)->(d),()", "fffi")
def nearest_point(point: Any, pieces: Any, legal: Any, piece: Any) -> None:
    """Compute the nearest point of the pieces, and the index of its piece."""
    least, piece[0] = -1.0, 0
    px, py, pz = point[0], point[1], point[2]
    for k in range(pieces.shape[0]):
        z = min(max(pz, pieces[k, 6]), pieces[k, 7])
        up = (z - pz) * (z - pz)
        if least >= 0.0 and up >= least:
            continue
        off, x, y = -1.0, 0.0, 0.0
        n_left, n_right = 0, 0
        for i in range(3):
            j = 2 * ((i + 1) % 3)
            sx, sy = pieces[k, 2 * i], pieces[k, 2 * i + 1]
            ux, uy = pieces[k, j] - sx, pieces[k, j + 1] - sy
            vx, vy = px - sx, py - sy
            square = ux * ux + uy * uy
            share = (vx * ux + vy * uy) / (square if square > 0.0 else 1.0)
            share = min(max(share, 0.0), 1.0)
            spot_x, spot_y = sx + share * ux, sy + share * uy
            away = (spot_x - px) * (spot_x - px) + (spot_y - py) * (spot_y - py)
            if off < 0.0 or away < off:
                off, x, y = away, spot_x, spot_y
            side = ux * vy - uy * vx
            n_left += side > 0.0
            n_right += side < 0.0
        if n_left == 3 or n_right == 3:
            off, x, y = 0.0, px, py
        if least < 0.0 or off + up < least:
            least, piece[0] = off + up, k
            legal[0], legal[1], legal[2] = x, y, z

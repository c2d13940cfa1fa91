"""Check the edges of a network: pairs of node indices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbl_gym.checks import check_count

IntArray = NDArray[np.intp]
MOST_NODES = 10**9


def check_edges(edges: ArrayLike, n_nodes: int, name: str = "edges") -> IntArray:
    """Return `edges` as (m, 2) indices of two different nodes each; `name` is for the message.

    An edge may occur twice, in either direction, if it was measured twice. An empty sequence means
    no edges. ValueError if they are not pairs of integers in [0, n_nodes), or an edge joins a node
    to itself.
    """
    n_nodes = check_count("n_nodes", n_nodes, most=MOST_NODES)
    try:
        array = np.asarray(edges)
    except ValueError as error:
        raise ValueError(f"{name} must be integers of shape (m, 2), got {edges!r:.80}") from error
    if array.size == 0:
        return np.zeros((0, 2), dtype=np.intp)
    if array.ndim != 2 or array.shape[1] != 2 or array.dtype.kind not in "iu":
        raise ValueError(
            f"{name} must be integers of shape (m, 2), got {array.shape} of {array.dtype}"
        )
    array = array.astype(np.intp, copy=False)
    if array.min() < 0 or array.max() >= n_nodes:
        row = int(np.argmax(((array < 0) | (array >= n_nodes)).any(axis=1)))
        raise ValueError(
            f"{name} must join nodes 0 to {n_nodes - 1}, got {array[row].tolist()} at row {row}"
        )
    loops = array[:, 0] == array[:, 1]
    if loops.any():
        row = int(np.argmax(loops))
        raise ValueError(
            f"{name} must join two different nodes, got {array[row].tolist()} at row {row}"
        )
    return array

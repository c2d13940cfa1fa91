"""Analyse graphs of sensing networks: components, trees, incidence and cycle matrices, sparse.

Graphs are multigraphs: every row of `edges` (m, 2) is a separate edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import check_one_of
from rbl_gym.networks.edges import IntArray, check_edges

__all__ = ["BASES", "SpanningTree", "cycle_matrix", "incidence", "spanning_tree"]

BASES = ("bfs", "paton", "minimum")
CYCLES = (*BASES, "all")
_MOST_CYCLES = 100_000  # limit of "all"; a complete graph of 9 nodes has 62,814
_NAMED = 8  # nodes of a component listed in a message


class SpanningTree(NamedTuple):
    """A tree from node 0 over all nodes; for node 0 all entries are 0, its edge is -1."""

    parent: IntArray  # (n,)
    edge: IntArray  # (n,) row of `edges` that joins a node to its parent
    sign: IntArray  # (n,) +1 if that row runs from the parent to the node, else -1
    depth: IntArray  # (n,) edges up to node 0


def components(edges: ArrayLike, n_nodes: int) -> IntArray:
    """Return the label (n,) of the connected component of every node."""
    return scipy.sparse.csgraph.connected_components(
        _adjacency(check_edges(edges, n_nodes), n_nodes), directed=False
    )[1].astype(np.intp)


def check_connected(
    edges: ArrayLike, n_nodes: int, ids: Sequence[int] | np.ndarray | None = None
) -> IntArray:
    """Return checked `edges` of a connected graph.

    `ids` (n,) are the names of the nodes in the message; None: 0 to n - 1. ValueError if the graph
    has several components; the message names them.
    """
    edges = check_edges(edges, n_nodes)
    label = components(edges, n_nodes)
    if label.any():
        parts = np.bincount(label)
        order = np.argsort(-parts, kind="stable")
        names = np.arange(n_nodes) if ids is None else np.asarray(ids)
        named = [_name(names[label == part]) for part in order[:3]]
        more = f" and {len(parts) - 3} more" if len(parts) > 3 else ""
        raise ValueError(
            f"edges must connect all {n_nodes} nodes, got {len(parts)} components: "
            f"{', '.join(named)}{more}"
        )
    return edges


def _name(nodes: np.ndarray) -> str:
    listed = ", ".join(map(str, nodes[:_NAMED]))
    return "{" + listed + (f", ... {len(nodes)} nodes" if len(nodes) > _NAMED else "") + "}"


def _adjacency(edges: IntArray, n_nodes: int) -> scipy.sparse.csr_matrix:
    ones = np.ones(len(edges), dtype=np.int8)
    return scipy.sparse.csr_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(n_nodes, n_nodes))


def incidence(edges: ArrayLike, n_nodes: int) -> scipy.sparse.csr_matrix:
    """Return the incidence matrix B (m, n): ``B theta`` are ``theta_j - theta_i``."""
    edges = check_edges(edges, n_nodes)
    m = len(edges)
    values = np.tile([-1.0, 1.0], m)
    return scipy.sparse.csr_matrix(
        (values, edges.ravel(), 2 * np.arange(m + 1)), shape=(m, n_nodes)
    )


def spanning_tree(edges: ArrayLike, n_nodes: int) -> SpanningTree:
    """Return the breadth-first tree from node 0, neighbours in ascending order.

    Raises
    ------
    ValueError
        If the graph is not connected.
    """
    edges = check_connected(edges, n_nodes)
    return _tree(edges, _breadth_first(_neighbours(edges, n_nodes), 0))


def _neighbours(edges: IntArray, n_nodes: int) -> scipy.sparse.csr_matrix:
    graph = _adjacency(edges, n_nodes)
    both = scipy.sparse.csr_matrix(graph + graph.T)
    both.sort_indices()
    return both


def _breadth_first(graph: scipy.sparse.csr_matrix, root: int) -> IntArray:
    parent = scipy.sparse.csgraph.breadth_first_order(graph, root)[1].astype(np.intp)
    parent[root] = root
    return parent


def _tree(edges: IntArray, parent: IntArray) -> SpanningTree:
    edge, sign = _tree_edges(edges, parent)
    return SpanningTree(parent, edge, sign, sum_to_root(parent, np.arange(len(parent)) > 0))


def sum_to_root(parent: IntArray, values: np.ndarray) -> np.ndarray:
    """Return the sum (n,) of `values` along the path of every node to node 0, by path doubling."""
    total, up = values.astype(np.result_type(values, np.intp)), parent
    total[0] = 0
    while up.any():
        total, up = total + total[up], up[up]
    return total


def _tree_edges(edges: IntArray, parent: IntArray) -> tuple[IntArray, IntArray]:
    """Return row and sign of the edge to the parent; for parallel edges the first."""
    i, j = edges.T
    edge, sign = np.full(len(parent), -1, dtype=np.intp), np.zeros(len(parent), dtype=np.intp)
    # Written from the last row to the first, so that the first remains.
    down, up = (np.flatnonzero(parent[child] == above)[::-1] for child, above in ((j, i), (i, j)))
    down, up = down[j[down] != 0], up[i[up] != 0]
    edge[j[down]] = down
    first = np.full(len(parent), len(edges), dtype=np.intp)
    first[i[up]] = up
    edge = np.where((edge < 0) | (first < edge), np.where(first < len(edges), first, edge), edge)
    known = edge >= 0
    sign[known] = np.where(j[edge[known]] == np.flatnonzero(known), 1, -1)
    return edge, sign


def cycle_matrix(edges: ArrayLike, n_nodes: int, basis: str = "bfs") -> scipy.sparse.csr_matrix:
    """Return the cycle matrix C (q, m), entries -1, 0, 1: ``C B = 0`` (Definition 4).

    Parameters
    ----------
    edges, n_nodes
        A connected graph.
    basis
        ``"bfs"``: one cycle for each edge outside the breadth-first tree, in the direction of
        this edge from i to j. ``"paton"``: cycles from a tree that grows from the last node
        reached, each shortened where it meets a neighbour. ``"minimum"``: the cycles of least total
        length (Horton), for graphs of up to some hundred nodes. These are bases with q = m - n + 1
        (Theorem 5). ``"all"``: every cycle of a small graph once, in either direction.

    Raises
    ------
    ValueError
        If the graph is not connected (the message names the components), or has more than
        100,000 cycles if all are requested.
    """
    check_one_of("basis", basis, CYCLES)
    edges = check_connected(edges, n_nodes)
    if basis == "bfs":
        return fundamental_cycles(edges, spanning_tree(edges, n_nodes))
    return _OTHERS[basis](edges, n_nodes)


def check_cycles(
    cycles: ArrayLike | scipy.sparse.csr_matrix, edges: IntArray, n_nodes: int
) -> scipy.sparse.csr_matrix:
    """Return a checked user-defined cycle matrix (q, m); its rows may be linearly dependent.

    ValueError if it has another number of columns, or a row is not a closed walk that uses each
    edge once.
    """
    C = scipy.sparse.csr_matrix(cycles, dtype=np.float64, copy=True)
    if C.shape[1] != len(edges):
        raise ValueError(
            f"cycles must have {len(edges)} columns, one for each edge, got shape {C.shape}"
        )
    C.sum_duplicates()
    C.eliminate_zeros()
    if not (np.abs(C.data) == 1).all():
        wrong = C.data[np.abs(C.data) != 1][0]
        raise ValueError(f"cycles must have only the entries -1, 0 and 1, got {wrong:g}")
    open_ = np.unique((C @ incidence(edges, n_nodes)).nonzero()[0])
    if len(open_):
        raise ValueError(f"cycles must be closed walks, but row {open_[0]} is an open one")
    return C


def fundamental_cycles(edges: IntArray, tree: SpanningTree) -> scipy.sparse.csr_matrix:
    """Return one cycle for each edge outside a tree: i to j, and back along the tree."""
    outside = np.ones(len(edges), dtype=np.bool_)
    outside[tree.edge[1:]] = False
    closing = np.flatnonzero(outside)
    rows, columns, values = [np.arange(len(closing))], [closing], [np.ones(len(closing), int)]
    cycle, ends = np.arange(len(closing)), edges[closing].T.copy()
    while len(cycle):
        for end, sense in ((0, 1), (1, -1)):
            climbs = ends[end] != ends[1 - end]
            climbs &= tree.depth[ends[end]] >= tree.depth[ends[1 - end]] + end
            nodes = ends[end, climbs]
            rows.append(cycle[climbs])
            columns.append(tree.edge[nodes])
            values.append(sense * tree.sign[nodes])
            ends[end, climbs] = tree.parent[nodes]
        open_ = ends[0] != ends[1]
        cycle, ends = cycle[open_], ends[:, open_]
    entries = np.concatenate(values).astype(np.float64)
    shape = (len(closing), len(edges))
    C = scipy.sparse.csr_matrix(
        (entries, (np.concatenate(rows), np.concatenate(columns))), shape=shape
    )
    C.sort_indices()
    return C


def _paton_basis(edges: IntArray, n_nodes: int) -> scipy.sparse.csr_matrix:
    """Return cycles of Paton (1969): every edge that meets a node already reached closes one."""
    near: list[list[tuple[int, int]]] = [[] for _ in range(n_nodes)]
    for row, (i, j) in enumerate(edges.tolist()):
        near[i].append((j, row))
        near[j].append((i, row))
    parent, upward = {0: 0}, {0: -1}
    # For every reached node: the neighbours with a used edge, and this edge.
    used: list[dict[int, int]] = [{} for _ in range(n_nodes)]
    done, walks, stack = set(), [], [0]
    while stack:
        node = stack.pop()
        for other, row in near[node]:
            if row in done:
                continue
            done.add(row)
            if other not in parent:
                parent[other], upward[other] = node, row
                used[other][node] = row
                stack.append(other)
                continue
            # From `other` along the new edge to `node`, up the tree, and back to `other`.
            walk, at = [(other, row)], node
            while at not in used[other]:
                walk.append((at, upward[at]))
                at = parent[at]
            walks.append([*walk, (at, used[other][at])])
            used[other].setdefault(node, row)
    return _walked(walks, edges)


def _walked(walks: list[list[tuple[int, int]]], edges: IntArray) -> scipy.sparse.csr_matrix:
    """Return the cycle matrix of closed walks, lists of (node, row of the edge that leaves it)."""
    rows = [row for row, walk in enumerate(walks) for _ in walk]
    starts, columns = (
        np.array([step[k] for walk in walks for step in walk], dtype=np.intp) for k in (0, 1)
    )
    signs = np.where(edges[columns, 0] == starts, 1.0, -1.0)
    return scipy.sparse.csr_matrix((signs, (rows, columns)), shape=(len(walks), len(edges)))


def _all_cycles(edges: IntArray, n_nodes: int) -> scipy.sparse.csr_matrix:
    """Return every cycle from its smallest node, in the direction that leaves by the smaller row.

    A path is extended only if it can still return to its start, so that every branch has a cycle.
    """
    near: list[list[tuple[int, int]]] = [[] for _ in range(n_nodes)]
    beside = [0] * n_nodes  # neighbours, as bits
    for row, (i, j) in enumerate(edges.tolist()):
        near[i].append((j, row))
        near[j].append((i, row))
        beside[i] |= 1 << j
        beside[j] |= 1 << i

    def comes_back(node: int, start: int, free: int) -> bool:
        reached = new = 1 << node
        while new:
            if new & beside[start]:
                return True
            at = new.bit_length() - 1
            new ^= 1 << at
            found = beside[at] & free & ~reached
            reached |= found
            new |= found
        return False

    walks: list[list[tuple[int, int]]] = []
    for start in range(n_nodes):
        free = (1 << n_nodes) - (2 << start)
        nodes, rows, ways = [start], list[int](), [iter(near[start])]
        while ways:
            for other, row in ways[-1]:
                if other == start and rows and row > rows[0]:
                    walks.append(list(zip(nodes, [*rows, row], strict=True)))
                    if len(walks) > _MOST_CYCLES:
                        raise ValueError(
                            f"cycles 'all' needs a graph with at most {_MOST_CYCLES:,} cycles, "
                            "this one has more: use cycles 'bfs'"
                        )
                elif free >> other & 1 and comes_back(other, start, free ^ 1 << other):
                    free ^= 1 << other
                    nodes.append(other)
                    rows.append(row)
                    ways.append(iter(near[other]))
                    break
            else:
                ways.pop()
                left = nodes.pop()
                if rows:
                    rows.pop()
                    free |= 1 << left
    return _walked(walks, edges)


def _minimum_basis(edges: IntArray, n_nodes: int) -> scipy.sparse.csr_matrix:
    """Return Horton's basis: the shortest independent cycles of two shortest paths and an edge."""
    wanted = len(edges) - n_nodes + 1
    graph = _neighbours(edges, n_nodes)
    candidates = []
    for root in range(n_nodes):
        # Renumbered with the root as 0, where trees begin.
        swap = np.arange(n_nodes)
        swap[[0, root]] = root, 0
        named = swap[edges]
        tree = _tree(named, swap[_breadth_first(graph, root)][swap])
        C = fundamental_cycles(named, tree)
        lengths = np.diff(C.indptr)
        outside = np.setdiff1d(np.arange(len(edges)), tree.edge[1:])
        through = tree.depth[named[outside]].sum(axis=1) + 1 == lengths
        candidates += [(int(lengths[row]), root, row, C[row]) for row in np.flatnonzero(through)]
    candidates.sort(key=lambda candidate: candidate[:3])
    chosen: list[scipy.sparse.csr_matrix] = []
    # Cycles as bits of an int; independent modulo 2 implies independent.
    pivots: dict[int, int] = {}
    for *_, cycle in candidates:
        if len(chosen) == wanted:
            break
        bits = sum(1 << int(edge) for edge in cycle.indices)
        while bits and (top := bits.bit_length()) in pivots:
            bits ^= pivots[top]
        if bits:
            pivots[bits.bit_length()] = bits
            chosen.append(cycle)
    return (
        scipy.sparse.csr_matrix(scipy.sparse.vstack(chosen))
        if chosen
        else scipy.sparse.csr_matrix((0, len(edges)))
    )


_OTHERS = {"paton": _paton_basis, "minimum": _minimum_basis, "all": _all_cycles}

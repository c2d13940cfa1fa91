"""Sensing networks: bearings, edge angles, graphs, cycle bases, what is localizable."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
import pytest

from rbl_gym.geometry import rotations
from rbl_gym.networks import graphs, rigidity, sensing
from rbl_gym.networks.graphs import BASES, components, cycle_matrix, incidence, spanning_tree
from rbl_gym.networks.sensing import edge_angles, proj, random_network, unit_disk_edges
from tests.helpers import load

GOLDEN = load("network_golden.json")
every_case = pytest.mark.parametrize("case", GOLDEN["cases"], ids=["5", "16", "31"])
# Parallel edges, in both directions, and a triangle.
MULTI = np.array([[0, 1], [1, 2], [2, 0], [1, 0], [2, 3], [0, 1], [3, 2], [3, 0]])


def graph(edges, n_nodes):
    built = nx.MultiGraph()
    built.add_nodes_from(range(n_nodes))
    built.add_edges_from(np.asarray(edges).tolist())
    return built


def networks(count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield random_network(int(rng.integers(8, 60)), rng.uniform(3, 9), 0.1, rng)


# --- angles -----------------------------------------------------------------------------------


def test_proj_is_half_open_and_exact_inside():
    assert float(proj(np.pi)) == -np.pi
    assert float(proj(-np.pi)) == -np.pi
    below = np.nextafter(np.pi, 0)
    assert float(proj(below)) == below
    rng = np.random.default_rng(0)
    angles = np.concatenate([rng.uniform(-np.pi, np.pi, 1000), [-1e-17, 0.0, 5e-324]])
    np.testing.assert_array_equal(proj(angles), angles)
    edges = np.pi * np.arange(-9, 10, 2)
    for spot in (edges, np.nextafter(edges, 99), np.nextafter(edges, -99), 50 * angles):
        wrapped = proj(spot)
        assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
        np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * spot), atol=1e-13)


@every_case
def test_edge_angles_of_the_reference(case):
    np.testing.assert_allclose(
        edge_angles(np.column_stack([case["a"], case["b"]])), case["y"], atol=1e-12
    )


def test_exact_bearings_give_differences_of_orientations_and_noise_has_its_variance():
    rng = np.random.default_rng(1)
    network = random_network(400, 10, 0.0, rng)
    i, j = network.edges.T
    truth = network.orientations[j] - network.orientations[i]
    np.testing.assert_allclose(proj(network.y - truth), 0, atol=1e-12)
    measured = sensing.measure_bearings(*network[:3], 0.2, rng)
    off = proj(measured - network.bearings)
    assert np.std(off) == pytest.approx(0.2, rel=0.05)
    assert np.var(proj(edge_angles(measured) - truth)) == pytest.approx(2 * 0.2**2, rel=0.1)


def test_unit_disk_edges_by_hand():
    rng = np.random.default_rng(2)
    positions = rng.uniform(0, 5, (40, 2))
    apart = np.linalg.norm(positions[:, None] - positions, axis=-1)
    want = [(i, j) for i in range(40) for j in range(i + 1, 40) if 0.4 <= apart[i, j] <= 1.3]
    assert unit_disk_edges(positions, 1.3, 0.4).tolist() == [list(pair) for pair in want]
    assert unit_disk_edges(positions, 0.0).shape == (0, 2)


# --- graphs -----------------------------------------------------------------------------------


@every_case
def test_breadth_first_basis_of_the_reference(case):
    C = cycle_matrix(case["E"], len(case["P"]))
    for row, want in zip(C.toarray(), case["basis_bfs"], strict=True):
        assert [[int(k), int(row[k])] for k in np.flatnonzero(row)] == want


@pytest.mark.parametrize("basis", BASES)
def test_cycles_are_cycles_and_a_basis(basis):
    multi = [(MULTI, 4)]
    for edges, n_nodes in multi + [(one.edges, len(one.positions)) for one in networks(10)]:
        C = cycle_matrix(edges, n_nodes, basis)
        assert C.shape == (len(edges) - n_nodes + 1, len(edges))
        if C.shape[0]:
            assert np.abs((C @ incidence(edges, n_nodes)).toarray()).max() == 0
            assert np.linalg.matrix_rank(C.toarray()) == C.shape[0]
            assert set(np.unique(C.data)) <= {-1.0, 1.0}


def test_minimum_basis_is_as_short_as_networkxs_and_patons_as_patons():
    for one in networks(8, seed=3):
        known = nx.Graph(one.edges.tolist())
        n_nodes = len(one.positions)
        shortest = sum(map(len, nx.minimum_cycle_basis(known)))
        assert cycle_matrix(one.edges, n_nodes, "minimum").nnz == shortest
        assert shortest <= cycle_matrix(one.edges, n_nodes, "paton").nnz


def test_all_cycles_are_those_of_brute_force():
    """Every connected set of edges that meets each of its nodes twice; parallel edges too."""
    rng = np.random.default_rng(5)
    for n_nodes, m in ((3, 3), (4, 6), (5, 8), (5, 9), (6, 9)):
        pairs = np.array(list(itertools.combinations(range(n_nodes), 2)))
        edges = np.concatenate(
            [[[k, k + 1] for k in range(n_nodes - 1)], rng.choice(pairs, m - n_nodes + 1)]
        )
        want = set()
        for size in range(2, n_nodes + 1):
            for rows in itertools.combinations(range(m), size):
                nodes, degree = np.unique(edges[list(rows)], return_counts=True)
                names = np.searchsorted(nodes, edges[list(rows)])
                if (degree == 2).all() and not components(names, len(nodes)).any():
                    want.add(rows)
        C = cycle_matrix(edges, n_nodes, "all")
        assert abs(C @ incidence(edges, n_nodes)).sum() == 0
        assert sorted(tuple(np.flatnonzero(row)) for row in C.toarray()) == sorted(want)


def test_the_complete_graphs_have_the_cycles_that_they_have():
    for n_nodes, count in ((3, 1), (4, 7), (5, 37), (6, 197), (7, 1172)):
        pairs = np.array(list(itertools.combinations(range(n_nodes), 2)))
        C = cycle_matrix(pairs, n_nodes, "all")
        assert C.shape == (count, len(pairs))
        assert np.linalg.matrix_rank(C.toarray()) == len(pairs) - n_nodes + 1
    with pytest.raises(ValueError, match="at most 100,000 cycles"):
        cycle_matrix(list(itertools.combinations(range(12), 2)), 12, "all")


def test_a_long_chain_of_triangles_and_a_ring_are_listed_at_once():
    """No search among dead ends: 100 triangles in a row, and a ring of 300 nodes."""
    chain = [edge for k in range(0, 200, 2) for edge in ((k, k + 1), (k + 1, k + 2), (k, k + 2))]
    assert cycle_matrix(chain, 201, "all").shape == (100, 300)
    ring = np.column_stack([np.arange(300), np.roll(np.arange(300), -1)])
    assert cycle_matrix(ring, 300, "all").nnz == 300


def test_components_and_tree_as_networkx():
    rng = np.random.default_rng(4)
    positions = rng.uniform(0, 8, (60, 2))
    edges = unit_disk_edges(positions, 1.0)
    label = components(edges, 60)
    for part in nx.connected_components(graph(edges, 60)):
        assert len(set(label[list(part)])) == 1
    assert label.max() + 1 == nx.number_connected_components(graph(edges, 60)) > 1
    one = random_network(200, 8, 0.1, rng)
    tree = spanning_tree(one.edges, len(one.positions))
    depth = nx.single_source_shortest_path_length(graph(one.edges, len(one.positions)), 0)
    assert tree.depth.tolist() == [depth[k] for k in range(len(one.positions))]
    ends = one.edges[tree.edge[1:]]
    for node, (end, sign) in enumerate(zip(ends, tree.sign[1:], strict=True), start=1):
        assert end.tolist() == [tree.parent[node], node][::sign]


def test_trivial_graphs():
    for basis in BASES:
        assert cycle_matrix([], 1, basis).shape == (0, 0)
        assert cycle_matrix([[1, 0]], 2, basis).shape == (0, 1)
        assert cycle_matrix([[1, 0], [0, 1]], 2, basis).toarray().tolist() in (
            [[1.0, 1.0]],
            [[-1.0, -1.0]],
        )


@pytest.mark.parametrize(
    ("edges", "n_nodes", "message"),
    [
        ([[0, 1], [2, 3]], 4, r"2 components: \{0, 1\}, \{2, 3\}"),
        ([[0, 1]], 3, r"\{0, 1\}, \{2\}"),
        ([[0, 0]], 1, "two different nodes, got \\[0, 0\\] at row 0"),
        ([[0, 1], [1, 5]], 3, "nodes 0 to 2, got \\[1, 5\\] at row 1"),
        ([[0, -1]], 3, "nodes 0 to 2"),
        ([[0.0, 1.0]], 3, "must be integers"),
        ([0, 1], 3, "shape \\(m, 2\\)"),
        ([[0, 1]], 0, "n_nodes"),
        ([[0, 1]], True, "n_nodes"),
    ],
)
def test_wrong_graphs_are_named(edges, n_nodes, message):
    with pytest.raises(ValueError, match=message):
        graphs.check_connected(edges, n_nodes)


def test_wrong_numbers_are_named():
    with pytest.raises(ValueError, match="positions must be finite, got nan"):
        unit_disk_edges([[0, np.nan]], 1)
    with pytest.raises(ValueError, match=r"nodes \[0, 1\] are the same"):
        sensing.directions([[0, 0], [0, 0]], [[0, 1]])
    with pytest.raises(ValueError, match="bearings must have shape"):
        edge_angles([[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match="basis must be one of"):
        cycle_matrix([[0, 1]], 2, "longest")


# --- what is localizable ----------------------------------------------------------------------


@every_case
def test_parallel_rigidity_ranks_of_the_reference(case):
    assert (
        list(rigidity.parallel_rigidity_rank(case["P"], case["E"]))
        == case["parallel_rigidity_rank"]
    )


def test_sparse_and_dense_ranks_agree(monkeypatch):
    for one in networks(6, seed=5):
        dense = rigidity.parallel_rigidity_rank(one.positions, one.edges)
        matrix = rigidity.parallel_rigidity_matrix(one.positions, one.edges).toarray()
        assert dense[0] == np.linalg.matrix_rank(matrix, tol=1e-6)
        with monkeypatch.context() as patch:
            patch.setattr(rigidity, "_DENSE", 0)
            assert rigidity.parallel_rigidity_rank(one.positions, one.edges) == dense


def test_localizability_names_what_is_missing():
    positions = np.random.default_rng(6).uniform(size=(4, 2))
    square = [[0, 1], [1, 2], [2, 3], [3, 0]]
    found = rigidity.localizability(positions, square)
    assert found.orientations
    assert not found.frames
    with pytest.raises(ValueError, match=r"\(rank 5\), got rank 4: add edges"):
        rigidity.check_frames(positions, square)
    rigidity.check_frames(positions, [*square, [0, 2]])
    with pytest.raises(ValueError, match=r"components: \{0, 1, 2\}, \{3\}"):
        rigidity.check_frames(positions, [[0, 1], [1, 2], [0, 2]])


# --- space ------------------------------------------------------------------------------------


def seen(R, p, a, b):
    """Unit bearing of node b in the frame of node a."""
    return R[a].T @ (p[b] - p[a]) / np.linalg.norm(p[b] - p[a])


def test_feasible_rotations_are_the_ones_that_two_bearings_allow():
    rng = np.random.default_rng(7)
    R, p = rotations.random(rng, (2,)), rng.standard_normal((2, 3))
    u, v = seen(R, p, 0, 1), seen(R, p, 1, 0)
    start, axis = rigidity.feasible_rotations(u, v)
    for phi in rng.uniform(-3, 3, 5):
        np.testing.assert_allclose(rotations.exp(phi * axis) @ start @ v, -u, atol=1e-14)
    # The truth is one of them: it differs from R_0 by a turn about the axis.
    turn = rotations.log(R[0].T @ R[1] @ start.T)
    np.testing.assert_allclose(np.cross(turn, axis), 0, atol=1e-12)


@pytest.mark.parametrize("u", [[1, 0, 0], [0, 1, 0], [0, 0, -1], [0.6, 0, 0.8], [1, 1, 1]])
def test_feasible_rotations_in_both_degenerate_cases(u):
    u = np.array(u) / np.linalg.norm(u)
    np.testing.assert_array_equal(rigidity.feasible_rotations(u, -u)[0], np.eye(3))
    half = rigidity.feasible_rotations(u, u)[0]
    np.testing.assert_allclose(half @ u, -u, atol=1e-14)
    np.testing.assert_allclose(half @ half.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(half) == pytest.approx(1)
    near = rotations.exp([1e-9, 2e-9, -1e-9]) @ u
    np.testing.assert_allclose(rigidity.feasible_rotations(u, near)[0] @ near, -u, atol=1e-12)


def test_a_triangle_leaves_nothing_free():
    rng = np.random.default_rng(8)
    for _ in range(20):
        R, p = rotations.random(rng, (3,)), rng.standard_normal((3, 3))
        got = rigidity.triangle_rotation(
            seen(R, p, 0, 1), seen(R, p, 1, 0), seen(R, p, 0, 2), seen(R, p, 1, 2)
        )
        np.testing.assert_allclose(got, R[0].T @ R[1], atol=1e-10)
    p[2] = 2 * p[1] - p[0]
    with pytest.raises(ValueError, match="collinear"):
        rigidity.triangle_rotation(
            seen(R, p, 0, 1), seen(R, p, 1, 0), seen(R, p, 0, 2), seen(R, p, 1, 2)
        )


def test_what_stays_free_in_space():
    positions = np.random.default_rng(9).standard_normal((6, 3))

    def free(n_nodes, edges):
        found = rigidity.freedom(positions[:n_nodes], edges)
        return found.free, found.free_orientations

    # Paths: a turn about every edge, and from the second on its length.
    assert [free(n, [[k, k + 1] for k in range(n - 1)]) for n in (2, 3, 4)] == [
        (1, 1),
        (3, 2),
        (5, 3),
    ]
    assert free(1, []) == (0, 0)
    assert free(3, [[0, 1], [1, 2], [0, 2]]) == (0, 0)
    # Rings have 4 n measurements for 6 n - 7 unknowns.
    for n in (4, 5, 6):
        assert free(n, [[k, (k + 1) % n] for k in range(n)]) == (2 * n - 7, n - 3)
    # Triangles side by side.
    assert free(4, [[0, 1], [1, 2], [0, 2], [1, 3], [2, 3]]) == (0, 0)

"""Test what the measurements of a network determine: orientations, frames, remaining freedom.

In the plane, orientations need a connected graph of bearings. Frames up to scale need a parallel
rigid one, whose rigidity matrix has rank 2 n - 3. In space, bearings do not determine the rotation
about the line of sight, unless triangles do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.geometry import rotations
from rbl_gym.networks.bounds import bearing_jacobian, range_jacobian, space_jacobian, sparse_rows
from rbl_gym.networks.edges import check_edges
from rbl_gym.networks.graphs import check_connected, components
from rbl_gym.networks.sensing import check_positions, directions_of

__all__ = [
    "Freedom", "Localizability", "feasible_rotations", "freedom", "localizability",
    "parallel_rigidity_matrix", "parallel_rigidity_rank", "triangle_rotation",
]  # fmt: skip

# Smaller eigenvalues of a Gram matrix of unit rows count as zero.
_ZERO = 1e-10
_DENSE = 400


class Localizability(NamedTuple):
    """The quantities that the bearings of a planar network determine."""

    components: int  # 1: the orientations are determined, relative to one node
    rank: int  # of the rigidity matrix
    full_rank: int  # 2 n - 3: all frames, up to a shift, a rotation and a scale

    @property
    def orientations(self) -> bool:
        """Return whether all orientations are determined."""
        return self.components == 1

    @property
    def frames(self) -> bool:
        """Return whether all frames are determined if one length is known."""
        return self.orientations and self.rank == self.full_rank


def parallel_rigidity_matrix(positions: ArrayLike, edges: ArrayLike) -> scipy.sparse.csr_matrix:
    """Return the rows (m, 2 n) whose null space are node shifts that keep all edge directions.

    This holds to first order. The row of edge (i, j) is ``u' (dp_j - dp_i)``, with u' the unit
    vector perpendicular to it. Columns are x and y of node 0, then of node 1, and so on.
    """
    positions = check_positions(positions)
    edges = check_edges(edges, len(positions))
    toward = directions_of(positions, edges)
    across = np.column_stack([-np.sin(toward), np.cos(toward)])
    columns = (2 * edges[:, :, None] + [0, 1]).reshape(-1, 4)
    return sparse_rows(np.concatenate([-across, across], axis=1), columns, 2 * len(positions))


def parallel_rigidity_rank(positions: ArrayLike, edges: ArrayLike) -> tuple[int, int]:
    """Return the rank of `parallel_rigidity_matrix`, and the full rank 2 n - 3."""
    R = parallel_rigidity_matrix(positions, edges)
    n_nodes = R.shape[1] // 2
    return 2 * n_nodes - _null_dimension(R), max(2 * n_nodes - 3, 0)


def localizability(positions: ArrayLike, edges: ArrayLike) -> Localizability:
    """Return what the bearings of a planar network determine at these positions."""
    positions = check_positions(positions)
    parts = int(components(edges, len(positions)).max()) + 1
    return Localizability(parts, *parallel_rigidity_rank(positions, edges))


def check_frames(positions: ArrayLike, edges: ArrayLike) -> None:
    """Raise ValueError unless bearings and one length determine all frames (Proposition 16).

    Raises
    ------
    ValueError
        If the graph is not connected, or not parallel rigid at these positions; the message
        names the components or the missing rank.
    """
    check_connected(edges, len(check_positions(positions)))
    rank, full = parallel_rigidity_rank(positions, edges)
    if rank < full:
        raise ValueError(
            f"edges must make the network parallel rigid (rank {full}), got rank {rank}: add edges"
        )


def check_joint(positions: ArrayLike, edges: ArrayLike, ranged: ArrayLike) -> None:
    """Raise ValueError unless bearings of `edges` and ranges of `ranged` determine all frames.

    Raises
    ------
    ValueError
        If they do not at these positions; the message names the missing rank.
    """
    J = scipy.sparse.vstack([bearing_jacobian(positions, edges), range_jacobian(positions, ranged)])
    full = J.shape[1] - 3
    missing = _null_dimension(scipy.sparse.csr_matrix(J)) - 3
    if missing:
        raise ValueError(
            f"edges and ranges must determine all frames (rank {full}), got rank {full - missing}: "
            "add edges or ranges"
        )


def _null_dimension(R: scipy.sparse.csr_matrix) -> int:
    """Return the dimension of the null space, from the zero eigenvalues of ``R^T R``."""
    gram = scipy.sparse.csc_matrix(R.T @ R)
    size = gram.shape[0]
    if size <= _DENSE:
        return int((np.linalg.eigvalsh(gram.toarray()) < _ZERO).sum())
    wanted = 8
    start = np.random.default_rng(0).standard_normal(size)
    while wanted < size - 1:
        # The shift keeps the matrix definite; Lanczos then finds the smallest first.
        found = scipy.sparse.linalg.eigsh(
            gram, k=wanted, sigma=-1e-7, v0=start, return_eigenvectors=False
        )
        if (free := int((found < _ZERO).sum())) < wanted:
            return free
        wanted *= 4
    return int((np.linalg.eigvalsh(gram.toarray()) < _ZERO).sum())


# --- space ------------------------------------------------------------------------------------


class Freedom(NamedTuple):
    """The freedom left by bearings in space, besides shift, rotation and scale of the whole."""

    rank: int  # of the rigidity matrix (2 rows a bearing, 6 columns a node)
    free: int  # 6 n - 7 - rank: motions of frames that change no bearing
    free_orientations: int  # of the orientations


def feasible_rotations(u_ij: ArrayLike, u_ji: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return rotations from frame j to frame i that agree with their two bearings (Lemma 13).

    They are ``exp(phi [u_ij]x) R_0`` with any phi: the bearings do not determine the rotation about
    the line of sight.

    Parameters
    ----------
    u_ij, u_ji
        (3,) bearing of j in the frame of i, and of i in the frame of j; normalised here.

    Returns
    -------
    R_0
        (3, 3), the smallest rotation with ``R_0 u_ji = -u_ij``. Degenerate cases: the identity
        for ``u_ji = -u_ij``; for ``u_ji = u_ij`` a rotation by 180 degrees about any axis
        perpendicular to it, as all are equally small.
    axis
        (3,) axis of the free rotation, ``u_ij``.
    """
    axis, other = _unit("u_ij", u_ij), _unit("u_ji", u_ji)
    across = np.cross(other, -axis)
    sine, cosine = float(np.linalg.norm(across)), float(other @ -axis)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3), axis
        helper = np.eye(3)[np.argmin(np.abs(axis))]
        across = np.cross(axis, helper)
        return rotations.exp(np.pi * across / np.linalg.norm(across)), axis
    return rotations.exp(np.arctan2(sine, cosine) * across / sine), axis


def triangle_rotation(
    u_ij: ArrayLike, u_ji: ArrayLike, u_ik: ArrayLike, u_jk: ArrayLike
) -> FloatArray:
    """Return the rotation (3, 3) from frame j to frame i if both also see k.

    The frames share the line of sight and the normal of the plane of the triangle, which determine
    the rotation. With noise, the line of sight is kept and the normals are fitted.

    Parameters
    ----------
    u_ij, u_ik
        Directions (3,) in which i sees j and k, in the frame of i.
    u_ji, u_jk
        The same for j.

    Raises
    ------
    ValueError
        If the three nodes lie on one line: there is no plane.
    """
    axis, other = _unit("u_ij", u_ij), _unit("u_ji", u_ji)
    normal_i = np.cross(axis, _unit("u_ik", u_ik))
    # Seen from j, the triangle has the opposite orientation.
    normal_j = np.cross(_unit("u_jk", u_jk), other)
    for name, normal in (("u_ik", normal_i), ("u_jk", normal_j)):
        if np.linalg.norm(normal) < 1e-9:
            raise ValueError(
                f"{name} must not be parallel to the line between i and j: the nodes are collinear"
            )
    return _triad(axis, normal_i) @ _triad(-other, normal_j).T


def _triad(direction: FloatArray, normal: FloatArray) -> FloatArray:
    third = normal / np.linalg.norm(normal)
    return np.column_stack([direction, third, np.cross(direction, third)])


def _unit(name: str, vector: ArrayLike) -> FloatArray:
    array = check_array(name, vector, (3,))
    length = float(np.linalg.norm(array))
    if array.shape != (3,) or length == 0:
        raise ValueError(f"{name} must be one nonzero vector, got {array!r:.80}")
    return array / length


def freedom(positions: ArrayLike, edges: ArrayLike) -> Freedom:
    """Return the freedom left by mutual bearings in space at these positions.

    Parameters
    ----------
    positions
        (n, 3) metres.
    edges
        (m, 2), both nodes of an edge measure the other's direction in their own frame.
    """
    matrix = space_jacobian(positions, edges)
    n_nodes = matrix.shape[1] // 6
    values, vectors = np.linalg.eigh(matrix.T @ matrix)
    null = vectors[:, values < _ZERO * max(1.0, values[-1])]
    turns = np.linalg.matrix_rank(null[3 * n_nodes :], tol=1e-6)
    rank = 6 * n_nodes - null.shape[1]
    # A single node has no size, and so no scale.
    return Freedom(rank, max(6 * n_nodes - 7 - rank, 0), int(turns) - 3)

"""Information and scores at poses that many problems share, along the problems.

Problems differ in where the body and the anchors are, not in the body's rotations and tags, so
that what depends on those alone is computed once. Arrays end in the problems (B).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray
from rbl_gym.measurements.ranging import NoiseLaw

# The six entries of a symmetric 3 x 3 matrix.
_ENTRIES = [(i, j) for i in range(3) for j in range(i, 3)]


@dataclass(frozen=True, eq=False)
class SharedPoses:
    """Rotations (P, 3, 3) of a body with tags (N, 3)."""

    rotation: FloatArray
    tags: FloatArray

    @functools.cached_property
    def turned(self) -> FloatArray:
        """Tags (P, N, 3) as the poses turn them."""
        return self.tags @ np.swapaxes(self.rotation, -1, -2)

    @functools.cached_property
    def lift(self) -> FloatArray:
        """(P, 36, 6 N): pose information by the six entries of that about each tag's place."""
        J = bounds.tag_jacobian(self.rotation, self.tags)
        products = np.einsum("pnia,pnjb->pabnij", J, J)
        products = products + np.where(np.eye(3, dtype=bool), 0, np.swapaxes(products, -1, -2))
        rows, columns = zip(*_ENTRIES, strict=True)
        return products[..., rows, columns].reshape((len(J), 36, -1))

    @functools.cached_property
    def spread(self) -> FloatArray:
        """C (6, 6, P) with ``C C^T = mean_n J_n^T J_n``: how a pose error moves the tags."""
        J = bounds.tag_jacobian(self.rotation, self.tags)
        values, vectors = np.linalg.eigh(np.einsum("pnki,pnkj->pij", J, J) / J.shape[1])
        return np.moveaxis(vectors * np.sqrt(np.maximum(values, 0.0))[:, None], 0, -1).copy()

    def information(
        self, away: Sequence[FloatArray], noise: NoiseLaw, share: FloatArray | None = None
    ) -> FloatArray:
        """Fisher information (6, 6, P, B), ``sum_n J_n^T U_n J_n`` with ``U_n = sum_m w u u^T``.

        Parameters
        ----------
        away
            Three components (P, M, B) of the body's place less the anchor's, metres.
        noise
            Law of the ranges.
        share
            What each link keeps of its information, (P, M, B); None: all.
        """
        tags = self.turned[..., None, None]
        d = [away[i][:, None] + tags[:, :, i] for i in range(3)]
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        # The laws know the tags as the last axis.
        variance = noise.variance(np.moveaxis(np.sqrt(square), 1, -1))
        # Where an anchor stands on a tag the range has no gradient: that link tells nothing.
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = np.where(square > 0, 1 / (np.moveaxis(variance, -1, 1) * square), 0.0)
        if share is not None:
            weight *= share[:, None]
        weighted = [weight * component for component in d]
        of_tags = np.empty((*square.shape[:2], 6, square.shape[-1]))
        for k, (i, j) in enumerate(_ENTRIES):
            np.einsum("pnmb,pnmb->pnb", weighted[i], d[j], out=of_tags[:, :, k])
        lifted = self.lift @ of_tags.reshape((len(of_tags), -1, of_tags.shape[-1]))
        return np.moveaxis(lifted.reshape((len(lifted), 6, 6, -1)), 0, 2)

    def mean_square(self, information: FloatArray) -> FloatArray:
        """Mean (B,) of b^2 over the poses, of regularised information (6, 6, P, B).

        With ``A = L L^T`` and ``mean_n J_n^T J_n = C C^T``, b^2 = mean_n tr(J_n A^-1 J_n^T) is the
        sum of squares of ``L^-1 C``: elimination on ``[A | C]``. NaN if A is not positive.
        """
        A, C = np.ascontiguousarray(information), self.spread[..., None]
        square = np.zeros(A.shape[2:])
        with np.errstate(divide="ignore", invalid="ignore"):
            while len(A):
                root = 1 / np.sqrt(A[0, 0])
                column, row = A[1:, 0] * root, C[0] * root
                square += (row * row).sum(axis=0)
                A = A[1:, 1:] - column[:, None] * column
                C = C[1:] - column[:, None] * row
        return np.asarray(square.mean(axis=0))

"""Ranges of a log and biases of their links, in the form the smoother uses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.costs.losses import SQUARES, expected_square, loss_of
from rbl_gym.estimators.costs.range_cost import offset_of
from rbl_gym.estimators.smoothing.equations import Equations, LogState, Rows
from rbl_gym.measurements.direction_bias import DirectionLaw, direction_bias
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.measurements.offsets import axes_of

# Least fraction of a bias that is new after an interval, for two epochs at the same time.
_LEAST_NEW = 1e-12


class BiasBlock(NamedTuple):
    """Biases of one kind: one per link, one common to all links, or clock offsets.

    `where` is their slice of the extra states of an epoch, or of the constants; `of_link` the index
    of the bias of each of the M N links; `std` in metres. `time_s` is the correlation time of the
    drift; None: constant biases; infinite: clock offsets (`clocks`).
    """

    where: slice
    of_link: np.ndarray
    std: float
    time_s: float | None


def bias_blocks(
    laws: tuple[LinkBias, ...], links: int, extra: int, constants: int
) -> tuple[list[BiasBlock], int, int]:
    """Return the block of each law, and the numbers of extra states and constants.

    Parameters
    ----------
    laws, links
        Laws of the biases, which add up, and the number of links.
    extra, constants
        Numbers of extra states and constants that precede them.
    """
    blocks: list[BiasBlock] = []
    for law in laws:
        for each, std in ((True, law.std_m), (False, law.common_std_m)):
            if std == 0:
                continue
            of_link = np.arange(links) if each else np.zeros(links, dtype=np.intp)
            size = links if each else 1
            start = constants if law.time_s is None else extra
            blocks.append(BiasBlock(slice(start, start + size), of_link, std, law.time_s))
            if law.time_s is None:
                constants += size
            else:
                extra += size
    return blocks, extra, constants


def bias_of(blocks: list[BiasBlock], state: LogState, links: int) -> FloatArray:
    """Return the sum (..., K, links) of all biases of a state, metres."""
    total = np.zeros((*state.translation.shape[:-1], links))
    for block in blocks:
        values = state.extra
        if block.time_s is None:
            values = state.constants[..., None, :]
        if block.time_s != np.inf:
            total += values[..., block.where][..., block.of_link]
    return total


def add_biases(
    equations: Equations, blocks: list[BiasBlock], state: LogState, times: FloatArray
) -> None:
    """Add the priors of the biases and their drift, Gauss-Markov processes of the same variance."""
    for block in blocks:
        where, std = block.where, block.std
        if block.time_s == np.inf:
            continue
        if block.time_s is None:
            equations.add_constants_prior(where, state.constants[..., where], np.asarray(std))
            continue
        value, shifted = state.extra[..., where], slice(6 + where.start, 6 + where.stop)
        equations.add_prior(shifted, value[..., 0, :], np.asarray(std))
        elapsed = np.diff(times)[..., None] / block.time_s
        kept, new = np.exp(-elapsed), np.maximum(-np.expm1(-2 * elapsed), _LEAST_NEW)
        weight = 1 / (new * std**2)
        residual = value[..., 1:, :] - kept * value[..., :-1, :]
        equations.cost += 0.5 * (weight * residual**2).sum(axis=(-2, -1))
        at = range(shifted.start, shifted.stop)
        equations.diagonal[..., :-1, at, at] += weight * kept**2
        equations.diagonal[..., 1:, at, at] += weight
        equations.above[..., :-1, at, at] -= weight * kept
        equations.gradient[..., :-1, shifted] -= weight * kept * residual
        equations.gradient[..., 1:, shifted] += weight * residual


class Layout(NamedTuple):
    """A model of biases by direction, anchors (..., K or 1, M, 3) and tags (N, 3)."""

    law: DirectionLaw
    anchors: FloatArray
    tags: FloatArray


@dataclass(frozen=True, eq=False)
class LogRanges:
    """The measured ranges, packed to at most S per epoch.

    Attributes
    ----------
    link
        (..., K, S), index of the link among M N.
    ranges, weights
        (..., K, S), metres and inverse variances; weight 0 if an epoch has fewer than S.
    anchors, tags
        (..., K, S, 3) of each range, anchors in the world frame and tags in the body frame.
    shape
        (M, N).
    blocks
        Blocks of the biases.
    offset
        Which ranges share an unknown offset that is new at every epoch; None: no offset.
    layout
        A model of biases by direction, with its anchors and tags; None: no such biases.
    """

    link: np.ndarray
    ranges: FloatArray
    weights: FloatArray
    anchors: FloatArray
    tags: FloatArray
    shape: tuple[int, int]
    blocks: list[BiasBlock]
    offset: str | None = None
    layout: Layout | None = None

    @classmethod
    def gathered(
        cls,
        ranges: FloatArray,
        variance: FloatArray,
        links: BoolArray | None,
        anchors: FloatArray,
        tags: FloatArray,
        blocks: list[BiasBlock],
        offset: str | None = None,
    ) -> LogRanges:
        """Pack ranges (..., K, M, N) to anchors (..., K or 1, M, 3) and tags (N, 3)."""
        M, N = ranges.shape[-2:]
        flat = (*ranges.shape[:-2], M * N)
        mask = np.broadcast_to(True if links is None else links, ranges.shape)
        most = max(int(mask.sum(axis=(-2, -1)).max()), 1)
        # Measured ranges first, in their order.
        link = np.argsort(~mask.reshape(flat), axis=-1, kind="stable")[..., :most]

        def pick(array: FloatArray | BoolArray) -> np.ndarray:
            flattened = np.broadcast_to(array, ranges.shape).reshape(flat)
            return np.take_along_axis(flattened, link, axis=-1)

        places = np.broadcast_to(anchors, (*flat[:-1], M, 3))
        places = np.take_along_axis(places, (link // N)[..., None], axis=-2)
        weights = np.where(pick(mask), 1 / pick(variance), 0.0)
        tags_of = tags[link % N]
        return cls(link, pick(ranges), weights, places, tags_of, (M, N), blocks, offset)

    def residual(
        self, state: LogState, loss: FloatArray = SQUARES
    ) -> tuple[FloatArray, FloatArray]:
        """Return prediction less range (..., K, S) [m], and derivative (..., K, S, 6) by the pose.

        The offsets that minimize the loss are removed.
        """
        turned = np.einsum("...ij,...sj->...si", state.rotation, self.tags)
        gap = turned + state.translation[..., None, :] - self.anchors
        distance = np.sqrt(np.einsum("...i,...i->...", gap, gap))
        unit = gap / np.where(distance > 0, distance, 1.0)[..., None]
        J = np.concatenate([np.cross(turned, unit), unit], axis=-1)
        total = np.zeros(distance.shape)
        if self.layout is not None:
            found = direction_bias(
                self.layout.law, state.rotation, state.translation, *self.layout[1:]
            )
            flat = (*found.bias.shape[:-2], -1)
            total += np.take_along_axis(found.bias.reshape(flat), self.link, axis=-1)
            slope = found.jacobian.reshape((*flat, 6))
            J = J + np.take_along_axis(slope, self.link[..., None], axis=-2)
        for block in self.blocks:
            values = (
                state.constants[..., None, block.where]
                if block.time_s is None
                else state.extra[..., block.where]
            )
            values = np.broadcast_to(values, (*self.link.shape[:-1], values.shape[-1]))
            total += np.take_along_axis(values, block.of_link[self.link], axis=-1)
        residual = np.where(self.weights > 0, distance + total - self.ranges, 0.0)
        if self.offset is not None:
            weights = self.spread(self.weights)
            found = offset_of(self.spread(residual), weights, loss, self.offset)
            found = np.broadcast_to(found, weights.shape).reshape((*weights.shape[:-2], -1))
            found = np.take_along_axis(found, self.link, axis=-1)
            residual = np.where(self.weights > 0, residual - found, 0.0)
        return residual, J

    def _centred(self, values: FloatArray, weights: FloatArray) -> FloatArray:
        """Return values (..., K, S, n) less the weighted mean of values with the same offset."""
        if self.offset is None:
            return values
        n_tags = self.shape[1]
        groups = {"tag": self.link % n_tags, "anchor": self.link // n_tags}
        group = groups.get(self.offset, np.zeros_like(self.link))
        of = (group[..., None] == np.arange(max(self.shape))).astype(np.float64)
        total = np.einsum("...ks,...ksg->...kg", weights, of)[..., None]
        mean = np.swapaxes(of, -1, -2) @ (weights[..., None] * values)
        return values - of @ (mean / np.where(total > 0, total, 1.0))

    def rows(self, state: LogState, loss: FloatArray) -> tuple[Rows, FloatArray]:
        """Return rows of the ranges, weighted by the loss at the state, and the cost (...).

        Derivatives by constants are by all constants of the log.
        """
        residual, J = self.residual(state, loss)
        cost, share = loss_of(self.weights * residual**2, loss, residual < 0)
        weights = self.weights * share
        root = np.sqrt(weights)
        before = np.zeros((*residual.shape, 6 + state.extra.shape[-1]))
        before[..., :6] = J
        constants = np.zeros((*residual.shape, state.constants.shape[-1]))
        for block in self.blocks:
            target, shift = (constants, 0) if block.time_s is None else (before, 6)
            columns = target[..., block.where.start + shift : block.where.stop + shift]
            columns[...] = block.of_link[self.link][..., None] == np.arange(columns.shape[-1])
        before = self._centred(before, weights) * root[..., None]
        constants = self._centred(constants, weights) * root[..., None]
        rows = Rows(root * residual, before, None, constants)
        return rows, cost.sum(axis=(-2, -1))

    def add(self, equations: Equations, state: LogState, loss: FloatArray) -> None:
        """Add the cost of the ranges under a loss."""
        rows, cost = self.rows(state, loss)
        equations.add(rows)
        # The loss replaces half the squares.
        equations.cost += cost - 0.5 * np.einsum("...ks,...ks->...", rows.residual, rows.residual)

    def consistency(
        self,
        state: LogState,
        loss: FloatArray,
        covariances: tuple[FloatArray, FloatArray, FloatArray],
    ) -> tuple[FloatArray, FloatArray]:
        """Return squared whitened residuals (..., K) of the epochs, and their expectation.

        The expectation per range is 1 less the fraction of its variance that the fit explains,
        times that of the loss (`expected_square`).
        """
        (r, A, _, C), _ = self.rows(state, loss)
        P, crossed, constants = covariances
        assert C is not None
        fitted = np.einsum("...ksi,...kij,...ksj->...ks", A, P, A, optimize=True)
        fitted += 2 * np.einsum("...ksi,...kia,...ksa->...ks", A, crossed, C, optimize=True)
        fitted += np.einsum("...ksa,...ab,...ksb->...ks", C, constants, C, optimize=True)
        free = (self.weights > 0).sum(axis=-1) - fitted.sum(axis=-1)
        if self.offset is not None:
            there = (self.spread(self.weights) > 0).any(axis=axes_of(self.offset), keepdims=True)
            free = free - there.sum(axis=(-2, -1))
        return (r**2).sum(axis=-1), free * expected_square(loss)[..., None]

    def spread(self, values: FloatArray) -> FloatArray:
        """Return values (..., K, S) as (..., K, M, N), zero where no range was measured."""
        M, N = self.shape
        full = np.zeros((*values.shape[:-1], M * N))
        np.put_along_axis(full, self.link, np.where(self.weights > 0, values, 0.0), axis=-1)
        return full.reshape((*values.shape[:-1], M, N))

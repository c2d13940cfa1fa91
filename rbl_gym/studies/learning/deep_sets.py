"""A network over sets in NumPy: one function of every element, in any number and order."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, check_array, check_finite

__all__ = ["DeepSets"]

# Weight (n_out, n_in) and bias (n_out,) of each layer.
Layers = tuple[tuple[FloatArray, FloatArray], ...]
# Factor on sums over the other elements, so that they are of order one.
SUM_SCALE = 0.25


class DeepSets(NamedTuple):
    """Two multilayer perceptrons: one for each pair, one for an element and its pooled pairs.

    ``outer([own_i, SUM_SCALE sum_j inner([own_i, pair_ij]), max_j inner([own_i, pair_ij])])``

    Attributes
    ----------
    inner
        Layers, each with tanh.
    outer
        Layers, each but the last with tanh.
    """

    inner: Layers
    outer: Layers

    def __call__(self, own: FloatArray, pairs: FloatArray, others: FloatArray) -> FloatArray:
        """Return outputs (..., M, n) of elements (..., M, a), their pairs (..., M, E, b) and masks.

        The masks (..., M, E) are 1 for existing pairs. The maximum over no pairs is -1.
        """
        (weight, bias), *rest = self.inner
        n_own = own.shape[-1]
        # The part of the element is the same for all its pairs.
        hidden = np.tanh(
            (own @ weight[:, :n_own].T + bias)[..., None, :] + pairs @ weight[:, n_own:].T
        )
        for weight, bias in rest:
            hidden = np.tanh(hidden @ weight.T + bias)
        there = others[..., None]
        pooled = [
            own,
            SUM_SCALE * (hidden * there).sum(axis=-2),
            np.where(there > 0, hidden, -1.0).max(axis=-2),
        ]
        output = np.concatenate(pooled, axis=-1)
        *inner, (weight, bias) = self.outer
        for w, b in inner:
            output = np.tanh(output @ w.T + b)
        return output @ weight.T + bias


def check_sets(network: DeepSets, n_own: int, n_pair: int, n_out: int) -> None:
    """Raise ValueError unless the layers are finite, fit together, and have these sizes."""
    pooled = n_own + 2 * _checked("inner", network.inner, n_own + n_pair)
    got = _checked("outer", network.outer, pooled)
    if got != n_out:
        raise ValueError(f"outer must have {n_out} outputs, got {got}")


def _checked(name: str, layers: Layers, n_in: int) -> int:
    if not layers:
        raise ValueError(f"{name} has no layers")
    for k, (weight, bias) in enumerate(layers):
        check_finite(f"{name}_bias_{k}", check_array(f"{name}_bias_{k}", bias, ("n_out",)))
        shape = (len(bias), n_in)
        check_finite(f"{name}_weight_{k}", check_array(f"{name}_weight_{k}", weight, shape))
        n_in = len(bias)
    return n_in

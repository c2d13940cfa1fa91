"""`deep_sets.DeepSets` in torch, for training."""

from __future__ import annotations

import itertools
from typing import Any

import torch

from rbl_gym.studies.learning.deep_sets import SUM_SCALE, DeepSets

nn: Any = torch.nn


class SetNetwork(nn.Module):
    """The same function as `DeepSets`, with gradients.

    The numbers are the lengths of the rows of elements, of pairs and of the output; `inner` and
    `outer` the sizes of the hidden layers.
    """

    def __init__(
        self,
        n_own: int,
        n_pair: int,
        n_out: int,
        inner: tuple[int, ...] = (64, 64),
        outer: tuple[int, ...] = (128, 128),
    ) -> None:
        super().__init__()
        sizes = (n_own + n_pair, *inner)
        self.inner = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        sizes = (n_own + 2 * sizes[-1], *outer, n_out)
        self.outer = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))

    def forward(self, own: Any, pairs: Any, others: Any) -> Any:
        """Return outputs (..., M, n). Arguments as in `DeepSets`."""
        repeated = own[..., None, :].expand(*pairs.shape[:-1], own.shape[-1])
        hidden = torch.cat([repeated, pairs], -1)
        for layer in self.inner:
            hidden = torch.tanh(layer(hidden))
        there = others[..., None]
        highest = torch.where(there > 0, hidden, torch.full_like(hidden, -1.0)).amax(-2)
        output = torch.cat([own, SUM_SCALE * (hidden * there).sum(-2), highest], -1)
        for layer in self.outer[:-1]:
            output = torch.tanh(layer(output))
        return self.outer[-1](output)

    def arrays(self) -> DeepSets:
        """Return the network in numpy."""

        def of(layers: Any) -> Any:
            return tuple(
                (one.weight.detach().numpy().astype(float), one.bias.detach().numpy().astype(float))
                for one in layers
            )

        return DeepSets(of(self.inner), of(self.outer))

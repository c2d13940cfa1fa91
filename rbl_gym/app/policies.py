"""Trained policies as small files: a multilayer perceptron in numpy, no learning library needed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray

_META = "meta"


class Policy(NamedTuple):
    """A deterministic policy: tanh layers, then a linear one.

    Attributes
    ----------
    weights, biases
        Of each layer, (n_out, n_in) and (n_out,).
    kind
        ``"box"``: actions cut to [-1, 1]. ``"discrete"``: the largest of the outputs.
        ``"multi-binary"``: which outputs are positive.
    meta
        Where it comes from: task, seed, steps, the command that makes it again.
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]
    kind: str
    meta: dict[str, Any]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (...,) or (..., n) of observations (..., n_in)."""
        hidden = np.asarray(observation, dtype=np.float64)
        if hidden.shape[-1] != self.weights[0].shape[1]:
            raise ValueError(
                f"observation must have {self.weights[0].shape[1]} entries for this policy, "
                f"got {hidden.shape[-1]}: it was trained on {self.meta.get('task')!r}"
            )
        *inner, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for w, b in inner:
            hidden = np.tanh(hidden @ w.T + b)
        output = hidden @ weight.T + bias
        if self.kind == "discrete":
            return output.argmax(axis=-1)
        if self.kind == "multi-binary":
            return (output > 0).astype(np.int8)
        return np.clip(output, -1.0, 1.0)


def save(policy: Policy, path: str | Path) -> None:
    """Write a policy as npz, in single precision."""
    arrays: dict[str, Any] = {}
    for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        arrays[f"weight_{k}"] = weight.astype(np.float32)
        arrays[f"bias_{k}"] = bias.astype(np.float32)
    arrays[_META] = np.array(json.dumps({"kind": policy.kind, **policy.meta}))
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load(path: str | Path) -> Policy:
    """Read a policy.

    Raises
    ------
    ValueError
        If the file is no policy.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            meta = json.loads(str(file[_META]))
            n_layers = sum(name.startswith("weight_") for name in file.files)
            weights = tuple(file[f"weight_{k}"].astype(float) for k in range(n_layers))
            biases = tuple(file[f"bias_{k}"].astype(float) for k in range(n_layers))
    except (KeyError, ValueError, EOFError) as error:
        raise ValueError(f"{path} is no policy of rbl-gym: {error}") from error
    return Policy(weights, biases, str(meta.pop("kind", "box")), meta)

"""Trained policies as small files: a multilayer perceptron in numpy, no learning library needed."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from rbl_gym.checks import FloatArray, check_array, check_finite, check_one_of

__all__ = ["KINDS", "Policy", "load", "save"]

_META = "meta"
KINDS = ("box", "discrete", "multi-binary")


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
        np.savez_compressed(file, **arrays)


def load(path: str | Path) -> Policy:
    """Read a policy.

    Raises
    ------
    ValueError
        If the file is no policy.
    """
    # Read first: an OSError from here on is the archive's.
    data = Path(path).read_bytes()
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            meta = json.loads(str(file[_META]))
            n_layers = sum(name.startswith("weight_") for name in file.files)
            weights = tuple(file[f"weight_{k}"].astype(float) for k in range(n_layers))
            biases = tuple(file[f"bias_{k}"].astype(float) for k in range(n_layers))
        policy = Policy(weights, biases, check_one_of("kind", meta.pop("kind"), KINDS), meta)
        _check_layers(policy)
    # What zipfile and numpy raise of a broken archive has no common kind but this.
    except Exception as error:
        raise ValueError(f"{path} is no policy of rbl-gym: {error}") from error
    return policy


def _check_layers(policy: Policy) -> None:
    """A ValueError unless the layers are finite and fit together."""
    if not policy.weights:
        raise ValueError("it has no layers")
    n_in = policy.weights[0].shape[-1]
    for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        check_finite(f"bias_{k}", check_array(f"bias_{k}", bias, ("n_out",)))
        check_finite(f"weight_{k}", check_array(f"weight_{k}", weight, (len(bias), n_in)))
        n_in = len(bias)


def kind_and_outputs(space: gym.Space[Any]) -> tuple[str, int]:
    """Of which kind a policy for an action space is, and how many outputs it has."""
    if isinstance(space, gym.spaces.Discrete):
        return "discrete", int(space.n)
    kind = "multi-binary" if isinstance(space, gym.spaces.MultiBinary) else "box"
    return kind, int(np.prod(space.shape or ()))


def check_fit(policy: Policy, label: str, envs: Any) -> None:
    """A ValueError unless a policy reads and acts as a vector environment asks for."""
    n_in, n_out = envs.single_observation_space.shape[0], len(policy.biases[-1])
    wanted = (n_in, *kind_and_outputs(envs.single_action_space))
    got = (policy.weights[0].shape[1], policy.kind, n_out)
    if got != wanted:
        raise ValueError(
            f"policy {label!r} does not fit: it was trained on {policy.meta.get('task')!r} and "
            f"has (observation, kind, outputs) = {got}, the task's are {wanted}"
        )

"""Trained policies as small files, run by numpy without a learning library."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from rbl_gym.checks import FloatArray, check_array, check_finite, check_one_of
from rbl_gym.studies.learning.deep_sets import DeepSets
from rbl_gym.studies.learning.set_policies import SET_KINDS, SetPolicy

__all__ = ["ACTIVATIONS", "KINDS", "Lstm", "Policy", "Scaling", "load", "save"]

_META = "meta"
KINDS = ("box", "discrete", "multi-binary")
# Activation functions between the layers.
ACTIVATIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
}


class Scaling(NamedTuple):
    """Scaling of observations: (observation - mean) / scale, clipped.

    Attributes
    ----------
    mean, scale
        (n_in,); scale is positive.
    clip
        Scaled observations are clipped to [-clip, clip].
    """

    mean: FloatArray
    scale: FloatArray
    clip: float

    def __call__(self, observation: FloatArray) -> FloatArray:
        """Return scaled observations (..., n_in)."""
        return np.clip((observation - self.mean) / self.scale, -self.clip, self.clip)


class Lstm(NamedTuple):
    """A layer with a memory, with gates in the order input, forget, cell, output (as in torch).

    Attributes
    ----------
    reads, recalls, bias
        Weights (4 H, n_in) of the input, weights (4 H, H) of the hidden state, and biases (4 H,).
    """

    reads: FloatArray
    recalls: FloatArray
    bias: FloatArray

    def __call__(
        self, observation: FloatArray, hidden: FloatArray, cell: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return hidden and cell state (..., H) after an observation (..., n_in)."""
        gates = observation @ self.reads.T + hidden @ self.recalls.T + self.bias
        enter, keep, new, out = np.split(gates, 4, axis=-1)
        cell = _sigmoid(keep) * cell + _sigmoid(enter) * np.tanh(new)
        return _sigmoid(out) * np.tanh(cell), cell


class Policy(NamedTuple):
    """A deterministic policy: layers with tanh between them, the last one linear.

    Attributes
    ----------
    weights, biases
        Weights (n_out, n_in) and biases (n_out,) of each layer.
    kind
        ``"box"``: actions clipped to [-1, 1]. ``"discrete"``: index of the largest output.
        ``"multi-binary"``: which outputs are positive.
    meta
        Origin: task, seed, steps, the command that repeats the training. With ``"algorithm":
        "maskable-ppo"`` the policy uses the environment's action masks.
    lstm
        A layer with a memory before the others, or None.
    activation
        Activation function between the layers, one of `ACTIVATIONS`.
    scaling
        Scaling of the observations before the first layer, or None.
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]
    kind: str
    meta: dict[str, Any]
    lstm: Lstm | None = None
    activation: str = "tanh"
    scaling: Scaling | None = None

    @property
    def n_inputs(self) -> int:
        """Number of entries of an observation."""
        first = self.weights[0] if self.lstm is None else self.lstm.reads
        return first.shape[1]

    def __call__(self, observation: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
        """Return actions (...,) or (..., n) for observations (..., n_in).

        `mask` is True for the allowed actions: (..., n) for a discrete policy, (..., 2 n) for a
        multi-binary one (for each entry whether it may be 0 and whether it may be 1).
        """
        if self.lstm is not None:
            raise ValueError(
                "a recurrent policy must be played by player(), with a new player for each episode"
            )
        return self._action(self._read(observation), mask)

    def player(self) -> Callable[[Any, np.ndarray], np.ndarray]:
        """Return a function ``(env, observation) -> actions`` for one episode."""
        masked = self.meta.get("algorithm") == "maskable-ppo"
        state = None

        def play(env: Any, observation: np.ndarray) -> np.ndarray:
            nonlocal state
            hidden = self._read(observation)
            if self.lstm is not None:
                if state is None:
                    state = (np.zeros((*hidden.shape[:-1], self.lstm.recalls.shape[1])),) * 2
                state = self.lstm(hidden, *state)
                hidden = state[0]
            return self._action(hidden, env.unwrapped.action_masks() if masked else None)

        return play

    def _read(self, observation: np.ndarray) -> FloatArray:
        """Return a checked and scaled observation."""
        seen = np.asarray(observation, dtype=np.float64)
        if seen.shape[-1] != self.n_inputs:
            raise ValueError(
                f"observation must have {self.n_inputs} entries for this policy, "
                f"got {seen.shape[-1]}: it was trained on {self.meta.get('task')!r}"
            )
        return seen if self.scaling is None else self.scaling(seen)

    def _outputs(self, hidden: FloatArray) -> FloatArray:
        """Return the outputs (..., n_out) of the last layer."""
        *inner, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for w, b in inner:
            hidden = ACTIVATIONS[self.activation](hidden @ w.T + b)
        return hidden @ weight.T + bias

    def _action(self, hidden: FloatArray, mask: np.ndarray | None) -> np.ndarray:
        output = self._outputs(hidden)
        if self.kind == "discrete":
            return (output if mask is None else np.where(mask, output, -np.inf)).argmax(axis=-1)
        if self.kind == "multi-binary":
            there = True if mask is None else np.asarray(mask)[..., 1::2]
            return ((output > 0) & there).astype(np.int8)
        return np.clip(output, -1.0, 1.0)


AnyPolicy = Policy | SetPolicy


def _sigmoid(x: FloatArray) -> FloatArray:
    return 0.5 * (1 + np.tanh(0.5 * x))


def save(policy: AnyPolicy, path: str | Path) -> None:
    """Write a policy as npz, in single precision."""
    arrays: dict[str, Any] = {}
    if isinstance(policy, SetPolicy):
        for name, layers in policy.network._asdict().items():
            for k, (weight, bias) in enumerate(layers):
                arrays[f"{name}_weight_{k}"], arrays[f"{name}_bias_{k}"] = weight, bias
    else:
        for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
            arrays[f"weight_{k}"], arrays[f"bias_{k}"] = weight, bias
        if policy.lstm is not None:
            arrays.update({f"lstm_{name}": one for name, one in policy.lstm._asdict().items()})
        if policy.scaling is not None:
            scaling = policy.scaling._asdict()
            arrays.update({f"scaling_{name}": np.asarray(one) for name, one in scaling.items()})
    arrays = {name: array.astype(np.float32) for name, array in arrays.items()}
    form = {"kind": policy.kind}
    if isinstance(policy, Policy) and policy.activation != "tanh":
        form["activation"] = policy.activation
    arrays[_META] = np.array(json.dumps({**form, **policy.meta}))
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)


def load(path: str | Path) -> AnyPolicy:
    """Read a policy.

    Raises
    ------
    ValueError
        If the file is not a policy.
    """
    # numpy leaves the file open if it is not an archive.
    data = io.BytesIO(Path(path).read_bytes())
    if not zipfile.is_zipfile(data):
        raise ValueError(f"{path} is not a policy of rbl-gym: must be a .npz file of rbl-gym train")
    try:
        with zipfile.ZipFile(data) as archive:
            if "policy.pth" in archive.namelist():
                raise ValueError(
                    "it is a model of stable-baselines3. Convert it by "
                    "rbl_gym.studies.learning.sb3_models.policy_of (docs/learners.md)"
                )
        with np.load(data, allow_pickle=False) as file:
            meta = json.loads(str(file[_META]))
            arrays = {key: file[key].astype(float) for key in file.files if key != _META}
        kind = check_one_of("kind", meta.pop("kind"), [*KINDS, *SET_KINDS])
        if kind in SET_KINDS:
            network = DeepSets(_layers(arrays, "inner_"), _layers(arrays, "outer_"))
            policy = SetPolicy(network, kind, meta)
            policy.check()
            return policy
        layers = _layers(arrays, "")
        lstm = scaling = None
        if "lstm_bias" in arrays:
            lstm = Lstm(*(arrays[f"lstm_{name}"] for name in Lstm._fields))
        if "scaling_clip" in arrays:
            mean, scale, clip = (arrays[f"scaling_{name}"] for name in Scaling._fields)
            scaling = Scaling(mean, scale, float(clip))
        activation = check_one_of("activation", meta.pop("activation", "tanh"), [*ACTIVATIONS])
        weights, biases = (
            (tuple(part) for part in zip(*layers, strict=True)) if layers else ((), ())
        )
        policy = Policy(weights, biases, kind, meta, lstm, activation, scaling)
        _check_layers(policy)
    # zipfile and numpy raise unrelated exceptions for a broken archive.
    except Exception as error:
        raise ValueError(f"{path} is not a policy of rbl-gym: {error}") from error
    return policy


def _layers(arrays: dict[str, np.ndarray], name: str) -> tuple[tuple[FloatArray, FloatArray], ...]:
    """Return weights and biases whose names begin with `name`."""
    count = sum(key.startswith(f"{name}weight_") for key in arrays)
    return tuple((arrays[f"{name}weight_{k}"], arrays[f"{name}bias_{k}"]) for k in range(count))


def _check_layers(policy: Policy) -> None:
    """Raise ValueError unless the layers are finite and fit together."""
    if not policy.weights:
        raise ValueError("the file has no layers")
    n_in = policy.weights[0].shape[-1]
    if policy.lstm is not None:
        for name, array in policy.lstm._asdict().items():
            check_finite(f"lstm_{name}", array)
        size = n_in
        check_array("lstm_reads", policy.lstm.reads, (4 * size, "n_in"))
        check_array("lstm_recalls", policy.lstm.recalls, (4 * size, size))
        check_array("lstm_bias", policy.lstm.bias, (4 * size,))
    for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        check_finite(f"bias_{k}", check_array(f"bias_{k}", bias, ("n_out",)))
        check_finite(f"weight_{k}", check_array(f"weight_{k}", weight, (len(bias), n_in)))
        n_in = len(bias)
    if policy.scaling is not None:
        for name, array in policy.scaling._asdict().items():
            shape = () if name == "clip" else (policy.n_inputs,)
            check_finite(f"scaling_{name}", check_array(f"scaling_{name}", array, shape))
        if not (policy.scaling.scale > 0).all() or not policy.scaling.clip > 0:
            raise ValueError("scaling_scale and scaling_clip must be positive")


def kind_and_outputs(space: gym.Space[Any]) -> tuple[str, int]:
    """Return the kind of a policy for an action space, and its number of outputs."""
    if isinstance(space, gym.spaces.Discrete):
        return "discrete", int(space.n)
    kind = "multi-binary" if isinstance(space, gym.spaces.MultiBinary) else "box"
    return kind, int(np.prod(space.shape or ()))


def _spaces(told: tuple[Any, ...]) -> str:
    *shape, kind, outputs = told
    return f"an observation of shape {tuple(shape)} and {outputs} outputs for {kind!r} actions"


def check_fit(policy: Any, label: str, envs: Any) -> None:
    """Raise ValueError unless a policy fits the spaces of an environment, vector or scalar.

    The spaces of an `OwnPolicy` are not known. Its actions are checked when it is played.
    """
    if not isinstance(policy, AnyPolicy):
        return
    trained = f"policy {label!r} does not fit: it was trained on {policy.meta.get('task')!r}"
    if isinstance(policy, SetPolicy):
        wanted = SET_KINDS[policy.kind][0]
        if envs.unwrapped.spec.id != wanted:
            raise ValueError(f"{trained} and is for {wanted}, got {envs.unwrapped.spec.id}")
        return
    seen = getattr(envs, "single_observation_space", envs.observation_space)
    acted = getattr(envs, "single_action_space", envs.action_space)
    asked = (*(seen.shape or (None,)), *kind_and_outputs(acted))
    got = (policy.n_inputs, policy.kind, len(policy.biases[-1]))
    if got != asked:
        raise ValueError(f"{trained}, with {_spaces(got)}, but this task has {_spaces(asked)}")

"""Policies of stable-baselines3 and sb3-contrib models as NumPy arrays."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.studies.learning.policies import Lstm, Policy, Scaling, kind_and_outputs

__all__ = ["policy_of"]

# Policy classes and the algorithms that they belong to (None: several).
_NETWORKS = {
    "ActorCriticPolicy": None,
    "MaskableActorCriticPolicy": "maskable-ppo",
    "RecurrentActorCriticPolicy": "recurrent-ppo",
}
_ACTIVATIONS = {"Tanh": "tanh", "ReLU": "relu"}
# Number of observations to compare the actions on, and the share of actions that must agree.
_TRIALS, _AGREEMENT = 64, 0.97


def policy_of(model: Any, task: str | None = None, *, normalize: Any = None) -> Policy:
    """Return the policy network of a stable-baselines3 model, for `policies.save`.

    The returned policy has the deterministic actions of the model. They are compared on random
    observations before the function returns.

    Parameters
    ----------
    model
        A PPO, A2C, MaskablePPO or RecurrentPPO model with ``MlpPolicy`` (or ``MlpLstmPolicy``) and
        tanh or ReLU activations, that observes one vector.
    task
        Name of the task the model was trained on. If it is one of `rl_tasks.TASKS`,
        ``rbl-gym studio --policy`` runs the file in that task.
    normalize
        The ``VecNormalize`` wrapper of the training; its scaling becomes part of the policy. None
        uses the wrapper of the model's environment, if any. A model loaded from a file has no
        environment, unless `load` was called with ``env=``.

    Returns
    -------
    The policy. Its `meta` has the task, the algorithm and the number of training steps.

    Raises
    ------
    ValueError
        If the model cannot be represented: another algorithm; observations that are not one
        vector; actions other than ``Box(-1, 1, (n,))``, ``Discrete`` and ``MultiBinary``; a custom
        policy class, features extractor or network; another activation; ``squash_output=True``;
        more than one LSTM layer. Also if `normalize` has another shape.
    """
    network: Any = getattr(model, "policy", None)
    for part in ("action_net", "mlp_extractor", "features_extractor"):
        if not hasattr(network, part):
            raise ValueError(
                "model must be a PPO, A2C, MaskablePPO or RecurrentPPO of stable-baselines3 or "
                f"sb3-contrib, got {type(model).__name__}"
            )
    _check_spaces(model)
    _check_network(network)
    layers = [one for one in network.mlp_extractor.policy_net if hasattr(one, "weight")]
    layers.append(network.action_net)
    weights = [_array(layer.weight) for layer in layers]
    biases = [_array(layer.bias) for layer in layers]
    kind, n_outputs = kind_and_outputs(model.action_space)
    if kind == "multi-binary" and len(biases[-1]) == 2 * n_outputs:
        # MaskablePPO has two outputs for each entry: for 0 and for 1.
        weights[-1] = weights[-1][1::2] - weights[-1][::2]
        biases[-1] = biases[-1][1::2] - biases[-1][::2]
    policy = Policy(
        tuple(weights),
        tuple(biases),
        kind,
        {
            "task": task or "custom",
            "algorithm": _NETWORKS[type(network).__name__] or type(model).__name__.lower(),
            "steps": int(model.num_timesteps),
        },
        _lstm(network),
        _activation(network),
        _scaling(model, normalize),
    )
    _check_same(model, policy)
    return policy


def _array(tensor: Any) -> FloatArray:
    return tensor.detach().cpu().numpy().astype(float)


def _check_spaces(model: Any) -> None:
    seen, acted = model.observation_space, model.action_space
    if not isinstance(seen, gym.spaces.Box) or len(seen.shape) != 1:
        raise ValueError(
            "model must observe one vector, a Box of shape (n,), got "
            f"{seen!r:.200}: train it with observation='flat'"
        )
    one_axis = isinstance(acted, gym.spaces.MultiBinary | gym.spaces.Box) and len(acted.shape) == 1
    if isinstance(acted, gym.spaces.Box):
        one_axis = one_axis and (acted.low == -1).all() and (acted.high == 1).all()
    if one_axis or isinstance(acted, gym.spaces.Discrete):
        return
    raise ValueError(
        "model must have actions in Box(-1, 1, (n,)), Discrete(n) or MultiBinary(n), got "
        f"{acted!r:.200}"
    )


def _check_network(network: Any) -> None:
    """Raise ValueError unless the network is that of MlpPolicy or of a one-layer MlpLstmPolicy."""
    extractor = getattr(network, "pi_features_extractor", network.features_extractor)
    for what, part, known in (
        ("policy class", network, _NETWORKS),
        ("features extractor", extractor, ("FlattenExtractor",)),
        ("network", network.mlp_extractor, ("MlpExtractor",)),
        ("last layer", network.action_net, ("Linear",)),
    ):
        if type(part).__name__ not in known:
            raise ValueError(
                f"model must have MlpPolicy without a custom {what}, got {type(part).__name__}"
            )
    if network.squash_output:
        raise ValueError("model must have squash_output=False, got True")
    lstm = getattr(network, "lstm_actor", None)
    if lstm is not None and not (lstm.num_layers == 1 and lstm.bias and not lstm.proj_size):
        raise ValueError(f"model must have one LSTM layer with biases, got {lstm}")


def _activation(network: Any) -> str:
    """Return the name of the activation function; tanh if there is one layer."""
    names = {type(one).__name__ for one in network.mlp_extractor.policy_net} - {"Linear"}
    if not names <= set(_ACTIVATIONS):
        raise ValueError(
            f"model must have {' or '.join(_ACTIVATIONS)} as activation_fn, got {', '.join(names)}"
        )
    return _ACTIVATIONS[names.pop()] if names else "tanh"


def _lstm(network: Any) -> Lstm | None:
    lstm = getattr(network, "lstm_actor", None)
    if lstm is None:
        return None
    reads, recalls, *both = (_array(one) for one in lstm.parameters())
    return Lstm(reads, recalls, np.sum(both, axis=0))


def _scaling(model: Any, normalize: Any) -> Scaling | None:
    if normalize is None:
        normalize = model.get_vec_normalize_env()
    if normalize is None or not normalize.norm_obs:
        return None
    mean, variance = normalize.obs_rms.mean, normalize.obs_rms.var
    if mean.shape != model.observation_space.shape:
        raise ValueError(
            f"normalize must have observations of shape {model.observation_space.shape}, got "
            f"{mean.shape}"
        )
    scale = np.sqrt(variance + normalize.epsilon)
    return Scaling(mean.astype(float), scale, float(normalize.clip_obs))


def _check_same(model: Any, policy: Policy) -> None:
    """Raise ValueError unless policy and model agree on random observations."""
    space, rng = model.observation_space, np.random.default_rng(0)
    low, high = np.maximum(space.low, -10.0), np.minimum(space.high, 10.0)
    play, state = policy._replace(meta={}).player(), None
    for _ in range(3):
        seen = rng.uniform(low, high, (_TRIALS, *space.shape)).astype(space.dtype)
        # `predict` of a model expects scaled observations.
        told = seen if policy.scaling is None else policy.scaling(seen).astype(np.float32)
        wanted, state = model.predict(told, state=state, deterministic=True)
        got = play(None, seen)
        # Single precision may decide between two almost equal outputs differently.
        same = np.isclose(got, wanted, atol=1e-3).mean()
        if same < _AGREEMENT:
            raise ValueError(
                "model must have an unmodified MlpPolicy: on random observations only "
                f"{same:.0%} of its actions are those of its layers"
            )

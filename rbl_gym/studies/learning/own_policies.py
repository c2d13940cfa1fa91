"""Policies of the user's own: functions, models of learning libraries, files, by one name."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import imported
from rbl_gym.studies.learning.policies import AnyPolicy, Policy, load
from rbl_gym.studies.learning.set_policies import SetPolicy

__all__ = ["OwnPolicy", "policies_by_label", "policy_like"]


class OwnPolicy(NamedTuple):
    """A function, or a model with ``predict``, that acts in all worlds of a vector environment.

    Attributes
    ----------
    act
        ``act(observation)`` or ``act(env, observation)``, returns the actions of all worlds; or a
        model as in stable-baselines3, whose deterministic actions are used.
    meta
        Empty: nothing is known about the training.
    """

    act: Any
    meta: Mapping[str, Any] = {}

    def player(self) -> Callable[[Any, Any], np.ndarray]:
        """Return a function ``(env, observation) -> actions`` for one episode."""
        act, state = self.act, None
        if hasattr(act, "predict"):
            masked = "action_masks" in inspect.signature(act.predict).parameters

            def play(env: Any, observation: Any) -> Any:
                nonlocal state
                # A recurrent model also needs its memory, others ignore it.
                told = {"state": state, "episode_start": np.full(env.num_envs, state is None)}
                if masked:
                    told["action_masks"] = env.unwrapped.action_masks()
                actions, state = act.predict(observation, deterministic=True, **told)
                return actions
        elif _takes_env(act):
            play = act
        else:

            def play(env: Any, observation: Any) -> Any:
                return act(observation)

        return lambda env, observation: _checked(play(env, observation), env)


PolicyLike = AnyPolicy | OwnPolicy


def _takes_env(act: Callable[..., Any]) -> bool:
    """Return whether a function has two arguments, the environment and the observation."""
    try:
        parameters = inspect.signature(act).parameters.values()
    except (TypeError, ValueError):  # of some functions in C
        return False
    by_position = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in by_position and p.default is p.empty for p in parameters) == 2


def _check_arguments(act: Callable[..., Any]) -> None:
    try:
        signature = inspect.signature(act)
    except (TypeError, ValueError):  # of some functions in C
        return
    for given in ("observation",), ("env", "observation"):
        with contextlib.suppress(TypeError):
            signature.bind(*given)
            return
    name = getattr(act, "__qualname__", type(act).__qualname__)
    raise ValueError(
        f"policy must be a function of (observation) or (env, observation), but {name} has the "
        f"arguments {signature}"
    )


def _checked(actions: Any, env: Any) -> np.ndarray:
    """Return actions as an array; raises ValueError if they are not those of all worlds."""
    array, wanted = np.asarray(actions), env.action_space.shape
    if array.shape != wanted:
        hint = ""
        if array.shape == env.single_action_space.shape:
            hint = (
                ". It gets the observations of all worlds at once. For a function act of one "
                "observation use lambda seen: np.array([act(one) for one in seen])"
            )
        raise ValueError(
            f"policy must return actions of shape {wanted}, one for each of the {env.num_envs} "
            f"worlds, got {array.shape}{hint}"
        )
    return array


def policy_like(value: Any) -> PolicyLike:
    """Return a policy to play.

    Parameters
    ----------
    value
        The path of a file of ``rbl-gym train``; ``"module:function"``; a policy of
        `policies.load`; a function ``observation -> actions`` or ``(env, observation) -> actions``
        of all worlds of a vector environment; or a model with ``predict``, as those of
        stable-baselines3.

    Raises
    ------
    ValueError
        If it is none of these, the file is not a policy, or the function cannot be imported or
        has other arguments.
    """
    if isinstance(value, Policy | SetPolicy | OwnPolicy):
        return value
    if isinstance(value, str | Path):
        text = str(value)
        if ":" in text and not text.endswith(".npz") and not Path(text).is_file():
            return policy_like(imported("policy", text))
        return load(value)
    if hasattr(value, "predict"):
        return OwnPolicy(value)
    if callable(value):
        _check_arguments(value)
        return OwnPolicy(value)
    raise ValueError(
        "policy must be a file of rbl-gym train, 'module:function', a function or a model with "
        f"predict, got {value!r:.80}"
    )


def policies_by_label(given: Any) -> dict[str, PolicyLike]:
    """Return policies by label.

    Parameters
    ----------
    given
        None; one value of `policy_like`, with the label ``"policy"``; or a dict of them by label.
    """
    if given is None:
        return {}
    several = given if isinstance(given, Mapping) else {"policy": given}
    return {label: policy_like(value) for label, value in several.items()}

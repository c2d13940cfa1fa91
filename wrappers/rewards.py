"""Rewards of `EstimatePose`: named rewards and custom functions."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray, all_finite, check_number, did_you_mean, imported
from rbl_gym.estimators import PoseBelief
from rbl_gym.metrics import Figures
from rbl_gym.worlds.scene import Scene

__all__ = ["REWARDS", "Outcome", "reward_of"]


class Outcome(NamedTuple):
    """A step as input of a reward. In a vector environment every array has a leading axis (B,).

    Attributes
    ----------
    figures
        Errors of the belief, its NEES and its score (`rbl_gym.metrics.Figures`).
    belief
        The belief after the step.
    rotation, translation
        The true pose: (..., 3, 3) and (..., 3), metres.
    bound_m
        b of the posterior Cramer-Rao bound (...), metres; None if the environment does not compute
        it (``reward="none"``).
    action
        The argument of `step`.
    observation
        The environment's observation: `ranges`, `links`, `anchors`, `twist` and so on.
    scene
        The world.
    """

    figures: Figures
    belief: PoseBelief
    rotation: FloatArray
    translation: FloatArray
    bound_m: FloatArray | None
    action: Any
    observation: Mapping[str, np.ndarray]
    scene: Scene


Reward = Callable[[Outcome], Any]
RewardLike = str | Mapping[str, Any] | Reward


def belief(outcome: Outcome) -> FloatArray:
    """Return ``-log b``, b the root mean square tag error expected by the belief, metres."""
    return -np.log(outcome.figures.score_m)


def error(outcome: Outcome) -> FloatArray:
    """Return minus the actual root mean square tag error, metres."""
    return -outcome.figures.tag_error_m


def worst_tag(outcome: Outcome) -> FloatArray:
    """Return ``-log`` of the largest expected tag error of the belief, metres."""
    J = bounds.tag_jacobian(outcome.belief.rotation, outcome.scene.body)
    P = outcome.belief.covariance[..., None, :, :]
    squares = np.einsum("...nia,...nab,...nib->...n", J, P, J)
    return -0.5 * np.log(squares.max(axis=-1))


def requirement(
    outcome: Outcome, position_m: float = math.inf, rotation_deg: float = math.inf
) -> FloatArray:
    """Return 1 if the actual errors are within both limits, otherwise 0."""
    figures = outcome.figures
    within = (figures.position_error_m <= position_m) & (
        figures.rotation_error_rad <= math.radians(rotation_deg)
    )
    return np.asarray(within, dtype=np.float64)


REWARDS: dict[str, Callable[..., FloatArray]] = {
    "belief": belief,
    "error": error,
    "worst-tag": worst_tag,
    "requirement": requirement,
}


def reward_of(reward: RewardLike) -> Reward:
    """Return the reward function of a name, a dict, a dotted path or a function.

    Parameters
    ----------
    reward
        One of these:

        * A name of `REWARDS`.
        * A dict ``{"kind": NAME, ...}`` with the options of this reward. With the option
          `action_price`, the price times the sum of the squares of the action is subtracted.
        * ``"module:function"``, the path of a function.
        * A function of an `Outcome` that returns a number for each world.

    Raises
    ------
    ValueError
        If the name or an option is unknown, the path cannot be imported, or the type is wrong.
    """
    if callable(reward):
        return reward
    if isinstance(reward, Mapping):
        return _with_options(dict(reward))
    if isinstance(reward, str) and reward in REWARDS and reward != "requirement":
        return REWARDS[reward]
    if isinstance(reward, str) and ":" in reward:
        return imported("reward", reward)
    if isinstance(reward, str) and reward == "requirement":
        raise ValueError(
            "reward 'requirement' needs limits: "
            '{"kind": "requirement", "position_m": ..., "rotation_deg": ...}'
        )
    raise ValueError(
        f"reward must be one of {', '.join(map(repr, REWARDS))}, a dict with a kind, "
        f"'module:function' or a function, got {reward!r:.80}{did_you_mean(reward, REWARDS)}"
    )


def _with_options(options: dict[str, Any]) -> Reward:
    kind = options.pop("kind", None)
    if not isinstance(kind, str) or kind not in REWARDS:
        raise ValueError(
            f"reward must have a kind, one of {', '.join(map(repr, REWARDS))}, got {kind!r:.80}"
            f"{did_you_mean(kind, REWARDS)}"
        )
    function = REWARDS[kind]
    known = [*inspect.signature(function).parameters][1:]
    price = check_number("reward.action_price", options.pop("action_price", 0.0), low=0.0)
    for name, value in options.items():
        if name not in known:
            raise ValueError(
                f"reward {kind!r} has no option {name!r:.80}; its options are "
                f"{', '.join([*known, 'action_price'])}{did_you_mean(name, known)}"
            )
        check_number(f"reward.{name}", value, low=0.0)
    if kind == "requirement" and not options:
        raise ValueError("reward 'requirement' needs position_m or rotation_deg, or both")
    reward = functools.partial(function, **options)
    return functools.partial(_priced, reward, price) if price else reward


def _priced(reward: Reward, price: float, outcome: Outcome) -> FloatArray:
    """Return the reward less the price of the action."""
    value: Any = reward(outcome)
    action = np.asarray(outcome.action, dtype=np.float64)
    entries = action.ndim - value.ndim
    return value - price * np.square(action).sum(axis=tuple(range(-entries, 0)))


def paid_of(reward: Reward, outcome: Outcome) -> FloatArray | float:
    """Return the rewards of a step, a finite number for each world; may raise ValueError."""
    try:
        value: Any = reward(outcome)
    except (TypeError, AttributeError) as error:
        if outcome.bound_m is not None or "NoneType" not in str(error):
            raise
        raise ValueError(
            f"reward {_label(reward)} raised {error!r:.160}; bound_m of the Outcome is None, "
            "because the environment has reward='none'"
        ) from error
    one_world = isinstance(value, float) and isinstance(outcome.figures.score_m, float)
    if one_world and math.isfinite(value):
        return value
    shape = np.shape(outcome.figures.score_m)
    wanted = f"reward {_label(reward)} must return one number for each world, shape {shape}"
    try:
        value = np.asarray(value if value is not None else "None", dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{wanted}, got {value!r:.80}") from None
    if value.shape != shape:
        hint = ""
        if shape and not value.shape:
            hint = (
                ". The arrays of the Outcome have the axis of the worlds first: reduce the other "
                "axes only, for example with .mean(axis=-1)"
            )
        raise ValueError(f"{wanted}, got shape {value.shape}{hint}")
    if not all_finite(value):
        wrong = np.flatnonzero(~np.isfinite(value))
        worlds = f" in {len(wrong)} of {value.size} worlds, first world {wrong[0]}" if shape else ""
        raise ValueError(
            f"reward {_label(reward)} must be finite, got {value.flat[wrong[0]]}{worlds}"
        )
    return value


def _label(reward: Any) -> str:
    """Return the name of a reward for a message."""
    while isinstance(reward, functools.partial):
        reward = reward.args[0] if reward.func is _priced else reward.func
    return str(getattr(reward, "__qualname__", type(reward).__qualname__))

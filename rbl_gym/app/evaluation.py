"""Policies and references on held-out worlds, side by side, with confidence intervals.

The loss L of a policy in a world is the mean of log b: of the final layout in a placement task, of
all steps in a task with a filter in the loop; where anchors have a price, minus the mean
reward. Normalised = (L_random - L) / (L_random - L_best), L_best that of the strongest
reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym import layout_search, layouts, placement
from rbl_gym.app.policies import Policy
from rbl_gym.app.rl_tasks import RlTask
from rbl_gym.checks import FloatArray, check_one_of
from rbl_gym.wrappers import controllers

# Seeds of held-out worlds lie beyond those that a training reaches.
HELD_OUT_SEED = 1_000_000_000
# Random layouts of each context; and generations of CMA-ES that refine a policy's proposal.
_RANDOM_TRIES = 8
REFINE_GENERATIONS = 12
_REFINE_SIGMA = 0.1
_RESAMPLES = 2000


def references(task: RlTask) -> list[str]:
    """Names of a task's references; the last is the strongest."""
    if task.env_id == "RBL/AnchorPlacement-v0":
        if task.arguments.get("mode") == "mounts":
            return ["random", "greedy", "greedy-swaps"]
        return [*layouts.LAYOUTS, *layout_search.SEARCHES]
    return list(_controllers(task))


def _controllers(task: RlTask) -> dict[str, controllers.Controller]:
    mobile = task.env_id == "RBL/MobileAnchors-v0"
    return controllers.MOBILE if mobile else controllers.SELECTION


def evaluate(
    task: RlTask,
    policies: dict[str, Policy],
    names: list[str],
    worlds: int,
    seed: int,
    advance: Callable[[], None],
) -> dict[str, Any]:
    """Losses of policies and references on the same `worlds` held-out worlds.

    Parameters
    ----------
    task
        What is played.
    policies
        By the label they are to have. In a placement task each also comes refined by a few
        generations of CMA-ES, ``LABEL + cma-es``.
    names
        Of `references`; ``random`` and the strongest are always among them.
    worlds, seed
        How many, and which.
    advance
        Called after each.

    Raises
    ------
    ValueError
        On an unknown reference.
    """
    known = references(task)
    names = [check_one_of("reference", name, known) for name in names]
    names = [name for name in known if name in {*names, known[0], known[-1]}]
    losses: dict[str, FloatArray] = {}
    is_placement = task.env_id == "RBL/AnchorPlacement-v0"
    for name in names:
        rng = np.random.default_rng([seed, known.index(name)])
        if is_placement:
            losses[name] = _placement_reference(task, name, worlds, seed, rng)
        else:
            controller = _controllers(task)[name]
            losses[name] = _rollout(
                task, lambda env, _, c=controller, r=rng: c(env, r), worlds, seed
            )
        advance()
    for label, policy in policies.items():
        losses[label] = _rollout(task, lambda _, seen, p=policy: p(seen), worlds, seed)
        advance()
        if is_placement and task.arguments.get("mode") != "mounts":
            rng = np.random.default_rng([seed, len(known)])
            losses[f"{label} + cma-es"] = _refined(task, policy, worlds, seed, rng)
            advance()
    rng = np.random.default_rng([seed, len(known) + 1])
    resamples = rng.integers(worlds, size=(_RESAMPLES, worlds))
    return {
        "worlds": worlds,
        "seed": seed,
        "best_reference": known[-1],
        "methods": {
            name: _figures(loss, losses["random"], losses[known[-1]], resamples)
            for name, loss in losses.items()
        },
    }


def work_units(task: RlTask, names: list[str], n_policies: int) -> int:
    """How often `evaluate` calls `advance`."""
    known = references(task)
    refined = task.env_id == "RBL/AnchorPlacement-v0" and task.arguments.get("mode") != "mounts"
    return len({*names, known[0], known[-1]}) + n_policies * (2 if refined else 1)


def _figures(
    loss: FloatArray, random: FloatArray, best: FloatArray, resamples: np.ndarray
) -> dict[str, float]:
    """Mean loss, its score in metres, the normalised value with a paired bootstrap interval."""
    means = [array[resamples].mean(axis=-1) for array in (random, loss, best)]
    normalised = (means[0] - means[1]) / (means[0] - means[2])
    low, high = np.quantile(normalised, [0.025, 0.975])
    return {
        "loss": float(loss.mean()),
        "loss_std_error": float(loss.std(ddof=1) / math.sqrt(len(loss))) if len(loss) > 1 else 0.0,
        "score_m": float(np.exp(loss.mean())),
        "normalised": float((random.mean() - loss.mean()) / (random.mean() - best.mean())),
        "normalised_low": float(low),
        "normalised_high": float(high),
    }


# --- tasks played step by step ----------------------------------------------------------------


def _rollout(
    task: RlTask, act: Callable[[Any, np.ndarray], np.ndarray], worlds: int, seed: int
) -> FloatArray:
    """Losses (worlds,) of one episode of each world."""
    env = task.make(worlds, "Disabled")
    observation, _ = env.reset(seed=HELD_OUT_SEED + seed)
    total, steps = np.zeros(worlds), 0
    done = np.zeros(worlds, dtype=np.bool_)
    info: dict[str, Any] = {}
    while not done.all():
        observation, reward, terminated, truncated, info = env.step(act(env, observation))
        total += reward
        steps += 1
        done = terminated | truncated
    if task.env_id == "RBL/AnchorPlacement-v0":
        return np.log(info["score_m"])
    return -total / steps


# --- placement --------------------------------------------------------------------------------


def _problems(task: RlTask, worlds: int, seed: int) -> Any:
    """An environment at the start of its held-out problems."""
    env = task.make(worlds, "Disabled")
    env.reset(seed=HELD_OUT_SEED + seed)
    return env


def _placement_reference(
    task: RlTask, name: str, worlds: int, seed: int, rng: np.random.Generator
) -> FloatArray:
    env = _problems(task, worlds, seed)
    problem, contexts = env.task, env.contexts
    if task.arguments.get("mode") == "mounts":
        candidates = placement.mounts(problem)
        if name == "random":
            return _mean_of_tries(
                problem, contexts,
                candidates[_choices(rng, worlds, len(candidates), problem.n_anchors)],
            )  # fmt: skip
        found = layout_search.greedy(
            problem, contexts, rng, candidates=candidates, swaps=name == "greedy-swaps"
        )
    elif name == "random":
        shape = (worlds, _RANDOM_TRIES, problem.n_anchors, 3)
        return _mean_of_tries(
            problem, contexts, problem.scene.anchor_region.draw(rng.random(shape))
        )
    else:
        found = {**layouts.LAYOUTS, **layout_search.SEARCHES}[name](problem, contexts, rng)
    return np.log(placement.score(problem, contexts, found))


def _choices(rng: np.random.Generator, worlds: int, n: int, k: int) -> np.ndarray:
    """Random sets (worlds, tries, k) of n without repetition."""
    return rng.random((worlds, _RANDOM_TRIES, n)).argsort(axis=-1)[..., :k]


def _mean_of_tries(problem: Any, contexts: Any, anchors: FloatArray) -> FloatArray:
    scores = placement.score(problem, layout_search.expand(contexts), anchors)
    return np.log(scores).mean(axis=-1)


def _refined(
    task: RlTask, policy: Policy, worlds: int, seed: int, rng: np.random.Generator
) -> FloatArray:
    """A policy's layouts after a tenth of the generations that CMA-ES alone takes."""
    env = _problems(task, worlds, seed)
    problem, contexts = env.task, env.contexts
    observation, _ = env.reset(seed=HELD_OUT_SEED + seed)
    info: dict[str, Any] = {}
    done = np.zeros(worlds, dtype=np.bool_)
    while not done.all():
        observation, _, done, _, info = env.step(policy(observation))
    found = layout_search.cma_es(
        problem, contexts, rng, generations=REFINE_GENERATIONS, sigma=_REFINE_SIGMA,
        start=info["anchors"],
    )  # fmt: skip
    return np.log(placement.score(problem, contexts, found))

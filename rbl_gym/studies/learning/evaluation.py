"""Policies and references on the same held-out worlds, with confidence intervals.

The loss L of a policy in a world is the mean of log b: of the final layout in a placement task, of
all steps in a task with a filter in the loop. If anchors have a price, L is minus the mean reward.
The normalised score is (L_random - L) / (L_random - L_best). L_best is the loss of the strongest
reference. In a placement task it is that of the best layout in each world over the strongest
searches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import placement
from rbl_gym.checks import FloatArray, check_one_of
from rbl_gym.placement import layouts, search
from rbl_gym.placement.problem import Context, PlacementTask
from rbl_gym.studies.learning import rollouts
from rbl_gym.studies.learning.left_out import left_out
from rbl_gym.studies.learning.own_policies import PolicyLike, policies_by_label
from rbl_gym.studies.learning.policies import check_fit
from rbl_gym.studies.learning.rl_tasks import RlTask, task_of
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.wrappers import controllers

__all__ = ["Layouts", "evaluate", "held_out_returns", "layouts_of", "references"]

# The reference with one layout for all contexts, and the number of contexts for its search.
_ONE_LAYOUT, _TRAINING_CONTEXTS = "one-for-all", 64
# Row of the best layouts of the strongest searches.
BEST_KNOWN = "best-known"
# Random layouts of each context, and gradient evaluations that refine a policy's layout.
_RANDOM_TRIES = 8
REFINE_EVALUATIONS = 20
_RESAMPLES = 2000


def references(task: RlTask) -> list[str]:
    """Return the names of a task's references; the last are the `strongest`."""
    if task.env_id == "RBL/AnchorPlacement-v0":
        if task.arguments.get("mode") == "mounts":
            return ["random", "greedy", "greedy-swaps"]
        last = search.STRONGEST
        others = [name for name in search.SEARCHES if name not in last]
        # There is no single layout for different rooms.
        one = [] if "scenes" in task.arguments else [_ONE_LAYOUT]
        return [*layouts.LAYOUTS, *one, *others, *last]
    return list(_controllers(task))


def strongest(task: RlTask) -> list[str]:
    """Return the references whose best result in each world defines the score 1."""
    known = references(task)
    return known[-len(search.STRONGEST) :] if known[-1] in search.STRONGEST else known[-1:]


def _controllers(task: RlTask) -> dict[str, controllers.Controller]:
    """Return the references of a task with a filter in the loop."""
    mobile = task.env_id == "RBL/MobileAnchors-v0"
    return controllers.MOBILE if mobile else controllers.SELECTION


def _generator(task: RlTask, name: str, seed: int) -> np.random.Generator:
    """Return the random numbers of a reference, which do not depend on the other references."""
    return np.random.default_rng([seed, references(task).index(name)])


def reference_player(task: RlTask, name: str, seed: int) -> Callable[[Any, Any], FloatArray]:
    """Return a reference of a task with a filter in the loop, for one run over the worlds."""
    controller, rng = _controllers(task)[name], _generator(task, name, seed)
    return lambda env, _: controller(env, rng)


def evaluate(
    task: Any,
    policies: Any = None,
    names: Sequence[str] | None = None,
    worlds: int = 256,
    seed: int = 0,
    advance: Advance = silent,
) -> dict[str, Any]:
    """Return losses of policies and references on the same `worlds` held-out worlds.

    Parameters
    ----------
    task
        A task, its name (`rl_tasks.TASKS`), or an environment of one of these tasks. Its arguments
        are used; it is not changed.
    policies
        One policy or a dict by label: anything that `own_policies.policy_like` takes, for example a
        function ``observation -> actions``, where both are arrays of all worlds. A placement task
        also refines each by a few gradient steps, as ``LABEL + gradient``.
    names
        Names of `references`; None: all. ``random`` and the strongest are always included, except
        without the package they need. ``best-known`` is the best of several in each world.
    worlds, seed
        Number and seed of the worlds.
    advance
        Called after each reference and policy.

    Returns
    -------
    A dict. ``methods[LABEL]`` has ``loss`` and ``loss_std_error``, ``score_m`` (None if the loss is
    not a mean of log b), ``normalised``, ``normalised_low`` and ``normalised_high``.

    Raises
    ------
    ValueError
        If a reference is unknown, or a policy does not fit the task.

    Examples
    --------
    >>> import numpy as np
    >>> from rbl_gym.studies.learning.evaluation import evaluate
    >>> result = evaluate(
    ...     "selection", lambda seen: np.ones((len(seen), 12)), names=["nearest"], worlds=2
    ... )
    >>> list(result["methods"])
    ['random', 'nearest', 'greedy-with-map', 'policy']
    """
    task, policies = task_of(task), policies_by_label(policies)
    skipped = left_out(references(task), names or ())
    known = [name for name in references(task) if name not in skipped]
    names = [check_one_of("reference", name, known) for name in (known if names is None else names)]
    best_of = [name for name in strongest(task) if name not in skipped]
    names = [name for name in known if name in {*names, known[0], *best_of}]
    play = _placement_losses if task.env_id == "RBL/AnchorPlacement-v0" else _loop_losses
    losses = play(task, policies, names, worlds, seed, advance)
    best = best_of[0] if len(best_of) == 1 else BEST_KNOWN
    if best == BEST_KNOWN:
        losses[best] = np.min([losses[name] for name in best_of], axis=0)
    rng = np.random.default_rng([seed, len(references(task)) + 1])
    resamples = rng.integers(worlds, size=(_RESAMPLES, worlds))
    methods: dict[str, dict[str, Any]] = {
        name: _figures(loss, losses["random"], losses[best], resamples)
        for name, loss in losses.items()
    }
    for figures in methods.values():
        figures["score_m"] = math.exp(figures["loss"]) if _is_log_score(task) else None
    return {
        "worlds": worlds,
        "seed": seed,
        "best_reference": best,
        "best_of": best_of,
        "skipped": skipped,
        "methods": methods,
    }


def _is_log_score(task: RlTask) -> bool:
    """Return whether losses are means of log b. With a price or another reward they are not."""
    own = task.arguments.get("reward", "belief") != "belief"
    placed = task.env_id == "RBL/AnchorPlacement-v0"
    return placed or not (own or task.arguments.get("mode") == "priced")


def held_out_returns(task: RlTask, policy: PolicyLike, worlds: int, seed: int) -> dict[str, Any]:
    """Return sums of rewards of a saved policy and of random actions, in the worlds of `evaluate`.

    The returns of a training differ: its actions are random around the policy's, in other worlds.

    Parameters
    ----------
    task, policy
        The task and its policy.
    worlds, seed
        Number and seed of the worlds.
    """
    check_fit(policy, str(policy.meta.get("task")), task.make(1))

    def by_chance(env: Any, _: np.ndarray) -> np.ndarray:
        return env.action_space.sample()

    result: dict[str, Any] = {"worlds": worlds}
    for name, act in (("policy", policy.player()), ("random", by_chance)):
        returns = rollouts.returns(task, act, worlds, seed)[0]
        result[f"{name}_mean_return"] = float(returns.mean())
        spread = float(returns.std(ddof=1)) if worlds > 1 else 0.0
        result[f"{name}_std_error"] = spread / math.sqrt(worlds)
    return result


def _figures(
    loss: FloatArray, random: FloatArray, best: FloatArray, resamples: np.ndarray
) -> dict[str, float]:
    """Return mean loss, and the normalised score with a paired bootstrap interval."""
    means = [array[resamples].mean(axis=-1) for array in (random, loss, best)]
    normalised = (means[0] - means[1]) / (means[0] - means[2])
    low, high = np.quantile(normalised, [0.025, 0.975])
    return {
        "loss": float(loss.mean()),
        "loss_std_error": float(loss.std(ddof=1) / math.sqrt(len(loss))) if len(loss) > 1 else 0.0,
        "normalised": float((random.mean() - loss.mean()) / (random.mean() - best.mean())),
        "normalised_low": float(low),
        "normalised_high": float(high),
    }


def _of_all(
    task: RlTask,
    policies: dict[str, PolicyLike],
    names: list[str],
    advance: Advance,
    of_reference: Callable[[str], Any],
    of_policy: Callable[[PolicyLike], Any],
) -> dict[str, Any]:
    """Run one function on references, and another on policies.

    Raises ValueError for unfit policies or equal labels, before the slow references.
    """
    envs = task.make(1)
    for label, policy in policies.items():
        if label in {*references(task), BEST_KNOWN}:
            raise ValueError(f"policy {label!r} has the name of a reference: rename it")
        check_fit(policy, label, envs)
    advance(0, more=len(names) + len(policies))
    # Policies first: if one fails, it does so before the slow references.
    played = {}
    for label, policy in policies.items():
        played[label] = of_policy(policy)
        advance()
    found = {}
    for name in names:
        found[name] = of_reference(name)
        advance()
    return found | played


# # --- step-by-step tasks -----------------------------------------------------------------------


def _loop_losses(
    task: RlTask,
    policies: dict[str, PolicyLike],
    names: list[str],
    worlds: int,
    seed: int,
    advance: Advance,
) -> dict[str, FloatArray]:
    def losses(act: Callable[[Any, Any], FloatArray]) -> FloatArray:
        returns, steps = rollouts.returns(task, act, worlds, seed)
        return -returns / steps

    return _of_all(
        task,
        policies,
        names,
        advance,
        lambda name: losses(reference_player(task, name, seed)),
        lambda policy: losses(policy.player()),
    )


# --- placement --------------------------------------------------------------------------------


def _placement_losses(
    task: RlTask,
    policies: dict[str, PolicyLike],
    names: list[str],
    worlds: int,
    seed: int,
    advance: Advance,
) -> dict[str, FloatArray]:
    groups = layouts_of(task, policies, names, worlds, seed, advance)
    if task.arguments.get("mode") != "mounts":
        advance(0, more=len(policies))
        rng = np.random.default_rng([seed, len(references(task))])
        for label in policies:
            for problem, contexts, found in groups:
                found[f"{label} + gradient"] = search.along_gradient(
                    problem, contexts, rng, REFINE_EVALUATIONS, found[label]
                )
            advance()
    return {
        name: np.concatenate(
            [_loss_of(problem, contexts, found[name]) for problem, contexts, found in groups]
        )
        for name in groups[0].found
    }


class Layouts(NamedTuple):
    """Layouts of C contexts of one problem.

    Attributes
    ----------
    problem, contexts
        The placement problem, and the work regions.
    found
        Layouts (C, M, 3) by label; random layouts are (C, 8, M, 3).
    """

    problem: PlacementTask
    contexts: Context
    found: dict[str, FloatArray]


def layouts_of(
    task: RlTask,
    policies: dict[str, PolicyLike],
    names: list[str],
    worlds: int,
    seed: int,
    advance: Advance = silent,
) -> list[Layouts]:
    """Return layouts of references and policies in held-out contexts.

    Parameters
    ----------
    task
        A placement task.
    policies, names
        Policies by label, and names of `references`.
    worlds, seed
        Number and seed of the contexts.
    advance
        Called after each reference and policy.

    Returns
    -------
    One entry for all contexts together; if scenes are random, one entry for each world.
    """
    problems = _problems(task, worlds, seed)

    def reference(name: str) -> list[FloatArray]:
        rng = _generator(task, name, seed)
        return [_reference_layout(task, *one, name, rng) for one in problems]

    found = _of_all(
        task,
        policies,
        names,
        advance,
        reference,
        lambda policy: _policy_layouts(task, policy, worlds, seed, problems),
    )
    return [
        Layouts(*one, {name: several[i] for name, several in found.items()})
        for i, one in enumerate(problems)
    ]


def _problems(task: RlTask, worlds: int, seed: int) -> list[tuple[PlacementTask, Context]]:
    env, _, _ = rollouts.held_out(task, worlds, seed)
    if "scenes" not in task.arguments:
        return [(env.task, env.contexts)]
    contexts = (Context(*(field[None] for field in env.problem(i))) for i in range(worlds))
    return list(zip(env.tasks, contexts, strict=True))


def _reference_layout(
    task: RlTask, problem: PlacementTask, contexts: Context, name: str, rng: np.random.Generator
) -> FloatArray:
    worlds = len(contexts.centre)
    if task.arguments.get("mode") == "mounts":
        candidates = placement.mounts(problem)
        if name == "random":
            draws = rng.random((worlds, _RANDOM_TRIES, len(candidates)))
            return candidates[draws.argsort(axis=-1)[..., : problem.n_anchors]]
        return search.greedy(
            problem, contexts, rng, candidates=candidates, swaps=name == "greedy-swaps"
        )
    if name == "random":
        shape = (worlds, _RANDOM_TRIES, problem.n_anchors, 3)
        return problem.scene.anchor_region.draw(rng.random(shape))
    if name == _ONE_LAYOUT:
        training = placement.draw_contexts(problem, rng, (_TRAINING_CONTEXTS,))
        one = search.shared_layout(problem, training, rng)
        return np.broadcast_to(one, (worlds, *one.shape))
    return {**layouts.LAYOUTS, **search.SEARCHES}[name](problem, contexts, rng)


def _policy_layouts(
    task: RlTask,
    policy: PolicyLike,
    worlds: int,
    seed: int,
    problems: list[tuple[PlacementTask, Context]],
) -> list[FloatArray]:
    anchors: Any = None
    for _, _, ends, info in rollouts.steps(task, policy.player(), worlds, seed):
        anchors = info["anchors"].copy() if anchors is None else anchors
        anchors[ends] = info["anchors"][ends]
    if "scenes" not in task.arguments:
        return [anchors]
    several = zip(anchors, problems, strict=True)
    return [own[None, : problem.n_anchors] for own, (problem, _) in several]


def _loss_of(problem: PlacementTask, contexts: Context, anchors: FloatArray) -> FloatArray:
    """Return log scores (C,) of layouts, the mean if there are several."""
    if anchors.ndim == 4:
        scores = placement.score(problem, search.expand(contexts), anchors)
        return np.log(scores).mean(axis=-1)
    return np.log(placement.score(problem, contexts, anchors))

"""Frames of trained policies, step by step, beside references."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from rbl_gym import placement
from rbl_gym.checks import FloatArray, check_one_of
from rbl_gym.studies.learning import evaluation, policies, rollouts
from rbl_gym.studies.learning.rl_tasks import HELD_OUT_SEED, SEED_STRIDE, RlTask, rl_task
from rbl_gym.studies.learning.trained_worlds import common_worlds
from rbl_gym.studies.watching.frames import Frame
from rbl_gym.studies.watching.played import env_frames
from rbl_gym.studies.watching.program import Disturb, Program, env_program

__all__ = ["learned_frames", "learned_program", "played_program"]

Policy = policies.AnyPolicy


def learned_program(
    path: str, reference: str | None = None, seed: int = 0, scene: Any = None
) -> Program:
    """Return the program of a trained policy in a held-out world, beside a reference.

    Parameters
    ----------
    path
        File of a policy of `rbl-gym train`.
    reference
        A name of `evaluation.references`; None: the strongest, for placement ``"gradient"``.
    seed
        Seed of the world, the first one of `rbl-gym evaluate` with this seed.
    scene
        Scene in place of that of the training, as in `RlTask.in_worlds`.

    Raises
    ------
    ValueError
        If the file is not a policy, its task or the reference is unknown, or it does not fit.
    """
    policy = policies.load(path)
    name = str(policy.meta.get("task"))
    worlds = common_worlds(name, {Path(path).name: policy}) if scene is None else {"scene": scene}
    task = rl_task(name).in_worlds(**worlds)
    known = evaluation.references(task)
    if reference is None:
        reference = "gradient" if "gradient" in known else known[-1]
    check_one_of("reference", reference, known)
    policies.check_fit(policy, Path(path).name, task.make(1))

    def start(_: tuple[str, ...], seed: int, disturb: Disturb) -> Iterator[Frame]:
        return learned_frames(task, policy, reference, seed)

    env = _env(task)
    shown = env_program(env, None, _held_out(seed))
    title = f"{name}: {Path(path).stem}"
    return Program(title, shown.room, shown.tags, start, shown.filters, seed)


def played_program(
    path: str, env: gym.Env[Any, Any], filters: Iterable[str] | None = None, seed: int = 0
) -> Program:
    """Return the program of a trained policy in a given environment.

    Parameters
    ----------
    path
        File of a policy (`policies.save`).
    env
        Environment, scalar, with the observation and the actions of the policy.
    filters, seed
        As for `env_program`.

    Raises
    ------
    ValueError
        If the file is not a policy, or does not fit.
    """
    policy = policies.load(path)
    policies.check_fit(policy, Path(path).name, env)
    play = policy.player()
    shown = env_program(env, filters, seed, lambda env, seen: play(env, seen))

    def start(labels: tuple[str, ...], seed: int, disturb: Disturb) -> Iterator[Frame]:
        nonlocal play
        # A policy with a memory forgets it.
        play = policy.player()
        return shown.start(labels, seed, disturb)

    return dataclasses.replace(shown, title=f"{shown.title}: {Path(path).stem}", start=start)


def learned_frames(task: RlTask, policy: Policy, reference: str, seed: int) -> Iterator[Frame]:
    """Yield frames of a held-out episode that a policy plays, beside a reference.

    The ghosts of a frame are the reference's anchors at the same step. Scores are those up to this
    step: in a placement the score of the anchors placed so far, else the geometric mean of b over
    the steps.

    Parameters
    ----------
    task, policy
        The task and its policy.
    reference
        A name of `evaluation.references`.
    seed
        Seed of the world.
    """
    env = _env(task)
    frames = env_frames(env, (), _held_out(seed), policy.player())
    if task.env_id == "RBL/AnchorPlacement-v0":
        groups = evaluation.layouts_of(task, {}, [reference], 1, seed)
        problem, context, found = groups[0]
        anchors = found[reference][0]
        anchors = anchors if anchors.ndim == 2 else anchors[0]
        score = float(placement.score(problem, context, anchors[None])[0])
        for frame in frames:
            yield frame._replace(ghosts={reference: anchors}, scores={reference: score})
        return
    logs: list[float] = []
    others: list[float] = []
    beside = _reference_steps(task, reference, seed)
    for frame, (anchors, score) in zip(frames, beside, strict=False):
        # No action precedes the reset.
        if frame.time_s > 0:
            logs.append(math.log(frame.score_m))
            others.append(math.log(score))
        yield frame._replace(
            score_m=_mean(logs), ghosts={reference: anchors}, scores={reference: _mean(others)}
        )


def _mean(logs: list[float]) -> float:
    return math.exp(float(np.mean(logs))) if logs else np.nan


def _reference_steps(task: RlTask, name: str, seed: int) -> Iterator[tuple[FloatArray, float]]:
    """Yield anchors (M, 3) and b, metres, of a held-out episode from its reset on."""
    act = evaluation.reference_player(task, name, seed)
    env, seen, info = rollouts.held_out(task, 1, seed)
    while True:
        yield env.inner_observation["anchors"][0].copy(), float(info["score_m"][0])
        seen, _, terminated, truncated, info = env.step(act(env, seen))
        if (terminated | truncated).any():
            yield env.inner_observation["anchors"][0].copy(), float(info["score_m"][0])
            return


def _env(task: RlTask) -> gym.Env[Any, Any]:
    return gym.make(f"rbl_gym:{task.env_id}", **task.arguments)


def _held_out(seed: int) -> int:
    return HELD_OUT_SEED + SEED_STRIDE * seed

"""A policy for choosing anchors by predicted sight, trained on simulated sight.

A simulated hall gives the sight of every anchor, so the training is supervised. It follows bodies
through random halls, chooses anchors by the prediction and remembers the sight of those. The loss
covers all anchors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from rbl_gym.checks import FloatArray
from rbl_gym.studies.learning.deep_sets import DeepSets
from rbl_gym.studies.learning.set_networks import SetNetwork
from rbl_gym.worlds import simulation
from rbl_gym.worlds.families import SceneFamily
from rbl_gym.wrappers.sight_tokens import EVENT, QUERY, forgotten, remember, sight_tokens

__all__ = ["train_sight"]

# Tracks at once; samples of an update; uses of each sample.
_TRACKS, _SAMPLES, _EPOCHS = 128, 256, 2
_LEARNING_RATE, _CLIP = 3e-3, 1.0
# Share of random choices; error of a belief's position, metres; its standard deviation before the
# ranges of a step, metres.
_RANDOM, _ERROR_M, _SPREAD_M = 0.15, 0.06, (0.05, 0.3)


class _Tracks(NamedTuple):
    """Bodies (B, T + 1, 3) among anchors (B, M, 3), and sight (B, T + 1, M): 1 or -1."""

    body: FloatArray
    anchors: FloatArray
    mask: FloatArray
    sight: FloatArray
    middle: FloatArray
    half: FloatArray
    # Variance of a position from the ranges of one anchor, at the bodies (B, T + 1, M).
    variance: FloatArray


def train_sight(
    family: SceneFamily, k: int, steps: int, seed: int, advance: Callable[[int], None]
) -> tuple[SetNetwork, list[dict[str, float]]]:
    """Train the network of a policy that chooses anchors in the scenes of a family.

    Parameters
    ----------
    family
        The family of scenes.
    k
        Number of anchors chosen in a step.
    steps
        Steps of all bodies together.
    seed
        Seed of scenes, tracks and network.
    advance
        Called with the number of finished steps.

    Returns
    -------
    The network, and the learning curve: steps, and the mean log-likelihood of the sight.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = SetNetwork(QUERY, EVENT, 1, inner=(32, 32), outer=(64, 64))
    optimizer = torch.optim.Adam(network.parameters(), lr=_LEARNING_RATE)
    rounds = max(1, round(steps / (_TRACKS * family.steps)))
    curve = []
    for done in range(rounds):
        for group in optimizer.param_groups:
            group["lr"] = _LEARNING_RATE * max(0.02, 1 - done / rounds)
        tracks = _draw(family, rng)
        samples = _followed(tracks, network.arrays(), k, rng)
        losses = []
        for _ in range(_EPOCHS):
            for rows in np.array_split(
                rng.permutation(len(samples[0])), -(-len(samples[0]) // _SAMPLES)
            ):
                own, pairs, others, mask, clear = (torch.from_numpy(one[rows]) for one in samples)
                expected = network(own, pairs, others)[..., 0]
                loss = torch.nn.functional.binary_cross_entropy_with_logits(
                    expected, clear, weight=mask, reduction="sum"
                )
                loss = loss / mask.sum()
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(network.parameters(), _CLIP)
                optimizer.step()
                losses.append(float(loss.detach()))
        curve.append(
            {
                "steps": (done + 1) * _TRACKS * family.steps,
                "mean_log_likelihood": -float(np.mean(losses)),
            }
        )
        advance(_TRACKS * family.steps)
    return network, curve


def _draw(family: SceneFamily, rng: np.random.Generator) -> _Tracks:
    shape, most = (_TRACKS, family.steps + 1), family.n_anchors
    body, sight = np.zeros((*shape, 3)), np.ones((*shape, most))
    variance = np.ones((*shape, most))
    anchors, mask = np.zeros((_TRACKS, most, 3)), np.zeros((_TRACKS, most))
    corners = np.zeros((_TRACKS, 2, 3))
    for row in range(_TRACKS):
        scene, _ = family.draw(rng)
        one, m = simulation.draw_episode(scene, rng), scene.n_anchors
        # After the end of a shorter episode the body stands still.
        body[row] = one.translation[np.minimum(np.arange(shape[1]), scene.steps)]
        anchors[row, :m], mask[row, :m] = one.anchors, 1.0
        if scene.obstacles:
            seen = scene.obstruction.share(one.anchors, body[row])
            sight[row, :, :m] = np.where(seen > 0.5, 1.0, -1.0)
        far = np.linalg.norm(body[row, :, None] - one.anchors, axis=-1)
        law = scene.noise.variance(far[..., None])[..., 0] / len(scene.tags)
        variance[row, :, :m] = law
        corners[row] = scene.volume.bounds()
    half = np.maximum(0.5 * (corners[:, 1] - corners[:, 0]), 1.0)
    return _Tracks(body, anchors, mask, sight, corners.mean(axis=1), half, variance)


def _followed(
    tracks: _Tracks, network: DeepSets, k: int, rng: np.random.Generator
) -> list[np.ndarray]:
    """Return elements, pairs, masks and targets (S, M, ...) of all steps of all tracks."""
    batch, epochs, most = tracks.sight.shape
    memory, samples = forgotten(batch, most), []
    spread = rng.uniform(*_SPREAD_M, batch)
    for t in range(1, epochs):
        believed = tracks.body[:, t] + _ERROR_M * rng.standard_normal((batch, 3))
        tokens = sight_tokens(tracks.anchors, believed, memory, tracks.middle, tracks.half)
        tokens = [one.astype(np.float32) for one in tokens]
        clear = (tracks.sight[:, t] > 0).astype(np.float32)
        samples.append((*tokens, tracks.mask.astype(np.float32), clear))
        likely = 1 / (1 + np.exp(-network(*tokens)[..., 0]))
        chosen = _chosen(tracks, t, likely, spread, k, rng)
        memory = remember(memory, chosen, believed, tracks.sight[:, t])
    return [np.concatenate(field) for field in zip(*samples, strict=True)]


def _chosen(
    tracks: _Tracks,
    t: int,
    likely: FloatArray,
    spread_m: FloatArray,
    k: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return k anchors of each world, greedily by their position information; some at random."""
    gap = tracks.body[:, t, None] - tracks.anchors
    unit = gap / np.linalg.norm(gap, axis=-1, keepdims=True)
    weight = likely * tracks.mask / tracks.variance[:, t]
    covariance = spread_m[:, None, None] ** 2 * np.eye(3)
    chosen, rows = np.zeros(likely.shape, dtype=np.bool_), np.arange(len(likely))
    for _ in range(k):
        gain = weight * np.einsum("bmi,bij,bmj->bm", unit, covariance, unit)
        gain = np.where(rng.random((len(rows), 1)) < _RANDOM, rng.random(gain.shape), gain)
        pick = np.where(chosen | (tracks.mask == 0), -1.0, gain).argmax(axis=-1)
        chosen[rows, pick] = True
        turned = (covariance @ unit[rows, pick][..., None])[..., 0]
        part = weight[rows, pick] / (
            1 + weight[rows, pick] * (unit[rows, pick] * turned).sum(axis=-1)
        )
        covariance = covariance - part[:, None, None] * turned[:, :, None] * turned[:, None, :]
    return chosen & (tracks.mask > 0)

"""The network of `amortised`.

Tokens of the problem and one token for each anchor attend to each other.
"""

from __future__ import annotations

import math

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.tokens import Tokens

__all__ = ["chosen", "forward", "pattern", "shapes"]

# Largest number of anchors, and number of attention heads.
MOST, HEADS = 16, 4


def shapes(sizes: dict[str, int], width: int, layers: int) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of the weights; `sizes` are the lengths of the token rows."""
    found: dict[str, tuple[int, ...]] = {
        f"{kind}.weight": (sizes[kind], width) for kind in Tokens._fields
    }
    found |= {"candidates.bias": (width,), "candidates.mix": (width, width)}
    found |= {"ordinal": (MOST, width), "count": (MOST, width), "pattern.weight": (3, width)}
    for layer in range(layers):
        name = f"layer{layer}"
        for norm in ("first", "second"):
            found |= {f"{name}.{norm}.scale": (width,), f"{name}.{norm}.bias": (width,)}
        found |= {f"{name}.query": (width, width), f"{name}.seen": (width, 2 * width)}
        found |= {f"{name}.out": (width, width), f"{name}.up": (width, 4 * width)}
        found |= {f"{name}.up.bias": (4 * width,), f"{name}.down": (4 * width, width)}
    found |= {"last.scale": (width,), "last.bias": (width,)}
    found |= {"action": (width, 3), "action.bias": (3,)}
    return found | {"point.query": (width, width), "point.key": (width, width)}


def pattern(count: int) -> FloatArray:
    """Return a ring (M, 3), alternately low and high, to which the network's steps are added."""
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    height = np.where(np.arange(count) % 2, 0.5, -0.5)
    return np.stack([np.cos(angle), np.sin(angle), height], axis=-1)


def forward(
    weights: dict[str, FloatArray], tokens: Tokens, count: int, total: int
) -> tuple[FloatArray, FloatArray]:
    """Return steps (..., M, 3) of the anchors, and scores (..., M, C) of the candidates.

    Parameters
    ----------
    weights
        Weights of a `Network`.
    tokens
        Tokens of the problem.
    count, total
        Number of placed anchors, and of all anchors with the fixed ones.
    """
    w = weights
    width, numbers = w["ordinal"].shape[1], w["ordinal"].dtype
    tokens = Tokens(*(rows.astype(numbers) for rows in tokens))
    batch = tokens.world.shape[:-2]
    ring = pattern(count).astype(numbers)
    anchors = w["ordinal"][:count] + w["count"][min(total, MOST) - 1] + ring @ w["pattern.weight"]
    rows, masks = [], []
    for kind in ("world", "zones", "obstacles", "fixed"):
        row = getattr(tokens, kind)
        if row.shape[-2]:
            rows.append(row @ w[f"{kind}.weight"])
            masks.append(row[..., 0] > 0)
    rows.append(np.broadcast_to(anchors, (*batch, count, width)))
    masks.append(np.ones((*batch, count), dtype=np.bool_))
    x = np.concatenate(rows, axis=-2)
    spots = _silu(tokens.candidates @ w["candidates.weight"] + w["candidates.bias"])
    spots = spots @ w["candidates.mix"]
    real = tokens.candidates[..., 0] > 0
    mask = np.concatenate([*masks, real], axis=-1)
    hidden = None if mask.all() else np.where(mask, 0.0, -np.inf)[..., None, None, :]
    layer = 0
    while (name := f"layer{layer}") + ".query" in w:
        y = _normed(x, w[f"{name}.first.scale"], w[f"{name}.first.bias"])
        seen = np.concatenate([y, spots], axis=-2) @ w[f"{name}.seen"]
        key, value = _heads(seen[..., :width]), _heads(seen[..., width:])
        query = _heads(y @ w[f"{name}.query"]) * (HEADS / width) ** 0.5
        attention = query @ np.swapaxes(key, -1, -2)
        if hidden is not None:
            attention = attention + hidden
        attention = np.exp(attention - attention.max(axis=-1, keepdims=True))
        attention /= attention.sum(axis=-1, keepdims=True)
        mixed = np.swapaxes(attention @ value, -2, -3)
        x = x + mixed.reshape(x.shape) @ w[f"{name}.out"]
        y = _normed(x, w[f"{name}.second.scale"], w[f"{name}.second.bias"])
        x = x + _silu(y @ w[f"{name}.up"] + w[f"{name}.up.bias"]) @ w[f"{name}.down"]
        layer += 1
    x = _normed(x[..., -count:, :], w["last.scale"], w["last.bias"])
    steps = x @ w["action"] + w["action.bias"] + ring
    key = spots @ w["point.key"]
    scores = (x @ w["point.query"]) @ np.swapaxes(key, -1, -2) / math.sqrt(width)
    return steps, np.where(real[..., None, :], scores, -np.inf)


def chosen(scores: FloatArray) -> np.ndarray:
    """Return the candidates (..., M) with the largest scores (..., M, C), each at most once."""
    scores = scores.copy()
    found = []
    for m in range(scores.shape[-2]):
        best = scores[..., m, :].argmax(axis=-1)[..., None]
        found.append(best)
        if scores.shape[-1] > m + 1:
            np.put_along_axis(scores, best[..., None, :], -np.inf, axis=-1)
    return np.concatenate(found, axis=-1)


def _heads(x: FloatArray) -> FloatArray:
    return np.swapaxes(x.reshape(*x.shape[:-1], HEADS, -1), -2, -3)


def _normed(x: FloatArray, scale: FloatArray, bias: FloatArray) -> FloatArray:
    x = x - x.mean(axis=-1, keepdims=True)
    return x / np.sqrt((x**2).mean(axis=-1, keepdims=True) + 1e-5) * scale + bias


def _silu(x: FloatArray) -> FloatArray:
    return x / (1 + np.exp(-x))

"""The network of `placement.amortised` in torch, and the score of a layout with its gradient.

Lengths are in units of the problem, with the origin in the centre of the work zones.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from rbl_gym.measurements.gain import Gain
from rbl_gym.placement import attention
from rbl_gym.placement.gradient import square_and_gradient

_HEADS = attention.HEADS


class Network(nn.Module):
    """Attention over the tokens of a problem and one token for each anchor.

    `sizes` are the row lengths of `tokens.Tokens`, `width` that of the network's tokens.
    """

    def __init__(self, sizes: dict[str, int], width: int = 64, layers: int = 4) -> None:
        super().__init__()
        arrays: dict[str, tuple[int, ...]] = attention.shapes(sizes, width, layers)
        self.weights = nn.ParameterDict()
        for name, shape in arrays.items():
            if name.endswith("bias"):
                value = torch.zeros(shape)
            elif name.endswith("scale"):
                value = torch.ones(shape)
            elif name in ("ordinal", "count"):
                value = 0.3 * torch.randn(shape)
            else:
                value = torch.randn(shape) / math.sqrt(shape[0])
                if name.endswith(("out", "down", "action")):
                    value = value * (0.1 if name == "action" else 1 / math.sqrt(2 * layers))
            self.weights[name.replace(".", "/")] = nn.Parameter(value)
        self.layers = layers

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the weights in the form of `placement.amortised`."""
        return {
            name.replace("/", "."): value.detach().numpy() for name, value in self.weights.items()
        }

    def forward(self, tokens: Any, count: int, total: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return steps (B, M, 3) and scores of candidates (B, M, C), as `attention.forward`."""
        w = {name.replace("/", "."): value for name, value in self.weights.items()}
        rows, masks = [], []
        for kind in ("world", "zones", "obstacles", "fixed"):
            row = getattr(tokens, kind)
            rows.append(row @ w[f"{kind}.weight"])
            masks.append(row[..., 0] > 0)
        batch = rows[0].shape[0]
        pattern = torch.as_tensor(attention.pattern(count), dtype=rows[0].dtype)
        anchors = w["ordinal"][:count] + w["count"][min(total, attention.MOST) - 1]
        anchors = anchors + pattern @ w["pattern.weight"]
        rows.append(anchors.expand(batch, -1, -1))
        masks.append(torch.ones(batch, count, dtype=torch.bool))
        x, mask = torch.cat(rows, dim=1), torch.cat(masks, dim=1)
        spots = functional.silu(tokens.candidates @ w["candidates.weight"] + w["candidates.bias"])
        spots = spots @ w["candidates.mix"]
        mask = torch.cat([mask, tokens.candidates[..., 0] > 0], dim=1)[:, None, None, :]
        width = x.shape[-1]
        for layer in range(self.layers):
            name = f"layer{layer}"
            y = functional.layer_norm(
                x, (width,), w[f"{name}.first.scale"], w[f"{name}.first.bias"]
            )
            query = y @ w[f"{name}.query"]
            seen = torch.cat([y, spots], dim=1) @ w[f"{name}.seen"]
            key, value = seen.split(width, dim=-1)
            query, key, value = (
                part.unflatten(-1, (_HEADS, -1)).transpose(1, 2) for part in (query, key, value)
            )
            y = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
            x = x + y.transpose(1, 2).flatten(-2) @ w[f"{name}.out"]
            y = functional.layer_norm(
                x, (width,), w[f"{name}.second.scale"], w[f"{name}.second.bias"]
            )
            y = functional.silu(y @ w[f"{name}.up"] + w[f"{name}.up.bias"])
            x = x + y @ w[f"{name}.down"]
        x = functional.layer_norm(x[:, -count:], (width,), w["last.scale"], w["last.bias"])
        steps = x @ w["action"] + w["action.bias"] + pattern
        key = spots @ w["point.key"]
        scores = (x @ w["point.query"]) @ key.transpose(1, 2) / math.sqrt(width)
        return steps, scores.masked_fill(tokens.candidates[:, None, :, 0] <= 0, -torch.inf)


class Case(NamedTuple):
    """A batch of problems of one family in their own units, as tensors.

    Tags (B, N, 3); parameters (B,) of the noise; poses (B, P, 3, 3), (B, P, 3), their weights (B,
    P), and the information (B, P, 6, 6) besides new anchors; corners (B, 3) of the region; radii
    (B,) and centre (B, 3) of a shell; obstacles (B, K, 6), and the share (B,) of a link's
    information that they leave.
    """

    tags: torch.Tensor
    floor: torch.Tensor
    growth: torch.Tensor
    rotation: torch.Tensor
    places: torch.Tensor
    weight: torch.Tensor
    prior: torch.Tensor
    low: torch.Tensor
    high: torch.Tensor
    inner: torch.Tensor
    outer: torch.Tensor
    middle: torch.Tensor
    boxes: torch.Tensor
    left: torch.Tensor


class _Clip(torch.autograd.Function):
    """Clip to limits. The gradient passes except if it pushes further out."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(x, low, high)
        return torch.minimum(torch.maximum(x, low), high)

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> Any:
        x, low, high = ctx.saved_tensors
        (slope,) = slopes
        # A step goes against the gradient.
        outward = ((x > high) & (slope < 0)) | ((x < low) & (slope > 0))
        return torch.where(outward, 0.0, slope), None, None


def legal(kind: str, case: Case, points: torch.Tensor) -> torch.Tensor:
    """Return legal points (B, M, 3) of the region for points (B, M, 3), as `amortised.legal`."""
    low, high = case.low[:, None], case.high[:, None]
    if kind == "box":
        return _Clip.apply(points, low, high)
    if kind == "shell":
        away = points - case.middle[:, None]
        radius = away.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        clipped: Any = _Clip.apply(radius, case.inner[:, None, None], case.outer[:, None, None])
        return case.middle[:, None] + away * (clipped / radius)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    action = (points - middle) / half
    reach = torch.maximum(action[..., :2].abs().amax(dim=-1), action[..., 2]).clamp(min=1e-3)
    ray = action / reach[..., None]
    bottom = -torch.ones_like(ray)
    bottom[..., :2] = -2
    ray = _Clip.apply(ray, bottom, -bottom)
    return middle + ray * half


def rows(case: Case, anchors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return rows q (B, P, M, N, 6) of the information of links, and their weights (B, P, M, N)."""
    c = torch.einsum("bpij,bnj->bpni", case.rotation, case.tags)
    s = c + case.places[:, :, None]
    d = s[:, :, None] - anchors[:, None, :, None]
    square = (d**2).sum(dim=-1)
    variance = (case.floor**2)[:, None, None, None] + (case.growth**2)[:, None, None, None] * square
    turn = torch.cross(c[:, :, None].expand_as(d), d, dim=-1)
    return torch.cat([turn, d], dim=-1), 1 / (variance * square)


def information(case: Case, anchors: torch.Tensor, share: torch.Tensor | None) -> torch.Tensor:
    """Return information (B, P, 6, 6) of layouts, including the prior, and shares (B, P, M)."""
    q, weight = rows(case, anchors)
    if share is not None:
        weight = weight * share[..., None]
    # Double precision, because the sum may be nearly singular.
    told = (q * weight.sqrt()[..., None]).flatten(2, 3).double()
    return told.transpose(-1, -2) @ told + case.prior


def parts(case: Case, candidates: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
    """Return information (B, C, P, 6, 6) of each single candidate, and shares (B, P, C)."""
    q, weight = rows(case, candidates)
    told = (q * (weight * share[..., None]).sqrt()[..., None]).double()
    return (told.transpose(-1, -2) @ told).transpose(1, 2)


def log_score(case: Case, told: torch.Tensor) -> torch.Tensor:
    """Return the log score (B,) of information (B, P, 6, 6)."""
    return 0.5 * (case.weight * _Square.apply(told, spread(case))).sum(dim=-1).log()


def spread(case: Case) -> torch.Tensor:
    """Return ``mean_n J_n^T J_n`` (B, P, 6, 6)."""
    c = torch.einsum("bpij,bnj->bpni", case.rotation, case.tags)
    J = c.new_zeros((*c.shape[:-1], 3, 6))
    x, y, z = c.unbind(dim=-1)
    J[..., 0, 1], J[..., 0, 2] = z, -y
    J[..., 1, 0], J[..., 1, 2] = -z, x
    J[..., 2, 0], J[..., 2, 1] = y, -x
    J[..., 3:] = torch.eye(3)
    return torch.einsum("bpnia,bpnic->bpac", J, J) / c.shape[2]


def log_score_in_sight(case: Case, anchors: torch.Tensor) -> torch.Tensor:
    """Return the kernel's log score (B,) of layouts without obstacles, with its gradient."""
    found: Any = _InSight.apply(anchors, case)
    return found


class _InSight(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, anchors: torch.Tensor, case: Case) -> torch.Tensor:
        size, count = anchors.shape[:2]
        places = anchors.detach().double().numpy()
        none = torch.zeros(size)
        law = torch.stack([none, case.floor, case.growth, none - 1], dim=-1)
        arrays = case.rotation, case.places, case.weight, case.prior, case.tags, law
        exact = (x.double().numpy() for x in arrays)
        share = np.ones((1, case.places.shape[1], count, case.tags.shape[1]))
        square, slope = square_and_gradient(
            places, np.zeros_like(places), *exact, Gain().numbers, share
        )
        slope = 0.5 * slope / square[:, None, None]
        ctx.save_for_backward(torch.as_tensor(slope, dtype=anchors.dtype))
        return torch.as_tensor(0.5 * np.log(square), dtype=anchors.dtype)

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> Any:
        return ctx.saved_tensors[0] * slopes[0][:, None, None], None


def some_poses(case: Case, generator: torch.Generator) -> Case:
    """Return the case over a random half of its poses. All poses of a batch have equal weight."""
    index = torch.randperm(case.places.shape[1], generator=generator)[: case.places.shape[1] // 2]
    return case._replace(
        rotation=case.rotation[:, index],
        places=case.places[:, index],
        weight=2 * case.weight[:, index],
        prior=case.prior[:, index],
    )


class _Square(torch.autograd.Function):
    """``tr(S F^-1)``; its derivative is ``-F^-1 S F^-1``."""

    @staticmethod
    def forward(ctx: Any, told: torch.Tensor, S: torch.Tensor) -> torch.Tensor:
        S = S.double()
        P = torch.cholesky_inverse(torch.linalg.cholesky(told))
        ctx.save_for_backward(P, S)
        return (P * S).sum(dim=(-1, -2))

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> Any:
        P, S = ctx.saved_tensors
        return -(P @ S @ P) * slopes[0][..., None, None], None


def sight(case: Case, anchors: torch.Tensor, blur: float) -> torch.Tensor | None:
    """Return shares (B, P, M) of links past boxes; edges of width `blur` give a gradient."""
    if not case.boxes.shape[1]:
        return None
    start, end = anchors[:, None, :, None], case.places[:, :, None, None]
    along = end - start
    boxes = case.boxes[:, None, None]
    safe = torch.where(along.abs() < 1e-6, 1e-6, along)
    away = boxes[..., :3] - start
    low, high = (away - boxes[..., 3:]) / safe, (away + boxes[..., 3:]) / safe
    enter = torch.minimum(low, high).amax(dim=-1).clamp(min=0.0)
    leave = torch.maximum(low, high).amin(dim=-1).clamp(max=1.0)
    way = (leave - enter) * along.norm(dim=-1)
    free = torch.sigmoid(-way / blur).prod(dim=-1)
    left = case.left[:, None, None]
    return left + (1 - left) * free

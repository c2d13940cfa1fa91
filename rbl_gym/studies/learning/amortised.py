"""Training of the network that places anchors, `placement.amortised`.

    python -m rbl_gym.studies.learning.amortised --out out/amortised.npz

The loss is log b of the layout, with b the score of `placement.score` in units of the problem. Its
gradient passes through the Fisher information. If anchors choose among candidates, the
probabilities of one anchor get the exact gradient of the expected loss, while the other anchors
keep their sampled candidates. Needs torch (extra ``rl``).
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rbl_gym.bounds.information import add_range_information
from rbl_gym.checks import FloatArray
from rbl_gym.placement.problem import weighted_square
from rbl_gym.placement.tokens import KINDS, Tokens, tokens_of
from rbl_gym.studies.learning import placement_families, random_buildings
from rbl_gym.studies.learning.random_problems import Batch
from rbl_gym.studies.learning.torch_layouts import (
    Case,
    Network,
    information,
    legal,
    log_score,
    log_score_in_sight,
    parts,
    sight,
    some_poses,
)

__all__ = ["save", "train"]

# Problems of each family per step, in the first round and later.
GROUPS = (
    (("boxes", 32), ("boxes", 32), ("boxes", 32), ("shells", 16), ("rooms", 32), ("buildings", 16)),
    (("boxes", 32), ("boxes", 32), ("shells", 8), ("rooms", 32), ("rooms", 32), ("buildings", 24)),
)
# Steps of the rounds that trained the package's network.
STEPS = (4200, 3000)
# Anchors of a building whose choice gets a gradient in a step.
_CHOICES = 2
# Steps with the same buildings, each with other bodies, noise and mirror images.
_AGAIN = 4
# Peak learning rates of the first round and of the others; warm-up steps; initial weight of the
# entropy of choices.
_RATES, _WARM, _ENTROPY = (2e-3, 1e-3), 150, 0.02
# Initial and final width of the edges of sight past racks, in units of the problem.
_BLUR = (0.06, 0.01)
_WIDTH, _LAYERS = 64, 4
# The saved weights are a moving average with this decay per step.
_FORGET = 0.005


def tensors(tokens: Tokens) -> Any:
    """Return tokens as tensors."""
    return Tokens(*(torch.as_tensor(x, dtype=torch.float32) for x in tokens))


def case_of(batch: Batch) -> Case:
    """Return a batch in its own units, with the information of fixed anchors in the prior."""
    scenery = batch.scenery
    origin, unit = scenery.frame()
    at, by = origin[:, None], unit[:, None, None]
    prior = batch.prior.copy()
    prior[..., 3:, 3:] *= (unit**2)[:, None, None, None]

    def of(x: FloatArray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)

    boxes = scenery.obstacles[..., :6].copy()
    boxes[..., :3] -= at
    case = Case(
        tags=of(scenery.tags / by),
        floor=of(scenery.noise[:, 0] / unit),
        growth=of(scenery.noise[:, 1]),
        rotation=of(batch.rotation),
        places=of((scenery.places - at) / by),
        weight=of(batch.weight),
        prior=torch.as_tensor(prior),
        low=of((scenery.low - origin) / unit[:, None]),
        high=of((scenery.high - origin) / unit[:, None]),
        inner=of(scenery.inner / unit),
        outer=of(batch.outer / unit),
        middle=of(-origin / unit[:, None]),
        boxes=of(boxes / by),
        left=of(batch.left),
    )
    if scenery.fixed.shape[1]:
        told = parts(case, of((scenery.fixed - at) / by), of(batch.fixed_share)).sum(dim=1)
        case = case._replace(prior=case.prior + told)
    return case


def loss_of(
    network: Network, batch: Batch, blur: float, entropy: float, generator: torch.Generator
) -> tuple[torch.Tensor, float]:
    """Return the loss of a batch, to differentiate, and the mean of log b."""
    tokens = tensors(tokens_of(batch.scenery, batch.count))
    steps, scores = network(tokens, batch.count, batch.count + batch.scenery.fixed.shape[1])
    case = case_of(batch)
    kind = KINDS[batch.scenery.kind]
    if kind == "mounts":
        return _choice_loss(case, batch, scores, entropy, generator)
    origin, unit = batch.scenery.frame()
    aim = torch.as_tensor((batch.scenery.aim() - origin) / unit[:, None], dtype=torch.float32)
    anchors = legal(kind, case, aim[:, None] + steps)
    if case.boxes.shape[1]:
        case = some_poses(case, generator)
        told = information(case, anchors, sight(case, anchors, blur))
        loss = log_score(case, told).mean()
    else:
        loss = log_score_in_sight(case, anchors).mean()
    # Penalise long steps: far outside the region there is nothing to learn.
    return loss + 1e-4 * (steps**2).mean(), float(loss.detach())


def _choice_loss(
    case: Case, batch: Batch, scores: torch.Tensor, entropy: float, generator: torch.Generator
) -> tuple[torch.Tensor, float]:
    logs = scores.log_softmax(dim=-1)
    shares = logs.exp()
    size, count, _ = shares.shape
    with torch.no_grad():
        origin, unit = batch.scenery.frame()
        spots = (batch.scenery.candidates - origin[:, None]) / unit[:, None, None]
        told = torch.as_tensor(alone(case, spots, batch.scenery.visibility))
        drawn = torch.multinomial(shares.flatten(0, 1), 1, generator=generator)
        drawn = drawn.view(size, count)
        at = torch.arange(size)[:, None]
        total = case.prior + told[at, drawn].sum(dim=1)
        which = torch.randperm(count, generator=generator)[:_CHOICES]
        without = total[:, None] - told[at, drawn[:, which]]
        tried = without[:, :, None] + told[:, None]
        square = weighted_square(
            tried.numpy(),
            case.rotation.double().numpy()[:, None, None],
            case.tags.double().numpy()[:, None, None],
            case.weight.double().numpy()[:, None, None],
        )
        losses = 0.5 * torch.as_tensor(np.log(square), dtype=torch.float32)
        mean = losses.gather(-1, drawn[:, which][..., None]).mean()
    expected = (shares[:, which] * (losses - losses.mean(dim=-1, keepdim=True))).sum(dim=-1)
    spread = -(shares * logs.clamp(min=-30)).sum(dim=-1)
    loss = expected.sum(dim=-1).mean() * (count / len(which)) - entropy * spread.sum(dim=-1).mean()
    return loss, float(mean)


def alone(case: Case, spots: FloatArray, share: FloatArray) -> FloatArray:
    """Return information (B, C, P, 6, 6) of each candidate (B, C, 3) alone; shares (B, P, C)."""
    tags, rotation, places = (x.double().numpy() for x in (case.tags, case.rotation, case.places))
    floor, growth = case.floor.double().numpy(), case.growth.double().numpy()
    law = np.stack([0 * floor, floor, growth, 0 * floor - 1], axis=-1)
    links = np.swapaxes(share, 1, 2)[..., None, None]
    return add_range_information(
        np.zeros((6, 6)), spots[:, :, None, None], tags[:, None, None], rotation[:, None],
        places[:, None], law[:, None, None],
        np.broadcast_to(links, (*links.shape[:-1], tags.shape[1])),
    )  # fmt: skip


def train(
    steps: Sequence[int], seed: int, log: Callable[[str], object] = print
) -> tuple[Network, dict[str, Any]]:
    """Train a network and return it with its history. Equal arguments give equal networks.

    Parameters
    ----------
    steps
        Steps of each round. The learning rate falls to zero within a round. The next round starts
        from the resulting weights.
    seed
        Seed of all random numbers.
    log
        Called with a line of text after every hundred steps.
    """
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    network = None
    for turn, number in enumerate(steps):
        rng = np.random.default_rng(seed + turn)
        if network is None:
            network = Network(_sizes(rng), _WIDTH, _LAYERS)
        _round(network, number, turn, rng, torch.Generator().manual_seed(seed + turn), log)
    if network is None:
        raise ValueError("steps must name at least one round, got none")
    command = "python -m rbl_gym.studies.learning.amortised --steps "
    command += f"{' '.join(map(str, steps))} --seed {seed}"
    return network, {"command": command, "seed": seed, "steps": list(steps)}


def _round(
    network: Network,
    steps: int,
    turn: int,
    rng: np.random.Generator,
    generator: torch.Generator,
    log: Callable[[str], object],
) -> None:
    """Train the weights for `steps` steps, then replace them by their moving average."""
    mean_of = {name: value.detach().clone() for name, value in network.weights.items()}
    optimizer = torch.optim.AdamW(network.parameters(), lr=_RATES[turn > 0], weight_decay=1e-3)
    means: dict[str, list[float]] = {}
    groups, floors = GROUPS[turn > 0], None
    begin = time.process_time()
    for number in range(steps):
        done = number / steps
        rate = min(1.0, (number + 1) / _WARM) * 0.5 * (1 + math.cos(math.pi * done))
        for group in optimizer.param_groups:
            group["lr"] = _RATES[turn > 0] * rate + 1e-6
        blur = _BLUR[0] * (_BLUR[1] / _BLUR[0]) ** min(1.0, turn + 1.5 * done)
        entropy = 0.0 if turn else _ENTROPY * max(0.0, 1 - 2 * done)
        optimizer.zero_grad()
        for family, size in groups:
            visits = len(means.get(family, []))
            if family == "buildings" and floors is not None and visits % _AGAIN:
                batch = random_buildings.again(rng, floors)
            else:
                batch = placement_families.draw(family, rng, size)
                floors = batch if family == "buildings" else floors
            loss, mean = loss_of(network, batch, blur, entropy, generator)
            (loss / len(groups)).backward()
            means.setdefault(family, []).append(mean)
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        with torch.no_grad():
            for name, value in network.weights.items():
                mean_of[name].lerp_(value, max(_FORGET, 1 / (number + 1)))
        if (number + 1) % 100 == 0:
            text = ", ".join(f"{family} {np.mean(values):.3f}" for family, values in means.items())
            minutes = (time.process_time() - begin) / 60
            log(f"{number + 1} steps, {minutes:.1f} min: mean log b of {text}")
            means = {}
    with torch.no_grad():
        for name, value in network.weights.items():
            value.copy_(mean_of[name])


def _sizes(rng: np.random.Generator) -> dict[str, int]:
    """Return the row lengths of the tokens."""
    batch = placement_families.draw("rooms", rng, 2)
    found = tokens_of(batch.scenery, batch.count)
    return {name: getattr(found, name).shape[-1] for name in Tokens._fields}


def save(network: Network, meta: dict[str, Any], path: str | Path) -> None:
    """Write the weights in half precision, with the history of the training."""
    versions = {"torch": torch.__version__, "numpy": np.__version__}
    versions["python"] = platform.python_version()
    arrays: dict[str, Any] = {k: v.astype(np.float16) for k, v in network.arrays().items()}
    arrays["meta"] = np.array(json.dumps({**meta, "versions": versions}))
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)


def main() -> None:
    """Train and save."""
    parser = argparse.ArgumentParser(description="Train the network of placement.amortised.")
    parser.add_argument("--steps", type=int, nargs="+", default=list(STEPS), help="of each round")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="out/amortised.npz")
    options = parser.parse_args()

    def log(text: str) -> None:
        print(text, flush=True)  # noqa: T201

    network, meta = train(options.steps, options.seed, log)
    save(network, meta, options.out)


if __name__ == "__main__":
    main()

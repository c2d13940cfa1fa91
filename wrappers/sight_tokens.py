"""Memory of which links were in line of sight, and queries about future links."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray

__all__ = ["forgotten", "remember", "sight_tokens"]

# Numbers of features of a query, and of an event with it.
QUERY, EVENT = 10, 15
# Number of events kept for each anchor, and the distance between two of them, metres.
KEPT, _APART_M = 4, 2.0


class SightMemory(NamedTuple):
    """Events of each anchor, the newest first: arrays (B, M, KEPT), `place` (B, M, KEPT, 3).

    `place` is the position of the body; `sight` 1: it was in sight of the anchor, -1: it was not,
    0: no event; `age` the steps since then.
    """

    place: FloatArray
    sight: FloatArray
    age: FloatArray


def forgotten(batch: int, anchors: int) -> SightMemory:
    """Return a memory without events."""
    shape = (batch, anchors, KEPT)
    return SightMemory(np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape))


def remember(
    memory: SightMemory, chosen: BoolArray, place: FloatArray, sight: FloatArray
) -> SightMemory:
    """Return the memory after a step.

    A new event replaces the newest one of an anchor, unless their results differ or the newest one
    was far from the one before it.

    Parameters
    ----------
    memory
        Memory before the step.
    chosen
        Anchors that measured (B, M).
    place
        Position of the body (B, 3).
    sight
        1 or -1 (B, M); only read where `chosen` is true.
    """
    memory = SightMemory(*(field.copy() for field in memory))
    memory.age[:] += 1
    newest = memory.sight[..., 0]
    far = np.linalg.norm(memory.place[..., 0, :] - memory.place[..., 1, :], axis=-1) > _APART_M
    other = (newest != sight) | (memory.sight[..., 1] == 0) | far
    moved = chosen & (newest != 0) & other
    for field in memory:
        field[..., 1:, *(slice(None),) * (field.ndim - 3)][moved] = field[moved][:, :-1]
    memory.place[:, :, 0][chosen] = np.broadcast_to(place[:, None], (*chosen.shape, 3))[chosen]
    memory.sight[..., 0][chosen] = sight[chosen]
    memory.age[..., 0][chosen] = 0.0
    return memory


def sight_tokens(
    anchors: FloatArray, body: FloatArray, memory: SightMemory, middle: FloatArray, half: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return queries whether anchors will see the body, and the events that help to answer them.

    Lengths are in a horizontal frame. Its origin is the anchor, and its first axis points to the
    body.

    Parameters
    ----------
    anchors, body
        Positions (B, M, 3) and (B, 3).
    memory
        The events so far.
    middle, half
        Of the body's volume: centre and half sizes (B, 3).

    Returns
    -------
    Queries (B, M, `QUERY`), events (B, M, M KEPT, `EVENT`), and their mask (B, M, M KEPT), 1 for
    existing events.
    """
    batch, m = anchors.shape[:2]
    events = m * KEPT
    gap = body[:, None] - anchors
    length = np.sqrt((gap[..., :2] ** 2).sum(axis=-1) + 1e-6)
    along = gap[..., :2] / length[..., None]
    aside = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    inside = (body - middle) / half
    query = [
        (length / 20)[..., None],
        anchors[..., 2:] / 5,
        np.broadcast_to(body[:, None, 2:] / 3, (batch, m, 1)),
        ((anchors - middle[:, None]) / half[:, None])[..., :2],
        np.broadcast_to(inside[:, None, :2], (batch, m, 2)),
        gap[..., :2] / 20,
        (gap[..., 2] / length)[..., None],
    ]
    place, sight, age = (
        memory.place.reshape(batch, 1, events, 3),
        memory.sight.reshape(batch, 1, events),
        memory.age.reshape(batch, 1, events),
    )
    source = np.repeat(anchors, KEPT, axis=1)[:, None]

    def framed(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        level = points[..., :2] - anchors[:, :, None, :2]
        return ((level * along[:, :, None]).sum(axis=-1), (level * aside[:, :, None]).sum(axis=-1))

    (x, y), (x0, y0) = framed(place), framed(source)
    # Where the two lines of sight cross or are closest, and their vertical distance there.
    across = y - y0
    crosses = np.abs(across) > 1e-3
    share = np.clip(np.where(crosses, -y0 / np.where(crosses, across, 1.0), 0.5), 0.0, 1.0)
    reach = np.clip((x0 + share * (x - x0)) / length[..., None], 0.0, 1.0)
    beside = y0 + share * across
    height = source[..., 2] + share * (place - source)[..., 2]
    height = height - anchors[..., 2:] - reach * gap[..., 2:]
    same = np.repeat(np.eye(m), KEPT, axis=1)
    shape = (batch, m, events)
    event = [
        x / 20, y / 10, x0 / 20, y0 / 10, place[..., 2] / 3, source[..., 2] / 5, sight, same,
        np.exp(-age / 10), reach, share, np.clip(beside, -20, 20) / 5, np.exp(-np.abs(beside)),
        height / 3, length[..., None] / 20,
    ]  # fmt: skip
    there = np.broadcast_to(sight != 0, shape).astype(np.float64)
    told = np.stack([np.broadcast_to(one, shape) for one in event], axis=-1)
    return np.concatenate(query, axis=-1), told, there

"""Treat biases by ray direction as states of an epoch, which are functions of the pose.

About a pose x the bias of a link is ``beta(x) + B e`` with the pose error e. It is a state without
own uncertainty, fully correlated with the pose. The bias update applies to it unchanged, and it is
dropped afterwards.
"""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.costs.bias_cost import AugmentedState
from rbl_gym.geometry import rotations
from rbl_gym.measurements.direction_bias import DirectionLaw, direction_bias


def directed(
    state: AugmentedState,
    law: DirectionLaw,
    about: tuple[FloatArray, FloatArray],
    anchors: FloatArray,
    tags: FloatArray,
) -> AugmentedState:
    """Return the state, before or after an update, with the biases (M N) by direction appended.

    `about` is the pose of the linearisation. `law` is that of anchors (..., M, 3) and tags (N, 3).
    """
    found = direction_bias(law, *about, anchors, tags)
    links = found.bias.shape[-2] * found.bias.shape[-1]
    batch = np.broadcast_shapes(found.bias.shape[:-2], state.translation.shape[:-1])
    slope = np.broadcast_to(found.jacobian, (*batch, *found.jacobian.shape[-3:]))
    slope = slope.reshape((*batch, links, 6))
    beta = np.broadcast_to(found.bias, (*batch, *found.bias.shape[-2:])).reshape((*batch, links))
    turn = rotations.error(state.rotation, about[0])
    away = np.concatenate([turn, state.translation - about[1]], axis=-1)
    beta = beta + (slope @ away[..., None])[..., 0]
    P, n = state.covariance, state.covariance.shape[-1]
    whole = np.empty((*batch, n + links, n + links))
    whole[..., :n, :n] = P
    whole[..., n:, :n] = slope @ P[..., :6, :]
    whole[..., :n, n:] = np.swapaxes(whole[..., n:, :n], -1, -2)
    whole[..., n:, n:] = whole[..., n:, :6] @ np.swapaxes(slope, -1, -2)
    extra = np.broadcast_to(state.extra, (*batch, state.extra.shape[-1]))
    return state._replace(extra=np.concatenate([extra, beta], axis=-1), covariance=whole)


def undirected(state: AugmentedState, links: int) -> AugmentedState:
    """Return the state without the link biases that `directed` has appended."""
    n = state.covariance.shape[-1] - links
    return state._replace(extra=state.extra[..., : n - 6], covariance=state.covariance[..., :n, :n])

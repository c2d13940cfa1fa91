"""Compute the information of anchors at positions of a zone, summed over the links of every tag."""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray
from rbl_gym.measurements import ranging
from rbl_gym.placement.building import Problem

__all__ = ["anchor_information", "layout_information", "link_shares"]


def link_shares(
    problem: Problem, anchors: FloatArray, places: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Return the share (L, T, M, N) of the information of each link that obstacles and gain leave.

    The line of sight is from the anchor to the tag.

    Parameters
    ----------
    problem
        The problem, with tags, obstacles, and the gain of the anchors.
    anchors
        Positions (M, 3), metres.
    places, rotation
        Positions (L, 3), and rotations (T, 3, 3) of the body at each.
    """
    tags = problem.tags
    share = np.ones((len(places), len(rotation), len(anchors), len(tags)))
    spots = ranging.tag_positions(rotation, places[:, None], tags)  # (L, T, N, 3)
    if problem.obstacles:
        seen = problem.obstacles.share(anchors, spots.reshape(-1, 3))
        share *= np.swapaxes(seen.reshape((*spots.shape[:-1], len(anchors))), -1, -2)
    if problem.gain:
        offsets = spots[:, :, None] - anchors[:, None]
        share *= problem.gain.share(offsets, problem.mounts.normal(anchors)[:, None])
    return share


def layout_information(
    problem: Problem, anchors: FloatArray, places: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Return information (L, T, 6, 6) of the ranges to all anchors.

    Arguments as in `link_shares`.
    """
    share = link_shares(problem, anchors, places, rotation)
    return bounds.information_at(
        anchors, problem.tags, rotation, places[:, None], problem.noise, share
    )


def anchor_information(
    problem: Problem, anchors: FloatArray, places: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Return information (M, L, T, 6, 6) of ranges to each anchor.

    Arguments as in `link_shares`.
    """
    share = np.moveaxis(link_shares(problem, anchors, places, rotation), 2, 0)[..., None, :]
    return bounds.information_at(
        anchors[:, None, None, None], problem.tags, rotation, places[:, None], problem.noise, share
    )

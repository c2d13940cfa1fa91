"""Frames of a planar network: nodes, links, headings and their estimates."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.networks.sensing import proj
from rbl_gym.rendering import panels
from rbl_gym.rendering.body import limits_of
from rbl_gym.rendering.drawing import BELIEF, INK, Image, Panel, gapped, plan_axes, write
from rbl_gym.rendering.film import Film, check_mode, mapped

_LENGTH = 0.055  # length of a heading, relative to the square's side
_ARC = np.linspace(-1, 1, 13)
_TURN = np.linspace(0, 2 * np.pi, 33)
_RING = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)


class Network(NamedTuple):
    """B networks of n nodes: positions (B, n, 2), orientations (B, n), links (B, n, n).

    `bound_std` (B, n): standard deviations of the orientations at the bound.
    """

    positions: FloatArray
    orientations: FloatArray
    links: BoolArray
    bound_std: FloatArray


class Headings(NamedTuple):
    """Estimated orientations (B, n) and their standard deviations, radians, and positions.

    `positions` (B, n, 2) are relative to node 0, and `spread` (B, n, 2, 2) are their covariances.
    Both are None if positions are not estimated.
    """

    orientations: FloatArray
    std: FloatArray
    positions: FloatArray | None = None
    spread: FloatArray | None = None


def film_of(render_mode: str | None, side_m: float, n_nodes: int, steps: int) -> Film | None:
    """Return a film of networks in a square; None without rendering."""
    if check_mode(render_mode) is None:
        return None
    return Film(functools.partial(_frame, side_m, n_nodes, steps), steps)


def _frame(
    side_m: float,
    n_nodes: int,
    steps: int,
    world: int,
    epochs: np.ndarray,
    shots: Sequence[Network],
    beliefs: Sequence[Headings | None],
) -> Image:
    last, belief = (mapped(lambda field: field[world], part) for part in (shots[-1], beliefs[-1]))
    source = "bound" if belief is None else "belief"
    errors, bands = np.full((1, len(shots)), np.nan), np.full((1, len(shots)), np.nan)
    for k, (shot, known) in enumerate(zip(shots, beliefs, strict=True)):
        std = shot.bound_std[world]
        if known is not None:
            std = known.std[world]
            errors[0, k] = _rms(proj(known.orientations - shot.orientations)[world, 1:])
        bands[0, k] = 3 * _rms(std[1:])
    headline = (
        f"epoch {epochs[-1]} of {steps}      {int(last.links.sum()) // 2} links      "
        f"{source} {bands[0, -1] / 3:.2f}°"
    )
    if belief is not None:
        headline += f", error {errors[0, -1]:.2f}°"
    picture, left, upper, lower = panels.empty()
    _plan(side_m, n_nodes).paint(last, belief, headline, left)
    placed = belief is not None and belief.positions is not None
    _legend(source, placed).paint([], upper)
    strips = panels.strips(
        steps,
        (limits_of(bands[0], errors[0]),),
        ("orientation [deg]",),
        ("" if belief is None else "error, RMS over the nodes", rf"3$\sigma$ of the {source}"),
    )
    strips.paint(epochs, errors, bands, lower)
    return picture


def _rms(angles: FloatArray) -> float:
    return math.degrees(math.sqrt(float(np.mean(angles**2))))


class _Plan:
    """The network in plan."""

    def __init__(self, side_m: float, n_nodes: int) -> None:
        self.panel = panel = Panel(panels.LEFT, panels.HEIGHT)
        margin = np.full(2, 0.12 * side_m)
        axes = plan_axes(panel, (0.085, 0.075, 0.84, 0.8), -margin, side_m + margin)
        panel.figure.text(0.025, 0.955, "planar network", fontsize=12, weight="bold", color=INK)
        panel.freeze()
        self._length = _LENGTH * side_m
        self._links = panel.line(axes, color="#adb5bd", lw=1.0)
        self._wedges = [panel.patch(axes, fc=BELIEF, ec="none", alpha=0.3) for _ in range(n_nodes)]
        self._ellipses = panel.line(axes, color=BELIEF, lw=1.0)
        self._places = panel.line(axes, color=BELIEF, marker="x", ms=6, mew=1.5, ls="")
        self._believed = panel.line(axes, color=BELIEF, lw=2.0)
        self._true = panel.line(axes, color=INK, lw=1.4)
        self._nodes = panel.line(axes, color=INK, marker="o", ms=7, ls="", mec="white", mew=0.8)
        self._first = panel.line(axes, color="white", marker="o", ms=6, ls="", mec=INK, mew=1.4)

    def paint(self, last: Network, belief: Headings | None, headline: str, picture: Image) -> None:
        """Draw a network and its headings; wedges are three standard deviations to either side."""
        places, true = last.positions, last.orientations
        i, j = np.nonzero(np.triu(last.links))
        self._links.set_data(*gapped(np.stack([places[i], places[j]], axis=1)).T)
        middle, std = (true, last.bound_std) if belief is None else belief[:2]
        opening = np.minimum(3 * std, math.pi)
        for patch, place, angle, half in zip(self._wedges, places, middle, opening, strict=True):
            arc = _along(angle + half * _ARC, 1.7 * self._length)
            patch.set_xy(place + np.concatenate([np.zeros((1, 2)), arc]))
        ahead = [(self._true, true, 1.3)]
        if belief is not None:
            ahead.append((self._believed, belief.orientations, 1.7))
        for line, angles, times in ahead:
            ends = places + _along(angles, times * self._length)
            line.set_data(*gapped(np.stack([places, ends], axis=1)).T)
        self._nodes.set_data(*places[1:].T)
        self._first.set_data(*places[:1].T)
        artists = [self._links, *self._wedges]
        if belief is not None:
            artists.append(self._believed)
        if belief is not None and belief.positions is not None and belief.spread is not None:
            # Drawn from the true position of node 0.
            found = belief.positions + places[0]
            values, vectors = np.linalg.eigh(belief.spread)
            axes = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
            rings = found[:, None] + 3 * np.einsum("nij,kj->nki", axes, _RING)
            self._ellipses.set_data(*gapped(rings[1:]).T)
            self._places.set_data(*found[1:].T)
            artists += [self._ellipses, self._places]
        self.panel.paint([*artists, self._true, self._nodes, self._first], picture)
        write(picture, 34, 14, headline)


def _along(angles: FloatArray, length: float) -> FloatArray:
    return length * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


@functools.lru_cache(maxsize=3)
def _legend(source: str, placed: bool) -> Panel:
    """Draw the legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    panel = Panel(panels.WIDTH - panels.LEFT, panels.TOP)
    handles: list[Any] = [
        Line2D([], [], color=INK, marker="o", ms=7, ls="", label="node"),
        Line2D([], [], color="white", marker="o", ms=6, ls="", mec=INK, mew=1.4,
               label="node 0, the reference"),
        Line2D([], [], color="#adb5bd", lw=1.0, label="see each other's bearing"),
        Line2D([], [], color=INK, lw=1.4, label="true heading"),
    ]  # fmt: skip
    if source == "belief":
        handles.append(Line2D([], [], color=BELIEF, lw=2.0, label="believed heading"))
    if placed:
        handles.append(
            Line2D(
                [], [], color=BELIEF, lw=1.0, marker="x", ms=6, label=r"believed place, 3$\sigma$"
            )
        )
    handles.append(Patch(fc=BELIEF, alpha=0.3, label=rf"$\pm$3$\sigma$ of the {source}"))
    panel.figure.legend(handles=handles, loc="center left", bbox_to_anchor=(0.14, 0.5),
                        fontsize=9, frameon=False, labelspacing=0.9)  # fmt: skip
    panel.freeze()
    return panel


_plan = functools.lru_cache(maxsize=4)(_Plan)

"""Draw the picture of docs/conventions.md: the world frame, the body frame, a range and a pose.

python examples/draw_frames.py docs/images/frames.png
"""

from __future__ import annotations

import argparse

import matplotlib
import numpy as np

from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging

matplotlib.use("agg")
import matplotlib.pyplot as plt

ANCHORS = np.array([[0.3, 4.2, 2.6], [5.2, 0.4, 0.6], [5.6, 3.9, 2.9]])
TAGS = np.array([[0.7, 0.45, 0.1], [0.7, -0.45, 0.1], [-0.7, 0.45, 0.1], [-0.7, -0.45, 0.1]])
ROTATION = rotations.exp(np.array([0.15, -0.2, 0.6]))
TRANSLATION = np.array([2.6, 2.0, 0.9])
AXES = (("x", "#c0392b"), ("y", "#1e8449"), ("z", "#2471a3"))


def draw_frame(axes, origin, rotation, length, suffix) -> None:
    for k, (name, colour) in enumerate(AXES):
        tip = origin + length * rotation[:, k]
        axes.plot(*np.stack([origin, tip]).T, color=colour, lw=2.2)
        axes.text(*(origin + 1.15 * length * rotation[:, k]), f"${name}_{suffix}$", color=colour)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out")
    path = parser.parse_args().out
    figure = plt.figure(figsize=(9, 5), dpi=120)
    axes = figure.add_axes((0, -0.4, 1, 1.8), projection="3d", computed_zorder=False)
    places = ranging.tag_positions(ROTATION, TRANSLATION, TAGS)

    draw_frame(axes, np.zeros(3), np.eye(3), 1.2, "w")
    draw_frame(axes, TRANSLATION, ROTATION, 1.0, "b")
    outline = places[[0, 1, 3, 2, 0]]
    axes.plot(*outline.T, color="0.4", lw=1)
    drawn = {"depthshade": False}
    axes.scatter(*places.T, color="#e67e22", s=36, label="tags, $s_n = Q c_n + t$", **drawn)
    axes.scatter(*ANCHORS.T, color="k", marker="^", s=60, label="anchors, $a_m$", **drawn)
    for m, anchor in enumerate(ANCHORS):
        for place in places:
            link = np.stack([anchor, place]).T
            axes.plot(*link, color="0.75", lw=0.7, zorder=0)
        axes.text(*(anchor + [0.1, 0.1, 0.15]), f"$a_{m}$")
    shown = np.stack([ANCHORS[1], places[1]])
    axes.plot(*shown.T, color="#8e44ad", lw=1.8)
    axes.text(*(shown.mean(axis=0) + [0.1, 0, 0.12]), "range $r_{11}$", color="#8e44ad")
    axes.quiver(0, 0, 0, *TRANSLATION, color="0.2", lw=1.4, arrow_length_ratio=0.06)
    axes.text(*(0.5 * TRANSLATION + [0.1, -0.5, 0]), "translation $t$")
    axes.text(*(places[1] + [0.1, -0.35, -0.1]), "$s_1$")

    axes.set_xlim(0, 6)
    axes.set_ylim(0, 4.5)
    axes.set_zlim(0, 3.2)
    axes.set_box_aspect((6, 4.5, 3.2), zoom=0.9)
    axes.view_init(elev=26, azim=-70)
    axes.set_axis_off()
    figure.legend(frameon=False, loc="upper left")
    figure.savefig(path)


if __name__ == "__main__":
    main()

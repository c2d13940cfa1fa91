"""From a move of an anchor to its picture: process time of the studio's server.

    python benchmarks/studio.py [SCENE|FILE]

Map, figures, the picture and all that is sent to browsers; no browser is open. Process time of
all threads, the median of the moves.
"""

from __future__ import annotations

import sys
import tempfile
import time

import numpy as np

from rbl_gym.app import studio
from rbl_gym.app.studio import place
from rbl_gym.placement import scene_files
from rbl_gym.studies.placing import design

MOVES = 40


def main() -> None:
    scene = sys.argv[1] if len(sys.argv) > 1 else "examples/warehouse.toml"
    problem = scene_files.problem(scene)
    # The search in the background would be measured too.
    layouts = design.usual_layouts(problem, 0)
    place.design.design_layout = lambda *_: design.Design(layouts["grid"], "grid", {})
    rng = np.random.default_rng(0)
    print("anchors   cells        move (ms)   refined: cells   (ms)")
    for count in (problem.n_anchors, 64):
        anchors = None if count != 64 else problem.mounts.draw(rng.random((count, 3)))
        with tempfile.TemporaryDirectory() as folder:
            options = studio.Options(port=0, folder=folder, browser=False)
            opened = studio.show(problem, anchors, options=options)
            print(f"{count:7}   {measured(opened.page)}")
            opened.stop()


def measured(page: place.PlacePage) -> str:
    """Cells and times of moves, and of letting go."""
    page.settle()
    times, begin = [], page.state.anchors[0]
    camera = begin + [0.0, -40.0, 40.0]
    page.drag(0, "start", camera, begin)
    for step in range(MOVES):
        page.settle()
        before = time.process_time()
        page.drag(0, "update", camera, begin + [0.05 * step, 0.0, 0.0])
        page.settle()
        times.append(time.process_time() - before)
    coarse = page.map.values.shape
    page.drag(0, "end", camera, begin)
    before = time.process_time()
    page.settle()
    refined = 1000 * (time.process_time() - before)
    move = 1000 * np.median(times[5:])
    return f"{coarse!s:12} {move:8.0f}    {page.map.values.shape!s:14} {refined:7.0f}"


if __name__ == "__main__":
    main()

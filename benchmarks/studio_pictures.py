"""The pictures of the studio in the README and on its page, from a real browser.

    python benchmarks/studio_pictures.py docs/images

Needs the extra studio, playwright and chromium. Writes studio.png and studio.webp.
"""

from __future__ import annotations

import io
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

from rbl_gym.app import studio
from rbl_gym.app.studio.scene_view import view_axes
from rbl_gym.placement import scene_files

WINDOW = {"width": 1120, "height": 680}
# Width of the animation, pixels; a frame, and the last one, milliseconds.
WIDTH, FRAME_MS, LAST_MS = 800, 110, 2500
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def main() -> None:
    """Drag an anchor, optimise, and take pictures of it."""
    folder = Path(sys.argv[1])
    problem = scene_files.problem("examples/warehouse.toml")
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        options = studio.Options(port=0, folder=scratch, browser=False)
        opened = studio.show(problem, options=options)
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=ARGUMENTS
        )
        window = browser.new_page(viewport=WINDOW)
        frames = list(filmed(opened, window))
        browser.close()
        opened.stop()
    frames[-1].save(folder / "studio.png", optimize=True)
    small = [frame.resize((WIDTH, WIDTH * frame.height // frame.width)) for frame in frames]
    times = [FRAME_MS] * (len(small) - 1) + [LAST_MS]
    small[0].save(
        folder / "studio.webp", save_all=True, append_images=small[1:], duration=times,
        loop=0, quality=60, method=6,
    )  # fmt: skip
    for name in ("studio.png", "studio.webp"):
        print(folder / name, (folder / name).stat().st_size)


def filmed(opened: Any, window: Any) -> Iterator[Image.Image]:
    """Frames: an anchor is dragged along the ceiling, then all of them go downhill."""
    page = opened.page
    window.goto(opened.url)
    window.get_by_text("being searched").wait_for(timeout=60_000)
    window.get_by_text("being searched").wait_for(state="detached", timeout=300_000)
    window.evaluate(
        "document.querySelectorAll('[class*=Notification-closeButton]').forEach(b => b.click())"
    )
    page.settle()
    window.wait_for_timeout(1500)
    yield picture(window)
    camera = next(iter(opened.server.get_clients().values())).camera
    place = page.state.anchors[4].copy()
    x, y = on_screen(camera, place)
    window.mouse.move(x, y)
    window.mouse.down()
    for step in range(1, 15):
        place = place + [0.7, -0.25, 0.0]
        window.mouse.move(*on_screen(camera, place))
        window.wait_for_timeout(250)
        page.settle()
        window.wait_for_timeout(250)
        if step % 1 == 0:
            yield picture(window)
    window.mouse.up()
    window.wait_for_timeout(500)
    page.settle()
    yield from [picture(window)] * 5
    start = page.state
    # Step by step, so that every step is in the picture.
    for _, better in studio.searches.optimise(start):
        page.edit(lambda _, better=better: better)
        page.settle()
        window.wait_for_timeout(400)
        yield from [picture(window)] * 2
    yield picture(window)


def picture(window: Any) -> Image.Image:
    """The window as it is."""
    return Image.open(io.BytesIO(window.screenshot(timeout=120_000))).convert("RGB")


def on_screen(camera: Any, point: np.ndarray) -> tuple[float, float]:
    """Pixels of a point in the window of a client's camera."""
    away = point - np.asarray(camera.position)
    forward = np.asarray(camera.look_at) - np.asarray(camera.position)
    right, up, ahead = view_axes(forward) @ away
    scale = 0.5 * camera.image_height / np.tan(0.5 * camera.fov)
    return (
        float(0.5 * camera.image_width + scale * right / ahead),
        float(0.5 * camera.image_height - scale * up / ahead),
    )


if __name__ == "__main__":
    main()

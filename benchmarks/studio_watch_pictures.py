"""The picture of filters at work on the studio's page, from a real browser.

    python benchmarks/studio_watch_pictures.py docs/images

Needs the extra studio, playwright and chromium. Writes watch.webp.
"""

from __future__ import annotations

import io
import shutil
import sys
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from rbl_gym.app import studio
from rbl_gym.studies.watching.live import Disturbances
from rbl_gym.worlds import scenes

WINDOW = {"width": 1120, "height": 680}
WIDTH, FRAME_MS, LAST_MS = 800, 200, 2500
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# Epochs without disturbances, and with one range in eight over a reflected path; every second is
# taken.
CALM, DISTURBED, STEP = 16, 40, 2
# How long a browser without a graphics card may take for a picture, seconds.
PATIENCE_S = 1.5


def main() -> None:
    """Let a filter break and the robust one hold, and take pictures of it."""
    folder = Path(sys.argv[1])
    opened = studio.show(scenes.get("uwb_room"), options=studio.Options(port=0, browser=False))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=ARGUMENTS
        )
        window = browser.new_page(viewport=WINDOW)
        window.set_default_timeout(90_000)
        window.goto(opened.url)
        window.get_by_role("button", name="Play").wait_for(state="attached")
        window.get_by_text("Software WebGL").wait_for()
        window.locator(".mantine-Notification-closeButton").click()
        frames = []
        for epoch in range(0, CALM + DISTURBED, STEP):
            if epoch == CALM:
                opened.page.disturb(Disturbances(nlos=0.12))
            for _ in range(STEP):
                opened.page.step()
            opened.page.settle()
            time.sleep(PATIENCE_S)
            frames.append(Image.open(io.BytesIO(window.screenshot())).convert("RGB"))
        browser.close()
    opened.stop()
    small = [frame.resize((WIDTH, WIDTH * frame.height // frame.width)) for frame in frames]
    path = folder / "watch.webp"
    small[0].save(
        path, save_all=True, append_images=small[1:],
        duration=[FRAME_MS] * (len(small) - 1) + [LAST_MS], loop=0, quality=60, method=6,
    )  # fmt: skip
    print(path, path.stat().st_size)


if __name__ == "__main__":
    main()

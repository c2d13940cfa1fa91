"""Write an animated picture of an environment: frames of `render()`, saved by Pillow.

python examples/animate.py --scene drone_yard --filter iekf --steps 100 out/drone.webp
"""

import argparse
from pathlib import Path

import gymnasium as gym
from PIL import Image

from rbl_gym.wrappers import EstimatePose

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("picture", help="where to: .webp or .gif")
parser.add_argument("--scene", default="drone_yard")
parser.add_argument("--filter", default="iekf")
parser.add_argument("--steps", type=int, default=100)
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--width", type=int, default=960, help="pixels; a frame has 960")
parser.add_argument("--fps", type=int, default=12)
options = parser.parse_args()

scene = {"name": options.scene, "steps": options.steps}
env = gym.make("rbl_gym:RBL/Tracking-v0", scene=scene, reward="none", render_mode="rgb_array")
env = EstimatePose(env, options.filter)
env.reset(seed=options.seed)
env.action_space.seed(options.seed)
still = env.action_space.sample() * 0
frames, truncated = [env.render()], False
while not truncated:
    *_, truncated, _ = env.step(still)
    frames.append(env.render())

size = options.width, round(options.width * 540 / 960)
images = [Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS) for frame in frames]
if options.picture.endswith(".gif"):
    # One palette for all frames, or colours flicker.
    palette = images[-1].quantize(64, Image.Quantize.MAXCOVERAGE)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
Path(options.picture).parent.mkdir(parents=True, exist_ok=True)
images[0].save(
    options.picture,
    save_all=True,
    append_images=images[1:],
    duration=[1000 // options.fps] * (len(images) - 1) + [1500],
    loop=0,
    quality=50,
    method=4,
)
print(
    f"{options.picture}: {len(images)} frames, {Path(options.picture).stat().st_size / 1000:.0f} kB"
)

"""Frames of environments, ``render_mode="rgb_array"``: (height, width, 3) of uint8.

A `Film` collects what there was to see, epoch by epoch; a frame is drawn from it alone, so that
the same episode gives the same pixels. Matplotlib is imported by the first frame.
"""

from rbl_gym.rendering.body import film_of, film_of_many, shot
from rbl_gym.rendering.film import RENDER_MODES, Film, check_mode, picture, select, tell
from rbl_gym.rendering.shots import Pose

__all__ = [
    "RENDER_MODES",
    "Film",
    "Pose",
    "check_mode",
    "film_of",
    "film_of_many",
    "picture",
    "select",
    "shot",
    "tell",
]

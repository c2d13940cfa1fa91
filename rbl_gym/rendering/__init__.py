"""Frames of environments for ``render_mode="rgb_array"``: (height, width, 3), uint8.

A `Film` stores what is shown of each epoch. A frame is drawn from the film alone, so that the same
episode gives the same pixels. Matplotlib is imported with the first frame.
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

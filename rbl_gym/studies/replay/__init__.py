"""A recording through a filter: the track, its mirror image, errors against the truth, hints."""

from rbl_gym.studies.replay.figures import Errors, errors, figures, truth_of
from rbl_gym.studies.replay.mirror import Mirror, covering, other_pose
from rbl_gym.studies.replay.settings import (
    DEFAULT_RANGE_STD_M,
    Settings,
    height_offset,
    origin_of,
    volume_of,
)
from rbl_gym.studies.replay.tracking import (
    Track,
    make_filter,
    named_filter,
    range_std_of,
    run,
    steps,
    track_of,
)
from rbl_gym.studies.replay.truth import check_overlap

__all__ = [
    "DEFAULT_RANGE_STD_M", "Errors", "Mirror", "Settings", "Track", "check_overlap", "covering",
    "errors", "figures", "height_offset", "make_filter", "named_filter", "origin_of", "other_pose",
    "range_std_of", "run", "steps", "track_of", "truth_of", "volume_of",
]  # fmt: skip

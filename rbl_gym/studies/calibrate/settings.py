"""What a calibration estimates, and what it is told."""

from __future__ import annotations

from dataclasses import dataclass

from rbl_gym.checks import check_count, check_number, check_one_of

__all__ = ["LinkSettings"]


@dataclass(frozen=True)
class LinkSettings:
    """How links are calibrated by a log with truth.

    Parameters
    ----------
    biases
        ``"link"``, ``"node"``, ``"common"`` as of `rbl_gym.estimators.calibration.LinkModel`, or
        ``"auto"``: of links, where these have ranges enough, else of nodes.
    slopes
        Whether ranges grow with the distance by more or less than one.
    tags
        ``"held"``, ``"turned"`` or ``"free"``, as of `LinkModel`.
    harmonics
        Of the bias by the direction in which a ray leaves the body: how many at the most; of
        these as many as foretell what was left out (0: none is looked for).
    ends
        ``"tags"``: of the direction at the tags; ``"both"``: at the anchors too, where these are on
        a body themselves.
    planar
        The body moves in a level plane: only the heading of the truth is read, and tags keep
        their heights.
    height_offset_m
        How far the tags' mean height lies below the anchors', where the truth has no height.
    time_offset
        How far the truth's clock is ahead of that of the ranges, seconds; ``"auto"``: found.
    truth_gap_s
        Longest gap of the truth that is bridged.
    truth_exclude
        Windows of time, pairs of start and end in seconds of the ranges' clock, that are left out.
    """

    biases: str = "auto"
    slopes: bool = True
    tags: str = "turned"
    harmonics: int = 0
    ends: str = "tags"
    planar: bool = False
    height_offset_m: float | None = None
    time_offset: float | str = "auto"
    truth_gap_s: float = 0.5
    truth_exclude: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        check_one_of("biases", self.biases, ("auto", "link", "node", "common"))
        check_one_of("tags", self.tags, ("held", "turned", "free"))
        check_count("harmonics", self.harmonics, least=0, most=8)
        check_one_of("ends", self.ends, ("tags", "both"))
        check_number("truth_gap_s", self.truth_gap_s, low=0.0)
        if self.height_offset_m is not None:
            check_number("height_offset_m", self.height_offset_m)
        if self.time_offset != "auto":
            check_number("time_offset", self.time_offset)
        for window in self.truth_exclude:
            if len(window) != 2 or not window[0] < window[1]:
                raise ValueError(
                    f"truth_exclude must be pairs of start and end in seconds, got {window!r:.80}"
                )

"""Settings of a calibration."""

from __future__ import annotations

from dataclasses import dataclass

from rbl_gym.checks import check_count, check_number, check_one_of

__all__ = ["LinkSettings"]


@dataclass(frozen=True)
class LinkSettings:
    """Settings for calibrating links with a log with truth.

    Parameters
    ----------
    biases
        ``"link"``, ``"node"``, ``"common"`` as in `rbl_gym.estimators.calibration.LinkModel`, or
        ``"auto"``: by link, if these have enough ranges, else by node.
    slopes
        Whether to estimate a scale error of ranges.
    tags
        ``"held"``, ``"turned"`` or ``"free"``, as in `LinkModel`.
    harmonics
        Maximum number of harmonics of the bias by ray direction; the number is chosen by
        cross-validation (0: no such bias).
    ends
        ``"tags"``: bias by the direction at the tags; ``"both"``: also at the anchors, if these are
        on a body themselves.
    planar
        The body moves in a horizontal plane: only the heading of the truth is used, and the heights
        of tags are fixed.
    height_offset_m
        Mean height of the anchors minus that of the tags, if the truth has no height.
    height_m
        Height of the body's origin, if the truth has no height; instead of `height_offset_m`.
    time_offset
        How far the clock of the truth is ahead of that of the ranges, seconds; ``"auto"``:
        estimated.
    truth_gap_s
        Longest gap of the truth that is interpolated.
    truth_exclude
        Excluded time windows: pairs of start and end in seconds on the clock of the ranges.
    """

    biases: str = "auto"
    slopes: bool = True
    tags: str = "turned"
    harmonics: int = 0
    ends: str = "tags"
    planar: bool = False
    height_offset_m: float | None = None
    height_m: float | None = None
    time_offset: float | str = "auto"
    truth_gap_s: float = 0.5
    truth_exclude: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        check_one_of("biases", self.biases, ("auto", "link", "node", "common"))
        check_one_of("tags", self.tags, ("held", "turned", "free"))
        check_count("harmonics", self.harmonics, least=0, most=8)
        check_one_of("ends", self.ends, ("tags", "both"))
        check_number("truth_gap_s", self.truth_gap_s, low=0.0)
        for name in ("height_offset_m", "height_m"):
            if (value := getattr(self, name)) is not None:
                check_number(name, value)
        if self.height_offset_m is not None and self.height_m is not None:
            raise ValueError("height_m must be left out with height_offset_m: give one of them")
        if self.time_offset != "auto":
            check_number("time_offset", self.time_offset)
        for window in self.truth_exclude:
            if len(window) != 2 or not window[0] < window[1]:
                raise ValueError(
                    f"truth_exclude must be pairs of start and end in seconds, got {window!r:.80}"
                )

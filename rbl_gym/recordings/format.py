"""How the files of a log are written, where they are not as `read_recording` says."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from rbl_gym.measurements.offsets import check_offset
from rbl_gym.recordings.stamps import TIME_UNITS
from rbl_gym.recordings.tables import METRES, Source

__all__ = ["Format"]

FILES = (
    "ranges",
    "anchors",
    "tags",
    "truth",
    "calibration",
    "directions",
    "carrier",
    "odometry",
    "imu",
)


@dataclasses.dataclass(frozen=True)
class Format:
    """How the files of a log are written.

    Parameters
    ----------
    columns
        What columns are called in the files, by what they hold: ``{"time": "time_s", "anchor":
        "to_id"}`` of the ranges, ``{"truth.x": "px", "anchors.anchor": "name"}`` of another file.
        ``{"truth.*": "B_*"}`` stands for all columns that begin so. ``{"range":
        "r_{anchor}_{tag}", "std": "sd_{anchor}_{tag}"}`` are the columns of a wide table. A unit
        may stand in brackets: ``"stamp[ms]"``. Columns of a file without a header go by number,
        from 1: ``{"odometry.t": "2"}``.
    where
        Cells of the rows that are meant, by column, as in `columns`: ``{"anchors.agent": "1"}``.
    time_unit
        Of the times of the ranges: ``"s"``, ``"ms"``, ``"us"``, ``"ns"`` or ``"iso"``; None: as
        the header tells, else found from their spacing.
    unit
        Of the ranges and their standard deviations: ``"m"``, ``"cm"`` or ``"mm"``; None: as the
        header tells, else metres.
    offset
        Whose ranges have an unknown offset in common, and may be zero or negative: ``"tag"``,
        ``"anchor"`` or ``"epoch"``; None: nobody's. Differences have that of their tag.
    wheelbase_m
        Of odometry of two wheels: the distance between them.
    turn_unit
        Of turn rates, of odometry and inertial sensors: ``"rad/s"`` or ``"deg/s"``.
    strict
        Refuse, by its line, what is dropped, sorted or counted otherwise.

    Raises
    ------
    ValueError
        On a unit or a file that is not known.
    """

    columns: Mapping[str, str] = dataclasses.field(default_factory=dict)
    where: Mapping[str, str] = dataclasses.field(default_factory=dict)
    time_unit: str | None = None
    unit: str | None = None
    offset: str | None = None
    wheelbase_m: float | None = None
    turn_unit: str = "rad/s"
    strict: bool = False

    def __post_init__(self) -> None:
        check_offset(self.offset)
        for name, known in (("time_unit", [*TIME_UNITS, "iso"]), ("unit", [*METRES])):
            if getattr(self, name) not in (None, *known):
                raise ValueError(f"{name} must be one of {known}, got {getattr(self, name)!r}")
        for name in ("columns", "where"):
            for key, value in getattr(self, name).items():
                file = key.partition(".")[0] if "." in key else "ranges"
                if file not in FILES or not value:
                    raise ValueError(
                        f"{name} must be names by what they hold, of one of the files "
                        f"{', '.join(FILES)}, got {key}={value}"
                    )

    def of(self, file: str) -> Source:
        """Names and rows of one of the files."""
        return Source(*(_of(file, names) for names in (self.columns, self.where)))


def _of(file: str, names: Mapping[str, str]) -> dict[str, str]:
    return {
        key.removeprefix(f"{file}."): value
        for key, value in names.items()
        if key.startswith(f"{file}.") or (file == "ranges" and "." not in key)
    }

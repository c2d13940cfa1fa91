"""Describe the files of a log that differ from the format of `read_recording`."""

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
    """The format of the files of a log.

    Parameters
    ----------
    columns
        Names of the columns in the files, by content: ``{"time": "time_s", "anchor": "to_id"}`` for
        the ranges, ``{"truth.x": "px", "anchors.anchor": "name"}`` for another file.
        ``{"truth.*": "B_*"}`` stands for all columns with this prefix. ``{"range":
        "r_{anchor}_{tag}", "std": "sd_{anchor}_{tag}"}`` are the columns of a wide table. A unit
        may follow in brackets: ``"stamp[ms]"``. Columns of a file without a header are named by
        numbers from 1: ``{"odometry.t": "2"}``.
    where
        Cells that the rows to use must have, by column, as in `columns`:
        ``{"anchors.agent": "1"}``.
    time_unit
        Unit of the times of the ranges: ``"s"``, ``"ms"``, ``"us"``, ``"ns"`` or ``"iso"``; None:
        the unit in the header, or else detected from the spacing.
    unit
        Unit of the ranges and their standard deviations: ``"m"``, ``"cm"`` or ``"mm"``; None: the
        unit in the header, or else metres.
    offset
        Ranges of one ``"tag"``, ``"anchor"`` or ``"epoch"`` share an unknown offset, and may be
        zero or negative; None: there is no offset. Differences always share that of their tag.
    wheelbase_m
        Distance between the two wheels of the odometry, metres.
    turn_unit
        Unit of the turn rates of odometry and inertial sensors: ``"rad/s"`` or ``"deg/s"``.
    strict
        Raise ValueError, with the line, for data that would be dropped, sorted or counted.

    Raises
    ------
    ValueError
        If a unit or a file is unknown.
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
                        f"{name} must map a quantity, or FILE.quantity with FILE one of "
                        f"{', '.join(FILES)}, to a name; got {key}={value}"
                    )

    def of(self, file: str) -> Source:
        """Return the column names and row selection of one of the files."""
        return Source(_of(file, self.columns), _of(file, self.where), file)


def _of(file: str, names: Mapping[str, str]) -> dict[str, str]:
    return {
        key.removeprefix(f"{file}."): value
        for key, value in names.items()
        if key.startswith(f"{file}.") or (file == "ranges" and "." not in key)
    }

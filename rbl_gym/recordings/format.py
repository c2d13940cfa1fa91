"""Name the files of a log, and describe their format."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from rbl_gym.checks import check_one_of
from rbl_gym.measurements.offsets import check_offset
from rbl_gym.recordings.stamps import TIME_UNITS
from rbl_gym.recordings.tables import METRES, AnyPath, Source

__all__ = ["Files", "Format"]


@dataclasses.dataclass(frozen=True)
class Files:
    """The files of a log.

    Parameters
    ----------
    ranges
        Long, ``t,anchor,tag,range[,std or var][,valid][,run]``: rows with equal `t` form an epoch.
        If `valid` (0 or 1) is 0, range and std may be any number or empty. Or wide,
        ``t,a{anchor}t{tag},...``: a row is an epoch. Seconds and metres. A link is missing if its
        range is empty, or if it has no row or column. Without `anchors`, every row holds the
        position of the anchor: ``ax,ay[,az]``. Or differences of the distances to two anchors,
        ``t,anchor_a,anchor_b,tag,difference[,std or var]``, the distance to `anchor_a` minus the
        distance to `anchor_b`. They become ranges with one unknown offset per tag.
    anchors, tags
        ``anchor,x,y,z`` and ``tag,x,y,z`` (or ``id,x,y,z``), metres; ids are any unique text.
        Moving anchors have a row for every position and time: ``anchor,t,x,y,z``. Without `tags`
        there is one tag, at the origin of the body frame.
    truth
        File for `rbl_gym.recordings.read_truth`: ``t,x,y,z,qw,qx,qy,qz``, TUM, EuRoC/ASL,
        positions with a heading, or positions only.
    calibration
        ``anchor,tag,bias_m[,slope][,sigma_m]``: ``(range - bias) / (1 + slope)`` replaces the
        range of that link and ``std / (1 + slope)`` its std. A corrected range that is not
        positive becomes a missing link. Links without a row are unchanged; `sigma_m` is not read.
    directions
        File for `rbl_gym.recordings.read_directions`: bias by the direction of the ray at its ends.
        It becomes part of the measurement model; the ranges are not corrected.
    carrier
        Poses of a body that carries the anchors, in the formats of `truth`. `anchors` is then in
        the frame of this body. May be the file of the ranges.
    relative
        Estimate the pose in the frame of the `carrier`. The anchors are fixed in this frame, and
        the truth is taken relative to it.
    odometry
        File for `rbl_gym.recordings.read_odometry`: ``t,vx,vy,vz,wx,wy,wz``, or the speeds of two
        wheels.
    imu, imu_frame
        File for `rbl_gym.recordings.read_inertial`, ``t,wx,wy,wz,ax,ay,az``, and the argument of
        `read_frame`: the rotation from its axes to those of the body.

    Raises
    ------
    ValueError
        If a file is given without one that it needs.
    """

    ranges: AnyPath
    anchors: AnyPath | None = None
    tags: AnyPath | None = None
    truth: AnyPath | None = None
    calibration: AnyPath | None = None
    directions: AnyPath | None = None
    carrier: AnyPath | None = None
    relative: bool = False
    odometry: AnyPath | None = None
    imu: AnyPath | None = None
    imu_frame: AnyPath | None = None

    def __post_init__(self) -> None:
        if self.carrier is not None and self.anchors is None:
            raise ValueError(
                "carrier needs anchors, a table of the anchors in the frame of the carrier"
            )
        if self.relative and self.carrier is None:
            raise ValueError("relative needs carrier, the poses of the body with the anchors")
        if self.imu_frame is not None and self.imu is None:
            raise ValueError("imu_frame needs imu")


# The files that may have columns of other names.
FILES = tuple(
    field.name for field in dataclasses.fields(Files) if field.name not in ("relative", "imu_frame")
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
            if getattr(self, name) is not None:
                check_one_of(name, getattr(self, name), known)
        for name in ("columns", "where"):
            for key, value in getattr(self, name).items():
                file = key.partition(".")[0] if "." in key else "ranges"
                if file not in FILES or not value:
                    raise ValueError(
                        f"{name} must have keys QUANTITY or FILE.QUANTITY, with FILE one of "
                        f"{', '.join(FILES)}, and names as values; got {key}={value}"
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

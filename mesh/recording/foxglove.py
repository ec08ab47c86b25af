"""Messages that Foxglove shows as more than numbers: pictures, places on a map, logs, poses, scans.

`job.publish("/gps", foxglove.LocationFix(latitude=52.5, longitude=13.4))`. The classes have the names and fields of
Foxglove's schemas; a field that is not given is empty, and a `timestamp` is now. Other classes can do the same with
`schema_name: ClassVar = "foxglove.…"`.
"""

from __future__ import annotations

import time
from enum import IntEnum
from typing import Annotated, Any, ClassVar, Final

from msgspec import Meta, Struct, field


class Timestamp(Struct, frozen=True):
    """A time of day: seconds since 1970, and nanoseconds."""

    sec: Annotated[int, Meta(ge=0)]
    nsec: Annotated[int, Meta(ge=0, le=999_999_999)] = 0


def now() -> Timestamp:
    """This moment."""
    return Timestamp(*divmod(time.time_ns(), 10**9))


class Vector3(Struct, frozen=True):
    """A point or a translation, in metres."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Quaternion(Struct, frozen=True):
    """An orientation."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


class Pose(Struct, frozen=True):
    """A position with an orientation."""

    position: Vector3 = Vector3()
    orientation: Quaternion = Quaternion()


class CompressedImage(Struct, frozen=True, kw_only=True):
    """A picture: `data` is the content of a file of this `format` (`jpeg`, `png`, `webp` or `avif`)."""

    schema_name: ClassVar[str] = "foxglove.CompressedImage"

    data: bytes
    format: str
    frame_id: str = ""
    timestamp: Timestamp = field(default_factory=now)


class CovarianceType(IntEnum):
    """What the covariance of a `LocationFix` is."""

    UNKNOWN = 0
    APPROXIMATED = 1
    DIAGONAL_KNOWN = 2
    KNOWN = 3


class LocationFix(Struct, frozen=True, kw_only=True):
    """A place on Earth: degrees, and metres of altitude. The covariance is in m², east, north, up, row by row."""

    schema_name: ClassVar[str] = "foxglove.LocationFix"

    latitude: float
    longitude: float
    altitude: float = 0.0
    position_covariance: Annotated[tuple[float, ...], Meta(min_length=9, max_length=9)] = (0.0,) * 9
    position_covariance_type: CovarianceType = CovarianceType.UNKNOWN
    frame_id: str = ""
    timestamp: Timestamp = field(default_factory=now)


class LogLevel(IntEnum):
    """How serious a `Log` is."""

    UNKNOWN = 0
    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


class Log(Struct, frozen=True, kw_only=True):
    """A line of a log. `name` says who wrote it; `file` and `line` where."""

    schema_name: ClassVar[str] = "foxglove.Log"

    message: str
    level: LogLevel = LogLevel.INFO
    name: str = ""
    file: str = ""
    line: Annotated[int, Meta(ge=0)] = 0
    timestamp: Timestamp = field(default_factory=now)


class PoseInFrame(Struct, frozen=True, kw_only=True):
    """Where something is, in a frame of reference."""

    schema_name: ClassVar[str] = "foxglove.PoseInFrame"

    pose: Pose
    frame_id: str = ""
    timestamp: Timestamp = field(default_factory=now)


class FrameTransform(Struct, frozen=True, kw_only=True):
    """Where a frame of reference is in another one."""

    schema_name: ClassVar[str] = "foxglove.FrameTransform"

    parent_frame_id: str
    child_frame_id: str
    translation: Vector3 = Vector3()
    rotation: Quaternion = Quaternion()
    timestamp: Timestamp = field(default_factory=now)


class LaserScan(Struct, frozen=True, kw_only=True):
    """A scan of a range finder: metres at equal steps from `start_angle` to `end_angle` (radians)."""

    schema_name: ClassVar[str] = "foxglove.LaserScan"

    start_angle: float
    end_angle: float
    ranges: tuple[float, ...]
    intensities: tuple[float, ...] = ()
    pose: Pose = Pose()
    frame_id: str = ""
    timestamp: Timestamp = field(default_factory=now)


KINDS: Final[dict[str, Any]] = {
    kind.schema_name: kind for kind in (CompressedImage, LocationFix, Log, PoseInFrame, FrameTransform, LaserScan)
}
"""The classes by the names of their schemas."""

"""Injected pedestrians: requests of an outside client into a running episode, and acknowledgements.

An injection is applied between two steps, in the order of arrival. Acknowledgement and record
contain its tick and its path on the map, so the record alone replays the episode.
"""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

import msgspec

from cosim.core.errors import SpecError
from cosim.core.geometry import Pose
from cosim.core.state import Doing
from cosim.spec.connection import Connection

_FASTEST_MPS = 3.0
"""Maximum speed of an injected pedestrian in m/s."""
LONGEST_S = 3600.0
"""Maximum stay at the end of the path in seconds."""
_FARTHEST_M: Final = 1000.0
"""Maximum coordinate of a point relative to the robot, in metres."""

POINT_FORMS: Final = (
    'a point is [x, y] on the map or {"ahead": 15, "left": 1} from the robot, in metres'
)
"""Valid forms of a point of a path, for messages."""

Name = Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9_-]{1,32}$")]
"""Name of an injected pedestrian."""


_FromRobot = Annotated[float, msgspec.Meta(ge=-_FARTHEST_M, le=_FARTHEST_M)]


class RelativePoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Point relative to the robot in metres: ahead of its middle and to the left.

    The robot's pose is the one at the start of the tick at which the pedestrian appears.
    """

    ahead: _FromRobot
    left: _FromRobot = 0.0

    @classmethod
    def of(cls, x_m: float, y_m: float, robot: Pose) -> RelativePoint:
        """Return the point (x_m, y_m) of the map relative to a robot, rounded to 0.1 m."""
        dx_m, dy_m = x_m - robot.x_m, y_m - robot.y_m
        cos, sin = math.cos(robot.heading_rad), math.sin(robot.heading_rad)
        ahead, left = (
            round(far_m, 1) + 0.0 for far_m in (dx_m * cos + dy_m * sin, dy_m * cos - dx_m * sin)
        )
        return cls(ahead, left)

    def on_map(self, robot: Pose) -> tuple[float, float]:
        """Return the point's x and y on the map in metres, for a robot at this pose."""
        cos, sin = math.cos(robot.heading_rad), math.sin(robot.heading_rad)
        return (
            robot.x_m + self.ahead * cos - self.left * sin,
            robot.y_m + self.ahead * sin + self.left * cos,
        )


class InjectionRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Request for a pedestrian that walks along a path, stays at its end, and leaves.

    path: points on the map (x, y in metres) or relative to the robot; it appears at the first one.
    heading_rad: heading at the end, on the map; by default that of the path.
    doing: activity at the end.
    stay_s: duration of the stay in seconds. Raises SpecError.
    """

    id: Name
    path: Annotated[
        tuple[tuple[float, float] | RelativePoint, ...], msgspec.Meta(min_length=1, max_length=200)
    ]
    speed_mps: float = 1.3
    heading_rad: float | None = None
    doing: Doing = "stand"
    age: Literal["adult", "child", "elderly"] = "adult"
    stay_s: float = 30.0

    def __post_init__(self) -> None:
        on_map = [point for point in self.path if not isinstance(point, RelativePoint)]
        if not all(math.isfinite(value) for point in on_map for value in point):
            raise SpecError(f"pedestrian '{self.id}': path holds a value that is no number")
        if not 0.0 < self.speed_mps <= _FASTEST_MPS:
            raise SpecError(
                f"pedestrian '{self.id}': speed_mps must be above 0 and at most {_FASTEST_MPS:g}, "
                f"not {self.speed_mps:g}"
            )
        if not 0.0 <= self.stay_s <= LONGEST_S:
            raise SpecError(
                f"pedestrian '{self.id}': stay_s must be 0 to {LONGEST_S:g}, not {self.stay_s:g}"
            )
        if self.heading_rad is not None and not math.isfinite(self.heading_rad):
            raise SpecError(f"pedestrian '{self.id}': heading_rad is no number")

    @property
    def has_relative_points(self) -> bool:
        """Whether the path has a point relative to the robot."""
        return any(isinstance(point, RelativePoint) for point in self.path)

    def resolved(self, robot: Pose) -> Injection:
        """Return the injection with points on the map, for a robot at this pose."""
        points = tuple(
            point.on_map(robot) if isinstance(point, RelativePoint) else point
            for point in self.path
        )
        return Injection(**msgspec.structs.asdict(self) | {"path": points})


class Injection(InjectionRequest, frozen=True, kw_only=True):
    """Pedestrian with a path on the map: x and y of each point in metres."""

    path: Annotated[tuple[tuple[float, float], ...], msgspec.Meta(min_length=1, max_length=200)]


class Injected(msgspec.Struct, frozen=True, kw_only=True):
    """Injection in the episode's log.

    tick: tick at which it takes effect.
    """

    tick: int
    injection: Injection


class Ack(msgspec.Struct, frozen=True, kw_only=True):
    """Reply to an injection.

    tick, time_s: when it takes effect.
    x_m, y_m: where the pedestrian appears.
    reason: why it was refused.
    """

    id: str
    status: Literal["accepted", "refused"]
    tick: int | None = None
    time_s: float | None = None
    x_m: float | None = None
    y_m: float | None = None
    reason: str = ""


class LiveAddress(msgspec.Struct, frozen=True, kw_only=True):
    """Address of a live run.

    connection: connection to its hub.
    run: name of the run in keys.
    """

    connection: Connection
    run: str

"""Manifest: a policy's declaration of its inputs and outputs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from cosim.core.errors import SpecError
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import GoalProtocol
from cosim.spec.odometry import OdometryKind
from cosim.spec.sensors import ImuKind, PeopleKind, ScanSpec, SensorTrack

WaypointRuleName = Literal["shipped", "atan2"]
"""Names of the rules that turn a waypoint into a command."""


@dataclass(frozen=True, slots=True)
class WaypointRule:
    """Rule that turns a policy's waypoints into a command. The defaults are those of GNM, ViNT and
    NoMaD.

    index: number of the waypoint to follow, from 0.
    unit_m: metres per unit of x and y.
    dt_s: time to reach the waypoint.
    rule: "shipped" (v = x / dt, w = arctan(y / x) / dt) or "atan2" (w = atan2(y, x) / dt). They
        differ for waypoints behind the robot: "shipped" turns by less than a quarter turn.

    Both rules use the heading of a waypoint at the robot's own position, if it has one
    (`cosim.episode.control`). Raises SpecError.

    >>> WaypointRule(index=0, dt_s=0.2).in_words
    'waypoint 0, units of 1 m, in 0.2 s, shipped'
    """

    index: int = 2
    unit_m: float = 1.0
    dt_s: float = 0.25
    rule: WaypointRuleName = "shipped"

    def __post_init__(self) -> None:
        if isinstance(self.index, bool) or not isinstance(self.index, int) or self.index < 0:
            raise SpecError(f"waypoints index must be a whole number from 0, not {self.index!r}")
        for name in ("unit_m", "dt_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise SpecError(f"waypoints {name} must be a positive number, not {value}")
        if self.rule not in get_args(WaypointRuleName):
            raise SpecError(
                f"waypoints rule must be one of {', '.join(get_args(WaypointRuleName))}, not "
                f"{self.rule!r}"
            )

    @property
    def in_words(self) -> str:
        """Description for tables."""
        return f"waypoint {self.index}, units of {self.unit_m:g} m, in {self.dt_s:g} s, {self.rule}"


@dataclass(frozen=True, slots=True)
class Manifest:
    """Declaration of a policy.

    rate_hz: rate at which it acts.
    camera: its camera, None for a policy without one.
    privileged: whether it gets simulator state (`cosim.episode.interfaces.Privileged`).
    waypoints: rule for its waypoints.
    goal: default goal protocol (`cosim.spec.goal.GOALS`); a run may override it.
    odometry: kind of odometry (`cosim.spec.odometry.ODOMETRY`).
    cameras: further cameras by name.
    goals: supported goal protocols, () for any; a run with another one is refused.
    scan: its lidar, None for a policy without one.
    imu: kind of inertial sensor (`cosim.spec.sensors.IMU`).
    people: kind of tracked people (`cosim.spec.sensors.PEOPLE`).

    The manifest itself raises nothing. An episode refuses invalid values, such as a period that is
    not a whole number of ticks.

    >>> Manifest("mine", rate_hz=5.0, camera=CameraSpec(width=512, height=288)).camera.height
    288
    """

    name: str
    version: str = "1"
    rate_hz: float = 4.0
    camera: CameraSpec | None = CameraSpec()
    privileged: bool = False
    waypoints: WaypointRule = WaypointRule()
    goal: GoalProtocol = "none"
    odometry: OdometryKind = "none"
    cameras: Mapping[str, CameraSpec] = field(default_factory=dict)
    goals: tuple[GoalProtocol, ...] = ()
    scan: ScanSpec | None = None
    imu: ImuKind = "none"
    people: PeopleKind = "none"

    @property
    def track(self) -> SensorTrack:
        """Sensor track: the strongest of the policy's sources of knowledge of the street.

        Labels are the simulator's own knowledge.
        """
        cameras = [one for one in (self.camera, *self.cameras.values()) if one is not None]
        sources: dict[SensorTrack, bool] = {
            "privileged": self.privileged or any(one.labels for one in cameras),
            "people": self.people != "none",
            "lidar": self.scan is not None,
            "picture": len(cameras) > 0,
        }
        return next((track for track, given in sources.items() if given), "blind")

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the camera's pictures in pixels; (0, 0) without a camera."""
        return (0, 0) if self.camera is None else self.camera.size

"""Manifest: what a policy declares about itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as filled
from typing import Literal, get_args

from cosim.core.errors import SpecError
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import GoalProtocol
from cosim.spec.odometry import OdometryKind

HowFollowed = Literal["shipped", "atan2"]


@dataclass(frozen=True, slots=True)
class WaypointRule:
    """How a policy's waypoints become a command. The defaults are how GNM, ViNT and NoMaD drive
    their robots.

    index: which waypoint is followed, from 0: the third of an answer. unit_m: metres in one unit of
    x and y. dt_s: the time in which it is to be reached. rule: "shipped", v = x / dt and w =
    arctan(y / x) / dt, so that a waypoint behind the robot turns it by less than a quarter; or
    "atan2", w = atan2(y, x) / dt, which turns it round. Both take a waypoint at the robot's own
    place by its heading, if it has one (`cosim.episode.control`). Raises SpecError.

    >>> WaypointRule(index=0, dt_s=0.2).in_words
    'waypoint 0, units of 1 m, in 0.2 s, shipped'
    """

    index: int = 2
    unit_m: float = 1.0
    dt_s: float = 0.25
    rule: HowFollowed = "shipped"

    def __post_init__(self) -> None:
        if isinstance(self.index, bool) or not isinstance(self.index, int) or self.index < 0:
            raise SpecError(f"waypoints index must be a whole number from 0, not {self.index!r}")
        for field in ("unit_m", "dt_s"):
            value = getattr(self, field)
            if not (math.isfinite(value) and value > 0.0):
                raise SpecError(f"waypoints {field} must be a positive number, not {value}")
        if self.rule not in get_args(HowFollowed):
            raise SpecError(
                f"waypoints rule must be one of {', '.join(get_args(HowFollowed))}, not "
                f"{self.rule!r}"
            )

    @property
    def in_words(self) -> str:
        """As tables tell it."""
        return f"waypoint {self.index}, units of {self.unit_m:g} m, in {self.dt_s:g} s, {self.rule}"


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a policy says of itself. rate_hz: how often it acts; waypoints: how those that it
    answers are followed.

    camera: what it sees by, None for a blind one; cameras: further ones, by names of its own; goal:
    what it is told of where to go (`cosim.spec.goal.GOALS`), unless the run says otherwise;
    odometry: what its sensors tell of where it is (`cosim.spec.odometry.ODOMETRY`); privileged:
    whether it is told what a camera does not show; goals: those that it can do with, () for any: a
    run that gives others is refused. Raises nothing itself: an episode refuses what cannot be, such
    as a rate of which a period is no whole number of ticks.

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
    cameras: Mapping[str, CameraSpec] = filled(default_factory=dict)
    goals: tuple[GoalProtocol, ...] = ()

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the camera's pictures in pixels; (0, 0) without a camera."""
        return (0, 0) if self.camera is None else self.camera.size

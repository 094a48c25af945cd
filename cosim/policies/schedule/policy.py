"""`schedule:NAME` and `schedule:FILE.json`: drives an open-loop schedule without a camera.

It uses odometry, the goal and the clock, but neither pictures nor simulator state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Generic, NamedTuple, TypeVar

from cosim.core.errors import SpecError, UsageError, unknown
from cosim.core.state import STILL, Command
from cosim.episode.interfaces import Observation
from cosim.policies.schedule.cheats import CHEATS
from cosim.policies.schedule.way import LineWay, RasterWay, Way
from cosim.spec.manifest import Manifest
from cosim.spec.schedule import LaneChange, Part, Schedule, SpeedChange, Stop, read_schedule

RATE_HZ: Final = 10.0
"""Rate at which schedules are driven."""
_SUFFIX: Final = ".json"
_LOOK_S: Final = 0.8
_MIN_LOOK_M: Final = 0.7
"""Look-ahead of the pursuit, in seconds of travel, and its least distance in metres."""
_TURN_FIRST_RAD: Final = 1.2
"""Bearing beyond which the robot turns in place."""

_ROLL_M: Final = 1.5
_ROLL_S: Final = 1.0
"""Largest distance in metres and time in seconds that a robot rolls after a stop has begun."""
_BEFORE_GOAL_M: Final = 2.5
"""Distance in metres before the goal at which a stop surely begins before the goal is reached."""

P = TypeVar("P", bound=Part)


def schedule_called(name: str) -> Schedule:
    """Return a bundled schedule by name, or the one of a .json file.

    Raises UsageError with the valid names, SpecError naming the file and the field.

    >>> schedule_called("stop-every-2-m").stops[0].every
    2.0
    """
    if name.endswith(_SUFFIX):
        return read_schedule(Path(name).expanduser())
    if name not in CHEATS:
        raise unknown("schedule", name, [*CHEATS, f"path/to/file{_SUFFIX}"])
    return CHEATS[name]


def schedule_policy(name: str) -> SchedulePolicy:
    """Load the policy of a schedule. Raises UsageError."""
    try:
        return SchedulePolicy(schedule_called(name))
    except SpecError as error:
        raise UsageError(str(error)) from error


class SchedulePolicy:
    """Drives an open-loop schedule, blind."""

    def __init__(self, schedule: Schedule) -> None:
        self.schedule = schedule
        self.digest = schedule.digest
        self.manifest = Manifest(
            schedule.name,
            version=schedule.digest,
            rate_hz=RATE_HZ,
            camera=None,
            goal=schedule.goal,
            odometry="exact",
            goals=() if schedule.goal == "none" else (schedule.goal,),
        )
        self.reset("", 0)

    def reset(self, episode_id: str, seed: int) -> None:
        """Start an episode; nothing is random."""
        schedule = self.schedule
        follows = schedule.goal != "none"
        self._way: Way = RasterWay() if schedule.goal == "route_patch" else LineWay(follows)
        self._stops = [_Timing[Stop](one) for one in schedule.stops]
        self._lanes = [_Timing[LaneChange](one) for one in schedule.lanes]
        self._speeds = [_Timing[SpeedChange](one) for one in schedule.speeds]
        self._lane_m = 0.0
        self._v_mps = schedule.v_mps
        self._due: list[Stop] = []
        self._until_s = 0.0

    def act(self, observation: Observation) -> Command:
        """Return the command of the schedule at this position and time."""
        self._way.update(observation)
        now = _Progress(self._way.along_m, self._way.length_m, observation.time_s)
        for lane in _begun(self._lanes, now):
            self._lane_m = lane.to_m
        for speed in _begun(self._speeds, now):
            self._v_mps = speed.to_mps
        stop = self._stop_at(now)
        if stop is not None:
            return Command(stop.v_mps, stop.w_radps)
        return self._pursue(observation.robot.w_max_radps)

    def least_s(self, way_m: float, time_s: float, *, stops: bool = True) -> float:
        """Return the least time in seconds to drive `way_m` straight to the goal from now on.

        It is the time at the largest speed that may still come, with the stops that must begin
        before.
        way_m: at least this is to be driven.
        time_s: seconds since the start.
        stops: whether stops count.
        """
        to_come = [timing.part for timing in self._stops if not timing.has_begun]
        speeds = [timing.part.to_mps for timing in self._speeds if not timing.has_begun]
        fastest = max(self._v_mps, *speeds, *(stop.v_mps for stop in (*self._due, *to_come)), 0.0)
        if way_m <= 0.0:
            return 0.0
        least_s = way_m / fastest if fastest > 0.0 else math.inf
        if not stops or way_m <= _ROLL_M or any(stop.v_mps for stop in self._due):
            return least_s
        if self._due:
            least_s += self._until_s - time_s + sum(stop.for_s for stop in self._due[1:])
        before_m = self._way.length_m - _BEFORE_GOAL_M
        if math.isfinite(before_m):
            begins_m = [(stop, _begins_m(stop, self._way.length_m)) for stop in to_come]
            least_s += sum(
                stop.for_s
                for stop, at_m in begins_m
                if at_m is not None and at_m < before_m and not stop.v_mps
            )
        for stop in sorted(to_come, key=lambda one: one.at):
            if stop.by == "clock" and stop.at < time_s + least_s - _ROLL_S and not stop.v_mps:
                least_s += stop.for_s
        return least_s

    def _stop_at(self, now: _Progress) -> Stop | None:
        """Return the current stop, if any. Stops that begin during another one follow it."""
        begun = _begun(self._stops, now)
        if begun and not self._due:
            self._until_s = now.time_s + begun[0].for_s
        self._due += begun
        while self._due and now.time_s >= self._until_s - 1e-9:
            del self._due[0]
            if self._due:
                self._until_s = now.time_s + self._due[0].for_s
        return self._due[0] if self._due else None

    def _pursue(self, w_max_radps: float) -> Command:
        """Return the command towards a point ahead in the lane."""
        if self._v_mps == 0.0:
            return STILL
        look_m = max(_MIN_LOOK_M, _LOOK_S * self._v_mps)
        bearing_rad = self._way.bearing_rad(look_m, self._lane_m)
        if abs(bearing_rad) > _TURN_FIRST_RAD:
            return Command(0.0, math.copysign(w_max_radps, bearing_rad))
        return Command(self._v_mps, 2.0 * self._v_mps * math.sin(bearing_rad) / look_m)


class _Progress(NamedTuple):
    """Progress of a robot.

    length_m: of the way, infinite if unknown.
    """

    along_m: float
    length_m: float
    time_s: float

    def reached(self, part: Part, at: float) -> bool:
        """Return whether a position is reached, in the unit of a part."""
        if part.by == "clock":
            return self.time_s >= at - 1e-9
        if part.by == "goal":
            return self.length_m - self.along_m <= at
        return self.along_m >= (at * self.length_m if part.by == "share" else at)


class _Timing(Generic[P]):
    """Beginnings of a part of a schedule."""

    def __init__(self, part: P) -> None:
        self.part = part
        self._times = 0

    @property
    def has_begun(self) -> bool:
        return self._times > 0

    def begins(self, now: _Progress) -> bool:
        """Return whether the part begins now; then its next repetition is awaited."""
        part = self.part
        if self._times and not part.every:
            return False
        step = -part.every if part.by == "goal" else part.every
        if not now.reached(part, part.at + self._times * step):
            return False
        self._times += 1
        return True


def _begins_m(part: Part, length_m: float) -> float | None:
    """Return the position in metres along the way where a part begins; None by the clock."""
    if part.by == "clock":
        return None
    if part.by == "goal":
        return length_m - part.at
    return part.at * length_m if part.by == "share" else part.at


def _begun(timings: Sequence[_Timing[P]], now: _Progress) -> list[P]:
    """Return the parts that begin now, in their order."""
    return [timing.part for timing in timings if timing.begins(now)]

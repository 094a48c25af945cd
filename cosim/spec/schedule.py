"""Schedule: an open-loop driving plan, which depends on odometry, goal and clock only."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec

from cosim.spec.goal import GoalProtocol
from cosim.spec.scenario import content_hash
from cosim.spec.spec_file import read_spec_file
from cosim.spec.validation import ItemCount, PathName, Ranged, Within

Position = Literal["start", "goal", "share", "clock"]
"""Measure of a position: metres from the start, metres before the goal, share of the way to the
goal, or seconds."""
ScheduleGoal = Literal["none", "final_point", "route_point", "route_patch"]
"""Goal protocols that a schedule can follow."""
GOAL_POSITIONS: Final[tuple[Position, ...]] = ("goal", "share")
"""Positions that need the distance to the goal, so the protocol `final_point`."""
BEST_BLIND: Final = "best blind schedule found"
"""Name of the row of a suite's exploitability in tables."""
MAX_STOPS: Final = 5
MAX_LANES: Final = 4

_AT: Final = Within(0, 100_000)
_SPEED_MPS: Final = Within(0, 5)


class Part(Ranged, frozen=True, kw_only=True):
    """Part of a schedule that begins at a position.

    at: position where it begins, in the unit of `by`.
    every: distance to its repetition, in the unit of `by`; 0 without repetitions.
    """

    at: Annotated[float, _AT]
    by: Position = "start"
    every: Annotated[float, _AT] = 0.0

    @property
    def place_in_words(self) -> str:
        """Position in words."""
        unit = {"start": " m", "goal": " m before the goal", "share": " of the way", "clock": " s"}
        every = f" and every {self.every:g}{unit[self.by]}" if self.every else ""
        return f"at {self.at:g}{unit[self.by]}{every}"


class Stop(Part, frozen=True, kw_only=True):
    """Stop for some seconds; with speeds, a fixed command in place of the schedule.

    v_mps, w_radps: the command, forward and to the left.
    """

    for_s: Annotated[float, Within(0, 100_000)]
    v_mps: Annotated[float, _SPEED_MPS] = 0.0
    w_radps: Annotated[float, Within(-5, 5)] = 0.0


class LaneChange(Part, frozen=True, kw_only=True):
    """Change to another lane.

    to_m: lateral offset from the way, left positive.
    """

    to_m: Annotated[float, Within(-20, 20)]


class SpeedChange(Part, frozen=True, kw_only=True):
    """Change to another speed."""

    to_mps: Annotated[float, _SPEED_MPS]


class Schedule(Ranged, frozen=True, kw_only=True):
    """Open-loop plan of a policy without a camera. Raises SpecError for contradictory fields.

    The way is the straight line from the start to the goal, or ahead without a goal. With
    `route_point` and `route_patch` it follows the reference route.

    name: name of the policy in tables.
    v_mps: speed.
    goal: goal protocol that it follows; with "none" it accepts any and uses none.

    >>> Schedule(name="one-stop", stops=(Stop(at=7.0, for_s=2.5),)).v_mps
    1.2
    """

    name: Annotated[str, PathName("a schedule")]
    v_mps: Annotated[float, _SPEED_MPS] = 1.2
    stops: Annotated[tuple[Stop, ...], ItemCount(0, MAX_STOPS)] = ()
    lanes: Annotated[tuple[LaneChange, ...], ItemCount(0, MAX_LANES)] = ()
    speeds: Annotated[tuple[SpeedChange, ...], ItemCount(0, 1)] = ()
    goal: ScheduleGoal = "none"

    @property
    def prefix(self) -> str:
        return f"schedule '{self.name}': "

    def contradictions(self) -> Iterator[str]:
        if len(self.name) > 80:
            yield f"{self.prefix}name must have at most 80 characters"
        if self.goal == "final_point":
            return
        for kind, parts in (("stops", self.stops), ("lanes", self.lanes), ("speeds", self.speeds)):
            for number, part in enumerate(parts):
                if part.by in GOAL_POSITIONS:
                    yield (
                        f"{self.prefix}{kind}[{number}] is placed by '{part.by}', which needs "
                        f'"goal": "final_point", not "{self.goal}"'
                    )

    @property
    def in_words(self) -> str:
        """Speeds, stops and lanes in words.

        >>> Schedule(name="one", lanes=(LaneChange(at=7.0, to_m=-1.35),)).in_words
        '1.2 m/s; lane -1.35 m at 7 m'
        """
        words = [f"{self.v_mps:g} m/s"]
        words += [f"{one.to_mps:g} m/s {one.place_in_words}" for one in self.speeds]
        for stop in self.stops:
            turn = f" turning at {stop.w_radps:g} rad/s" if stop.w_radps else ""
            words.append(f"stop {stop.for_s:g} s{turn} {stop.place_in_words}")
        words += [f"lane {one.to_m:g} m {one.place_in_words}" for one in self.lanes]
        return "; ".join(words)

    @property
    def digest(self) -> str:
        """Hash of what it drives, 16 hex digits; its name is not included."""
        return content_hash(msgspec.structs.replace(self, name="schedule"))

    def under(self, goal: GoalProtocol) -> Schedule:
        """Return the schedule for a goal protocol; one that it cannot follow is not used."""
        follows: ScheduleGoal = "none"
        if goal in ("final_point", "route_point", "route_patch"):
            follows = goal
        return msgspec.structs.replace(self, goal=follows)


def read_schedule(path: Path) -> Schedule:
    """Load a schedule from a JSON file. Raises SpecError with file, field and valid choices."""
    return read_spec_file(path, Schedule)

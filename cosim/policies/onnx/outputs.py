"""What comes out of a graph: the field `output` of a bundle's manifest.

{"what": "waypoints", "name": "action", "unit_m": 0.25, "index": 2, "dt_s": 0.25}
{"what": "wheels", "left": {"name": "wheels", "index": 0}, "right": {"name": "wheels", "index": 1}, "unit_mps": 1.0}
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final, Literal

from cosim.episode.ports import HowFollowed, WaypointRule
from cosim.spec.ranges import Counted, Ranged, Within

_NUMBER: Final = Within(-1e9, 1e9)
_ABOVE_0: Final = Within(0, 1e9, above=True)


class Element(Ranged, frozen=True, kw_only=True):
    """One number of an output, from 0, counted through it with the last axis first."""

    name: str
    index: Annotated[int, Within(0, 10**9)] = 0


class Mixture(Ranged, frozen=True, kw_only=True):
    """Waypoints in one row of numbers: for each of `modes` the values of all points, as many scales of them, and one
    score, of which the highest is taken."""

    modes: Annotated[int, Within(1, 10_000)]
    points: Annotated[int, Within(1, 10_000)]


class WaypointsOutput(Ranged, frozen=True, kw_only=True, tag="waypoints", tag_field="what"):
    """Waypoints in the robot's frame: the output's last axis holds `columns`, the one before the waypoints.

    columns: what each is: x ahead, y left, -y right, heading in radians; "speed" m/s, "turn" rad/s; "" for what is not
    used. Numbers become number * scale + offset, one of each column, empty for 1 and 0. steps: each row is the way from
    the row before, x and y are summed up. unit_m: metres in one unit of x and y; index, dt_s, rule: which is followed
    and how (`cosim.episode.ports.WaypointRule`). follow: "speeds" takes speed and turn of row `index` for the command.

    Further axes are modes or samples: the first is taken, or the one with the highest of the output `scores`.
    """

    name: str
    columns: Annotated[
        tuple[
            Literal["x", "-x", "y", "-y", "cos", "sin", "-sin", "heading", "-heading", "speed", "turn", "-turn", ""],
            ...,
        ],
        Counted(2, 64),
    ] = ("x", "y")
    scale: Annotated[tuple[float, ...], Counted(0, 64)] = ()
    offset: Annotated[tuple[float, ...], Counted(0, 64)] = ()
    steps: bool = False
    unit_m: Annotated[float, _ABOVE_0] = 1.0
    index: Annotated[int, Within(0, 10_000)] = 2
    dt_s: Annotated[float, _ABOVE_0] = 0.25
    rule: HowFollowed = "shipped"
    follow: Literal["waypoint", "speeds"] = "waypoint"
    scores: str | None = None
    mixture: Mixture | None = None

    @property
    def called(self) -> str:
        return "waypoints "

    @property
    def waypoint_rule(self) -> WaypointRule:
        return WaypointRule(self.index, self.unit_m, self.dt_s, self.rule)

    @property
    def outputs(self) -> tuple[str, ...]:
        """The names of the graph's outputs that it reads."""
        return (self.name,) if self.scores is None else (self.name, self.scores)

    def contradictions(self) -> Iterator[str]:
        bare = [column.removeprefix("-") for column in self.columns if column]
        if len(set(bare)) != len(bare):
            yield f"waypoints columns must differ: {list(self.columns)}"
        wanted = {"x", "y"} | ({"speed", "turn"} if self.follow == "speeds" else set())
        if lacking := sorted(wanted - set(bare)):
            yield f"waypoints columns lack {', '.join(lacking)}: {list(self.columns)}"
        if ("cos" in bare) != ("sin" in bare) or ("cos" in bare and "heading" in bare):
            yield f"waypoints columns must have cos and sin, or heading, or neither: {list(self.columns)}"
        for field in ("scale", "offset"):
            if (numbers := getattr(self, field)) and len(numbers) != len(self.columns):
                yield f"waypoints {field} must hold {len(self.columns)} numbers or none, not {len(numbers)}"
        if self.mixture is not None and self.scores is not None:
            yield "waypoints mixture has scores of its own: leave scores out"
        if self.mixture is not None and self.index >= self.mixture.points:
            yield f"waypoints index must be below mixture.points, {self.mixture.points}, not {self.index}"


class WheelsOutput(Ranged, frozen=True, kw_only=True, tag="wheels", tag_field="what"):
    """Speeds of the wheels at the left and at the right, in units of `unit_mps`; the robot's track makes them a
    turn."""

    left: Element
    right: Element
    unit_mps: Annotated[float, _ABOVE_0] = 1.0

    @property
    def called(self) -> str:
        return "wheels "

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.left.name, self.right.name


class SteeringOutput(Ranged, frozen=True, kw_only=True, tag="steering", tag_field="what"):
    """A turn, in units of `unit_radps`, to the left unless that is negative; and a speed: `speed_mps`, times the number
    `speed`, times 1 less the number `stop`, where these are named. keep_turn, keep_speed: the share of the last command
    that stays in the next one."""

    turn: Element
    unit_radps: Annotated[float, _NUMBER] = 1.0
    speed_mps: Annotated[float, _ABOVE_0] = 1.0
    speed: Element | None = None
    stop: Element | None = None
    keep_turn: Annotated[float, Within(0, 0.99)] = 0.0
    keep_speed: Annotated[float, Within(0, 0.99)] = 0.0

    @property
    def called(self) -> str:
        return "steering "

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(one.name for one in (self.turn, self.speed, self.stop) if one is not None)

    def contradictions(self) -> Iterator[str]:
        if self.unit_radps == 0.0:
            yield "steering unit_radps must not be 0"


class CommandOutput(Ranged, frozen=True, kw_only=True, tag="command", tag_field="what"):
    """A speed in units of `unit_mps`, and a turn to the left in units of `unit_radps` (negative: to the right)."""

    v: Element
    w: Element
    unit_mps: Annotated[float, _ABOVE_0] = 1.0
    unit_radps: Annotated[float, _NUMBER] = 1.0

    @property
    def called(self) -> str:
        return "command "

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.v.name, self.w.name

    def contradictions(self) -> Iterator[str]:
        if self.unit_radps == 0.0:
            yield "command unit_radps must not be 0"


GraphOutput = WaypointsOutput | WheelsOutput | SteeringOutput | CommandOutput

"""Format of user scenario files: the fields of each table, with ranges and defaults.

Ranges that `cosim.spec` declares are not repeated. Each table is converted to its spec, which
checks them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Annotated, Final, Literal

from cosim.core.errors import SpecError
from cosim.place.route_line import ROUTE_M
from cosim.spec.goal import GoalProtocol
from cosim.spec.obstacle import OBSTACLE_VARIANTS, Obstacle, ObstacleKind
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City, CrowdSpec, Light
from cosim.spec.validation import (
    ARC_LENGTH_M,
    COORDINATE_M,
    SEED,
    PathName,
    Points,
    Ranged,
    Text,
    Within,
)
from cosim.spec.weather import CLEAR, weather_fault

STRAIGHT_M: Final = (10.0, 100.0)
_MAX_SEEDS: Final = 1000
_TURNED_DEG: Final = Within(-360, 360)
_SIZES: Final = ("small", "middle", "large")

WayKind = Literal["straight", "curve", "crosswalk", "route"]
PointXY = tuple[float, float]


def _refusal_of(make: Callable[[], object]) -> str:
    """Return the error of a spec's constructor, or "" if it succeeds."""
    try:
        make()
    except SpecError as error:
        return str(error)
    return ""


class OwnPlace(Ranged, frozen=True, kw_only=True):
    """Place of a scenario: one of city, map and file.

    city: seed of a generated city, size_m across, of a style.
    map: name in `cosim map list`.
    file: path of a map, relative to this file.
    roughness: of the ground, 0 to 1.
    """

    city: Annotated[int | None, SEED] = None
    size_m: float = 1000.0
    style: str = "mixed"
    map: Annotated[str, Text(200)] = ""
    file: Annotated[str, Text(1000)] = ""
    roughness: Annotated[float, Within(0, 1)] = 0.0

    @property
    def prefix(self) -> str:
        return "place "

    def contradictions(self) -> Iterator[str]:
        given = [name for name in ("city", "map", "file") if getattr(self, name) not in (None, "")]
        if len(given) != 1:
            yield f"place: give one of city, map, file, not {' and '.join(given) or 'none'}"
        if self.city is not None:
            yield _refusal_of(
                lambda: City(seed=self.city or 0, size_m=self.size_m, style=self.style)
            )


class OwnWay(Ranged, frozen=True, kw_only=True):
    """Way of a scenario: one of kind, start and goal, and route.

    kind: drawn from the seed, length_m long.
    start, goal: ends of a shortest way, moved to the middle of the nearest sidewalk.
    route: points of the way.
    fences: close all branches, so that one path is left.
    signals: the crossings of the way have signals, have none, or either.
    """

    kind: WayKind | None = None
    length_m: float | None = None
    start: PointXY | None = None
    goal: PointXY | None = None
    route: Annotated[tuple[PointXY, ...], Points(COORDINATE_M.low, COORDINATE_M.high)] = ()
    fences: bool = False
    signals: Literal["any", "with", "without"] = "any"

    @property
    def prefix(self) -> str:
        return "way "

    def contradictions(self) -> Iterator[str]:
        points = [name for name in ("start", "goal") if getattr(self, name) is not None]
        given = [
            *filter(
                None,
                (self.kind and "kind", points and " and ".join(points), self.route and "route"),
            )
        ]
        if len(given) != 1:
            yield (
                f"way: give one of kind, start and goal, route, not "
                f"{', '.join(map(str, given)) or 'none'}"
            )
        elif len(points) == 1:
            yield (
                f"way: start and goal go together; {'goal' if points == ['start'] else 'start'} "
                f"is missing"
            )
        for name in points:
            for k, where_m in enumerate(getattr(self, name)):
                yield COORDINATE_M.refusal(f"way {name}[{k}]", where_m)
        if len(self.route) == 1 or (self.route and len(set(self.route)) == 1):
            yield "way route needs two different points or more"
        lengths = {"straight": STRAIGHT_M, "route": ROUTE_M}
        if self.length_m is not None and self.kind in lengths:
            yield Within(*lengths[self.kind]).refusal(
                f"way length_m of kind '{self.kind}'", self.length_m
            )
        elif self.length_m is not None and len(given) == 1:
            what = f"one of kind '{self.kind}'" if self.kind else f"one by {given[0]}"
            yield f"way length_m is for ways of kind 'straight' and 'route', not for {what}"
        if self.signals == "with" and self.kind in ("straight", "curve"):
            yield (
                f"way signals 'with' is for ways over crossings; one of kind '{self.kind}' "
                f"crosses no street"
            )
        if self.fences and self.route:
            yield (
                "way fences close the branches of ways that are found here: of kind 'route', or "
                "from start to goal"
            )
        if self.fences and self.kind in ("straight", "curve", "crosswalk"):
            yield f"way fences are for long ways; one of kind '{self.kind}' is short"


class OwnEvent(Ranged, frozen=True, kw_only=True):
    """People who meet the robot.

    at_m: along the route; by default the suitable place nearest to its middle.
    people: number; by default the least of the kind.
    side: of the sidewalk, for kinds that come from one.
    """

    kind: str
    at_m: Annotated[float | None, ARC_LENGTH_M] = None
    side: Literal["left", "right"] = "left"
    people: Annotated[int | None, Within(1, 100)] = None
    speed_mps: Annotated[float, Within(0, 3, above=True)] = 1.3

    @property
    def prefix(self) -> str:
        return "event "


class OwnObstacle(Ranged, frozen=True, kw_only=True):
    """Obstacle at_m along the route and left_m to the left of it (right below 0).

    turned_deg: angle from the direction of the route, counter-clockwise.
    paint: one of four.
    """

    kind: ObstacleKind
    at_m: Annotated[float, ARC_LENGTH_M]
    left_m: Annotated[float, Within(-20, 20)] = 0.0
    turned_deg: Annotated[float, _TURNED_DEG] = 0.0
    size: Literal["small", "middle", "large"] = "middle"
    paint: Annotated[int, Within(0, 3)] = 0

    @property
    def prefix(self) -> str:
        return "obstacle "

    @property
    def form(self) -> int:
        """Size and paint, as `Obstacle` has them."""
        return _SIZES.index(self.size) + OBSTACLE_VARIANTS * self.paint

    def standing(self, x_m: float, y_m: float, along_rad: float) -> Obstacle:
        """Return the obstacle at a point of the route with direction `along_rad`."""
        turned = math.remainder(along_rad + math.radians(self.turned_deg), 2.0 * math.pi)
        x_m = x_m - self.left_m * math.sin(along_rad)
        y_m = y_m + self.left_m * math.cos(along_rad)
        at = {"x_m": round(x_m, 3), "y_m": round(y_m, 3), "heading_rad": round(turned, 4)}
        return Obstacle(kind=self.kind, form=self.form, **at)


class OwnObstacles(Ranged, frozen=True, kw_only=True):
    """Obstacles on the sidewalks.

    per_100m: number of drawn obstacles along 100 m, each leaving room for the robot and 0.5 m.
    beside: draw none within 1 m of the middle of the route.
    placed: obstacles at given places.
    """

    per_100m: Annotated[float, Within(0, 40)] = 0.0
    beside: bool = False
    placed: tuple[OwnObstacle, ...] = ()

    @property
    def prefix(self) -> str:
        return "obstacles "


class OwnCrowd(Ranged, frozen=True, kw_only=True):
    """People and vehicles, as in `CrowdSpec`; none by default.

    persons, or density: persons per 1000 m2.
    """

    persons: int | None = None
    density: float | None = None
    vehicles: int = 0
    radius_m: float = 80.0
    residents: int = 0
    groups: float = 0.0
    elderly: float = 0.0
    children: float = 0.0

    def contradictions(self) -> Iterator[str]:
        if self.persons is not None and self.density is not None:
            yield f"crowd: give persons ({self.persons}) or density ({self.density:g}), not both"
        else:
            yield _refusal_of(lambda: self.spec)

    @property
    def prefix(self) -> str:
        return "crowd "

    @property
    def spec(self) -> CrowdSpec:
        """The crowd of a scenario."""
        same = {name: getattr(self, name) for name in self.__struct_fields__[2:]}
        if self.density is not None:
            return CrowdSpec(density=self.density, **same)
        return CrowdSpec(persons=self.persons or 0, **same)


class OwnLimits(Ranged, frozen=True, kw_only=True):
    """Limits of an episode.

    time_s: by default one minute plus the time for the route at 0.2 m/s.
    ends_at: the goal, or the robot's stop before a person with a raised hand.
    """

    time_s: Annotated[float | None, Within(0.1, 100_000)] = None
    goal_radius_m: Annotated[float, Within(0.1, 20)] = 1.0
    ends_on_failure: bool = False
    ends_at: Literal["goal", "stop"] = "goal"

    @property
    def prefix(self) -> str:
        return "limits "


class OwnScenario(Ranged, frozen=True, kw_only=True):
    """User scenario file.

    seed: of everything that is drawn.
    seeds: number of repetitions, each with the next seed.
    weather: name of a row of `cosim.spec.weather.WEATHERS`.
    goal_protocol: form of the goal for the policy; by default that of its manifest.
    """

    name: Annotated[str, PathName("a scenario")]
    description: Annotated[str, Text(1000)] = ""
    seed: Annotated[int, SEED] = 0
    seeds: Annotated[int, Within(1, _MAX_SEEDS)] = 1
    robot: str = COURIER.name
    goal_protocol: GoalProtocol | None = None
    place: OwnPlace
    way: OwnWay
    events: tuple[OwnEvent, ...] = ()
    obstacles: OwnObstacles = OwnObstacles()
    crowd: OwnCrowd = OwnCrowd()
    light: Light = Light()
    weather: str = CLEAR
    limits: OwnLimits = OwnLimits()

    def contradictions(self) -> Iterator[str]:
        yield weather_fault(self.weather)

    @property
    def prefix(self) -> str:
        return ""

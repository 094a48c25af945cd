"""Draw scenarios from a seed until one fits its place, and build the parts of all route
scenarios.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Final, TypeVar

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.errors import CosimError, SpecError
from cosim.core.geometry import Polyline
from cosim.core.state import PERSON_RADIUS_M
from cosim.people.yielding import STEP_ROUND_GAP_M
from cosim.place.street_map import StreetMap, Strip
from cosim.spec.events import EventKind
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import Place, RouteCrossing, Scenario
from sumo_nets.crowd.free_space import LocalWalkableArea
from sumo_nets.crowd.group_sampling import GROUP_STRIPE_M

TRIES: Final = 400
SCAN_TRIES: Final = 800
"""Numbers of draws, and of those on scans, which have few places."""
_STEP_M: Final = 5.0
"""Distance between the points of a route at which the room of people is measured, m."""
FREE_M2: Final = 20.0
"""Area of sidewalk for each person, m2, on routes drawn with `--map`: of the stripes that the robot
leaves free."""
CROWDED_SHARE: Final = 0.2
"""Share of such a route on which there may be less than FREE_M2 for each person."""
BESIDE_PERSON_M: Final = 2.0 * PERSON_RADIUS_M + 3.0 * STEP_ROUND_GAP_M
"""Width in addition to the robot's, m, with which a person passes it and keeps a gap on every
side."""
LARGEST_GROUP_M: Final = 3 * GROUP_STRIPE_M
"""Width of the largest group, side by side, in metres."""
NARROW_M: Final = 10.0
"""Length of route, in metres, up to which sidewalks without room to pass a group are ignored."""

_ROUNDING: Final = 1e-6

_Drawn = TypeVar("_Drawn")


class Refusals:
    """Counter of the reasons for refused draws."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, refusal: CosimError) -> None:
        """Count one more. What follows a colon is of this draw alone."""
        self._counts[str(refusal).split(":")[0]] += 1

    def __str__(self) -> str:
        return "; ".join(f"{reason} ({n} times)" for reason, n in self._counts.most_common())

    @property
    def most_frequent(self) -> str:
        """Return the most frequent reason, "" without refusals."""
        return self._counts.most_common(1)[0][0] if self._counts else ""


def first_that_fits(draw: Callable[[], Scenario], failure: str, tries: int = TRIES) -> Scenario:
    """Return the first of a number of draws that is not refused.

    Raises SpecError with `failure` and the count of each reason.
    """
    refusals = Refusals()
    found = first_of((draw for _ in range(tries)), refusals)
    if found is None:
        raise SpecError(f"{failure} in {tries} draws: {refusals}")
    return found


def first_of(draws: Iterable[Callable[[], _Drawn]], refusals: Refusals) -> _Drawn | None:
    """Return the first draw that is not refused, or None. Refusals are counted."""
    for draw in draws:
        try:
            return draw()
        except CosimError as refusal:
            refusals.add(refusal)
        except shapely.errors.GEOSException as error:
            refusals.add(SpecError(f"the ground is too tangled: {error}"))
    return None


def bare_scenario(
    route: Polyline,
    crossings: tuple[RouteCrossing, ...],
    place: Place,
    street_map: StreetMap,
    *,
    suite: str,
    seed: int,
    scenario_id: str,
    time_limit_s: float,
    robot: Robot = COURIER,
) -> Scenario:
    """Build a scenario from one end of a route to the other, without any other content."""
    start = route.at(0.0)
    goal = route.at(route.length_m)
    return Scenario(
        id=scenario_id,
        suite=suite,
        place=msgspec.structs.replace(place, net_hash=street_map.net_hash),
        seed=seed,
        start=(start.x_m, start.y_m, start.heading_rad),
        goal=(goal.x_m, goal.y_m),
        route=tuple((float(x), float(y)) for x, y in route.points),
        crossings=crossings,
        time_limit_s=time_limit_s,
        robot=robot.name,
    )


def people_of(kind: EventKind, half_width_m: float, robot: Robot, rng: np.random.Generator) -> int:
    """Draw the number of people of an event so that the robot has room to pass them."""
    if kind.group is not None:
        return kind.group(half_width_m - 0.5 * wider_m(robot), rng)
    fewest, most = kind.people
    return int(rng.integers(fewest, most + 1))


def wider_m(robot: Robot) -> float:
    """Return the width of a robot beyond that of the robot for which event layouts are written."""
    return robot.width_m - COURIER.width_m


def passable(scenario: Scenario, street_map: StreetMap, robot: Robot = COURIER) -> Scenario:
    """Return the scenario with a crowd that leaves the robot room to pass, for routes drawn with
    `--map`.

    People spread evenly over the length of sidewalks, so narrow sidewalks have less room for each.
    The crowd is as dense as leaves each person FREE_M2 on all but CROWDED_SHARE of the route's
    sidewalks. On sidewalks narrower than `passing_width_m`, no ground counts as free.
    There are no groups where three abreast fill a sidewalk of the route.
    A crowd without a density is unchanged.
    """
    crowd = scenario.crowd
    if crowd.density is None:
        return scenario
    line = shapely.LineString(scenario.route)
    lane_m = robot.width_m + 2.0 * STEP_ROUND_GAP_M
    narrow_m = sum(
        strip.polygon.intersection(line).length
        for strip in street_map.near("strip", line)
        if isinstance(strip, Strip)
        and strip.kind == "sidewalk"
        and strip.width_m < LARGEST_GROUP_M + lane_m
    )
    free = _free_share_along(scenario, street_map, robot)
    fitting = 1000.0 * float(np.quantile(free, CROWDED_SHARE, method="lower")) / FREE_M2
    crowd = msgspec.structs.replace(
        crowd,
        density=min(crowd.density, round(fitting, 1)),
        groups=crowd.groups if narrow_m <= NARROW_M else 0.0,
    )
    return msgspec.structs.replace(scenario, crowd=crowd)


def passing_width_m(robot: Robot) -> float:
    """Return the width of the narrowest sidewalk on which people pass a robot, m.

    People walk in stripes. One stripe must stay free of the robot and its gaps.
    """
    return (_stripes_of(robot) + 1) * GROUP_STRIPE_M


def _stripes_of(robot: Robot) -> int:
    return math.ceil((robot.width_m + 2.0 * STEP_ROUND_GAP_M) / GROUP_STRIPE_M - _ROUNDING)


def _free_share_along(
    scenario: Scenario, street_map: StreetMap, robot: Robot
) -> NDArray[np.float64]:
    """Return the share of walkable ground that is free, at points of the route on sidewalks.

    Free is the length of sidewalks within the crowd's radius, times the width that the robot
    leaves free at the point.
    """
    route = scenario.route_line
    strips = street_map.near(
        "strip", shapely.LineString(route.points).buffer(scenario.crowd.radius_m)
    )
    sidewalks = [strip for strip in strips if isinstance(strip, Strip) and strip.kind == "sidewalk"]
    lines = np.array([shapely.LineString(strip.line[:, :2]) for strip in sidewalks], dtype=object)
    walkable = LocalWalkableArea(street_map, scenario.crowd.radius_m)
    shares = []
    for s_m in np.arange(0.0, route.length_m, _STEP_M).tolist():
        x_m, y_m = route.at(s_m).xy
        here = street_map.strips.get(street_map.locate(x_m, y_m, 0.05).edge)
        if here is None or here.kind != "sidewalk":
            continue
        around = shapely.Point(x_m, y_m).buffer(scenario.crowd.radius_m)
        length_m = float(shapely.length(shapely.intersection(lines, around)).sum())
        free = max(int(here.width_m / GROUP_STRIPE_M + _ROUNDING) - _stripes_of(robot), 0)
        shares.append(length_m * free * GROUP_STRIPE_M / walkable.area_m2(x_m, y_m))
    return np.array(shares or [0.0])

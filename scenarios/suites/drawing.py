"""Draw scenarios from a seed until one fits its place, and build the parts of all route
scenarios.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Final, TypeVar

import msgspec
import numpy as np
import shapely

from cosim.core.errors import CosimError, SpecError
from cosim.core.geometry import Polyline
from cosim.people.yielding import STEP_ROUND_GAP_M
from cosim.place.street_map import StreetMap, Strip
from cosim.spec.events import EventKind
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import Place, RouteCrossing, Scenario
from sumo_nets.crowd.group_sampling import GROUP_STRIPE_M

TRIES: Final = 400
PERSON_M2: Final = 25.0
"""Least mean area of sidewalk for each person along a route, in m2; about 29 in generated
cities.
"""
_SAMPLE_M: Final = 20.0

FREE_M2: Final = 20.0
"""Area of sidewalk for each person, without the lane of the robot, on routes of users, in m2; about
21 in generated cities.
"""
LARGEST_GROUP_M: Final = 3 * GROUP_STRIPE_M
"""Width of the largest group, side by side, in metres."""
NARROW_M: Final = 10.0
"""Length of route, in metres, up to which sidewalks without room to pass a group are ignored."""

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


def first_that_fits(draw: Callable[[], Scenario], failure: str) -> Scenario:
    """Return the first of TRIES draws that is not refused.

    Raises SpecError with `failure` and the count of each reason.
    """
    refusals = Refusals()
    found = first_of((draw for _ in range(TRIES)), refusals)
    if found is None:
        raise SpecError(f"{failure} in {TRIES} draws: {refusals}")
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


def thinned(scenario: Scenario, street_map: StreetMap) -> Scenario:
    """Return the scenario with no more people than fit on the sidewalks near its route.

    Sidewalks within the radius of the crowd count.
    """
    persons = min(
        scenario.crowd.persons, round(_area_around_m2(scenario, street_map, 0.0) / PERSON_M2)
    )
    return msgspec.structs.replace(
        scenario, crowd=msgspec.structs.replace(scenario.crowd, persons=persons)
    )


def passable(scenario: Scenario, street_map: StreetMap, robot: Robot = COURIER) -> Scenario:
    """Return the scenario with a crowd that leaves the robot room to pass.

    The number of people is limited to those that leave room for the robot. Groups are removed if
    three people abreast fill a sidewalk of the route. The shipped suites use `thinned` alone.
    """
    scenario = thinned(scenario, street_map)
    lane_m = robot.width_m + 2.0 * STEP_ROUND_GAP_M
    line = shapely.LineString(scenario.route)
    narrow_m = sum(
        strip.polygon.intersection(line).length
        for strip in street_map.near("strip", line)
        if isinstance(strip, Strip)
        and strip.kind == "sidewalk"
        and strip.width_m < LARGEST_GROUP_M + lane_m
    )
    crowd = scenario.crowd
    persons = min(crowd.persons, round(_area_around_m2(scenario, street_map, lane_m) / FREE_M2))
    groups = crowd.groups if narrow_m <= NARROW_M else 0.0
    return msgspec.structs.replace(
        scenario, crowd=msgspec.structs.replace(crowd, persons=persons, groups=groups)
    )


def _area_around_m2(scenario: Scenario, street_map: StreetMap, less_m: float) -> float:
    """Return the mean area of sidewalk within the crowd's radius of points on the route.

    less_m: subtracted from each width.
    """
    route = Polyline(np.array(scenario.route))
    around = [
        shapely.Point(route.at(float(s_m)).xy).buffer(scenario.crowd.radius_m)
        for s_m in np.arange(0.0, route.length_m, _SAMPLE_M)
    ]
    area_m2 = [
        sum(
            strip.polygon.intersection(disc).area * max(1.0 - less_m / strip.width_m, 0.0)
            for strip in street_map.near("strip", disc)
            if isinstance(strip, Strip) and strip.kind == "sidewalk"
        )
        for disc in around
    ]
    return float(np.mean(area_m2))

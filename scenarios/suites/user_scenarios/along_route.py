"""Events and obstacles along the route of a user scenario, as given in its file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from cosim.core.errors import SpecError
from cosim.core.geometry import Polyline, Pose
from cosim.core.state import PERSON_RADIUS_M
from cosim.place.street_map import StreetMap
from cosim.spec.events import Event, EventKind
from cosim.spec.obstacle import Obstacle
from cosim.spec.robot import Robot, robot_called
from cosim.spec.scenario import Scenario
from scenarios.events import EVENT_KINDS
from scenarios.suites.drawing import wider_m
from scenarios.suites.user_scenarios.format import OwnEvent, OwnObstacle
from scenarios.suites.way_events import crosswalk_spots, is_straight_between

_NARROW_M: Final = 0.25
"""Space that a sidewalk with a standing person needs on either side of robot and person, in
metres.
"""
_LOOK_EVERY_M: Final = 0.5
_BEYOND_M: Final = 5.0
"""Length after its place along which the route of an event is straight, unless it ends before."""


def event_along(
    number: int, wanted: OwnEvent, scenario: Scenario, street_map: StreetMap, robot: Robot
) -> Event:
    """Return the event of a file on the way of a scenario.

    Raises SpecError with the reason, and the places where it fits.
    """
    kind = EVENT_KINDS[wanted.kind]
    route = scenario.route_line
    half_length_m = 0.0
    if kind.layout is None:
        spots = crosswalk_spots(street_map, route, scenario.crossings)
        if not spots:
            raise SpecError(
                f"'{kind.name}' needs a crossing without signals, 5 to 12 m long, that the way "
                "leads straight over, and there is none: give another start and goal, or route, "
                "or a way of kind 'crosswalk'"
            )
        at_m = route.length_m / 2 if wanted.at_m is None else wanted.at_m
        spot = min(spots, key=lambda one: abs(one.s_m - at_m))
        if wanted.at_m is not None and abs(spot.s_m - at_m) > spot.half_length_m:
            where = _listed(
                [(one.s_m - one.half_length_m, one.s_m + one.half_length_m) for one in spots]
            )
            raise SpecError(
                f"at_m {at_m:g} is on no crossing for '{kind.name}': it fits from {where}"
            )
        at_m, half_width_m, half_length_m = spot.s_m, spot.half_width_m, spot.half_length_m
    else:
        at_m = _place_of(wanted, kind, scenario, street_map, robot)
        half_width_m = _half_width_m(route, at_m, street_map)
    pose = _beyond(route, at_m)
    before, behind = (route.at(at_m + d_m) for d_m in (-half_length_m, half_length_m))
    heading_rad = (
        math.atan2(behind.y_m - before.y_m, behind.x_m - before.x_m)
        if half_length_m
        else pose.heading_rad
    )
    return Event(
        id=f"e{number}",
        kind=kind.name,
        x_m=pose.x_m,
        y_m=pose.y_m,
        heading_rad=heading_rad,
        route_s_m=at_m,
        half_width_m=half_width_m,
        half_length_m=half_length_m,
        people=kind.people[0] if wanted.people is None else wanted.people,
        speed_mps=wanted.speed_mps,
        side=1 if wanted.side == "left" else -1,
    )


def narrow_events(scenario: Scenario) -> Iterator[str]:
    """Return events on sidewalks narrower than those of the suites, which may leave no room to
    pass.
    """
    robot = robot_called(scenario.robot)
    for event in scenario.events:
        layout = EVENT_KINDS[event.kind].layout
        usual_m = 0.0 if layout is None else 2.0 * (layout.half_width_m + wider_m(robot))
        if 2.0 * event.half_width_m < usual_m:
            yield (
                f"'{event.kind}' at {event.route_s_m:.1f} m: the sidewalk is "
                f"{2 * event.half_width_m:.1f} m wide, "
                f"in the suites {usual_m:.1f} m or more: there may be no room to pass"
            )


def obstacle_along(wanted: OwnObstacle, route: Polyline) -> Obstacle:
    """Return the obstacle of a file at its place along the route.

    Raises SpecError if the route is too short.
    """
    if wanted.at_m > route.length_m:
        raise SpecError(
            f"at_m {wanted.at_m:g} is past the goal: the way is {route.length_m:.1f} m long"
        )
    return wanted.standing(*route.at(wanted.at_m))


def _place_of(
    wanted: OwnEvent, kind: EventKind, scenario: Scenario, street_map: StreetMap, robot: Robot
) -> float:
    """Return the place of an event on sidewalks, in metres along the route.

    It is the given place, or the suitable place nearest to the middle of the route.
    """
    route = scenario.route_line
    if wanted.at_m is not None:
        reason = _misfit(kind, wanted.at_m, route, street_map, robot)
        if not reason:
            return wanted.at_m
        refusal = f"at_m {wanted.at_m:g} does not do for '{kind.name}': {reason}"
    else:
        reason = _misfit(kind, route.length_m / 2, route, street_map, robot)
        refusal = f"no place for '{kind.name}': in the middle of the way, {reason}"
    at = np.arange(0.0, route.length_m + _BEYOND_M, _LOOK_EVERY_M)
    fits = np.array([not _misfit(kind, s_m, route, street_map, robot) for s_m in at.tolist()])
    if not fits.any():
        raise SpecError(
            f"{refusal}; it fits nowhere on this way of {route.length_m:.1f} m: give another "
            f"way or kind"
        )
    if wanted.at_m is not None:
        raise SpecError(f"{refusal}; it fits from {_listed(_runs(at, fits))}")
    return float(at[fits][np.argmin(abs(at[fits] - route.length_m / 2))])


def _misfit(
    kind: EventKind, at_m: float, route: Polyline, street_map: StreetMap, robot: Robot
) -> str:
    """Return why an event cannot take place there, or "" if it can."""
    layout = kind.layout
    assert layout is not None
    if at_m < layout.event_m[0]:
        return (
            f"it begins before the robot is there, {layout.event_m[0]:g} m from the start or "
            f"farther"
        )
    if at_m > route.length_m + _BEYOND_M:
        return f"the way ends at {route.length_m:.1f} m"
    half_m = _half_width_m(route, at_m, street_map)
    needed_m = layout.half_width_m + wider_m(robot)
    if not kind.passed_as_group:
        needed_m = min(needed_m, robot.width_m / 2 + PERSON_RADIUS_M + _NARROW_M)
    if half_m <= 0.0:
        return "no sidewalk is there, but a corner or a crossing"
    if half_m < needed_m:
        return f"the sidewalk is {2 * half_m:.1f} m wide there, and it needs {2 * needed_m:.1f} m"
    from_m = max(at_m - layout.event_m[0], 0.0)
    to_m = min(at_m + _BEYOND_M, route.length_m)
    if to_m - from_m > 1.0 and not is_straight_between(route, from_m, to_m):
        return f"the way bends between {from_m:.0f} and {to_m:.0f} m, and it needs a straight one"
    return ""


def _half_width_m(route: Polyline, at_m: float, street_map: StreetMap) -> float:
    """Return half the width of the sidewalk there, in metres, or 0 without a sidewalk."""
    pose = _beyond(route, at_m)
    strip = street_map.strips.get(street_map.locate(pose.x_m, pose.y_m, 0.05).edge)
    return strip.width_m / 2 if strip is not None and strip.kind == "sidewalk" else 0.0


def _beyond(route: Polyline, at_m: float) -> Pose:
    """Return the point at an arc length of a route, extended straight past its goal."""
    pose = route.at(at_m)
    past_m = max(at_m - route.length_m, 0.0)
    x_m, y_m = (
        pose.x_m + past_m * math.cos(pose.heading_rad),
        pose.y_m + past_m * math.sin(pose.heading_rad),
    )
    return Pose(x_m, y_m, pose.heading_rad)


def _runs(at: np.ndarray, fits: np.ndarray) -> list[tuple[float, float]]:
    """Return the stretches that fit, each from its first place to its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], fits, [False]]).astype(int)))
    return [(float(at[first]), float(at[last - 1])) for first, last in edges.reshape(-1, 2)]


def _listed(spans: Sequence[tuple[float, float]]) -> str:
    """Format stretches of a route as text."""
    return ", and from ".join(
        f"{math.ceil(10 * a) / 10:g} to {math.floor(10 * b) / 10:g} m" for a, b in spans[:4]
    )

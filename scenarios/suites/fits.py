"""Checks that scenarios fit their places, before any simulation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np
import shapely
from shapely.geometry import LineString, Point

from cosim.core.errors import MapError, SpecError, UsageError
from cosim.core.progress import Progress, ignore
from cosim.place.barriers import outline
from cosim.place.street_map import StreetMap, WalkableArea
from cosim.spec.obstacle import footprint
from cosim.spec.robot import ROBOTS, robot_called
from cosim.spec.scenario import MAX_PERSONS, Place, RouteCrossing, Scenario, Suite, event_faults
from cosim.spec.spec_file import join_faults
from physics.cameras.hdri import read_hdri
from scenarios.events import EVENT_KINDS
from scenarios.ipc.parallel_map import parallel_map
from scenarios.places.nets import place
from sumo_nets.crowd.free_space import LocalWalkableArea

LOOKING: Final = "looking where the episodes take place"
_PLACES_A_PROCESS: Final = 8
"""Number of places for each process; fewer are checked faster without another process."""
_AROUND_M: Final = 3.0
"""Distance around routes and events in which a place is checked, in metres."""
_SAMPLE_M: Final = 0.5
_EDGE_M: Final = 0.02
"""Distance from the edge of the walkable area, in metres, below which a point is on it."""
BESIDE_STRIP_M: Final = 8.0
"""Largest distance of a barrier from the strip that it closes, in metres. Strips end where corners
begin, and corners are wide.
"""


def check_places(
    suite: Suite, scenarios: Sequence[Scenario], progress: Progress = ignore, jobs: int = 1
) -> None:
    """Check that each scenario of a suite fits its place, and generate missing places.

    Places are checked one by one, or by `jobs` processes if there are many.

    Raises SpecError with all faults, scenario by scenario. Raises MachineError if the machine lacks
    a requirement.
    """
    there: dict[Place, list[Scenario]] = {}
    for scenario in scenarios:
        there.setdefault(scenario.place, []).append(scenario)
    faults = [*_missing_robots_and_skies(scenarios), *_invalid_events(scenarios)]
    jobs = min(jobs, len(there) // _PLACES_A_PROCESS)
    for found in parallel_map(_misfits_at, list(there.items()), jobs, progress, LOOKING):
        faults += found
    if faults:
        raise SpecError(f"suite '{suite.name}': {join_faults(faults)}")


def _misfits_at(of_place: tuple[Place, Sequence[Scenario]]) -> list[str]:
    """Return the faults of the scenarios of one place, which is generated if missing."""
    where, scenarios = of_place
    try:
        _, street_map = place(where)
    except (MapError, UsageError, SpecError) as error:
        more = f" and {len(scenarios) - 1} more" if len(scenarios) > 1 else ""
        return [f"scenario '{scenarios[0].id}'{more}: {error}"]
    return [*misfits(scenarios, street_map)]


def misfits(scenarios: Sequence[Scenario], street_map: StreetMap) -> Iterator[str]:
    """Yield the faults of scenarios that use one map."""
    spots = {(event.x_m, event.y_m) for scenario in scenarios for event in scenario.events}
    ways = {scenario.route for scenario in scenarios}  # the union of many equal shapes is very slow
    near = shapely.union_all([*map(LineString, sorted(ways)), *map(Point, sorted(spots))])
    try:
        area = WalkableArea(street_map.walkable_near(shapely.buffer(near, _AROUND_M)))
    except MapError:
        yield from (
            f"scenario '{one.id}': start {one.start[:2]} is not on map '{street_map.name}'"
            for one in scenarios
        )
        return
    for scenario in scenarios:
        faults = (
            *_outside_area(scenario, area),
            *_invalid_crossings(scenario, street_map),
            *_invalid_barriers(scenario, street_map),
            *_invalid_obstacles(scenario, area),
            *_excessive_crowd(scenario, street_map),
        )
        yield from (f"scenario '{scenario.id}': {fault}" for fault in faults)


def _outside_area(scenario: Scenario, area: WalkableArea) -> Iterator[str]:
    """Yield where the route first leaves the walkable area, and the events outside it."""
    line = scenario.route_line.resampled(_SAMPLE_M)
    off = np.flatnonzero(area.signed_distance(line.points) < -_EDGE_M)
    if len(off):
        (x_m, y_m) = line.points[off[0]]
        s_m = line.s_m[off[0]]
        what = "start" if off[0] == 0 else "route"
        yield (
            f"{what} is off the walkable area at ({x_m:.2f}, {y_m:.2f}), {s_m:.1f} m along the "
            f"route"
        )
    for event in scenario.events:
        if area.signed_distance([event.x_m, event.y_m])[0] < -_EDGE_M:
            yield (
                f"event '{event.id}' is off the walkable area at ({event.x_m:.2f}, {event.y_m:.2f})"
            )


def _invalid_crossings(scenario: Scenario, street_map: StreetMap) -> Iterator[str]:
    """Yield crossings that the map lacks, or has elsewhere."""
    for crossing in scenario.crossings:
        strip = street_map.strips.get(crossing.id)
        if strip is None or strip.kind != "crossing":
            yield f"crossing '{crossing.id}' is none of map '{street_map.name}'"
        elif strip.signalised != crossing.signalised:
            yield (
                f"crossing '{crossing.id}': signalised is {strip.signalised} on the map, not "
                f"{crossing.signalised}"
            )
        elif not strip.polygon.intersects(_on(scenario, crossing)):
            yield f"crossing '{crossing.id}' is not where the route is from enter_s_m to leave_s_m"


def _on(scenario: Scenario, crossing: RouteCrossing) -> Point:
    """Return the middle of the route on a crossing."""
    return Point(scenario.route_line.at((crossing.enter_s_m + crossing.leave_s_m) / 2).xy)


def _invalid_barriers(scenario: Scenario, street_map: StreetMap) -> Iterator[str]:
    """Yield barriers that close missing ports, are misplaced, or block the robot."""
    route = LineString(scenario.route)
    robot = ROBOTS.get(scenario.robot)
    half_width_m = 0.0 if robot is None else robot.width_m / 2
    for number, barrier in enumerate(scenario.barriers):
        strip = street_map.strips.get(barrier.strip)
        fence = outline(barrier)
        if strip is None:
            yield f"barriers[{number}].strip '{barrier.strip}' is none of map '{street_map.name}'"
        elif (far_m := strip.polygon.distance(fence)) > BESIDE_STRIP_M:
            yield (
                f"barriers[{number}] stands {far_m:.0f} m from strip '{barrier.strip}', which it "
                f"should close"
            )
        elif fence.distance(route) < half_width_m:
            yield f"barriers[{number}] on strip '{barrier.strip}' stands across the route"


def _invalid_obstacles(scenario: Scenario, area: WalkableArea) -> Iterator[str]:
    """Yield obstacles that are off the walkable area, at the start of the robot, or on the goal."""
    start = Point(scenario.start[:2])
    goal = Point(scenario.goal)
    robot = ROBOTS.get(scenario.robot)
    reach_m = 0.0 if robot is None else float(np.hypot(*robot.footprint_m)) / 2
    for number, obstacle in enumerate(scenario.obstacles):
        ground = footprint(obstacle)
        at = f"obstacles[{number}] ({obstacle.kind})"
        if area.signed_distance([obstacle.x_m, obstacle.y_m])[0] < -_EDGE_M:
            yield f"{at} is off the walkable area at ({obstacle.x_m:.2f}, {obstacle.y_m:.2f})"
        elif ground.distance(start) < reach_m:
            yield f"{at} stands where the robot starts"
        elif ground.covers(goal):
            yield f"{at} stands on the goal"


def _invalid_events(scenarios: Iterable[Scenario]) -> Iterator[str]:
    """Yield events of unknown kinds, and those that contradict the row of their kind."""
    for scenario in scenarios:
        yield from (
            f"scenario '{scenario.id}': {fault}" for fault in event_faults(scenario, EVENT_KINDS)
        )


def _excessive_crowd(scenario: Scenario, street_map: StreetMap) -> Iterator[str]:
    """Yield crowds whose density means more people than the limit for numbers."""
    crowd = scenario.crowd
    if crowd.density is not None:
        room_m2 = LocalWalkableArea(street_map, crowd.radius_m).area_m2(*scenario.start[:2])
        if (persons := round(crowd.density * room_m2 / 1000.0)) > MAX_PERSONS:
            yield (
                f"crowd density {crowd.density:g} within {crowd.radius_m:g} m of the start "
                f"makes {persons} persons, "
                f"and at most {MAX_PERSONS} can be had: lower density or radius_m"
            )


def _missing_robots_and_skies(scenarios: Iterable[Scenario]) -> Iterator[str]:
    """Yield each unknown robot and each missing picture of a sky once."""
    robots, skies = ({getattr(s, name): s.id for s in scenarios} for name in ("robot", "light"))
    for robot, scenario_id in robots.items():
        try:
            robot_called(robot)
        except UsageError as error:
            yield f"scenario '{scenario_id}': {error}"
    for light, scenario_id in skies.items():
        try:
            if light.hdri:
                read_hdri(light.hdri)
        except SpecError as error:
            yield f"scenario '{scenario_id}': {error}"

"""Builder of reactive scenarios: 10 to 20 m of route with one event and no other people.

They end on the first failure.
"""

from __future__ import annotations

import math
import zlib
from typing import Literal, NamedTuple

import msgspec
import numpy as np
import shapely
from shapely.geometry import LineString

from cosim.core.errors import MapError, SpecError
from cosim.core.geometry import Floats, Polyline, Pose
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import Event, EventKind, SidewalkLayout
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import CrowdSpec, Place, RouteCrossing, Scenario
from scenarios.suites.drawing import bare_scenario, first_that_fits, people_of, wider_m
from scenarios.suites.long_horizon import route_crossings
from scenarios.suites.obstacles import with_obstacles

LIMIT_S = 60.0
NO_CROWD = CrowdSpec(persons=0, vehicles=0)
"""Crowd without vehicles and with no people but those of the event, as in the paper."""
BESIDE_CROSSING_M = (2.0, 5.0)
"""Least and largest length of route before and after a crosswalk, in metres."""
_ROOM_M = 0.35
"""Half the width of the walkable ground before and after a crosswalk, in metres."""
_SHORTEST_M = 10.0
ENDS_CLEAR_M = 6.0
"""Least distance of route and event from the ends of their sidewalk, in metres."""
BEND_M = 0.15
_SPEEDS_MPS = (1.1, 1.65)
"""Least and largest walking speed in the paper, in m/s."""


class EventSpot(NamedTuple):
    """Way with the place of the event on it.

    route: (N, 2) m.
    half_width_m, half_length_m: see `Event`.
    """

    route: Floats
    pose: Pose
    route_s_m: float
    half_width_m: float
    half_length_m: float = 0.0
    crossings: tuple[RouteCrossing, ...] = ()


def build_reactive(
    kind: EventKind,
    place: Place,
    street_map: StreetMap,
    graph: WalkGraph,
    seed: int,
    scenario_id: str,
    robot: Robot = COURIER,
) -> Scenario:
    """Draw a scenario of one kind of event from `seed`. Raises SpecError if no place is found."""
    rng = np.random.default_rng([seed, place.seed, 0x4EAC7, zlib.crc32(kind.name.encode())])
    strips = strips_of(kind, street_map, graph)
    if not strips:
        wanted = "crossing" if kind.layout is None else "sidewalk"
        raise MapError(f"map '{street_map.name}' has no {wanted} for '{kind.name}'")

    def draw() -> Scenario:
        at = event_spot(kind, strips[int(rng.integers(len(strips)))], street_map, rng, robot)
        bare = bare_scenario(
            Polyline(at.route),
            at.crossings,
            place,
            street_map,
            suite="reactive",
            seed=seed,
            scenario_id=scenario_id,
            time_limit_s=LIMIT_S,
            robot=robot,
        )
        event = _event_at(kind, at, rng, robot)
        of_kind = {"events": (event,), "structure": kind.name, "ends_at": kind.ends_at}
        whole = msgspec.structs.replace(bare, crowd=NO_CROWD, ends_on_failure=True, **of_kind)
        return with_obstacles(whole, street_map, beside=True)

    return first_that_fits(
        draw, f"no place for '{kind.name}' on '{street_map.name}' with seed {seed}"
    )


def strips_of(kind: EventKind, street_map: StreetMap, graph: WalkGraph) -> list[Strip]:
    """Return the strips on which a kind of event may fit, sorted by id. Nothing is drawn for this
    check.
    """
    wanted = "crossing" if kind.layout is None else "sidewalk"
    strips = [
        street_map.strips[strip_id] for strip_id in sorted(graph.main_strips - street_map.steep)
    ]
    return [strip for strip in strips if strip.kind == wanted and strip.going == "plain"]


def event_spot(
    kind: EventKind, strip: Strip, street_map: StreetMap, rng: np.random.Generator, robot: Robot
) -> EventSpot:
    """Draw a way along a strip and the place of an event on it. Raises SpecError if it does not
    fit.
    """
    if kind.layout is None:
        return over_crossing(street_map, strip, rng, robot)
    return along_sidewalk(kind.layout, strip, rng, robot)


def _event_at(kind: EventKind, at: EventSpot, rng: np.random.Generator, robot: Robot) -> Event:
    return Event(
        id="e0",
        kind=kind.name,
        x_m=at.pose.x_m,
        y_m=at.pose.y_m,
        heading_rad=at.pose.heading_rad,
        route_s_m=at.route_s_m,
        half_width_m=at.half_width_m,
        half_length_m=at.half_length_m,
        people=people_of(kind, at.half_width_m, robot, rng),
        speed_mps=float(rng.uniform(*_SPEEDS_MPS)),
        side=1 if rng.random() < 0.5 else -1,
    )


def along_sidewalk(
    layout: SidewalkLayout, strip: Strip, rng: np.random.Generator, robot: Robot
) -> EventSpot:
    half_m = strip.width_m / 2
    least_m = layout.half_width_m + wider_m(robot)
    if half_m < least_m:
        raise SpecError(f"the sidewalk is narrower than {2.0 * least_m:.2g} m")
    way_m, event_m = float(rng.uniform(*layout.way_m)), float(rng.uniform(*layout.event_m))
    reach_m = max(way_m, event_m)
    line = strip.line[:, :2] if rng.random() < 0.5 else strip.line[::-1, :2]
    middle = Polyline(line)
    room_m = middle.length_m - reach_m - 2 * ENDS_CLEAR_M
    if room_m < 0.0:
        raise SpecError("the sidewalk is too short")
    start_m = ENDS_CLEAR_M + float(rng.uniform(0.0, room_m))
    ends = middle.at(start_m).xy, middle.at(start_m + reach_m).xy
    chord = Polyline(np.stack(ends))
    between = middle.points[(middle.s_m > start_m) & (middle.s_m < start_m + reach_m)]
    if any(abs(chord.project(x, y)[1]) > BEND_M for x, y in between.tolist()):
        raise SpecError("the sidewalk is not straight")
    steps = np.append(np.arange(0.0, way_m - 0.5, 1.0), way_m)
    route = np.round([chord.at(float(s)).xy for s in steps], 3)
    return EventSpot(route, chord.at(min(event_m, chord.length_m)), event_m, half_m)


def over_crossing(
    street_map: StreetMap, strip: Strip, rng: np.random.Generator, robot: Robot
) -> EventSpot:
    leave: Literal[0, 1] = 1 if rng.random() < 0.5 else 0
    if not 5.0 <= strip.length_m <= 12.0 or None in strip.corners:
        raise SpecError("the crossing is too short or too long")
    if strip.signalised:
        raise SpecError("the crossing has signals: waiting there takes longer than the episode")
    ends = strip.line[[0, -1], :2] if leave else strip.line[[-1, 0], :2]
    route = Polyline(
        np.round(_straight_over(street_map, ends, _ROOM_M + 0.5 * wider_m(robot)), 3)
    ).resampled(0.99)
    route = Polyline(np.round(route.points, 3))
    crossings = route_crossings(
        street_map, route, [Port(strip.id, 0 if leave else 1), Port(strip.id, leave)]
    )
    enter_m, leave_m = crossings[0].enter_s_m, crossings[0].leave_s_m
    middle_m = 0.5 * (enter_m + leave_m)
    (along_x, along_y) = ends[1] - ends[0]
    pose = route.at(middle_m)._replace(heading_rad=math.atan2(along_y, along_x))
    return EventSpot(
        route.points, pose, middle_m, strip.width_m / 2, 0.5 * (leave_m - enter_m), crossings
    )


def _straight_over(street_map: StreetMap, ends: Floats, room_m: float) -> Floats:
    """Return a straight way over a crosswalk, from before its first end to beyond its second.

    It is (2, 2) in metres. It reaches as far as the ground is walkable straight on, with `room_m`
    on either side. Raises SpecError if it is too short.
    """
    along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    walkable = street_map.walkable_near(
        shapely.buffer(LineString(ends), BESIDE_CROSSING_M[1] + 1.0)
    )
    reached = []
    for end, outward in ((ends[0], -along), (ends[1], along)):
        for far_m in np.arange(BESIDE_CROSSING_M[1], BESIDE_CROSSING_M[0] - 1e-9, -0.25):
            beyond = shapely.buffer(LineString([end, end + far_m * outward]), room_m)
            if shapely.covers(walkable, beyond):
                reached.append(end + far_m * outward)
                break
        else:
            raise SpecError("there is no room straight on beside the crossing")
    if np.hypot(*(reached[1] - reached[0])) < _SHORTEST_M:
        raise SpecError("the way over the crossing is too short")
    return np.array(reached)

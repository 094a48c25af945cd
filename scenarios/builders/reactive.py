"""Builder of reactive scenarios: 10 to 20 m of way, one event on it, street life around; ends on the first failure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

import msgspec
import numpy as np
import shapely
from shapely.geometry import LineString

from cosim.core.errors import MapError, SpecError
from cosim.core.geometry import Floats, Polyline
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import GROUPS, Event, EventName
from cosim.spec.scenario import CrowdSpec, Place, RouteCrossing, Scenario
from scenarios.builders.drawing import events_along, first_that_fits
from scenarios.builders.long_horizon import route_crossings

_LIMIT_S = 60.0
CROWD = CrowdSpec(persons=12, radius_m=80.0, vehicles=8)
BESIDE_CROSSING_M = (2.0, 5.0)
"""Way driven before a crosswalk and after it, least and most."""
_ROOM_M = 0.35
"""Half the width of what is walkable there."""
_SHORTEST_M = 10.0
ENDS_CLEAR_M = 6.0
"""Way and event keep this far from the ends of their sidewalk."""
BEND_M = 0.15
_SPEEDS_MPS = (1.1, 1.65)
"""Walking speeds of the paper."""
OPEN_M = 1.25
"""Width that a queue leaves beside it."""
GROUP_M = 1.95
"""Half the width of a sidewalk on which one can pass round a group of talkers in its middle."""


class _Layout(NamedTuple):
    """Where things are along a way. way_m: its length, shortest and longest; event_m: from the start to the event's
    place, nearest and farthest; half_width_m: least half of the sidewalk's width."""

    way_m: tuple[float, float]
    event_m: tuple[float, float]
    half_width_m: float = 1.3


LAYOUTS: Mapping[EventName, _Layout] = MappingProxyType(
    {
        "obstructing": _Layout((18.0, 20.0), (11.0, 13.0)),
        "conversing": _Layout((18.0, 20.0), (11.5, 13.0), GROUP_M),
        "queueing": _Layout((18.0, 20.0), (11.0, 13.0), 1.4),
        "gesturing": _Layout((18.0, 20.0), (11.0, 13.0)),
        "frontal": _Layout((18.0, 20.0), (21.0, 22.0)),
        "lateral": _Layout((15.0, 20.0), (8.0, 11.0)),
        "overtaking": _Layout((18.0, 20.0), (1.5, 3.0), 1.4),
        "ped_crossing": _Layout((10.0, 20.0), (0.0, 0.0)),
    }
)
"""An event lies farther from the start than its trigger reaches, so that it triggers on the way."""


def build_reactive(
    kind: EventName, place: Place, street_map: StreetMap, graph: WalkGraph, seed: int, scenario_id: str
) -> Scenario:
    """A scenario of one kind of event drawn from `seed`. Raises SpecError when no place for it is found."""
    rng = np.random.default_rng([seed, place.seed, 0x4EAC7, sorted(GROUPS).index(kind)])
    wanted = "crossing" if kind == "ped_crossing" else "sidewalk"
    even = sorted(graph.main_strips - street_map.steep)
    strips = [street_map.strips[s] for s in even if street_map.strips[s].kind == wanted]
    if not strips:
        raise MapError(f"map '{street_map.name}' has no {wanted} for '{kind}'")

    def draw() -> Scenario:
        strip = strips[int(rng.integers(len(strips)))]
        if kind == "ped_crossing":
            return _over_crossing(place, street_map, strip, rng, seed, scenario_id)
        return _along_sidewalk(kind, place, street_map, strip, rng, seed, scenario_id)

    return first_that_fits(draw, f"no place for '{kind}' on '{street_map.name}' with seed {seed}")


def _along_sidewalk(
    kind: EventName,
    place: Place,
    street_map: StreetMap,
    strip: Strip,
    rng: np.random.Generator,
    seed: int,
    scenario_id: str,
) -> Scenario:
    layout = LAYOUTS[kind]
    half_m = strip.width_m / 2
    if half_m < layout.half_width_m:
        raise SpecError("sidewalk too narrow")
    way_m, event_m = float(rng.uniform(*layout.way_m)), float(rng.uniform(*layout.event_m))
    reach_m = max(way_m, event_m)
    line = strip.line[:, :2] if rng.random() < 0.5 else strip.line[::-1, :2]
    middle = Polyline(line)
    room_m = middle.length_m - reach_m - 2 * ENDS_CLEAR_M
    if room_m < 0.0:
        raise SpecError("sidewalk too short")
    start_m = ENDS_CLEAR_M + float(rng.uniform(0.0, room_m))
    ends = middle.at(start_m).xy, middle.at(start_m + reach_m).xy
    chord = Polyline(np.stack(ends))
    between = middle.points[(middle.s_m > start_m) & (middle.s_m < start_m + reach_m)]
    if any(abs(chord.project(x, y)[1]) > BEND_M for x, y in between.tolist()):
        raise SpecError("sidewalk not straight")
    steps = np.append(np.arange(0.0, way_m - 0.5, 1.0), way_m)
    route = np.round([chord.at(float(s)).xy for s in steps], 3)
    pose = chord.at(min(event_m, chord.length_m))
    side: Literal[-1, 1] = 1 if rng.random() < 0.5 else -1
    event = Event(
        id="e0",
        kind=kind,
        x_m=pose.x_m,
        y_m=pose.y_m,
        heading_rad=pose.heading_rad,
        route_s_m=event_m,
        half_width_m=half_m,
        people=_group(kind, half_m, rng),
        speed_mps=float(rng.uniform(*_SPEEDS_MPS)),
        side=side,
    )
    return _scenario(place, street_map, route, event, (), seed, scenario_id)


def _group(kind: EventName, half_m: float, rng: np.random.Generator) -> int:
    """How many people: talkers as drawn; a queue as long as leaves OPEN_M beside it, past the middle."""
    fewest, most = GROUPS[kind]
    if kind == "queueing":
        return max(fewest, min(most, int((2 * half_m - OPEN_M - 0.6) / 0.65) + 1))
    return int(rng.integers(fewest, most + 1))


def _over_crossing(
    place: Place, street_map: StreetMap, strip: Strip, rng: np.random.Generator, seed: int, scenario_id: str
) -> Scenario:
    leave: Literal[0, 1] = 1 if rng.random() < 0.5 else 0
    if not 5.0 <= strip.length_m <= 12.0 or None in strip.corners:
        raise SpecError("crossing too short or too long")
    if strip.signalised:
        raise SpecError("crossing signalised: waiting there takes longer than the episode")
    ends = strip.line[[0, -1], :2] if leave else strip.line[[-1, 0], :2]
    route = Polyline(np.round(_straight_over(street_map, ends), 3)).resampled(0.99)
    route = Polyline(np.round(route.points, 3))
    crossings = route_crossings(street_map, route, [Port(strip.id, 0 if leave else 1), Port(strip.id, leave)])
    middle_m = 0.5 * (crossings[0].enter_s_m + crossings[0].leave_s_m)
    pose = route.at(middle_m)
    events_along = ends[1] - ends[0]
    event = Event(
        id="e0",
        kind="ped_crossing",
        x_m=pose.x_m,
        y_m=pose.y_m,
        heading_rad=math.atan2(events_along[1], events_along[0]),
        route_s_m=middle_m,
        half_width_m=strip.width_m / 2,
        half_length_m=0.5 * (crossings[0].leave_s_m - crossings[0].enter_s_m),
        people=int(rng.integers(2, GROUPS["ped_crossing"][1] + 1)),
        speed_mps=float(rng.uniform(*_SPEEDS_MPS)),
        side=1 if rng.random() < 0.5 else -1,
    )
    return _scenario(place, street_map, route.points, event, crossings, seed, scenario_id)


def _straight_over(street_map: StreetMap, ends: Floats) -> Floats:
    """(2, 2) m: a way straight over a crosswalk, from before its first end to beyond its second, as far as one can walk
    straight on there: who only drives straight ahead stays on it. Raises SpecError when that is too short."""
    events_along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    walkable = street_map.walkable_near(shapely.buffer(LineString(ends), BESIDE_CROSSING_M[1] + 1.0))
    reached = []
    for end, outward in ((ends[0], -events_along), (ends[1], events_along)):
        for far_m in np.arange(BESIDE_CROSSING_M[1], BESIDE_CROSSING_M[0] - 1e-9, -0.25):
            beyond = shapely.buffer(LineString([end, end + far_m * outward]), _ROOM_M)
            if shapely.covers(walkable, beyond):
                reached.append(end + far_m * outward)
                break
        else:
            raise SpecError("no room straight on beside the crossing")
    if np.hypot(*(reached[1] - reached[0])) < _SHORTEST_M:
        raise SpecError("way over the crossing too short")
    return np.array(reached)


def _scenario(
    place: Place,
    street_map: StreetMap,
    route: Floats,
    event: Event,
    crossings: tuple[RouteCrossing, ...],
    seed: int,
    scenario_id: str,
) -> Scenario:
    bare = events_along(
        Polyline(route),
        crossings,
        place,
        street_map,
        suite="reactive",
        seed=seed,
        scenario_id=scenario_id,
        time_limit_s=_LIMIT_S,
    )
    return msgspec.structs.replace(
        bare,
        events=(event,),
        crowd=CROWD,
        ends_on_failure=True,
        ends_at="stop" if event.kind == "gesturing" else "goal",
    )

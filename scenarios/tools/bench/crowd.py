"""Measures how people and vehicles behave around a robot that drives its routes: `cosim bench
crowd`.

In each city the `route` policy drives long-horizon routes, one after another, among the crowd and
the event pedestrians. A robot that follows commands at once replaces the physics, so that hours
can be simulated. Counts are of the people and vehicles of a `Street`, after every filter.
"""

from __future__ import annotations

import math
import multiprocessing
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, cast

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely.geometry import LineString, Polygon

from cosim.core.clock import Clock
from cosim.core.geometry import Floats, Pose, boxes_overlap, wrap_angle
from cosim.core.progress import Progress
from cosim.core.state import (
    DIRECTED,
    PERSON_RADIUS_M,
    Command,
    Motion,
    People,
    PersonKind,
    RobotState,
    Street,
    Vehicles,
    write_protected_copy,
)
from cosim.episode.interfaces import Crowd
from cosim.episode.loop import Step
from cosim.place.street_map import StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.policies.privileged.route import Route
from cosim.results.referee import Verdict
from cosim.spec.scenario import City, CrowdSpec, Scenario
from physics.ground.tiles import tile_at
from physics.street.furniture import footprints
from physics.street.street_surface import StreetSurface
from scenarios.episodes.episode import Episode
from scenarios.episodes.wiring import StagedScenario
from scenarios.places.nets import place
from scenarios.suites.long_horizon import build_long_horizon
from scenarios.tools.bench.figures import PartTimes, TimedEngine
from sumo_nets.crowd.crowd import SumoCrowd
from sumo_nets.crowd.stoplines import StopLineCrossing, StopLines

THINGS_M = 60.0
"""Distance from the route within which buildings and props are examined, in metres."""
CITY_M = 2000.0
GROUPS_EVERY_TICKS = 10
CONTACT_M: Final = 1.5
"""Two people whose centres are nearer than this are in contact range."""
OVERLAP_M: Final = 0.3
"""Two people whose centres are nearer than this overlap."""
ENTERING_S: Final = 3.0
"""Time after a person appears that counts as entering, in seconds."""
_NARROW_M: Final = 2.5
"""A sidewalk narrower than this counts as narrow."""
EVERY_TICKS: Final = 5
"""Ticks between checks of things, crossings and vehicles; people are checked at every tick."""
INTO_M: Final = 1.0
"""Metres beyond the end of a crossing's line from which a person has entered it."""
GRACE_S: Final = 1.0
"""A slow walker who steps off at the end of green has INTO_M behind it this long after."""
ROLLING_MPS: Final = 0.5
NEAR_BOX_M: Final = 1.0
APART_M: Final = 2.0
"""A group with a member farther than this from all others is apart, in metres."""


class CityCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Observations of one city.

    counts: see `StreetCounter`.
    crossings: signalised crossings that a pedestrian entered.
    crowd_ms: mean CPU milliseconds of a step of the crowd.
    group_gaps_m: for each group, every half second, the largest distance of a member to its
        nearest other.
    """

    place: str
    minutes: float
    persons: float
    counts: dict[str, float]
    crossings: int
    crowd_ms: float
    group_gaps_m: tuple[float, ...] = ()


class InstantRobot:
    """A robot without physics: it follows commands at once."""

    def __init__(self, footprint_m: tuple[float, float]) -> None:
        self.footprint_m = footprint_m
        self._robot = RobotState(Pose(0.0, 0.0, 0.0))

    def place(self, pose: Pose) -> RobotState:
        self._robot = RobotState(pose)
        return self._robot

    def step(self, command: Command, before: Street, after: Street, substeps: int) -> Motion:
        """Drive an arc for one tick."""
        x_m, y_m, heading = self._robot.pose
        dt_s = Clock().tick_s
        middle = heading + 0.5 * command.w_radps * dt_s
        way_m = command.v_mps * dt_s
        pose = Pose(
            x_m + way_m * math.cos(middle),
            y_m + way_m * math.sin(middle),
            wrap_angle(heading + command.w_radps * dt_s),
        )
        self._robot = RobotState(pose, command.v_mps, command.w_radps)
        return Motion(self._robot, write_protected_copy([pose] * substeps))


def measure_crowd(city: City, minutes: float, crowd: CrowdSpec) -> CityCounts:
    """Count the crowd's behaviour in a city for a number of simulated minutes."""
    _, street_map = place(city)
    graph = WalkGraph(street_map)
    clock = Clock.for_rate(Route.manifest.rate_hz)
    counts: list[Mapping[str, float]] = []
    crossings: set[str] = set()
    gaps_m: list[float] = []
    ticks = 0
    persons = 0
    crowd_s = 0.0
    seed = 0
    wanted = clock.ticks(60.0 * minutes)
    while ticks < wanted:
        scenario = msgspec.structs.replace(
            build_long_horizon(city, street_map, graph, seed, f"crowd-{seed}"), crowd=crowd
        )
        seed += 1
        counter, done, shown, spent_s = _drive(scenario, street_map, wanted - ticks, gaps_m)
        counts.append(counter.counts)
        crossings |= counter.crossings
        ticks, persons, crowd_s = ticks + done, persons + shown, crowd_s + spent_s
    return CityCounts(
        place=city.name,
        minutes=clock.time_s(ticks) / 60.0,
        persons=persons / ticks,
        counts=summed(counts),
        crossings=len(crossings),
        crowd_ms=1000.0 * crowd_s / ticks,
        group_gaps_m=tuple(gaps_m),
    )


def _drive(
    scenario: Scenario, street_map: StreetMap, limit_ticks: int, gaps_m: list[float]
) -> tuple[StreetCounter, int, int, float]:
    """Drive one route. Returns counter, ticks, sum of persons shown, and the crowd's CPU seconds.

    gaps_m: list to which the gaps within groups are appended
    """
    clock = Clock.for_rate(Route.manifest.rate_hz)
    policy = Route()
    counter = StreetCounter(street_map, clock.tick_s, things_along(scenario, street_map))
    lines = StopLines(clock.tick_s)
    crowd: SumoCrowd
    spent = PartTimes(time.process_time)  # what else runs on the machine does not count
    persons = 0

    def replace_engines(stage: StagedScenario) -> None:
        nonlocal crowd
        crowd = cast(SumoCrowd, stage.engines.crowd)
        timed = cast(Crowd, TimedEngine(crowd, "step", "crowd", spent))
        stage.engines = replace(
            stage.engines, world=InstantRobot(stage.engines.world.footprint_m), crowd=timed
        )

    def watch(step: Step, _: Verdict) -> None:
        nonlocal persons
        street = step.street_after
        persons += int(street.people.are(PersonKind.CROWD).sum())
        counter.update(street)
        counter.count_vehicles(lines.passed(street.vehicles.ids))
        if (step.tick + 1) % GROUPS_EVERY_TICKS == 0:
            gaps_m.extend(widest_gaps(crowd.groups, street.people))

    with Episode(scenario, policy.manifest, watches=[watch], through=replace_engines) as episode:
        policy.reset(episode.id, episode.seed)
        observation = episode.reset()
        while not episode.over and episode.moment.tick < limit_ticks:
            observation = episode.advance(policy.act(observation), until_tick=limit_ticks)
        return counter, episode.moment.tick, persons, spent["crowd"]


def things_along(scenario: Scenario, street_map: StreetMap) -> list[tuple[str, Polygon]]:
    """Return kinds and outlines of props and buildings around a route."""
    around = shapely.buffer(LineString(scenario.route), THINGS_M)
    ground = StreetSurface(street_map, scenario.place.seed)
    props = ground.standing(around)
    things = [(prop.kind, polygon) for prop, polygon in zip(props, footprints(props), strict=True)]
    x0, y0, x1, y1 = around.bounds
    (i0, j0) = tile_at(x0, y0)
    (i1, j1) = tile_at(x1, y1)
    keys = [(i, j) for i in range(i0, i1 + 1) for j in range(j0, j1 + 1)]
    return things + [
        ("building", building.polygon) for key in keys for building in ground.buildings(key)
    ]


def measure_crowds(
    cities: int, minutes: float, crowd: CrowdSpec, progress: Progress
) -> list[CityCounts]:
    """Count the crowd's behaviour in several cities, one process each, one after another."""
    found = []
    for seed in range(cities):
        progress(f"simulating the crowd: city {seed + 1} of {cities}")
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            arguments: tuple[Any, ...] = (City(seed=100 + seed, size_m=CITY_M), minutes, crowd)
            found.append(pool.apply(measure_crowd, arguments))
    return found


def summed(counts: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Add the counts of several places."""
    total: defaultdict[str, float] = defaultdict(float)
    for one in counts:
        for name, count in one.items():
            total[name] += count
    return dict(total)


class StreetCounter:
    """Counter of people's and vehicles' behaviour in one place.

    counts: seconds of pairs, seconds of persons and numbers of entries, by name
    crossings: ids of the signalised crossings that were entered
    at_red: entries at red, with name, place and time, in words
    things: obstacles, as (kind, ground)
    A light that comes into view red counts as red since then. People on its crossing at that
    moment do not count as entering.
    """

    def __init__(
        self,
        street_map: StreetMap,
        tick_s: float,
        things: Sequence[tuple[str, shapely.Geometry]] = (),
    ) -> None:
        self.counts: defaultdict[str, float] = defaultdict(float)
        self.crossings: set[str] = set()
        self.at_red: list[str] = []
        self._map = street_map
        self._tick_s = tick_s
        self._kinds = [kind for kind, _ in things]
        self._things = shapely.STRtree([ground for _, ground in things])
        self._tick = -1
        self._since: dict[str, int] = {}
        self._red_s: dict[str, float] = {}
        self._new: set[str] = set()
        self._on: set[str] = set()
        self._over: set[tuple[str, str]] = set()
        self._boxes: dict[str, tuple[Floats, Floats]] = {}

    def update(self, street: Street) -> None:
        """Count people in the street of the next tick."""
        people = street.people
        self._since = {name: self._since.get(name, street.tick) for name in people.ids}
        self._pairs(street.tick, people)
        self._new = street.signals.keys() - self._red_s.keys()
        self._red_s = {
            crossing: 0.0 if signal.walk else self._red_s.get(crossing, 0.0) + self._tick_s
            for crossing, signal in street.signals.items()
        }
        if street.tick % EVERY_TICKS == 0 and len(people):
            self._penetrations(people, street.vehicles)
        self._signals(street)
        self._tick = street.tick

    def count_vehicles(self, passed: Iterable[StopLineCrossing]) -> None:
        """Count vehicles that drove over stop lines in the last tick."""
        for one in passed:
            self.counts["vehicles passed stop lines"] += 1
            if one.light in "Gg":
                self.counts["vehicles passed at green"] += 1
            elif one.light in "yY":
                self.counts["vehicles passed at yellow"] += 1
            elif one.light == "r" and one.red_s > GRACE_S:
                self.counts["vehicles passed at red"] += 1
                self.at_red.append(f"{one.vehicle} at tick {self._tick}, red for {one.red_s:.2f} s")
            elif one.light == "r":
                self.counts["vehicles passed within a second of red"] += 1

    def _pairs(self, tick: int, people: People) -> None:
        if len(people) < 2:
            return
        pairs = cKDTree(people.xy).query_pairs(CONTACT_M, output_type="ndarray")
        gap = np.hypot(*(people.xy[pairs[:, 0]] - people.xy[pairs[:, 1]]).T)
        event = people.are(*DIRECTED)
        own = ~(event[pairs].all(axis=1)) if len(pairs) else np.zeros(0, dtype=bool)
        self.counts["pairs in contact range"] += float(own.sum()) * self._tick_s
        self.counts["pairs nearer than 0.6 m"] += (
            float((own & (gap < 2 * PERSON_RADIUS_M)).sum()) * self._tick_s
        )
        self.counts["pairs nearer than 0.45 m"] += float((own & (gap < 0.45)).sum()) * self._tick_s
        self.counts["event pairs nearer than 0.3 m"] += (
            float((~own & (gap < OVERLAP_M)).sum()) * self._tick_s
        )
        for i, j in pairs[own & (gap < OVERLAP_M)].tolist():
            self.counts["overlaps"] += self._tick_s
            self.counts[f"overlaps: {self._where(tick, people, i, j)}"] += self._tick_s

    def _where(self, tick: int, people: People, i: int, j: int) -> str:
        pair = people.kind[[i, j]]
        if np.isin(pair, DIRECTED).any():
            return "with an event pedestrian"
        if PersonKind.RESIDENT in pair:
            return "with a resident"
        if (
            tick - max(self._since[people.ids[i]], self._since[people.ids[j]])
        ) * self._tick_s < ENTERING_S:
            return "entering"
        x_m, y_m = (0.5 * (people.xy[i] + people.xy[j])).tolist()
        edge = self._map.locate(x_m, y_m).edge
        if edge in self._map.corners:
            return "on corners"
        strip = self._map.strips.get(edge)
        if strip is None:
            return "off the sidewalks"
        if strip.kind == "crossing":
            return "on crossings"
        return "on narrow sidewalks" if strip.width_m < _NARROW_M else "on sidewalks"

    def _penetrations(self, people: People, vehicles: Vehicles) -> None:
        seconds = self._tick_s * EVERY_TICKS
        self.counts["persons"] += len(people) * seconds
        points = np.atleast_1d(np.asarray(shapely.points(people.xy), dtype=object))
        off = [self._map.locate(x_m, y_m, 0.0).kind for x_m, y_m in people.xy.tolist()]
        self.counts["off the walkable area"] += (len(off) - off.count("walk")) * seconds
        who, what = self._things.query(points, predicate="within")
        for i, thing in zip(who.tolist(), what.tolist(), strict=True):
            self.counts[f"in a {self._kinds[thing]}"] += seconds
            place = self._map.strips.get(self._map.locate(*people.xy[i]).edge)
            if place is not None and place.kind == "sidewalk" and self._in_middle(place, points[i]):
                self.counts["in a thing in the clear band"] += seconds
        who, _ = self._things.query(points, predicate="dwithin", distance=0.15)
        self.counts["within 0.15 m of a thing"] += len(set(who.tolist())) * seconds
        if len(vehicles):
            gap = box_gaps(vehicles, people.xy)
            self.counts["in a vehicle"] += float((gap <= 0.0).any(axis=0).sum()) * seconds
            crowd = people.are(PersonKind.CROWD)
            moving = (gap <= 0.0) & (vehicles.speed[:, None] > ROLLING_MPS)
            self.counts["in a vehicle that moves"] += (
                float((moving.any(axis=0) & crowd).sum()) * seconds
            )

    @staticmethod
    def _in_middle(strip: Strip, point: shapely.Point) -> bool:
        return bool(shapely.distance(shapely.linestrings(strip.line[:, :2]), point) < 0.6)

    def _signals(self, street: Street) -> None:
        """Count entries of people, and each EVERY_TICKS the vehicles on crossings at walk."""
        people, vehicles = street.people, street.vehicles
        crowd = people.are(PersonKind.CROWD)
        now: set[str] = set()
        over: set[tuple[str, str]] = set()
        looks = street.tick % EVERY_TICKS == 0
        for crossing, signal in street.signals.items():
            middle, half = self._box(crossing)
            inside = crowd & (point_gaps(middle, half - (INTO_M, 0.0), people.xy) <= 0.0)
            for i in np.flatnonzero(inside).tolist():
                name = people.ids[i]
                # Crossings of one junction may overlap: a person on one does not enter another.
                begins = (
                    name not in now and name not in self._on and street.tick > self._since[name]
                )
                if begins and crossing not in self._new:
                    self._entered(name, crossing, self._red_s[crossing], street.tick)
                now.add(name)
            if looks and signal.walk and len(vehicles):
                boxes = np.column_stack([vehicles.xy, vehicles.heading])
                hit = boxes_overlap(middle, half, boxes, vehicles.size / 2) & (
                    vehicles.speed > ROLLING_MPS
                )
                over |= {(crossing, vehicles.ids[k]) for k in np.flatnonzero(hit).tolist()}
                self._driven(crossing, hit, inside, street)
        self._on = now
        if looks:
            self._over = over

    def _entered(self, person: str, crossing: str, red_s: float, tick: int) -> None:
        self.crossings.add(crossing)
        self.counts["persons entered signalised crossings"] += 1
        if red_s > GRACE_S:
            self.counts["persons entered at red"] += 1
            self.at_red.append(f"{person} on {crossing} at tick {tick}, red for {red_s:.2f} s")
        elif red_s > 0.0:
            self.counts["persons entered within a second of red"] += 1

    def _driven(
        self, crossing: str, hit: NDArray[np.bool_], walking: NDArray[np.bool_], street: Street
    ) -> None:
        vehicles = street.vehicles
        for k in np.flatnonzero(hit).tolist():
            if (crossing, vehicles.ids[k]) not in self._over:
                self.counts["vehicles drove over a crossing at walk"] += 1
            on = street.people.xy[walking]
            if len(on) and box_gaps(vehicles, on)[k].min() < NEAR_BOX_M:
                self.counts["vehicles within 1 m of a walker on it"] += self._tick_s * EVERY_TICKS

    def _box(self, crossing: str) -> tuple[Floats, Floats]:
        """Return a crossing's box: (3,) x, y, heading of its middle; (2,) half length and width."""
        if crossing not in self._boxes:
            strip = self._map.strips[crossing]
            first = strip.line[0, :2]
            last = strip.line[-1, :2]
            along = last - first
            middle = np.array([*(0.5 * (first + last)), np.arctan2(along[1], along[0])])
            self._boxes[crossing] = middle, np.array([0.5 * np.hypot(*along), 0.5 * strip.width_m])
        return self._boxes[crossing]


def point_gaps(middle: Floats, half: Floats, xy: Floats) -> Floats:
    """Return (N,) distances of points from a box; 0 inside, and inf from a box without room."""
    if (half <= 0.0).any():
        return np.full(len(xy), np.inf)
    dx, dy = (xy - middle[:2]).T
    cos, sin = np.cos(middle[2]), np.sin(middle[2])
    ahead = np.abs(cos * dx + sin * dy) - half[0]
    aside = np.abs(cos * dy - sin * dx) - half[1]
    return np.asarray(np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0)))


def box_gaps(vehicles: Vehicles, xy: Floats) -> Floats:
    """Return (V, N) distances of points from the boxes of vehicles; 0 inside."""
    offset = xy[None] - vehicles.xy[:, None]
    cos, sin = np.cos(vehicles.heading)[:, None], np.sin(vehicles.heading)[:, None]
    ahead = np.abs(cos * offset[..., 0] + sin * offset[..., 1]) - 0.5 * vehicles.size[:, :1]
    aside = np.abs(cos * offset[..., 1] - sin * offset[..., 0]) - 0.5 * vehicles.size[:, 1:]
    return np.asarray(np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0)))


def widest_gaps(groups: Iterable[Sequence[str]], people: People) -> list[float]:
    """Return the largest distance of a member to its nearest other, metres, for each group.

    Groups with fewer than two shown members are left out.
    """
    row = {name: i for i, name in enumerate(people.ids)}
    gaps = []
    for names in groups:
        xy = people.xy[[row[name] for name in names if name in row]]
        if len(xy) > 1:
            apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
            np.fill_diagonal(apart, np.inf)
            gaps.append(float(apart.min(axis=1).max()))
    return gaps

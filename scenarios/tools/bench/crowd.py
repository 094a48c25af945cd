"""What `cosim bench crowd` measures: how people and vehicles behave around a robot that drives its
routes.

In each city the `route` policy drives long-horizon routes, one after another, among the crowd and
the event pedestrians; a body that does at once what it is told stands in for the physics, so that
hours can be looked at.
"""

from __future__ import annotations

import math
import multiprocessing
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, cast

import msgspec
import shapely
from shapely.geometry import LineString, Polygon

from cosim.core.clock import Clock
from cosim.core.geometry import Pose, wrap_angle
from cosim.core.progress import Progress
from cosim.core.state import Command, Motion, PersonKind, RobotState, Street, write_protected
from cosim.episode.step import Step
from cosim.place.street_map import StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.policies.privileged.route import Route
from cosim.results.referee import Verdict
from cosim.spec.events import EventReply
from cosim.spec.scenario import City, CrowdSpec, Scenario
from physics.ground.tiles import key_at
from physics.street.furniture import footprints
from physics.street.street_surface import StreetSurface
from scenarios.episodes.episode import Episode
from scenarios.episodes.wiring import StagedScenario
from scenarios.places.nets import place
from scenarios.suites.long_horizon import build_long_horizon
from scenarios.tools.bench.crowd_tally import Tally
from scenarios.tools.bench.group_tally import widest_gaps
from sumo_nets.crowd.crowd import SumoCrowd
from sumo_nets.crowd.stoplines import StopLines

THINGS_M = 60.0
"""Buildings and props are looked at this far around the route."""

CITY_M = 2000.0
GROUPS_EVERY_TICKS = 10


class Watched(msgspec.Struct, frozen=True, kw_only=True):
    """What was seen in one city. counts: see `Tally`. crossings: signalised ones that somebody
    entered.

    crowd_ms: CPU milliseconds of a step of the crowd, on the mean. group_gaps_m: every half second,
    of each group, how far its loneliest member is from its nearest fellow.
    """

    place: str
    minutes: float
    persons: float
    counts: dict[str, float]
    crossings: int
    crowd_ms: float
    group_gaps_m: tuple[float, ...] = ()


class Glider:
    """A robot without physics: it moves as it is told, at once."""

    def __init__(self, footprint_m: tuple[float, float]) -> None:
        self.footprint_m = footprint_m
        self._robot = RobotState(Pose(0.0, 0.0, 0.0))

    def place(self, pose: Pose) -> RobotState:
        self._robot = RobotState(pose)
        return self._robot

    def step(self, command: Command, before: Street, after: Street, substeps: int) -> Motion:
        """One tick of driving an arc."""
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
        return Motion(self._robot, write_protected([pose] * substeps))


def watch(city: City, minutes: float, crowd: CrowdSpec) -> Watched:
    """Watch the crowd of a city for so many simulated minutes."""
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
        tally, done, shown, spent_s = _drive(scenario, street_map, wanted - ticks, gaps_m)
        counts.append(tally.counts)
        crossings |= tally.crossings
        ticks, persons, crowd_s = ticks + done, persons + shown, crowd_s + spent_s
    return Watched(
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
) -> tuple[Tally, int, int, float]:
    """Drive one route. Returns what was counted, the ticks, the sum of persons shown, the crowd's
    CPU seconds.

    gaps_m: takes up the gaps within groups.
    """
    clock = Clock.for_rate(Route.manifest.rate_hz)
    policy = Route()
    tally = Tally(street_map, clock.tick_s, things_along(scenario, street_map))
    lines = StopLines(clock.tick_s)
    crowd: SumoCrowd
    timed: Stopwatch
    persons = 0

    def gliding(stage: StagedScenario) -> None:
        nonlocal crowd, timed
        crowd = cast(SumoCrowd, stage.parts.crowd)
        timed = Stopwatch(crowd)
        stage.parts = replace(stage.parts, world=Glider(stage.parts.world.footprint_m), crowd=timed)

    def watch(step: Step, _: Verdict) -> None:
        nonlocal persons
        street = step.street_after
        persons += int(street.people.are(PersonKind.CROWD).sum())
        tally.see(street)
        tally.drove(lines.passed(street.vehicles.ids))
        if (step.tick + 1) % GROUPS_EVERY_TICKS == 0:
            gaps_m.extend(widest_gaps(crowd.groups, street.people))

    with Episode(scenario, policy.manifest, watches=[watch], through=gliding) as episode:
        policy.reset(episode.id, episode.seed)
        observation = episode.reset()
        while not episode.over and episode.moment.tick < limit_ticks:
            observation = episode.advance(policy.act(observation), until_tick=limit_ticks)
        return tally, episode.moment.tick, persons, timed.spent_s


def things_along(scenario: Scenario, street_map: StreetMap) -> list[tuple[str, Polygon]]:
    """What stands around a route: kinds and outlines of props and buildings."""
    around = shapely.buffer(LineString(scenario.route), THINGS_M)
    ground = StreetSurface(street_map, scenario.place.seed)
    props = ground.standing(around)
    things = [(prop.kind, polygon) for prop, polygon in zip(props, footprints(props), strict=True)]
    x0, y0, x1, y1 = around.bounds
    (i0, j0) = key_at(x0, y0)
    (i1, j1) = key_at(x1, y1)
    keys = [(i, j) for i in range(i0, i1 + 1) for j in range(j0, j1 + 1)]
    return things + [
        ("building", building.polygon) for key in keys for building in ground.buildings(key)
    ]


class Stopwatch:
    """A crowd whose steps are timed, in seconds of CPU: what else runs on the machine does not
    count."""

    def __init__(self, crowd: SumoCrowd) -> None:
        self._crowd = crowd
        self.spent_s = 0.0

    @property
    def street(self) -> Street:
        return self._crowd.street

    def step(self, robot: RobotState, reply: EventReply) -> Street:
        began = time.process_time()
        street = self._crowd.step(robot, reply)
        self.spent_s += time.process_time() - began
        return street


def watch_all(cities: int, minutes: float, crowd: CrowdSpec, progress: Progress) -> list[Watched]:
    """Watch the crowd in several cities, a process for each, one after another."""
    found = []
    for seed in range(cities):
        progress(f"watching the crowd: city {seed + 1} of {cities}")
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            arguments: tuple[Any, ...] = (City(seed=100 + seed, size_m=CITY_M), minutes, crowd)
            found.append(pool.apply(watch, arguments))
    return found


def summed(counts: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Counts of several places together."""
    total: defaultdict[str, float] = defaultdict(float)
    for one in counts:
        for name, count in one.items():
            total[name] += count
    return dict(total)

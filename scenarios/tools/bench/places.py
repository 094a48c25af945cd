"""Surveys generated cities, and tests whether SUMO endures bodies that go anywhere on a map.

In the test of a map the bodies walk from sidewalk to sidewalk, drive along lanes, cut straight
across everything, wait at the ends of sidewalks and jump, as resets do. Each map has a process of
its own, because a crash of SUMO ends it.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import resource
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from typing import NamedTuple

import msgspec
import numpy as np

from cosim.core.child_process import exit_in_words, exit_with_parent
from cosim.core.clock import Clock
from cosim.core.errors import CosimError, EngineError
from cosim.core.geometry import Floats, Polyline, Pose
from cosim.core.progress import Progress, ignore
from cosim.core.state import PersonKind, RobotState
from cosim.place.street_map import StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import Actor, EventReply
from cosim.spec.scenario import City, Place, Scenario
from physics.street.clearance import clear_widths, props_on_driveways
from physics.street.furniture import footprints
from physics.street.placement import props_of
from sumo_nets.city.census import MIN_CLEAR_M, Census, census
from sumo_nets.city.store import city_net
from sumo_nets.net.snapshot import street_map_of

BODIES = 3
"""The robot and two event pedestrians."""
_STEP_M = 0.075
"""Distance that a body moves in a tick, in metres: 1.5 m/s."""
MOVES = {"walk": 0.2, "lane": 0.2, "across": 0.3, "stand": 0.15, "jump": 0.15}
"""Probabilities of a body's next move."""
_WALK_EDGES = 6
ACROSS_M = (10.0, 60.0)
STAND_TICKS = 160
NEARBY_M = 100.0
REPORT_TICKS = 200
HANG_S = 120.0


class Survey(NamedTuple):
    """A city with its furniture.

    side_m: the least free width on any sidewalk, around its middle.
    props: number of props.
    faults: violations of what a city promises.
    memory_mib: the largest memory of its process so far.
    """

    seed: int
    census: Census
    side_m: float
    props: int
    faults: tuple[str, ...]
    memory_mib: float


def survey(city: City) -> Survey:
    """Count and measure a city on its final geometry."""
    net = city_net(city)
    place = street_map_of(net)
    props = props_of(place, city.seed)
    found = census(net, place, list(footprints(props)))
    sidewalks = [strip for strip in place.strips.values() if strip.kind == "sidewalk"]
    widths = clear_widths(sidewalks, props)
    tightest = min(widths, key=lambda strip: widths[strip][0])
    faults = list(found.faults)
    if (side_m := widths[tightest][0]) < MIN_CLEAR_M:
        faults.append(f"sidewalk {tightest} is only {side_m:.2f} m wide next to its objects")
    if blocked := props_on_driveways(sidewalks, props):
        faults.append(f"{len(blocked)} props stand on driveways: {', '.join(blocked[:3])}")
    memory_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return Survey(city.seed, found, side_m, len(props), tuple(faults), memory_mib)


def surveys(cities: Sequence[City], jobs: int) -> Iterator[Survey]:
    """Yield surveys in the order of the cities, made by `jobs` processes."""
    if jobs == 1:
        yield from map(survey, cities)
        return
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        try:
            yield from pool.map(survey, cities)
        except BrokenProcessPool as error:
            raise EngineError(
                "a process that surveyed cities has died: with fewer --jobs it may have "
                "memory enough"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


class EnduranceResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a place.

    ticks: number of simulated ticks
    persons, vehicles: means over the ticks of those around the robot
    reason: error that ended the simulation early, or ""
    """

    place: str
    ticks: int = 0
    persons: float = 0.0
    vehicles: float = 0.0
    wall_s: float = 0.0
    reason: str = ""


def endure(
    where: Place, seed: int, minutes: float = 10.0, progress: Progress = ignore
) -> EnduranceResult:
    """Simulate a place in a process of its own; errors become the result's reason."""
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe(duplex=False)
    ticks = Clock().ticks(60.0 * minutes)
    process = context.Process(
        target=_child, args=(theirs, where, seed, ticks, os.getpid()), daemon=True
    )
    began = time.monotonic()
    process.start()
    theirs.close()
    last = EnduranceResult(place=where.name)
    try:
        while mine.poll(HANG_S):
            last = msgspec.json.decode(mine.recv_bytes(), type=EnduranceResult)
            progress(f"{minutes:g} min on {where.name}", last.ticks / ticks)
        process.kill()
        reason = f"SUMO showed no sign of life for {HANG_S:g} s"
    except (EOFError, ConnectionResetError):
        process.join()
        reason = f"SUMO {exit_in_words(process.exitcode)}" if process.exitcode else ""
    process.join()
    wall_s = round(time.monotonic() - began, 1)
    return msgspec.structs.replace(last, wall_s=wall_s, reason=last.reason or reason)


def _child(pipe: Connection, where: Place, seed: int, ticks: int, parent: int) -> None:
    exit_with_parent(parent)
    so_far = EnduranceResult(place=where.name)
    try:
        for so_far in simulated(where, seed, ticks):
            pipe.send_bytes(msgspec.json.encode(so_far))
    except CosimError as error:
        pipe.send_bytes(msgspec.json.encode(msgspec.structs.replace(so_far, reason=str(error))))


def simulated(where: Place, seed: int, ticks: int) -> Iterator[EnduranceResult]:
    """Simulate a place in this process; yields its state every REPORT_TICKS and at the end."""
    from scenarios.episodes.wiring import crowd_of
    from scenarios.places.nets import place

    _, street_map = place(where)
    graph = WalkGraph(street_map)
    bodies = [
        wandering(street_map, graph, rng)
        for rng in np.random.default_rng([seed, 0xE2D]).spawn(BODIES)
    ]
    persons = vehicles = 0
    start = next(bodies[0])
    ahead = (start.x_m + 10.0, start.y_m)
    scenario = Scenario(
        id="soak",
        suite="soak",
        place=where,
        seed=seed,
        start=start,
        goal=ahead,
        route=((start.x_m, start.y_m), ahead),
    )
    with crowd_of(scenario) as crowd:
        for tick in range(ticks):
            robot, *others = map(next, bodies)
            actors = tuple(
                Actor(
                    id=f"e{i}",
                    x_m=x,
                    y_m=y,
                    heading_rad=way,
                    speed_mps=1.5,
                    doing="walk",
                    kind=PersonKind.EVENT,
                )
                for i, (x, y, way) in enumerate(others)
            )
            street = crowd.step(
                RobotState(robot), EventReply(episode="", tick=tick, states=(), actors=actors)
            )
            persons += len(street.people) - len(actors)
            vehicles += len(street.vehicles)
            done = tick + 1
            if done % REPORT_TICKS == 0 or done == ticks:
                yield EnduranceResult(
                    place=where.name, ticks=done, persons=persons / done, vehicles=vehicles / done
                )


def wandering(street_map: StreetMap, graph: WalkGraph, rng: np.random.Generator) -> Iterator[Pose]:
    """Yield the poses of a body that goes anywhere, one for each tick, without end."""
    starts = [s.line[:, :2] for s in street_map.strips.values()]
    ends = [
        s.line[:: 1 if end else -1, :2]
        for s in street_map.strips.values()
        for end in (0, 1)
        if not s.corners[end]
    ]
    lanes = [lane.line[:, :2] for lane in street_map.lanes.values() if lane.kind == "road"]
    pose = Polyline(starts[int(rng.integers(len(starts)))]).at(0.0)
    while True:
        move = str(rng.choice(list(MOVES), p=list(MOVES.values())))
        if move == "walk":
            line = _walk(street_map, graph, rng, pose)
        elif move == "lane" and lanes:
            line = _near(lanes, rng, pose)
        elif move == "across":
            way_m = rng.uniform(*ACROSS_M)
            turn_rad = rng.uniform(-math.pi, math.pi)
            line = np.array(
                [pose.xy, pose.xy + way_m * np.array([math.cos(turn_rad), math.sin(turn_rad)])]
            )
        else:
            near = _near(ends if ends and rng.random() < 0.5 else starts, rng, pose)
            line = near if rng.random() < 0.8 else starts[int(rng.integers(len(starts)))]
            x_m, y_m = line[-1].tolist()
            pose = Pose(x_m, y_m, float(rng.uniform(-math.pi, math.pi)))
            for _ in range(STAND_TICKS if move == "stand" else 1):
                yield pose
            continue
        path = Polyline(line)
        for s_m in np.arange(0.0, path.length_m, _STEP_M):
            pose = path.at(float(s_m))
            yield pose


def _near(lines: list[Floats], rng: np.random.Generator, pose: Pose) -> Floats:
    """Draw one of the lines that begin nearby, or any."""
    near = [line for line in lines if np.hypot(*(line[0] - pose.xy)) < NEARBY_M] or lines
    return near[int(rng.integers(len(near)))]


def _walk(street_map: StreetMap, graph: WalkGraph, rng: np.random.Generator, pose: Pose) -> Floats:
    """Draw the line of a random walk that begins on the sidewalk at a pose, or on any."""
    strips = street_map.strips
    here = street_map.locate(pose.x_m, pose.y_m).edge
    names = list(strips)
    first = here if here in strips else names[int(rng.integers(len(names)))]
    walk = graph.wander(rng, first, bool(rng.random() < 0.5), _WALK_EDGES)
    pieces = [strips[first].line[:, :2]]
    for name in walk[1:]:
        line = strips[name].line[:, :2]
        straight = np.hypot(*(line[0] - pieces[-1][-1])) <= np.hypot(*(line[-1] - pieces[-1][-1]))
        pieces.append(line if straight else line[::-1])
    return np.vstack(pieces)

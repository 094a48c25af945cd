"""Residents: the behaviour graph of a street, and its people."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Point

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats, Polyline, wrap_angle
from cosim.core.state import NO_PEOPLE, PERSON_RADIUS_M, People, PersonKind
from cosim.place.barriers import outline
from cosim.place.street_map import Lane, StreetMap, Strip
from cosim.spec.events import EventQuery, EventReply
from cosim.spec.scenario import Barrier, City, CrowdSpec, Scenario
from physics.ground.tiles import tile_at
from physics.street.furniture import footprints
from physics.street.interaction_spots import spots
from physics.street.placement import CLEAR_HALF_M
from physics.street.street_surface import StreetSurface
from scenarios.events.behaviour_graph import OPEN_GROUND_M, BehaviorGraph, behavior_graph
from scenarios.events.resident import SPEED_MPS, STAY_RANGES_S, Resident
from scenarios.events.resident_director import APPEARS_WITHIN_M, REMOVED_BEYOND_M, Residents
from scenarios.suites.catalog import load_suite, with_crowd
from sumo_nets.city.store import city_net
from sumo_nets.crowd.demand import SIGHT_M
from sumo_nets.net.net_file import read_net
from sumo_nets.net.snapshot import street_map_of

SHARED = Path(os.environ.get("COSIM_SHARED", Path(__file__).parents[3] / "shared")) / "maps"
IMPORTED = SHARED / "ingolstadt-fkk"
CITIES = ((3, "mixed"), (4, "mixed"), (5, "mixed"))
TICK_MS = 50


class Town(NamedTuple):
    """A place with its behaviour graph and obstacles."""

    map: StreetMap
    route: tuple[tuple[float, float], ...]
    barriers: tuple[Barrier, ...]
    graph: BehaviorGraph
    things: tuple[shapely.Geometry, ...]


@cache
def town(seed: int, style: str = "mixed") -> Town:
    """Return a small city, or the imported map, with a route along its longest sidewalk and a fence
    in the middle of it."""
    if style == "imported":
        street_map = read_net(next(iter(sorted(IMPORTED.glob("*.net.xml.gz")))))
    else:
        street_map = street_map_of(city_net(City(seed=seed, size_m=400.0, style=style)))
    longest = max(
        (s for s in street_map.strips.values() if s.kind == "sidewalk"), key=lambda s: s.length_m
    )
    line = Polyline(longest.line[:, :2])
    x, y, heading = line.at(0.5 * line.length_m)
    fence = Barrier(
        x_m=x, y_m=y, heading_rad=heading, length_m=longest.width_m + 0.3, strip=longest.id, end=0
    )
    ground = StreetSurface(street_map, seed)
    route = tuple((float(px), float(py)) for px, py in line.points)
    graph = behavior_graph(street_map, ground, route, (fence,))
    around = LineString(route).buffer(80.0)
    x0, y0, x1, y1 = around.bounds
    (i0, j0) = tile_at(x0, y0)
    (i1, j1) = tile_at(x1, y1)
    houses = [
        b.polygon
        for i in range(i0, i1 + 1)
        for j in range(j0, j1 + 1)
        for b in ground.buildings((i, j))
    ]
    return Town(
        street_map,
        route,
        (fence,),
        graph,
        (*footprints(ground.standing(around)), *houses, outline(fence)),
    )


def towns() -> list[Town]:
    found = [town(*city) for city in CITIES]
    return [*found, town(1, "imported")] if IMPORTED.is_dir() else found


def arcs(graph: BehaviorGraph) -> Floats:
    """Return (A, 2, 2) ends of the paths."""
    pairs = np.column_stack(graph.arcs.nonzero())
    return graph.xy[pairs]


class NoEvents:
    """A director without events."""

    def react(self, query: EventQuery) -> EventReply:
        return EventReply(episode=query.episode, tick=query.tick, states=(), actors=())


def query(
    tick: int, x_m: float, y_m: float, heading_rad: float = 0.0, v_mps: float = 0.0
) -> EventQuery:
    return EventQuery(
        episode="t",
        tick=tick,
        tick_ms=TICK_MS,
        robot_x_m=x_m,
        robot_y_m=y_m,
        robot_heading_rad=heading_rad,
        robot_v_mps=v_mps,
        robot_w_radps=0.0,
        route_s_m=0.0,
        robot_length_m=0.7,
        robot_width_m=0.55,
        events=(),
    )


class Moment(NamedTuple):
    query: EventQuery
    people: People
    residents: tuple[Resident, ...]


def simulated(
    place: Town, seconds: float, seed: int = 7, count: int = 8, v_mps: float = 0.8
) -> list[Moment]:
    """Simulate residents around a robot that drives along the route, and two people who stand in
    their way."""
    line = Polyline(place.route)
    shown = NO_PEOPLE
    moments = []
    still = place.graph.xy[[0, place.graph.waypoints // 2]]
    director = Residents(NoEvents(), place.graph, count, seed, lambda: shown)
    for tick in range(round(seconds * 1000 / TICK_MS)):
        x, y, heading = line.at(min(v_mps * tick * TICK_MS / 1000, line.length_m))
        robot_query = query(tick, x, y, heading, v_mps)
        actors = sorted(director.react(robot_query).actors, key=lambda actor: actor.id)
        shown = People.of(
            ("c1", "c2", *(a.id for a in actors)),
            [*still.tolist(), *((a.x_m, a.y_m) for a in actors)],
            [0.0, 0.0, *(a.heading_rad for a in actors)],
            [0.0, 0.0, *(a.speed_mps for a in actors)],
            ("stand", "stand", *(a.doing for a in actors)),
            pace=[0.0, 0.0, *(a.pace_mps for a in actors)],
            kind=[0, 0, *(a.kind for a in actors)],
            age=[0, 0, *(a.age for a in actors)],
        )
        moments.append(Moment(robot_query, shown, director.here))
    return moments


def test_waypoints_and_paths_are_walkable_and_clear_of_obstacles() -> None:
    """In three cities and on an imported map, waypoints and the paths between them keep a person's
    radius."""
    for one in towns():
        graph = one.graph
        assert graph.waypoints > 50 and np.isfinite(graph.xy).all()
        points = shapely.points(graph.xy[: graph.waypoints])
        walk = one.map.walkable_near(LineString(one.route).buffer(90.0))
        assert shapely.contains(shapely.buffer(walk, 0.01), points).all()
        assert shapely.distance(walk.boundary, points).min() > PERSON_RADIUS_M
        ends = arcs(graph)
        tree = shapely.STRtree(list(one.things))
        for shape, gap_m in (
            (points, PERSON_RADIUS_M),
            (shapely.points(graph.xy), PERSON_RADIUS_M),
        ):
            assert not len(tree.query(shape, predicate="dwithin", distance=gap_m)[0])
        assert not len(
            tree.query(
                shapely.linestrings(ends), predicate="dwithin", distance=PERSON_RADIUS_M - 0.01
            )[0]
        )


def test_paths_avoid_roads_and_crossings() -> None:
    """Paths stay off every lane and off the middle of every crossing."""
    for one in towns():
        lines = shapely.linestrings(arcs(one.graph))
        area = LineString(one.route).buffer(90.0)
        roads = [
            p.polygon
            for p in one.map.near("lane", area)
            if isinstance(p, Lane) and p.kind == "road"
        ]
        assert not len(shapely.STRtree(roads).query(lines, predicate="intersects")[0])
        crossings = [
            s for s in one.map.near("strip", area) if isinstance(s, Strip) and s.kind == "crossing"
        ]
        middles = [
            Point(Polyline(s.line[:, :2]).at(0.5 * s.length_m).xy).buffer(0.3) for s in crossings
        ]
        assert not len(shapely.STRtree(middles).query(lines, predicate="intersects")[0])


def test_no_path_crosses_a_fence() -> None:
    """The sidewalk has waypoints on both sides of the fence and no path across it."""
    one = town(*CITIES[0])
    (fence,) = one.barriers
    assert not shapely.intersects(outline(fence), shapely.linestrings(arcs(one.graph))).any()
    ahead = (one.graph.xy - (fence.x_m, fence.y_m)) @ (
        math.cos(fence.heading_rad),
        math.sin(fence.heading_rad),
    )
    near = np.hypot(*(one.graph.xy - (fence.x_m, fence.y_m)).T) < 6.0
    assert (ahead[near] > 0.5).any() and (ahead[near] < -0.5).any()


def test_residents_face_their_activity_and_leave_the_middle_free() -> None:
    """Residents sit with the back to a bench, look into a window, and wait facing a road. They
    leave 0.6 m on both sides of the sidewalk's middle free."""
    seen = set()
    for one in towns():
        area = LineString(one.route).buffer(90.0)
        walk = one.map.walkable_near(area)
        middles = [
            LineString(s.line[:, :2])
            for s in one.map.near("strip", area)
            if isinstance(s, Strip) and s.kind == "sidewalk"
        ]
        roads = shapely.union_all(
            [
                p.polygon
                for p in one.map.near("lane", area.buffer(40.0))
                if isinstance(p, Lane) and p.kind == "road"
            ]
        )
        for spot in one.graph.spots:
            seen.add(spot.what)
            at = Point(spot.x_m, spot.y_m)
            to = math.atan2(spot.at_m[1] - spot.y_m, spot.at_m[0] - spot.x_m)
            off_rad = abs(wrap_angle(to - spot.heading_rad))
            if spot.what == "bench":
                assert off_rad == pytest.approx(math.pi, abs=1e-6)
            elif spot.what == "window":
                assert off_rad < 1e-6 and math.dist(spot.at_m, (spot.x_m, spot.y_m)) < 2.5
            else:
                cos, sin = math.cos(spot.heading_rad), math.sin(spot.heading_rad)
                ahead = LineString(
                    [(spot.x_m, spot.y_m), (spot.x_m + 35.0 * cos, spot.y_m + 35.0 * sin)]
                )
                assert ahead.intersects(roads)
            assert (
                min(at.distance(line) for line in middles) > CLEAR_HALF_M + PERSON_RADIUS_M - 1e-6
            )
            assert at.distance(walk) < OPEN_GROUND_M + 0.01
    assert seen == {"bench", "window", "stop"}


def test_residents_wait_for_a_bus_only_at_shelters() -> None:
    """Activities come from props and houses: without them there are none."""
    one = town(*CITIES[0])
    assert list(spots(one.map, (), ())) == []
    ground = StreetSurface(one.map, CITIES[0][0])
    shelters = {
        p.id for p in ground.standing(LineString(one.route).buffer(90.0)) if p.kind == "shelter"
    }
    stops = {s.thing.rpartition("/")[0] for s in one.graph.spots if s.what == "stop"}
    assert stops and stops <= shelters


@pytest.fixture(scope="module")
def three_minutes() -> list[Moment]:
    """Return three minutes of residents of the first city, around a slow robot."""
    return simulated(town(*CITIES[0]), 180.0, v_mps=0.2)


def test_residents_walk_idle_and_interact(three_minutes: list[Moment]) -> None:
    """In three minutes all three states occur, speeds and stays are those of the table, and
    interacting residents are at their spots."""
    one = town(*CITIES[0])
    moments = three_minutes
    states = {(r.number, r.phase) for m in moments for r in m.residents}
    assert {phase for _, phase in states} == {"walking", "idle", "interacting"}
    assert (
        sum(len({p for n, p in states if n == number}) >= 2 for number in {n for n, _ in states})
        >= 4
    )
    for moment in moments:
        for resident in moment.residents:
            assert (
                SPEED_MPS[0] <= resident.speed_mps <= SPEED_MPS[1]
                and resident.shown_mps <= resident.speed_mps + 1e-6
            )
            assert resident.stay_s <= max(high for _, high in STAY_RANGES_S.values())
            if resident.phase == "interacting" and resident.since_tick is not None:
                spot = one.graph.spot(resident.goal)
                assert spot is not None and resident.heading_rad == spot.heading_rad
                assert (resident.x_m, resident.y_m) == (spot.x_m, spot.y_m)


def test_speeds_are_those_of_the_motion(three_minutes: list[Moment]) -> None:
    """The speed of each resident is the distance it moved in the tick."""
    before: dict[str, Floats] = {}
    treads = 0
    for moment in three_minutes:
        people = moment.people
        here = dict(zip(people.ids, people.xy, strict=True))
        for name, speed, pace in zip(people.ids, people.speed, people.pace, strict=True):
            if name in before:
                assert speed == pytest.approx(
                    math.dist(before[name], here[name]) * 1000 / TICK_MS, abs=1e-6
                )
            treads += speed == 0.0 and pace > 0.0
        before = here
    assert treads > 50


def test_residents_overlap_no_object_person_or_robot() -> None:
    """Residents keep their distance from each of them in every tick."""
    for city in CITIES[:2]:
        one = town(*city)
        tree = shapely.STRtree(list(one.things))
        moments = [moment for moment in simulated(one, 75.0, count=12) if len(moment.people) > 2]
        assert moments
        for moment in moments:
            xy = moment.people.xy[2:]
            assert not len(
                tree.query(
                    shapely.points(xy), predicate="dwithin", distance=PERSON_RADIUS_M - 0.01
                )[0]
            )
            gap = np.hypot(*(moment.people.xy[:, None] - xy[None]).transpose(2, 0, 1))
            gap[np.arange(2, len(gap)), np.arange(len(xy))] = np.inf
            assert gap.min() > 0.43
            robot = np.array([moment.query.robot_x_m, moment.query.robot_y_m])
            assert np.hypot(*(xy - robot).T).min() > PERSON_RADIUS_M + 0.27


def test_residents_appear_and_vanish_out_of_sight() -> None:
    """After the first tick no resident appears within 35 m of the robot or beyond 60 m, or vanishes
    within 70 m."""
    moments = simulated(town(*CITIES[1]), 150.0, v_mps=1.5)
    before: dict[int, Resident] = {r.number: r for r in moments[0].residents}
    assert before
    for moment in moments[1:]:
        here = {r.number: r for r in moment.residents}
        robot = moment.query.robot_x_m, moment.query.robot_y_m
        for number in here.keys() - before.keys():
            assert (
                SIGHT_M
                <= math.dist((here[number].x_m, here[number].y_m), robot)
                <= APPEARS_WITHIN_M
            )
        for number in before.keys() - here.keys():
            assert (
                math.dist((before[number].x_m, before[number].y_m), robot) > REMOVED_BEYOND_M - 0.2
            )
        before = here


def test_the_same_seed_gives_the_same_residents_in_another_process() -> None:
    """Positions of every tick have the same bits under another salt of Python's hashes, and another
    seed differs."""
    code = "from tests.scenarios.test_residents import trace; print(trace(7))"
    environment = os.environ | {
        "PYTHONHASHSEED": "321",
        "PYTHONPATH": str(Path(__file__).parents[2]),
    }
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout.split()[-1] == trace(7) != trace(8)


def trace(seed: int) -> str:
    """Return a hash of 40 s of residents."""
    import hashlib

    positions = b"".join(m.people.xy.tobytes() for m in simulated(town(*CITIES[0]), 40.0, seed))
    return hashlib.sha256(positions).hexdigest()


def test_suites_with_residents_have_another_version_and_survive_their_file() -> None:
    """Residents change version and hash of a suite, are read back from its file, and have a valid
    range."""
    shipped = load_suite("long-horizon")
    settled = with_crowd(shipped, residents=8)
    assert settled.version != shipped.version and settled.content_hash != shipped.content_hash
    one = msgspec.json.decode(msgspec.json.encode(settled.scenarios[0]), type=Scenario)
    assert one.crowd == msgspec.structs.replace(shipped.scenarios[0].crowd, residents=8, added=True)
    assert one == settled.scenarios[0]
    with pytest.raises(SpecError, match=r"crowd residents must be in \[0, 60\], not 61"):
        CrowdSpec(residents=61)


@pytest.mark.engine
def test_an_episode_with_residents_is_replayed_and_compared() -> None:
    """Residents are among the people, and both the replay and the comparison without the robot
    reproduce them."""
    from cosim.episode.loop import Step
    from cosim.place.walk_graph import WalkGraph
    from cosim.policies.load import load_policy
    from cosim.results.referee import Verdict
    from scenarios.episodes.replay import RecordedEpisode, replay_and_compare
    from scenarios.episodes.run_episode import run_episode
    from scenarios.places.nets import place
    from scenarios.suites.long_horizon import build_long_horizon

    city = City(seed=1, size_m=500.0)
    _, street_map = place(city)
    crowd = CrowdSpec(persons=10, radius_m=50.0, vehicles=4, residents=6)
    drawn = build_long_horizon(city, street_map, WalkGraph(street_map), 1, "lived-in")
    scenario = msgspec.structs.replace(drawn, crowd=crowd, time_limit_s=3.0)
    names: set[str] = set()

    def watch(step: Step, verdict: Verdict) -> None:
        people = step.street_after.people
        names.update(people.only(np.flatnonzero(people.are(PersonKind.RESIDENT))).ids)

    outcome = run_episode(scenario, load_policy("orca"), watches=[watch])
    assert outcome.log is not None and outcome.record.status == "done", outcome.record.reason
    assert len(names) >= 6 and PersonKind.RESIDENT in outcome.log.people_kind
    state_hash, without = replay_and_compare(RecordedEpisode(scenario, outcome.record, outcome.log))
    assert state_hash == outcome.record.state_hash and without.people.compared > 0

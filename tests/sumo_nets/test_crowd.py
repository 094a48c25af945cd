"""SumoCrowd on a small generated city."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import shapely
from shapely.ops import substring

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats, Polyline, Pose, box_disk_gap
from cosim.core.state import PERSON_RADIUS_M, Age, PersonKind, RobotState, Street
from cosim.place.street_map import Corner, Lane, Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import Actor, EventReply
from cosim.spec.scenario import City, CrowdSpec
from sumo_nets.city.store import city_net
from sumo_nets.crowd.crowd import SumoCrowd
from sumo_nets.crowd.stoplines import StopLines
from sumo_nets.net.net_file import read_net
from sumo_nets.net.netconvert import netconvert
from sumo_nets.net.snapshot import street_map_of

pytestmark = pytest.mark.engine

OPEN: frozenset[Port] = frozenset()


class Place(NamedTuple):
    net: Path
    map: StreetMap
    graph: WalkGraph


@pytest.fixture(scope="module")
def place() -> Place:
    """Return a city of 600 m."""
    net = city_net(City(seed=2, size_m=600.0))
    street_map = street_map_of(net)
    return Place(net, street_map, WalkGraph(street_map))


def event_actor(name: str, x_m: float, y_m: float, heading_rad: float, speed_mps: float) -> Actor:
    """Return a walking person of an event."""
    return Actor(
        id=name,
        x_m=x_m,
        y_m=y_m,
        heading_rad=heading_rad,
        speed_mps=speed_mps,
        doing="walk",
        kind=PersonKind.EVENT,
    )


def reply(tick: int, *actors: Actor) -> EventReply:
    return EventReply(episode="test", tick=tick, states=(), actors=actors)


def at(pose: Pose) -> RobotState:
    return RobotState(pose)


def middle(place: Place, *, signalised: bool = False) -> Pose:
    """Return the middle of a long sidewalk near the centre of the map, or the nearest one to a
    signalised crossing."""
    street_map = place.map
    x0, y0, x1, y1 = street_map.bounds
    centre = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    if signalised:
        crossing = next(s for s in street_map.strips.values() if s.signalised)
        centre = crossing.line.mean(axis=0)
    sidewalks = [
        Polyline(street_map.strips[i].line) for i in sorted(place.graph.main_strips) if i[0] != ":"
    ]
    line = min(
        (line for line in sidewalks if line.length_m > 40.0),
        key=lambda line: float(np.hypot(*(line.at(line.length_m / 2).xy - centre))),
    )
    return line.at(line.length_m / 2)


def gaps(street: Street, pose: Pose) -> Floats:
    """Return the distance of every person to a pose in metres."""
    offset = street.people.xy - pose[:2]
    return np.asarray(np.hypot(offset[:, 0], offset[:, 1]))


class Travel(NamedTuple):
    """The streets around a robot that travels 120 m in a minute, and its poses."""

    streets: list[Street]
    poses: list[Pose]


@pytest.fixture(scope="module")
def travel(place: Place) -> Travel:
    start = middle(place)
    reach = place.graph.reach(Port(place.map.locate(*start[:2]).edge, 0))
    path = reach.path(reach.within(140.0, 300.0)[0])
    assert path is not None
    line = Polyline([place.graph.point(port) for port in path])
    spec = CrowdSpec(persons=40, radius_m=80.0, vehicles=12)
    poses = [start, *(line.at(0.1 * tick) for tick in range(1200))]
    with SumoCrowd(place.net, place.map, spec, 5, OPEN, start[:2]) as crowd:
        streets = [crowd.street]
        streets += [crowd.step(at(pose), reply(tick)) for tick, pose in enumerate(poses[1:])]
    return Travel(streets, poses)


def test_the_first_street_is_populated_and_clear_around_the_robot(
    place: Place, travel: Travel
) -> None:
    """At tick 0 all requested persons are on walkable ground, none nearer than 8 m, and cars
    drive."""
    street = travel.streets[0]
    near = gaps(street, travel.poses[0])
    assert street.tick == 0 and len(street.people) == 40
    assert near.min() >= 7.9 and near.max() <= 82.5
    assert {place.map.locate(*xy).kind for xy in street.people.xy} == {"walk"}
    assert street.people.are(PersonKind.CROWD).all()
    ages = np.concatenate([street.people.age for street in travel.streets])
    assert {*ages.tolist()} == {*Age}
    assert list(street.people.ids) == sorted(street.people.ids)
    assert len(street.vehicles) >= 10 and street.vehicles.speed.max() > 5.0
    on_road = [bool(place.map.near("lane", shapely.Point(xy))) for xy in street.vehicles.xy]
    assert np.mean(on_road) > 0.9


def test_the_crowd_follows_a_robot_that_travels(travel: Travel) -> None:
    """About as many persons as requested are within the radius of the robot, and none appears near
    it."""
    known: set[str] = set()
    appeared: list[float] = []
    for street, pose in zip(travel.streets, travel.poses, strict=True):
        near = gaps(street, pose)
        if street.tick:
            appeared += [
                gap for gap, name in zip(near, street.people.ids, strict=True) if name not in known
            ]
        known |= set(street.people.ids)
    seen = [*zip(travel.streets, travel.poses, strict=True)][1::20]
    inside = [int((gaps(street, pose) < 80.0).sum()) for street, pose in seen]
    assert travel.streets[-1].tick == 1200
    assert 36 <= np.mean(inside) <= 44 and min(inside) >= 28
    assert np.mean([len(street.vehicles) for street, _ in seen]) >= 9
    assert len(appeared) > 10 and min(appeared) > 34.0


def test_a_density_is_kept_along_the_way(place: Place) -> None:
    """Over 100 m the mean of every third has the requested persons per 1000 m2 of walkable ground,
    within 5 %."""
    start = middle(place)
    reach = place.graph.reach(Port(place.map.locate(*start[:2]).edge, 0))
    path = reach.path(reach.within(130.0, 300.0)[0])
    assert path is not None
    line = Polyline([place.graph.point(port) for port in path])
    pieces = np.array(
        [p.polygon for p in (*place.map.strips.values(), *place.map.corners.values())], dtype=object
    )
    found = []
    with SumoCrowd(
        place.net, place.map, CrowdSpec(density=40.0, vehicles=0), 5, OPEN, start[:2]
    ) as crowd:
        for tick in range(1200):
            pose = line.at(0.08 * tick)
            street = crowd.step(at(pose), reply(tick))
            if tick % 40 == 20:
                disk = shapely.Point(pose.xy).buffer(80.0)
                room_m2 = shapely.area(shapely.intersection(pieces, disk)).sum()
                found.append(1000.0 * float((gaps(street, pose) < 80.0).sum()) / room_m2)
    assert [np.mean(third) for third in np.array_split(found, 3)] == pytest.approx(
        [40.0] * 3, rel=0.05
    )


def test_people_keep_a_distance_from_a_standing_robot(place: Place) -> None:
    """In 40 seconds beside a standing robot people pass on the sidewalk, none nearer than 0.5 m."""
    start = middle(place)
    spec = CrowdSpec(persons=60, radius_m=60.0, vehicles=0)
    nearest = math.inf
    passed = set()
    with SumoCrowd(place.net, place.map, spec, 4, OPEN, start[:2]) as crowd:
        for tick in range(800):
            street = crowd.step(at(start), reply(tick))
            near = gaps(street, start)
            nearest = min(nearest, float(near.min()))
            passed |= {name for name, gap in zip(street.people.ids, near, strict=True) if gap < 2.5}
    assert len(passed) >= 5
    assert nearest >= 0.5


def test_people_pass_a_robot_in_the_middle_of_a_narrow_sidewalk(tmp_path: Path) -> None:
    """On a sidewalk of 1.5 m they pass it in both directions without touching it."""
    nodes, edges, net = (tmp_path / name for name in ("n.nod.xml", "e.edg.xml", "street.net.xml"))
    nodes.write_text('<n><node id="a" x="0" y="0"/><node id="b" x="100" y="0"/></n>')
    edge = '<edge id="{0}" from="{0[0]}" to="{0[1]}" numLanes="1" sidewalkWidth="1.5"/>'
    edges.write_text("<e>" + "".join(edge.format(way) for way in ("ab", "ba")) + "</e>")
    netconvert(["-n", str(nodes), "-e", str(edges), "--walkingareas"], net)
    street_map = read_net(net)
    pose = Polyline(street_map.strips["ab"].line[:, :2]).at(50.0)
    ahead = np.array([math.cos(pose.heading_rad), math.sin(pose.heading_rad)])
    came: dict[str, float] = {}
    passed = {-1.0: 0, 1.0: 0}
    least_m = math.inf
    spec = CrowdSpec(persons=14, radius_m=60.0, vehicles=0)
    with SumoCrowd(net, street_map, spec, 9, OPEN, pose.xy) as crowd:
        for tick in range(500):
            people = crowd.step(at(pose), reply(tick)).people
            near = np.hypot(*(people.xy - pose.xy).T) < 4.0
            gap_m = box_disk_gap(np.array([pose]), 0.35, 0.275, people.xy[None])[0]
            least_m = min(least_m, float(gap_m.min(initial=math.inf)) - PERSON_RADIUS_M)
            for i in np.flatnonzero(near).tolist():
                side = float(np.sign((people.xy[i] - pose.xy) @ ahead))
                first = came.setdefault(people.ids[i], side)
                if side == -first:
                    passed[first] += 1
                    came[people.ids[i]] = side
    assert min(passed.values()) >= 1 and least_m > 0.05


def test_people_walk_through_an_absent_robot(place: Place) -> None:
    """Where people keep half a metre from a robot, without it some walk over its place."""
    start = middle(place)
    nearest = math.inf
    with SumoCrowd(
        place.net, place.map, CrowdSpec(persons=60, radius_m=60.0, vehicles=0), 4, OPEN, start[:2]
    ) as crowd:
        for tick in range(2400):
            nearest = min(
                nearest, float(gaps(crowd.step(at(start), reply(tick), absent=True), start).min())
            )
            if nearest < 0.4:
                break
    assert nearest < 0.4


class Junction(NamedTuple):
    """The streets of 80 seconds beside signals, and the light of each vehicle at its stop line."""

    streets: list[Street]
    lights: str


@pytest.fixture(scope="module")
def junction(place: Place) -> Junction:
    start = middle(place, signalised=True)
    spec = CrowdSpec(persons=80, radius_m=80.0, vehicles=30)
    lights = ""
    with SumoCrowd(place.net, place.map, spec, 6, OPEN, start[:2]) as crowd:
        streets = [crowd.street]
        lines = StopLines(0.05)
        for tick in range(1600):
            streets.append(crowd.step(at(start), reply(tick)))
            lights += "".join(p.light for p in lines.passed(streets[-1].vehicles.ids))
    return Junction(streets, lights)


def test_nobody_enters_a_signalised_crossing_on_red(place: Place, junction: Junction) -> None:
    """People wait and start over crossings, none once it has been red for 2 s, which a slow walker
    needs from the kerb to the inner part."""
    strips = [strip for strip in place.map.strips.values() if strip.signalised]
    lines = {s.id: shapely.LineString(s.line) for s in strips}
    middles = {name: substring(line, 2.2, line.length - 2.2) for name, line in lines.items()}
    inner = {s.id: shapely.buffer(middles[s.id], s.width_m / 2, cap_style="flat") for s in strips}
    entries: list[float] = []
    on: dict[str, str] = {}
    red_s: dict[str, float] = {}
    waiting = 0
    for street in junction.streets[1:]:
        now: dict[str, str] = {}
        for crossing, signal in street.signals.items():
            red_s[crossing] = 0.0 if signal.walk else red_s.get(crossing, -2.0) + 0.05
            inside = shapely.contains_xy(inner[crossing], *street.people.xy.T)
            now |= {street.people.ids[i]: crossing for i in np.flatnonzero(inside)}
        entries += [red_s[crossing] for name, crossing in now.items() if on.get(name) != crossing]
        waiting += sum(doing == "stand" for doing in street.people.doing)
        on = now
    assert len(entries) >= 10 and waiting > 100
    assert max(entries) < 2.0


def test_vehicles_stop_at_red(junction: Junction) -> None:
    """Vehicles pass stop lines, none of them at red."""
    assert len(junction.lights) >= 10 and "r" not in junction.lights


def test_signals_change_at_the_announced_time(junction: Junction) -> None:
    """Every change happens within a tick of its announced time, and red stays red until then."""
    announced: dict[str, tuple[bool, float]] = {}
    changes = 0
    for tick, street in enumerate(junction.streets):
        now_s = tick * 0.05
        for crossing, signal in street.signals.items():
            walk, at_s = announced.get(crossing, (signal.walk, math.inf))
            if signal.walk != walk:
                changes += 1
                assert now_s == pytest.approx(at_s, abs=0.051)
            else:
                assert now_s <= at_s + 0.051
            assert signal.changes_in_s is not None and signal.changes_in_s >= 0.0
            announced[crossing] = (signal.walk, now_s + signal.changes_in_s)
    assert changes >= 4


def test_nobody_passes_a_closed_port(place: Place) -> None:
    """In 40 seconds nobody crosses between a closed sidewalk and its corner, where people pass
    otherwise."""
    start = middle(place)
    port = Port(place.map.locate(*start[:2]).edge, 1)
    strip = place.map.strips[port.strip]
    corner = place.map.corners[str(strip.corners[1])].polygon
    behind = strip.polygon.difference(shapely.Point(place.graph.point(port)).buffer(3.0))
    spec = CrowdSpec(persons=60, radius_m=60.0, vehicles=0)

    def passed(closed: frozenset[Port], most: int) -> int:
        side: dict[str, str] = {}
        count = 0
        with SumoCrowd(place.net, place.map, spec, 8, closed, start[:2]) as crowd:
            for tick in range(800):
                people = crowd.step(at(start), reply(tick)).people
                for where, area in (("behind", behind), ("corner", corner)):
                    inside = shapely.contains_xy(area, people.xy[:, 0], people.xy[:, 1])
                    for name in (people.ids[i] for i in np.flatnonzero(inside)):
                        count += side.get(name, where) != where
                        side[name] = where
                if count >= most:
                    break
        return count

    assert passed(OPEN, 3) == 3
    assert passed(frozenset({port}), 1) == 0


def test_event_actors_appear_exactly_and_the_crowd_evades_them(place: Place) -> None:
    """Actors are in the street as given, after the others in order of ids, and vanish when not
    given; people walk round them."""
    start = middle(place)
    ahead = Pose(
        start.x_m + 6.0 * math.cos(start.heading_rad),
        start.y_m + 6.0 * math.sin(start.heading_rad),
        start.heading_rad,
    )
    talker = Actor(
        id="a2",
        x_m=ahead.x_m,
        y_m=ahead.y_m,
        heading_rad=1.0,
        speed_mps=0.0,
        doing="talk",
        kind=PersonKind.INJECTED,
        age=Age.ELDERLY,
    )
    spec = CrowdSpec(persons=60, radius_m=60.0, vehicles=0)
    nearest = math.inf
    with SumoCrowd(place.net, place.map, spec, 4, OPEN, start[:2]) as crowd:
        for tick in range(800):
            walker = event_actor("a1", start.x_m + 0.01 * tick, start.y_m, 0.0, 0.2)
            street = crowd.step(at(start), reply(tick, talker, walker))
            people = street.people
            assert people.ids[-2:] == ("a1", "a2") and people.kind[-2:].tolist() == [
                walker.kind,
                talker.kind,
            ]
            assert people.age[-2:].tolist() == [Age.ADULT, Age.ELDERLY]
            assert not people.kind[:-2].any()
            assert people.xy[-2:].tolist() == [[walker.x_m, walker.y_m], [talker.x_m, talker.y_m]]
            assert (
                people.heading[-1] == 1.0
                and people.speed[-2] == 0.2
                and people.doing[-2:] == ("walk", "talk")
            )
            nearest = min(nearest, float(gaps(street, ahead)[:-2].min()))
        street = crowd.step(at(start), reply(800))
        assert street.people.are(PersonKind.CROWD).all()
    assert 0.45 <= nearest < 3.0


def test_the_same_calls_give_the_same_streets_bit_for_bit(place: Place) -> None:
    """A second run in the same process repeats every array, and another seed does not."""
    start = middle(place)

    def run(seed: int, ticks: int) -> list[Street]:
        spec = CrowdSpec(persons=50, radius_m=80.0, vehicles=20)
        streets = []
        with SumoCrowd(place.net, place.map, spec, seed, OPEN, start[:2]) as crowd:
            streets.append(crowd.street)
            for tick in range(ticks):
                pose = Pose(
                    start.x_m + 0.05 * tick * math.cos(start.heading_rad),
                    start.y_m,
                    start.heading_rad,
                )
                actor = event_actor("e1", pose.x_m + 2.0, pose.y_m, 0.0, 1.0)
                streets.append(crowd.step(at(pose), reply(tick, actor)))
        return streets

    first, second, other = run(1, 250), run(1, 250), run(2, 0)
    for a, b in zip(first, second, strict=True):
        assert (
            a.people.ids == b.people.ids
            and a.people.doing == b.people.doing
            and a.vehicles.ids == b.vehicles.ids
        )
        assert a.signals == b.signals
        for kind in ("xy", "heading", "speed"):
            assert getattr(a.people, kind).tobytes() == getattr(b.people, kind).tobytes()
            assert getattr(a.vehicles, kind).tobytes() == getattr(b.vehicles, kind).tobytes()
    assert first[0].people.xy.tobytes() != other[0].people.xy.tobytes()


def test_the_crowd_runs_with_a_robot_anywhere(place: Place) -> None:
    """A robot and event pedestrians may jump over sidewalks, corners, roads and fields."""
    rng = np.random.default_rng(9)
    pieces: list[Strip | Corner | Lane] = [
        *place.map.strips.values(),
        *place.map.corners.values(),
        *place.map.lanes.values(),
    ]

    def somewhere() -> list[float]:
        x0, y0, x1, y1 = pieces[int(rng.integers(len(pieces)))].polygon.bounds
        return [
            rng.uniform(x0 - 1, x1 + 1),
            rng.uniform(y0 - 1, y1 + 1),
            rng.uniform(-math.pi, math.pi),
        ]

    bodies = [somewhere() for _ in range(4)]
    spec = CrowdSpec(persons=20, radius_m=60.0, vehicles=8)
    with SumoCrowd(place.net, place.map, spec, 9, OPEN, (bodies[0][0], bodies[0][1])) as crowd:
        for tick in range(600):
            for body in bodies:
                if rng.random() < 0.08:
                    body[:] = somewhere()
                body[0] += 0.06 * math.cos(body[2])
                body[1] += 0.06 * math.sin(body[2])
            actors = [
                event_actor(f"e{i}", x, y, heading, 1.2)
                for i, (x, y, heading) in enumerate(bodies[1:])
            ]
            street = crowd.step(at(Pose(*bodies[0])), reply(tick, *actors))
        assert np.isfinite(street.people.xy).all() and np.isfinite(street.vehicles.xy).all()


def test_the_crowd_runs_beside_corners_without_a_crossing(tmp_path: Path) -> None:
    """Bodies may jump where footpaths meet in two adjacent corners, which SUMO confuses."""
    at_m = {"j": (0, 0), "a": (60, 18), "b": (-6, -3), "c": (-4, 3.5)}
    paths = [f"{a}{b}" for other in "abc" for a, b in ((other, "j"), ("j", other))]
    nodes, edges, net = (tmp_path / name for name in ("n.nod.xml", "e.edg.xml", "paths.net.xml"))
    nodes.write_text(
        "<n>" + "".join(f'<node id="{k}" x="{x}" y="{y}"/>' for k, (x, y) in at_m.items()) + "</n>"
    )
    edge = '<edge id="{0}{1}" from="{0}" to="{1}" numLanes="1" allow="pedestrian" width="3.2"/>'
    edges.write_text("<e>" + "".join(edge.format(*path) for path in paths) + "</e>")
    netconvert(["-n", str(nodes), "-e", str(edges), "--walkingareas"], net)
    street_map = read_net(net)
    assert {corner.id for corner in street_map.corners.values()} >= {":j_w0", ":j_w1"}
    rng = np.random.default_rng(4)
    spots = rng.uniform((-5, -5, -math.pi), (12, 12, math.pi), (500, 2, 3)).tolist()
    with SumoCrowd(net, street_map, CrowdSpec(persons=4, vehicles=0), 9, OPEN, (0.0, 0.0)) as crowd:
        for tick, (robot, (x, y, heading)) in enumerate(spots):
            actor = event_actor("e0", x, y, heading, 1.2)
            crowd.step(at(Pose(*robot)), reply(tick, actor))
        assert crowd.street.tick == 500


def test_people_turn_round_where_the_sidewalks_meet(tmp_path: Path) -> None:
    """Behind a barrier they return to the other sidewalk of the street over the far end, and
    arrive."""
    at_m = {"a": (0, 0), "b": (60, 0), "c": (66, 2)}
    nodes, edges, net = (tmp_path / name for name in ("n.nod.xml", "e.edg.xml", "street.net.xml"))
    nodes.write_text(
        "<n>" + "".join(f'<node id="{k}" x="{x}" y="{y}"/>' for k, (x, y) in at_m.items()) + "</n>"
    )
    edge = '<edge id="{0}" from="{0[0]}" to="{0[1]}" numLanes="1" sidewalkWidth="1.92"/>'
    edges.write_text("<e>" + "".join(edge.format(way) for way in ("ab", "ba", "bc", "cb")) + "</e>")
    netconvert(["-n", str(nodes), "-e", str(edges), "--walkingareas"], net)
    street_map = read_net(net)
    barrier = frozenset({Port("bc", 1)})
    assert WalkGraph(street_map).wander(np.random.default_rng(0), "ab", False, 9, barrier) == [
        "ab",
        "ba",
    ]
    with SumoCrowd(
        net, street_map, CrowdSpec(persons=12, vehicles=0), 9, barrier, (0.0, 0.0)
    ) as crowd:
        for tick in range(1600):
            crowd.step(at(Pose(0.0, 20.0, 0.0)), reply(tick))
            assert crowd.street.people.xy[:, 0].max(initial=0.0) < 57.0
        assert int(crowd.street.people.ids[-1][1:]) > 20


def test_misuse_is_named(place: Place, tmp_path: Path) -> None:
    """A second crowd, a step without a running one, invalid actors and a broken net each have their
    own message."""
    spec = CrowdSpec(persons=2, vehicles=0)
    start = middle(place)
    crowd = SumoCrowd(place.net, place.map, spec, 1, OPEN, start[:2])
    with pytest.raises(EngineError, match="not running: use it as a context manager"):
        crowd.step(at(start), reply(0))
    actor = event_actor("x1", 0.0, 0.0, 0.0, 0.0)
    with crowd:
        with (
            pytest.raises(EngineError, match="only once per process"),
            SumoCrowd(*_arguments(crowd)),
        ):
            pass
        for bad in ((actor, actor), (event_actor(crowd.street.people.ids[0], 0.0, 0.0, 0.0, 0.0),)):
            with pytest.raises(EngineError, match="unique ids, and none of the crowd's"):
                crowd.step(at(start), reply(0, *bad))
    crowd.close()
    with (
        pytest.raises(EngineError, match="no street net at"),
        SumoCrowd(tmp_path / "no.xml", *_arguments(crowd)[1:]),
    ):
        pass
    broken = tmp_path / "broken.net.xml"
    broken.write_text("<net")
    with (
        pytest.raises(EngineError, match=r"SUMO cannot start on .*broken.*end of input"),
        SumoCrowd(broken, *_arguments(crowd)[1:]),
    ):
        pass
    with crowd:
        assert crowd.street.tick == 0


def _arguments(
    crowd: SumoCrowd,
) -> tuple[Path, StreetMap, CrowdSpec, int, frozenset[Port], tuple[float, float]]:
    return crowd._net_path, crowd._map, crowd._spec, crowd._seed, crowd._closed, crowd._start_xy

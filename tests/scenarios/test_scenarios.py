"""Registered suites, routes and policies: each registered item is tested without a test of its
own."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Point, Polygon, box

from cosim.core.clock import Clock
from cosim.core.errors import SpecError, UsageError
from cosim.core.geometry import Polyline
from cosim.core.state import NO_PEOPLE, NO_VEHICLES, RobotState, Street
from cosim.episode.interfaces import Privileged
from cosim.episode.loop import Moment, query
from cosim.episode.policy_caller import PolicyCaller
from cosim.place.barriers import barrier_at, ports_to_close, prove_single_path, without_barriers
from cosim.place.route_line import way_line
from cosim.place.street_map import Corner, Lane, Port, StreetMap, Strip, WalkableArea
from cosim.place.walk_graph import WalkGraph
from cosim.policies import POLICIES
from cosim.spec.events import Event, EventQuery
from cosim.spec.goal import PointGoal
from cosim.spec.odometry import Odometry
from cosim.spec.robot import COURIER, ROBOTS, Robot
from cosim.spec.scenario import (
    Barrier,
    City,
    CityMap,
    RouteCrossing,
    Scenario,
    content_hash,
    read_suite,
    write_suite,
)
from cosim.spec.selection import select_scenarios
from cosim.spec.sensors import Scan
from scenarios.events import EVENT_KINDS, react
from scenarios.places.nets import place
from scenarios.suites import long_horizon, unit
from scenarios.suites.catalog import SUITES, load_suite
from scenarios.suites.long_horizon import (
    avoided_strips,
    build_long_horizon,
    on_car_paths_m,
    on_road_m,
)
from scenarios.suites.proofs import read_proofs
from scenarios.suites.sample import suite_on_map
from scenarios.suites.unit import build_unit
from sumo_nets.maps.map_store import read_map
from tests.support.shipped import long_ways


def test_the_long_horizon_suite_matches_its_description() -> None:
    """It has a route in each of 100 cities and five on real places, 36.5 km in total, each longer
    than 100 m."""
    suite = load_suite("long-horizon")
    assert len(suite.scenarios) == len({s.place.name for s in suite.scenarios}) == 105
    assert sum(isinstance(s.place, CityMap) for s in suite.scenarios) == 5
    assert abs(sum(s.route_line.length_m for s in suite.scenarios) - 36_500.0) < 365.0
    for scenario in suite.scenarios:
        assert scenario.route_line.length_m > 100.0
        assert scenario.time_limit_s == pytest.approx(
            max(300.0, scenario.route_line.length_m / 0.2), abs=0.01
        )
        assert scenario.crossings and scenario.place.net_hash


def test_the_reactive_suite_matches_its_description() -> None:
    """Each of a hundred cities has each event with its decoy and an empty way, of 12 to 30 m; no
    event triggers at the start."""
    suite = load_suite("reactive")
    events = [scenario for scenario in suite.scenarios if not scenario.decoy_of]
    decoys = {scenario.decoy_of for scenario in suite.scenarios if scenario.decoy_of}
    assert decoys == {scenario.id for scenario in events if scenario.events}
    cities = {scenario.place.name for scenario in suite.scenarios}
    assert len(cities) == 100
    structures = (*EVENT_KINDS, "static")
    places = {one: [s.place.name for s in events if s.structure == one] for one in structures}
    assert all(len(names) == 100 and set(names) == cities for names in places.values())
    assert [s.place.name for s in suite.scenarios] == sorted(
        (s.place.name for s in suite.scenarios), key=lambda name: int(name.rpartition("-")[2])
    )
    for scenario in suite.scenarios:
        if scenario.structure == "static":
            assert not scenario.events
            continue
        (event,) = scenario.events
        assert (event.kind, scenario.crowd.persons, scenario.crowd.vehicles) == (
            scenario.structure,
            0,
            0,
        )
        assert 11.9 <= scenario.route_line.length_m <= 30.1
        stops = event.kind == "gesturing" and not scenario.decoy_of
        assert scenario.ends_on_failure and (scenario.ends_at == "stop") == stops
        assert 1.1 <= event.speed_mps <= 1.65
        states = react(first_query(scenario)).states
        assert states[0].phase == "waiting"
        chord = Polyline([scenario.start[:2], scenario.goal])
        assert max(abs(chord.project(x, y)[1]) for x, y in scenario.route) < 0.2


def first_query(scenario: Scenario) -> EventQuery:
    """Return the query of a director at the first tick."""
    return query(
        scenario, Clock(), Moment(0, RobotState(scenario.start_pose), Street(0), 0.0), (0.7, 0.55)
    )


@pytest.mark.parametrize("name", SUITES)
def test_every_scenario_comes_with_its_proof(name: str) -> None:
    """The proofs beside a suite have the hashes of its scenarios."""
    assert {proof.scenario: proof.scenario_hash for proof in read_proofs(SUITES[name]).proofs} == {
        s.id: content_hash(s) for s in load_suite(name).scenarios
    }


def test_scenarios_are_chosen_by_event() -> None:
    """Selection by kind keeps events of these kinds, and an unknown kind is refused with the known
    ones."""
    suite = load_suite("reactive")
    assert {s.events[0].kind for s in select_scenarios(suite, kinds=["frontal", "lateral"])} == {
        "frontal",
        "lateral",
    }
    first = select_scenarios(suite, kinds=["frontal"], episodes=1)
    assert [(one.structure, bool(one.decoy_of)) for one in first] == [
        ("frontal", False),
        ("frontal", True),
    ]
    with pytest.raises(UsageError, match=r"event 'ambush'.*frontal"):
        select_scenarios(suite, kinds=["ambush"])


def test_a_suite_survives_its_file(tmp_path: Path) -> None:
    """Writing and reading a suite changes neither its values nor its hash."""
    suite = load_suite("long-horizon")
    write_suite(suite, tmp_path / "s.json")
    again = read_suite(tmp_path / "s.json")
    assert again == suite and again.content_hash == suite.content_hash


def test_roughness_of_a_place_is_stored_and_has_a_range() -> None:
    """Ground is flat by default; roughness is read back and changes the hash; values out of range
    are refused."""
    rough = CityMap(map="m", roughness=0.4)
    assert City(seed=1).roughness == 0.0
    assert msgspec.json.decode(msgspec.json.encode(rough), type=CityMap) == rough
    assert content_hash(rough) != content_hash(CityMap(map="m"))
    for bad in (-0.1, 1.5, float("nan")):
        with pytest.raises(
            SpecError, match=r"roughness is \S+, but it lies between 0 \(flat\) and 1"
        ):
            City(seed=1, roughness=bad)


@pytest.mark.engine
def test_roughness_needs_a_map_and_has_a_range() -> None:
    """`--roughness` without `--map`, or out of range, is refused with the reason."""
    from typer.testing import CliRunner

    from cosim.cli.app import app

    for options, reason in (
        (["--roughness", "0.3"], "--roughness goes with --map"),
        (["--map", "anything", "--roughness", "2"], "roughness is 2, but it lies between 0"),
    ):
        refused = CliRunner().invoke(app, ["run", "long-horizon", *options])
        assert refused.exit_code != 0 and reason in str(refused.exception)


@pytest.mark.engine
def test_fewer_people_walk_where_sidewalks_are_narrow() -> None:
    """On a map with narrow sidewalks the crowd is less dense than in a city."""
    (scenario,) = suite_on_map("long-horizon", "sumo-fkk-in", 1, 1).scenarios
    assert scenario.crowd.density is not None and 2.0 <= scenario.crowd.density < 22.0


def test_free_space_ends_at_furniture() -> None:
    """A prop on walkable ground is cut out; without props on it the area is the same object."""
    from physics.street.furniture import Prop, footprints
    from scenarios.episodes.wiring import without_obstacles

    area = cross_map().walkable
    post = Prop("prop:east:0", "lamp", 0, 20.0, 1.2, 0.0, 0)
    beside = Prop("prop:east:1", "bench", 0, 20.0, 4.0, 0.0, 0)
    assert without_obstacles(area, [beside]) is area and without_obstacles(area, []) is area
    free = without_obstacles(area, [post, beside])
    assert free.area == pytest.approx(area.area - footprints([post])[0].area)
    assert not free.intersects(Point(20.0, 1.2))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Take one route by default, all with --whole."""
    if "shipped" in metafunc.fixturenames:
        whole = metafunc.config.getoption("--whole")
        metafunc.parametrize("shipped", range(105 if whole else 1), indirect=True)


@pytest.fixture
def shipped(request: pytest.FixtureRequest) -> Scenario:
    """Return a route of `long-horizon`."""
    return long_ways()[request.param]


@pytest.mark.engine
def test_a_scenario_has_exactly_one_walkable_path(shipped: Scenario) -> None:
    """Start and goal are connected inside the fences, no path leads round a hole, and the route
    keeps off the edge."""
    scenario = shipped
    _, street_map = place(scenario.place)
    route = scenario.route_line
    near = shapely.buffer(LineString(scenario.route), 200.0)
    free = without_barriers(street_map.walkable_near(near), scenario.barriers)
    part = next(p for p in shapely.get_parts(free) if p.covers(Point(route.points[0])))
    assert part.covers(Point(route.points[-1]))
    assert not [ring for ring in part.interiors if shapely.Polygon(ring).area > 0.25]
    assert shapely.covers(shapely.buffer(near, -1.0), part)
    assert (
        WalkableArea(shapely.buffer(part, -0.3)).signed_distance(route.resampled(0.25).points).min()
        >= 0.0
    )
    assert {e.kind for e in scenario.events} <= set(EVENT_KINDS)
    for event in scenario.events:
        at = route.at(event.route_s_m)
        assert np.hypot(at.x_m - event.x_m, at.y_m - event.y_m) < 0.01
    for crossing in scenario.crossings:
        middle = route.at((crossing.enter_s_m + crossing.leave_s_m) / 2)
        strip = street_map.strips[crossing.id]
        assert strip.polygon.covers(Point(middle[:2])) and strip.signalised == crossing.signalised


def cross_map(width_m: float = 3.2) -> StreetMap:
    """Return four sidewalks of 40 m that meet at a corner of 4 m x 4 m in the middle."""
    arms = {"east": (1, 0), "north": (0, 1), "west": (-1, 0), "south": (0, -1)}
    strips = {}
    for name, (dx, dy) in arms.items():
        line = np.array([[2.0 * dx, 2.0 * dy], [42.0 * dx, 42.0 * dy]])
        polygon = shapely.buffer(LineString(line), 0.5 * width_m, cap_style="flat")
        strips[name] = Strip(name, "sidewalk", line, width_m, polygon, ("middle", None))
    corner = Corner("middle", box(-2, -2, 2, 2), tuple(Port(name, 0) for name in arms))
    return StreetMap("cross", (-42, -42, 42, 42), strips, {"middle": corner}, {}, {})


def test_branches_are_the_ports_that_a_route_does_not_use() -> None:
    """On a crossroads from west to east, north and south are closed."""
    way = [Port("west", 0), Port("east", 0)]
    assert ports_to_close(cross_map(), way) == [Port("north", 0), Port("south", 0)]


def test_the_proof_refuses_a_blocked_and_a_narrow_route() -> None:
    """Fences at every branch prove the path; a fence across it and too wide a margin are refused
    with the reason."""
    street_map = cross_map()
    way = [Port("west", 0), Port("east", 0)]
    route = Polyline([(-30, 0), (30, 0)])
    fences = [barrier_at(street_map, port) for port in ports_to_close(street_map, way)]
    part = prove_single_path(street_map, route, fences, way, 0.3)
    assert part.covers(Point(30, 0)) and not part.covers(Point(0, 30))
    across = barrier_at(street_map, Port("east", 0))
    with pytest.raises(SpecError, match="start and goal are not connected"):
        prove_single_path(street_map, route, [*fences, across], way, 0.3)
    with pytest.raises(SpecError, match=r"nearer than 1\.70 m|narrower than 3\.40 m"):
        prove_single_path(street_map, route, fences, way, 1.7)


def test_the_proof_refuses_two_paths_round_a_hole() -> None:
    """A hole in the walkable area leaves two paths and is named with its place."""
    street_map = cross_map()
    island = box(-0.4, -0.4, 0.6, 0.6)
    holed = Corner(
        "middle", box(-2, -2, 2, 2).difference(island), street_map.corners["middle"].ports
    )
    street_map = StreetMap(
        "island", street_map.bounds, street_map.strips, {"middle": holed}, {}, {}
    )
    way = [Port("west", 0), Port("east", 0)]
    fences = [barrier_at(street_map, port) for port in ports_to_close(street_map, way)]
    with pytest.raises(SpecError, match=r"two ways remain: they lead round \(0\.1, 0\.1\)"):
        prove_single_path(street_map, Polyline([(-30, 0), (30, 0)]), fences, way, 0.2)


def test_the_proof_refuses_a_route_that_doubles_back() -> None:
    """On two sidewalks that touch, a robot can cross over and skip the loop; with a gap between
    them it cannot."""

    def parallel_sidewalks(apart_m: float) -> StreetMap:
        """Return two sidewalks of 60 m and 2 m of width at a distance, joined in the east."""
        lines = {
            "out": np.array([[0.0, 0.0], [60.0, 0.0]]),
            "back": np.array([[0.0, 2.0], [60.0, 2.0]]),
        }
        lines["back"][:, 1] += apart_m
        strips = {
            name: Strip(
                name,
                "sidewalk",
                line,
                2.0,
                LineString(line).buffer(1.0, cap_style="flat"),
                (None, "end"),
            )
            for name, line in lines.items()
        }
        corner = Corner("end", box(60, -1, 63, 3 + apart_m), (Port("out", 1), Port("back", 1)))
        return StreetMap("beside", (0, -1, 63, 3 + apart_m), strips, {"end": corner}, {}, {})

    way = [Port("out", 1), Port("back", 1)]
    route = way_line(parallel_sidewalks(0.0), way, 40.0, 35.0)
    with pytest.raises(
        SpecError, match=r"^the way doubles back: its start is \d\d m nearer on foot 7\d m along"
    ):
        prove_single_path(parallel_sidewalks(0.0), route, (), way, 0.3)
    assert prove_single_path(
        parallel_sidewalks(0.5), way_line(parallel_sidewalks(0.5), way, 40.0, 35.0), (), way, 0.3
    )


def test_a_fence_closes_its_whole_strip() -> None:
    """Each port's fence cuts its strip from its corner."""
    street_map = cross_map()
    for name in street_map.strips:
        free = without_barriers(street_map.walkable, [barrier_at(street_map, Port(name, 0))])
        far = Point(street_map.strips[name].line[-1] * 0.9)
        part = next(p for p in shapely.get_parts(free) if p.covers(far))
        assert not part.covers(Point(0, 0))


def test_a_slanting_fence_closes_a_crossing_that_meets_its_corner_at_an_angle() -> None:
    """A square fence leaves a path past it where the corner reaches round the end of the crossing,
    and a slanting one does not."""
    street_map = cross_map()
    slanting = Corner(
        "middle", Polygon([(-2, -2), (2, -2), (2, 6), (-2, 2)]), street_map.corners["middle"].ports
    )
    north = dataclasses.replace(street_map.strips["north"], kind="crossing")
    strips = {**street_map.strips, "north": north}
    street_map = StreetMap("slant", street_map.bounds, strips, {"middle": slanting}, {}, {})
    far = Point(0, 40)

    def reached(fence: Barrier) -> bool:
        free = without_barriers(street_map.walkable, [fence])
        return any(
            part.covers(far) and part.covers(Point(0, -1)) for part in shapely.get_parts(free)
        )

    assert reached(barrier_at(street_map, Port("north", 0)))
    assert not reached(barrier_at(street_map, Port("north", 0), slanting=True))


def test_a_route_on_a_carriageway_is_measured() -> None:
    """20 m of a route lie on a lane that is drawn over its sidewalk; parts on a crossing do not
    count."""
    line = np.array([[10.0, 0.0], [30.0, 0.0]])
    lane = Lane(
        "car_0", "car", "road", line, 3.0, shapely.buffer(LineString(line), 1.5, cap_style="flat")
    )
    street_map = dataclasses.replace(cross_map(), lanes={"car_0": lane})
    route = Polyline([(-30, 0), (38, 0)])
    assert on_road_m(street_map, route, ()) == pytest.approx(20.0, abs=1.0)
    crossing = RouteCrossing(id="c", enter_s_m=50.0, leave_s_m=60.0, signalised=False)
    assert on_road_m(street_map, route, [crossing]) == pytest.approx(9.0, abs=1.0)
    assert on_road_m(cross_map(), route, ()) == 0.0


def turning(street_map: StreetMap, *points: tuple[float, float], cars: bool = True) -> StreetMap:
    """Return the map with a lane inside a junction."""
    line = np.array(points)
    inner = LineString(line).buffer(1.6, cap_style="flat")
    lane = Lane(
        f":j{len(street_map.lanes)}", ":j", "road", line, 3.2, inner, internal=True, cars=cars
    )
    return dataclasses.replace(street_map, lanes={**street_map.lanes, lane.id: lane})


def test_a_route_where_cars_turn_is_measured() -> None:
    """A car path across a route counts for the width of a car and the robot; paths of bicycles and
    paths over crossings do not count."""
    route = Polyline([(-30, 0), (38, 0)])
    across = ((0.0, -9.0), (0.0, 9.0))
    wide_m = COURIER.width_m + 2.0
    assert on_car_paths_m(turning(cross_map(), *across), route, (), COURIER) == pytest.approx(
        wide_m, abs=0.5
    )
    assert on_car_paths_m(turning(cross_map(), *across, cars=False), route, (), COURIER) == 0.0
    crossing = RouteCrossing(id="c", enter_s_m=27.0, leave_s_m=33.0, signalised=False)
    assert on_car_paths_m(turning(cross_map(), *across), route, [crossing], COURIER) == 0.0
    assert on_car_paths_m(turning(cross_map(), (0.0, 2.0), (0.0, 9.0)), route, (), COURIER) == 0.0


@pytest.mark.engine
def test_routes_keep_off_corners_where_cars_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small city has a route, but neither a route nor a curve when cars turn over every
    corner."""
    for builder, tries in ((long_horizon, 12), (unit, 4)):
        monkeypatch.setattr(builder, "TRIES", tries)
    monkeypatch.setattr(long_horizon, "SEARCHES", 3)
    where = City(seed=2, size_m=500.0)
    _, street_map = place(where)
    assert build_long_horizon(where, street_map, WalkGraph(street_map), 0, "plain").crossings
    for corner in street_map.corners.values():
        x0, y0, x1, y1 = corner.polygon.bounds
        street_map = turning(
            street_map, *((x, y) for y in np.arange(y0, y1 + 2.0, 2.0).tolist() for x in (x0, x1))
        )
    with pytest.raises(
        SpecError, match=r"cars turn over the way \(\d+ times\).*corners reach into junctions"
    ):
        build_long_horizon(where, street_map, WalkGraph(street_map), 0, "turned-over")
    with pytest.raises(SpecError, match="cars turn over the way"):
        build_unit("curve", where, street_map, WalkGraph(street_map), 0, "turned-over")


@pytest.mark.engine
def test_routes_keep_off_stairs_and_bridges() -> None:
    """A map with routes has none when every way is one of stairs."""
    where = CityMap(map="sumo-fkk-in")
    street_map = read_map(where)
    assert build_long_horizon(where, street_map, WalkGraph(street_map), 0, "plain").crossings
    steps = {
        name: dataclasses.replace(strip, going="steps") for name, strip in street_map.strips.items()
    }
    street_map = dataclasses.replace(street_map, strips=steps)
    with pytest.raises(SpecError) as caught:
        build_long_horizon(where, street_map, WalkGraph(street_map), 0, "stairs")
    message = str(caught.value)
    assert "the way leads over stairs, a bridge or a tunnel (" in message and "\n" not in message
    assert (
        "every long sidewalk is a stair, a bridge, a tunnel or on a road (1 times)): import "
        "another area" in message
    )


@pytest.mark.engine
def test_routes_keep_off_greens_that_are_too_short() -> None:
    """No route is found when every crossing has a green too short to walk."""
    where = CityMap(map="sumo-fkk-in")
    street_map = read_map(where)
    short = {
        name: dataclasses.replace(strip, short_green=strip.kind == "crossing")
        for name, strip in street_map.strips.items()
    }
    street_map = dataclasses.replace(street_map, strips=short)
    with pytest.raises(SpecError, match="signal whose green is too short to walk"):
        build_long_horizon(where, street_map, WalkGraph(street_map), 0, "short-green")
    assert {name for name, one in short.items() if one.short_green} <= avoided_strips(street_map)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
@pytest.mark.parametrize("name", POLICIES)
def test_every_policy_stays_within_the_limits_of_every_robot(name: str, robot: Robot) -> None:
    """Every shipped policy resets and acts within the robot's limits on an empty street."""
    from cosim.episode.interfaces import Observation

    driver = PolicyCaller(POLICIES[name]())
    Clock.for_rate(driver.manifest.rate_hz)
    route = Polyline([(0, 0), (50, 0)])
    driver.reset("t", 0)
    for tick in range(0, 200, 20):
        known = Privileged(
            RobotState(route.at(tick * 0.05), 1.0),
            route,
            tick * 0.05,
            NO_PEOPLE,
            NO_VEHICLES,
            {},
            (),
            box(-1, -2, 51, 2),
        )
        lidar = driver.manifest.scan
        command = driver.act(
            Observation(
                tick,
                tick * 0.05,
                None,
                1.0,
                0.0,
                robot,
                known,
                goal=PointGoal(10.0, 0.0),
                odometry=Odometry(tick * 0.05, 0.0, 0.0),
                scan=lidar and Scan(np.full((lidar.rings, lidar.rays), np.inf, np.float32), lidar),
            )
        )
        assert 0.0 <= command.v_mps <= robot.v_max_mps and abs(command.w_radps) <= robot.w_max_radps


def test_the_walking_graph_agrees_with_the_branches() -> None:
    """With its branches closed, the graph reaches only the strips of the route."""
    street_map = cross_map()
    graph = WalkGraph(street_map)
    closed = ports_to_close(street_map, [Port("west", 0), Port("east", 0)])
    reach = graph.reach(Port("west", 1), frozenset(closed))
    assert {p.strip for p in reach.ports if np.isfinite(reach.to(p))} == {"west", "east"}
    assert len(closed) == len(set(closed)) == 2


def test_two_pedestrians_of_one_name_are_refused() -> None:
    """The second pedestrian of a group "e0" is "e0-1", so no other event may have this id."""
    one = load_suite("reactive").scenarios[0]
    two = [
        Event(
            id=name,
            kind="queueing",
            x_m=0,
            y_m=0,
            heading_rad=0,
            route_s_m=5,
            half_width_m=2,
            people=2,
        )
        for name in ("e0", "e0-1")
    ]
    assert len(msgspec.structs.replace(one, events=(two[0],)).events[0].names) == 2
    with pytest.raises(SpecError, match="two events have a pedestrian 'e0-1': give one another id"):
        Scenario(**msgspec.structs.asdict(one) | {"events": tuple(two)})

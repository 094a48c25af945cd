"""Obstacles drawn along a way: on sidewalks, with a gap for the robot, outside of people's ways."""

from __future__ import annotations

import math
from functools import cache

import msgspec
import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Point

from cosim.core.errors import SpecError
from cosim.core.state import PERSON_RADIUS_M, RobotState
from cosim.place.barriers import outline, without_barriers
from cosim.place.street_map import StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventReply
from cosim.spec.obstacle import OBSTACLE_SIZES_M, Obstacle, footprint
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City, CrowdSpec, Scenario
from physics.ground.tiles import tiles_touching
from physics.street.furniture import footprints
from physics.street.placement import driveway_ground
from physics.street.street_surface import StreetSurface
from scenarios.suites.long_horizon import build_long_horizon
from scenarios.suites.obstacles import (
    BESIDE_FREE_M,
    ENDS_FREE_M,
    EVENT_FREE_M,
    PER_100M,
    TO_SPARE_M,
    obstacles_along,
    prove_gap,
    with_obstacles,
)
from tests.scenarios.test_scenarios import cross_map

SMALL = City(seed=1, size_m=500.0)
SEEDS = range(4)


def street() -> StreetMap:
    from scenarios.places.nets import place

    return place(SMALL)[1]


@cache
def ways() -> tuple[Scenario, ...]:
    """Return long ways of a small city."""
    graph = WalkGraph(street())
    return tuple(build_long_horizon(SMALL, street(), graph, seed, f"long-{seed}") for seed in SEEDS)


def straight(**changed: object) -> Scenario:
    """Return 30 m of sidewalk 3.2 m wide, with nothing beside it."""
    route = tuple((float(x), 0.0) for x in range(6, 37, 2))
    known: dict[str, object] = {"id": "t", "suite": "t", "place": SMALL, "seed": 0, "route": route}
    ends: dict[str, object] = {"start": (6.0, 0.0, 0.0), "goal": (36.0, 0.0)}
    return Scenario(**known | ends | changed)  # type: ignore[arg-type]


def eroded(scenario: Scenario, street_map: StreetMap) -> list[shapely.Geometry]:
    """Return the ground that is left of the way, computed differently than by the builder: each
    obstacle and each edge is grown."""
    around = shapely.buffer(LineString(scenario.route), 10.0)
    ground = without_barriers(street_map.walkable_near(around), scenario.barriers)
    half_m = 0.5 * (COURIER.width_m + TO_SPARE_M) - 1e-3
    edges = shapely.buffer(shapely.boundary(ground), half_m)
    things = [footprint(one).buffer(half_m) for one in scenario.obstacles]
    return list(
        shapely.get_parts(
            ground.difference(shapely.union_all([edges, *things])).intersection(around)
        )
    )


@pytest.mark.engine
def test_a_gap_is_left_on_every_way() -> None:
    """On random ways start and goal stay connected for a robot 0.5 m wider, and fences across the
    gap are refused."""
    for scenario in ways():
        prove_gap(scenario, street())
        ends = Point(scenario.start[:2]), Point(scenario.goal)
        assert any(all(part.covers(end) for end in ends) for part in eroded(scenario, street())), (
            scenario.id
        )
        x_m, y_m, heading = scenario.route_line.at(4.0)
        across = [
            Obstacle(
                kind="fence",
                form=2,
                heading_rad=heading - 0.5 * np.pi,
                x_m=x_m - left_m * np.sin(heading),
                y_m=y_m + left_m * np.cos(heading),
            )
            for left_m in (-3.0, -1.5, 0.0, 1.5, 3.0)
        ]
        closed = msgspec.structs.replace(scenario, obstacles=(*scenario.obstacles, *across))
        with pytest.raises(SpecError, match=r"leave no gap of 1\.05 m"):
            prove_gap(closed, street())


@pytest.mark.engine
def test_obstacles_stand_on_sidewalks_and_on_nothing_else() -> None:
    """Obstacles lie on the walkable ground of a sidewalk. They overlap neither each other nor
    props, houses, barriers, driveways, corners, crossings, start, goal or events."""
    surface = StreetSurface(street(), SMALL.seed)
    for scenario in ways():
        around = shapely.buffer(LineString(scenario.route), 15.0)
        grounds = [footprint(one) for one in scenario.obstacles]
        sidewalks = [s for s in street().near("strip", around) if s.kind == "sidewalk"]  # type: ignore[union-attr]
        crossings = [s for s in street().near("strip", around) if s.kind == "crossing"]  # type: ignore[union-attr]
        others = [
            *footprints(surface.standing(around)),
            *(house.polygon for key in tiles_touching(around) for house in surface.buildings(key)),
            *(outline(barrier) for barrier in scenario.barriers),
            *(way for strip in sidewalks for way in driveway_ground(strip)),  # type: ignore[arg-type]
            *(piece.polygon for piece in (*crossings, *street().near("corner", around))),
            *(Point(event.x_m, event.y_m).buffer(EVENT_FREE_M - 0.1) for event in scenario.events),
            Point(scenario.start[:2]).buffer(ENDS_FREE_M),
            Point(scenario.goal).buffer(ENDS_FREE_M - 0.01),
        ]
        assert grounds and not len(
            shapely.STRtree(others).query(grounds, predicate="intersects")[0]
        )
        assert all(any(strip.polygon.covers(ground) for strip in sidewalks) for ground in grounds)
        assert not any(one.intersects(two) for k, one in enumerate(grounds) for two in grounds[:k])


@pytest.mark.engine
def test_a_robot_that_follows_the_route_blindly_hits_an_obstacle() -> None:
    """On every way an obstacle overlaps the swept route, the density is in its range, most kinds
    are drawn, and the same seed gives the same obstacles."""
    kinds = set()
    found = 0
    length_m = 0.0
    for scenario in ways():
        swept = shapely.buffer(LineString(scenario.route), COURIER.width_m / 2)
        assert any(footprint(one).intersects(swept) for one in scenario.obstacles), scenario.id
        kinds |= {one.kind for one in scenario.obstacles}
        found = found + len(scenario.obstacles)
        length_m = length_m + scenario.route_line.length_m
    assert 0.4 * PER_100M[0] < 100.0 * found / length_m < PER_100M[1]
    assert len(kinds) >= 6
    again = build_long_horizon(SMALL, street(), WalkGraph(street()), SEEDS[0], "long-0")
    assert again == ways()[0]


@pytest.mark.engine
def test_obstacles_can_be_restricted_to_the_sides_of_the_way() -> None:
    """The band about the middle stays free."""
    found = 0
    for way in ways():
        bare = msgspec.structs.replace(way, obstacles=())
        scenario = with_obstacles(bare, street(), beside=True)
        for one in scenario.obstacles:
            assert footprint(one).distance(LineString(scenario.route)) >= BESIDE_FREE_M - 1e-6
        found += len(scenario.obstacles)
        prove_gap(scenario, street())
    assert found > 3


def test_every_kind_is_drawn_and_narrows_the_way() -> None:
    """On a sidewalk 3.2 m wide each kind is drawn, and construction sites leave the gap."""
    kinds = set()
    sites = 0
    for seed in range(25):
        obstacles = obstacles_along(
            straight(), cross_map(), np.random.default_rng(seed), per_100m=15.0
        )
        prove_gap(straight(obstacles=obstacles), cross_map())
        kinds |= {one.kind for one in obstacles}
        fences = [footprint(one) for one in obstacles if one.kind == "fence"]
        if fences:
            sites += 1
            wide_m = shapely.union_all(fences).bounds[3] - shapely.union_all(fences).bounds[1]
            assert 1.0 <= wide_m <= 3.2 - (COURIER.width_m + TO_SPARE_M)
    assert kinds == set(OBSTACLE_SIZES_M) and sites >= 2


def test_a_way_no_wider_than_the_gap_gets_no_obstacles() -> None:
    """A way on which the robot could not pass an obstacle has none."""
    wide = cross_map()
    narrow = msgspec.structs.replace(straight(), robot="courier")
    thin = {name: _thinner(strip) for name, strip in wide.strips.items()}
    street_map = StreetMap("thin", wide.bounds, thin, wide.corners, {}, {})
    assert obstacles_along(narrow, street_map, np.random.default_rng(0), per_100m=8.0) == ()
    assert obstacles_along(narrow, wide, np.random.default_rng(0), per_100m=8.0) != ()


def _thinner(strip):  # type: ignore[no-untyped-def]
    import dataclasses

    polygon = shapely.buffer(LineString(strip.line), 0.5, cap_style="flat")
    return dataclasses.replace(strip, width_m=1.0, polygon=polygon)


@pytest.mark.engine
def test_people_walk_round_obstacles() -> None:
    """People who walk over a place without obstacles walk round bins at that place."""
    from scenarios.episodes.wiring import crowd_of

    def tracks(scenario: Scenario) -> dict[str, list[tuple[float, float]]]:
        found: dict[str, list[tuple[float, float]]] = {}
        reply = EventReply(episode="t", tick=0, states=(), actors=())
        with crowd_of(scenario) as crowd:
            for _ in range(40):
                people = crowd.step(RobotState(scenario.start_pose), reply).people
                for name, (x_m, y_m) in zip(people.ids, people.xy.tolist(), strict=True):
                    found.setdefault(name, []).append((x_m, y_m))
        return found

    bare = msgspec.structs.replace(ways()[0], obstacles=(), crowd=CrowdSpec(persons=25, vehicles=0))
    before = tracks(bare)
    inside = shapely.buffer(street().walkable, -0.8)
    spots: list[tuple[float, float]] = []
    for track in before.values():
        walks = len(track) == 40 and math.dist(track[0], track[-1]) > 2.0
        at = track[min(24, len(track) - 1)]
        if (
            walks
            and shapely.contains_xy(inside, *at)
            and all(math.dist(at, other) > 4.0 for other in spots)
        ):
            spots.append(at)
    bins = tuple(Obstacle(kind="bin", x_m=x, y_m=y, heading_rad=0.0) for x, y in spots)
    after = tracks(msgspec.structs.replace(bare, obstacles=bins))
    ground = shapely.union_all([footprint(one) for one in bins])

    def nearest_m(found: dict[str, list[tuple[float, float]]]) -> float:
        late = [at for track in found.values() for at in track if len(track) == 40]
        free = [at for at in late if at not in {track[0] for track in found.values()}]
        return float(shapely.distance(shapely.points(free), ground).min())

    assert len(bins) >= 3 and nearest_m(before) == 0.0
    assert nearest_m(after) > PERSON_RADIUS_M - 0.06

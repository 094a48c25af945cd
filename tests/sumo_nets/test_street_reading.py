"""Queries of SUMO at every tick, and results that need none, in a small city."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Polyline, Pose, heading_to_sumo
from cosim.core.state import RobotState
from cosim.place.street_map import StreetMap
from cosim.spec.events import EventReply
from cosim.spec.scenario import City, CrowdSpec
from sumo_nets.city.store import city_net
from sumo_nets.crowd.crowd import SumoCrowd
from sumo_nets.crowd.lights import WaitingSpots
from sumo_nets.crowd.proxy import KEEP_ROUTE, KEEP_ROUTE_ON_ROAD, LEAD_MIN_M, MATCH_M, Walks
from sumo_nets.engine import NearReader, libsumo, sumo, sumo_errors
from sumo_nets.net.snapshot import street_map_of

CITY = City(seed=2, size_m=600.0)


@pytest.fixture(scope="module")
def street_map() -> StreetMap:
    return street_map_of(city_net(CITY))


@pytest.fixture(scope="module")
def crowd(street_map: StreetMap) -> Iterator[SumoCrowd]:
    """Run fifty persons and twelve vehicles in the middle of the city for half a second."""
    x0, y0, x1, y1 = street_map.bounds
    middle = Pose((x0 + x1) / 2, (y0 + y1) / 2, 0.0)
    spec = CrowdSpec(persons=50, radius_m=80.0, vehicles=12)
    with SumoCrowd(city_net(CITY), street_map, spec, 3, frozenset(), middle[:2]) as running:
        for tick in range(10):
            running.step(
                RobotState(middle), EventReply(episode="", tick=tick, states=(), actors=())
            )
        yield running


@pytest.mark.engine
def test_near_persons_and_vehicles_are_those_within_the_radius(crowd: SumoCrowd) -> None:
    """A query returns exactly the persons and vehicles within its radius."""
    x_m, y_m = crowd.street.people.xy.mean(axis=0).tolist()
    ours = set(sumo.person.getIDList()[::2])
    reader = NearReader(ours)
    for reach_m in (60.0, 75.0, 500.0):
        near, _ = reader.near(x_m, y_m, reach_m, 100.0)
        away_m = {name: math.dist(sumo.person.getPosition(name), (x_m, y_m)) for name in ours}
        assert list(near.names) == sorted(
            name for name, far_m in away_m.items() if far_m <= reach_m
        )
        for k, name in enumerate(near.names):
            assert tuple(near.xy[k]) == sumo.person.getPosition(name) and near.mps[
                k
            ] == sumo.person.getSpeed(name)
            assert near.ahead[k] == sumo.person.getNextEdge(name)
    assert 0 < len(reader.near(x_m, y_m, 60.0, 100.0)[0].names) < len(near.names) == len(ours)
    _, cars = reader.near(x_m, y_m, 60.0, 100.0)
    assert (
        0
        < len(cars.names)
        <= len(reader.near(x_m, y_m, 60.0, 1000.0)[1].names)
        == len(sumo.vehicle.getIDList())
    )
    assert np.hypot(*(cars.xy - (x_m, y_m)).T).max() <= 100.0


@pytest.mark.engine
def test_the_people_shown_are_those_that_sumo_lists(crowd: SumoCrowd) -> None:
    """At each of 60 ticks, in which people arrive and enter, exactly SUMO's persons are shown."""
    at = Pose(*crowd.street.people.xy.mean(axis=0).tolist(), 0.0)
    shown = []
    for _ in range(60):
        reply = EventReply(episode="", tick=crowd.street.tick, states=(), actors=())
        street = crowd.step(RobotState(at), reply, absent=True)
        listed = [name for name in sumo.person.getIDList() if name[0] == "c"]
        assert list(street.people.ids) == sorted(
            name for name in listed if math.dist(sumo.person.getPosition(name), at[:2]) <= 100.0
        )
        shown.append(street.people.ids)
    assert len(set(shown)) > 1


@pytest.mark.engine
def test_a_lead_from_near_lines_equals_the_lead_from_all_lines(
    crowd: SumoCrowd, street_map: StreetMap
) -> None:
    """Within LOCAL_M of a point, the lines near it give the same lead as all lines."""
    walks = Walks(sumo, street_map)
    rng = np.random.default_rng(6)
    sidewalks = [strip for strip in street_map.strips.values() if strip.kind == "sidewalk"]
    compared = 0
    for strip in sidewalks[:40]:
        middle = Polyline(strip.line).at(rng.uniform(0.0, strip.length_m))
        walk = walks.choose(strip.id, middle)
        if walk is not None:
            lead = walks.lead.around(walk.first, walk.second, *middle[:2])
            for _ in range(5):
                x_m, y_m = (np.array(middle[:2]) + rng.uniform(-3.5, 3.5, 2)).tolist()
                expected_m = walks.lead.metres(walk.first, walk.second, x_m, y_m)
                assert lead.metres(x_m, y_m) == pytest.approx(expected_m, abs=1e-9)
                compared += 1
    assert compared >= 50


@pytest.mark.engine
def test_on_a_sidewalk_car_lanes_do_not_change_the_matched_lane(
    crowd: SumoCrowd, street_map: StreetMap
) -> None:
    """Where a sidewalk leads, a body gets the same lane and place whether SUMO compares car lanes
    or not; elsewhere it may not."""
    walks = Walks(sumo, street_map)
    rng = np.random.default_rng(4)
    sidewalks = [strip for strip in street_map.strips.values() if strip.kind == "sidewalk"]
    same: dict[bool, list[bool]] = {True: [], False: []}
    for k in range(120):
        strip = sidewalks[int(rng.integers(len(sidewalks)))]
        middle = Polyline(strip.line).at(rng.uniform(0.0, strip.length_m))
        left_m, x_m, y_m = rng.uniform(-2.5, 2.5), *middle[:2]
        x_m = x_m - left_m * math.sin(middle.heading_rad)
        y_m = y_m + left_m * math.cos(middle.heading_rad)
        walk = walks.choose(strip.id, Pose(x_m, y_m, middle.heading_rad))
        if walk is None:
            continue
        inside = shapely.contains_xy(strip.polygon, x_m, y_m)
        leads = bool(inside) and walks.lead.metres(walk.first, walk.second, x_m, y_m) > LEAD_MIN_M
        names = {mode: f"p{k}.{mode}" for mode in (KEEP_ROUTE, KEEP_ROUTE_ON_ROAD)}
        for name in names.values():
            sumo.person.add(name, walk.first, 1.0)
            sumo.person.appendWalkingStage(name, [walk.first, walk.second], 1.0)
        for _ in range(2):
            for mode, name in names.items():
                sumo.person.moveToXY(
                    name, "", x_m, y_m, heading_to_sumo(middle.heading_rad), mode, MATCH_M
                )
            sumo.simulationStep()
        placed = [
            (sumo.person.getRoadID(name), sumo.person.getLanePosition(name))
            for name in names.values()
        ]
        same[leads].append(placed[0] == placed[1])
        for name in names.values():
            sumo.person.remove(name)
    assert len(same[True]) > 30 and all(same[True])
    assert not all(same[False])


@pytest.mark.engine
def test_waiting_spots_lie_on_the_nearest_corner(street_map: StreetMap) -> None:
    """A waiting spot before a crossing lies on its nearest corner."""
    kerbs = WaitingSpots(street_map)
    rng = np.random.default_rng(5)
    crossings = [
        strip
        for strip in street_map.strips.values()
        if strip.kind == "crossing" and all(strip.corners)
    ][:12]
    ends = np.array([strip.line[k, :2] for strip in crossings for k in (0, -1)])
    names = [strip.id for strip in crossings for _ in (0, 1)]
    at = ends + rng.uniform(-1.5, 1.5, ends.shape)
    spots = kerbs.behind(names, at)
    for name, wanted, spot in zip(names, at, spots, strict=True):
        assert np.array_equal(WaitingSpots(street_map).behind([name], wanted[None])[0], spot)
        corners = [
            street_map.corners[str(corner)].polygon for corner in street_map.strips[name].corners
        ]
        corner = min(corners, key=lambda corner: shapely.distance(corner, shapely.Point(wanted)))
        assert shapely.dwithin(corner, shapely.Point(spot), 1e-6)
    stays = (spots == at).all(axis=1)
    assert stays.any() and not stays.all()
    assert np.array_equal(kerbs.behind(names, spots)[stays], spots[stays])


@pytest.mark.engine
def test_a_person_removed_while_another_is_loaded_is_not_read(crowd: SumoCrowd) -> None:
    """Only persons on the street are read, also where others enter later."""
    x_m, y_m = crowd.street.people.xy.mean(axis=0).tolist()
    reader = NearReader({"first", "second"})
    edge = sumo.person.getRoadID(crowd.street.people.ids[0])

    def read() -> tuple[str, ...]:
        sumo.simulationStep()
        return reader.near(x_m, y_m, 1e5, 1.0)[0].names

    try:
        for name in ("first", "second"):
            depart_s = sumo.simulation.getTime() if name == "first" else 1e6
            libsumo.person.add(name, edge, 1.0, depart=depart_s)
            sumo.person.appendWalkingStage(name, [edge], 2.0, speed=0.001)
            if name == "first":
                assert read() == ("first",)
                sumo.person.remove("first")
        assert read() == ()
    finally:
        with sumo_errors("removing a person"):
            sumo.person.remove("second")

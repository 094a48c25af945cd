"""The robot among vehicles, on a road of 8 m with one crossing, worked out by hand."""

from __future__ import annotations

from dataclasses import fields, replace
from types import MappingProxyType

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Pose
from cosim.core.state import STILL, Motion, People, RobotState, Signal, Street, Vehicles
from cosim.episode.loop import Step
from cosim.place.street_map import Corner, Lane, Located, StreetMap, Strip
from cosim.results.traffic import RoadState, TrafficMonitor, vehicles_braking_for
from cosim.spec.events import EventReply

LINE = np.array([[20.0, -4.0], [20.0, 4.0]])
CROSSING = Strip(
    ":j_c0",
    "crossing",
    LINE,
    4.0,
    shapely.box(18.0, -4.0, 22.0, 4.0),
    (None, None),
    signalised=True,
)
LANE = Lane(
    "r_0",
    "r",
    "road",
    np.array([[-50.0, 0.0], [50.0, 0.0]]),
    8.0,
    shapely.box(-50.0, -4.0, 50.0, 4.0),
)
MAP = StreetMap("m", (-50.0, -9.0, 50.0, 9.0), {":j_c0": CROSSING}, {}, {"r_0": LANE}, {})


def street(speed_mps: float, walk: bool | None = None, people: People | None = None) -> Street:
    """A street with a car whose bumper is at x = 2, heading east, and a crossing signal, None for
    unsignalised."""
    car = Vehicles.of(("v0",), [[0.0, 0.0]], [0.0], [speed_mps], [[4.0, 2.0]])
    signals = {} if walk is None else {":j_c0": Signal(walk)}
    return Street(
        0,
        People.of((), [], [], [], ()) if people is None else people,
        car,
        MappingProxyType(signals),
    )


def step(tick: int, x_m: float, y_m: float, before: Street, after: Street) -> Step:
    robot = RobotState(Pose(x_m, y_m, 0.0))
    reply = EventReply(episode="", tick=tick, states=(), actors=())
    return Step(
        tick, robot, before, 0.0, None, STILL, reply, Motion(robot, np.zeros((1, 3))), after, 0.0
    )


@pytest.mark.parametrize(
    ("x_m", "y_m", "walk", "on_road"),
    [
        (10.0, 0.0, True, True),
        (20.0, 0.0, True, False),
        (20.0, 0.0, False, True),
        (20.0, 0.0, None, False),
        (10.0, 6.0, True, False),
    ],
)
def test_the_carriageway_is_the_road_and_the_red_crossing(
    x_m: float, y_m: float, walk: bool | None, on_road: bool
) -> None:
    """On the road, on a green, a red and an unsignalised crossing, and beside the road."""
    after = street(8.0, walk)
    assert TrafficMonitor(MAP, 0.05).update(step(0, x_m, y_m, after, after)).carriageway is on_road


def test_a_vehicle_that_brakes_for_the_robot_counts_once() -> None:
    """A car that brakes at 3 m/s2 before a robot on the road counts at the first tick, and again
    after two seconds."""
    roadway = TrafficMonitor(MAP, 0.05)
    ticks = (0, 1, 2, 60)
    seen = [roadway.update(step(tick, 12.0, 0.5, street(8.0), street(7.85))) for tick in ticks]
    assert seen == [RoadState(True, 1), RoadState(True, 0), RoadState(True, 0), RoadState(True, 1)]


def test_only_hard_braking_for_a_robot_next_in_the_way_counts() -> None:
    """1 m/s2, a robot aside or behind, and a nearer person do not count."""
    robot = Pose(12.0, 0.5, 0.0)
    person = People.of(("c0",), [[8.0, 0.0]], [0.0], [1.0], ("walk",))
    assert vehicles_braking_for(robot, street(8.0), street(7.85), 0.05) == ["v0"]
    assert vehicles_braking_for(robot, street(8.0), street(7.95), 0.05) == []
    assert vehicles_braking_for(Pose(12.0, 3.0, 0.0), street(8.0), street(7.85), 0.05) == []
    assert vehicles_braking_for(Pose(-9.0, 0.0, 0.0), street(8.0), street(7.85), 0.05) == []
    assert vehicles_braking_for(robot, street(8.0), street(7.85, people=person), 0.05) == []


def test_braking_counts_at_a_red_crossing_only() -> None:
    """Cars that stop while the robot crosses at green stop for their own light, and at red for the
    robot."""
    for walk, braked in ((True, 0), (False, 1)):
        seen = TrafficMonitor(MAP, 0.05).update(
            step(0, 20.0, 0.5, street(8.0, walk), street(7.8, walk))
        )
        assert seen.braked == braked


def test_cached_lookups_on_the_sidewalk_equal_fresh_ones() -> None:
    """A walk over sidewalk, corner and crossing, at red and green, gives the answers of a new
    instance."""
    side = Strip(
        "s",
        "sidewalk",
        np.array([[0.0, 6.0], [40.0, 6.0]]),
        4.4,
        shapely.box(0.0, 3.8, 40.0, 8.2),
        (None, None),
    )
    corner = Corner("w", shapely.box(16.0, 3.0, 24.0, 9.0), ())
    street_map = StreetMap("m", MAP.bounds, {"s": side, **MAP.strips}, {"w": corner}, MAP.lanes, {})
    looks: list[tuple[float, float]] = []

    class Counted(StreetMap):
        def locate(self, x_m: float, y_m: float, slack_m: float = 0.8) -> Located:
            looks.append((x_m, y_m))
            return super().locate(x_m, y_m, slack_m)

    counted = Counted(**{f.name: getattr(street_map, f.name) for f in fields(street_map) if f.init})
    cached = TrafficMonitor(counted, 0.05)
    rng = np.random.default_rng(4)
    walk = np.concatenate(
        [
            np.column_stack([np.linspace(1.0, 15.0, 100), np.full(100, 6.0)]),
            rng.uniform((0, -5), (40, 9), (2000, 2)),
        ]
    )
    for tick, (x_m, y_m) in enumerate(walk.tolist()):
        after = street(7.7, tick % 2 == 0)
        this = step(100 * tick, x_m, y_m, street(8.0, tick % 2 == 0), after)
        assert cached.update(this) == TrafficMonitor(street_map, 0.05).update(this)
        if tick == 99:
            assert len(looks) == 1


def test_a_robot_on_the_kerb_before_a_red_crossing_is_not_on_the_road() -> None:
    """The crossing's ground extends half a metre beyond its line, but only its line is road."""
    seamed = replace(CROSSING, polygon=shapely.box(18.0, -4.5, 22.0, 4.5))
    street_map = StreetMap("m", MAP.bounds, {":j_c0": seamed}, {}, {}, {})
    after = street(0.0, walk=False)
    seen = [
        TrafficMonitor(street_map, 0.05).update(step(0, 20.0, y_m, after, after)).carriageway
        for y_m in (4.3, 3.9, -4.3)
    ]
    assert seen == [False, True, False]

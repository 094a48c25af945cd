"""Vehicles brake for a robot on corners that their paths cross."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Pose, boxes_overlap
from cosim.core.state import RobotState
from cosim.place.car_paths import paths_near
from cosim.place.street_map import StreetMap
from cosim.spec.events import EventReply
from cosim.spec.scenario import City, CityMap, CrowdSpec, Place
from scenarios.places.nets import place
from sumo_nets.crowd.crowd import SumoCrowd

pytestmark = pytest.mark.engine

HALF_M = np.array([0.35, 0.275])


def middle_of_car_path(street_map: StreetMap, corner: str) -> Pose:
    """Return the middle of the longest path of cars over a corner."""
    ground = street_map.corners[corner].polygon
    lines = [line.intersection(ground) for line in paths_near(street_map, ground)]
    longest = max(lines, key=lambda line: line.length)
    x_m, y_m = shapely.line_interpolate_point(longest, 0.5, normalized=True).coords[0]
    return Pose(x_m, y_m, 0.3)


@pytest.mark.parametrize(
    ("where", "corner"),
    [
        pytest.param(City(seed=1), ":n10x11_w1", id="city"),
        pytest.param(CityMap(map="braunschweig-2"), ":34677738_w0", id="imported"),
    ],
)
def test_vehicles_stop_before_a_robot_on_a_corner_that_they_cross(
    where: Place, corner: str
) -> None:
    """Two vehicles drive over a spot without a robot, none while a robot is there as long, and
    again after it has left."""
    net, street_map = place(where)
    spot = middle_of_car_path(street_map, corner)
    assert street_map.locate(*spot[:2]).edge == corner
    over: dict[str, int] = {}
    crowd_spec = CrowdSpec(persons=0, vehicles=40)

    def drive(robot: Pose, ticks: int, absent: bool = False) -> None:
        over.clear()
        for _ in range(ticks):
            if absent and len(over) >= 2:
                break
            reply = EventReply(episode="t", tick=crowd.street.tick, states=(), actors=())
            cars = crowd.step(RobotState(robot), reply, absent=absent).vehicles
            boxes = np.column_stack([cars.xy, cars.heading])
            hit = boxes_overlap(np.array(spot), HALF_M, boxes, cars.size / 2)
            over.update((cars.ids[i], crowd.street.tick) for i in np.flatnonzero(hit).tolist())

    with SumoCrowd(net, street_map, crowd_spec, 7, frozenset(), spot[:2]) as crowd:
        drive(spot, 1200, absent=True)
        assert len(over) >= 2
        last = crowd.street.tick
    with SumoCrowd(net, street_map, crowd_spec, 7, frozenset(), spot[:2]) as crowd:
        drive(spot, max(last, 300))
        assert not {name for name, tick in over.items() if tick > 40}  # those that were there
        drive(spot, 600, absent=True)
        assert over

"""Where a robot waits before a crossing: outside the paths of turning cars."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Polyline
from cosim.place.car_paths import CAR_WIDTH_M, STOP_SHORT_M, waits_before
from cosim.place.street_map import Lane, StreetMap
from cosim.spec.robot import COURIER
from cosim.spec.scenario import RouteCrossing
from tests.support.tiny_street import tiny_map

ROUTE = Polyline([(-20.0, 5.0), (0.0, 5.0), (0.0, -6.5)])
CROSSING = RouteCrossing(id=":c0", enter_s_m=21.5, leave_s_m=28.5, signalised=True)


def street_with_turning_car(y_m: float) -> StreetMap:
    """Return the street where a car turns over the northern corner, along x at y."""
    line = np.array([[-4.0, y_m], [4.0, y_m]])
    polygon = shapely.LineString(line).buffer(1.6, cap_style="flat")
    turn = Lane(":t_0", ":t", "road", line, 3.2, polygon, internal=True)
    street = tiny_map()
    return dataclasses.replace(street, lanes=street.lanes | {turn.id: turn})


def test_a_robot_waits_directly_before_a_crossing_where_no_car_turns() -> None:
    """Its front has the usual distance from the crossing."""
    (wait_m,) = waits_before(tiny_map(), ROUTE, (CROSSING,), COURIER)
    assert wait_m == pytest.approx(21.5 - COURIER.length_m / 2 - STOP_SHORT_M)


def test_a_robot_waits_outside_the_path_of_a_car_that_turns_over_the_corner() -> None:
    """It has a gap to the car's path, and still counts as waiting at the crossing."""
    (wait_m,) = waits_before(street_with_turning_car(3.6), ROUTE, (CROSSING,), COURIER)
    path = shapely.LineString([(-4.0, 3.6), (4.0, 3.6)]).buffer(CAR_WIDTH_M / 2)
    pose = ROUTE.at(wait_m)
    body = shapely.Point(pose.xy).buffer(COURIER.width_m / 2)
    assert 21.5 - 4.0 < wait_m < 21.5 - COURIER.length_m / 2 - STOP_SHORT_M
    assert body.distance(path) > 0.0

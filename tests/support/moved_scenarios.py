"""Scenarios in the frame of another map of the same street."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import wrap_angle
from cosim.place.street_map import StreetMap
from cosim.spec.scenario import CityMap, Scenario

Move = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def moved_scenario(scenario: Scenario, name: str, street_map: StreetMap, move: Move) -> Scenario:
    """Return the same scenario on the map `name`, whose net is `street_map`. move: points (N, 2) of
    the scenario's map to points of the other one; a rotation and a shift."""
    (x0, y0), (x1, y1) = move(np.array([[0.0, 0.0], [1.0, 0.0]]))
    turn = float(np.arctan2(y1 - y0, x1 - x0))
    route = tuple((float(x), float(y)) for x, y in move(np.array(scenario.route)))
    obstacles = []
    for one in scenario.obstacles:
        ((x, y),) = move(np.array([[one.x_m, one.y_m]]))
        heading = wrap_angle(one.heading_rad + turn)
        obstacles.append(
            msgspec.structs.replace(one, x_m=float(x), y_m=float(y), heading_rad=heading)
        )
    line = shapely.LineString(route)
    crossings = []
    for crossing in scenario.crossings:
        middle = line.interpolate(0.5 * (crossing.enter_s_m + crossing.leave_s_m))
        (strip,) = (
            strip
            for strip in street_map.strips.values()
            if strip.kind == "crossing" and strip.polygon.contains(middle)
        )
        crossings.append(msgspec.structs.replace(crossing, id=strip.id))
    assert not scenario.events and not scenario.barriers
    return msgspec.structs.replace(
        scenario,
        place=CityMap(map=name, net_hash=street_map.net_hash),
        start=(*route[0], wrap_angle(scenario.start[2] + turn)),
        goal=route[-1],
        route=route,
        obstacles=tuple(obstacles),
        crossings=tuple(crossings),
    )

"""Paths of cars inside junctions, the corners that they cross, and where to wait outside them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from cosim.core.geometry import Floats, Polyline
from cosim.place import overlay
from cosim.place.street_map import Lane, StreetMap, Strip
from cosim.spec.robot import Robot
from cosim.spec.scenario import RouteCrossing

CAR_WIDTH_M = 2.0
"""Width of the widest vehicle in metres."""
_NEAR_M = 4.0
"""Distance in metres beyond which a car path is ignored."""
_SLIVER_M = 0.5
"""Width in metres below which crossed ground is ignored: the rim of a corner."""

STOP_SHORT_M = 0.55
"""Distance in metres between the robot's front and a crossing at which it waits."""
_WAIT_WITHIN_M = 3.8
"""Largest distance in metres of a waiting robot's centre from a crossing. Up to 4 m before a red
one, waiting counts as lawful."""
_BESIDE_CAR_M = 0.4
"""Gap in metres between a waiting robot and the paths of turning cars, whose rear cuts corners."""
_STEP_M = 0.1


def paths_near(street_map: StreetMap, area: shapely.Geometry) -> list[shapely.LineString]:
    """Return the centre lines of car paths inside junctions near an area."""
    lanes = [lane for lane in street_map.near("lane", area) if isinstance(lane, Lane)]
    inner = [lane for lane in lanes if lane.internal and lane.cars and lane.kind == "road"]
    return [shapely.LineString(lane.line[:, :2]) for lane in inner]


def distance_to_car_paths_m(street_map: StreetMap, xy: Floats) -> Floats:
    """Return the distance of (N, 2) points along a way to the nearest car path, (N,) metres.

    It is inf beyond 4 m.
    """
    far_m = np.full(len(xy), np.inf)
    if len(xy) < 2:
        return far_m
    lines = paths_near(street_map, shapely.buffer(shapely.LineString(xy), _NEAR_M, quad_segs=2))
    if lines:
        points = np.asarray(shapely.points(xy), dtype=object)
        near, gap_m = shapely.STRtree(lines).query_nearest(
            points, max_distance=_NEAR_M, return_distance=True, all_matches=False
        )
        far_m[near[0]] = gap_m
    return far_m


def corners_driven_over(street_map: StreetMap) -> dict[str, shapely.Geometry]:
    """Return the ground that cars drive over at each corner, without crossings."""
    found = {}
    for name, corner in street_map.corners.items():
        lines = paths_near(street_map, corner.polygon)
        if not lines:
            continue
        driven = overlay.union_all(
            shapely.buffer(np.array(lines), CAR_WIDTH_M / 2.0, cap_style="flat").tolist()
        )
        crossings = [
            strip.polygon
            for strip in street_map.near("strip", corner.polygon)
            if isinstance(strip, Strip) and strip.kind == "crossing"
        ]
        ground = overlay.intersection(corner.polygon, driven)
        ground = overlay.difference(ground, overlay.union_all(crossings)) if crossings else ground
        if not shapely.is_empty(shapely.buffer(ground, -_SLIVER_M / 2.0)):
            found[name] = ground
    return found


def waits_before(
    street_map: StreetMap, route: Polyline, crossings: Sequence[RouteCrossing], robot: Robot
) -> tuple[float, ...]:
    """Return for each crossing of a route the arc length in metres at which a robot waits before
    it.

    It is the nearest place to the crossing that no turning car drives over, else the place farthest
    from their paths.
    """
    found = []
    left_m = 0.0
    for crossing in crossings:
        last_m = crossing.enter_s_m - 0.5 * robot.length_m - STOP_SHORT_M
        first_m = max(crossing.enter_s_m - _WAIT_WITHIN_M, min(left_m, last_m))
        s_m = np.arange(last_m, first_m - 1e-9, -_STEP_M)
        gap_m = _gap_to_cars_m(street_map, route, s_m, robot)
        clear = np.flatnonzero(gap_m >= _BESIDE_CAR_M)
        found.append(float(s_m[clear[0] if len(clear) else int(np.argmax(gap_m))]))
        left_m = crossing.leave_s_m + 0.5 * robot.length_m
    return tuple(found)


def _gap_to_cars_m(street_map: StreetMap, route: Polyline, s_m: Floats, robot: Robot) -> Floats:
    """Return the gap in metres, (N,), from a robot at arc lengths (N,) to cars inside junctions."""
    poses = [route.at(max(s, 0.0)) for s in s_m.tolist()]
    half_m = 0.5 * robot.length_m
    bodies = [
        shapely.LineString(
            [
                (x - half_m * np.cos(a), y - half_m * np.sin(a)),
                (x + half_m * np.cos(a), y + half_m * np.sin(a)),
            ]
        )
        for x, y, a in poses
    ]
    paths = paths_near(street_map, shapely.buffer(shapely.union_all(bodies), _NEAR_M))
    if not paths:
        return np.full(len(s_m), np.inf)
    gap_m: Floats = shapely.distance(np.array(bodies, dtype=object), shapely.union_all(paths))
    return gap_m - 0.5 * (CAR_WIDTH_M + robot.width_m)

"""Paths of cars inside junctions, and the corners that they cross."""

from __future__ import annotations

import numpy as np
import shapely

from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.street_map import Lane, StreetMap, Strip

CAR_WIDTH_M = 2.0
"""Width of the widest vehicle in metres."""
_NEAR_M = 4.0
"""Distance in metres beyond which a car path is ignored."""
_SLIVER_M = 0.5
"""Width in metres below which crossed ground is ignored: the rim of a corner."""


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

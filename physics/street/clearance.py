"""The free width of sidewalks on the final geometry: what their outlines and the props on them
leave around the middle.

Measured on lines across the sidewalk, cut by its outline and by the footprints of props: every
quarter of a metre and at every corner of a footprint.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Polyline
from cosim.place.street_map import Strip
from physics.street.furniture import Prop, footprints
from physics.street.placement import driveway_ground

STATION_M: Final = 0.25
_AT_ONCE: Final = 400_000
"""Pairs of lines across and corners of outlines that are looked at in one piece, to bound the
memory."""


def clear_width(
    strips: Iterable[Strip], props: Sequence[Prop]
) -> Mapping[str, tuple[float, float]]:
    """For each sidewalk the least width in metres that is free on both sides of its middle line: as
    it is, and as it would be without props. 0 where the middle itself is not free."""
    ground = footprints(props)
    tree = shapely.STRtree(ground)
    found = {}
    for strip in strips:
        line = Polyline(strip.line[:, :2])
        near = ground[np.sort(tree.query(strip.polygon, predicate="intersects"))]
        corners = shapely.points(shapely.get_coordinates(near))
        stations = np.concatenate(
            [
                np.linspace(0.0, line.length_m, max(int(line.length_m / STATION_M), 1) + 1)[1:-1],
                np.asarray(
                    shapely.line_locate_point(shapely.linestrings(line.points), corners),
                    dtype=float,
                ),
            ]
        )
        if not len(stations):
            stations = np.array([0.5 * line.length_m])
        middles, aside = _across(line, stations)
        reach = 0.5 * strip.width_m + 0.5
        left, right, within = _gaps(middles, aside, [strip.polygon], reach)
        bare = np.where(within, left + right, 0.0)
        free = bare
        if len(near):
            nearer_left, nearer_right, _ = _gaps(middles, aside, near, reach)
            free = np.minimum(left, nearer_left) + np.minimum(right, nearer_right)
            on_prop = shapely.intersects_xy(shapely.union_all(near), *middles.T)
            free = np.where(within & ~on_prop, free, 0.0)
        found[strip.id] = float(free.min()), float(bare.min())
    return found


def on_driveways(strips: Iterable[Strip], props: Sequence[Prop]) -> list[str]:
    """Ids of the props that stand on a driveway or the flares of its ramp; cars, which belong
    there, apart."""
    still = [prop for prop in props if prop.kind != "car"]
    ways = [way for strip in strips for way in driveway_ground(strip)]
    hit, _ = shapely.STRtree(ways).query(footprints(still), predicate="intersects")
    return [still[i].id for i in np.unique(hit)]


def _across(line: Polyline, stations_m: Floats) -> tuple[Floats, Floats]:
    """(N, 2) points at arc lengths and (N, 2) unit vectors to their left."""
    segment = np.clip(np.searchsorted(line.s_m, stations_m, side="right") - 1, 0, len(line.s_m) - 2)
    steps = np.diff(line.points, axis=0)
    along = steps / np.hypot(*steps.T)[:, None]
    middles = line.points[segment] + (stations_m - line.s_m[segment])[:, None] * along[segment]
    return middles, np.column_stack([-along[segment, 1], along[segment, 0]])


def _gaps(
    middles: Floats,
    aside: Floats,
    polygons: Sequence[shapely.Geometry] | NDArray[np.object_],
    reach_m: float,
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """(N,) distances from points to the first side of a polygon to their left and right, at most
    `reach_m`; and whether a point lies within: an odd number of sides to its left."""
    corners, ring = shapely.get_coordinates(
        shapely.get_rings(np.asarray(polygons, dtype=object)), return_index=True
    )
    corners, at = corners - middles[0], middles - middles[0]
    along = np.column_stack([aside[:, 1], -aside[:, 0]])
    left, right = np.full(len(middles), reach_m), np.full(len(middles), reach_m)
    to_the_left = np.zeros(len(middles), dtype=int)
    step = max(_AT_ONCE // max(len(corners), 1), 1)
    for i in range(0, len(middles), step):
        rows = slice(i, i + step)
        ahead = along[rows] @ corners.T - (along[rows] * at[rows]).sum(axis=1)[:, None]
        is_ahead = ahead > 0.0
        line, side = np.nonzero((is_ahead[:, 1:] != is_ahead[:, :-1]) & (ring[1:] == ring[:-1]))
        u0 = ahead[line, side]
        u1 = ahead[line, side + 1]
        line += i
        v0 = ((corners[side] - at[line]) * aside[line]).sum(axis=1)
        v1 = ((corners[side + 1] - at[line]) * aside[line]).sum(axis=1)
        gap = v0 - u0 * (v1 - v0) / (u1 - u0)
        is_left = gap > 0.0
        np.minimum.at(left, line[is_left], gap[is_left])
        np.minimum.at(right, line[~is_left], -gap[~is_left])
        np.add.at(to_the_left, line[is_left], 1)
    return left, right, to_the_left % 2 == 1

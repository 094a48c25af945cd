"""Measurement of the free width of sidewalks between their outlines and props.

Cross-sections are taken every quarter of a metre and at each corner of a prop's footprint.
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
"""Distance between cross-sections in metres."""

_BATCH_PAIRS: Final = 400_000
"""Pairs of cross-sections and outline corners per batch; limits memory."""


def clear_widths(
    strips: Iterable[Strip], props: Sequence[Prop]
) -> Mapping[str, tuple[float, float]]:
    """Return the smallest free width of each sidewalk around its centre line.

    Returns: sidewalk id -> (width with props, width without props) in metres; 0 if the centre line
        itself is blocked
    """
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
        middles, aside = _cross_sections(line, stations)
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


def props_on_driveways(strips: Iterable[Strip], props: Sequence[Prop]) -> list[str]:
    """Return the ids of props, except cars, on a driveway or the flares of its ramp."""
    still = [prop for prop in props if prop.kind != "car"]
    ways = [way for strip in strips for way in driveway_ground(strip)]
    hit, _ = shapely.STRtree(ways).query(footprints(still), predicate="intersects")
    return [still[i].id for i in np.unique(hit)]


def _cross_sections(line: Polyline, stations_m: Floats) -> tuple[Floats, Floats]:
    """Return (N, 2) points at arc lengths and (N, 2) unit vectors to their left."""
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
    """Return free distances from points to polygon sides on their left and right.

    middles, aside: (N, 2) points and unit vectors to their left
    reach_m: upper limit of the distances

    Returns: left (N,) m, right (N,) m, and (N,) whether a point is inside (odd number of sides on
        its left)
    """
    corners, ring = shapely.get_coordinates(
        shapely.get_rings(np.asarray(polygons, dtype=object)), return_index=True
    )
    corners, at = corners - middles[0], middles - middles[0]
    along = np.column_stack([aside[:, 1], -aside[:, 0]])
    left, right = np.full(len(middles), reach_m), np.full(len(middles), reach_m)
    to_the_left = np.zeros(len(middles), dtype=int)
    step = max(_BATCH_PAIRS // max(len(corners), 1), 1)
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

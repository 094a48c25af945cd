"""Widen torn or pinched corners of foreign nets, so that a robot can pass.

Many walking areas of netconvert cross themselves, narrow between two sidewalks or end short of one.
SUMO's pedestrians ignore this, since they walk from lane to lane.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from itertools import combinations, repeat

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.geometry import Floats
from cosim.core.progress import Progress, ignore
from cosim.place import overlay
from cosim.place.street_map import SEAM_M, Corner, Port, StreetMap, Strip, union_closed

CLEAR_M = 0.36
"""Half of the width that must be free through a corner, metres."""
PAD_M = 0.5
"""Radius of the ground added at a port of a repaired corner, metres."""
_WIDEST_M = 2.0
"""Largest width of an added band, metres."""
_EDGE_M = 0.05
"""Distance from the edge of the ground within which a strip's end counts as torn, metres."""


def repair_corners(
    root: ET.Element, street_map: StreetMap, progress: Progress = ignore
) -> list[str]:
    """Widen, in place, the walking areas that block a robot. Return the changes, a sentence
    each."""
    lanes = {
        e.get("id"): e[0]
        for e in root.iter("edge")
        if e.get("function") == "walkingarea" and len(e)
    }
    widened = 0
    for number, corner in enumerate(street_map.corners.values()):
        if number % 100 == 0:
            progress("mending corners", number / len(street_map.corners))
        polygon = widened_corner(street_map, corner)
        if polygon is not None and corner.id in lanes:
            ring = shapely.get_coordinates(polygon.exterior)[:-1]
            lanes[corner.id].set("shape", " ".join(f"{x:.2f},{y:.2f}" for x, y in ring))
            widened += 1
    if not widened:
        return []
    return [
        f"{widened} of {len(street_map.corners)} corners were torn or pinched: widened along "
        f"the ways across them"
    ]


def widened_corner(street_map: StreetMap, corner: Corner) -> Polygon | None:
    """Return a corner's polygon, widened by pads at its ports and bands between them; None if it
    is passable."""
    ports = list(dict.fromkeys(corner.ports))
    if len(ports) < 2:
        return None
    strips = [street_map.strips[port.strip] for port in ports]
    ends = np.array([_port_point(port, strip) for port, strip in zip(ports, strips, strict=True)])
    widths = np.array([strip.width_m for strip in strips])
    clear_m = min(CLEAR_M, 0.35 * float(widths.min()))
    torn = isinstance(corner.polygon, MultiPolygon) or any(
        map(_is_torn, repeat(corner), strips, ends)
    )
    if not torn and _is_passable(corner.polygon, strips, ends, widths, clear_m):
        return None
    pads = shapely.buffer(shapely.points(ends), np.minimum(widths / 2.0, PAD_M))
    groups = _groups([corner.polygon, *pads], ends, clear_m)
    bands: list[Polygon] = []
    pairs = combinations(range(len(ports)), 2)
    for i, k in sorted(pairs, key=lambda pair: float(np.hypot(*(ends[pair[0]] - ends[pair[1]])))):
        if groups[i] != groups[k]:
            width_m = max(2.0 * clear_m + 0.1, min(float(widths[i]), float(widths[k]), _WIDEST_M))
            bands.append(_band(ends[i], ends[k], width_m))
            old = groups[k]
            groups = [groups[i] if group == old else group for group in groups]
    whole = overlay.union_all([*shapely.get_parts(corner.polygon), *pads, *bands])
    parts = [
        part for part in shapely.get_parts(whole) if isinstance(part, Polygon) and part.area > 0.0
    ]
    return max(
        parts,
        key=lambda part: (int((shapely.distance(part, pads) < 0.05).sum()), part.area),
        default=None,
    )


def _port_point(port: Port, strip: Strip) -> Floats:
    return strip.line[0 if port.end == 0 else -1, :2]


def _is_torn(corner: Corner, strip: Strip, end: Floats) -> bool:
    """Return whether a strip ends at the edge of the ground."""
    ground = union_closed([corner.polygon, strip.polygon])
    return float(shapely.distance(shapely.boundary(ground), shapely.Point(end))) < _EDGE_M


def _is_passable(
    polygon: Polygon | MultiPolygon,
    strips: Sequence[Strip],
    ends: Floats,
    widths: Floats,
    clear_m: float,
) -> bool:
    """Return whether all ports of a corner are connected across the corner and their own strips."""
    at = shapely.points(ends)
    core = shapely.buffer(polygon, -clear_m)
    if (
        isinstance(core, Polygon)
        and not core.is_empty
        and shapely.distance(core, at).max() <= 1.5 * clear_m
    ):
        return True
    mouths = overlay.intersection(
        [s.polygon for s in strips], shapely.buffer(at, np.maximum(widths / 2.0, 1.0))
    )
    for i, k in combinations(range(len(ends)), 2):
        first, second = _groups([polygon, mouths[i], mouths[k]], ends[[i, k]], clear_m)
        if first != second:
            return False
    return True


def _band(a: Floats, b: Floats, width_m: float) -> Polygon:
    if float(np.hypot(*(b - a))) < 0.01:
        return shapely.Point(a).buffer(width_m / 2.0)
    return shapely.LineString([a, b]).buffer(width_m / 2.0)


def _groups(pieces: Sequence[shapely.Geometry], ends: Floats, clear_m: float) -> list[int]:
    """Return the index of the free part of the ground at each port; a negative number without
    one."""
    free = shapely.buffer(union_closed(pieces), -clear_m)
    parts = [part for part in shapely.get_parts(free) if not part.is_empty]
    groups = []
    for i, end in enumerate(ends):
        gaps = [float(part.distance(shapely.Point(end))) for part in parts]
        best = int(np.argmin(gaps)) if gaps else -1
        groups.append(best if gaps and gaps[best] <= clear_m + SEAM_M else -1 - i)
    return groups

"""Fit mapped buildings and objects between the streets of a net."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Final, cast

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Point, Polygon

from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.street_map import (
    LAND_KINDS,
    Feature,
    FeatureKind,
    LandKind,
    Lane,
    StreetMap,
    Strip,
)
from sumo_nets.maps.osm_features import MappedFeature, OsmFeatures


def utm_zone(proj: str) -> tuple[int, bool] | None:
    """Return the zone of a net's `projParameter` and whether it is southern; None for other
    projections."""
    zone = re.search(r"\+zone=(\d+)\b", proj)
    if "+proj=utm" not in proj or zone is None or not 1 <= int(zone[1]) <= 60:
        return None
    return int(zone[1]), "+south" in proj


def utm_xy(lonlat: Floats, zone: int, south: bool) -> Floats:
    """Convert WGS 84 longitudes and latitudes (N, 2), degrees, to UTM east and north (N, 2),
    metres."""
    from pyproj import Proj  # slow import, needed only for maps with features

    projection = Proj(proj="utm", zone=zone, south=south, ellps="WGS84")
    return np.column_stack(projection(lonlat[:, 0], lonlat[:, 1]))


EXTENT_M: Final[Mapping[str, tuple[float, float]]] = {
    "tree": (0.4, 0.4),
    "lamp": (0.16, 0.16),
    "bench": (1.9, 0.55),
    "bollard": (0.18, 0.18),
    "bin": (0.56, 0.56),
    "hydrant": (0.32, 0.32),
    "rack": (1.5, 0.75),
}
"""Length and depth of the ground that each kind of object may cover, metres."""

_CLEAR_HALF_M: Final = 0.6
"""Half of the smallest clear width along the middle of a sidewalk, metres."""
_OUTER_M: Final = 0.6
"""Width of the outer parts of a sidewalk where objects may stand, metres."""
WALL_GAP_M: Final = 0.2
"""Smallest distance of a building from streets and walkways, metres."""
_GAP_M: Final = 0.1
"""Smallest distance between objects, metres."""
_MAX_MOVE_M: Final = 3.0
"""Largest displacement of an object to a permitted position, metres."""
_CELL_M: Final = 2.5
"""Cell size of the search for touching objects, metres: touching objects are at most this far
apart."""
_FAR_M: Final = 100.0
"""Objects farther from every walkway are omitted, metres."""
IN_ZONE_DEG: Final = 10.0
"""Objects farther from the central meridian of the net's UTM zone are omitted, degrees."""
_LAND_M2: Final = 1.0
"""Smaller pieces of land are omitted, m2."""
LEFT_SHARE: Final = 0.5
"""A building is omitted if less of its area remains after cutting out the streets."""
LEFT_M2: Final = 6.0
"""Smaller remaining parts of a building are omitted, m2."""


def fit_features(
    found: OsmFeatures, location: Mapping[str, str], street_map: StreetMap
) -> tuple[tuple[Feature, ...], list[str]]:
    """Return the features of a map in its net's frame, and the changes, a sentence each.

    location: the attributes of the net's <location>.
    """
    zone = utm_zone(location.get("projParameter", ""))
    if not found.things:
        return (), []
    if zone is None:
        return (), [
            f"{len(found.things)} buildings and things left out: the net has no UTM projection"
        ]
    offset = np.array([float(v) for v in location["netOffset"].split(",")])
    around = [thing for thing in found.things if _in_zone(thing, zone[0])]
    mapped = [
        thing._replace(rings=tuple(utm_xy(ring, *zone) + offset for ring in thing.rings))
        for thing in around
    ]
    near = _near_walkways(mapped, street_map)
    streets = _Streets(street_map)
    buildings, cut_changes = _cut_buildings(
        [thing for thing in near if thing.kind == "building"], streets
    )
    things = [thing for thing in near if thing.kind not in ("building", *LAND_KINDS)]
    standing, moved_changes = _placed(things, streets, buildings)
    lands = _clipped([thing for thing in near if thing.kind in LAND_KINDS], street_map)
    kinds = Counter(feature.kind for feature in (*buildings, *standing, *lands))
    counts = [f"{count} x {kind}" for kind, count in kinds.items()]
    changes = [f"taken from the map: {', '.join(counts)}"] if counts else []
    left_out = [f"{count} x {reason}" for reason, count in found.skipped.items()]
    if left_out:
        changes.append(f"left out: {', '.join(left_out)}")
    return (*buildings, *standing, *lands), [*changes, *cut_changes, *moved_changes]


def _in_zone(thing: MappedFeature, zone: int) -> bool:
    """Return whether a feature is close enough to the zone's middle for the projection."""
    east = np.remainder(thing.rings[0][:, 0] - (6.0 * zone - 183.0) + 180.0, 360.0) - 180.0
    return bool((np.abs(east) < IN_ZONE_DEG).all())


def _near_walkways(mapped: Sequence[MappedFeature], street_map: StreetMap) -> list[MappedFeature]:
    walked = [strip.polygon for strip in street_map.strips.values()]
    if not walked or not mapped:
        return []
    outlines = [_outline(thing) for thing in mapped]
    hit, _ = shapely.STRtree(walked).query(outlines, predicate="dwithin", distance=_FAR_M)
    return [mapped[i] for i in np.unique(hit)]


def _outline(thing: MappedFeature) -> shapely.Geometry:
    """Return the geometry of a feature for distance checks: land as an area, since walkways may
    cross it."""
    ring = thing.rings[0]
    if thing.kind in LAND_KINDS:
        return shapely.make_valid(Polygon(ring))
    return shapely.LineString(ring) if len(ring) > 1 else Point(ring[0])


def _clipped(mapped: Sequence[MappedFeature], street_map: StreetMap) -> list[Feature]:
    """Return the pieces of land within the map, simplified to 0.1 m."""
    x0, y0, x1, y1 = street_map.bounds
    area = shapely.box(x0 - _FAR_M, y0 - _FAR_M, x1 + _FAR_M, y1 + _FAR_M)
    found: list[Feature] = []
    for thing in mapped:
        whole = shapely.make_valid(Polygon(thing.rings[0], thing.rings[1:]))
        inside = shapely.set_precision(
            shapely.simplify(overlay.intersection(whole, area), 0.1), 0.01
        )
        for part in shapely.get_parts(inside):
            if isinstance(part, Polygon) and part.is_valid and part.area > _LAND_M2:
                x, y = shapely.get_coordinates(shapely.point_on_surface(part))[0].tolist()
                found.append(
                    Feature(cast(LandKind, thing.kind), round(x, 2), round(y, 2), polygon=part)
                )
    return found


class _Streets:
    """The ground that streets cover, and the parts of it that must remain free of objects."""

    def __init__(self, street_map: StreetMap) -> None:
        strips = list(street_map.strips.values())
        lanes = [lane for lane in street_map.lanes.values() if lane.kind == "road"]
        ground: list[shapely.Geometry] = [lane.polygon for lane in lanes]
        ground += [corner.polygon for corner in street_map.corners.values()]
        self._ground = _Index([*ground, *(strip.polygon for strip in strips)])
        self._closed = _Index([*ground, *(_closed_band(strip) for strip in strips)])
        self._roads = _Lines(lanes)
        self._walks = _Lines([strip for strip in strips if strip.kind == "sidewalk"])

    def under(self, area: shapely.Geometry) -> shapely.Geometry:
        """Return the street ground within an area."""
        return self._ground.union(area, 0.0)

    def closed(self, at: Point) -> shapely.Geometry:
        """Return the ground around a point where objects are not permitted."""
        return self._closed.union(at, 2.0 * _MAX_MOVE_M)

    def heading(self, kind: str, at: Point | Polygon) -> float:
        """Return the heading of an object.

        A lamp's arm points over the road, a bench faces the walkway, a building's front the street.
        Other objects are aligned with the street.
        """
        over_road = self._roads.toward(at)
        to_walk = self._walks.toward(at)
        faced = to_walk if kind == "bench" or over_road is None else over_road
        if kind in ("bench", "building") and faced is not None:
            return math.remainder(faced + 0.5 * math.pi, 2.0 * math.pi)
        toward = over_road if over_road is not None else to_walk
        return 0.0 if toward is None else math.remainder(toward - 0.5 * math.pi, 2.0 * math.pi)


class _Index:
    """Spatial index of polygons."""

    def __init__(self, polygons: Sequence[shapely.Geometry]) -> None:
        self._polygons = np.array(polygons, dtype=object)
        self._tree = shapely.STRtree(self._polygons)

    def union(self, area: shapely.Geometry, within_m: float) -> shapely.Geometry:
        near = np.sort(self._tree.query(area, predicate="dwithin", distance=within_m))
        return overlay.union_all(self._polygons[near])


class _Lines:
    """Spatial index of the middle lines of lanes or strips."""

    def __init__(self, pieces: Sequence[Lane] | Sequence[Strip]) -> None:
        self._lines: NDArray[np.object_] = np.array(
            [shapely.LineString(p.line[:, :2]) for p in pieces], dtype=object
        )
        self._tree = shapely.STRtree(self._lines)

    def toward(self, at: Point | Polygon) -> float | None:
        """Return the heading from a place to the nearest line within 30 m."""
        nearest = self._tree.query_nearest(at, max_distance=30.0, all_matches=False)
        if not len(nearest):
            return None
        (x0, y0), (x1, y1) = shapely.get_coordinates(
            shapely.shortest_line(at, self._lines[nearest[0]])
        ).tolist()
        return math.atan2(y1 - y0, x1 - x0)


def _closed_band(strip: Strip) -> shapely.Geometry:
    """Return the part of a strip without objects: all around a crossing, the middle of a
    sidewalk."""
    if strip.kind == "crossing":
        return shapely.buffer(strip.polygon, 1.0)
    half = max(_CLEAR_HALF_M, 0.5 * strip.width_m - _OUTER_M)
    if half >= 0.5 * strip.width_m:
        return strip.polygon
    return shapely.buffer(shapely.LineString(strip.line[:, :2]), half)


def _cut_buildings(
    mapped: Sequence[MappedFeature], streets: _Streets
) -> tuple[list[Feature], list[str]]:
    """Return buildings without the ground of streets."""
    found: list[Feature] = []
    cut = dropped = 0
    for thing in mapped:
        whole = Polygon(thing.rings[0], thing.rings[1:])
        if not whole.is_valid:
            dropped += 1  # valid in degrees, and too thin for metres
            continue
        parts = [whole]
        taken = streets.under(shapely.buffer(whole, WALL_GAP_M))
        if not shapely.is_empty(taken):
            parts = _outside_streets(whole, taken)
            left = sum(part.area for part in parts) > LEFT_SHARE * whole.area
            cut += left
            dropped += not left
            parts = parts if left else []
        for part in parts:
            x, y = shapely.get_coordinates(shapely.point_on_surface(part))[0].tolist()
            heading = round(_front_heading(part, streets.heading("building", part)), 4)
            found.append(
                Feature(
                    "building", round(x, 2), round(y, 2), heading, round(thing.height_m, 2), part
                )
            )
    changes = []
    if cut:
        changes.append(
            f"buildings cut back where they reached into streets (what is walked on wins): {cut}"
        )
    if dropped:
        changes.append(f"buildings left out that lay mostly on streets or are none: {dropped}")
    return found, changes


def _front_heading(part: Polygon, heading_rad: float) -> float:
    """Return the heading along the wall that faces a street to the right of `heading_rad`."""
    ring = shapely.get_coordinates(shapely.orient_polygons(part).exterior)
    sides = np.diff(ring, axis=0)
    # Walls run with the outside to their right, so the front wall runs along the heading.
    fit = sides @ np.array([math.cos(heading_rad), math.sin(heading_rad)])
    x, y = sides[int(np.argmax(fit * (fit > 0.7 * np.hypot(*sides.T))))].tolist()
    return math.atan2(y, x)


def _outside_streets(whole: Polygon, taken: shapely.Geometry) -> list[Polygon]:
    """Return the parts of a building outside of the streets, without splinters."""
    ground = shapely.buffer(taken, WALL_GAP_M, join_style="mitre", mitre_limit=2.0)
    left = shapely.simplify(overlay.difference(whole, ground), 0.05)
    left = shapely.buffer(
        shapely.buffer(left, -0.3, join_style="mitre"), 0.3, join_style="mitre", mitre_limit=2.0
    )
    # Mitres may reach into the streets again, and the file stores corners to the centimetre.
    left = shapely.set_precision(
        overlay.difference(overlay.intersection(left, whole), ground), 0.01
    )
    return [
        p
        for p in shapely.get_parts(left)
        if isinstance(p, Polygon) and p.is_valid and p.area >= LEFT_M2
    ]


def _placed(
    mapped: Sequence[MappedFeature], streets: _Streets, buildings: Sequence[Feature]
) -> tuple[list[Feature], list[str]]:
    """Place objects at permitted positions near the mapped ones, or omit them."""
    houses = _Index([building.polygon for building in buildings])
    found: list[Feature] = []
    placed: dict[tuple[int, int], list[tuple[Floats, float]]] = defaultdict(list)
    counts: Counter[str] = Counter()
    for thing in mapped:
        radius = 0.5 * math.hypot(*EXTENT_M[thing.kind])
        spot = Point(thing.rings[0][0])
        closed = overlay.union(streets.closed(spot), houses.union(spot, 2.0 * _MAX_MOVE_M))
        at = _free_spot(spot, closed, radius)
        if at is None:
            counts["left out on a road, a crossing or in a narrow passage"] += 1
            continue
        xy = np.array([round(at.x, 2), round(at.y, 2)])
        i, j = (math.floor(c / _CELL_M) for c in xy)
        rivals = [
            rival
            for a in (-1, 0, 1)
            for b in (-1, 0, 1)
            for rival in placed.get((i + a, j + b), ())
        ]
        if any(np.hypot(*(xy - other)) < radius + reach + _GAP_M for other, reach in rivals):
            counts["left out where another one is"] += 1
            continue
        if at is not spot:
            counts["moved aside by up to 3 m, off the road or the middle of a sidewalk"] += 1
        placed[i, j].append((xy, radius))
        facing = thing.facing_rad
        turned = streets.heading(thing.kind, at) if facing is None else facing + 0.5 * math.pi
        heading = round(math.remainder(turned, 2.0 * math.pi), 4)
        kind = cast(FeatureKind, thing.kind)
        found.append(Feature(kind, float(xy[0]), float(xy[1]), heading, round(thing.height_m, 2)))
    return found, [f"mapped things {reason}: {count}" for reason, count in counts.items()]


def _free_spot(spot: Point, closed: shapely.Geometry, radius_m: float) -> Point | None:
    """Return the nearest point for a disk outside of `closed`, or None beyond _MAX_MOVE_M."""
    if shapely.is_empty(closed) or spot.distance(closed) > radius_m:
        return spot
    edge = shapely.boundary(shapely.buffer(closed, radius_m + 0.02))
    _, at = (Point(p) for p in shapely.get_coordinates(shapely.shortest_line(spot, edge)))
    return at if spot.distance(at) <= _MAX_MOVE_M else None

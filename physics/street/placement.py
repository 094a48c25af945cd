"""Random placement of street furniture along sidewalks.

Each sidewalk draws its props from its own generator. A prop belongs to the tile of its centre, so
tiles do not depend on the order in which they are built. A band along the middle of every sidewalk
stays free. Cars stand only at the ends of driveways, because traffic uses every lane of the road.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Polyline
from cosim.place import overlay
from cosim.place.street_map import Lane, PieceKind, StreetMap, Strip
from physics.ground.tiles import (
    CURBSTONE_M,
    DRIVEWAY_M,
    RAMP_M,
    Key,
    grown_box,
    tile_at,
    tile_bounds,
    tiles_touching,
)
from physics.street.buildings import BuildingRows
from physics.street.furniture import (
    CATALOGUE,
    KINDS,
    PROP_VARIANTS,
    Prop,
    PropKind,
    Zone,
    footprints,
)
from physics.street.mapped import MappedObjects

CLEAR_HALF_M: Final = 0.6
"""Smallest half width in metres of the free band along the middle of a sidewalk."""

PROP_END_GAP_M: Final = 2.0
"""Smallest distance in metres between a prop and a crossing or the end of a sidewalk."""

_GAP_M: Final = 0.25
"""Smallest distance in metres between two props."""

_EDGE_M: Final = 0.6
"""Width in metres of the outer edge of a wide sidewalk for props at the curb."""

TREE_TURN_RAD: Final = 2.399963
"""Rotation in radians from one tree to the next, so that trees look different."""

_MARGIN_M: Final = 0.06
"""Distance in metres between props and the border of their zone."""

_VERGE_MIN_M: Final = 0.3
"""Smallest width in metres of a verge with props."""

_ZONE_MAX_M: Final = 6.0
"""Largest width of a zone in metres."""

_SEARCH_M: Final = 12.0
"""Search distance in metres for props of a sidewalk and for buildings near props.

Props are closer than this to their sidewalk, and centres of buildings to their walls.
"""

_STREET_PIECES: Final[tuple[PieceKind, ...]] = ("strip", "corner", "lane", "junction")
"""Kinds of map pieces that props must not cover."""

_CLASS_OF_WORDS: Final = (
    (("motorway", "trunk", "primary", "secondary"), "avenue"),
    (("tertiary",), "commercial"),
    (("living", "service", "alley"), "narrow"),
)
"""Street classes of imported maps by words in the edge type; the default is residential."""


class _Band(NamedTuple):
    """Range of distances from the centre line, positive away from the road, in metres."""

    low_m: float
    high_m: float


class PropPlacement:
    """Street furniture of a map.

    mapped: mapped props, near which none of the same kind are generated

    Results are pure functions of map, seed and arguments, and are cached.
    """

    def __init__(
        self,
        street_map: StreetMap,
        seed: int,
        frontage: BuildingRows,
        mapped: MappedObjects | None = None,
    ) -> None:
        self._map = street_map
        self._seed = seed
        self._frontage = frontage
        self._mapped = MappedObjects(street_map) if mapped is None else mapped
        self._candidates: dict[str, tuple[list[Prop], NDArray[np.object_]]] = {}
        self._final: dict[str, tuple[Prop, ...]] = {}
        self._houses: dict[Key, list[shapely.Geometry]] = {}

    def in_tile(self, key: Key) -> tuple[Prop, ...]:
        """Return the props whose centre lies in a tile, in map order."""
        strips = self._map.near("strip", grown_box(tile_bounds(key), _SEARCH_M))
        props = [prop for s in strips if isinstance(s, Strip) for prop in self.props_of_strip(s)]
        return (
            *self._mapped.props(key),
            *(prop for prop in props if tile_at(prop.x_m, prop.y_m) == key),
        )

    def props_of_strip(self, strip: Strip) -> tuple[Prop, ...]:
        """Return the props of a sidewalk without overlaps.

        Props that overlap a building or a prop of an earlier sidewalk are removed.
        """
        if strip.id not in self._final:
            props, ground = self._draw_candidates(strip)
            hit = np.zeros(len(props), dtype=bool)
            if props:
                area = grown_box(shapely.total_bounds(ground), _SEARCH_M)
                others = [
                    s
                    for s in self._map.near("strip", area)
                    if isinstance(s, Strip) and s.id < strip.id
                ]
                others_ground = [polygon for s in others for polygon in self._draw_candidates(s)[1]]
                others_ground += list(footprints(self._mapped_in(area)))
                hit |= _within(ground, others_ground, _GAP_M)
                spread = np.array([KINDS[prop.kind].spread_m for prop in props])
                hit |= _within(
                    shapely.buffer(ground, spread, quad_segs=2), self._houses_in(area), _MARGIN_M
                )
            self._final[strip.id] = tuple(
                prop for prop, is_hit in zip(props, hit, strict=True) if not is_hit
            )
        return self._final[strip.id]

    def _mapped_in(self, area: shapely.Polygon) -> list[Prop]:
        return [prop for key in tiles_touching(area) for prop in self._mapped.props(key)]

    def _houses_in(self, area: shapely.Polygon) -> list[shapely.Geometry]:
        keys = tiles_touching(area)
        for key in keys:
            if key not in self._houses:
                self._houses[key] = [b.polygon for b in self._frontage.in_tile(key)]
        return [house for key in keys for house in self._houses[key]]

    def _draw_candidates(self, strip: Strip) -> tuple[list[Prop], NDArray[np.object_]]:
        """Return random props of a sidewalk that fit its zones, the street and each other.

        Returns: props and their (N,) footprints
        """
        if strip.id not in self._candidates:
            props = list(draw_props(strip, self._seed)) if strip.kind == "sidewalk" else []
            mapped_kinds = self._mapped.kinds
            props = [
                p
                for p in props
                if p.kind not in mapped_kinds
                or not self._mapped.shows(p.kind, shapely.Point(p.x_m, p.y_m))
            ]
            ground = footprints(props)
            if props:
                free = _find_free(self._map, strip, props, ground)
                props = [prop for prop, is_free in zip(props, free, strict=True) if is_free]
                ground = ground[free]
            self._candidates[strip.id] = props, ground
        return self._candidates[strip.id]


def draw_props(strip: Strip, seed: int) -> Iterable[Prop]:
    """Return random props of a sidewalk, kind by kind, before overlaps are removed."""
    line = Polyline(strip.line if strip.road_side <= 0 else strip.line[::-1])
    bands = prop_zones(strip)
    usable = line.length_m - 2.0 * PROP_END_GAP_M
    if usable < 1.0 or not bands:
        return
    rng = np.random.default_rng([seed, zlib.crc32(strip.id.encode()), 0x9209])
    style = street_style(strip.street_class)
    driveways = [s if strip.road_side <= 0 else line.length_m - s for s in strip.driveways]
    density = float(rng.uniform(0.5, 1.5))
    n = 0
    for kind in CATALOGUE:
        fitting = [zone for zone in kind.zones if zone in bands]
        expected = kind.per_100m[style] * density * usable / 100.0
        count = int(expected + rng.random())
        variant = int(rng.integers(PROP_VARIANTS))
        paint = int(rng.integers(len(kind.paints)))
        aside, row_phase = rng.random(2)
        if not fitting:
            continue
        if "driveway" in fitting:
            count = min(count, len(driveways))
        for k in range(count):
            u, v, w = rng.random(3)
            if kind.row:
                # Props in a row share one size and one distance from the curb.
                s = (k + 0.2 + 0.6 * row_phase + 0.05 * u) / count * usable
                share = aside
                zone = fitting[0]
            else:
                s = u * usable
                share = v
                zone = fitting[min(int(w * len(fitting)), len(fitting) - 1)]
                variant = int(rng.integers(PROP_VARIANTS))
                paint = int(rng.integers(len(kind.paints)))
            size = kind.size_m(variant)
            at_m = driveways[k] if zone == "driveway" else PROP_END_GAP_M + s
            turned = zone == "driveway" and _depth_m(bands[zone]) > size[0]
            prop = _place(
                strip, line, at_m, bands[zone], share, kind, variant, paint, zone, turned, n
            )
            if prop is None or (
                zone != "driveway" and any(_blocks_driveway(at_m, size[0], d) for d in driveways)
            ):
                continue
            yield prop
            n += 1


def _place(
    strip: Strip,
    line: Polyline,
    at_m: float,
    band: _Band,
    share: float,
    kind: PropKind,
    variant: int,
    paint: int,
    zone: Zone,
    turned: bool,
    n: int,
) -> Prop | None:
    """Return a prop in a zone of a sidewalk, or None if it does not fit.

    at_m: arc length along the line
    share: position within the free depth of the zone, 0 to 1
    turned: place the prop across the street direction
    n: number of the prop along the sidewalk
    """
    length, depth, _ = kind.size_m(variant)
    if turned:
        length, depth = depth, length
    slack = _depth_m(band) - depth
    if (
        slack < 0.0
        or not PROP_END_GAP_M + 0.5 * length
        <= at_m
        <= line.length_m - PROP_END_GAP_M - 0.5 * length
    ):
        return None
    x, y, along = line.at(at_m)
    away = band.low_m + 0.5 * depth + share * slack
    heading = along + (
        0.5 * math.pi if turned else 0.0 if zone in ("frontage", "driveway") else math.pi
    )
    x = x - away * math.sin(along)
    y = y + away * math.cos(along)
    turned_rad = 0.0
    if kind.name == "lamp" and zone == "frontage":
        turned_rad = math.pi  # the arm must point to the road, not into buildings
    elif kind.grown:
        turned_rad = TREE_TURN_RAD * n
    return Prop(f"prop:{strip.id}:{n}", kind.name, variant, x, y, heading, paint, turned_rad)


def prop_zones(strip: Strip) -> dict[Zone, _Band]:
    """Return the zones of a sidewalk that props may use."""
    half = 0.5 * strip.width_m
    found: dict[Zone, _Band] = {}
    if strip.road_side != 0:
        verge = min(strip.verge_m, _ZONE_MAX_M)
        if verge >= _VERGE_MIN_M:
            found["verge"] = _Band(-half - verge + CURBSTONE_M, -half - 0.02)
        elif half - clear_half_m(strip) > 0.1:
            found["curb"] = _Band(-half + _MARGIN_M, -clear_half_m(strip) - 0.01)
    frontage = min(strip.frontage_m, _ZONE_MAX_M)
    if frontage > 2.0 * _MARGIN_M:
        found["frontage"] = found["driveway"] = _Band(
            half + _MARGIN_M, half + frontage - 2.0 * _MARGIN_M
        )
    return found


def clear_half_m(strip: Strip) -> float:
    """Return half the width in metres of the free band along the middle of a sidewalk."""
    return min(max(CLEAR_HALF_M, 0.5 * strip.width_m - _EDGE_M), 0.5 * strip.width_m)


def street_style(street_class: str) -> str:
    """Return the catalogue column for a street class or the type of an imported edge."""
    if street_class in CATALOGUE[0].per_100m:
        return street_class
    return next(
        (ours for words, ours in _CLASS_OF_WORDS if any(w in street_class for w in words)),
        "residential",
    )


def props_of(street_map: StreetMap, seed: int) -> tuple[Prop, ...]:
    """Return all props of a map, sidewalk by sidewalk; takes seconds on large maps."""
    mapped = MappedObjects(street_map)
    placement = PropPlacement(street_map, seed, BuildingRows(street_map, seed, mapped), mapped)
    made_up = (
        prop for strip in street_map.strips.values() for prop in placement.props_of_strip(strip)
    )
    return (*mapped.all_props, *made_up)


def driveway_ground(strip: Strip) -> list[shapely.Geometry]:
    """Return the area to keep free for each driveway of a sidewalk.

    It is the way through verge, sidewalk and frontage, and the flares of its ramp.
    """
    line = Polyline(strip.line)
    found: list[shapely.Geometry] = []
    for at_m in strip.driveways:
        x, y, heading = line.at(at_m)
        along = 0.5 * DRIVEWAY_M * np.array([math.cos(heading), math.sin(heading)])
        aside = strip.road_side * np.array([-math.sin(heading), math.cos(heading)])
        road = np.array([x, y]) + (0.5 * strip.width_m + strip.verge_m) * aside
        far = np.array([x, y]) - (0.5 * strip.width_m + strip.frontage_m) * aside
        way = shapely.Polygon([road - along, road + along, far + along, far - along])
        flares = shapely.buffer(shapely.LineString([road - along, road + along]), RAMP_M)
        found.append(overlay.union(way, flares))
    return found


def _find_free(
    street_map: StreetMap, strip: Strip, props: Sequence[Prop], ground: NDArray[np.object_]
) -> NDArray[np.bool_]:
    """Return which props are clear of the free band, other streets and earlier props."""
    area = grown_box(shapely.total_bounds(ground), PROP_END_GAP_M)
    taken: list[shapely.Geometry] = []
    for piece in [piece for kind in _STREET_PIECES for piece in street_map.near(kind, area)]:
        if piece is strip or (isinstance(piece, Lane) and piece.kind == "verge"):
            continue
        is_crossing = isinstance(piece, Strip) and piece.kind == "crossing"
        taken.append(
            shapely.buffer(piece.polygon, PROP_END_GAP_M) if is_crossing else piece.polygon
        )
    free = ~_within(ground, taken, 0.02)
    ways = [
        way
        for s in street_map.near("strip", area)
        if isinstance(s, Strip)
        for way in driveway_ground(s)
    ]
    free &= ~_within(ground, ways, 0.0) | np.array([prop.kind == "car" for prop in props])
    half = clear_half_m(strip) if "curb" in prop_zones(strip) else 0.5 * strip.width_m
    free &= np.asarray(shapely.distance(shapely.linestrings(strip.line), ground) >= half)
    one, two = shapely.STRtree(ground).query(ground, predicate="dwithin", distance=_GAP_M)
    earlier: dict[int, list[int]] = {}
    for i, j in zip(one.tolist(), two.tolist(), strict=True):
        if j < i:
            earlier.setdefault(i, []).append(j)
    for i in sorted(earlier):
        free[i] &= not any(free[j] for j in earlier[i])
    return np.asarray(free, dtype=bool)


def _within(
    ground: NDArray[np.object_], taken: Sequence[shapely.Geometry], gap_m: float
) -> NDArray[np.bool_]:
    """Return which footprints are within a distance of taken areas."""
    hit = np.zeros(len(ground), dtype=bool)
    if taken:
        hit[shapely.STRtree(taken).query(ground, predicate="dwithin", distance=gap_m)[0]] = True
    return hit


def _blocks_driveway(at_m: float, length_m: float, driveway_m: float) -> bool:
    """Return whether a prop stands on a driveway or its ramp."""
    return abs(at_m - driveway_m) < 0.5 * (DRIVEWAY_M + length_m) + RAMP_M


def _depth_m(band: _Band) -> float:
    return band.high_m - band.low_m

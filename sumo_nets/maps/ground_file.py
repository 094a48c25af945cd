"""Store the drawn ground of a scan next to its net: the share of each strip and corner.

SUMO walks on lanes, in the inner part of the drawn ground. Robots are judged on all of it.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.errors import MapError
from cosim.core.geometry import Floats, Polyline
from cosim.place import overlay
from cosim.place.scan import SCAN_FOLDER
from cosim.place.street_map import Corner, StreetMap, Strip

GROUND_FILE: Final = "ground.json"
"""Name of the file next to a net."""
_SCHEMA: Final = 1
_STEP_M: Final = 0.5
"""Distance of the points by which ground belongs to the nearest piece, in metres."""
_END_M: Final = 0.05
"""Distance of the outermost points from the end of a strip, in metres."""
_SPECK_M2: Final = 1e-3

_Rings = list[list[tuple[float, float]]]


class DrawnGround(msgspec.Struct, frozen=True):
    """Shares of the drawn ground, by the ids of strips and corners.

    widths_m: clear width of each strip, which is more than that of SUMO's lane.
    uncrowded: see `StreetMap`.
    """

    strips: dict[str, Polygon]
    corners: dict[str, Polygon | MultiPolygon]
    widths_m: dict[str, float]
    uncrowded: tuple[str, ...] = ()


class _Stored(msgspec.Struct, frozen=True):
    schema: int
    strips: dict[str, list[_Rings]]
    corners: dict[str, list[_Rings]]
    widths_m: dict[str, float]
    uncrowded: tuple[str, ...]


def write_ground(ground: DrawnGround, path: Path) -> None:
    """Write drawn ground to `path`. Raises OSError."""
    stored = _Stored(
        _SCHEMA,
        {name: _rings(polygon) for name, polygon in ground.strips.items()},
        {name: _rings(polygon) for name, polygon in ground.corners.items()},
        ground.widths_m,
        ground.uncrowded,
    )
    path.write_bytes(msgspec.json.encode(stored))


def with_drawn_ground(street_map: StreetMap, path: Path) -> StreetMap:
    """Return the map with the drawn ground at `path`; unchanged without a file.

    Raises MapError if the file is damaged or of another net.
    """
    try:
        stored = msgspec.json.decode(path.read_bytes(), type=_Stored)
        if stored.schema != _SCHEMA:
            raise ValueError(f"schema {stored.schema}; this version reads {_SCHEMA}")
        if not stored.strips.keys() == stored.widths_m.keys() == street_map.strips.keys():
            raise ValueError("its strips are not those of the net")
        if stored.corners.keys() != street_map.corners.keys():
            raise ValueError("its corners are not those of the net")
        strips = {name: _polygon(stored.strips[name][0]) for name in street_map.strips}
        corners = {name: _area(stored.corners[name]) for name in street_map.corners}
    except FileNotFoundError:
        return street_map
    except (OSError, ValueError, IndexError, shapely.errors.GEOSException) as error:
        raise MapError(f"{path}: cannot be read: {error}: import the scan again") from error
    return _with(street_map, DrawnGround(strips, corners, stored.widths_m, stored.uncrowded))


def with_scan(net_hash: str, folder: Path) -> str:
    """Return the content hash of a map with the drawn ground and scan in its folder, if any.

    Splats are left out, because they affect only pictures. A generated scan of a suite has its
    recorded hash if its ground is the recorded one.
    """
    facts = folder / SCAN_FOLDER / "facts.json"
    if not facts.is_file():
        return _with_files(net_hash, folder, "")
    held = msgspec.json.decode(facts.read_bytes())
    recorded = held.get("recorded")
    if recorded and ground_hash(net_hash, folder) == recorded["ground_hash"]:
        return str(recorded["map_hash"])
    return _with_files(net_hash, folder, f"{held.get('mesh_hash')} {held.get('heights_hash')}")


def ground_hash(net_hash: str, folder: Path) -> str:
    """Return the hash of what a scan's map has in common on every processor: all but its mesh."""
    held = msgspec.json.decode((folder / SCAN_FOLDER / "facts.json").read_bytes())
    return _with_files(net_hash, folder, str(held.get("heights_hash")))


def _with_files(net_hash: str, folder: Path, more: str) -> str:
    """Return the hash of a net, of the drawn ground and areas in its folder, if any, and of
    more."""
    files = [folder / GROUND_FILE, folder / SCAN_FOLDER / "areas.geojson"]
    found = [path.read_bytes() for path in files if path.is_file()]
    if not found:
        return net_hash
    digest = hashlib.sha256(net_hash.encode())
    for data in found:
        digest.update(hashlib.sha256(data).digest())
    digest.update(more.encode())
    return digest.hexdigest()[:16]


def drawn_ground(
    street_map: StreetMap,
    ground: Polygon | MultiPolygon,
    widths_m: Mapping[str, float],
    uncrowded: tuple[str, ...] = (),
) -> DrawnGround:
    """Divide ground among the strips and corners of a map: each point goes to the nearest piece.

    widths_m: clear widths of strips; those of SUMO's lanes by default.

    Raises MapError if a strip has no share.
    """
    xy, owners = _labelled_points(street_map)
    cells = shapely.voronoi_polygons(
        shapely.MultiPoint(xy), extend_to=shapely.buffer(ground, 1.0), ordered=True
    )
    names = [*street_map.strips, *street_map.corners]
    order = np.argsort(owners, kind="stable")
    bounds = np.searchsorted(owners[order], np.arange(len(names) + 1))
    cell_of = np.asarray(shapely.get_parts(cells), dtype=object)[order]
    shares: dict[str, list[Polygon]] = {}
    loose: list[Polygon] = []
    for number, name in enumerate(names):
        own = overlay.union_all(cell_of[bounds[number] : bounds[number + 1]])
        parts = _parts(overlay.intersection(own, ground))
        at = shapely.points(xy[owners == number])
        holding = [int(shapely.dwithin(part, at, 1e-6).sum()) for part in parts]
        one = name in street_map.strips
        most = int(np.argmax(holding)) if holding else -1
        shares[name] = [p for i, p in enumerate(parts) if (i == most if one else holding[i])]
        loose += [p for i, p in enumerate(parts) if (i != most if one else not holding[i])]
    _give_away(shares, loose)
    if bare := [name for name in street_map.strips if not shares[name]]:
        raise MapError(f"piece '{bare[0]}' of the walking net lies beside the drawn ground")
    return DrawnGround(
        {name: _whole(shares[name]) for name in street_map.strips},
        {name: _several(shares[name], corner) for name, corner in street_map.corners.items()},
        {name: widths_m.get(name, strip.width_m) for name, strip in street_map.strips.items()},
        uncrowded,
    )


def _give_away(shares: dict[str, list[Polygon]], loose: list[Polygon]) -> None:
    """Add loose parts to the piece with which they share the longest border, in place."""
    left = sorted(loose, key=lambda part: (-part.area, part.bounds))
    while left:
        later = []
        for part in left:
            borders = {
                name: max(
                    (float(shapely.intersection(part, own).length) for own in parts), default=0.0
                )
                for name, parts in shares.items()
            }
            best = max(borders, key=lambda name: borders[name])
            if borders[best] <= 1e-6:
                later.append(part)
                continue
            own = shares[best]
            nearest = max(own, key=lambda one: shapely.intersection(part, one).length)
            shares[best] = [*(one for one in own if one is not nearest), *_joined(nearest, part)]
        if len(later) == len(left):
            return
        left = later


def _joined(one: Polygon, other: Polygon) -> list[Polygon]:
    """Return the union of two polygons with a common border, as one polygon if it is one."""
    both = shapely.union(one, other)
    if isinstance(both, Polygon):
        return [both]
    closed = shapely.buffer(
        shapely.buffer(both, 1e-4, join_style="mitre"), -1e-4, join_style="mitre"
    )
    return [closed] if isinstance(closed, Polygon) else [one]


def _labelled_points(street_map: StreetMap) -> tuple[Floats, NDArray[np.int64]]:
    """Return points along strips and in corners, (N, 2), and the number of the piece of each."""
    found: list[Floats] = []
    owners: list[int] = []
    number = 0
    for number, strip in enumerate(street_map.strips.values()):
        line = Polyline(strip.line[:, :2])
        end_m = min(_END_M, 0.25 * line.length_m)
        count = max(2, round(line.length_m / _STEP_M))
        s_m = np.linspace(end_m, line.length_m - end_m, count)
        found.append(np.column_stack([np.interp(s_m, line.s_m, line.points[:, k]) for k in (0, 1)]))
        owners += [number] * count
    for number, corner in enumerate(street_map.corners.values(), len(street_map.strips)):
        points = _corner_points(street_map, corner)
        found.append(points)
        owners += [number] * len(points)
    xy, first = np.unique(np.round(np.concatenate(found), 6), axis=0, return_index=True)
    return np.asarray(xy, dtype=float), np.array(owners, dtype=np.int64)[first]


def _corner_points(street_map: StreetMap, corner: Corner) -> Floats:
    """Return points from the ports of a corner to its middle."""
    ends, outward = [], []
    for port in dict.fromkeys(corner.ports):
        line = street_map.strips[port.strip].line[:, :2]
        end, inner = (line[0], line[1]) if port.end == 0 else (line[-1], line[-2])
        along = (end - inner) / max(float(np.hypot(*(end - inner))), 1e-9)
        ends.append(end)
        outward.append(along)
    if not ends:
        return shapely.get_coordinates(shapely.point_on_surface(corner.polygon))
    middle = np.mean(ends, axis=0)
    rows = [middle[None]]
    for end, along in zip(ends, outward, strict=True):
        start = end + _END_M * along
        rows.append(start[None])
        gap = float(np.hypot(*(middle - start)))
        if len(ends) > 1 and gap > _STEP_M:
            shares = np.arange(0.5 * _STEP_M, gap, 0.5 * _STEP_M)[:, None] / gap
            rows.append(start + shares * (middle - start))
    if len(ends) == 1:
        rows[0] = ends[0][None] + _END_M * outward[0]
    return np.concatenate(rows)


def _with(street_map: StreetMap, ground: DrawnGround) -> StreetMap:
    strips: Mapping[str, Strip] = {
        name: dataclasses.replace(
            strip, polygon=ground.strips[name], width_m=ground.widths_m[name], frontage_m=0.0
        )
        for name, strip in street_map.strips.items()
    }
    corners = {
        name: dataclasses.replace(corner, polygon=ground.corners[name])
        for name, corner in street_map.corners.items()
    }
    every = shapely.total_bounds(
        [strip.polygon for strip in strips.values()] + [c.polygon for c in corners.values()]
    )
    low = np.minimum(every[:2], street_map.bounds[:2]).tolist()
    high = np.maximum(every[2:], street_map.bounds[2:]).tolist()
    return dataclasses.replace(
        street_map,
        strips=strips,
        corners=corners,
        bounds=(low[0], low[1], high[0], high[1]),
        scanned=True,
        uncrowded=ground.uncrowded,
    )


def _parts(shape: shapely.Geometry) -> list[Polygon]:
    return [
        part
        for part in shapely.get_parts(shapely.get_parts(shape))
        if isinstance(part, Polygon) and part.area > _SPECK_M2
    ]


def _whole(parts: list[Polygon]) -> Polygon:
    return max(parts, key=lambda part: float(part.area))


def _several(parts: list[Polygon], corner: Corner) -> Polygon | MultiPolygon:
    if not parts:  # between two pieces that touch
        return shapely.Point(corner.polygon.centroid).buffer(_END_M)
    return overlay.union_all(parts)


def _rings(shape: Polygon | MultiPolygon) -> list[_Rings]:
    return [
        [
            [(x, y) for x, y in shapely.get_coordinates(ring).tolist()]
            for ring in (part.exterior, *part.interiors)
        ]
        for part in shapely.get_parts(shape)
    ]


def _polygon(rings: _Rings) -> Polygon:
    polygon = Polygon(rings[0], rings[1:])
    if polygon.is_empty or not polygon.is_valid:
        raise ValueError("a polygon is not valid")
    return polygon


def _area(parts: list[_Rings]) -> Polygon | MultiPolygon:
    polygons = [_polygon(rings) for rings in parts]
    return polygons[0] if len(polygons) == 1 else MultiPolygon(polygons)

"""Areas of a scan: read from GeoJSON, drawn along a walked path, or drafted from measured ground.

Areas are in the net's frame, in metres. Files may also use WGS84 where the scan has a georeference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.core.errors import MapError, UsageError
from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.medial_axis import opened
from cosim.place.scan import AREA_KINDS, AreaKind, Georeference, HeightGrid, ScanArea

WIDTHS_M: Final = (1.0, 20.0)
"""Smallest and largest width of a corridor, in metres."""
MAX_GRADE: Final = 0.25
"""Largest grade of drafted ground."""
WALKED: Final[frozenset[AreaKind]] = frozenset(("sidewalk", "crossing"))
"""Kinds of areas that people and robots use."""
_APART: Final[frozenset[AreaKind]] = frozenset(("sidewalk", "road", "verge"))
"""Kinds of areas of which two must not overlap."""
_OVERLAP_M2: Final = 0.25
_OUTSIDE_SHARE: Final = 0.02
"""Share of an area that may lie outside of the scan."""
_GAP_M: Final = 0.5
"""Distance from measured ground up to which unmeasured ground counts as covered, in metres."""
_SIMPLE_M: Final = 0.25
"""Tolerance of drafted outlines, in metres."""
_DRAFT_WIDTH_M: Final = 1.2
"""Least width of drafted ground, in metres."""
_DRAFT_M2: Final = 10.0
_SPECK_M2: Final = 1.0
"""Area in m2 below which walkable pieces and holes are dropped."""
_SHIFTS_M: Final = ((4.0, 0.5), (0.5, 0.1))
"""Reach and step of the two rounds of a fit, in metres."""
_FIT_POINTS: Final = 30_000
"""Largest number of points of walkable ground that are compared with the scan in a fit."""
_FAR_DEG: Final = 0.5
"""Distance from the georeference up to which coordinates can be degrees."""


class Fit(NamedTuple):
    """Shift of areas to measured ground.

    x_m, y_m: shift east and north.
    before, after: share of the walkable area on free measured ground.
    """

    x_m: float
    y_m: float
    before: float
    after: float

    def __str__(self) -> str:
        return (
            f"moved by {self.x_m:+.1f} m east and {self.y_m:+.1f} m north to fit the measured "
            f"ground: {self.after:.0%} of the walkable area is on free ground, {self.before:.0%} "
            "before"
        )


def to_local(lonlat: Floats, georeference: Georeference) -> Floats:
    """Convert WGS84 longitudes and latitudes (N, 2), degrees, to metres in the net's frame."""
    origin = np.array([[georeference.longitude_deg, georeference.latitude_deg]])
    lon, lat = np.radians(origin[0]).tolist()
    gap = _earth_centred(lonlat) - _earth_centred(origin)
    east = -math.sin(lon) * gap[:, 0] + math.cos(lon) * gap[:, 1]
    outward = math.cos(lon) * gap[:, 0] + math.sin(lon) * gap[:, 1]
    return np.column_stack([east, -math.sin(lat) * outward + math.cos(lat) * gap[:, 2]])


def _earth_centred(lonlat: Floats) -> Floats:
    lon, lat = np.radians(lonlat).T
    flattening = 1.0 / 298.257223563
    eccentricity2 = flattening * (2.0 - flattening)
    normal_m = 6378137.0 / np.sqrt(1.0 - eccentricity2 * np.sin(lat) ** 2)
    return np.column_stack(
        [
            normal_m * np.cos(lat) * np.cos(lon),
            normal_m * np.cos(lat) * np.sin(lon),
            normal_m * (1.0 - eccentricity2) * np.sin(lat),
        ]
    )


def read_areas(
    path: Path, grid: HeightGrid, georeference: Georeference | None
) -> tuple[ScanArea, ...]:
    """Read drawn areas from a GeoJSON file in WGS84 or in metres of the net's frame.

    A member "frame", "local" or "wgs84", names the frame. Only degrees near the georeference need
    none.

    Raises MapError naming file, feature and remedy.
    """
    features = _features(path)
    place = _placer(path, features, georeference)
    areas: list[tuple[int, ScanArea]] = []
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        kind = (feature.get("properties") or {}).get("kind")
        if kind not in AREA_KINDS:
            raise MapError(f"{where}: kind is {kind!r}, but must be one of {', '.join(AREA_KINDS)}")
        shape = place(_geometry(where, feature))
        for part in shapely.get_parts(shape):
            if not isinstance(part, Polygon) or part.is_empty:
                raise MapError(
                    f"{where} ({kind}): geometry is a {shape.geom_type}, but must be a Polygon or "
                    "MultiPolygon"
                )
            areas.append((number, ScanArea(kind, part)))
    _check(path, areas, grid)
    return tuple(area for _, area in areas)


def read_way(path: Path, georeference: Georeference | None) -> Floats:
    """Read a walked path, (N, 2) metres in the net's frame.

    The file is GeoJSON with a LineString, or JSON with `route`, points of x, y in metres, and
    `lat0`, `lon0`, the WGS84 position of its origin. Raises MapError naming file and reason.
    """
    held = _decoded(path)
    if "route" not in held:
        features = _features(path)
        lines = [_geometry(f"{path}: feature {i}", one) for i, one in enumerate(features)]
        lines = [line for line in lines if isinstance(line, LineString)]
        if len(lines) != 1:
            raise MapError(f"{path}: {len(lines)} LineStrings, but a walked path is one")
        return shapely.get_coordinates(_placer(path, features, georeference)(lines[0]))
    try:
        way = np.array([point[:2] for point in held["route"]], dtype=float).reshape(-1, 2)
        origin = np.array([[held["lon0"], held["lat0"]]], dtype=float) if "lat0" in held else None
    except (KeyError, TypeError, ValueError) as error:
        raise MapError(
            f"{path}: route must be a list of points [x, y] in metres: {error}"
        ) from error
    if len(way) < 2 or not np.isfinite(way).all():
        raise MapError(f"{path}: route must have at least two points, all of them numbers")
    if np.ptp(way, axis=0).max() < _FAR_DEG:
        raise MapError(
            f"{path}: the route's points, {way[0, 0]:.6g}, {way[0, 1]:.6g} and so on, are degrees, "
            "but must be metres: write them as a GeoJSON LineString, and give --georeference"
        )
    return way if origin is None or georeference is None else way + to_local(origin, georeference)


def corridor(way: Floats, width_m: float, grid: HeightGrid) -> tuple[ScanArea, ...]:
    """Return a sidewalk of a width along a walked path, where the scan has ground.

    Raises UsageError for an unusable width, MapError where no ground is near the path.
    """
    low_m, high_m = WIDTHS_M
    if not low_m <= width_m <= high_m:
        raise UsageError(f"--width must be {low_m:g} to {high_m:g} metres, not {width_m:g}")
    band = shapely.buffer(LineString(way), 0.5 * width_m, cap_style="flat", join_style="round")
    parts = _large(overlay.difference(band, uncovered(grid, band)), _SPECK_M2)
    if not parts:
        raise MapError(
            f"the walked path from ({way[0, 0]:.0f}, {way[0, 1]:.0f}) to ({way[-1, 0]:.0f}, "
            f"{way[-1, 1]:.0f}) is not over measured ground: check its frame and georeference"
        )
    return tuple(ScanArea("sidewalk", part) for part in parts)


def draft_areas(
    grid: HeightGrid, grade: NDArray[np.float32], hidden: NDArray[np.bool_] | None = None
) -> tuple[ScanArea, ...]:
    """Return the largest connected piece of level, free, measured ground as a sidewalk.

    It is a draft, in which roads and lawns count as sidewalks.

    grade: (H, W) slope of the ground.
    hidden: (H, W) whether ground is behind walls, as seen from the walked side.

    Raises MapError if no piece is large enough.
    """
    free = grid.measured & ~grid.blocked & (grade < MAX_GRADE)
    if hidden is not None:
        free &= ~hidden
    ground = opened(_cells(grid, free), 0.5 * _DRAFT_WIDTH_M)
    simple = shapely.simplify(shapely.buffer(ground, -0.5 * _SIMPLE_M), _SIMPLE_M)
    parts = [Polygon(part.exterior, _large_rings(part)) for part in _large(simple, _DRAFT_M2)]
    if not parts:
        raise MapError(
            f"no level ground of {_DRAFT_M2:g} m2 without obstacles: check the scan's up axis and "
            "scale, or draw areas"
        )
    return (ScanArea("sidewalk", parts[0]),)


def walkable_ground(areas: Iterable[ScanArea], grid: HeightGrid) -> Polygon | MultiPolygon:
    """Return sidewalks and crossings without obstacles, blocked and uncovered ground, in
    millimetres.

    Raises MapError if nothing remains.
    """
    held = list(areas)
    drawn = overlay.union_all([area.polygon for area in held if area.kind in WALKED])
    if drawn.is_empty:
        raise MapError("no area of kind sidewalk or crossing: nothing is walkable: draw one")
    taken = [area.polygon for area in held if area.kind == "obstacle"]
    blocked = _cells(grid, grid.blocked, drawn)
    free = overlay.difference(drawn, overlay.union_all([*taken, blocked, uncovered(grid, drawn)]))
    parts = _large(shapely.set_precision(free, 1e-3), _SPECK_M2)
    if not parts:
        raise MapError(
            "nothing of the drawn areas is walkable: obstacles cover all, or the scan has no "
            "ground there: compare with `cosim scan areas --draft`"
        )
    return parts[0] if len(parts) == 1 else MultiPolygon(parts)


def uncovered(grid: HeightGrid, around: Polygon | MultiPolygon) -> Polygon | MultiPolygon:
    """Return the part of an area that is farther than half a metre from measured ground."""
    near = _cells(grid, grid.measured, shapely.buffer(around, 2.0 * _GAP_M))
    found: Polygon | MultiPolygon = overlay.difference(around, overlay.grown(near, _GAP_M))
    return found


def fit_to_ground(areas: Sequence[ScanArea], grid: HeightGrid) -> tuple[tuple[ScanArea, ...], Fit]:
    """Move areas by the shift that puts most of their walkable ground on free measured ground.

    Of equal shifts, the smallest is taken. Raises MapError if no walkable ground is over the scan.
    """
    walked = overlay.union_all([area.polygon for area in areas if area.kind in WALKED])
    points = _lattice_points(walked, max(grid.step_m, math.sqrt(walked.area / _FIT_POINTS)))
    free = grid.measured & ~grid.blocked
    x, y, before = 0.0, 0.0, _share_on(points, grid, free)
    for reach_m, step_m in _SHIFTS_M:
        steps = np.arange(-round(reach_m / step_m), round(reach_m / step_m) + 1) * step_m
        tried = [(x + dx, y + dy) for dx in steps.tolist() for dy in steps.tolist()]
        tried.sort(key=lambda one: (round(math.hypot(*one), 6), one))
        shares = [_share_on(points + np.array(one), grid, free) for one in tried]
        best = int(np.argmax(np.round(shares, 3)))
        x, y = tried[best]
    after = _share_on(points + np.array([x, y]), grid, free)
    if after == 0.0:
        raise MapError("the map's sidewalks are not over the scan: check its georeference")

    def move(xy: Floats) -> Floats:
        return np.asarray(xy + np.array([x, y]))

    moved = [ScanArea(area.kind, shapely.transform(area.polygon, move)) for area in areas]
    return tuple(moved), Fit(round(x, 2), round(y, 2), before, after)


def cut_to_scan(areas: Iterable[ScanArea], grid: HeightGrid) -> tuple[ScanArea, ...]:
    """Return the parts of areas over the scan, of at least 1 m2."""
    box = grid_box(grid)
    return tuple(
        ScanArea(area.kind, part)
        for area in areas
        for part in _large(overlay.intersection(area.polygon, box), _SPECK_M2)
    )


def grid_box(grid: HeightGrid) -> Polygon:
    """Return the rectangle that a height grid covers."""
    rows, columns = grid.heights.shape
    x0, y0 = grid.origin.tolist()
    found: Polygon = shapely.box(
        x0, y0, x0 + (columns - 1) * grid.step_m, y0 + (rows - 1) * grid.step_m
    )
    return found


def _lattice_points(area: Polygon | MultiPolygon, step_m: float) -> Floats:
    if area.is_empty:
        raise MapError("the map has no sidewalks or crossings: draw areas by hand")
    x0, y0, x1, y1 = area.bounds
    half_m = 0.5 * step_m
    columns, rows = np.arange(x0 + half_m, x1, step_m), np.arange(y0 + half_m, y1, step_m)
    x, y = (v.ravel() for v in np.meshgrid(columns, rows))
    inside = shapely.contains_xy(area, x, y)
    return np.column_stack([x[inside], y[inside]])


def _share_on(points: Floats, grid: HeightGrid, free: NDArray[np.bool_]) -> float:
    """Return the share of the points over the scan's lattice that are on free points of it."""
    at = np.rint((points - grid.origin) / grid.step_m).astype(int)
    inside = ((at >= 0) & (at < np.array(free.shape[::-1]))).all(axis=1)
    if not inside.any():
        return 0.0
    return float(free[at[inside, 1], at[inside, 0]].mean())


def _cells(
    grid: HeightGrid, wanted: NDArray[np.bool_], within: Polygon | MultiPolygon | None = None
) -> Polygon | MultiPolygon:
    """Return the union of the cells around wanted lattice points, near an area if given."""
    x0, y0 = grid.origin.tolist()
    rows, columns = wanted.shape
    first, last = np.zeros(2, dtype=int), np.array([columns, rows])
    if within is not None:
        if within.is_empty:
            return Polygon()
        low, high = np.array(within.bounds).reshape(2, 2)
        first = np.clip(np.floor((low - grid.origin) / grid.step_m).astype(int) - 1, 0, last)
        last = np.clip(np.ceil((high - grid.origin) / grid.step_m).astype(int) + 2, first, last)
    part = np.zeros((last[1] - first[1], last[0] - first[0] + 2), dtype=np.int8)
    part[:, 1:-1] = wanted[first[1] : last[1], first[0] : last[0]]
    steps = np.diff(part, axis=1)
    row, begin = np.nonzero(steps == 1)
    end = np.nonzero(steps == -1)[1]
    half = 0.5 * grid.step_m
    west = x0 + (first[0] + begin) * grid.step_m - half
    east = x0 + (first[0] + end) * grid.step_m - half
    middle = y0 + (first[1] + row) * grid.step_m
    boxes = shapely.box(west, middle - half, east, middle + half)
    # A grid makes the shared sides of cells equal to the bit.
    found: Any = shapely.union_all(boxes, grid_size=1e-4)
    return found if isinstance(found, Polygon | MultiPolygon) else Polygon()


def _large(shape: shapely.Geometry, least_m2: float) -> list[Polygon]:
    """Return the polygons of a shape of at least an area, largest first."""
    parts = [
        part
        for part in shapely.get_parts(shapely.get_parts(shape))
        if isinstance(part, Polygon) and part.area >= least_m2
    ]
    return sorted(parts, key=lambda part: (-part.area, part.bounds))


def _large_rings(part: Polygon) -> list[Any]:
    """Return the holes of a drafted piece that are no specks."""
    return [ring for ring in part.interiors if Polygon(ring).area >= 2.0 * _SIMPLE_M**2]


def _decoded(path: Path) -> Mapping[str, Any]:
    try:
        held = msgspec.json.decode(path.read_bytes())
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror}") from error
    except msgspec.DecodeError as error:
        raise MapError(f"{path}: no JSON: {error}") from error
    if not isinstance(held, dict):
        raise MapError(f"{path}: must be a JSON object, not a {type(held).__name__}")
    return held


def _features(path: Path) -> list[Mapping[str, Any]]:
    held = _decoded(path)
    features = held.get("features") if held.get("type") == "FeatureCollection" else [held]
    if not isinstance(features, list) or not all(isinstance(one, dict) for one in features):
        raise MapError(f"{path}: features must be a list of GeoJSON features")
    if not features:
        raise MapError(f"{path}: no features: draw at least one sidewalk")
    return [{"frame": held.get("frame"), **one} for one in features]


def _geometry(where: str, feature: Mapping[str, Any]) -> Any:
    held: Any = feature.get("geometry") if feature.get("type") == "Feature" else feature
    try:
        return shapely.force_2d(shapely.geometry.shape(held))
    except Exception as error:  # shapely raises errors of many kinds for damaged geometry
        raise MapError(f"{where}: geometry cannot be read: {error}") from error


def _placer(
    path: Path, features: Sequence[Mapping[str, Any]], georeference: Georeference | None
) -> Callable[[Any], Any]:
    """Return the function that moves geometry of a file into the net's frame."""
    frame = features[0].get("frame")
    if frame not in (None, "local", "wgs84"):
        raise MapError(f"{path}: frame is {frame!r}, but must be 'local' or 'wgs84'")
    xy = np.concatenate(
        [
            shapely.get_coordinates(_geometry(f"{path}: feature {i}", f))
            for i, f in enumerate(features)
        ]
    )
    if not len(xy) or not np.isfinite(xy).all():
        raise MapError(f"{path}: coordinates must be finite numbers")
    if not _in_degrees(path, xy, frame, georeference):
        return lambda shape: shape
    assert georeference is not None
    return lambda shape: shapely.transform(shape, lambda lonlat: to_local(lonlat, georeference))


def _in_degrees(
    path: Path, xy: Floats, frame: str | None, georeference: Georeference | None
) -> bool:
    """Return whether coordinates (N, 2) are degrees near the georeference, and not metres.

    Raises MapError with their range and the remedy if they do not fit the frame, or need one.
    """
    (x0, y0), (x1, y1) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    words = f"{path}: its coordinates, {x0:.6g} to {x1:.6g} and {y0:.6g} to {y1:.6g}, are"
    # Metres of drawn ground extend farther.
    small = bool(np.ptp(xy, axis=0).max() < _FAR_DEG)
    degrees = small and max(abs(x0), abs(x1)) <= 180.0 and max(abs(y0), abs(y1)) <= 90.0
    if not degrees and frame == "local":
        return False
    if not degrees:
        here = "" if frame is None else ", but its frame is 'wgs84'"
        raise MapError(
            f"{words} no degrees in a small area{here}: for metres of the map, write "
            '"frame": "local" beside "type"'
        )
    if georeference is None:
        raise MapError(
            f"{words} degrees, but the scan has no georeference: import it with --georeference "
            "LATITUDE,LONGITUDE of its origin, or draw in metres of the map with "
            '"frame": "local"'
        )
    if frame == "local":
        raise MapError(
            f"{words} degrees, but its frame is 'local', metres of the map: write "
            '"frame": "wgs84"'
        )
    lat, lon = georeference.latitude_deg, georeference.longitude_deg
    if not (np.abs(xy - np.array([lon, lat])) < _FAR_DEG).all():
        raise MapError(
            f"{words} degrees far from the scan, at longitude {lon:.6g} and latitude {lat:.6g}: "
            "coordinates are longitude, latitude; check them, and --georeference"
        )
    return True


def _check(path: Path, areas: Sequence[tuple[int, ScanArea]], grid: HeightGrid) -> None:
    """Raise MapError for the first area that crosses itself, leaves the scan or overlaps."""
    box = grid_box(grid)
    for number, area in areas:
        where = f"{path}: feature {number} ({area.kind})"
        if not area.polygon.is_valid:
            reason = shapely.is_valid_reason(area.polygon)
            raise MapError(f"{where}: its outline is not valid: {reason}: redraw it")
        outside = float(shapely.area(shapely.difference(area.polygon, box)))
        if outside > _OUTSIDE_SHARE * area.polygon.area:
            x0, y0, x1, y1 = box.bounds
            raise MapError(
                f"{where}: {outside / area.polygon.area:.0%} of it is outside of the scan, which "
                f"covers x {x0:.1f} to {x1:.1f} and y {y0:.1f} to {y1:.1f} m: move it, or check "
                "frame and georeference"
            )
    apart = [one for one in areas if one[1].kind in _APART]
    for (i, one), (k, other) in combinations(apart, 2):
        if one.kind != other.kind:
            both = float(shapely.area(shapely.intersection(one.polygon, other.polygon)))
            if both > _OVERLAP_M2:
                raise MapError(
                    f"{path}: features {i} ({one.kind}) and {k} ({other.kind}) overlap by "
                    f"{both:.1f} m2: ground can be only one of them"
                )

"""Areas of scans: reading, checks, corridors, drafts and fits."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from cosim.core.errors import MapError, UsageError
from cosim.place.scan import Georeference, ScanArea, encode_areas
from cosim.place.scan_areas import (
    corridor,
    draft_areas,
    fit_to_ground,
    read_areas,
    read_way,
    to_local,
    walkable_ground,
)
from tests.support.flat_scans import STREET_GRID, flat_grid, street_areas

LUND = Georeference(latitude_deg=55.698166667, longitude_deg=13.195388889)
GRID = flat_grid(0.0, 0.0, 40.0, 20.0)


def square(x: float, y: float, size: float = 4.0) -> dict[str, Any]:
    ring = [[x, y], [x + size, y], [x + size, y + size], [x, y + size], [x, y]]
    return {"type": "Polygon", "coordinates": [ring]}


def feature(kind: str, geometry: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "properties": {"kind": kind}, "geometry": geometry}


def write_geojson(path: Path, *features: dict[str, Any], frame: str | None = "local") -> Path:
    stated = {} if frame is None else {"frame": frame}
    path.write_text(json.dumps({"type": "FeatureCollection", **stated, "features": features}))
    return path


def test_local_and_wgs84_files_give_equal_areas(tmp_path: Path) -> None:
    """Areas in degrees near the georeference equal those in metres of the map, whose frame is
    named."""
    degrees = np.array([[13.1955, 55.6982], [13.1957, 55.6982], [13.1957, 55.6983]])
    metres = to_local(degrees, LUND)
    assert metres[1, 0] - metres[0, 0] == pytest.approx(12.57, abs=0.02)
    assert metres[2, 1] - metres[1, 1] == pytest.approx(11.14, abs=0.02)
    rings = [
        {"type": "Polygon", "coordinates": [[*r.tolist(), r[0].tolist()]]}
        for r in (degrees, metres)
    ]
    files = [
        write_geojson(tmp_path / f"{i}.geojson", feature("sidewalk", ring), frame=frame)
        for i, (ring, frame) in enumerate(zip(rings, (None, "local"), strict=True))
    ]
    one, other = (read_areas(path, GRID, LUND)[0].polygon for path in files)
    assert shapely.hausdorff_distance(one, other) < 1e-6
    named = write_geojson(tmp_path / "named.geojson", feature("sidewalk", rings[0]), frame="wgs84")
    assert read_areas(named, GRID, LUND)[0].polygon.equals(one)


FAR = Georeference(latitude_deg=-33.0, longitude_deg=151.0)
DEGREES = square(13.1955, 55.6982, 2e-4)
METRES = square(3.0, 2.0)
CONFUSED: dict[str, tuple[dict[str, Any], str | None, Georeference | None, str]] = {
    "metres without frame": (
        METRES,
        None,
        LUND,
        r"3 to 7 and 2 to 6, are no degrees in a small area: for metres .* \"frame\": \"local\"",
    ),
    "metres without frame and georeference": (METRES, None, None, r"are no degrees"),
    "metres as degrees": (METRES, "wgs84", LUND, "no degrees .* but its frame is 'wgs84'"),
    "degrees without georeference": (
        DEGREES,
        None,
        None,
        r"13\.1955 to 13\.1957 and 55\.6982 .*, are degrees, .* --georeference LATITUDE,LONGITUDE",
    ),
    "degrees as metres": (DEGREES, "local", LUND, "are degrees, but its frame is 'local'"),
    "degrees as metres without georeference": (DEGREES, "local", None, "with --georeference"),
    "degrees elsewhere": (DEGREES, None, FAR, "far from the scan, at longitude 151 .* -33"),
}


@pytest.mark.parametrize("name", CONFUSED)
def test_metres_and_degrees_are_not_confused(tmp_path: Path, name: str) -> None:
    """Areas and paths in another unit than their frame are refused with their range and remedy."""
    geometry, frame, expected, words = CONFUSED[name]
    path = write_geojson(tmp_path / "a.geojson", feature("sidewalk", geometry), frame=frame)
    with pytest.raises(MapError, match=words):
        read_areas(path, GRID, expected)
    line = {"type": "LineString", "coordinates": geometry["coordinates"][0][:3]}
    path = write_geojson(tmp_path / "way.geojson", feature("", line), frame=frame)
    with pytest.raises(MapError, match=r"are (no )?degrees"):
        read_way(path, expected)
    if frame == "local" and expected is None:
        route = {"route": line["coordinates"]}
        (tmp_path / "way.json").write_text(json.dumps(route))
        with pytest.raises(MapError, match=r"way\.json: .* are degrees, .* --georeference"):
            read_way(tmp_path / "way.json", expected)


def test_areas_survive_writing_and_reading(tmp_path: Path) -> None:
    """Areas written for editing read back unchanged, holes included."""
    holed = shapely.box(1, 1, 9, 9) - shapely.box(3, 3, 5, 5)
    areas = [ScanArea("sidewalk", holed), ScanArea("obstacle", shapely.box(6, 6, 7, 7))]
    (tmp_path / "areas.geojson").write_bytes(encode_areas(areas, step_m=0.01))
    read = read_areas(tmp_path / "areas.geojson", GRID, LUND)
    assert [area.kind for area in read] == ["sidewalk", "obstacle"]
    assert all(a.polygon.equals(b.polygon) for a, b in zip(areas, read, strict=True))


BOW = {"type": "Polygon", "coordinates": [[[1, 1], [5, 5], [5, 1], [1, 5], [1, 1]]]}
WRONG = {
    "kind": ([feature("pavement", square(1, 1))], r"feature 0: kind is 'pavement', but must be"),
    "line": (
        [feature("road", {"type": "LineString", "coordinates": [[0, 0], [1, 1]]})],
        r"feature 0 \(road\): geometry is a LineString",
    ),
    "bow": ([feature("verge", BOW)], r"feature 0 \(verge\): its outline is not valid: Self-inter"),
    "outside": (
        [feature("sidewalk", square(1, 1)), feature("sidewalk", square(38, 2))],
        r"feature 1 \(sidewalk\): 50% of it is outside of the scan, which covers x 0\.0 to 40\.0",
    ),
    "overlap": (
        [feature("sidewalk", square(1, 1)), feature("road", square(4, 1))],
        r"features 0 \(sidewalk\) and 1 \(road\) overlap by 4\.0 m2",
    ),
    "geometry": ([feature("road", {"type": "Polygon"})], r"feature 0: geometry cannot be read"),
    "none": ([], r"no features: draw at least one sidewalk"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_areas_are_refused(tmp_path: Path, name: str) -> None:
    """The error names file, feature and reason."""
    features, words = WRONG[name]
    path = write_geojson(tmp_path / "areas.geojson", *features)
    with pytest.raises(MapError, match=rf"areas\.geojson: {words}"):
        read_areas(path, GRID, None)


def test_files_that_are_no_geojson_are_refused(tmp_path: Path) -> None:
    """Missing files, broken JSON and other frames are refused."""
    with pytest.raises(MapError, match="cannot be read"):
        read_areas(tmp_path / "none.geojson", GRID, None)
    (tmp_path / "broken.geojson").write_text("{")
    with pytest.raises(MapError, match="no JSON"):
        read_areas(tmp_path / "broken.geojson", GRID, None)
    other = write_geojson(tmp_path / "other.geojson", feature("road", square(1, 1)), frame="utm")
    with pytest.raises(MapError, match="frame is 'utm', but must be 'local' or 'wgs84'"):
        read_areas(other, GRID, None)


def test_walked_paths_of_both_formats_are_equal(tmp_path: Path) -> None:
    """A route with an origin and a GeoJSON line in degrees lead along the same places."""
    origin = np.array([[13.1956, 55.6982]])
    (tmp_path / "way.json").write_text(
        json.dumps({"lat0": 55.6982, "lon0": 13.1956, "route": [[0, 0, 1.0], [5, 9, 1.1]]})
    )
    way = read_way(tmp_path / "way.json", LUND)
    assert way[0] == pytest.approx(to_local(origin, LUND)[0])
    line = {"type": "LineString", "coordinates": [*origin.tolist(), [13.1957, 55.6983]]}
    path = write_geojson(
        tmp_path / "way.geojson",
        {"type": "Feature", "properties": {}, "geometry": line},
        frame=None,
    )
    assert read_way(path, LUND)[0] == pytest.approx(way[0])
    (tmp_path / "short.json").write_text('{"route": [[0, 0]]}')
    with pytest.raises(MapError, match="at least two points"):
        read_way(tmp_path / "short.json", None)


def test_a_corridor_covers_measured_ground_alone() -> None:
    """It has the requested width and ends where the scan has no ground."""
    measured = GRID.measured.copy()
    measured[:, 121:] = False
    grid = dataclasses.replace(GRID, measured=measured)
    way = np.array([[2.0, 10.0], [38.0, 10.0]])
    (area,) = corridor(way, 3.0, grid)
    assert area.kind == "sidewalk"
    assert area.polygon.bounds == pytest.approx((2.0, 8.5, 30.6, 11.5), abs=0.15)
    with pytest.raises(UsageError, match=r"--width must be 1 to 20 metres, not 0\.5"):
        corridor(way, 0.5, grid)
    with pytest.raises(MapError, match="not over measured ground"):
        corridor(way + 100.0, 3.0, grid)


def test_walkable_ground_is_drawn_ground_without_obstacles() -> None:
    """Obstacles, blocked cells and uncovered ground are left out."""
    blocked = STREET_GRID.blocked.copy()
    blocked[22:27, 60:65] = True  # x 10 to 11, y 0.5 to 1.5
    grid = dataclasses.replace(STREET_GRID, blocked=blocked)
    ground = walkable_ground(street_areas(), grid)
    assert ground.area == pytest.approx(
        100 * 3 + 100 * 4 + 46 * 3 + 4 * 7 - 0.7 - 1.25**2, abs=1e-6
    )
    only_road = [ScanArea("road", shapely.box(0, 0, 9, 9))]
    with pytest.raises(MapError, match="no area of kind sidewalk or crossing"):
        walkable_ground(only_road, grid)
    nothing = dataclasses.replace(grid, measured=np.zeros_like(grid.measured))
    with pytest.raises(MapError, match="nothing of the drawn areas is walkable"):
        walkable_ground(street_areas(), nothing)


def test_a_draft_is_the_largest_level_free_piece() -> None:
    """Steep, blocked and unmeasured ground is left out, and so is what lies behind it."""
    grade = np.zeros(GRID.heights.shape, dtype=np.float32)
    grade[:, 80:84] = 1.0  # a step at x = 20 to 21
    blocked = GRID.blocked.copy()
    blocked[36:44, 40:48] = True  # x 10 to 12, y 9 to 11
    (area,) = draft_areas(dataclasses.replace(GRID, blocked=blocked), grade)
    assert 360.0 < area.polygon.area < 396.0
    assert not area.polygon.intersects(shapely.box(20.1, 0, 40.0, 20))
    assert not area.polygon.contains(shapely.Point(11.0, 10.0))
    with pytest.raises(MapError, match="no level ground of 10 m2"):
        draft_areas(GRID, grade + 1.0)


def test_areas_of_a_map_are_moved_to_free_ground() -> None:
    """A sidewalk between two walls is found again after a shift, which is reported."""
    blocked = np.ones(GRID.heights.shape, dtype=bool)
    blocked[32:45] = False  # y 8 to 11
    grid = dataclasses.replace(GRID, blocked=blocked)
    drawn = [ScanArea("sidewalk", shapely.box(5, 10.1, 35, 13.1))]
    (moved,), fit = fit_to_ground(drawn, grid)
    assert moved.polygon.bounds == pytest.approx((5, 8, 35, 11), abs=0.26)
    assert fit.before < 0.4 < 0.95 < fit.after and "-1.9 m north" in str(fit)
    with pytest.raises(MapError, match="not over the scan"):
        fit_to_ground([ScanArea("sidewalk", shapely.box(500, 500, 510, 503))], grid)

"""Generated scans: a part of a generated city as mesh, splats and areas."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from cosim.core.errors import UsageError
from cosim.place.scan import parse_areas
from cosim.spec.scenario import City
from physics.scans.write_splats import SPLAT_ROW
from scenarios.places.nets import surface_of_place
from scenarios.places.scan_make import crossing_box, make_scan

CITY = City(seed=7, size_m=300.0)


def splat_rows(folder: Path) -> NDArray[np.void]:
    data = (folder / "splats.ply").read_bytes()
    return np.frombuffer(data[data.index(b"end_header\n") + 11 :], dtype=SPLAT_ROW)


def test_a_generated_scan_has_the_ground_of_its_street(tmp_path: Path) -> None:
    """Vertices and splats lie on the street's surfaces, and the areas are those of its map."""
    count = make_scan(CITY, None, tmp_path / "a", spacing_m=0.5)
    facts = json.loads((tmp_path / "a" / "scan.json").read_text())
    assert facts["up"] == "+z" and 0.0 < facts["sun"]["elevation_deg"] < 90.0
    areas = parse_areas((tmp_path / "a" / "areas.geojson").read_bytes())
    assert {"sidewalk", "crossing", "road"} <= {area.kind for area in areas}
    rows = splat_rows(tmp_path / "a")
    assert len(rows) == count > 20_000
    surface = surface_of_place(CITY)
    x0, y0, x1, y1 = crossing_box(surface.street_map)
    middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
    walkable = shapely.union_all([a.polygon for a in areas if a.kind in ("sidewalk", "crossing")])
    at = np.stack([rows["x"], rows["y"], rows["z"]], axis=1).astype(float)
    upright = np.abs(rows["rot_0"]) > 0.999
    low = upright & shapely.contains_xy(walkable, at[:, 0], at[:, 1]) & (at[:, 2] < 0.3)
    expected = surface.heights(at[low, :2] + middle)
    assert low.sum() > 3000
    assert np.percentile(np.abs(at[low, 2] - expected), 99) < 0.01


def test_a_scan_is_generated_again_to_the_byte(tmp_path: Path) -> None:
    """Two scans of a small box have the same files."""
    x0, y0, x1, y1 = crossing_box(surface_of_place(CITY).street_map)
    box = (x0 + 28.0, y0 + 18.0, x1 - 28.0, y1 - 18.0)
    for folder in ("a", "b"):
        make_scan(CITY, box, tmp_path / folder, spacing_m=0.3)
    for name in ("mesh.ply", "splats.ply", "areas.geojson", "scan.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize(
    ("box", "words"),
    [
        ((0.0, 0.0, 5.0, 50.0), "--box must be x0,y0,x1,y1 with sides of 10 to 300 m, not 5 x 50"),
        ((250.0, 250.0, 350.0, 300.0), "is not within the city, which covers"),
    ],
)
def test_a_box_outside_of_the_city_is_refused(
    tmp_path: Path, box: tuple[float, float, float, float], words: str
) -> None:
    """The error has the limits, and nothing is written."""
    with pytest.raises(UsageError, match=words):
        make_scan(CITY, box, tmp_path / "a")
    assert not (tmp_path / "a").exists()

"""Both looks of a scan: its splats and its mesh show the same street."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Pose
from cosim.core.state import Street
from cosim.spec.camera import CameraSpec
from cosim.spec.scenario import City, CityMap
from physics.cameras.gl.camera import GlCamera
from physics.dynamics.world import BulletWorld
from scenarios.places.nets import surface_of_place
from scenarios.places.scan_import import import_scan
from scenarios.places.scan_make import crossing_box, make_scan
from scenarios.places.scan_options import read_options

POSES = 12
NEAR_M = 20.0


@pytest.mark.engine
def test_the_splats_of_a_scan_match_its_mesh(tmp_path: Path) -> None:
    """Over drawn poses on a generated scan, pictures agree to 24 dB, depths to 5 cm for 90 % of the
    pixels within 20 m, and labels for 97 %."""
    city = City(seed=7, size_m=300.0)
    x0, y0, x1, y1 = crossing_box(surface_of_place(city).street_map)
    box = (x0 + 25.0, y0 + 15.0, x1 - 25.0, y1 - 15.0)
    make_scan(city, box, tmp_path / "looks", spacing_m=0.05)
    import_scan(tmp_path / "looks", read_options(tmp_path / "looks", {}))
    surface = surface_of_place(CityMap(map="looks"))
    assert surface.scan is not None
    walkable = [a.polygon for a in surface.scan.areas if a.kind in ("sidewalk", "crossing")]
    ground = shapely.buffer(shapely.union_all(walkable), -0.6)
    rng = np.random.default_rng(1)
    spec = CameraSpec(width=256, height=144)
    psnr_db: list[float] = []
    with (
        BulletWorld(surface) as world,
        GlCamera(world, spec, depth=True, appearance="mesh") as mesh,
        GlCamera(world, spec, depth=True, appearance="splats") as splats,
    ):
        while len(psnr_db) < POSES:
            x, y = rng.uniform(ground.bounds[:2], ground.bounds[2:])
            if not shapely.contains_xy(ground, x, y):
                continue
            robot = world.place(Pose(x, y, rng.uniform(-math.pi, math.pi)))
            one, other = mesh.render(robot, Street(0)), splats.render(robot, Street(0))
            assert one.labels is not None and other.labels is not None
            assert one.depth is not None and other.depth is not None
            seen = one.labels > 0
            error = (one.rgb.astype(float) - other.rgb)[seen]
            psnr_db.append(10.0 * math.log10(255.0**2 / (error**2).mean()))
            gap_m = np.abs(one.depth - other.depth)[seen & (one.depth < NEAR_M)]
            assert np.percentile(gap_m, 90) < 0.05
            assert (one.labels == other.labels).mean() > 0.97
    assert np.median(psnr_db) > 24.0, psnr_db

"""An imported generated scan: both looks show the same street, and robots stand on its mesh."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
import shapely

from cosim.core.geometry import Pose
from cosim.core.state import Command, Street
from cosim.place.scan import ScanMesh, read_facts
from cosim.results.record import RECORD_FILE, ScanLook
from cosim.results.table import table_row
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import City, CityMap, CrowdSpec, Scenario
from physics.cameras.gl.camera import GlCamera
from physics.dynamics.world import BulletWorld
from scenarios.episodes.episode import Episode
from scenarios.places.nets import surface_of_place
from scenarios.places.scan_import import import_scan
from scenarios.places.scan_make import crossing_box, make_scan
from scenarios.places.scan_options import read_options
from sumo_nets.maps.map_store import maps_folder, read_map

POSES = 12
NEAR_M = 20.0


@pytest.fixture(scope="module")
def looks_map(tmp_path_factory: pytest.TempPathFactory) -> CityMap:
    """Return a generated scan of 30 x 30 m."""
    folder = tmp_path_factory.mktemp("scans") / "looks"
    city = City(seed=7, size_m=300.0)
    x0, y0, x1, y1 = crossing_box(surface_of_place(city).street_map)
    box = (x0 + 25.0, y0 + 15.0, x1 - 25.0, y1 - 15.0)
    make_scan(city, box, folder, spacing_m=0.05)
    import_scan(folder, read_options(folder, {}))
    return CityMap(map="looks")


@pytest.mark.engine
def test_a_record_has_the_look_that_the_cameras_saw(looks_map: CityMap) -> None:
    """A record has the splats' hash and the sun with a camera, no splats with the mesh's look, and
    no look without a camera. The state is the same."""
    line = max(read_map("looks").strips.values(), key=lambda strip: strip.length_m).line[:, :2]
    scenario = Scenario(
        id="look",
        suite="looks",
        place=looks_map,
        seed=0,
        start=(*line[0].tolist(), math.atan2(*(line[1] - line[0])[::-1])),
        goal=tuple(line[-1].tolist()),
        route=tuple(map(tuple, line.tolist())),
        crowd=CrowdSpec(persons=0, vehicles=0),
        time_limit_s=1.0,
    )
    manifests = {
        True: Manifest("seeing", camera=CameraSpec(64, 36)),
        False: Manifest("blind", camera=None),
    }
    records = {}
    for sees, appearance in ((True, "splats"), (True, "mesh"), (False, "splats")):
        with Episode(scenario, manifests[sees], EpisodeOptions(appearance=appearance)) as episode:
            episode.reset()
            while not episode.over:
                episode.advance(Command(0.3, 0.0))
            records[sees, appearance] = episode.result()[0]
    facts = read_facts(maps_folder() / "looks")
    assert facts.sun is not None
    splats, mesh, blind = records.values()
    assert splats.scan == ScanLook(
        appearance="splats",
        splats=facts.splats_hash,
        sun_azimuth_deg=facts.sun.azimuth_deg,
        sun_elevation_deg=facts.sun.elevation_deg,
    )
    assert mesh.scan == msgspec.structs.replace(splats.scan, appearance="mesh", splats="")
    assert blind.scan is None and "scan" not in table_row(splats)
    assert len({record.state_hash for record in records.values()}) == 1
    assert RECORD_FILE.decode(splats.encoded()).scan == splats.scan


@pytest.mark.engine
def test_the_splats_of_a_scan_match_its_mesh(looks_map: CityMap) -> None:
    """At drawn poses pictures agree to 24 dB, depths to 5 cm for 90 % of the pixels within 20 m,
    and labels for 97 %."""
    surface = surface_of_place(looks_map)
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


STARTS = 1000


@pytest.mark.engine
def test_robots_stand_on_the_mesh_wherever_they_start(looks_map: CityMap) -> None:
    """At 1,000 random places the robot has not moved after 0.1 s, and its base is within 2 cm of
    the mesh under its wheels."""
    surface = surface_of_place(looks_map)
    assert surface.scan is not None
    inside = shapely.buffer(read_map("looks").walkable, -0.5)
    rng = np.random.default_rng(4)
    xy = rng.uniform(inside.bounds[:2], inside.bounds[2:], (20 * STARTS, 2))
    xy = xy[shapely.contains_xy(inside, xy)][:STARTS]
    headings = rng.uniform(-math.pi, math.pi, len(xy))
    stands = np.empty((STARTS, 3))
    with BulletWorld(surface) as world:
        ahead, aside = (0.5 * side for side in world.robot.drive.span_m)
        for i, (x, y) in enumerate(xy.tolist()):
            world.place(Pose(x, y, float(headings[i])))
            for _ in range(2):
                robot = world.step(Command(0.0, 0.0), Street(0), Street(0), 10).robot
            stands[i] = robot.pose.x_m, robot.pose.y_m, robot.z_m
    wheels = np.array([(a * ahead, b * aside) for a in (1, -1) for b in (1, -1)])
    cos, sin = np.cos(headings)[:, None], np.sin(headings)[:, None]
    turned = np.stack(
        [cos * wheels[:, 0] - sin * wheels[:, 1], sin * wheels[:, 0] + cos * wheels[:, 1]], 2
    )
    ground = _mesh_heights(surface.scan.mesh, (xy[:, None] + turned).reshape(-1, 2)).reshape(-1, 4)
    assert np.abs(stands[:, 2] - ground.mean(axis=1)).max() < 0.02
    assert np.hypot(*(stands[:, :2] - xy).T).max() < 0.02


def _mesh_heights(mesh: ScanMesh, xy: np.ndarray) -> np.ndarray:
    """Return the height of the lowest triangle over each (N, 2) point that faces up, (N,)."""
    corners = mesh.vertices.astype(float)[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    up = normals[:, 2] > 0.5 * np.linalg.norm(normals, axis=1)
    corners, normals = corners[up], normals[up]
    tree = shapely.STRtree(shapely.polygons(corners[:, :, :2]))
    point, triangle = tree.query(shapely.points(xy), predicate="intersects")
    offset = xy[point] - corners[triangle, 0, :2]
    n = normals[triangle]
    z = corners[triangle, 0, 2] - (n[:, 0] * offset[:, 0] + n[:, 1] * offset[:, 1]) / n[:, 2]
    lowest = np.full(len(xy), np.inf)
    np.minimum.at(lowest, point, z)
    return lowest

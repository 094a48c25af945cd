"""Surfaces of scanned places: ground, obstacles, and camera pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Pose
from cosim.core.state import LABELS, Command, Street
from cosim.place.scan import HeightGrid, Scan, ScanArea, ScanFacts, ScanMesh
from cosim.results.run_setup import appearance_of
from cosim.spec.camera import CameraSpec
from physics.cameras.bullet_camera import BulletCamera
from physics.cameras.choice import renderer_of
from physics.cameras.gl.camera import GlCamera
from physics.dynamics.world import BulletWorld
from physics.ground.tiles import tiles_touching
from physics.street.scan_surface import ScanSurface
from tests.support.tiny_street import tiny_map

GRADE = 0.04
WALL_X_M = 8.0
SIZE_M = 24.0


def sloped_scan(*, hole: bool = False, kind: str = "sidewalk", grid_m: float = SIZE_M) -> Scan:
    """Return a scanned slope with a wall across it, in two colours; its middle may be missing.
    grid_m: half the side of the height grid, which may be larger than the mesh."""
    at = np.arange(-SIZE_M, SIZE_M + 0.1, 1.0)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    ground = np.column_stack([x, y, GRADE * x])
    count = len(at)
    first = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    squares = np.stack([first, first + 1, first + count + 1, first + count], axis=1)
    if hole:
        middle = ground[squares].mean(axis=1)
        squares = squares[np.abs(middle[:, :2]).max(axis=1) > 2.0]
    foot = GRADE * WALL_X_M
    wall = np.array([(WALL_X_M, y, foot + z) for y in (-6.0, 6.0) for z in (-0.2, 3.0)])
    triangles = np.concatenate(
        [
            squares[:, [0, 1, 2]],
            squares[:, [0, 2, 3]],
            len(ground) + np.array([[0, 1, 3], [0, 3, 2]]),
        ]
    ).astype(np.int32)
    colours = np.concatenate([np.full((len(ground), 3), 120), np.tile((200, 60, 40), (4, 1))])
    lattice = np.arange(-grid_m, grid_m + 0.1, 0.25)
    heights = np.tile(GRADE * lattice, (len(lattice), 1)).astype(np.float32)
    near = np.abs(lattice) <= 2.0
    measured = ~(near[:, None] & near) if hole else np.ones(heights.shape, dtype=bool)
    facts = ScanFacts(
        name="slope",
        files={},
        scale=1.0,
        up="+z",
        transform=tuple(tuple(map(float, row)) for row in np.eye(4)),
        mesh_hash=f"slope-{hole}-{grid_m}",
        areas_hash=kind,
    )
    return Scan(
        facts,
        ScanMesh(
            np.concatenate([ground, wall]).astype(np.float32),
            triangles,
            colours.astype(np.uint8),
            np.zeros(len(triangles), dtype=np.uint8),
        ),
        HeightGrid(np.full(2, -grid_m), 0.25, heights, measured, ~measured),
        (ScanArea(kind, shapely.box(-16.0, -3.0, 16.0, 3.0)),),
    )


def surface_of(scan: Scan) -> ScanSurface:
    return ScanSurface(tiny_map(), scan, 0)


def test_a_robot_stands_and_drives_on_the_scanned_ground() -> None:
    """Its base is within a centimetre of the slope after 2 s of driving from any place."""
    surface = surface_of(sloped_scan())
    with BulletWorld(surface) as world:
        for x, y, heading in ((-10.0, 1.0, 0.3), (0.0, -2.0, 2.0), (3.0, 8.0, -1.0)):
            world.place(Pose(x, y, heading))
            for _ in range(40):
                robot = world.step(Command(0.5, 0.0), Street(0), Street(0), 10).robot
            expected_m, _, _ = surface.lean(robot.pose, world.robot.drive.span_m)
            assert robot.z_m == pytest.approx(expected_m, abs=0.01)
            assert math.dist((robot.pose.x_m, robot.pose.y_m), (x, y)) > 0.5


def test_a_scanned_wall_stops_a_robot_and_hides_people() -> None:
    """The contact is with a wall, and only points behind the wall are hidden."""
    with BulletWorld(surface_of(sloped_scan())) as world:
        world.place(Pose(WALL_X_M - 1.5, 0.0, 0.0))
        motions = [world.step(Command(1.0, 0.0), Street(0), Street(0), 10) for _ in range(60)]
        assert any(contact.kind == "wall" for motion in motions for contact in motion.contacts)
        assert motions[-1].robot.pose.x_m < WALL_X_M
        eye = np.array([0.0, 0.0, 1.0])
        points = np.array([[WALL_X_M + 2.0, 0.0, 1.0], [WALL_X_M - 2.0, 0.0, 1.0]])
        assert world.occluded(eye, points).tolist() == [True, False]


@pytest.mark.parametrize(("kind", "value"), [("sidewalk", 0.9), ("verge", 0.7)])
def test_the_ground_of_an_area_has_the_friction_of_its_kind(kind: str, value: float) -> None:
    """Patches cover the area to 1 m2 and have the friction of its kind."""
    surface = surface_of(sloped_scan(kind=kind))
    patches = [
        p for key in tiles_touching(shapely.box(-16, -3, 16, 3)) for p in surface.chunk(key).ground
    ]
    drawn = [patch for patch in patches if patch.name == kind]
    assert {patch.friction for patch in drawn} == {value}
    corners = np.concatenate([patch.mesh.vertices[patch.mesh.triangles] for patch in drawn])
    one, two = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    area_m2 = 0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    assert area_m2.min() > 0.0 and area_m2.sum() == pytest.approx(32 * 6, abs=1.0)


@pytest.mark.parametrize("hole", [False, True], ids=["whole", "with a hole"])
def test_both_cameras_show_the_scan(hole: bool) -> None:
    """Both show the wall in front of the slope in the scan's colours with equal labels, and a hole
    in an area is closed."""
    surface = surface_of(sloped_scan(hole=hole))
    spec = CameraSpec(width=96, height=96)
    with BulletWorld(surface) as world:
        robot = world.place(Pose(-4.0, 0.0, 0.0))
        with GlCamera(world, spec) as gl, BulletCamera(world, spec) as bullet:
            frames = [gl.render(robot, Street(0)), bullet.render(robot, Street(0))]
    for frame in frames:
        assert frame.labels is not None
        at = frame.labels == LABELS["building"]
        red, green, blue = frame.rgb[at].mean(axis=0)
        assert at.sum() > 300 and red > 2.0 * green and red > 2.0 * blue
        assert (frame.labels[80:, 30:66] == LABELS["sidewalk"]).all()
    same = frames[0].labels == frames[1].labels
    assert same.mean() > 0.97
    assert np.abs(frames[0].rgb[90, 48].astype(int) - 120).max() < 12


def test_nothing_is_drawn_around_a_scan() -> None:
    """Beyond the end of the scan both cameras see no ground of the height grid."""
    spec = CameraSpec(width=96, height=96)
    with BulletWorld(surface_of(sloped_scan(grid_m=80.0))) as world:
        robot = world.place(Pose(-SIZE_M + 0.5, 0.0, math.pi))
        with (
            GlCamera(world, spec, depth=True) as gl,
            BulletCamera(world, spec, depth=True) as bullet,
        ):
            for frame in (gl.render(robot, Street(0)), bullet.render(robot, Street(0))):
                assert frame.depth is not None
                assert frame.depth[40:].min() > 100.0


def test_a_renderer_names_the_look_of_scans() -> None:
    """The look in the name of a renderer is that of its record."""
    for appearance in ("splats", "mesh"):
        assert appearance_of(renderer_of("gl", appearance)) == appearance
    assert appearance_of(renderer_of("bullet")) == appearance_of("none") == "splats"


def test_the_tiles_of_a_scan_depend_on_the_scan_alone() -> None:
    """Another scan has other tiles, whatever the cache holds."""
    complete, holed = surface_of(sloped_scan()), surface_of(sloped_scan(hole=True))
    counts = [sum(len(one.mesh) for one in s.scanned((0, 0))) for s in (complete, holed, complete)]
    assert counts[0] == counts[2] != counts[1]

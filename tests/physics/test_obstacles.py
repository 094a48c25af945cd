"""Obstacles of a scenario in the physics, in pictures, and in exports."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.errors import SpecError
from cosim.core.geometry import Pose
from cosim.core.state import LABELS, Command, Street
from cosim.episode.interfaces import Camera
from cosim.spec.camera import CameraSpec
from cosim.spec.obstacle import OBSTACLE_FORMS, OBSTACLE_SIZES_M, Obstacle, footprint
from physics.cameras.bullet_camera import BulletCamera
from physics.cameras.gl.camera import GlCamera
from physics.dynamics.world import BulletWorld
from physics.ground.tiles import tile_at
from physics.street.furniture import footprints, obstacle_prop
from physics.street.gltf import as_gltf
from physics.street.street_surface import StreetSurface
from tests.support.tiny_street import tiny_map

MAP = tiny_map()
KINDS = sorted(OBSTACLE_SIZES_M)
START = Pose(-40.0, 5.0, 0.0)


def ahead(kind: str, far_m: float = 3.0, form: int = 1) -> Obstacle:
    """Return an obstacle in front of a robot at START, with its wider side towards it."""
    turned_rad = 0.0 if kind == "sign" else math.pi / 2
    return Obstacle(
        kind=kind, x_m=START.x_m + far_m, y_m=START.y_m, heading_rad=turned_rad, form=form
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_footprint_equals_the_body(kind: str) -> None:
    """The ground that the spec gives an obstacle is the ground of its body in the physics,
    rotated."""
    for form in range(OBSTACLE_FORMS):
        one = Obstacle(kind=kind, x_m=3.0, y_m=-2.0, heading_rad=0.7, form=form)
        (ground,) = footprints([obstacle_prop(one, 0)])
        assert (
            ground.equals_exact(footprint(one), 1e-9)
            or ground.symmetric_difference(footprint(one)).area < 1e-9
        )
        assert (
            footprint(one, 0.1).area > footprint(one).area == pytest.approx(np.prod(one.size_m[:2]))
        )


def test_an_invalid_obstacle_is_refused() -> None:
    """A form or a heading out of range is named with the valid range."""
    with pytest.raises(SpecError, match=r"form must be in \[0, 11\], not 12"):
        Obstacle(kind="bin", x_m=0.0, y_m=0.0, heading_rad=0.0, form=12)
    with pytest.raises(SpecError, match="heading_rad"):
        Obstacle(kind="bin", x_m=0.0, y_m=0.0, heading_rad=9.0)


@pytest.mark.engine
@pytest.mark.parametrize("kind", KINDS)
def test_a_robot_that_drives_into_an_obstacle_touches_it(kind: str) -> None:
    """The contact is with an object of that name, at its outline."""
    one = ahead(kind)
    with BulletWorld(StreetSurface(MAP, seed=1), obstacles=[one]) as world:
        world.place(START)
        motions = [world.step(Command(1.0, 0.0), Street(k), Street(k + 1), 10) for k in range(80)]
    contacts = [contact for motion in motions for contact in motion.contacts]
    assert {(c.kind, c.other) for c in contacts} == {("object", f"obstacle:0:{kind}")}
    near_m = footprint(one).bounds[0] - 0.5 * world.robot.length_m
    first = next(motion for motion in motions if motion.contacts)
    assert near_m - 0.06 < first.robot.pose.x_m < near_m + (0.25 if kind == "cafe" else 0.06)


@pytest.mark.engine
@pytest.mark.parametrize("make", [GlCamera, BulletCamera], ids=["gl", "bullet"])
def test_an_obstacle_is_seen_where_it_stands(make: type[Camera]) -> None:
    """Each kind has pixels labelled as a prop in the middle of the picture, and there are none
    without it."""
    surface = StreetSurface(MAP, seed=1)
    spec = CameraSpec(96, 96)
    street = Street(0)
    for kind in (None, *KINDS):
        world = BulletWorld(surface, obstacles=[] if kind is None else [ahead(kind)])
        with world, make(world, spec) as camera:  # type: ignore[call-arg]
            frame = camera.render(world.place(START), street)
        seen = int((frame.labels[40:, 24:72] == LABELS["prop"]).sum())
        assert seen == 0 if kind is None else seen > 60, (kind, seen)


def test_obstacles_are_exported_by_their_names(tmp_path: Path) -> None:
    """A .glb holds each of them at its place, under a node named by its kind."""
    import trimesh

    surface = StreetSurface(MAP, seed=1)
    path = tmp_path / "street.glb"
    obstacles = [ahead(kind, 3.0 + 3.0 * k) for k, kind in enumerate(KINDS)]
    path.write_bytes(as_gltf(surface, [tile_at(*START.xy)], obstacles=obstacles))
    scene = trimesh.load_scene(path)
    for one in obstacles:
        parts = [
            mesh for name, mesh in scene.geometry.items() if name.startswith(f"obstacle:{one.kind}")
        ]
        corners = np.concatenate([mesh.vertices for mesh in parts])
        ground = shapely.MultiPoint(np.column_stack([corners[:, 0], -corners[:, 2]])).convex_hull
        assert footprint(one, 0.03).covers(ground) and corners[:, 1].max() > 0.4

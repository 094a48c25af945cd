"""A plain surface, a slope with a step at its end: driving, contacts, and both cameras."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from cosim.core.geometry import Floats, Pose
from cosim.core.state import LABELS, Command, Frame, Street
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import COURIER
from physics.cameras.bullet_camera import BulletCamera
from physics.cameras.gl import context
from physics.cameras.gl.camera import GlCamera
from physics.cameras.view import shot
from physics.dynamics.world import BulletWorld
from physics.ground.mesh import Mesh
from physics.ground.tiles import Key, tile_bounds
from physics.street.surface import Chunk, Patch, Surface
from physics.textures.ground import layer_of

EMPTY = Street(0)
GRADE = 0.1
STEP_M = 0.25
LONG_M = 6.0
TOP_M = GRADE * LONG_M + STEP_M
PROFILE = {
    "sidewalk": ((-5.0, 0.0), (0.0, 0.0)),
    "sidewalk:brick:0": ((0.0, 0.0), (LONG_M, GRADE * LONG_M)),
    "curb": ((LONG_M, GRADE * LONG_M), (LONG_M, TOP_M)),
    "plateau": ((LONG_M, TOP_M), (14.0, TOP_M)),
}
"""Profile in x and z: level, uphill, a step up, level again; 10 m wide. Squares meet
at x = 0.41."""
LABEL = {
    "sidewalk": "sidewalk",
    "sidewalk:brick:0": "sidewalk",
    "curb": "curb",
    "plateau": "ground",
}


def height(x_m: float) -> float:
    return TOP_M if x_m > LONG_M else GRADE * max(x_m, 0.0)


class Hill(Surface):
    """A slope with a step at its end."""

    def heights(self, xy: ArrayLike) -> Floats:
        return np.array([height(x_m) for x_m in np.asarray(xy, dtype=float).reshape(-1, 2)[:, 0]])

    def chunk(self, key: Key) -> Chunk:
        x0, y0, x1, y1 = tile_bounds(key)
        low = max(y0, -5.0)
        high = min(y1, 5.0)
        ground = []
        for name, ((begin, z0), (end, z1)) in PROFILE.items():
            left, right = max(begin, x0), min(end, x1)
            if begin == end:
                overlaps = x0 <= begin < x1
                z = np.array([z0, z1])
            else:
                overlaps = left < right
                z = np.interp((left, right), (begin, end), (z0, z1))
            if low >= high or not overlaps:
                continue
            corners = np.array(
                [(left, low, z[0]), (right, low, z[1]), (right, high, z[1]), (left, high, z[0])]
            )
            normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
            triangles = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.int32)
            mesh = Mesh(corners, np.repeat([normal / np.linalg.norm(normal)], 4, axis=0), triangles)
            layer = "plain" if name == "plateau" else layer_of(name, 0)
            ground.append(Patch(name, mesh, 0.8, LABEL[name], (0.6, 0.6, 0.6), layer))
        return Chunk(tuple(ground))


@pytest.fixture(scope="module")
def surface() -> Hill:
    return Hill()


def test_a_robot_leans_like_the_slope(surface: Hill) -> None:
    """It leans at any heading, a vehicle lies on its wheels, and no foot floats."""
    for heading, roll, pitch in ((0.0, 0.0, -1.0), (math.pi, 0.0, 1.0), (math.pi / 2, -1.0, 0.0)):
        z, leant, nodding = surface.lean(Pose(3.0, 1.0, heading), COURIER.drive.span_m)
        assert z == pytest.approx(3.0 * GRADE, abs=1e-6)
        assert (leant, nodding) == pytest.approx(
            (roll * math.atan(GRADE), pitch * math.atan(GRADE)), abs=1e-6
        )
    lying = surface.road([(3.0, 0.0)], [0.0], [(4.5, 1.8)])[0]
    assert lying == pytest.approx((0.3, 0.0, -math.atan(GRADE)), abs=1e-6)
    assert surface.foot(3.0, 0.0, 0.0, (2.0, 0.5)) == pytest.approx(0.2, abs=1e-6)


@pytest.mark.engine
def test_the_robot_climbs_the_slope_and_is_stopped_by_the_step(surface: Hill) -> None:
    """Its wheels stay on the slope, it leans like it, keeps its speed, and does not get over the
    step."""
    with BulletWorld(surface) as world:
        state = world.place(Pose(-1.5, 1.0, 0.0))
        states = []
        for _ in range(140):
            state = world.step(Command(1.5, 0.0), EMPTY, EMPTY, 10).robot
            states.append(state)
    on_slope = [s for s in states if 1.0 < s.pose.x_m < LONG_M - 1.0]
    assert len(on_slope) > 20
    assert [s.tilt_rad for s in on_slope] == pytest.approx(
        [math.atan(GRADE)] * len(on_slope), abs=0.02
    )
    assert [s.z_m for s in on_slope] == pytest.approx(
        [GRADE * s.pose.x_m for s in on_slope], abs=0.02
    )
    assert np.mean([s.v_mps for s in on_slope]) == pytest.approx(1.5, rel=0.05)
    nose_m = 0.5 * world.footprint_m[0]
    assert LONG_M - nose_m - 0.15 < states[-1].pose.x_m and max(s.pose.x_m for s in states) < LONG_M
    assert abs(states[-1].v_mps) < 0.3


@pytest.mark.engine
def test_the_robot_drops_off_the_step(surface: Hill) -> None:
    """From above it falls by the height of the step, and continues downhill on its wheels."""
    with BulletWorld(surface) as world:
        state = world.place(Pose(8.5, -1.0, math.pi))
        states = []
        for _ in range(110):
            state = world.step(Command(1.5, 0.0), EMPTY, EMPTY, 10).robot
            states.append(state)
    assert states[10].z_m == pytest.approx(TOP_M, abs=0.02)
    assert max(s.tilt_rad for s in states) > 2.0 * GRADE
    below = [s for s in states if 0.5 < s.pose.x_m < LONG_M - 1.5]
    assert len(below) > 20
    assert [s.z_m for s in below] == pytest.approx([GRADE * s.pose.x_m for s in below], abs=0.03)


VIEWS = (
    ((-3.0, 0.5, 1.2), (3.0, 0.0, 0.2)),
    ((1.0, -2.0, 2.5), (7.0, 1.0, 0.6)),
    ((12.0, 0.0, 1.6), (6.0, -1.0, 0.5)),
    ((4.0, 3.0, 0.9), (6.5, -1.0, 0.7)),
)


def points_of(frame: Frame, eye: np.ndarray, target: np.ndarray, fov_deg: float) -> np.ndarray:
    """Return (H, W, 3) world points in metres that each pixel shows."""
    assert frame.depth is not None
    high, wide = frame.depth.shape
    taken = shot(eye, target, (wide, high), fov_deg)
    right, up, ahead = taken.axes
    across, over = taken.half_picture
    u = (2.0 * (np.arange(wide) + 0.5) / wide - 1.0) * across
    v = (1.0 - 2.0 * (np.arange(high) + 0.5) / high) * over
    rays = ahead + u[None, :, None] * right + v[:, None, None] * up
    return taken.eye_m + frame.depth[..., None] * rays


@pytest.mark.engine
@pytest.mark.parametrize("make", [GlCamera, BulletCamera], ids=["gl", "bullet"])
def test_a_camera_draws_a_mesh_where_it_is(
    make: type[GlCamera | BulletCamera], surface: Hill
) -> None:
    """In four views each pixel of the mesh lies on it by its depth, on the part of its label."""
    if make is GlCamera and not context.available():
        pytest.skip("no OpenGL through EGL here (see `cosim doctor`)")
    seen = set()
    with make(BulletWorld(surface), CameraSpec(160, 120), depth=True) as camera:
        for eye, target in VIEWS:
            frame = camera.picture(eye, target, EMPTY, size=(160, 120), fov_deg=60.0)
            assert frame.labels is not None and frame.depth is not None
            at = points_of(frame, np.array(eye), np.array(target), 60.0)
            inside = (
                (at[..., 0] > -4.9)
                & (at[..., 0] < 13.9)
                & (np.abs(at[..., 1]) < 4.9)
                & (frame.depth < 20.0)
            )
            wall = inside & (frame.labels == LABELS["curb"])
            if wall.any():
                assert at[wall][:, 0] == pytest.approx(np.full(wall.sum(), LONG_M), abs=0.03)
                seen.add("curb")
            for label, low, high in (("sidewalk", -5.0, LONG_M), ("ground", LONG_M, 14.0)):
                part = at[inside & (frame.labels == LABELS[label])]
                if len(part):
                    assert part[:, 0].min() > low - 0.05 and part[:, 0].max() < high + 0.05, (
                        label,
                        eye,
                    )
                    assert part[:, 2] == pytest.approx([height(x) for x in part[:, 0]], abs=0.03)
                    seen.add(label)
    assert seen == {"sidewalk", "curb", "ground"}

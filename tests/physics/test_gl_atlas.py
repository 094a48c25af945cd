"""Many environments in one atlas: equal pictures, read back together."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from cosim.core.errors import EngineError, UsageError
from cosim.core.geometry import Pose
from cosim.core.state import Frame, RobotState, Street
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import ROBOTS
from cosim.spec.scenario import Light
from physics.cameras.gl import context
from physics.dynamics.world import BulletWorld
from physics.street.street_surface import StreetSurface
from scenarios.tools.bench.cameras import busy_street, camera_city

pytestmark = [
    pytest.mark.engine,
    pytest.mark.skipif(not context.available(), reason="no OpenGL through EGL here"),
]

SPEC = CameraSpec(96, 54, fov_deg=60.0)
NOON = Light()


@pytest.fixture(scope="module")
def worlds() -> list[BulletWorld]:
    return [BulletWorld(StreetSurface(camera_city(300.0), seed)) for seed in (1, 2, 3)]


def test_an_atlas_equals_single_cameras(worlds: list[BulletWorld]) -> None:
    """Three environments that are drawn together, with a second batch before the first is read,
    equal three single cameras bit for bit."""
    from physics.cameras.gl.atlas import Atlas

    busy = busy_street(camera_city(300.0), 8, 5)
    ticks = [[busy.streets[i + k] for k in range(3)] for i in range(2)]
    single = [
        _single_camera(world, NOON, [(busy.robot, streets[k]) for streets in ticks])
        for k, world in enumerate(worlds)
    ]
    with Atlas(SPEC) as atlas:
        keys = [atlas.join(world) for world in worlds]
        for streets in ticks:
            atlas.begin(
                [(key, busy.robot, street) for key, street in zip(keys, streets, strict=True)]
            )
        with pytest.raises(EngineError, match="under way"):
            atlas.begin([(keys[0], busy.robot, busy.streets[0])])
        together = [atlas.end() for _ in ticks]
    for k in range(3):
        for i in range(2):
            assert _same(together[i][k], single[k][i])
    assert not np.array_equal(single[0][0].rgb, single[1][0].rgb)


@pytest.mark.parametrize("staged", [False, True])
@pytest.mark.parametrize("layers", [False, True])
def test_layers_equal_single_cameras(
    worlds: list[BulletWorld], monkeypatch: pytest.MonkeyPatch, layers: bool, staged: bool
) -> None:
    """Pictures that are drawn as layers of a texture equal those of single cameras, also when
    staged as on a graphics card. Later drawings do not change them."""
    from physics.cameras.gl import atlas as module
    from physics.cameras.gl.atlas import Atlas
    from physics.cameras.gl.readback import Readback

    monkeypatch.setattr(context, "LAYERS", False)
    busy = busy_street(camera_city(300.0), 8, 9)
    lights = [NOON, Light(hour=19.0), Light(hour=0.0), Light(shadows=False)]
    asked = [(busy.robot, street) for street in busy.streets]
    single = [_single_camera(worlds[k % 3], light, asked) for k, light in enumerate(lights)]
    monkeypatch.setattr(context, "LAYERS", layers)
    monkeypatch.setattr(module, "Readback", partial(Readback, staged=staged))
    with Atlas(SPEC) as atlas:
        keys = [atlas.join(worlds[k % 3], light) for k, light in enumerate(lights)]
        order = [(0, 1, 2, 3), (3, 0), (1, 2), (0, 3, 1), (2, 1, 0), (1,), (3, 2, 0), (0, 0, 1)]
        found = [
            atlas.render([(keys[k], *asked[tick]) for k in some]) for tick, some in enumerate(order)
        ]
    for tick, some in enumerate(order):
        for k, frame in zip(some, found[tick], strict=True):
            assert _same(frame, single[k][tick]), (tick, k)


@pytest.mark.parametrize("layers", [False, True])
def test_environments_join_and_leave_an_atlas(
    worlds: list[BulletWorld], monkeypatch: pytest.MonkeyPatch, layers: bool
) -> None:
    """An environment gets the pictures of its own camera, whichever environments join, leave or
    fail."""
    from physics.cameras.gl.atlas import Atlas
    from physics.cameras.gl.crowd import CrowdDrawing
    from physics.cameras.gl.street import StreetDrawing

    def fails(*arguments: object) -> None:
        raise ZeroDivisionError

    busy = busy_street(camera_city(300.0), 8, 4)
    near = worlds[0].robot
    tall = next(robot for robot in ROBOTS.values() if robot.name != near.name)
    other = BulletWorld(StreetSurface(camera_city(300.0), 2), robot=tall)
    lights = [NOON, Light(hour=22.0), Light(shadows=False, fog_m=40.0)]
    asked = [(busy.robot, street) for street in busy.streets]
    seats = list(zip((worlds[0], other, worlds[2]), lights, strict=True))
    a, b, c = (_single_camera(world, light, asked) for world, light in seats)
    monkeypatch.setattr(context, "LAYERS", layers)
    with Atlas(SPEC) as atlas:
        first, second = (atlas.join(*seat) for seat in seats[:2])
        found = atlas.render([(second, *asked[0]), (first, *asked[0])])
        assert _same(found[0], b[0]) and _same(found[1], a[0])
        third = atlas.join(*seats[2])
        atlas.begin([(first, *asked[1]), (third, *asked[1]), (second, *asked[2])])
        atlas.leave(first)
        atlas.begin([(third, *asked[2])])
        for one, expected in zip(atlas.end() + atlas.end(), (a[1], c[1], b[2], c[2]), strict=True):
            assert _same(one, expected)
        with pytest.raises(
            UsageError,
            match=f"environment {first} is not in the atlas; in it are: {second}, {third}",
        ):
            atlas.begin([(first, *asked[3])])
        with monkeypatch.context() as broken, pytest.raises(ZeroDivisionError):
            broken.setattr(other.surface, "heights", lambda xy: 1 / 0)
            atlas.begin([(third, *asked[3]), (second, *asked[3])])
        again = atlas.join(*seats[0])
        assert again not in (first, second, third)
        for drawing, name in ((StreetDrawing, "draw"), (CrowdDrawing, "draw_contact")):
            with monkeypatch.context() as broken, pytest.raises(ZeroDivisionError):
                broken.setattr(drawing, name, fails)
                atlas.begin([(third, *asked[3]), (again, *asked[3])])
        assert all(map(_same, atlas.render([(k, *asked[3]) for k in (again, third)]), (a[3], c[3])))
        assert atlas.render([]) == []


def test_forced_layers_fail_on_a_driver_without_support(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error has the missing extensions and limits."""
    limits = (("GL_MAX_UNIFORM_BLOCK_SIZE", 1 << 30), ("GL_MAX_VERTEX_SHADER_STORAGE_BLOCKS", 1))
    monkeypatch.setattr(context, "LAYERS", True)
    with context.context() as gl, monkeypatch.context() as lacking:
        assert context.draws_layers(gl)
        lacking.setattr(context, "_LAYER_EXTENSIONS", ("GL_ARB_none", "GL_ARB_clear_texture"))
        lacking.setattr(context, "_LAYER_LIMITS", limits)
        context.missing_for_layers.cache_clear()
        with pytest.raises(EngineError, match=r"lacks GL_ARB_none, GL_MAX_UNIFORM_BLOCK_SIZE of"):
            context.draws_layers(gl)
    context.missing_for_layers.cache_clear()


def test_a_picture_whose_drawing_or_wait_failed_is_not_returned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After an error while drawing or waiting, `end` returns later pictures."""
    from physics.cameras.gl import readback
    from physics.cameras.gl.crowd import CrowdDrawing
    from physics.cameras.gl.people_only import PeopleAlone

    busy = busy_street(camera_city(300.0), 8, 3)
    pose, streets = busy.robot.pose, busy.streets
    original = readback.function

    def waits(result: int) -> Callable[..., Callable[..., Any]]:
        def replaced(name: str, *kinds: str) -> Callable[..., Any]:
            wait = name == "glClientWaitSync"
            return (lambda *arguments: result) if wait else original(name, *kinds)

        return replaced

    with PeopleAlone((96, 54), 60.0) as eyes:
        first, second = eyes.render(pose, streets[0]), eyes.render(pose, streets[2])
        assert not _same(first, second)
        for _ in range(3):
            with monkeypatch.context() as broken, pytest.raises(ZeroDivisionError):
                broken.setattr(CrowdDrawing, "draw", lambda *arguments: 1 / 0)
                eyes.begin(pose, streets[0])
        eyes.begin(pose, streets[2])
        assert _same(eyes.end(), second)
        for result in (0x911B, 0x911D):  # timeout expired, wait failed
            eyes.begin(pose, streets[0])
            with monkeypatch.context() as broken, pytest.raises(EngineError, match="did not fini"):
                broken.setattr(readback, "function", waits(result))
                eyes.end()
        eyes.begin(pose, streets[2])
        assert _same(eyes.end(), second)
        eyes.begin(pose, streets[0])  # is pending when the drawing ends


def _single_camera(
    world: BulletWorld, light: Light, queries: list[tuple[RobotState, Street]]
) -> list[Frame]:
    from physics.cameras.gl.camera import GlCamera

    with GlCamera(world, SPEC, light=light) as camera:
        return [camera.render(robot, street) for robot, street in queries]


def _same(first: Frame, second: Frame) -> bool:
    assert first.labels is not None and second.labels is not None
    return np.array_equal(first.rgb, second.rgb) and np.array_equal(first.labels, second.labels)


def test_an_atlas_refuses_too_many_pixels_and_closed_use(worlds: list[BulletWorld]) -> None:
    """The errors have the limit, and the missing 'with' block."""
    from physics.cameras.gl.atlas import Atlas

    atlas = Atlas(CameraSpec(64, 1024))
    with pytest.raises(EngineError, match="'with' block"):
        atlas.join(worlds[0])
    with atlas, pytest.raises(UsageError, match="64 x 1024 pixels: 1 to 512 fit"):
        atlas.begin([(atlas.join(worlds[0]), RobotState(Pose(0.0, 0.0, 0.0)), Street(0))] * 513)

"""GlCamera: pictures by OpenGL, on a GPU or on a processor that plays one.

A picture is a function of the robot's state and the street alone: same values, same pixels on the same renderer,
whatever was drawn before.
"""

from __future__ import annotations

import math
from typing import Final, Self

import moderngl
import numpy as np

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats
from cosim.core.state import Frame, RobotState, Street
from cosim.episode.ports import CameraSpec
from cosim.spec.scenario import Light
from physics.cameras.eyes import WorldCamera
from physics.cameras.gl.backdrop import Backdrop
from physics.cameras.gl.context import context
from physics.cameras.gl.lighting import Lighting, lighting_of
from physics.cameras.gl.scene import GlScene
from physics.cameras.gl.shading import SceneBlock, anchor_of, camera_matrix
from physics.cameras.gl.shadows import ShadowMaps, middle_of
from physics.cameras.gl.targets import Target
from physics.cameras.sky import sky_of
from physics.cameras.view import Shot, View
from physics.world.world import BulletWorld

NOON: Final = Light()
_TARGETS_MAX: Final = 4
_TO_TEXTURE: Final = np.array([[0.5, 0.0, 0.0, 0.5], [0.0, 0.5, 0.0, 0.5], [0.0, 0.0, 0.5, 0.5], [0.0, 0.0, 0.0, 1.0]])
"""From clip space to the space of a texture."""


class GlCamera(WorldCamera):
    """The robot's camera in a world. Use it in a `with` block; the world need not be running."""

    def __init__(self, world: BulletWorld, spec: CameraSpec, depth: bool = False, light: Light = NOON) -> None:
        super().__init__(world, spec, depth)
        self._sky = sky_of(light, world.surface.seed)
        self._light = lighting_of(self._sky)
        self._lights: dict[tuple[int, int], Lighting] = {}
        self._context: moderngl.Context | None = None
        self._targets: dict[tuple[int, int], Target] = {}
        self._from_sun: Floats | None = None
        self._to_map: Floats = _TO_TEXTURE

    def __enter__(self) -> Self:
        if self._context is None:
            world, shadows = self._world, self._light.shadows
            with context() as gl:
                self._scene = GlScene(gl, world.surface, world.barriers, world.robot, self._light)
                self._shadows = ShadowMaps(gl) if shadows else None
                self._block, self._sun_block = SceneBlock(gl), SceneBlock(gl)
                self._backdrop = Backdrop(gl, self._sky)
            self._context = gl
        return self

    def close(self) -> None:
        """Free what the camera holds; a second call does nothing."""
        if self._context is not None:
            with self._context:
                self._scene.release()
                if self._shadows is not None:
                    self._shadows.release()
                self._block.release()
                self._sun_block.release()
                self._backdrop.release()
                while self._targets:
                    self._targets.popitem()[1].release()
            self._context = self._from_sun = None

    def _drawn(self, taken: Shot, street: Street, robot: RobotState | None, body: bool) -> Frame:
        if self._context is None:
            raise EngineError("the camera is not running: use GlCamera in a 'with' block")
        with self._context:
            target = self._target(taken.size)
            target.clear()
            self._draw(target, taken, street, robot, body)
            rgb, labels = target.read()
            return Frame(rgb, labels, target.read_depth() if self._depth else None)

    def draw_into(self, target: Target, robot: RobotState, street: Street) -> None:
        """Draw what `render` shows, but for the lens, into a target that was cleared. The context must be held."""
        self._draw(target, self._mounted(robot), street, robot, body=False)

    def _draw(self, target: Target, taken: Shot, street: Street, robot: RobotState | None, body: bool) -> None:
        gl = self._context
        if gl is None:
            raise EngineError("the camera is not running: use GlCamera in a 'with' block")
        anchor = anchor_of(taken.eye_m)
        self._scene.arrange(taken, anchor, street, robot, body)
        if self._shadows is not None:
            middle = middle_of(taken.eye_m)
            from_sun = self._shadows.matrix(middle, anchor, self._light)
            if from_sun is self._from_sun:
                self._sun_block.bind()
            else:
                self._sun_block.write(from_sun, from_sun, taken, anchor, self._light)
                self._from_sun, self._to_map = from_sun, _TO_TEXTURE @ from_sun
            self._shadows.draw(middle, anchor, self._light, self._scene.draw)
            self._shadows.bind()
        self._block.write(camera_matrix(taken, anchor), self._to_map, taken, anchor, self._light_of(taken.view))
        target.use()
        gl.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        gl.front_face = "cw"  # the picture is drawn upside down, to be read top first
        gl.depth_func = "<"
        self._scene.draw("colour")
        self._draw_paint(gl, target)
        gl.depth_func = "<="
        self._backdrop.draw()

    def _light_of(self, view: View) -> Lighting:
        """The light of a view, its direction to a degree."""
        key = round(math.degrees(view.heading_rad)), round(math.degrees(view.half_angle_rad))
        if key not in self._lights:
            self._lights[key] = self._light.seen(math.radians(key[0]), math.radians(key[1]))
        return self._lights[key]

    def _draw_paint(self, gl: moderngl.Context, target: Target) -> None:
        """Paint changes colours alone: the ground keeps its labels and its depth."""
        gl.polygon_offset = -1.0, -8.0
        target.use(labels=False, depth=False)
        self._scene.draw_paint()
        target.use()
        gl.polygon_offset = 0.0, 0.0

    def _target(self, size: tuple[int, int]) -> Target:
        if size not in self._targets:
            assert self._context is not None
            if len(self._targets) == _TARGETS_MAX:
                self._targets.pop(next(iter(self._targets))).release()
            self._targets[size] = Target(self._context, size)
        return self._targets[size]

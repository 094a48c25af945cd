"""Camera with OpenGL, on a GPU or a software renderer.

A picture is a function of the robot's state and the street alone.
The same values give the same pixels on the same renderer, independent of previous pictures.
"""

from __future__ import annotations

import math
from typing import Final, Self

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from cosim.core.state import Frame, RobotState, Street
from cosim.spec.camera import CameraSpec
from cosim.spec.run_config import Appearance
from cosim.spec.scenario import Light
from cosim.spec.weather import CLEAR, WEATHERS, Weather
from physics.cameras.camera_base import WorldCamera
from physics.cameras.gl.backdrop import Backdrop, SkySlot, sky_layers
from physics.cameras.gl.batch import PictureOrder, Stage, batch_drawing
from physics.cameras.gl.context import context, draws_layers
from physics.cameras.gl.lighting import Lighting, lighting_of
from physics.cameras.gl.readback import SinglePicture
from physics.cameras.gl.scene import GlScene
from physics.cameras.gl.shadows import ShadowMaps, ShadowSlot, shadow_layers
from physics.cameras.gl.splat_layers import scan_sky, splat_pictures
from physics.cameras.gl.weather import WeatherLook, exposed, weather_look, weathered_sky
from physics.cameras.view import Shot, View
from physics.dynamics.world import BulletWorld
from physics.people.wardrobe import season_of

NOON: Final = Light()
_TARGETS_MAX: Final = 4


class GlCamera(WorldCamera):
    """Robot camera with OpenGL. Use it in a `with` block; the world need not be running.

    appearance: of a scanned place; splats are drawn where the scan has them
    weather: changes sky, surfaces and air; not in a scanned place, whose colours contain its light
    """

    def __init__(
        self,
        world: BulletWorld,
        spec: CameraSpec,
        depth: bool = False,
        light: Light = NOON,
        appearance: Appearance = "splats",
        weather: Weather = WEATHERS[CLEAR],
    ) -> None:
        super().__init__(world, spec, depth)
        scan = world.surface.scan
        self._splats = scan.splats if scan is not None and appearance == "splats" else None
        seed = world.surface.seed
        self._look: WeatherLook | None = None
        if scan is None:
            self._sky = weathered_sky(light, weather, seed)
            hour = light.hour if weather.sun_deg is None else None
            self._look = weather_look(weather, self._sky, seed, light.shadows, hour)
        else:
            self._sky = scan_sky(light, scan.facts, seed)
        contact = light.shadows and self._look is not None
        bright = 1.0 if self._look is None else exposed(weather)
        self._light = lighting_of(self._sky, self._splats is None, contact, bright)
        self._season = season_of(light.day_of_year, light.latitude_deg)
        self._rain = weather.rain_mm_h > 0.0
        self._lights: dict[tuple[int, int], tuple[Lighting, NDArray[np.float32]]] = {}
        self._context: moderngl.Context | None = None
        self._targets: dict[tuple[int, int], SinglePicture] = {}

    def __enter__(self) -> Self:
        if self._context is None:
            world, light = self._world, self._light
            with context() as gl:
                splats = self._splats
                look = self._look
                drawing = batch_drawing(gl)
                plain = splats is None and look is None and not self._depth
                layers = plain and draws_layers(gl)
                scene = GlScene(gl, drawing.street, world, light, splats is not None, look, layers)
                cloud = None if splats is None else splat_pictures(gl).cloud(splats)
                shadows = self._shadows(gl, layers) if light.shadows else None
                sky: Backdrop | SkySlot
                if layers:
                    sky = SkySlot(sky_layers(gl, self._sky.radiance.shape[:2]), self._sky)
                else:
                    sky = Backdrop(gl, self._sky, 0 if look is None else look.variant)
                clothes = self._season, self._rain
                self._stage = Stage(
                    *(world.surface, world.robot, scene, shadows, sky, light, cloud),
                    *(*clothes, look),
                )
            self._context = gl
        return self

    def _shadows(self, gl: moderngl.Context, layers: bool) -> ShadowMaps | ShadowSlot:
        high = self._pinhole.height
        return ShadowSlot(shadow_layers(gl, high), self._light) if layers else ShadowMaps(gl, high)

    def close(self) -> None:
        """Free the camera's resources; a second call does nothing."""
        if self._context is not None:
            with self._context:
                self._stage.scene.release()
                if self._stage.shadows is not None:
                    self._stage.shadows.release()
                self._stage.backdrop.release()
                if self._stage.cloud is not None:
                    splat_pictures(self._context).release(self._stage.cloud)
                self._lights.clear()
                while self._targets:
                    self._targets.popitem()[1].release()
            self._context = None

    def mounted_picture(self, robot: RobotState, street: Street) -> PictureOrder:
        """Return the request for the picture of `render`, without the lens, for use in a batch."""
        return self._picture(self._mounted(robot), street, robot, body=False)

    def _drawn(self, taken: Shot, street: Street, robot: RobotState | None, body: bool) -> Frame:
        picture = self._picture(taken, street, robot, body)
        assert self._context is not None
        with self._context as gl:
            target = self._target(taken.size)
            batch_drawing(gl).draw([picture], target.target, target)
            rgb, labels = target.end()
            depth = target.target.read_depth() if self._depth else None
        return Frame(rgb, labels, depth)

    def _picture(
        self, taken: Shot, street: Street, robot: RobotState | None, body: bool
    ) -> PictureOrder:
        if self._context is None:
            raise EngineError("the camera is not running: use GlCamera in a 'with' block")
        return PictureOrder(self._stage, taken, *self._light_of(taken.view), street, robot, body)

    def _light_of(self, view: View) -> tuple[Lighting, NDArray[np.float32]]:
        """Return the light of a view, and its rows; its direction is rounded to a degree."""
        key = round(math.degrees(view.heading_rad)), round(math.degrees(view.half_angle_rad))
        if key not in self._lights:
            light = self._light.seen(math.radians(key[0]), math.radians(key[1]))
            rows = np.zeros((8, 4), dtype=np.float32)
            rows[:7] = light.rows()
            if isinstance(sky := self._stage.backdrop, SkySlot):
                rows[7] = *sky.around, sky.layer
            self._lights[key] = light, rows
        return self._lights[key]

    def _target(self, size: tuple[int, int]) -> SinglePicture:
        if size not in self._targets:
            assert self._context is not None
            if len(self._targets) == _TARGETS_MAX:
                self._targets.pop(next(iter(self._targets))).release()
            self._targets[size] = SinglePicture(self._context, size)
        return self._targets[size]

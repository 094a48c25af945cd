"""Rendering of people without the street, as measured by the paper."""

from __future__ import annotations

from types import TracebackType
from typing import Final, Self

import moderngl
import numpy as np

from cosim.core.clock import Clock
from cosim.core.geometry import Floats, Pose
from cosim.core.state import Frame, Street
from cosim.spec.scenario import Light
from physics.cameras.gl.context import context, draws_layers
from physics.cameras.gl.crowd import CrowdDrawing, PeopleSeen
from physics.cameras.gl.layers import LayerTarget
from physics.cameras.gl.lighting import lighting_of
from physics.cameras.gl.readback import Readback
from physics.cameras.gl.shading import SceneBlocks, SceneMaps
from physics.cameras.gl.shadows import NO_SUN
from physics.cameras.gl.shots import Shots
from physics.cameras.gl.targets import Target
from physics.cameras.gl.variants import Variant
from physics.cameras.sky import sky_of
from physics.cameras.view import shot

_FIRST: Final = np.zeros(1, dtype=np.intp)
EYE_M = 0.75
"""Height of the eye over flat ground, metres."""


class PeopleAlone:
    """Posed, skinned, shaded people before an empty background. Use it in a `with` block.

    size: width, height in pixels
    """

    def __init__(self, size: tuple[int, int], fov_deg: float) -> None:
        self._size = size
        self._fov_deg = fov_deg
        self._rows = np.zeros((1, 8, 4), dtype=np.float32)
        self._rows[0, :7] = lighting_of(sky_of(Light(shadows=False), 0)).rows()

    def __enter__(self) -> Self:
        with context() as gl:
            self._crowd, self._blocks, self._target = (
                CrowdDrawing(gl),
                SceneBlocks(gl),
                Target(gl, self._size),
            )
            self._readback = Readback(gl, self._target)
            self._layers = LayerTarget(gl, self._size)
            self._scene_maps = SceneMaps(gl)
            self._variant = Variant.LAYERS if draws_layers(gl) else Variant.NONE
        self._context = gl
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._context:
            for thing in (
                *(self._crowd, self._blocks, self._target, self._readback),
                *(self._layers, self._scene_maps),
            ):
                thing.release()

    def render(self, pose: Pose, street: Street) -> Frame:
        """Render the people of a street from a pose."""
        self.begin(pose, street)
        return self.end()

    def begin(self, pose: Pose, street: Street) -> None:
        """Start drawing a picture; `end` returns it, and the next may begin before that."""
        ahead = np.array([np.cos(pose.heading_rad), np.sin(pose.heading_rad)])
        eye = np.append(pose.xy, EYE_M)
        taken = shot(eye, eye + np.append(ahead, -0.1), self._size, self._fov_deg)
        shots = Shots([taken])
        with self._context as gl:
            self._crowd.set(
                [PeopleSeen(street.people, Clock().time_s(street.tick), _flat, shadows=False)],
                shots,
            )
            self._blocks.set(shots.cameras(), NO_SUN[None], NO_SUN[None], shots.views(), self._rows)
            gl.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
            gl.front_face = "cw"
            gl.depth_func = "<"
            with self._readback.begin():
                if self._variant:
                    self._draw_layer()
                else:
                    self._blocks.bind()
                    self._target.clear()
                    self._crowd.draw("colour", Variant.NONE)
                    self._readback.take()

    def _draw_layer(self) -> None:
        """Draw the picture as a layer, as on a graphics card."""
        self._layers.room(1)
        self._blocks.bind_all()
        self._scene_maps.set(1, _FIRST, _FIRST)
        self._scene_maps.bind()
        self._layers.clear()
        self._crowd.draw("colour", self._variant)
        self._readback.take_layers(self._layers, (0,))

    def end(self) -> Frame:
        """Return the oldest pending picture."""
        with self._context:
            return Frame(*self._readback.end()[0])


def _flat(xy: Floats) -> Floats:
    return np.zeros(len(xy))

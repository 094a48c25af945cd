"""Atlas: the robots of many environments in one process, drawn one after the other and read back at once.

The pictures are those of a `GlCamera` each, bit for bit: each is drawn by itself and copied behind the last into one
buffer on the graphics card. Waiting for that buffer is what costs there; one is waited for while the next is under
way: `begin` the next pictures before you `end` the last ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self

import moderngl

from cosim.core.errors import EngineError, UsageError
from cosim.core.state import Frame, RobotState, Street
from cosim.episode.ports import CameraSpec
from cosim.spec.scenario import Light
from physics.cameras.gl.camera import NOON, GlCamera
from physics.cameras.gl.context import context
from physics.cameras.gl.targets import Readback, Target
from physics.cameras.lens import drawn
from physics.cameras.view import SIDE_MAX
from physics.world.world import BulletWorld

_Seen = Sequence[tuple[RobotState, Street]]
"""A robot and its street for each environment."""


class Atlas:
    """One camera for several worlds. Use it in a `with` block. Raises UsageError when the atlas would be too large."""

    def __init__(self, worlds: Sequence[BulletWorld], spec: CameraSpec, light: Light = NOON) -> None:
        self._size = drawn(spec).width, drawn(spec).height
        if not worlds or len(worlds) * self._size[1] > 4 * SIDE_MAX:
            raise UsageError(
                f"an atlas of {len(worlds)} pictures of {self._size[1]} rows: 1 to {4 * SIDE_MAX // self._size[1]} fit"
            )
        self._cameras = [GlCamera(world, spec, light=light) for world in worlds]
        self._running = ExitStack()
        self._begun: deque[_Seen] = deque()
        self._context: moderngl.Context | None = None

    def __enter__(self) -> Self:
        for camera in self._cameras:
            self._running.enter_context(camera)
        with context() as gl:
            self._target, self._readback = Target(gl, self._size), Readback(gl, self._size, len(self._cameras))
        self._context = gl
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._context is not None:
            with self._context:
                self._target.release()
                self._readback.release()
            self._context = None
        self._running.close()

    def render(self, seen: _Seen) -> list[Frame]:
        """What every robot sees, in the order of the worlds."""
        self.begin(seen)
        return self.end()

    def begin(self, seen: _Seen) -> None:
        """Draw what every robot sees; `end` hands the pictures over."""
        with self._running_context:
            self._readback.begin()
            for i, (camera, (robot, street)) in enumerate(zip(self._cameras, seen, strict=True)):
                self._target.clear()
                camera.draw_into(self._target, robot, street)
                self._readback.copy(self._target, i)
        self._begun.append(seen)

    def end(self) -> list[Frame]:
        """The pictures that began first and have not ended."""
        with self._running_context:
            pictures = self._readback.end()
        return [
            camera.through_lens(Frame(*picture), robot, street)
            for camera, picture, (robot, street) in zip(self._cameras, pictures, self._begun.popleft(), strict=True)
        ]

    @property
    def _running_context(self) -> moderngl.Context:
        if self._context is None:
            raise EngineError("the atlas is not running: use Atlas in a 'with' block")
        return self._context

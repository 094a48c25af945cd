"""Joint rendering of the robots of many environments in one process, with one readback.

Environments join and leave at any time, each with a world, a light and a robot; a batch holds any
subset.
Each picture has the same bits as that of a separate `GlCamera`.
All pictures of a batch are read back together, while the next are drawn: call `begin` for the next
batch before `end` for the last one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import count
from types import TracebackType
from typing import Final, NewType, Self

import moderngl

from cosim.core.errors import EngineError, UsageError
from cosim.core.state import Frame, RobotState, Street
from cosim.spec.camera import CameraSpec
from cosim.spec.run_config import Appearance
from cosim.spec.scenario import Light
from cosim.spec.weather import CLEAR, WEATHERS, Weather
from physics.cameras.gl.batch import batch_drawing
from physics.cameras.gl.camera import NOON, GlCamera
from physics.cameras.gl.context import context
from physics.cameras.gl.readback import Readback
from physics.cameras.gl.targets import Target
from physics.cameras.lens import drawn
from physics.dynamics.world import BulletWorld

_PIXELS_MAX: Final = 1 << 25
"""Maximum number of pixels of a batch: 128 MiB of memory, for each of two pending batches."""
SeatKey = NewType("SeatKey", int)
"""Key of an environment in an atlas, from `join` to `leave`; keys are never reused."""
_Seen = Sequence[tuple[SeatKey, RobotState, Street]]
"""Environment, robot and street of each picture."""


class Atlas:
    """Camera for several worlds. Use it in a `with` block.

    appearance: of scanned places
    """

    def __init__(self, spec: CameraSpec, appearance: Appearance = "splats") -> None:
        self._spec = spec
        self._appearance = appearance
        self._size = drawn(spec).width, drawn(spec).height
        self._most = max(1, _PIXELS_MAX // (self._size[0] * self._size[1]))
        self._cameras: dict[SeatKey, GlCamera] = {}
        self._keys = count()
        self._begun: deque[list[tuple[GlCamera, RobotState, Street]]] = deque()
        self._context: moderngl.Context | None = None

    def __enter__(self) -> Self:
        with context() as gl:
            self._target = Target(gl, self._size)
            self._readback = Readback(gl, self._target)
        self._context = gl
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        while self._cameras:
            self._cameras.popitem()[1].close()
        if self._context is not None:
            with self._context:
                self._target.release()
                self._readback.release()
            self._context = None

    def join(
        self, world: BulletWorld, light: Light = NOON, weather: Weather = WEATHERS[CLEAR]
    ) -> SeatKey:
        """Add an environment; the world need not be running."""
        self._running_context  # noqa: B018  raises if the atlas is not running
        camera = GlCamera(
            world, self._spec, light=light, appearance=self._appearance, weather=weather
        )
        key = SeatKey(next(self._keys))
        self._cameras[key] = camera.__enter__()
        return key

    def leave(self, key: SeatKey) -> None:
        """Remove an environment and free its data. Its pending pictures are still delivered."""
        self._camera(key).close()
        del self._cameras[key]

    def render(self, seen: _Seen) -> list[Frame]:
        """Render the views of these robots, in this order."""
        self.begin(seen)
        return self.end()

    def begin(self, seen: _Seen) -> None:
        """Start drawing the views of these robots; `end` returns the pictures.

        Raises UsageError for an environment that is not in the atlas, and for too many pictures.
        """
        gl = self._running_context
        if len(seen) > self._most:
            raise UsageError(
                f"an atlas of {len(seen)} pictures of {self._size[0]} x {self._size[1]} pixels: "
                f"1 to {self._most} fit at a time"
            )
        batch = [(self._camera(key), robot, street) for key, robot, street in seen]
        pictures = [camera.mounted_picture(robot, street) for camera, robot, street in batch]
        with gl, self._readback.begin(len(batch)):
            batch_drawing(gl).draw(pictures, self._target, self._readback)
        self._begun.append(batch)

    def end(self) -> list[Frame]:
        """Return the pictures of the oldest pending `begin`, in the order of its robots."""
        with self._running_context:
            batch = self._begun.popleft() if self._begun else []
            pictures = self._readback.end()
        return [
            camera.through_lens(Frame(*picture), robot, street)
            for picture, (camera, robot, street) in zip(pictures, batch, strict=True)
        ]

    def _camera(self, key: SeatKey) -> GlCamera:
        if key not in self._cameras:
            known = ", ".join(map(str, self._cameras)) or "none"
            raise UsageError(f"environment {key} is not in the atlas; in it are: {known}")
        return self._cameras[key]

    @property
    def _running_context(self) -> moderngl.Context:
        if self._context is None:
            raise EngineError("the atlas is not running: use Atlas in a 'with' block")
        return self._context

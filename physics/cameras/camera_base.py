"""Base class of a world's cameras: mount, lens, views for humans, and closing."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from types import TracebackType

from numpy.typing import ArrayLike

from cosim.core.state import Frame, RobotState, Street
from cosim.spec.camera import CameraSpec
from physics.cameras.lens import drawn, through
from physics.cameras.view import Mounting, Shot, check_size, mounted_shot, shot
from physics.dynamics.world import BulletWorld


class WorldCamera(ABC):
    """Robot camera in a world. Use it in a `with` block; the world need not be running.

    A subclass starts its renderer on entering and draws a `Shot`.
    """

    def __init__(self, world: BulletWorld, spec: CameraSpec, depth: bool) -> None:
        check_size(spec.width, spec.height, spec.fov_deg)
        self.spec = spec = dataclasses.replace(spec, mount=spec.on(world.robot))
        self._pinhole = drawn(spec)
        self._mounting = Mounting.of(self._pinhole, world.robot)
        self._world = world
        self._depth = depth

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Close the renderer; a second call does nothing."""

    @abstractmethod
    def _drawn(self, taken: Shot, street: Street, robot: RobotState | None, body: bool) -> Frame:
        """Draw a shot.

        body: the robot's own body is in the picture.
        """

    def render(self, robot: RobotState, street: Street) -> Frame:
        """Render the robot's view from its mount, through its lens.

        The camera tilts with the ground, and the robot's own body is not in the picture.
        """
        return self.through_lens(
            self._drawn(self._mounted(robot), street, robot, body=False), robot, street
        )

    def picture(
        self,
        eye_m: ArrayLike,
        target_m: ArrayLike,
        street: Street,
        robot: RobotState | None = None,
        size: tuple[int, int] = (640, 480),
        fov_deg: float = 60.0,
    ) -> Frame:
        """Render a view for humans with the robot in it.

        eye_m, target_m: (3,) camera position and point to look at
        size: width, height in pixels
        """
        return self._drawn(shot(eye_m, target_m, size, fov_deg), street, robot, body=True)

    def through_lens(self, frame: Frame, robot: RobotState, street: Street) -> Frame:
        """Apply the lens to a pinhole picture of the robot's camera, and crop it for the policy."""
        whole = through(self.spec, frame, robot, self._world.surface.seed, street.tick)
        return whole if self.spec.crop is None else _cropped(whole, *self.spec.crop)

    def _mounted(self, robot: RobotState) -> Shot:
        return mounted_shot(self._world.surface, self._world.robot, self._mounting, robot)


def _cropped(frame: Frame, x0: int, y0: int, x1: int, y1: int) -> Frame:
    """Crop a picture with its labels and depth."""
    part = slice(y0, y1), slice(x0, x1)
    labels = None if frame.labels is None else frame.labels[part].copy()
    return Frame(
        frame.rgb[part].copy(), labels, None if frame.depth is None else frame.depth[part].copy()
    )

"""For the bench: how much of the physics' and the camera's time is PyBullet's own, and how long frames take."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import pybullet as p

from cosim.ports import Camera
from cosim.state import RobotState, Street

Timed = Callable[[str, Callable[..., Any]], Callable[..., Any]]


def put_stopwatch(timed: Timed) -> None:
    """Replace PyBullet's step and picture by timed ones, for the rest of this process."""
    p.stepSimulation = timed("physics", p.stepSimulation)
    p.getCameraImage = timed("camera", p.getCameraImage)


def frame_times(camera: Camera, moments: Sequence[tuple[RobotState, Street]], count: int) -> list[float]:
    """Seconds of each of `count` frames of a running camera, which takes the moments in turn. The first round through
    the moments, in which the ground is built and shapes are made, is not counted."""
    for robot, street in moments:
        camera.render(robot, street)
    spent = []
    for k in range(count):
        robot, street = moments[k % len(moments)]
        began = time.perf_counter()
        camera.render(robot, street)
        spent.append(time.perf_counter() - began)
    return spent

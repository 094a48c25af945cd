"""For the bench: how much of the physics' and the camera's time is PyBullet's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from physics.dynamics.bullet import p

_Timed = Callable[[str, Callable[..., Any]], Callable[..., Any]]


def put_physics_stopwatch(timed: _Timed) -> None:
    """Replace PyBullet's step and picture by timed ones, for the rest of this process."""
    p.stepSimulation = timed("physics", p.stepSimulation)
    p.getCameraImage = timed("camera", p.getCameraImage)

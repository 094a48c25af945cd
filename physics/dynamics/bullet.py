"""Import of PyBullet without its start-up message, engine fingerprint, and timing hooks."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

_STEPS: Final = 240
"""Physics steps in the fingerprint simulation."""

_Timed = Callable[[str, Callable[..., Any]], Callable[..., Any]]


def _import_quietly() -> Any:
    """Import PyBullet with stderr redirected, so that progress bars stay intact."""
    sys.stderr.flush()
    saved = os.dup(2)
    try:
        with Path(os.devnull).open("wb") as devnull:
            os.dup2(devnull.fileno(), 2)
            import pybullet
    finally:
        os.dup2(saved, 2)
        os.close(saved)
    return pybullet


p = _import_quietly()


def bullet_fingerprint() -> dict[str, str]:
    """Return hashes of a small simulation and of a TinyRenderer image.

    The scene uses no project code, so the hashes depend on the PyBullet build alone.
    """
    client = p.connect(p.DIRECT)
    try:
        p.setGravity(0, 0, -9.81, physicsClientId=client)
        shapes = [
            p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client),
            p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.3, 0.2, 0.1], physicsClientId=client),
            p.createCollisionShape(p.GEOM_SPHERE, radius=0.15, physicsClientId=client),
        ]
        p.createMultiBody(0, shapes[0], physicsClientId=client)
        bodies = [
            p.createMultiBody(
                1.0 + i,
                shapes[1 + i % 2],
                basePosition=[0.05 * i, -0.03 * i, 0.4 + 0.3 * i],
                baseOrientation=p.getQuaternionFromEuler([0.1 * i, 0.2, 0.3 * i]),
                physicsClientId=client,
            )
            for i in range(8)
        ]
        seen = hashlib.blake2b(digest_size=8)
        for _ in range(_STEPS):
            p.stepSimulation(physicsClientId=client)
            for body in bodies:
                place, turn = p.getBasePositionAndOrientation(body, physicsClientId=client)
                seen.update(np.array([*place, *turn]).tobytes())
        view = p.computeViewMatrix([2.0, 1.5, 1.2], [0, 0, 0.3], [0, 0, 1])
        lens = p.computeProjectionMatrixFOV(60.0, 1.0, 0.1, 20.0)
        _, _, rgba, _, _ = p.getCameraImage(
            96, 96, view, lens, renderer=p.ER_TINY_RENDERER, physicsClientId=client
        )
        picture = np.asarray(rgba, dtype=np.uint8).tobytes()
    finally:
        p.disconnect(client)
    return {
        "PyBullet": seen.hexdigest(),
        "TinyRenderer": hashlib.blake2b(picture, digest_size=8).hexdigest(),
    }


def time_physics_calls(timed: _Timed) -> None:
    """Replace PyBullet's step and image functions by timed ones for the rest of the process."""
    p.stepSimulation = timed("physics", p.stepSimulation)
    p.getCameraImage = timed("camera", p.getCameraImage)

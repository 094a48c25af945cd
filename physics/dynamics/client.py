"""One PyBullet client: calls with errors of this project, bodies without mass, and rays."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats
from physics.dynamics.bullet import p
from physics.ground.mesh import Mesh, pybullet_lists

UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0)
"""Quaternion of an upright body that faces along x."""


class BulletClient:
    """A running PyBullet client; `close` ends it."""

    def __init__(self) -> None:
        self._client: int = p.connect(p.DIRECT)
        if self._client < 0:
            raise EngineError("PyBullet did not start")

    def close(self) -> None:
        """Disconnect the client."""
        p.disconnect(self._client)

    def add_concave(self, mesh: Mesh) -> int:
        """Add a static body of triangles; return its id."""
        middle = mesh.vertices.mean(axis=0) * (1.0, 1.0, 0.0)
        flags = p.GEOM_FORCE_CONCAVE_TRIMESH
        with pybullet_lists(mesh.triangles, mesh.vertices - middle) as (indices, (vertices,)):
            shape = self._call(
                "createCollisionShape", p.GEOM_MESH, vertices=vertices, indices=indices, flags=flags
            )
        return self._create_body(shape, middle)

    def remove_body(self, body: int) -> None:
        """Remove a body."""
        self._call("removeBody", body)

    def hit_shares(self, begin_m: Floats, end_m: Floats) -> Floats:
        """Return the share of each line at which it first hits a body, (N,); inf without a hit.

        begin_m, end_m: (N, 3) ends of the lines.
        """
        hits = self._call("rayTestBatch", begin_m.tolist(), end_m.tolist(), numThreads=1)
        return np.array([hit[2] if hit[0] >= 0 else np.inf for hit in hits], dtype=float)

    def _create_body(self, shape: int, at: Any, turn: Any = UPRIGHT) -> int:
        body: int = self._call(
            "createMultiBody",
            baseMass=0.0,
            baseCollisionShapeIndex=shape,
            basePosition=[float(c) for c in at],
            baseOrientation=turn,
            useMaximalCoordinates=True,
        )
        return body

    def _call(self, call: str, *args: Any, **options: Any) -> Any:
        try:
            return getattr(p, call)(*args, **options, physicsClientId=self._client)
        except p.error as error:
            raise EngineError(f"PyBullet: {call}: {error}") from error

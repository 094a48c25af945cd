"""Rays against triangles, through the C interface in PyBullet's library.

PyBullet's own function takes and returns lists of Python numbers, which takes as long as the rays.
Here arrays are passed. The answers have the same bits.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats
from physics.dynamics.bullet import p
from physics.dynamics.client import UPRIGHT
from physics.ground.mesh import Mesh

_MAX_VERTICES: Final = 131_072
"""Largest number of vertices of a body; Bullet leaves out further ones without an error."""
_MAX_CORNERS: Final = 524_288
"""Largest number of corners of triangles of a body, likewise."""
_MAX_RAYS: Final = 8_192
"""Number of rays of a call; Bullet fails above twice of it."""

_API_VERSION: Final = 202010061
"""Version of the C interface with the structures and statuses below."""
_RAYS_CAST: Final = 65
_BODY_REMOVED: Final = 75
_SHAPE_CREATED: Final = 80
_BODY_CREATED: Final = 84
"""Types of status after success, of `EnumSharedMemoryServerStatus`."""

_HIT: Final = np.dtype(
    [
        ("share", np.float64),
        ("body", np.int32),
        ("link", np.int32),
        ("at_m", np.float64, 3),
        ("normal", np.float64, 3),
    ]
)
"""A `b3RayHitInfo`."""


class _Answer(ctypes.Structure):
    """A `b3RaycastInformation`."""

    _fields_ = (("count", ctypes.c_int), ("hits", ctypes.c_void_p))


class TriangleRays:
    """Static triangles and rays against them, in an own Bullet client; `close` ends it."""

    def __init__(self) -> None:
        self._call = _interface()
        self._client: int | None = self._call.b3ConnectPhysicsDirect()
        if not self._client:
            raise EngineError("Bullet did not start")
        self._answer = _Answer()

    def close(self) -> None:
        """Disconnect the client."""
        if self._client is not None:
            self._call.b3DisconnectSharedMemory(self._client)
            self._client = None

    def add(self, mesh: Mesh) -> int:
        """Add a body of triangles; return its id. Raises EngineError for too large a mesh."""
        if len(mesh.vertices) > _MAX_VERTICES or 3 * len(mesh) > _MAX_CORNERS:
            raise EngineError(
                f"Bullet: a body has {len(mesh.vertices)} vertices and {len(mesh)} triangles, "
                f"but it may have {_MAX_VERTICES} and {_MAX_CORNERS // 3}"
            )
        call, client = self._call, self._client
        middle = mesh.vertices.mean(axis=0) * (1.0, 1.0, 0.0)
        vertices = np.ascontiguousarray(mesh.vertices - middle, dtype=np.float64)
        corners = np.ascontiguousarray(mesh.triangles, dtype=np.int32)
        command = call.b3CreateCollisionShapeCommandInit(client)
        number = call.b3CreateCollisionShapeAddConcaveMesh(
            client,
            command,
            _doubles(1.0, 1.0, 1.0),
            vertices.ctypes.data,
            len(vertices),
            corners.ctypes.data,
            corners.size,
        )
        call.b3CreateCollisionSetFlag(command, number, p.GEOM_FORCE_CONCAVE_TRIMESH)
        shape = call.b3GetStatusCollisionShapeUniqueId(self._sent(command, _SHAPE_CREATED))
        if shape < 0:
            raise EngineError(f"Bullet made no shape of {len(mesh)} triangles")
        command = call.b3CreateMultiBodyCommandInit(client)
        still, level = _doubles(0.0, 0.0, 0.0), _doubles(*UPRIGHT)
        at = _doubles(*middle.tolist())
        call.b3CreateMultiBodyBase(command, 0.0, shape, -1, at, level, still, level)
        call.b3CreateMultiBodyUseMaximalCoordinates(command)
        body: int = call.b3GetStatusBodyIndex(self._sent(command, _BODY_CREATED))
        if body < 0:
            raise EngineError(f"Bullet made no body of {len(mesh)} triangles")
        return body

    def remove(self, body: int) -> None:
        """Remove a body."""
        self._sent(self._call.b3InitRemoveBodyCommand(self._client, body), _BODY_REMOVED)

    def hit_shares(self, begin_m: Floats, end_m: Floats) -> Floats:
        """Return the share of each line at which it first hits a triangle, (N,); inf without a hit.

        begin_m, end_m: (N, 3) contiguous ends of the lines.
        """
        parts = [
            self._hit_shares(begin_m[i : i + _MAX_RAYS], end_m[i : i + _MAX_RAYS])
            for i in range(0, len(begin_m), _MAX_RAYS)
        ]
        return parts[0] if len(parts) == 1 else np.concatenate([np.zeros(0), *parts])

    def _hit_shares(self, begin_m: Floats, end_m: Floats) -> Floats:
        call, client = self._call, self._client
        command = call.b3CreateRaycastBatchCommandInit(client)
        call.b3RaycastBatchSetNumThreads(command, 1)
        call.b3RaycastBatchAddRays(
            client, command, begin_m.ctypes.data, end_m.ctypes.data, len(begin_m)
        )
        self._sent(command, _RAYS_CAST)
        call.b3GetRaycastInformation(client, ctypes.byref(self._answer))
        if self._answer.count != len(begin_m):
            raise EngineError(f"Bullet answered {self._answer.count} of {len(begin_m)} rays")
        size = self._answer.count * _HIT.itemsize
        hits = np.frombuffer((ctypes.c_char * size).from_address(self._answer.hits), dtype=_HIT)
        return np.where(hits["body"] >= 0, hits["share"], np.inf)

    def _sent(self, command: int, expected: int) -> int:
        """Run a command; return its status. Raises EngineError for a type that is not expected."""
        status: int = self._call.b3SubmitClientCommandAndWaitStatus(self._client, command)
        kind = self._call.b3GetStatusType(status) if status else -1
        if kind != expected:
            raise EngineError(f"Bullet failed: a command ended with status {kind}, not {expected}")
        return status


def _doubles(*values: float) -> Any:
    return (ctypes.c_double * len(values))(*values)


_POINTER: Final = ctypes.c_void_p
_INT: Final = ctypes.c_int
_FUNCTIONS: Final[Mapping[str, tuple[Any, ...]]] = MappingProxyType(
    {
        "ConnectPhysicsDirect": (_POINTER,),
        "DisconnectSharedMemory": (None, _POINTER),
        "SubmitClientCommandAndWaitStatus": (_POINTER, *[_POINTER] * 2),
        "CreateCollisionShapeCommandInit": (_POINTER, _POINTER),
        "CreateCollisionShapeAddConcaveMesh": (_INT, *[_POINTER] * 4, _INT, _POINTER, _INT),
        "CreateCollisionSetFlag": (None, _POINTER, _INT, _INT),
        "GetStatusCollisionShapeUniqueId": (_INT, _POINTER),
        "CreateMultiBodyCommandInit": (_POINTER, _POINTER),
        "CreateMultiBodyBase": (_INT, _POINTER, ctypes.c_double, _INT, _INT, *[_POINTER] * 4),
        "CreateMultiBodyUseMaximalCoordinates": (None, _POINTER),
        "GetStatusType": (_INT, _POINTER),
        "GetStatusBodyIndex": (_INT, _POINTER),
        "InitRemoveBodyCommand": (_POINTER, _POINTER, _INT),
        "CreateRaycastBatchCommandInit": (_POINTER, _POINTER),
        "RaycastBatchSetNumThreads": (None, _POINTER, _INT),
        "RaycastBatchAddRays": (None, *[_POINTER] * 4, _INT),
        "GetRaycastInformation": (None, *[_POINTER] * 2),
    }
)
"""Functions of Bullet without their prefix `b3`: type of the result, types of the arguments."""


@lru_cache(maxsize=1)
def _interface() -> Any:
    """Return PyBullet's library with the types of the functions used here."""
    if p.getAPIVersion() != _API_VERSION:
        raise EngineError(
            f"PyBullet has the interface {p.getAPIVersion()}, not {_API_VERSION}: install the "
            "locked PyBullet"
        )
    # PyDLL holds Python's lock during calls, as Bullet's global variables allow one thread only.
    library = ctypes.PyDLL(p.__file__)
    for name, (result, *arguments) in _FUNCTIONS.items():
        try:
            function = getattr(library, f"b3{name}")
        except AttributeError as error:
            raise EngineError(
                f"PyBullet's library has no function b3{name}: install the locked PyBullet"
            ) from error
        function.restype, function.argtypes = result, arguments
    return library

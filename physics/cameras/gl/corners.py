"""Conversion of meshes to rows of a vertex buffer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physics.ground.mesh import Mesh

CORNER: Final = np.dtype([("at", "f4", 3), ("normal", "u1", 4), ("colour", "u1", 4)])
"""normal: bytes from -127 to 127, plus 127, for `unpacked` in shading's chunks.

Each drawable defines the meaning of the fourth channels.
"""

LAYOUT: Final = ("3f 4f1 4f1", "in_at", "in_normal", "in_colour")
"""Layout of CORNER for moderngl."""

CornerRows = NDArray[np.void]


def corners(mesh: Mesh, colour: ArrayLike, fourth: int) -> CornerRows:
    """Return (V,) rows of CORNER of a mesh.

    colour: rgb from 0 to 1, (3,) or (V, 3)
    fourth: fourth channel of the colour
    """
    rows = np.zeros(len(mesh.vertices), dtype=CORNER)
    rows["at"], rows["normal"][:, :3] = mesh.vertices, np.rint(127.0 * mesh.normals) + 127.0
    rows["colour"][:, :3], rows["colour"][:, 3] = np.rint(255.0 * np.asarray(colour)), fourth
    return rows


def joined_corners(
    parts: Sequence[tuple[Mesh, CornerRows]],
) -> tuple[CornerRows, NDArray[np.uint32]]:
    """Concatenate one or more meshes.

    Returns their rows and the flat indices of their triangles.
    """
    starts = np.cumsum([0, *(len(rows) for _, rows in parts)])
    indices = [
        (mesh.triangles + start).ravel() for (mesh, _), start in zip(parts, starts, strict=False)
    ]
    return np.concatenate([rows for _, rows in parts]), np.concatenate(indices).astype(np.uint32)

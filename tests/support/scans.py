"""A small scanned street, its splats, and writers of the formats in which scans come."""

from __future__ import annotations

import gzip
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from physics.scans.read_splats import SH_C0

LENGTH_M = 30.0
HALF_WIDTH_M = 6.0
WALL_M = 3.0
FIELDS = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


@dataclass
class Street:
    """Metres, z up: ground with a wall along one side, a shorter one across, and a post."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    colours: NDArray[np.uint8]

    def mesh(self) -> trimesh.Trimesh:
        return trimesh.Trimesh(
            self.vertices, self.triangles, vertex_colors=self.colours, process=False
        )

    def moved(self, matrix: NDArray[Any]) -> Street:
        """Return the street after a 3 x 3 or 4 x 4 matrix."""
        found = self.vertices @ matrix[:3, :3].T
        if matrix.shape == (4, 4):
            found = found + matrix[:3, 3]
        return Street(found, self.triangles, self.colours)


@dataclass
class Cloud:
    """Splats: centres (N, 3), linear scales (N, 3), quaternions (N, 4) w first, rgba 0 to 1."""

    centres: NDArray[np.float64]
    scales: NDArray[np.float64]
    quaternions: NDArray[np.float64]
    rgba: NDArray[np.float64]

    def taken(self, rows: Any) -> Cloud:
        return Cloud(self.centres[rows], self.scales[rows], self.quaternions[rows], self.rgba[rows])


def street() -> Street:
    parts = [
        _sheet((0, -HALF_WIDTH_M, 0), (LENGTH_M, 0, 0), (0, 2 * HALF_WIDTH_M, 0), 0.5),
        _sheet((0, HALF_WIDTH_M, 0), (LENGTH_M, 0, 0), (0, 0, WALL_M), 0.5),
        _sheet((LENGTH_M, -HALF_WIDTH_M, 0), (0, 2.5 * HALF_WIDTH_M / 2.5, 0), (0, 0, 2.0), 0.5),
        _sheet((8, 3, 0), (0.4, 0, 0), (0, 0, 1.5), 0.2),
        _sheet((8, 3.4, 0), (0, -0.4, 0), (0, 0, 1.5), 0.2),
    ]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    triangles = np.concatenate([t + s for (_, t), s in zip(parts, starts, strict=False)])
    shade = 90 + 60 * np.sin(vertices[:, 0]) + 8 * vertices[:, 2]
    colours = np.clip(np.column_stack([shade, shade * 0.9, shade * 0.8]), 0, 255).astype(np.uint8)
    return Street(vertices, triangles, colours)


def _sheet(
    corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], step_m: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a rectangle, counter-clockwise as seen from u x v."""
    n, m = (max(1, round(np.linalg.norm(side) / step_m)) for side in (u, v))
    i, j = np.meshgrid(np.arange(n + 1), np.arange(m + 1), indexing="ij")
    vertices = np.array(corner, float) + np.outer(i / n, u) + np.outer(j / m, v)
    at = (i * (m + 1) + j)[:-1, :-1].ravel()
    triangles = [[at, at + m + 1, at + m + 2], [at, at + m + 2, at + 1]]
    return vertices, np.concatenate([np.array(one).T for one in triangles])


def splats_of(place: Street, count: int = 12_000, seed: int = 0) -> Cloud:
    """Return flat splats on the surfaces of a street, with opacity 0.9."""
    random = np.random.default_rng(seed)
    mesh = place.mesh()
    ends = np.cumsum(mesh.area_faces)
    faces = np.searchsorted(ends, random.random(count) * ends[-1])
    a, b = random.random((2, count, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    corner = place.vertices[place.triangles[faces]]
    centres = corner[:, 0] + a * (corner[:, 1] - corner[:, 0]) + b * (corner[:, 2] - corner[:, 0])
    normals = mesh.face_normals[faces]
    half = np.array([0.0, 0.0, 1.0]) + normals
    half /= np.linalg.norm(half, axis=1)[:, None]
    axis = np.cross([0.0, 0.0, 1.0], half)
    quaternions = np.column_stack([half[:, 2], axis])
    rgb = place.colours[place.triangles[faces, 0]] / 255.0
    return Cloud(
        centres,
        np.tile([0.12, 0.12, 0.01], (count, 1)),
        quaternions,
        np.column_stack([rgb, np.full(count, 0.9)]),
    )


def glb(place: Street) -> bytes:
    """Return a street as glTF, y up."""
    y_up = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)
    written: bytes = place.moved(y_up).mesh().export(file_type="glb")
    return written


def gaussian_ply(
    cloud: Cloud, *, linear: bool = False, order: str = "wxyz", extra: tuple[str, ...] = ()
) -> bytes:
    """Return splats as 3DGS writes them: log scales and logit opacities, unless `linear`."""
    opacity = cloud.rgba[:, 3]
    q = cloud.quaternions if order == "wxyz" else cloud.quaternions[:, [1, 2, 3, 0]]
    columns = [
        cloud.centres,
        (cloud.rgba[:, :3] - 0.5) / SH_C0,
        (opacity if linear else np.log(opacity / (1 - opacity)))[:, None],
        cloud.scales if linear else np.log(cloud.scales),
        q,
        np.zeros((len(opacity), len(extra))),
    ]
    fields = "".join(f"property float {name}\n" for name in (*FIELDS, *extra))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(opacity)}\n{fields}"
    return f"{head}end_header\n".encode() + np.hstack(columns).astype("<f4").tobytes()


def splat_file(cloud: Cloud) -> bytes:
    """Return splats as .splat: 32 bytes a row."""
    rows = np.zeros(
        len(cloud.centres), [("c", "<f4", 3), ("s", "<f4", 3), ("k", "u1", 4), ("q", "u1", 4)]
    )
    rows["c"], rows["s"] = cloud.centres, cloud.scales
    rows["k"] = np.rint(cloud.rgba * 255)
    rows["q"] = np.clip(np.rint(cloud.quaternions * 128 + 128), 0, 255)
    return rows.tobytes()


def spz_file(cloud: Cloud, version: int, bits: int = 12) -> bytes:
    """Return splats as .spz of version 1, 2 or 3."""
    count = len(cloud.centres)
    if version == 1:
        centres = cloud.centres.astype("<f2").tobytes()
    else:
        fixed = np.rint(cloud.centres * (1 << bits)).astype(np.int64) & 0xFFFFFF
        centres = np.stack([fixed >> shift & 255 for shift in (0, 8, 16)], 2).astype("u1").tobytes()
    colour = np.clip(np.rint(((cloud.rgba[:, :3] - 0.5) / SH_C0 * 0.15 + 0.5) * 255), 0, 255)
    scales = np.clip(np.rint((np.log(cloud.scales) + 10) * 16), 0, 255)
    xyzw = cloud.quaternions[:, [1, 2, 3, 0]]
    if version == 3:
        rotations = b"".join(_smallest_three(q) for q in xyzw)
    else:
        xyz = xyzw[:, :3] * np.where(xyzw[:, 3:] < 0, -1, 1)
        rotations = np.clip(np.rint(xyz * 127.5 + 127.5), 0, 255).astype("u1").tobytes()
    head = struct.pack("<IIIBBBB", 0x5053474E, version, count, 0, bits, 0, 0)
    alpha = np.rint(cloud.rgba[:, 3] * 255).astype("u1").tobytes()
    body = centres + alpha + colour.astype("u1").tobytes() + scales.astype("u1").tobytes()
    return gzip.compress(head + body + rotations)


def _smallest_three(q: NDArray[np.float64]) -> bytes:
    largest = int(np.argmax(np.abs(q)))
    q = q * np.sign(q[largest])
    packed = largest
    for k in range(4):
        if k != largest:
            size = min(511, round(511 * abs(float(q[k])) * 2**0.5))
            packed = packed << 10 | int(q[k] < 0) << 9 | size
    return struct.pack("<I", packed)


def write_street(folder: Path, place: Street | None = None, cloud: Cloud | None = None) -> Path:
    """Write a folder with mesh.glb and splats.ply, in metres; the splats have z up."""
    folder.mkdir(parents=True, exist_ok=True)
    place = place or street()
    (folder / "mesh.glb").write_bytes(glb(place))
    (folder / "splats.ply").write_bytes(gaussian_ply(cloud or splats_of(place)))
    return folder

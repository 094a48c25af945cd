"""Read triangle meshes of scans: .glb, .ply and .obj, with colours of vertices or textures."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from physics.scans.bake import bake_texture
from physics.scans.findings import Finding, note, warning
from physics.scans.frame import move
from physics.scans.sources import read_ply_header, stem_and_ending
from physics.textures.layers import as_uint8, linear_to_srgb

MAX_TRIANGLES: Final = 6_000_000
"""Maximum number of triangles of a scan."""
MAX_DROPPED_SHARE: Final = 0.01
"""Share of triangles with invalid numbers above which a file is refused."""
GREY: Final = (128, 128, 128)
"""sRGB colour of meshes without colours."""
_SRGB_WRITERS: Final = ("trimesh", "open3d", "meshlab", "cosim")
"""Generators of .glb files that write vertex colours as sRGB, against the glTF specification."""

Colours = Literal["srgb", "linear"]
"""Encoding of vertex colours."""


@dataclass(frozen=True, slots=True)
class RawMesh:
    """Mesh in the frame and unit of its file.

    vertices: (V, 3).
    triangles: (T, 3).
    colours: (V, 3) uint8 sRGB.
    """

    vertices: Floats
    triangles: NDArray[np.int64]
    colours: NDArray[np.uint8]
    findings: tuple[Finding, ...] = ()


def read_mesh(path: Path, data: bytes, unit_m: float, colours: Colours | None = None) -> RawMesh:
    """Return the mesh of a file. Raises MapError with the finding and a remedy.

    data: content of the file, see `read_source`.
    unit_m: metres per unit, by which textures are baked.
    colours: encoding of vertex colours; by default sRGB, and linear in .glb files of programs
        that follow the glTF specification.
    """
    ending = stem_and_ending(path)[1]
    generator = ""
    if ending == ".glb":
        generator = _check_glb(path, data)
    elif ending == ".ply":
        _check_ply(path, data)
    srgb = any(name in generator.lower() for name in _SRGB_WRITERS)
    encoding: Colours = colours or ("linear" if ending == ".glb" and not srgb else "srgb")
    parts, findings = [], []
    for vertices, triangles, painted, words in _parts(path, data, ending, unit_m, encoding):
        parts.append((vertices, triangles, painted))
        findings += words
    if not parts:
        raise MapError(f"{path}: holds 0 triangles: export the scan as a mesh with faces")
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts)])
    return _whole(
        path,
        np.concatenate([vertices for vertices, _, _ in parts]),
        np.concatenate([t + start for (_, t, _), start in zip(parts, starts, strict=False)]),
        np.concatenate([painted for _, _, painted in parts]),
        list(dict.fromkeys(findings)),
    )


def _check_glb(path: Path, data: bytes) -> str:
    """Check the frame of a .glb file, and return the name of its generator. Raises MapError."""
    if data[:4] != b"glTF" or len(data) < 20:
        raise MapError(
            f"{path}: not a .glb file: it starts with {data[:4]!r} in place of b'glTF': export "
            "the scan again"
        )
    _, version, size, head, _ = struct.unpack_from("<IIIII", data)
    if version != 2:
        raise MapError(f"{path}: glTF version {version}; version 2 is read: export it as .glb")
    if size > len(data):
        raise MapError(
            f"{path}: is cut off: {len(data)} of {size} bytes are there: download it again"
        )
    try:
        tree = json.loads(data[20 : 20 + head])
    except ValueError as error:
        raise MapError(f"{path}: its JSON part is broken: {error}: export it again") from error
    packed = [one for one in tree.get("extensionsRequired", []) if "compression" in one]
    if packed:
        raise MapError(
            f"{path}: is packed with {', '.join(packed)}, which is not read: export it without "
            "mesh compression"
        )
    return str(tree.get("asset", {}).get("generator", ""))


def _check_ply(path: Path, data: bytes) -> None:
    """Check that a binary .ply file is not cut off. Raises MapError."""
    header = read_ply_header(path, data)
    if header.form == "ascii":
        return
    least = 0
    for element in header.elements:
        row = sum(int(kind[1]) for _, kind in element.properties)
        least += element.count * (row + (13 if element.lists else 0))
    if len(data) - header.size < least:
        raise MapError(
            f"{path}: is cut off: its header promises {least} bytes or more, and "
            f"{len(data) - header.size} follow: download it again"
        )


def _parts(
    path: Path, data: bytes, ending: str, unit_m: float, encoding: Colours
) -> Iterator[tuple[Floats, NDArray[np.int64], NDArray[np.uint8], list[Finding]]]:
    """Yield vertices, triangles, colours and findings of every mesh of a file, in its frame."""
    import trimesh  # takes 0.2 s

    try:
        if path.name.lower().endswith(".gz"):
            scene = trimesh.load_scene(io.BytesIO(data), file_type=ending[1:], process=False)
        else:
            scene = trimesh.load_scene(path, process=False)
    except Exception as error:
        raise MapError(
            f"{path}: cannot be read as a mesh: {type(error).__name__}: {str(error)[:120]}: "
            "export the scan again"
        ) from error
    for name in scene.graph.nodes_geometry:
        matrix, key = scene.graph[name]
        mesh = scene.geometry[key]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        rows = tuple(tuple(float(one) for one in row) for row in matrix)
        vertices = move(np.asarray(mesh.vertices), rows)
        if not np.isfinite(vertices).all():
            yield vertices, _ints(mesh.faces), _grey(vertices), []
        else:
            yield _coloured(path, mesh, vertices, unit_m, encoding)


def _coloured(
    path: Path, mesh: Any, vertices: Floats, unit_m: float, encoding: Colours
) -> tuple[Floats, NDArray[np.int64], NDArray[np.uint8], list[Finding]]:
    """Return a mesh of trimesh with a colour per vertex."""
    triangles, visual = _ints(mesh.faces), mesh.visual
    if visual.kind == "vertex":
        colours = np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)
        return vertices, triangles, _as_srgb(colours, encoding), []
    if visual.kind == "face":
        corners = vertices[triangles].reshape(-1, 3)
        colours = np.repeat(np.asarray(visual.face_colors)[:, :3].astype(np.uint8), 3, axis=0)
        apart = np.arange(len(corners)).reshape(-1, 3)
        return corners, apart, _as_srgb(colours, encoding), []
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if image is not None and visual.uv is not None:
            pixels = np.asarray(image.convert("RGB"))
            done = bake_texture(vertices, triangles, np.asarray(visual.uv), pixels, unit_m)
            words = (
                f"{path.name}: its texture is baked to colours of vertices, "
                f"{done.edge_m:.2g} m apart at most"
            )
            return done.vertices, done.triangles, done.colours, [note(words)]
        words = (
            f"{path.name}: its texture is missing or packed in a format that is not read (KTX2): "
            "drawn in one colour; export it with PNG or JPEG textures, beside an .obj"
        )
        found = [] if visual.uv is None else [warning(words)]
        return vertices, triangles, _plain(material, vertices), found
    words = f"{path.name}: has no colours: drawn grey; export it with texture or vertex colours"
    return vertices, triangles, _grey(vertices), [warning(words)]


def _plain(material: Any, vertices: Floats) -> NDArray[np.uint8]:
    """Return the colour of a material without a texture for every vertex."""
    factor = getattr(material, "baseColorFactor", None)
    if factor is None:
        colour = np.asarray(getattr(material, "main_color", (*GREY, 255)))[:3]
    else:  # trimesh turns the factor, which is linear, into bytes
        colour = as_uint8(linear_to_srgb(np.asarray(factor)[None, :3] / 255.0))[0]
    found: NDArray[np.uint8] = np.tile(np.asarray(colour, dtype=np.uint8), (len(vertices), 1))
    return found


def _as_srgb(colours: NDArray[np.uint8], encoding: Colours) -> NDArray[np.uint8]:
    if encoding == "srgb":
        return colours
    table = np.rint(linear_to_srgb(np.arange(256) / 255.0) * 255.0).astype(np.uint8)
    found: NDArray[np.uint8] = table[colours]
    return found


def _grey(vertices: Floats) -> NDArray[np.uint8]:
    return np.full((len(vertices), 3), GREY, dtype=np.uint8)


def _ints(faces: Any) -> NDArray[np.int64]:
    return np.asarray(faces, dtype=np.int64)


def _whole(
    path: Path,
    vertices: Floats,
    triangles: NDArray[np.int64],
    colours: NDArray[np.uint8],
    findings: list[Finding],
) -> RawMesh:
    """Return a mesh without triangles with invalid numbers. Raises MapError if they are many."""
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise MapError(
            f"{path}: a triangle has the vertex {triangles.max()} of {len(vertices)}: the file is "
            "damaged, export the scan again"
        )
    finite = np.asarray(np.isfinite(vertices).all(axis=1))
    valid = np.asarray(finite[triangles].all(axis=1))
    if dropped := int(len(valid) - np.count_nonzero(valid)):
        if dropped > MAX_DROPPED_SHARE * len(valid):
            raise MapError(
                f"{path}: {dropped} of {len(valid)} triangles ({dropped / len(valid):.1%}) have "
                f"NaN or infinite corners; at most {MAX_DROPPED_SHARE:.0%} are dropped: export "
                "the scan again"
            )
        words = f"{path.name}: {dropped} of {len(valid)} triangles with NaN or infinite corners"
        findings.append(warning(f"{words} dropped: export the scan again if they matter"))
    used = np.zeros(len(vertices), dtype=bool)
    used[triangles[valid]] = True
    index = np.cumsum(used) - 1
    return RawMesh(vertices[used], index[triangles[valid]], colours[used], tuple(findings))

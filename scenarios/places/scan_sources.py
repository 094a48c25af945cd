"""Read the files of a scan's folder into one mesh and one set of splats in the net's frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from cosim.core.progress import Progress, ignore
from cosim.place.scan import Georeference, ScanMesh, Splats
from physics.scans.check import fitting_frame, ground_planes, guess_up
from physics.scans.clean import largest_m
from physics.scans.findings import Finding, note, warning
from physics.scans.frame import (
    UP_AXES,
    Matrix,
    combine,
    file_matrix,
    levelling,
    local_origin,
    move,
    move_splats,
    place,
    scale_of,
    unplaced,
)
from physics.scans.mesh_distance import MeshDistance
from physics.scans.ordering import order_mesh, order_splats, take_splats
from physics.scans.read_mesh import MAX_TRIANGLES, RawMesh, read_mesh
from physics.scans.read_splats import RawSplats, read_splats
from physics.scans.sources import kind_of_source, read_source, stem_and_ending
from scenarios.places.scan_options import OPTIONS_FILE, ScanOptions, Up, read_transform

BUDGET: Final = 4_000_000
"""Number of splats above which a scan is refused: 3 million are drawn at 60 frames/s on a GPU."""
NORTH_ASSUMED: Final = (
    "georeference: +y of the scan (-z of a .glb) is taken as north, heading 0: if it points "
    "elsewhere, give its compass heading in degrees as third number of --georeference, or as "
    "heading_deg in scan.json"
)
_ENDINGS: Final = (".glb", ".ply", ".obj", ".spz", ".splat")


@dataclass(slots=True)
class LoadedScan:
    """Scan in the net's frame.

    raw: splats in the frame of their file; None without splats.
    matrix, splat_matrix: from the files to the net's frame.
    placing: from metres with z up to the net's frame.
    file_matrix: from the mesh's files to metres with z up; None if they differ in it.
    up: stated axis of the mesh, "" with a transform.
    files: SHA-256 of each file by its name.
    """

    mesh: ScanMesh
    matrix: Matrix
    up: str
    georeference: Georeference | None
    scale: float
    splats: Splats | None = None
    raw: RawSplats | None = None
    splat_matrix: Matrix | None = None
    placing: Matrix = ()
    file_matrix: Matrix | None = None
    files: dict[str, str] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


@dataclass(slots=True)
class _Found:
    """Files of a folder by kind, with their contents."""

    meshes: dict[Path, bytes] = field(default_factory=dict)
    splats: dict[Path, bytes] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    files: dict[str, str] = field(default_factory=dict)


def load_mesh(
    folder: Path, options: ScanOptions, progress: Progress = ignore
) -> tuple[LoadedScan, dict[Path, bytes]]:
    """Return the scan of a folder without its splats, and the contents of their files.

    Raises MapError with a finding and a remedy.
    """
    found = _found(folder, options, progress)
    loaded = _load_mesh(found, options, progress)
    loaded.files, loaded.findings = found.files, found.findings + loaded.findings
    return loaded, found.splats


def _found(folder: Path, options: ScanOptions, progress: Progress) -> _Found:
    """Read the files of a folder, in the order of their names."""
    names = options.files or [
        path.name
        for path in sorted(folder.iterdir())
        if path.is_file() and stem_and_ending(path)[1] in (*_ENDINGS, ".gltf")
    ]
    found = _Found()
    for name in sorted(set(names)):
        path = folder / name
        if not path.is_file():
            there = ", ".join(sorted(one.name for one in folder.iterdir())[:20])
            raise MapError(f"files: '{name}' is not in {folder}: there are {there}")
        if stem_and_ending(path)[1] == ".gltf":
            raise MapError(f"{path}: .gltf with separate files is not read: export it as .glb")
        progress(f"reading {name}")
        data = read_source(path)
        kind = kind_of_source(path, data)
        if kind == "points":
            found.findings.append(
                note(f"{name}: a point cloud, without triangles and splats: not used")
            )
            continue
        found.files[name] = hashlib.sha256(data).hexdigest()
        (found.meshes if kind == "mesh" else found.splats)[path] = data
    if not found.meshes:
        count = f"{len(found.splats)} files of splats" if found.splats else "no files"
        raise MapError(
            f"{folder}: holds {count} and 0 meshes: export the scan also as a mesh (.glb, .ply or "
            ".obj with faces): heights and contacts come from it"
        )
    return found


def _load_mesh(found: _Found, options: ScanOptions, progress: Progress) -> LoadedScan:
    """Read all meshes, and place the scan by their bounds."""
    transform = read_transform(options.transform)
    meshes: list[tuple[Matrix, str, RawMesh]] = []
    for path, data in found.meshes.items():
        progress(f"reading the mesh {path.name}")
        gltf = stem_and_ending(path)[1] == ".glb"
        scale: float | None = options.scale
        up: Up | None = options.up
        if transform is None and gltf:
            scale, up = scale or 1.0, up or "+y"
        if transform is None and (scale is None or up is None):
            _refuse_unstated(path, data, scale, up)
        matrix = _mirrored(file_matrix(scale or 1.0, up or "+z", transform), options.mirror)
        unit_m = scale or 1.0 if transform is None else scale_of(matrix)
        raw = read_mesh(path, data, unit_m, options.colours)
        meshes.append((matrix, "" if transform else str(up), raw))
    parts = [move(raw.vertices, matrix) for matrix, _, raw in meshes]
    low = np.min([part.min(axis=0) for part in parts], axis=0)
    high = np.max([part.max(axis=0) for part in parts], axis=0)
    placing, georeference = place(low, high, options.georeference)
    starts = np.cumsum([0, *(len(part) for part in parts)])
    triangles: NDArray[np.int64] = np.concatenate(
        [raw.triangles + start for (_, _, raw), start in zip(meshes, starts, strict=False)]
    )
    if len(triangles) > MAX_TRIANGLES:
        raise MapError(
            f"the mesh has {len(triangles)} triangles; at most {MAX_TRIANGLES} are imported: "
            "simplify it, for example in MeshLab or Blender"
        )
    progress("ordering the mesh")
    mesh = order_mesh(
        move(np.concatenate(parts), placing).astype(np.float32),
        triangles[:, ::-1] if options.flip else triangles,
        np.concatenate([raw.colours for _, _, raw in meshes]),
    )
    if not len(mesh.triangles):
        raise MapError("the mesh has only flat triangles, of no area: export the scan again")
    matrix, stated, _ = meshes[0]
    findings = [finding for _, _, raw in meshes for finding in raw.findings]
    words = f"mesh: {len(mesh.triangles)} triangles, {len(mesh.vertices)} vertices"
    findings.append(note(words))
    origin = local_origin(low, high)
    if origin.any():
        shifted = ", ".join(f"{one:.0f}" for one in origin)
        findings.append(note(f"local origin at ({shifted}) m of the source frame"))
    given = options.georeference
    if given is not None and not given.crs and given.heading_deg is None:
        findings.append(note(NORTH_ASSUMED))
    return LoadedScan(
        mesh,
        combine(placing, matrix),
        stated,
        georeference,
        scale_of(matrix),
        placing=placing,
        file_matrix=matrix if all(one == matrix for one, _, _ in meshes) else None,
        findings=findings,
    )


def _refuse_unstated(path: Path, data: bytes, scale: float | None, up: str | None) -> None:
    """Raise MapError for a mesh without scale or up axis, with a guess as remedy."""
    raw = read_mesh(path, data, scale or 1.0)
    vertices = (raw.vertices - raw.vertices.mean(axis=0)) * (scale or 1.0)
    size = float(np.ptp(vertices, axis=0).max())
    missing = [name for name, value in (("scale", scale), ("up", up)) if value is None]
    unit = size if scale is None else 1.0
    mesh = order_mesh((vertices / unit * 100.0).astype(np.float32), raw.triangles, raw.colours)
    normal = ground_planes(mesh)[0].normal
    axis, angle = guess_up(normal, "+z")
    hints = []
    if up is None:
        hints.append(f"--up {axis} (the ground's normal is {angle:.1f} degrees off it)")
    if scale is None:
        hints.append(f"--scale 1 if it is {size:.4g} m long, else metres per unit")
    raise MapError(
        f"{path}: {' and '.join(missing)} must be given for a {stem_and_ending(path)[1]} file, in "
        f"scan.json or as options; likely: {', '.join(hints)}"
    )


def load_splats(
    loaded: LoadedScan, files: dict[Path, bytes], options: ScanOptions, progress: Progress
) -> None:
    """Read all splats into a loaded scan. Raises MapError with a finding and a remedy."""
    raws = []
    for path, data in files.items():
        progress(f"reading the splats {path.name}")
        raws.append(read_splats(path, data, options.quaternions))
    raw = RawSplats(
        np.concatenate([one.centres for one in raws]),
        np.concatenate([one.scales for one in raws]),
        np.concatenate([one.quaternions for one in raws]),
        np.concatenate([one.rgba for one in raws]),
    )
    loaded.findings += [finding for one in raws for finding in one.findings]
    names = ", ".join(path.name for path in files)
    if len(raw) > BUDGET and options.most_splats is None:
        raise MapError(
            f"{names}: {len(raw)} splats; at most {BUDGET} are imported: reduce them with "
            f"--most-splats {BUDGET // 2}, or in SuperSplat"
        )
    loaded.raw = raw
    stated = all(stem_and_ending(path)[1] == ".spz" for path in files)
    own = _splat_matrix(loaded, names, raw, options, "+y" if stated else None)
    loaded.splat_matrix = combine(loaded.placing, own)
    progress("ordering the splats")
    splats = order_splats(move_splats(raw, loaded.splat_matrix))
    loaded.findings.append(note(f"{names}: {len(splats)} splats"))
    if options.most_splats is not None and len(splats) > options.most_splats:
        loaded.findings.append(
            warning(
                f"{names}: reduced from {len(splats)} to {options.most_splats} splats, the least "
                "visible first: pictures lose detail"
            )
        )
        splats = _reduced(splats, options.most_splats)
    loaded.splats = splats


def _splat_matrix(
    loaded: LoadedScan, names: str, raw: RawSplats, options: ScanOptions, format_up: Up | None
) -> Matrix:
    """Return the matrix from the splats' frame to metres with z up.

    format_up: axis that the format states, None without one.
    Raises MapError if scale or up are not given, with what fits the mesh.
    """
    own = any(
        getattr(options, f"splat_{name}") is not None
        for name in ("scale", "up", "transform", "mirror")
    )
    transform = read_transform(options.splat_transform if own else options.transform)
    scale = options.splat_scale or (None if transform else options.scale)
    up = options.splat_up or (None if transform else options.up or format_up)
    if transform is None and (scale is None or up is None):
        missing = [
            name for name, value in (("splat_scale", scale), ("splat_up", up)) if value is None
        ]
        hint = splat_hint(loaded, raw, scale)
        raise MapError(
            f"{names}: {' and '.join(missing)} must be given, in scan.json or as options, because "
            f"splats state neither unit nor axes{hint or ': compare with the mesh in a viewer'}"
        )
    mirror = options.splat_mirror if own else options.mirror
    return _mirrored(file_matrix(scale or 1.0, up or "+z", transform), mirror)


def level_hint(loaded: LoadedScan, options: ScanOptions, normal: Floats) -> str:
    """Return the transforms for `scan.json` that turn the ground's normal up.

    normal: in the net's frame. Returns "" for files with several frames or a mirrored one.
    """
    own = any(
        getattr(options, f"splat_{name}") is not None for name in ("scale", "up", "transform")
    )
    if loaded.file_matrix is None or options.mirror or options.splat_mirror:
        return ""
    turn = levelling(unplaced(normal, loaded.placing))
    found = {"transform": combine(turn, loaded.file_matrix)}
    if own:
        transform = read_transform(options.splat_transform)
        scale, up = options.splat_scale or options.scale, options.splat_up or options.up
        if transform is None and (scale is None or up is None):
            return ""
        splats = file_matrix(scale or 1.0, up or "+z", transform)
        found["splat_transform"] = combine(turn, splats)
    rows = ", ".join(
        f'"{key}": {[[round(one, 9) + 0.0 for one in row] for row in matrix]}'
        for key, matrix in found.items()
    )
    return f"this in {OPTIONS_FILE}, in place of scale and up: {rows}"


def splat_hint(loaded: LoadedScan, raw: RawSplats, scale: float | None) -> str:
    """Return advice with the up axis, and if need be a mirrored one, that fits the mesh."""
    frames = {}
    for mirror in (None, "x", "y", "z"):
        for up in UP_AXES:
            words = f"--splat-scale {scale or 1.0:g} --splat-up {up}"
            matrix = _mirrored(file_matrix(scale or 1.0, up, None), mirror)
            words += f" --splat-mirror {mirror}" if mirror else ""
            frames[words] = combine(loaded.placing, matrix)
    opaque = raw.centres[raw.rgba[:, 3] >= 128]
    return fitting_frame(opaque, frames, MeshDistance(loaded.mesh)) if len(opaque) else ""


def _reduced(splats: Splats, most: int) -> Splats:
    """Return the most visible splats by opacity and size, in their order."""
    weight = splats.rgba[:, 3] * np.minimum(largest_m(splats), 1.0)
    kept = np.sort(np.argsort(-weight, kind="stable")[:most])
    return take_splats(splats, kept)


def _mirrored(matrix: Matrix, axis: str | None) -> Matrix:
    """Return a matrix that negates an axis of the file first."""
    if axis is None:
        return matrix
    signs = [-1.0 if axis == one else 1.0 for one in "xyz"] + [1.0]
    return tuple(tuple(a * sign for a, sign in zip(row, signs, strict=True)) for row in matrix)

"""Read Gaussian splats: 3DGS .ply, .splat, and .spz of the versions 1 to 3.

Spherical harmonics above degree 0 are left out. The layout of .spz is that of
https://github.com/nianticlabs/spz.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from physics.scans.findings import Finding, note, warning
from physics.scans.sources import read_ply_header, stem_and_ending

SH_C0: Final = 0.28209479177387814
"""Value of the spherical harmonic of degree 0."""
MAX_SPLATS: Final = 20_000_000
"""Maximum number of splats in a file."""
MAX_DROPPED_SHARE: Final = 0.01
"""Share of splats with invalid numbers above which a file is refused."""
_SPLAT_ROW: Final = np.dtype(
    [("centre", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
)
_SPZ_MAGIC: Final = 0x5053474E
_SPZ_COLOUR: Final = 0.15
"""Units of a colour byte's range per unit of f_dc in .spz files."""
_PLY_FIELDS: Final = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)

QuaternionOrder = Literal["wxyz", "xyzw"]


@dataclass(frozen=True, slots=True)
class RawSplats:
    """Splats in the frame and unit of their file.

    centres: (N, 3).
    scales: (N, 3) standard deviations along the axes.
    quaternions: (N, 4) w, x, y, z, of unit length.
    rgba: (N, 4) uint8 sRGB colour and opacity.
    """

    centres: Floats
    scales: Floats
    quaternions: Floats
    rgba: NDArray[np.uint8]
    findings: tuple[Finding, ...] = ()

    def __len__(self) -> int:
        return len(self.centres)


def read_splats(path: Path, data: bytes, order: QuaternionOrder = "wxyz") -> RawSplats:
    """Return the splats of a file. Raises MapError with the finding and a remedy.

    data: content of the file, see `read_source`.
    order: of the quaternions of a .ply file.
    """
    ending = stem_and_ending(path)[1]
    if ending == ".splat":
        return _read_splat(path, data)
    return _read_spz(path, data) if ending == ".spz" else _read_ply(path, data, order)


def _read_ply(path: Path, data: bytes, order: QuaternionOrder) -> RawSplats:
    header = read_ply_header(path, data)
    element = header.elements[0]
    names = [name for name, _ in element.properties]
    if "packed_position" in names or any(e.name == "chunk" for e in header.elements):
        raise MapError(
            f"{path}: a compressed .ply of SuperSplat, which is not read: export it as .ply "
            "(uncompressed), .splat or .spz"
        )
    if header.form != "binary_little_endian":
        raise MapError(
            f"{path}: its format is '{header.form}', and only binary_little_endian is read: "
            "export it as a binary .ply"
        )
    missing = [name for name in _PLY_FIELDS if name not in names]
    if missing:
        raise MapError(
            f"{path}: not 3DGS splats: the properties {', '.join(missing)} are missing; use an "
            "export for Gaussian splats, with standard names"
        )
    row = np.dtype([(name, f"<{kind}") for name, kind in element.properties])
    _check_length(path, len(data) - header.size, element.count, row.itemsize, exact=False)
    rows = np.frombuffer(data, row, element.count, header.size)

    def columns(*fields: str) -> Floats:
        return np.column_stack([rows[name].astype(np.float64) for name in fields])

    findings: list[Finding] = []
    scales = columns("scale_0", "scale_1", "scale_2")
    log_scale = bool(np.nanmin(scales, initial=np.inf) < 0.0)
    opacity = rows["opacity"].astype(np.float64)
    known = opacity[np.isfinite(opacity)]
    linear_opacity = bool(len(known) and known.min() >= 0.0 and known.max() <= 1.0)
    findings.append(
        note(
            f"{path.name}: {'log' if log_scale else 'linear'} scales and "
            f"{'linear' if linear_opacity else 'logit'} opacities, by their ranges"
        )
    )
    if rest := sum(name.startswith("f_rest_") for name in names):
        degree = round(math.sqrt(rest / 3 + 1)) - 1
        findings.append(note(f"{path.name}: spherical harmonics of degree {degree} cut to 0"))
    colour = 0.5 + SH_C0 * columns("f_dc_0", "f_dc_1", "f_dc_2")
    rotation = ("rot_0", "rot_1", "rot_2", "rot_3")
    with np.errstate(over="ignore", invalid="ignore"):
        return _whole(
            path,
            columns("x", "y", "z"),
            np.exp(scales) if log_scale else scales,
            columns(*(rotation if order == "wxyz" else (rotation[3], *rotation[:3]))),
            np.column_stack([colour, opacity if linear_opacity else 1 / (1 + np.exp(-opacity))]),
            findings,
        )


def _read_splat(path: Path, data: bytes) -> RawSplats:
    count = len(data) // _SPLAT_ROW.itemsize
    if len(data) % _SPLAT_ROW.itemsize:
        raise MapError(
            f"{path}: {len(data)} bytes are no multiple of {_SPLAT_ROW.itemsize}, the size of a "
            "splat: the file is cut off or is not .splat; download it again"
        )
    _check_length(path, len(data), count, _SPLAT_ROW.itemsize)
    rows = np.frombuffer(data, _SPLAT_ROW, count)
    rotations = (rows["rotation"].astype(np.float64) - 128.0) / 128.0
    return _whole(
        path,
        rows["centre"].astype(np.float64),
        rows["scale"].astype(np.float64),
        rotations,
        rows["rgba"].astype(np.float64) / 255.0,
        [],
    )


def _read_spz(path: Path, data: bytes) -> RawSplats:
    if data[:4] == struct.pack("<I", _SPZ_MAGIC) and data[4:8] == struct.pack("<I", 4):
        raise MapError(
            f"{path}: .spz version 4, packed with zstd, which Python 3.11 cannot unpack: convert "
            "it to .spz version 3 or to .ply, with SuperSplat or Niantic's spz tools"
        )
    if data[:2] == b"\x1f\x8b":
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError, zlib.error) as error:
            raise MapError(
                f"{path}: its packed content is cut off or damaged ({error}): download it again"
            ) from error
    if len(data) < 16 or struct.unpack_from("<I", data)[0] != _SPZ_MAGIC:
        raise MapError(
            f"{path}: not an .spz file: it starts with {data[:4]!r} in place of b'NGSP'; export "
            "the scan again"
        )
    _, version, count, degree, bits, _, _ = struct.unpack_from("<IIIBBBB", data)
    if version not in (1, 2, 3):
        raise MapError(
            f"{path}: .spz version {version}; the versions 1, 2 and 3 are read: convert it to "
            "version 3 or to .ply"
        )
    sizes = (6 if version == 1 else 9, 1, 3, 3, 4 if version == 3 else 3)
    rest = 3 * ((degree + 1) ** 2 - 1)
    _check_length(path, len(data) - 16, count, sum(sizes) + rest, exact=False)
    raw = np.frombuffer(data, np.uint8, offset=16)
    ends = np.cumsum([0, *(size * count for size in sizes)])
    centres, alphas, colours, scales, rotations = (
        raw[start:end].reshape(count, -1) for start, end in pairwise(ends)
    )
    dc = (colours / 255.0 - 0.5) / _SPZ_COLOUR
    findings = [note(f"{path.name}: .spz version {version}")]
    if degree:
        findings.append(note(f"{path.name}: spherical harmonics of degree {degree} cut to 0"))
    return _whole(
        path,
        _spz_centres(centres, version, bits),
        np.exp(scales / 16.0 - 10.0),
        _smallest_three(rotations) if version == 3 else _first_three(rotations),
        np.column_stack([0.5 + SH_C0 * dc, alphas / 255.0]),
        findings,
    )


def _spz_centres(stored: NDArray[np.uint8], version: int, bits: int) -> Floats:
    """Return (N, 3) places: half floats in version 1, fixed point of 24 bits after it."""
    if version == 1:
        return np.ascontiguousarray(stored).view("<f2").astype(np.float64)
    low, middle, high = (stored.reshape(-1, 3, 3)[:, :, k].astype(np.int64) for k in range(3))
    fixed = low | middle << 8 | high << 16
    return (fixed - ((fixed & 0x800000) << 1)) / float(1 << bits)


def _first_three(stored: NDArray[np.uint8]) -> Floats:
    """Return quaternions of which x, y and z are bytes."""
    x, y, z = (stored[:, k] / 127.5 - 1.0 for k in range(3))
    return np.column_stack([np.sqrt(np.maximum(0.0, 1.0 - x * x - y * y - z * z)), x, y, z])


def _smallest_three(stored: NDArray[np.uint8]) -> Floats:
    """Return quaternions without their largest component: sign and 9 bits for each other one."""
    packed = np.ascontiguousarray(stored).view("<u4").ravel().astype(np.int64)
    largest = packed >> 30
    found = np.zeros((len(packed), 4))
    squares = np.zeros(len(packed))
    for k in (3, 2, 1, 0):  # x, y, z, w
        here = largest != k
        size = math.sqrt(0.5) * (packed & 511) / 511.0
        value = np.where(packed >> 9 & 1, -size, size)
        found[here, k] = value[here]
        squares += np.where(here, value * value, 0.0)
        packed = np.where(here, packed >> 10, packed)
    found[np.arange(len(packed)), largest] = np.sqrt(np.maximum(0.0, 1.0 - squares))
    return found[:, [3, 0, 1, 2]]


def _check_length(path: Path, size: int, count: int, row: int, *, exact: bool = True) -> None:
    """Check the number of splats and the size of their rows in bytes. Raises MapError."""
    if count == 0:
        raise MapError(f"{path}: holds 0 splats: export the scan again")
    if count > MAX_SPLATS:
        raise MapError(
            f"{path}: holds {count} splats; at most {MAX_SPLATS} are read: reduce it, for "
            "example in SuperSplat"
        )
    if size < count * row or (exact and size != count * row):
        raise MapError(
            f"{path}: is cut off: its header promises {count} splats of {row} bytes, and "
            f"{size} bytes follow, enough for {size // row}; download it again"
        )


def _whole(
    path: Path,
    centres: Floats,
    scales: Floats,
    quaternions: Floats,
    rgba: NDArray[Any],
    findings: list[Finding],
) -> RawSplats:
    """Return splats without those that have invalid numbers. Raises MapError if they are many.

    rgba: (N, 4), 0 to 1.
    """
    w, x, y, z = quaternions.T
    length = np.sqrt(w * w + x * x + y * y + z * z)
    valid = np.isfinite(length) & (length > 1e-6)
    for array in (centres, scales, rgba):
        valid &= np.isfinite(array).all(axis=1)
    valid &= (scales >= 0.0).all(axis=1)
    if dropped := int(len(valid) - np.count_nonzero(valid)):
        words = f"{path.name}: {dropped} of {len(valid)} splats with NaN, infinite or zero numbers"
        if dropped > MAX_DROPPED_SHARE * len(valid):
            raise MapError(
                f"{path}: {dropped} of {len(valid)} splats ({dropped / len(valid):.1%}) have NaN, "
                f"infinite or zero numbers; at most {MAX_DROPPED_SHARE:.0%} are dropped: the "
                "training has failed, train or export again"
            )
        findings.append(warning(f"{words} dropped: export the scan again if they matter"))
    colours = np.clip(np.rint(rgba[valid] * 255.0), 0.0, 255.0).astype(np.uint8)
    return RawSplats(
        centres[valid],
        scales[valid],
        quaternions[valid] / length[valid, None],
        colours,
        tuple(findings),
    )

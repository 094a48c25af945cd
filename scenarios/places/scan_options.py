"""Options of the import of a scan: `scan.json` in its folder, and options of the same names."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec

from cosim.core.errors import MapError, UsageError
from cosim.place.scan import ScanSun
from cosim.spec.spec_file import read_spec_file
from cosim.spec.validation import Ranged, Within
from physics.scans.frame import Matrix, Placing
from physics.scans.read_mesh import Colours
from physics.scans.read_splats import QuaternionOrder

OPTIONS_FILE: Final = "scan.json"
"""Name of the file in a scan's folder."""
_MATRIX_KEYS: Final = ("transform", "matrix")
"""Keys of a transform file; others that start with them count if there is only one."""

Up = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Axis = Literal["x", "y", "z"]


class ScanOptions(Ranged, frozen=True, kw_only=True):
    """Options of an import. Options that begin with `splat_` default to those of the mesh.

    scale: metres per unit of the files.
    up: axis of the files that points up.
    transform: 4 x 4 matrix by rows from the files to metres with z up, or the file that has it.
        It replaces scale and up.
    mirror: axis to negate, for files with a left-handed frame.
    flip: reverse the winding of triangles.
    colours: encoding of vertex colours; by default sRGB, in .glb as its program writes them.
    quaternions: order of the rotations in a .ply file of splats.
    most_splats: reduce the splats to this number, the least visible first.
    georeference: place of the origin of the files on earth.
    exposure_ev: stops by which people and objects are drawn brighter.
    files: names in the folder; by default all meshes and splats in it.
    areas, osm, way: file that determines the walkable area; by default a draft from the ground.
    width_m: of the corridor along a way.
    """

    name: str = ""
    scale: Annotated[float | None, Within(0, 1e6, above=True)] = None
    up: Up | None = None
    transform: Matrix | str | None = None
    mirror: Axis | None = None
    flip: bool = False
    colours: Colours | None = None
    splat_scale: Annotated[float | None, Within(0, 1e6, above=True)] = None
    splat_up: Up | None = None
    splat_transform: Matrix | str | None = None
    splat_mirror: Axis | None = None
    quaternions: QuaternionOrder = "wxyz"
    most_splats: Annotated[int | None, Within(1, 20_000_000)] = None
    georeference: Placing | None = None
    sun: ScanSun | None = None
    exposure_ev: Annotated[float, Within(-8, 8)] = 0.0
    licence: str = ""
    files: tuple[str, ...] = ()
    areas: str = ""
    osm: str = ""
    way: str = ""
    width_m: Annotated[float, Within(1, 20)] = 3.0

    @property
    def prefix(self) -> str:
        return ""

    def contradictions(self) -> Iterator[str]:
        for prefix in ("", "splat_"):
            if getattr(self, f"{prefix}transform") is not None and (
                getattr(self, f"{prefix}scale") is not None
                or getattr(self, f"{prefix}up") is not None
                or getattr(self, f"{prefix}mirror") is not None
            ):
                yield (
                    f"{prefix}transform replaces {prefix}scale, {prefix}up and {prefix}mirror: "
                    "leave them out"
                )
        given = [name for name in ("areas", "osm", "way") if getattr(self, name)]
        if len(given) > 1:
            yield f"{' and '.join(given)} both determine the walkable area: give one of them"


def read_options(folder: Path, given: Mapping[str, Any], preset: Path | None = None) -> ScanOptions:
    """Return the options of `scan.json` in a folder, if it exists, replaced by given ones.

    given: options by name; None and empty ones are left out.
    preset: other folder whose `scan.json` is read instead.
    Paths of the file are relative to its folder.
    Raises SpecError for wrong options, UsageError for a folder that does not exist.
    """
    if not folder.is_dir():
        raise UsageError(
            f"{folder}: must be a folder with the mesh (.glb, .ply, .obj) and, if there are any, "
            "the splats (.ply, .spz, .splat) of a scan"
        )
    path = (preset or folder) / OPTIONS_FILE
    options = read_spec_file(path, ScanOptions) if path.exists() else ScanOptions()
    placed = {
        field: str(path.parent / value)
        for field in ("transform", "splat_transform", "areas", "osm", "way")
        if isinstance(value := getattr(options, field), str) and value
    }
    fields = {name: getattr(options, name) for name in ScanOptions.__struct_fields__}
    chosen = {name: value for name, value in given.items() if value is not None and value != ""}
    for prefix in ("", "splat_"):  # a given frame replaces the file's whole
        frame = {f"{prefix}{name}" for name in ("scale", "up", "mirror")}
        if f"{prefix}transform" in chosen:
            fields |= dict.fromkeys(frame)
        elif frame & chosen.keys():
            fields[f"{prefix}transform"] = None
            placed.pop(f"{prefix}transform", None)
    if any(name in chosen for name in ("areas", "osm", "way")):
        for name in ("areas", "osm", "way"):
            fields[name] = ""
            placed.pop(name, None)
    return ScanOptions(**(fields | placed | chosen))


def read_transform(transform: Matrix | str | None) -> Matrix | None:
    """Return a transform, from its file if it is a path. Raises MapError."""
    if transform is None or not isinstance(transform, str):
        return transform
    path = Path(transform)
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise MapError(f"{path}: cannot be read: {error}") from error
    try:
        held = json.loads(text)
    except ValueError:
        held = text.split()
    if isinstance(held, dict):
        held = _matrix_in(path, held)
    if isinstance(held, list) and len(held) == 16:
        held = [held[i : i + 4] for i in range(0, 16, 4)]
    try:
        return msgspec.convert(held, Matrix, strict=False)
    except msgspec.ValidationError as error:
        raise MapError(
            f"{path}: holds no 4 x 4 matrix: give 4 rows of 4 numbers, as JSON or text"
        ) from error


def _matrix_in(path: Path, held: Mapping[str, Any]) -> Any:
    """Return the matrix of a JSON object. Raises MapError if it is not clear which it is."""
    keys = [key for key in _MATRIX_KEYS if key in held] or [
        key for key in held if key.startswith(_MATRIX_KEYS)
    ]
    if len(keys) != 1:
        raise MapError(f"{path}: holds {len(keys)} matrices: name one of them 'transform'")
    return held[keys[0]]


def parse_georeference(words: str) -> Placing:
    """Return the place of "LATITUDE,LONGITUDE[,HEADING]", "CRS" or "CRS,EAST,NORTH".

    Raises UsageError.
    """
    parts = [part.strip() for part in words.split(",")]
    try:
        if len(parts) == 2 or (len(parts) == 3 and _is_number(parts[0])):
            latitude, longitude, *heading = map(float, parts)
            if -90.0 <= latitude <= 90.0 and -180.0 <= longitude <= 180.0:
                return Placing(
                    latitude_deg=latitude,
                    longitude_deg=longitude,
                    heading_deg=heading[0] if heading else None,
                )
        elif len(parts) == 3:
            return Placing(crs=parts[0], offset=(float(parts[1]), float(parts[2])))
        elif parts[0]:
            return Placing(crs=parts[0])
    except ValueError:
        pass
    raise UsageError(
        f"--georeference {words}: give LATITUDE,LONGITUDE of the origin in degrees, such as "
        "55.698,13.195, with the compass heading of +y if that is not north: 55.698,13.195,33; "
        "or a coordinate system, such as EPSG:25833, with an offset or without: "
        "EPSG:25833,391000,5820000"
    )


def _is_number(words: str) -> bool:
    try:
        float(words)
    except ValueError:
        return False
    return True


def parse_sun(words: str) -> ScanSun:
    """Return the sun of "AZIMUTH,ELEVATION" in degrees. Raises UsageError."""
    try:
        azimuth, elevation = (float(part) for part in words.split(","))
        if not (0.0 <= azimuth <= 360.0 and 0.0 < elevation <= 90.0):
            raise ValueError
    except ValueError:
        raise UsageError(
            f"--sun {words}: give AZIMUTH,ELEVATION in degrees, clockwise from north and above "
            "the horizon, such as 215,38"
        ) from None
    return ScanSun(azimuth_deg=azimuth, elevation_deg=elevation)

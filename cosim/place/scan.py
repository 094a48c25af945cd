"""Scan: a scanned place, and its files in a map's folder.

A map with a scan has a folder `scan` beside its net. The net determines what is walkable, the mesh
heights and contacts. Splats affect only pictures.

All coordinates are metres in the net's frame: x east, y north, z up.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.errors import MapError
from cosim.core.geometry import Floats

SCAN_FOLDER: Final = "scan"
"""Folder of a scan in the folder of its map."""
_FACTS: Final = "facts.json"
_AREAS: Final = "areas.geojson"
_FLOATERS: Final = "floaters"

AreaKind = Literal["sidewalk", "crossing", "road", "verge", "obstacle"]
"""Kinds of drawn areas. People and robots use sidewalks and crossings."""
AREA_KINDS: Final[tuple[AreaKind, ...]] = get_args(AreaKind)
"""All kinds of drawn areas."""


@dataclass(frozen=True, slots=True)
class ScanMesh:
    """Triangle mesh of a scan.

    vertices: (V, 3) float32 metres.
    triangles: (T, 3) int32 vertex indices, counter-clockwise from the front.
    colours: (V, 3) uint8 sRGB.
    labels: (T,) uint8 ids of `cosim.core.state.LABELS`.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    colours: NDArray[np.uint8]
    labels: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Splats:
    """Gaussian splats, ordered by Morton code and then by bytes.

    centres: (N, 3) float32 metres.
    covariances: (N, 6) float32 square metres: xx, xy, xz, yy, yz, zz.
    rgba: (N, 4) uint8 sRGB colour and opacity.
    ground: (N,) bool, whether a splat belongs to the ground and never covers people.
    """

    centres: NDArray[np.float32]
    covariances: NDArray[np.float32]
    rgba: NDArray[np.uint8]
    ground: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.centres)


@dataclass(frozen=True, slots=True)
class HeightGrid:
    """Ground heights on a lattice, and what is known about its points.

    origin: (2,) x, y of the point [0, 0], m; rows are along y, columns along x.
    step_m: distance of neighbouring points.
    heights: (H, W) float32 metres; closed holes are interpolated.
    measured: (H, W) bool, whether the scan has ground there.
    blocked: (H, W) bool, whether the scan has an obstacle there, 0.2 to 1.8 m above the ground.
    """

    origin: Floats
    step_m: float
    heights: NDArray[np.float32]
    measured: NDArray[np.bool_]
    blocked: NDArray[np.bool_]


class Georeference(msgspec.Struct, frozen=True, kw_only=True):
    """Position of the origin of the net's frame in WGS84; x is east there."""

    latitude_deg: float
    longitude_deg: float


class ScanSun(msgspec.Struct, frozen=True, kw_only=True):
    """Direction to the sun when the scan was taken.

    azimuth_deg: clockwise from north.
    """

    azimuth_deg: float
    elevation_deg: float


class RecordedMap(msgspec.Struct, frozen=True):
    """Hashes of a generated scan as it was recorded.

    Processors round differently, and a few of a million triangles of its mesh depend on the last
    bit. So a map with the recorded ground has the recorded hash.

    map_hash: to which frozen suites refer.
    ground_hash: of net, drawn ground, areas and heights, which are equal on every processor.
    """

    map_hash: str
    ground_hash: str


class ScanFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Origin and properties of a scan.

    files: SHA-256 of each source file by its name.
    scale: metres per unit of the source mesh.
    up: axis of the source mesh that points up, such as "+y".
    transform: 4 x 4 matrix, by rows, from the source mesh to the net's frame.
    splat_transform: the same from the source splats; None without splats.
    exposure_ev: stops by which people and objects are drawn brighter, to match the scan.
    findings: results of the checks, a sentence each.
    versions: of the importer and of libraries that affect the result.
    mesh_hash, splats_hash, heights_hash, areas_hash: content hashes; splats_hash is "" without
        splats.
    recorded: hashes of a generated scan of a suite.
    """

    name: str
    files: dict[str, str]
    scale: float
    up: str
    transform: tuple[tuple[float, ...], ...]
    splat_transform: tuple[tuple[float, ...], ...] | None = None
    georeference: Georeference | None = None
    sun: ScanSun | None = None
    exposure_ev: float = 0.0
    licence: str = ""
    findings: tuple[str, ...] = ()
    versions: dict[str, str] = {}
    mesh_hash: str = ""
    splats_hash: str = ""
    heights_hash: str = ""
    areas_hash: str = ""
    recorded: RecordedMap | None = None


class ScanArea(msgspec.Struct, frozen=True):
    """A drawn area.

    polygon: in the net's frame, m.
    """

    kind: AreaKind
    polygon: shapely.Polygon


@dataclass(frozen=True, slots=True)
class Scan:
    """A scanned place.

    floaters: (K, 3) float32 centres of splats that the import removed, for pictures of it.
    """

    facts: ScanFacts
    mesh: ScanMesh
    heights: HeightGrid
    areas: tuple[ScanArea, ...]
    splats: Splats | None = None
    floaters: NDArray[np.float32] | None = None


def has_scan(map_folder: Path) -> bool:
    """Return whether the map in a folder has a scan."""
    return (map_folder / SCAN_FOLDER / _FACTS).is_file()


def read_facts(map_folder: Path) -> ScanFacts:
    """Read the facts of a map's scan. Raises MapError if they are missing or damaged."""
    path = map_folder / SCAN_FOLDER / _FACTS
    try:
        return msgspec.json.decode(path.read_bytes(), type=ScanFacts)
    except (OSError, msgspec.DecodeError, msgspec.ValidationError) as error:
        raise MapError(f"{path}: cannot be read: {error}: import the scan again") from error


def read_scan(map_folder: Path, *, splats: bool = True) -> Scan:
    """Read the scan of a map; its arrays are mapped into memory.

    splats: whether to read the splats, if there are any.
    Raises MapError if a file is missing or damaged.
    """
    folder = map_folder / SCAN_FOLDER
    facts = read_facts(map_folder)
    try:
        grid = msgspec.json.decode((folder / "heights.json").read_bytes())
        mesh = ScanMesh(*(_array(folder, f"mesh-{name}") for name in ScanMesh.__slots__))
        heights = HeightGrid(
            np.array(grid["origin"]),
            grid["step_m"],
            *(_array(folder, f"grid-{name}") for name in HeightGrid.__slots__[2:]),
        )
        held = None
        if splats and facts.splats_hash:
            held = Splats(*(_array(folder, f"splats-{name}") for name in Splats.__slots__))
        areas = parse_areas((folder / _AREAS).read_bytes())
        floaters = _array(folder, _FLOATERS) if held is not None else None
    except (OSError, KeyError, ValueError) as error:
        raise MapError(f"{folder}: cannot be read: {error}: import the scan again") from error
    return Scan(facts, mesh, heights, areas, held, floaters)


def write_scan(scan: Scan, map_folder: Path) -> ScanFacts:
    """Write a scan into the folder of its map. Returns its facts with content hashes.

    Raises OSError.
    """
    folder = map_folder / SCAN_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    grid = scan.heights
    words = msgspec.json.encode({"origin": grid.origin.tolist(), "step_m": grid.step_m})
    (folder / "heights.json").write_bytes(words)
    _save(folder, "mesh", scan.mesh, ScanMesh.__slots__)
    _save(folder, "grid", grid, HeightGrid.__slots__[2:])
    if scan.splats is not None:
        _save(folder, "splats", scan.splats, Splats.__slots__)
        floaters = np.empty((0, 3), np.float32) if scan.floaters is None else scan.floaters
        np.save(folder / f"{_FLOATERS}.npy", floaters, allow_pickle=False)
    areas = encode_areas(scan.areas, framed=False)  # the hashes of maps cover these bytes
    (folder / _AREAS).write_bytes(areas)
    facts = msgspec.structs.replace(
        scan.facts,
        mesh_hash=_hash_of(scan.mesh, ScanMesh.__slots__),
        splats_hash="" if scan.splats is None else _hash_of(scan.splats, Splats.__slots__),
        heights_hash=hashlib.sha256(
            words + _hash_of(grid, HeightGrid.__slots__[2:]).encode()
        ).hexdigest()[:16],
        areas_hash=hashlib.sha256(areas).hexdigest()[:16],
    )
    (folder / _FACTS).write_bytes(msgspec.json.format(msgspec.json.encode(facts), indent=2))
    return facts


def parse_areas(data: bytes) -> tuple[ScanArea, ...]:
    """Read areas from GeoJSON in the net's frame. Raises ValueError with the feature at fault."""
    found = msgspec.json.decode(data)
    areas = []
    for number, feature in enumerate(found["features"]):
        kind = feature["properties"].get("kind")
        if kind not in AREA_KINDS:
            raise ValueError(f"feature {number}: kind must be one of {', '.join(AREA_KINDS)}")
        shape = shapely.geometry.shape(feature["geometry"])
        parts = shape.geoms if isinstance(shape, shapely.MultiPolygon) else (shape,)
        for part in parts:
            if not isinstance(part, shapely.Polygon) or not part.is_valid:
                raise ValueError(f"feature {number}: geometry must be a valid (Multi)Polygon")
            areas.append(ScanArea(kind, part))
    return tuple(areas)


def encode_areas(areas: Iterable[ScanArea], *, framed: bool = True, step_m: float = 0.0) -> bytes:
    """Return areas as GeoJSON in the net's frame.

    framed: whether the member "frame" says so, as files that are read for an import need.
    step_m: grid to which coordinates are rounded, in metres; 0 for none.
    """
    features = [
        {
            "type": "Feature",
            "properties": {"kind": area.kind},
            "geometry": shapely.geometry.mapping(
                shapely.set_precision(area.polygon, step_m) if step_m else area.polygon
            ),
        }
        for area in areas
    ]
    frame = {"frame": "local"} if framed else {}
    return msgspec.json.encode({"type": "FeatureCollection", **frame, "features": features})


def _array(folder: Path, name: str) -> NDArray[Any]:
    return np.asarray(np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False))


def _save(folder: Path, prefix: str, held: object, names: Iterable[str]) -> None:
    for name in names:
        np.save(folder / f"{prefix}-{name}.npy", getattr(held, name), allow_pickle=False)


def _hash_of(held: object, names: Iterable[str]) -> str:
    digest = hashlib.sha256()
    for name in names:
        digest.update(np.ascontiguousarray(getattr(held, name)).data)
    return digest.hexdigest()[:16]

"""Places of the suite `scans`: generated ones, made on first use, and real ones from users."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

from cosim.core.errors import MapError, UsageError, unknown
from cosim.core.files import folder_holds, lock, temp_folder
from cosim.core.progress import Progress
from cosim.place.scan import RecordedMap
from cosim.spec.scenario import City, CityMap, Place
from sumo_nets.maps.map_store import map_net, maps_folder

PLACES_FOLDER: Final = Path(__file__).parents[1] / "suites" / "scans"
"""Folder of the import options and areas of the real places, by place name."""


@dataclass(frozen=True, kw_only=True)
class GeneratedScan:
    """Part of a generated city that is made into a scan on first use.

    box: x0, y0, x1, y1 in metres of the city's frame.
    recorded: hashes of the map.
    spacing_m: distance between splats on the ground.
    """

    recorded: RecordedMap
    city: City
    box: tuple[float, float, float, float]
    spacing_m: float = 0.2


@dataclass(frozen=True, kw_only=True)
class RealScan:
    """Scan of a real street. Its files are not shipped: users supply them.

    files: meshes that the import reads.
    source: address of the original data and how the meshes are made from it.
    """

    files: tuple[str, ...]
    source: str
    size: str
    licence: str

    def remedy(self, name: str) -> str:
        """Return how to get and import the data."""
        return (
            f"put {' and '.join(self.files)} into a folder ({self.source}; {self.size}; "
            f"{self.licence}), then `cosim scan import FOLDER --preset {name}` (docs/scans.md)"
        )


SCAN_PLACES: Final[Mapping[str, GeneratedScan | RealScan]] = MappingProxyType(
    {
        "lund-street": RealScan(
            files=("lund_street_ground.glb", "lund_street_obstacles.glb"),
            source="reconstructed from the photos of github.com/mapillary/OpenSfM, data/lund, "
            "commit 238744cd",
            size="2.8 MB",
            licence="BSD-2-Clause",
        ),
        "autzen-boulevard": RealScan(
            files=("ground.glb", "obstacles.glb"),
            source="made from the lidar points of github.com/PDAL/data, entwine/data/binary, "
            "commit ce002425",
            size="5.7 MB",
            licence="CC BY 4.0",
        ),
        "scan-5": GeneratedScan(
            city=City(seed=5, size_m=500.0),
            box=(26.0, 9.0, 186.0, 129.0),
            recorded=RecordedMap("572dfb425576ef46", "e8c74e0ce950fb23"),
        ),
        "scan-12": GeneratedScan(
            city=City(seed=12, size_m=500.0),
            box=(10.0, 91.0, 170.0, 211.0),
            recorded=RecordedMap("129e5659f81be89b", "c36a14aa63993631"),
        ),
        "scan-40": GeneratedScan(
            city=City(seed=40, size_m=500.0),
            box=(10.0, 219.0, 130.0, 379.0),
            recorded=RecordedMap("3aedb047ea722efb", "195d9bab2b696603"),
        ),
    }
)
"""Places of the suite by map name."""


def preset_folder(name: str) -> Path:
    """Return the folder with the import options of a real place. Raises UsageError."""
    real = [called for called, one in SCAN_PLACES.items() if isinstance(one, RealScan)]
    if name not in real:
        raise unknown("preset", name, real)
    return PLACES_FOLDER / name


def lacking_scans(places: Iterable[Place]) -> dict[str, str]:
    """Return the real scans among places that are not imported, with how to get each, by name."""
    names = dict.fromkeys(one.map for one in places if isinstance(one, CityMap))
    return {
        name: found.remedy(name)
        for name in names
        if isinstance(found := SCAN_PLACES.get(name), RealScan) and not _is_stored(name)
    }


def provide_scan(where: CityMap) -> None:
    """Make a generated scan that is missing, and check that the map is the one of the scenario.

    Raises UsageError for a missing real scan, MapError for another map of that name. Both say how
    to get it. Other maps are left alone.
    """
    found = SCAN_PLACES.get(where.map)
    if found is None:
        return
    if not _is_stored(where.map):
        if isinstance(found, RealScan):
            raise UsageError(f"map '{where.map}' is not imported: {found.remedy(where.map)}")
        _make(where.map, found)
    try:
        map_net(where)
    except MapError as error:
        remedy = (
            found.remedy(where.map)
            if isinstance(found, RealScan)
            else f"delete {maps_folder() / where.map}, and it is made again"
        )
        raise MapError(f"{error}; for the suite `scans`: {remedy}") from error


def _is_stored(name: str) -> bool:
    return folder_holds(maps_folder() / name, "net.xml")


def _make(name: str, recipe: GeneratedScan) -> None:
    """Make and import a generated scan, once among processes."""
    # Imported only where needed: the importer of scans takes a second to load.
    from scenarios.places.scan_import import import_scan
    from scenarios.places.scan_make import make_scan
    from scenarios.places.scan_options import read_options

    maps_folder().mkdir(parents=True, exist_ok=True)
    with lock(maps_folder() / f".{name}.lock"):
        if _is_stored(name):
            return
        progress = _printing(name)
        with temp_folder(".source-", maps_folder()) as folder:
            source = folder / name
            make_scan(
                recipe.city, recipe.box, source, spacing_m=recipe.spacing_m, progress=progress
            )
            options = read_options(source, {"name": name})
            import_scan(source, options, progress, recipe.recorded)


def _printing(name: str) -> Progress:
    """Return a callback that prints the stages of making a scan on stderr."""
    print(f"making the scan '{name}', once (about a minute)", file=sys.stderr, flush=True)

    def show(stage: str, share: float | None = None, /) -> None:
        print(f"{name}: {stage} ...", file=sys.stderr, flush=True)

    return show

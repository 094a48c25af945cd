"""Loading of the nets, street maps and surfaces of places."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from cosim.core.cache import cache_folder
from cosim.core.errors import MachineError, MapError, SpecError, UsageError
from cosim.place.scan import Scan, has_scan, read_scan
from cosim.place.street_map import StreetMap
from cosim.spec.scenario import City, CityMap, Place
from physics.street.scan_surface import ScanSurface
from physics.street.street_surface import StreetSurface
from physics.street.surface import PlaceSurface
from sumo_nets.city.store import city_net
from sumo_nets.net.snapshot import street_map_of


@lru_cache(maxsize=1)
def place(where: Place) -> tuple[Path, StreetMap]:
    """Return the net file of a place and its street map; the last one is cached."""
    if isinstance(where, City):
        path = city_net(where)
        return path, street_map_of(path)
    # Imported only where needed: it loads the importer of maps, which takes a second.
    from sumo_nets.maps.map_store import map_net, read_map

    return map_net(where), read_map(where)


def check_place(where: Place, net_hash: str) -> None:
    """Check that the net of a place is the run's. Raises MachineError if it differs or cannot be
    built or loaded."""
    try:
        found = place(where)[1].net_hash
    except (MapError, UsageError, SpecError) as error:
        raise MachineError(
            f"the place of an episode of the run cannot be had here: {error}"
        ) from error
    if found != net_hash:
        raise MachineError(
            f"{where.name} is another one here: its net's hash is {found}, for the run it is "
            f"{net_hash}: set COSIM_CACHE to a new folder"
        )


@lru_cache(maxsize=1)
def surface_of_place(where: Place) -> PlaceSurface:
    """Return the surface of a place with its tiles; the last one is cached."""
    return make_surface(where, place(where)[1])


def make_surface(where: Place, street_map: StreetMap) -> PlaceSurface:
    """Return a new surface of a place: of its scan if it has one, otherwise of its street map."""
    scan = scan_of(where)
    if scan is not None:
        return ScanSurface(street_map, scan, where.seed)
    return StreetSurface(street_map, where.seed, where.roughness)


def scan_of(where: Place) -> Scan | None:
    """Return the scan of a place, None if it has none."""
    folder = cache_folder() / "maps" / where.map if isinstance(where, CityMap) else None
    if folder is None or not has_scan(folder):
        return None
    return read_scan(folder)

"""Loading of the nets, street maps and surfaces of places."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from cosim.core.errors import MachineError, MapError, SpecError, UsageError
from cosim.place.street_map import StreetMap
from cosim.spec.scenario import City, Place
from physics.street.street_surface import StreetSurface
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
def surface_of_place(where: Place) -> StreetSurface:
    """Return the surface of a place with its tiles; the last one is cached."""
    return StreetSurface(place(where)[1], where.seed, where.roughness)

"""The places of scenarios: their nets, and what was read from them."""

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
    """The net of a place and what was read from it; the last one is kept."""
    if isinstance(where, City):
        path = city_net(where)
        return path, street_map_of(path)
    from sumo_nets.maps.map_store import map_net, read_map  # with the importer of maps

    return map_net(where), read_map(where)


def check_place(where: Place, net_hash: str) -> None:
    """Raises MachineError when a place cannot be had on this machine, or its net is another one
    than the run's."""
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
    """The surface of a place, with the tiles that were built of it; the last one is kept."""
    return StreetSurface(place(where)[1], where.seed, where.roughness)

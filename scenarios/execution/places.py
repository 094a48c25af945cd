"""The places of scenarios: their nets, and what was read from them."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from cosim.place.street_map import StreetMap
from cosim.spec.scenario import City, Place
from physics.world.street_surface import StreetSurface
from sumo_nets.city.store import city_net
from sumo_nets.net.snapshot import street_map_of


@lru_cache(maxsize=1)
def place(where: Place) -> tuple[Path, StreetMap]:
    """The net of a place and what was read from it; the last one is kept."""
    if isinstance(where, City):
        path = city_net(where)
        return path, street_map_of(path)
    from sumo_nets.maps.mapstore import map_net, read_map  # with the importer of maps

    return map_net(where), read_map(where)


@lru_cache(maxsize=1)
def surface_of_place(where: Place) -> StreetSurface:
    """The surface of a place, with the tiles that were built of it; the last one is kept."""
    return StreetSurface(place(where)[1], where.seed, where.roughness)

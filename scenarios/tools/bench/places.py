"""How fast places are made, read and asked."""

from __future__ import annotations

import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Final

from cosim.spec.scenario import City
from scenarios.tools.bench.figures import Figure

_ASKED: Final = 500
"""Questions about a place whose mean time is taken."""


def places() -> list[Figure]:
    """Make a 2 km city from its seed, read it again, ask it: a point against the walkable area, a
    shortest walk."""
    import numpy as np

    from cosim.place.street_map import WalkableArea
    from cosim.place.walk_graph import WalkGraph
    from sumo_nets.city.store import build_city, city_net
    from sumo_nets.net.net_file import read_net
    from sumo_nets.net.snapshot import street_map_of

    city = City(seed=5, size_m=2000.0)
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        path = Path(folder) / "city.net.xml"
        build_city(city, path)
        read_net(path)
        made_s = time.perf_counter() - began
    street_map_of(city_net(city))
    began = time.perf_counter()
    street_map = street_map_of(city_net(city))
    read_s = time.perf_counter() - began
    graph = WalkGraph(street_map)
    area = WalkableArea(street_map.walkable)
    rng = np.random.default_rng(1)
    ends = rng.integers(len(graph.ports), size=(_ASKED, 2)).tolist()
    points = graph.xy[rng.integers(len(graph.xy), size=_ASKED)] + rng.normal(0.0, 2.0, (_ASKED, 2))
    graph.shortest(graph.ports[0], graph.ports[-1])
    # The first questions build GEOS's indices; a referee asks on and on about one neighbourhood.
    for x, y in points.tolist():
        area.contains(x, y)
    stamps = [time.perf_counter()]
    for x, y in points.tolist():
        area.contains(x, y)
    stamps.append(time.perf_counter())
    area.signed_distance(points)
    stamps.append(time.perf_counter())
    for a, b in ends:
        graph.shortest(graph.ports[a], graph.ports[b])
    stamps.append(time.perf_counter())
    contains_s, distance_s, walk_s = ((b - a) / _ASKED for a, b in pairwise(stamps))
    return [
        Figure("city from its seed to a street map, s", made_s, reach=4.0),
        Figure("cached city to a street map, s", read_s, reach=0.5),
        Figure("point in the walkable area, us", 1e6 * contains_s, reach=5.0),
        Figure("distance to its edge, us", 1e6 * distance_s, reach=20.0),
        Figure("shortest walk, ms", 1e3 * walk_s, reach=2.0),
    ]

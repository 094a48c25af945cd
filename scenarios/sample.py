"""Suites drawn on the spot: routes on any known map, from a seed."""

from __future__ import annotations

from cosim.errors import unknown
from cosim.scenario import CityMap, Suite
from cosim.walks import WalkGraph
from scenarios.assemble import place
from scenarios.long_horizon import build


def suite_on_map(kind: str, name: str, seed: int, count: int, roughness: float = 0.0) -> Suite:
    """`count` long-horizon scenarios on a map; the same arguments and net give the same suite.

    roughness: of the ground, from 0 (flat) to 1.

    Raises UsageError for another kind of suite, and whatever the map or the builder has to refuse.
    """
    if kind != "long-horizon":
        raise unknown("suite for --map", kind, ["long-horizon"])
    where = CityMap(map=name, roughness=roughness)
    _, street_map = place(where)
    graph = WalkGraph(street_map)
    scenarios = tuple(build(where, street_map, graph, seed + i, f"{name}-{seed + i:03d}") for i in range(count))
    return Suite(
        name="long-horizon",
        version=f"map-{name}-{seed}" + (f"-rough{roughness:g}" if roughness else ""),
        scenarios=scenarios,
    )

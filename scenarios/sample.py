"""Suites drawn on the spot: routes on any known map, from a seed."""

from __future__ import annotations

import msgspec
import numpy as np
import shapely

from cosim.errors import unknown
from cosim.geometry import Polyline
from cosim.scenario import CityMap, Scenario, Suite
from cosim.streetmap import StreetMap, Strip
from cosim.walks import WalkGraph
from scenarios.long_horizon import build
from scenarios.places import place

PERSON_M2 = 25.0
"""Sidewalk that every person has at least, on the mean along a route; in generated cities it is about 29 m2."""

SAMPLE_M = 20.0


def suite_on_map(kind: str, name: str, seed: int, count: int, roughness: float = 0.0) -> Suite:
    """`count` long-horizon scenarios on a map; the same arguments and net give the same suite.

    Where sidewalks are few or narrow, fewer people walk: on a metre of width nobody passes a robot.
    roughness: of the ground, from 0 (flat) to 1.

    Raises UsageError for another kind of suite, and whatever the map or the builder has to refuse.
    """
    if kind != "long-horizon":
        raise unknown("suite for --map", kind, ["long-horizon"])
    where = CityMap(map=name, roughness=roughness)
    _, street_map = place(where)
    graph = WalkGraph(street_map)
    drawn = (build(where, street_map, graph, seed + i, f"{name}-{seed + i:03d}") for i in range(count))
    scenarios = tuple(thinned(scenario, street_map) for scenario in drawn)
    return Suite(
        name="long-horizon",
        version=f"map-{name}-{seed}" + (f"-rough{roughness:g}" if roughness else ""),
        scenarios=scenarios,
    )


def thinned(scenario: Scenario, street_map: StreetMap) -> Scenario:
    """The scenario with no more people than the sidewalks within the crowd's radius of its route have room for."""
    route = Polyline(np.array(scenario.route))
    around = [
        shapely.Point(route.at(float(s_m)).xy).buffer(scenario.crowd.radius_m)
        for s_m in np.arange(0.0, route.length_m, SAMPLE_M)
    ]
    area_m2 = [
        sum(
            strip.polygon.intersection(disc).area
            for strip in street_map.near("strip", disc)
            if isinstance(strip, Strip) and strip.kind == "sidewalk"
        )
        for disc in around
    ]
    persons = min(scenario.crowd.persons, round(float(np.mean(area_m2)) / PERSON_M2))
    return msgspec.structs.replace(scenario, crowd=msgspec.structs.replace(scenario.crowd, persons=persons))

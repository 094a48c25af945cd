"""Builder of crossing scenarios: one signalised crossing with a few metres of sidewalk on either
side.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from cosim.core.errors import CosimError, MapError
from cosim.core.geometry import Polyline
from cosim.place.route_line import way_line
from cosim.place.street_map import Port, StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.robot import COURIER
from cosim.spec.scenario import Place, Scenario
from scenarios.suites.drawing import Refusals, bare_scenario
from scenarios.suites.long_horizon import TURNED_OVER_M, on_car_paths_m, on_road_m, route_crossings

START_BEFORE_CROSSING_M: Final = 10.0
AFTER_M: Final = 8.0
"""Distance from the start to the crossing and from the crossing to the goal, in metres."""
OFF_ROAD_M: Final = 1.0
_LIMIT_S: Final = 180.0
"""Time limit in seconds: longer than a cycle of any signal, with time to walk."""


def build_all(
    place: Place, street_map: StreetMap, graph: WalkGraph, seed: int, count: int
) -> list[Scenario]:
    """Build scenarios over `count` different signalised crossings, drawn from `seed`.

    The phase of the signal is not chosen. Raises MapError if the map has fewer crossings that can
    be reached from sidewalks on both sides.
    """
    rng = np.random.default_rng([seed, place.seed, 0xC2055])
    strips = street_map.strips
    signalised = sorted(s for s in graph.main_strips - street_map.steep if strips[s].signalised)
    found: list[Scenario] = []
    refusals = Refusals()
    for i in rng.permutation(len(signalised)).tolist():
        if len(found) == count:
            break
        enter = Port(signalised[i], 0 if rng.random() < 0.5 else 1)
        scenario_id = f"crossing-{place.seed:03d}-{len(found):02d}"
        try:
            found.append(
                _over(place, street_map, graph, enter, seed * 1000 + len(found), scenario_id)
            )
        except CosimError as refusal:
            refusals.add(refusal)
    if len(found) < count:
        raise MapError(
            f"map '{street_map.name}' has {len(found)} signalised crossings to drive over, "
            f"not {count}. {refusals}"
        )
    return found


def _over(
    place: Place, street_map: StreetMap, graph: WalkGraph, enter: Port, seed: int, scenario_id: str
) -> Scenario:
    """Build the scenario over one crossing, entered at a port. Raises CosimError if it fails."""
    way = [_beside(street_map, graph, enter, START_BEFORE_CROSSING_M), enter, enter.other]
    way.append(_beside(street_map, graph, enter.other, AFTER_M))
    # Corners belong to the route: the line starts early enough and is cut to the right length.
    line = way_line(street_map, way, START_BEFORE_CROSSING_M, AFTER_M)
    (crossing,) = route_crossings(street_map, line, way[1:])
    from_m = crossing.enter_s_m - START_BEFORE_CROSSING_M
    to_m = crossing.leave_s_m + AFTER_M
    route = Polyline(
        np.round([line.at(s).xy for s in np.linspace(from_m, to_m, round(to_m - from_m) + 1)], 3)
    )
    crossings = route_crossings(street_map, route, way[1:])
    if on_road_m(street_map, route, crossings) > OFF_ROAD_M:
        raise MapError("the way lies on a road")
    if on_car_paths_m(street_map, route, crossings, COURIER) > TURNED_OVER_M:
        raise MapError("cars turn over the way")
    return bare_scenario(
        route,
        crossings,
        place,
        street_map,
        suite="crossings",
        seed=seed,
        scenario_id=scenario_id,
        time_limit_s=_LIMIT_S,
    )


def _beside(street_map: StreetMap, graph: WalkGraph, port: Port, length_m: float) -> Port:
    """Return the nearest end of a sidewalk across the corner at a crossing's port.

    length_m: least length of the sidewalk.
    """
    strips = street_map.strips
    x_m, y_m = graph.point(port)
    near = [
        (np.hypot(x_m - graph.point(other)[0], y_m - graph.point(other)[1]), other)
        for other in graph.others(port)
        if strips[other.strip].kind == "sidewalk"
        and strips[other.strip].going == "plain"
        and other.strip not in street_map.steep
        and strips[other.strip].length_m >= length_m
    ]
    if not near:
        raise MapError("no sidewalk at an end of the crossing")
    return min(near)[1]

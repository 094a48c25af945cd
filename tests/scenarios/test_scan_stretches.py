"""Straight scenarios on scans: drawn over the pieces of their net, as wide as the ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.errors import CosimError
from cosim.place.scan_areas import corridor
from cosim.place.street_map import StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventKind
from cosim.spec.scenario import CityMap
from scenarios.events import EVENT_KINDS
from scenarios.suites.capacity import Capacity, capacity_of
from scenarios.suites.reactive import build_reactive
from scenarios.suites.stretches import sidewalks_of
from scenarios.suites.unit import build_unit
from sumo_nets.maps.ground_file import GROUND_FILE, with_drawn_ground
from sumo_nets.maps.scan_net import build_scan_net
from sumo_nets.net.net_file import read_net
from tests.support.flat_scans import flat_grid

pytestmark = pytest.mark.engine

WIDTHS_M = (2.3, 3.0, 4.5, 6.0)


def _bent_way() -> np.ndarray:
    """Return a path of 120 m that turns by 4 or 8 degrees every 15 m, in both directions."""
    turns = np.radians([0, 4, 0, 8, 0, 4, 8, 4])
    steps = 15.0 * np.column_stack([np.cos(turns), np.sin(turns)])
    return np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)])


def _corridor(width_m: float, folder: Path) -> StreetMap:
    """Return the map of a corridor along the path, with posts off its middle and in wide
    corridors."""
    way = _bent_way()
    (x0, y0), (x1, y1) = way.min(axis=0) - 12.0, way.max(axis=0) + 12.0
    grid = flat_grid(x0, y0, x1, y1)
    for x, y in (way[2] + (0.0, 2.4), way[5] + (7.0, -2.0)):
        column, row = np.rint((np.array([x, y]) - grid.origin) / grid.step_m).astype(int)
        grid.blocked[row : row + 2, column : column + 2] = True
    folder.mkdir()
    net = build_scan_net(corridor(way, width_m, grid), grid, None, folder)
    return with_drawn_ground(read_net(net.path), folder / GROUND_FILE)


@pytest.fixture(scope="module")
def corridors(tmp_path_factory: pytest.TempPathFactory) -> dict[float, StreetMap]:
    """Return maps of the corridor, by width."""
    folder = tmp_path_factory.mktemp("corridors")
    return {width_m: _corridor(width_m, folder / f"{width_m:g}") for width_m in WIDTHS_M}


@pytest.fixture(scope="module")
def capacities(corridors: dict[float, StreetMap]) -> dict[float, Capacity]:
    return {width_m: capacity_of(one, WalkGraph(one)) for width_m, one in corridors.items()}


def test_a_wider_corridor_never_has_fewer_places(capacities: dict[float, Capacity]) -> None:
    """The number of places of each event and of straight ways grows with the width, in spite of
    bends and of obstacles in wide corridors."""
    for name in (*EVENT_KINDS, "straight"):
        counts = [
            {**capacity.events, **capacity.structures}[name].found
            for capacity in capacities.values()
        ]
        assert counts == sorted(counts), (name, counts)
        assert counts[-1] >= 7 or name == "ped_crossing"


def test_the_check_of_a_scan_offers_what_is_drawn(
    corridors: dict[float, StreetMap], capacities: dict[float, Capacity]
) -> None:
    """The check offers an event on exactly the corridors on which each of four seeds draws it."""
    for width_m, street_map in corridors.items():
        graph = WalkGraph(street_map)
        for name, kind in EVENT_KINDS.items():
            drawn = [_fits(kind, street_map, graph, seed) for seed in range(4)]
            offered = capacities[width_m].events[name].found > 0
            assert drawn == [offered] * 4, (width_m, name)


def _fits(kind: EventKind, street_map: StreetMap, graph: WalkGraph, seed: int) -> bool:
    try:
        build_reactive(kind, CityMap(map="corridor"), street_map, graph, seed, kind.name)
    except CosimError:
        return False
    return True


def test_routes_over_pieces_have_the_stated_ground(
    corridors: dict[float, StreetMap],
) -> None:
    """Routes lead from one piece of the net to another, and the ground is walkable on both sides as
    far as the event says."""
    street_map = corridors[4.5]
    graph = WalkGraph(street_map)
    pieces = [strip.polygon for strip in street_map.strips.values()]
    crossings = 0
    for seed in range(8):
        drawn = build_reactive(
            EVENT_KINDS["frontal"], CityMap(map="corridor"), street_map, graph, seed, "frontal"
        )
        (event,) = drawn.events
        line = shapely.LineString(drawn.route)
        ground = shapely.buffer(line, event.half_width_m - 0.01, cap_style="flat")
        assert street_map.walkable.covers(ground)
        crossings += sum(one.intersects(line) for one in pieces) > 1
        straight = build_unit(
            "straight", CityMap(map="corridor"), street_map, graph, seed, "straight"
        )
        crossings += sum(one.intersects(shapely.LineString(straight.route)) for one in pieces) > 1
    assert crossings >= 2


def test_stretches_cover_the_corridor(corridors: dict[float, StreetMap]) -> None:
    """Corridors with more pieces have the same stretches."""
    counts = set()
    for street_map in corridors.values():
        stretches = sidewalks_of(street_map, WalkGraph(street_map))
        lines = shapely.union_all([shapely.LineString(one.line[:, :2]) for one in stretches])
        assert lines.buffer(1.0).covers(shapely.LineString(_bent_way()[1:-1]).buffer(0.1))
        counts.add(len(stretches))
    assert len(counts) == 1
    assert len({len(street_map.strips) for street_map in corridors.values()}) > 1

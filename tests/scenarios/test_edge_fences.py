"""Routes on maps with overlapping sidewalks, which need fences along their edges."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString

from cosim.core.errors import SpecError
from cosim.core.geometry import Polyline
from cosim.place.barriers import barrier_at, outline, ports_to_close, prove_single_path
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.scenario import City, content_hash
from scenarios.places.nets import place
from scenarios.suites import long_horizon
from scenarios.suites.catalog import load_suite
from scenarios.suites.edge_fences import MOST, edge_fences
from scenarios.suites.recipes import RECIPES, candidate
from tests.scenarios.test_scenarios import cross_map

WAY = [Port("west", 0), Port("east", 0)]
ROUTE = Polyline([(-30, 0), (30, 0)])


def laid_over(
    street_map: StreetMap, name: str, *points: tuple[float, float], width_m: float = 2.0
) -> StreetMap:
    """Return the map with an additional footway that meets no corner."""
    line = np.array(points)
    polygon = shapely.buffer(LineString(line), width_m / 2, cap_style="flat")
    strip = Strip(name, "sidewalk", line, width_m, polygon, (None, None))
    return dataclasses.replace(street_map, strips={**street_map.strips, name: strip})


def test_a_footway_across_a_sidewalk_is_fenced_off() -> None:
    """Fences at the branches leave the footway open; an edge fence closes it on both sides, names
    it, and keeps off the route."""
    street_map = laid_over(cross_map(), "path", (-15.0, -50.0), (-10.0, 50.0))
    fences = [barrier_at(street_map, port) for port in ports_to_close(street_map, WAY)]
    with pytest.raises(SpecError, match="a branch is left open"):
        prove_single_path(street_map, ROUTE, fences, WAY, 0.3)
    hemmed = edge_fences(street_map, WAY)
    part = prove_single_path(street_map, ROUTE, hemmed, WAY, 0.3)
    assert not part.intersects(
        street_map.strips["path"].polygon.difference(shapely.box(-50, -2, 50, 2))
    )
    closed = {(fence.strip, fence.end) for fence in hemmed}
    assert {("north", 0), ("south", 0), ("path", 0), ("path", 1)} <= closed
    for fence in hemmed:
        assert street_map.strips[fence.strip].polygon.distance(outline(fence)) < 8.0
        assert outline(fence).distance(LineString(ROUTE.points)) > 0.3


def test_a_footway_along_a_sidewalk_is_fenced_off() -> None:
    """The fence runs along a footway that overlaps half of the sidewalk."""
    street_map = laid_over(cross_map(), "beside", (-35.0, 2.0), (-5.0, 2.0), (60.0, 60.0))
    part = prove_single_path(street_map, ROUTE, edge_fences(street_map, WAY), WAY, 0.3)
    assert part.bounds[3] < 2.5


def test_an_isolated_route_needs_no_edge_fence() -> None:
    """A route without adjacent ground has no fences; one with far too much adjacent ground is
    refused."""
    alone = cross_map()
    alone = dataclasses.replace(
        alone, strips={name: alone.strips[name] for name in ("west", "east")}
    )
    ports = tuple(port for port in alone.corners["middle"].ports if port.strip in alone.strips)
    corner = dataclasses.replace(alone.corners["middle"], ports=ports)
    alone = dataclasses.replace(alone, corners={"middle": corner})
    assert edge_fences(alone, WAY) == ()
    crowded = cross_map()
    for number in range(MOST):
        x_m = -40.0 + 0.5 * number
        crowded = laid_over(crowded, f"path{number}", (x_m, -9.0), (x_m, 9.0), width_m=0.3)
    with pytest.raises(SpecError, match=f"more than {MOST} fences"):
        edge_fences(crowded, WAY)


@pytest.fixture(scope="module")
def overlaid() -> StreetMap:
    """Return a small city with a footway of 90 m across the middle of each long sidewalk."""
    _, street_map = place(City(seed=1, size_m=500.0))
    for strip in list(street_map.strips.values()):
        if strip.kind == "sidewalk" and strip.length_m >= 30.0:
            x, y, heading = Polyline(strip.line).at(0.3 * strip.length_m)
            aside = 45.0 * np.array([-np.sin(heading), np.cos(heading)])
            ends = [(float(x + k * aside[0]), float(y + k * aside[1])) for k in (-1.0, 1.0)]
            street_map = laid_over(street_map, f"over:{strip.id}", *ends)
    return street_map


@pytest.mark.engine
def test_a_route_is_searched_and_fenced_where_no_draw_fits(
    overlaid: StreetMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a map of overlapping sidewalks the same seed gives the same proved route; without the
    search there is none, with the reason."""
    monkeypatch.setattr(long_horizon, "TRIES", 10)
    graph = WalkGraph(overlaid)
    city = City(seed=1, size_m=500.0)
    found, again = (
        long_horizon.build_long_horizon(city, overlaid, graph, 4, "hemmed") for _ in range(2)
    )
    assert found == again and found.crossings and len(found.barriers) > 10
    assert any(barrier.strip.startswith("over:") for barrier in found.barriers)
    monkeypatch.setattr(long_horizon, "SEARCHES", 0)
    with pytest.raises(
        SpecError, match=r"^no long-horizon route .* in 10 draws \(.*\), and none was found.*$"
    ):
        long_horizon.build_long_horizon(city, overlaid, graph, 4, "none")


@pytest.mark.engine
def test_shipped_routes_are_drawn_again_to_the_bit(request: pytest.FixtureRequest) -> None:
    """The search does not change a route that a draw finds: one route, two with --whole."""
    names = ("lh-011-00", "lh-037-00") if request.config.getoption("--whole") else ("lh-011-00",)
    shipped = {s.id: s for s in load_suite("long-horizon").scenarios}
    slots = [slot for slot in RECIPES["long-horizon"].slots if slot.name in names]
    assert len(slots) == len(names)
    for slot in slots:
        scenario = shipped[slot.name]
        assert content_hash(candidate(slot, scenario.seed)) == content_hash(scenario)

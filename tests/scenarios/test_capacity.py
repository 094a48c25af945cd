"""The capacity that `cosim map check` reports for a place, compared with what the builders draw
there."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import LineString, box

from cosim.core.errors import CosimError
from cosim.place.street_map import Corner, Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.scenario import City, CityMap, Place
from scenarios.events import EVENT_KINDS
from scenarios.places.nets import place
from scenarios.suites.capacity import capacity_of
from scenarios.suites.reactive import build_reactive
from scenarios.suites.unit import STRUCTURES, build_unit
from tests.conftest import Cosim

pytestmark = pytest.mark.engine


@pytest.mark.parametrize(
    "where", [City(seed=1, size_m=500.0), CityMap(map="sumo-fkk-in")], ids=lambda p: p.name
)
def test_scenarios_can_be_drawn_exactly_where_the_check_offers_them(where: Place) -> None:
    """Each kind of event and each structure can be drawn where the check finds a place for it, and
    nowhere else."""
    _, street_map = place(where)
    graph = WalkGraph(street_map)
    capacity = capacity_of(street_map, graph)
    drawn = set()
    refusal_allowed = contextlib.suppress(CosimError)
    for name, kind in EVENT_KINDS.items():
        with refusal_allowed:
            build_reactive(kind, where, street_map, graph, 0, name)
            drawn.add(name)
    for structure in STRUCTURES:
        with refusal_allowed:
            build_unit(structure, where, street_map, graph, 0, structure)
            drawn.add(structure)
    found = {
        name: count
        for name, count in {**capacity.events, **capacity.structures}.items()
        if count.found
    }
    assert set(found) == drawn and capacity.routes.found
    assert all(
        count.found <= count.looked_at <= count.places and not count.why_not
        for count in found.values()
    )


def street(width_m: float) -> StreetMap:
    """Return two sidewalks of 60 m that meet at a corner."""
    lines = {
        "west": np.array([[0.0, 0.0], [60.0, 0.0]]),
        "north": np.array([[62.0, 2.0], [62.0, 62.0]]),
    }
    strips = {
        name: Strip(
            name,
            "sidewalk",
            line,
            width_m,
            LineString(line).buffer(width_m / 2, cap_style="flat"),
            ends,
        )
        for (name, line), ends in zip(lines.items(), [(None, "c"), ("c", None)], strict=True)
    }
    corner = Corner(
        "c", box(60, -width_m / 2, 62 + width_m / 2, 2), (Port("west", 1), Port("north", 0))
    )
    return StreetMap("street", (0, -2, 64, 62), strips, {"c": corner}, {}, {})


MIN_M = {
    "obstructing": 1.9,
    "conversing": 3.4,
    "queueing": 3.2,
    "frontal": 2.6,
    "lateral": 2.6,
    "overtaking": 2.8,
    "gesturing": 2.6,
}
"""Width in metres of the narrowest sidewalk for each kind of event on sidewalks."""


@pytest.mark.parametrize(("width_m", "fit"), [(1.6, 0), (2.7, 4), (4.0, 7)])
def test_a_kind_without_a_place_is_reported_with_the_reason(width_m: float, fit: int) -> None:
    """Too narrow sidewalks and missing crosswalks leave no place for a kind, and the reason is
    given."""
    capacity = capacity_of(street(width_m), WalkGraph(street(width_m)))
    assert {name: str(count) for name, count in capacity.events.items()} == {
        "ped_crossing": "none: there are no crosswalks"
    } | {
        name: "2 of 2 sidewalks"
        if width_m > least_m
        else f"none of 2 sidewalks: the sidewalk is narrower than {least_m} m"
        for name, least_m in MIN_M.items()
    }
    assert sum(count.found == 2 for count in capacity.events.values()) == fit
    straight = (
        "2 of 2 sidewalks"
        if fit
        else "none: no sidewalk is wide enough, apart from stairs, bridges and tunnels"
    )
    assert str(capacity.structures["straight"]) == straight
    assert str(capacity.routes).startswith(
        "none: no way of the drawn length"
    ) and capacity.usable == (fit > 0)


def test_the_check_counts_the_places_of_each_kind(cosim: Cosim, tmp_path: Path) -> None:
    """The check has a row for each of the eight events, the three structures and long routes, and
    the same in JSON."""
    done = cosim("map", "check", "sumo-fkk-in", cwd=tmp_path)
    assert done.returncode == 0 and "possible" not in done.stdout
    as_json = cosim("map", "check", "sumo-fkk-in", "--json", cwd=tmp_path)
    capacity = json.loads(as_json.stdout)["capacity"]
    assert list(capacity["events"]) == [*EVENT_KINDS] and list(capacity["structures"]) == [
        *STRUCTURES
    ]
    for name, count in capacity["events"].items():
        (row,) = [line for line in done.stdout.splitlines() if f"event {name} " in line]
        assert (f" {count['found']} of {count['places']} " if count["found"] else "none of") in row
    assert any("long route" in line and "ways drawn" in line for line in done.stdout.splitlines())

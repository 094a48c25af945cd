"""Counts of the street counter, on hand-made streets."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
import shapely

from cosim.core.state import People, Signal, Street, Vehicles
from cosim.place.street_map import StreetMap, Strip
from scenarios.tools.bench.crowd import StreetCounter

LINE = np.array([[0.0, 0.0], [8.0, 0.0]])
CROSSING = Strip(
    ":j_c0", "crossing", LINE, 4.0, shapely.box(0.0, -2.0, 8.0, 2.0), (None, None), signalised=True
)
SLANT = shapely.LineString([[4.0, -6.0], [12.0, 6.0]]).buffer(2.0, cap_style="flat")
MAP = StreetMap("m", (0.0, 0.0, 9.0, 9.0), {":j_c0": CROSSING}, {}, {}, {})


def street(
    tick: int, xy: list[tuple[float, float]], walk: bool = True, vehicles: Vehicles | None = None
) -> Street:
    n = len(xy)
    people = People.of(tuple(f"c{i}" for i in range(n)), xy, np.zeros(n), np.ones(n), ("walk",) * n)
    cars = vehicles if vehicles is not None else Vehicles.of((), [], [], [], [])
    return Street(tick, people, cars, MappingProxyType({":j_c0": Signal(walk)}))


def test_overlaps_are_counted_in_pair_seconds_with_their_place() -> None:
    """Of three people two are 0.2 m apart on the crossing for two seconds, and all pairs are in
    contact range."""
    counter = StreetCounter(MAP, 0.05, [])
    for tick in range(100):
        counter.update(street(tick, [(4.0, 0.0), (4.0, 0.2 if tick >= 60 else 0.7), (4.0, 1.2)]))
    assert counter.counts["pairs in contact range"] == pytest.approx(3 * 5.0)
    assert counter.counts["overlaps"] == pytest.approx(2.0)
    assert counter.counts["overlaps: on crossings"] == pytest.approx(2.0)


def test_an_entry_at_red_differs_from_one_at_the_end_of_green() -> None:
    """A person a metre into the crossing 0.5 s after the change began at green; one 3 s after
    walked at red."""
    counter = StreetCounter(MAP, 0.05, [])
    for tick in range(100):
        walked_m = -1.0 + 0.07 * tick
        counter.update(street(tick, [(walked_m, 0.0), (walked_m - 2.9, 1.0)], walk=tick < 20))
    assert counter.counts["persons entered signalised crossings"] == 2
    assert counter.counts["persons entered within a second of red"] == 1
    assert counter.counts["persons entered at red"] == 1
    assert counter.crossings == {":j_c0"}


def test_a_light_that_appears_red_counts_as_red() -> None:
    """An entry at red counts without an earlier green, but not for a person already on the
    crossing."""

    def counted(xs: list[float], walks: list[bool | None]) -> list[float]:
        """Return how many entered, entered at red, and entered within a second of red."""
        counter = StreetCounter(MAP, 0.05, [])
        for tick, (x_m, walk) in enumerate(zip(xs, walks, strict=True)):
            seen = street(tick, [(x_m, 0.0)], walk=bool(walk))
            counter.update(replace(seen, signals=MappingProxyType({})) if walk is None else seen)
        kinds = "signalised crossings", "at red", "within a second of red"
        return [counter.counts[f"persons entered {kind}"] for kind in kinds]

    comes = [-4.0 + 0.1 * k for k in range(60)]
    waits = [-4.0] * 100
    assert counted(comes, [False] * 60) == [1, 1, 0]
    assert counted(waits + comes, [True] * 50 + [None] * 50 + [False] * 60) == [1, 1, 0]
    assert counted(waits + comes, [True] * 10 + [False] * 40 + [None] * 90 + [False] * 20) == [
        1,
        0,
        1,
    ]
    assert counted([4.0] * 60, [None] * 20 + [False] * 40) == [0, 0, 0]


def test_overlapping_crossings_are_entered_separately() -> None:
    """A person who entered one crossing at green does not enter the slanting red one that overlaps
    it."""
    slanting = Strip(
        ":j_c1",
        "crossing",
        np.array([[4.0, -6.0], [12.0, 6.0]]),
        4.0,
        SLANT,
        (None, None),
        signalised=True,
    )
    counter = StreetCounter(
        StreetMap("m", MAP.bounds, {**MAP.strips, ":j_c1": slanting}, {}, {}, {}), 0.05, []
    )
    for tick in range(150):
        seen = street(tick, [(-1.0 + 0.06 * tick, 0.0)])
        counter.update(
            replace(seen, signals=MappingProxyType({**seen.signals, ":j_c1": Signal(False)}))
        )
    assert counter.counts["persons entered signalised crossings"] == 1
    assert counter.counts["persons entered at red"] == 0


def test_people_inside_objects_and_vehicles_are_counted() -> None:
    """One of two people is in a bench and the other in a moving car, both for one second."""
    counter = StreetCounter(MAP, 0.05, [("bench", shapely.box(1.0, -1.0, 2.0, 1.0))])
    car = Vehicles.of(("v0",), [[6.0, 0.0]], [0.0], [3.0], [[4.0, 2.0]])
    for tick in range(20):
        counter.update(street(tick, [(1.5, 0.0), (6.0, 0.5)], vehicles=car))
    assert counter.counts["persons"] == pytest.approx(2.0)
    assert counter.counts["in a bench"] == pytest.approx(1.0)
    assert counter.counts["in a vehicle that moves"] == pytest.approx(1.0)

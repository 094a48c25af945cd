"""Enduring a place: crowd and traffic around bodies that go anywhere, in a process of its own."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from cosim.place.walk_graph import WalkGraph
from cosim.spec.scenario import CityMap
from scenarios.tools.bench.places import endure, wandering
from sumo_nets.maps.map_store import read_map

pytestmark = pytest.mark.engine

MAP = "sumo-fkk-in"


def test_a_map_is_endured() -> None:
    """A net that comes with SUMO is simulated to the end, with about as many persons and cars as
    asked for; how far it has come is reported meanwhile."""
    shares: list[float] = []
    done = endure(
        CityMap(map=MAP),
        seed=1,
        minutes=0.5,
        progress=lambda _, share=None: shares.append(share or 0.0),
    )
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 1
    assert done.reason == "" and done.ticks == 600
    assert done.persons > 40 and done.vehicles > 10


def test_what_goes_wrong_is_the_reason() -> None:
    """A place that cannot be simulated ends with its reason, after no tick."""
    done = endure(CityMap(map="nowhere"), seed=0, minutes=0.5)
    assert done.ticks == 0 and "unknown map 'nowhere'" in done.reason


def test_bodies_go_everywhere() -> None:
    """In ten minutes a body is on sidewalks, on roads, on neither and at dead ends; it walks, and
    at times it jumps."""
    street_map = read_map(MAP)
    body = wandering(street_map, WalkGraph(street_map), np.random.default_rng(3))
    poses = list(itertools.islice(body, 12000))
    assert {street_map.locate(p.x_m, p.y_m).kind for p in poses[::5]} == {"walk", "road", "off"}
    steps = [math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in itertools.pairwise(poses)]
    assert sum(step > 1.0 for step in steps) >= 5 and sum(0.0 < step < 0.1 for step in steps) > 5000
    dead_ends = [s.line[-1, :2] for s in street_map.strips.values() if s.corners[1] is None]
    assert dead_ends and min(math.dist(p[:2], end) for p in poses for end in dead_ends) < 0.5

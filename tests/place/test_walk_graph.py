"""The walking graph, on a small invented street: two sidewalks, a crossing, and a detour."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from shapely.geometry import LineString, box

from cosim.core.errors import MapError
from cosim.place.street_map import Corner, Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph


def strip(
    name: str, points: list[tuple[float, float]], corners: tuple[str | None, str | None]
) -> Strip:
    line = np.array(points, dtype=float)
    kind = "crossing" if "_c" in name else "sidewalk"
    return Strip(name, kind, line, 1.92, LineString(points).buffer(0.96, cap_style="flat"), corners)  # type: ignore[arg-type]


def square() -> StreetMap:
    """A ring of four strips with an island strip: corners of 2 m, south 40 m long, the others 20 m,
    north a crossing."""
    strips = [
        strip("south", [(1, 0), (41, 0)], ("sw", "se")),
        strip("east", [(42, 1), (42, 21)], ("se", "ne")),
        strip(":n_c0", [(41, 22), (21, 22), (1, 22)], ("ne", "nw")),
        strip("west", [(0, 21), (0, 1)], ("nw", "sw")),
        strip("spur", [(43, 22), (63, 22)], ("ne", None)),
        strip("island", [(0, 90), (10, 90)], (None, None)),
    ]
    ports: dict[str, list[Port]] = {}
    for s in strips:
        for end in (0, 1):
            corner = s.corners[end]
            if corner is not None:
                ports.setdefault(corner, []).append(Port(s.id, end))
    corners = {c: Corner(c, box(0, 0, 1, 1), tuple(p)) for c, p in ports.items()}
    return StreetMap("square", (0, 0, 63, 90), {s.id: s for s in strips}, corners, {}, {})


HOP = math.sqrt(2.0)


def test_shortest_takes_the_shorter_way_round() -> None:
    """From the south-west to the north-west corner the way leads along west, not round by the
    crossing."""
    path, length_m = WalkGraph(square()).shortest(Port("south", 0), Port(":n_c0", 1)) or ([], 0.0)
    assert path == [Port("south", 0), Port("west", 1), Port("west", 0), Port(":n_c0", 1)]
    assert length_m == pytest.approx(HOP + 20 + HOP)


def test_a_closed_port_is_not_passed_in_either_direction() -> None:
    """With one end of the crossing closed, the way to and from it leads along the rest of the
    ring."""
    graph = WalkGraph(square())
    closed = frozenset({Port(":n_c0", 1)})
    forward = graph.shortest(Port("west", 0), Port(":n_c0", 1), closed)
    back = graph.shortest(Port(":n_c0", 1), Port("west", 0), closed)
    assert forward is not None and back is not None
    assert forward[0] == back[0][::-1]
    assert forward[0][-2] == Port(":n_c0", 0)
    assert forward[1] == pytest.approx(20 + HOP + 40 + HOP + 20 + HOP + 40)


def test_an_unreachable_goal_gives_none() -> None:
    """The island, and a strip closed at both ends, cannot be reached."""
    graph = WalkGraph(square())
    assert graph.shortest(Port("south", 0), Port("island", 0)) is None
    assert (
        graph.shortest(
            Port("south", 0), Port("east", 0), frozenset({Port("east", 0), Port("east", 1)})
        )
        is None
    )


def test_components_and_the_main_component() -> None:
    """The ring with its spur is one component and the main one; the island is another."""
    graph = WalkGraph(square())
    assert graph.main_strips == {"south", "east", ":n_c0", "west", "spur"}
    assert len(set(graph.component.tolist())) == 2
    assert graph.component[graph.ports.index(Port("island", 0))] != graph.component[0]


def test_reach_is_limited_and_agrees_with_shortest() -> None:
    """Every port within the limit has the distance and path of `shortest`; those beyond are
    infinitely far."""
    graph = WalkGraph(square())
    start = Port("south", 0)
    near = graph.reach(start, limit_m=30.0)
    everything = graph.reach(start)
    assert near.within(0.0, 30.0) == [start, Port(":n_c0", 1), Port("west", 0), Port("west", 1)]
    assert near.to(Port("spur", 1)) == math.inf and near.path(Port("spur", 1)) is None
    for goal in everything.within(0.0, 1e6):
        path, length_m = graph.shortest(start, goal) or ([], 0.0)
        assert everything.path(goal) == path
        assert everything.to(goal) == pytest.approx(length_m)


def test_the_other_ports_are_those_across_the_corner() -> None:
    """A corner connects its ports; a dead end has none, and a closed port leads to none."""
    graph = WalkGraph(square())
    assert graph.others(Port("east", 1)) == (Port(":n_c0", 0), Port("spur", 0))
    assert graph.others(Port("east", 1), frozenset({Port("spur", 0)})) == (Port(":n_c0", 0),)
    assert graph.others(Port("east", 1), frozenset({Port("east", 1)})) == ()
    assert graph.others(Port("spur", 1)) == ()


def test_wander_is_connected_and_avoids_dead_ends() -> None:
    """A wanderer goes from strip to neighbouring strip, never into the dead end, and stops on a
    sidewalk."""
    street_map = square()
    graph = WalkGraph(street_map)
    for seed in range(50):
        walk = graph.wander(np.random.default_rng(seed), "south", seed % 2 == 0, 9)
        assert walk[0] == "south" and 1 < len(walk) <= 9
        assert "spur" not in walk and street_map.strips[walk[-1]].kind == "sidewalk"
        for a, b in itertools.pairwise(walk):
            assert set(street_map.strips[a].corners) & set(street_map.strips[b].corners)


def test_an_unknown_strip_is_named() -> None:
    """Asking for a strip that the map lacks says so."""
    with pytest.raises(MapError, match="no strip 'nowhere' on this map to walk on"):
        WalkGraph(square()).reach(Port("nowhere", 0))

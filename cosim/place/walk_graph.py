"""WalkGraph: reachability and walking distances between strips.

Nodes are ports, the two ends of every strip. Arcs run along each strip and, at each corner,
straight between its ports. A barrier closes a port: its arcs across the corner are removed. The
strip behind it can be entered from its other end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from cosim.place.street_map import Port, StreetMap

if TYPE_CHECKING:  # imported on use: a wandering crowd does not need it
    from scipy.sparse import csr_array

OPEN: frozenset[Port] = frozenset()
"""Empty set of closed ports."""

SHORTEST_HOP_M = 0.1
"""Minimum length of an arc in metres, for ports that touch."""

CROSSING_WEIGHT = 0.5
"""Probability that a random walk takes a crossing, relative to a sidewalk."""


@dataclass(frozen=True, slots=True)
class Reach:
    """Ports reachable from `start`.

    distance_m: (P,) metres to each port; inf if it is unreachable or beyond the limit.
    """

    start: Port
    ports: tuple[Port, ...]
    distance_m: Floats
    _index: dict[str, int]
    _before: NDArray[np.int32]

    def within(self, low_m: float, high_m: float) -> list[Port]:
        """Return the ports at a walking distance in [low_m, high_m], in the graph's order."""
        hits = np.flatnonzero((self.distance_m >= low_m) & (self.distance_m <= high_m))
        return [self.ports[i] for i in hits]

    def to(self, goal: Port) -> float:
        """Return the walking distance to `goal` in metres, inf if it is unreachable."""
        return float(self.distance_m[_node(self._index, goal)])

    def path(self, goal: Port) -> list[Port] | None:
        """Return the shortest path to `goal` with both ends, or None if it is unreachable."""
        node = _node(self._index, goal)
        if not np.isfinite(self.distance_m[node]):
            return None
        nodes = [node]
        while (node := int(self._before[node])) >= 0:
            nodes.append(node)
        return [self.ports[i] for i in reversed(nodes)]


class WalkGraph:
    """Walking graph of a place.

    ports: all P ports, both ends of each strip in the map's order.
    xy: (P, 2) metres.
    component: (P,) label of each port's connected part, without closed ports.
    main_strips: strips of the longest connected part.
    """

    def __init__(self, street_map: StreetMap) -> None:
        self.street_map = street_map
        self.ports: tuple[Port, ...] = tuple(
            p for s in street_map.strips for p in (Port(s, 0), Port(s, 1))
        )
        self._index = {strip: 2 * i for i, strip in enumerate(street_map.strips)}
        strips = list(street_map.strips.values())
        ends = [strip.line[i, :2] for strip in strips for i in (0, -1)]
        self.xy: Floats = np.array(ends, dtype=float).reshape(-1, 2)
        self.xy.flags.writeable = False
        self._corner: dict[Port, tuple[Port, ...]] = {
            port: tuple(other for other in corner.ports if other != port)
            for corner in street_map.corners.values()
            for port in corner.ports
        }
        self._arcs = lru_cache(maxsize=8)(self._build_arcs)
        self._next_ports = lru_cache(maxsize=4096)(self._find_next_ports)

    @cached_property
    def component(self) -> NDArray[np.int32]:
        from scipy.sparse.csgraph import connected_components

        labels: NDArray[np.int32] = connected_components(self._arcs(OPEN), directed=False)[1]
        return labels

    @cached_property
    def main_strips(self) -> frozenset[str]:
        if not self.street_map.strips:
            return frozenset()
        labels = self.component[::2]
        (_, _, lengths_m) = self._strip_arcs
        main = np.argmax(np.bincount(labels, weights=lengths_m[: len(labels)]))
        return frozenset(
            strip for strip, c in zip(self.street_map.strips, labels, strict=True) if c == main
        )

    def point(self, port: Port) -> tuple[float, float]:
        """Return the position of a port in metres."""
        x, y = self.xy[_node(self._index, port)]
        return float(x), float(y)

    def others(self, port: Port, closed: frozenset[Port] = OPEN) -> tuple[Port, ...]:
        """Return the ports reachable across the corner at `port`; none at a dead end or a closed
        port."""
        if port in closed:
            return ()
        around = self._corner.get(port, ())
        return tuple(other for other in around if other not in closed) if closed else around

    def shortest(
        self, start: Port, goal: Port, closed: frozenset[Port] = OPEN
    ) -> tuple[list[Port], float] | None:
        """Return the shortest path between ports with both ends, and its length in metres; None
        without one."""
        reach = self.reach(start, closed)
        path = reach.path(goal)
        return None if path is None else (path, reach.to(goal))

    def reach(
        self, start: Port, closed: frozenset[Port] = OPEN, limit_m: float = math.inf
    ) -> Reach:
        """Return the ports reachable from `start` within `limit_m`, with their distances."""
        from scipy.sparse.csgraph import dijkstra

        distance, before = dijkstra(  # type: ignore[call-overload]
            self._arcs(closed),
            indices=_node(self._index, start),
            return_predecessors=True,
            limit=limit_m,
        )
        return Reach(start, self.ports, distance, self._index, before)

    def wander(
        self,
        rng: np.random.Generator,
        strip: str,
        forward: bool,
        n_edges: int,
        closed: frozenset[Port] = OPEN,
    ) -> list[str]:
        """Return a random walk of up to `n_edges` strip ids, crossings included, within open ports.

        strip: first strip.
        forward: whether it is walked along its line.

        The walk avoids dead ends, unless the place is a scan, whose streets continue beyond its
        edge. It does not end on a crossing, so it can be shorter, down to one strip.
        """
        strips = self.street_map.strips
        walk = [strip]
        port = Port(strip, 1 if forward else 0)
        while len(walk) < n_edges:
            choices, weights = self._next_ports(port, closed)
            if not choices:
                break
            pick = rng.random() * sum(weights)
            chosen = choices[-1]
            for choice, weight in zip(choices, weights, strict=True):
                pick -= weight
                if pick < 0.0:
                    chosen = choice
                    break
            walk.append(chosen.strip)
            port = chosen.other
        while len(walk) > 1 and strips[walk[-1]].kind == "crossing":
            walk.pop()
        return walk

    def _find_next_ports(
        self, port: Port, closed: frozenset[Port]
    ) -> tuple[tuple[Port, ...], tuple[float, ...]]:
        """Return the next ports of a random walk, and their weights."""
        scanned = self.street_map.scanned
        choices = tuple(
            [
                p
                for p in self.others(port, closed)
                if self.others(p.other, closed) or (scanned and p.other not in closed)
            ]
        )
        kinds = [self.street_map.strips[p.strip].kind for p in choices]
        return choices, tuple([CROSSING_WEIGHT if kind == "crossing" else 1.0 for kind in kinds])

    @cached_property
    def _strip_arcs(self) -> tuple[NDArray[np.int32], NDArray[np.int32], Floats]:
        lengths = np.array(
            [max(strip.length_m, SHORTEST_HOP_M) for strip in self.street_map.strips.values()]
        )
        even = 2 * np.arange(len(lengths), dtype=np.int32)
        return (
            np.concatenate([even, even + 1]),
            np.concatenate([even + 1, even]),
            np.tile(lengths, 2),
        )

    @cached_property
    def _corner_arcs(self) -> tuple[NDArray[np.int32], NDArray[np.int32], Floats]:
        pairs = [
            (_node(self._index, a), _node(self._index, b))
            for corner in self.street_map.corners.values()
            for a in corner.ports
            for b in corner.ports
            if a.strip != b.strip
        ]
        nodes = np.array(pairs, dtype=np.int32).reshape(-1, 2)
        gap = self.xy[nodes[:, 0]] - self.xy[nodes[:, 1]]
        return nodes[:, 0], nodes[:, 1], np.maximum(np.hypot(gap[:, 0], gap[:, 1]), SHORTEST_HOP_M)

    def _build_arcs(self, closed: frozenset[Port]) -> csr_array:
        from scipy.sparse import csr_array

        tails, heads, metres = self._corner_arcs
        if closed:
            closed_nodes = [_node(self._index, port) for port in closed]
            keep = ~(np.isin(tails, closed_nodes) | np.isin(heads, closed_nodes))
            tails, heads, metres = tails[keep], heads[keep], metres[keep]
        along_tails, along_heads, along_m = self._strip_arcs
        nodes = (np.concatenate([along_tails, tails]), np.concatenate([along_heads, heads]))
        count = len(self.ports)
        return csr_array((np.concatenate([along_m, metres]), nodes), shape=(count, count))


@lru_cache(maxsize=1)
def walk_graph_of(street_map: StreetMap) -> WalkGraph:
    """Return the graph of a place; the last one is cached."""
    return WalkGraph(street_map)


def _node(index: dict[str, int], port: Port) -> int:
    try:
        return index[port.strip] + port.end
    except KeyError:
        raise MapError(f"no strip '{port.strip}' on this map to walk on") from None

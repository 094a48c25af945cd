"""Draft of a city during planning, and the final plan: nodes, edges, crossings and roundabouts."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sumo_nets.city.blocks import (
    CLASSES,
    Line,
    Point,
    Section,
    bend,
    corner,
    direction,
    length,
    polar,
    ring,
    split,
    straight,
)

Cell = tuple[int, int]
"""Column and row of a lattice point."""


@dataclass(slots=True)
class Link:
    """A street between lattice points.

    via: lattice point of a rounded corner.
    turns: left turn off the chord at either end, radians.
    """

    a: Cell
    b: Cell
    street_class: str
    section: Section
    via: Cell | None = None
    turns: tuple[float, float] = (0.0, 0.0)

    @property
    def plain(self) -> bool:
        """Whether the street has no bend yet."""
        return self.via is None and self.turns == (0.0, 0.0)


@dataclass(slots=True)
class Draft:
    """Lattice points, streets between them, and roundabouts.

    rings: radius of the roundabout at a point, metres.
    """

    at: dict[Cell, Point]
    links: list[Link]
    rings: dict[Cell, float] = field(default_factory=dict)

    def arms(self) -> dict[Cell, list[Link]]:
        """Return the streets at each point."""
        arms: dict[Cell, list[Link]] = {cell: [] for cell in self.at}
        for link in self.links:
            arms[link.a].append(link)
            arms[link.b].append(link)
        return arms

    def leaving(self, link: Link, cell: Cell) -> float:
        """Return the heading with which `link` leaves the point of `cell`, radians."""
        far = link.b if cell == link.a else link.a
        chord = direction(self.at[cell], self.at[far if link.via is None else link.via])
        return chord + link.turns[0 if cell == link.a else 1]

    def gap(self, cell: Cell, arms: list[Link]) -> float:
        """Return the smallest angle between two arms, radians."""
        headings = sorted(self.leaving(link, cell) % (2.0 * math.pi) for link in arms)
        around = [*headings[1:], headings[0] + 2.0 * math.pi]
        return min(b - a for a, b in zip(headings, around, strict=True))

    def on_border(self, *cells: Cell) -> bool:
        """Return whether all cells lie on one side of the lattice."""
        last = max(self.at)[0]
        return any(
            {cell[axis] for cell in cells} == {side} for axis in (0, 1) for side in (0, last)
        )

    def chord(self, link: Link) -> float:
        """Return the distance between the ends of a street, metres."""
        return math.dist(self.at[link.a], self.at[link.b])


DRIVEWAY_CLEAR_M = 36.0
"""Smallest distance of driveways from the ends of their street, metres; junctions take up to 27
m."""
DRIVEWAY_GAP_M = 12.0
"""Smallest distance between driveways, metres."""
CROSSWALK_ROOM_M = 0.4
"""Length of a mid-street crosswalk's area beyond the crosswalk on either side, metres."""


class Node(NamedTuple):
    """A junction.

    signalised: whether it has traffic lights.
    outline: its area, where netconvert would make it too small.
    """

    id: str
    at: Point
    signalised: bool
    outline: tuple[Point, ...] = ()


class Edge(NamedTuple):
    """One direction of a street.

    driveways: points of its line where driveways cross the sidewalk.
    """

    id: str
    tail: str
    head: str
    street_class: str
    section: Section
    line: Line
    driveways: tuple[Point, ...] = ()


class Zebra(NamedTuple):
    """A crossing over the given edges at a node."""

    node: str
    edges: tuple[str, ...]
    width_m: float


class _Ring(NamedTuple):
    """Nodes and edges of a roundabout."""

    nodes: tuple[str, ...]
    edges: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class CityPlan:
    """The elements of a city.

    signal_rng: random generator of the signal programs.
    """

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    zebras: tuple[Zebra, ...]
    rings: tuple[_Ring, ...]
    signal_rng: np.random.Generator


@dataclass(slots=True)
class _Parts:
    """Elements planned so far.

    joints: node where a street, by index, meets a lattice point.
    """

    nodes: dict[str, Node]
    edges: list[Edge]
    rings: list[_Ring]
    joints: dict[tuple[Cell, int], Node]
    zebras: dict[str, list[Zebra]]


def plan_of(draft: Draft, rngs: Mapping[str, np.random.Generator], crosswalks: float) -> CityPlan:
    """Return the plan of a draft.

    crosswalks: share of the longer streets with a mid-street crosswalk.
    """
    parts = _Parts({}, [], [], {}, defaultdict(list))
    numbers = {id(link): number for number, link in enumerate(draft.links)}
    for cell, arms in draft.arms().items():
        draw = rngs["lights"].random()
        ways = [(numbers[id(link)], link) for link in arms]
        if cell in draft.rings:
            _add_ring(parts, draft, cell, ways, rngs["widths"])
        elif arms:
            wide = any(CLASSES[link.street_class].lanes > 1 for link in arms)
            lit = draw < (0.85 if wide else 0.25 if len(arms) > 3 else 0.08)
            node = parts.nodes[_name(cell)] = Node(_name(cell), draft.at[cell], lit)
            parts.joints |= {(cell, number): node for number, _ in ways}
    for number, link in enumerate(draft.links):
        _add_street(parts, draft, number, link, crosswalks, rngs)
    zebras = tuple(zebra for node in parts.nodes for zebra in parts.zebras[node])
    return CityPlan(
        tuple(parts.nodes.values()), tuple(parts.edges), zebras, tuple(parts.rings), rngs["signals"]
    )


def _name(cell: Cell) -> str:
    return f"n{cell[0]}x{cell[1]}"


def _add_ring(
    parts: _Parts,
    draft: Draft,
    cell: Cell,
    ways: list[tuple[int, Link]],
    width_rng: np.random.Generator,
) -> None:
    name = _name(cell)
    centre = draft.at[cell]
    radius = draft.rings[cell]
    order = sorted((draft.leaving(link, cell) % (2.0 * math.pi), number) for number, link in ways)
    angles = [angle for angle, _ in order]
    around = [Node(f"{name}r{k}", polar(centre, radius, a), False) for k, a in enumerate(angles)]
    section = CLASSES["ring"].section(width_rng)
    arcs = [
        Edge(f"{name}q{k}", around[k].id, around[(k + 1) % len(around)].id, "ring", section, line)
        for k, line in enumerate(ring(centre, radius, angles))
    ]
    parts.nodes |= {node.id: node for node in around}
    parts.joints |= {(cell, number): node for (_, number), node in zip(order, around, strict=True)}
    parts.edges += arcs
    parts.rings.append(_Ring(tuple(n.id for n in around), tuple(e.id for e in arcs)))


def _add_street(
    parts: _Parts,
    draft: Draft,
    number: int,
    link: Link,
    crosswalks: float,
    rngs: Mapping[str, np.random.Generator],
) -> None:
    """Add both directions of a street and its crossings, in two pieces if it has a mid-street
    crosswalk."""
    tail, head = parts.joints[link.a, number], parts.joints[link.b, number]
    line = _line(draft, link, tail.at, head.at)
    name = f"s{number}"
    kind = CLASSES[link.street_class]
    draws = rngs["crosswalks"].random(3).tolist()
    width_m = kind.crossings_m[int(rngs["widths"].integers(len(kind.crossings_m)))]
    blocked = sum(20.0 if end in draft.rings else 0.0 for end in (link.a, link.b))
    if length(line) > (106.0 if link.via is None else 180.0) + blocked and draws[0] < crosswalks:
        # On a street with a corner, the crosswalk lies well before it.
        where = 0.45 + 0.1 * draws[1] if link.via is None else 0.27
        first, second = split(line, where * length(line))
        outline = _crosswalk_area(
            first[-1], direction(first[-2], second[1]), link.section.half_m, width_m
        )
        middle = Node(f"{name}m", first[-1], draws[2] < (0.7 if kind.lanes > 1 else 0.25), outline)
        parts.nodes[middle.id] = middle
        parts.zebras[middle.id].append(Zebra(middle.id, (f"{name}a", f"-{name}a"), width_m))
        pieces = [(f"{name}a", tail, middle, first), (f"{name}b", middle, head, second)]
    else:
        pieces = [(name, tail, head, line)]
    for piece, start, end, shape in pieces:
        there, back = (
            _driveways(way, kind.driveways, rngs["driveways"]) for way in (shape, shape[::-1])
        )
        parts.edges.append(
            Edge(piece, start.id, end.id, link.street_class, link.section, shape, there)
        )
        parts.edges.append(
            Edge(f"-{piece}", end.id, start.id, link.street_class, link.section, shape[::-1], back)
        )
        for node in (start, end):
            if node in (tail, head):
                parts.zebras[node.id].append(Zebra(node.id, (piece, f"-{piece}"), width_m))


def _crosswalk_area(
    at: Point, heading: float, half_m: float, crossing_m: float
) -> tuple[Point, ...]:
    """Return the rectangle of a crosswalk and the sidewalks at its ends, with room for curb
    ramps."""
    ahead = 0.5 * crossing_m + CROSSWALK_ROOM_M
    aside = half_m
    corners = ((ahead, aside), (ahead, -aside), (-ahead, -aside), (-ahead, aside))
    cos, sin = math.cos(heading), math.sin(heading)
    return tuple((at[0] + u * cos - v * sin, at[1] + u * sin + v * cos) for u, v in corners)


def _driveways(line: Line, per_m: float, rng: np.random.Generator) -> tuple[Point, ...]:
    """Draw the driveways of a street, on average `per_m` per metre, away from its ends and each
    other."""
    found: list[Point] = []
    at = DRIVEWAY_CLEAR_M
    end = length(line) - DRIVEWAY_CLEAR_M
    while per_m and (at := at + float(rng.exponential(1.0 / per_m))) < end:
        found.append(split(line, at)[0][-1])
        at += DRIVEWAY_GAP_M
    return tuple(found)


def _line(draft: Draft, link: Link, a: Point, b: Point) -> Line:
    """Return the centre line between the points where the street starts and ends."""
    leave = draft.leaving(link, link.a)
    arrive = draft.leaving(link, link.b) + math.pi
    if link.via is not None:
        return corner(a, draft.at[link.via], b, 32.0)
    if link.turns == (0.0, 0.0):
        return straight(a, b)
    return bend(a, b, leave, arrive)

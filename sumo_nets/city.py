"""A whole city from a seed: a jittered lattice with streets removed, bent, joined by roundabouts and crosswalks.

The plan is pure geometry and topology; `sumo_nets.store` makes a street net of it. A street class runs along a whole
row or column of the lattice. Metres, x east, y north; the city fills the square from 0, 0 to size_m, size_m.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from cosim.errors import MapError, unknown
from sumo_nets.blocks import CLASSES, Line, Point, bend, corner, direction, length, polar, ring, split, straight

SIZE_M = (200.0, 4000.0)
"""Smallest and largest city."""
PITCH_M = 112.0
MARGIN_M = 22.0
CLEAR_RAD = math.radians(58.0)
"""Smallest angle between two arms of a junction."""


class Style(NamedTuple):
    """Shares of what a city is made of; classes: weight of each street class among rows and columns."""

    classes: dict[str, float]
    jitter: float
    removed: float
    diagonals: float
    ys: float
    curves: float
    s_bends: float
    roundabouts: float
    crosswalks: float


MIXED = {"residential": 0.38, "commercial": 0.24, "avenue": 0.18, "boulevard": 0.12, "narrow": 0.08}
DOWNTOWN = {"residential": 0.1, "commercial": 0.4, "avenue": 0.3, "boulevard": 0.2}
SUBURB = {"residential": 0.74, "commercial": 0.08, "avenue": 0.1, "narrow": 0.08}

STYLES = {
    "mixed": Style(MIXED, 0.25, 0.13, 0.04, 0.45, 0.35, 0.10, 0.12, 0.25),
    "downtown": Style(DOWNTOWN, 0.10, 0.08, 0.02, 0.15, 0.08, 0.03, 0.05, 0.35),
    "suburb": Style(SUBURB, 0.28, 0.18, 0.05, 0.55, 0.55, 0.15, 0.15, 0.15),
}

Cell = tuple[int, int]
PURPOSES = ("lattice", "classes", "diagonals", "removal", "shapes", "roundabouts", "crosswalks", "lights", "signals")


class Node(NamedTuple):
    """A junction. signalised: with traffic lights."""

    id: str
    at: Point
    signalised: bool


class Edge(NamedTuple):
    """One direction of a street."""

    id: str
    tail: str
    head: str
    street_class: str
    line: Line


class Zebra(NamedTuple):
    """A crossing over the given edges at a node."""

    node: str
    edges: tuple[str, ...]


class Ring(NamedTuple):
    """A roundabout's nodes and edges."""

    nodes: tuple[str, ...]
    edges: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class CityPlan:
    """What is built: signal_rng draws the signal programs' times."""

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    zebras: tuple[Zebra, ...]
    rings: tuple[Ring, ...]
    signal_rng: np.random.Generator


@dataclass(slots=True)
class _Link:
    """A street between lattice points while the plan is drawn. turns: left turn off the chord at either end."""

    a: Cell
    b: Cell
    street_class: str
    via: Cell | None = None
    turns: tuple[float, float] = (0.0, 0.0)


@dataclass(slots=True)
class _Draft:
    at: dict[Cell, Point]
    links: list[_Link]
    rings: dict[Cell, float] = field(default_factory=dict)

    def arms(self) -> dict[Cell, list[_Link]]:
        arms: dict[Cell, list[_Link]] = {cell: [] for cell in self.at}
        for link in self.links:
            arms[link.a].append(link)
            arms[link.b].append(link)
        return arms

    def leaving(self, link: _Link, cell: Cell) -> float:
        """Heading with which `link` leaves the point of `cell`."""
        far = link.b if cell == link.a else link.a
        chord = direction(self.at[cell], self.at[far if link.via is None else link.via])
        return chord + link.turns[0 if cell == link.a else 1]

    def gap(self, cell: Cell, arms: list[_Link]) -> float:
        """Smallest angle between two arms."""
        headings = sorted(self.leaving(link, cell) % (2.0 * math.pi) for link in arms)
        around = [*headings[1:], headings[0] + 2.0 * math.pi]
        return min(b - a for a, b in zip(headings, around, strict=True))

    def on_border(self, *cells: Cell) -> bool:
        """Whether all cells lie on one side of the lattice."""
        last = max(self.at)[0]
        return any({cell[axis] for cell in cells} == {side} for axis in (0, 1) for side in (0, last))

    def chord(self, link: _Link) -> float:
        return math.dist(self.at[link.a], self.at[link.b])


def plan_city(seed: int, size_m: float, style: str) -> CityPlan:
    """The plan of a city; equal to the bit for equal arguments. Raises MapError for a size out of range."""
    if style not in STYLES:
        raise unknown("city style", style, STYLES)
    if not SIZE_M[0] <= size_m <= SIZE_M[1]:
        raise MapError(f"a city's size_m must be in [{SIZE_M[0]:g}, {SIZE_M[1]:g}], not {size_m:g}")
    if seed < 0:
        raise MapError(f"a city's seed cannot be negative: {seed}")
    made_of = STYLES[style]
    entropy = (seed, round(size_m * 100), sorted(STYLES).index(style))
    seeds = np.random.SeedSequence(entropy).spawn(len(PURPOSES))
    rngs = {purpose: np.random.default_rng(s) for purpose, s in zip(PURPOSES, seeds, strict=True)}
    draft = _lattice(rngs["lattice"], rngs["classes"], size_m, made_of)
    _diagonals(draft, rngs["diagonals"], made_of.diagonals)
    _remove(draft, rngs["removal"], made_of.removed)
    _dissolve(draft)
    _bend_streets(draft, rngs["shapes"], made_of)
    _place_roundabouts(draft, rngs["roundabouts"], made_of.roundabouts)
    return _emit(draft, rngs["crosswalks"], rngs["lights"], made_of.crosswalks, rngs["signals"])


def _lattice(rng: np.random.Generator, class_rng: np.random.Generator, size_m: float, style: Style) -> _Draft:
    cells = max(2, round((size_m - 2.0 * MARGIN_M) / PITCH_M))
    pitch = (size_m - 2.0 * MARGIN_M) / cells
    sway = style.jitter * (pitch - 55.0)
    at: dict[Cell, Point] = {}
    for i in range(cells + 1):
        for j in range(cells + 1):
            dx, dy = rng.uniform(-sway, sway, 2)
            # The border stays straight enough to remain inside the square.
            dx, dy = dx * (0.3 if i in (0, cells) else 1.0), dy * (0.3 if j in (0, cells) else 1.0)
            at[i, j] = (MARGIN_M + i * pitch + float(dx), MARGIN_M + j * pitch + float(dy))
    names, weights = list(style.classes), np.array(list(style.classes.values()))
    rows, columns = (class_rng.choice(names, cells + 1, p=weights / weights.sum()).tolist() for _ in range(2))
    links = [_Link((i, j), (i + 1, j), rows[j]) for i in range(cells) for j in range(cells + 1)]
    links += [_Link((i, j), (i, j + 1), columns[i]) for i in range(cells + 1) for j in range(cells)]
    return _Draft(at, links)


def _diagonals(draft: _Draft, rng: np.random.Generator, share: float) -> None:
    """Replace two opposite sides of some blocks by one slanting street, which makes Y junctions."""
    last = max(draft.at)[0]
    blocks = [(i, j) for i in range(1, last - 1) for j in range(1, last - 1)]
    taken: set[Cell] = set()
    for k in rng.permutation(len(blocks))[: math.ceil(share * len(blocks))].tolist():
        i, j = blocks[k]
        corners = {(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)}
        if taken & {(p + di, q + dj) for p, q in corners for di in (-1, 0, 1) for dj in (-1, 0, 1)}:
            continue
        rising, across = bool(rng.integers(2)), bool(rng.integers(2))
        a, b = ((i, j), (i + 1, j + 1)) if rising else ((i, j + 1), (i + 1, j))
        dropped = [
            link
            for link in draft.links
            if {link.a, link.b} <= corners and (link.a[1] == link.b[1] if across else link.a[0] == link.b[0])
        ]
        kept = [link for link in draft.links if link not in dropped]
        for degrees in (14.0, 20.0, 26.0):
            turn = math.radians(degrees if rising != across else -degrees)
            trial = _Draft(draft.at, [*kept, _Link(a, b, dropped[0].street_class, turns=(turn, turn))])
            arms = trial.arms()
            if min(trial.gap(a, arms[a]), trial.gap(b, arms[b])) >= CLEAR_RAD:
                draft.links = trial.links
                taken |= corners
                break


def _remove(draft: _Draft, rng: np.random.Generator, share: float) -> None:
    """Remove a share of the streets; the rest stays one network without dead ends."""
    neighbours: dict[Cell, set[Cell]] = defaultdict(set)
    for link in draft.links:
        neighbours[link.a].add(link.b)
        neighbours[link.b].add(link.a)
    slanting = {end for link in draft.links if link.turns != (0.0, 0.0) for end in (link.a, link.b)}
    wanted = round(share * len(draft.links))
    gone: set[tuple[Cell, Cell]] = set()
    for k in rng.permutation(len(draft.links)).tolist():
        if len(gone) == wanted:
            break
        link = draft.links[k]
        ends = (link.a, link.b)
        thin = [end for end in ends if len(neighbours[end]) == 3]
        if link.turns != (0.0, 0.0) or any(len(neighbours[end]) < 3 for end in ends):
            continue
        # Two arms make one longer street: rarely, and never two such points in a row.
        if any(len(neighbours[near]) < 3 for end in thin for near in neighbours[end]) or len(thin) == 2:
            continue
        if thin and (slanting & set(thin) or rng.random() > 0.3):
            continue
        neighbours[link.a].discard(link.b)
        neighbours[link.b].discard(link.a)
        if _reaches(neighbours, link.a, link.b):
            gone.add(ends)
        else:
            neighbours[link.a].add(link.b)
            neighbours[link.b].add(link.a)
    draft.links = [link for link in draft.links if (link.a, link.b) not in gone]


def _reaches(neighbours: dict[Cell, set[Cell]], start: Cell, goal: Cell) -> bool:
    seen, front = {start}, [start]
    while front:
        cell = front.pop()
        if cell == goal:
            return True
        fresh = neighbours[cell] - seen
        seen |= fresh
        front += sorted(fresh)
    return False


def _dissolve(draft: _Draft) -> None:
    """Join the two streets of every point with two arms into one with a rounded corner."""
    for cell, arms in draft.arms().items():
        if len(arms) != 2:
            continue
        one, two = arms
        if one.via is not None or two.via is not None or one.turns != (0.0, 0.0) or two.turns != (0.0, 0.0):
            continue
        a = one.a if one.b == cell else one.b
        b = two.a if two.b == cell else two.b
        draft.links[draft.links.index(one)] = _Link(a, b, one.street_class, via=cell)
        draft.links.remove(two)


def _bend_streets(draft: _Draft, rng: np.random.Generator, style: Style) -> None:
    """Y junctions, curves and S-bends, each only where every angle between arms stays wide."""
    arms = draft.arms()
    for cell, mine in arms.items():
        if rng.random() > style.ys or len(mine) != 3 or draft.on_border(cell):
            continue
        headings = sorted((draft.leaving(link, cell) % (2.0 * math.pi), i) for i, link in enumerate(mine))
        gaps = [(headings[(k + 1) % 3][0] - headings[k][0]) % (2.0 * math.pi) for k in range(3)]
        k = max(range(3), key=lambda i: gaps[i])
        fold = min((gaps[k] - 2.0 * math.pi / 3.0) / 2.0, math.radians(28.0))
        # Only the two arms beside the widest gap fold into it.
        _turn(draft, arms, mine[headings[k][1]], cell, fold)
        _turn(draft, arms, mine[headings[(k + 1) % 3][1]], cell, -fold)
    middle = max(draft.at)[0] / 2.0
    for link in draft.links:
        draw, side = rng.random(), 1.0 if rng.integers(2) else -1.0
        if draft.on_border(link.a, link.b):
            # Towards the middle of the city, to stay inside its square.
            (x, y), (p, q) = link.a, link.b
            side = math.copysign(1.0, ((p - x) * (middle - y) - (q - y) * (middle - x)))
            draw = draw if draw < style.curves else 1.0
        turn = side * math.radians(rng.uniform(18.0, 42.0))
        if link.via is not None or link.turns != (0.0, 0.0) or draw > style.curves + style.s_bends:
            continue
        for factor in (1.0, 0.75, 0.5):
            link.turns = (factor * turn, factor * turn * (-1.0 if draw < style.curves else 1.0))
            if min(draft.gap(end, arms[end]) for end in (link.a, link.b)) >= CLEAR_RAD:
                break
            link.turns = (0.0, 0.0)


def _turn(draft: _Draft, arms: dict[Cell, list[_Link]], link: _Link, cell: Cell, turn: float) -> None:
    if link.via is not None:
        return
    before, end = link.turns, 0 if link.a == cell else 1
    link.turns = (before[0] + turn, before[1]) if end == 0 else (before[0], before[1] + turn)
    if abs(link.turns[end]) > math.radians(40.0) or draft.gap(cell, arms[cell]) < CLEAR_RAD:
        link.turns = before


def _place_roundabouts(draft: _Draft, rng: np.random.Generator, share: float) -> None:
    """Radii of the roundabouts, at interior junctions of quiet streets that are far enough from each other."""
    last, arms = max(draft.at)[0], draft.arms()
    for cell, mine in arms.items():
        radius, draw = float(rng.uniform(19.0, 22.0)), rng.random()
        if draw > share or len(mine) < 3 or {0, last} & set(cell):
            continue
        near = {end for link in mine for end in (link.a, link.b)}
        quiet = all(CLASSES[link.street_class].lanes == 1 and draft.chord(link) > 85.0 for link in mine)
        if quiet and not near & set(draft.rings) and draft.gap(cell, mine) > math.radians(74.0):
            draft.rings[cell] = radius


def _emit(
    draft: _Draft,
    rng: np.random.Generator,
    lights: np.random.Generator,
    crosswalks: float,
    signal_rng: np.random.Generator,
) -> CityPlan:
    nodes: dict[str, Node] = {}
    edges: list[Edge] = []
    rings: list[Ring] = []
    joints: dict[tuple[Cell, int], Node] = {}
    numbers = {id(link): number for number, link in enumerate(draft.links)}
    for cell, arms in draft.arms().items():
        name = f"n{cell[0]}x{cell[1]}"
        draw = lights.random()
        if cell in draft.rings:
            order = sorted((draft.leaving(link, cell) % (2.0 * math.pi), numbers[id(link)]) for link in arms)
            angles = [angle for angle, _ in order]
            around = [
                Node(f"{name}r{k}", polar(draft.at[cell], draft.rings[cell], a), False) for k, a in enumerate(angles)
            ]
            joints |= {(cell, link): node for (_, link), node in zip(order, around, strict=True)}
            parts = [
                Edge(f"{name}q{k}", around[k].id, around[(k + 1) % len(around)].id, "ring", line)
                for k, line in enumerate(ring(draft.at[cell], draft.rings[cell], angles))
            ]
            edges += parts
            rings.append(Ring(tuple(n.id for n in around), tuple(e.id for e in parts)))
        elif arms:
            wide = sum(CLASSES[link.street_class].lanes > 1 for link in arms)
            node = Node(name, draft.at[cell], draw < (0.85 if wide else 0.25 if len(arms) > 3 else 0.08))
            joints |= {(cell, numbers[id(link)]): node for link in arms}
            around = [node]
        else:
            continue
        nodes |= {node.id: node for node in around}
    zebras: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for number, link in enumerate(draft.links):
        tail, head = joints[link.a, number], joints[link.b, number]
        line, name = _line(draft, link, tail.at, head.at), f"s{number}"
        draws = rng.random(3).tolist()
        blocked = sum(20.0 if end in draft.rings else 0.0 for end in (link.a, link.b))
        if length(line) > (106.0 if link.via is None else 180.0) + blocked and draws[0] < crosswalks:
            # Well before the corner of a street that has one.
            where = 0.45 + 0.1 * draws[1] if link.via is None else 0.27
            first, second = split(line, where * length(line))
            busy = CLASSES[link.street_class].lanes > 1
            middle = Node(f"{name}m", first[-1], draws[2] < (0.7 if busy else 0.25))
            nodes[middle.id] = middle
            zebras[middle.id].append((f"{name}a", f"-{name}a"))
            pieces = [(f"{name}a", tail, middle, first), (f"{name}b", middle, head, second)]
        else:
            pieces = [(name, tail, head, line)]
        for piece, start, end, shape in pieces:
            edges.append(Edge(piece, start.id, end.id, link.street_class, shape))
            edges.append(Edge(f"-{piece}", end.id, start.id, link.street_class, shape[::-1]))
        for piece, start, end, _ in pieces:
            for node in (start, end):
                if node in (tail, head):
                    zebras[node.id].append((piece, f"-{piece}"))
    return CityPlan(
        tuple(nodes.values()),
        tuple(edges),
        tuple(Zebra(node, pair) for node in nodes for pair in zebras[node]),
        tuple(rings),
        signal_rng,
    )


def _line(draft: _Draft, link: _Link, a: Point, b: Point) -> Line:
    """The centre line between the points where the street starts and ends, a roundabout's rim included."""
    leave, arrive = draft.leaving(link, link.a), draft.leaving(link, link.b) + math.pi
    if link.via is not None:
        return corner(a, draft.at[link.via], b, 32.0)
    if link.turns == (0.0, 0.0):
        return straight(a, b)
    return bend(a, b, leave, arrive)

"""Plan a city from a seed: a jittered lattice with removed and bent streets, roundabouts and
crosswalks.

The plan is geometry and topology; `sumo_nets.city.store` builds a net from it. A street class and
its widths are constant along a row or column of the lattice. Units are metres, x east, y north; the
city fills the square from (0, 0) to (size_m, size_m).
"""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cosim.core.errors import MapError, unknown
from cosim.spec.scenario import CITY_SIZE_M
from sumo_nets.city.blocks import CLASSES
from sumo_nets.city.plan import Cell, CityPlan, Draft, Link, plan_of

_SIZE_M = (CITY_SIZE_M.low, CITY_SIZE_M.high)
"""Smallest and largest side length of a city, metres."""
PITCH_M = (102.0, 126.0)
"""Range of the distance between parallel streets, metres."""
_MARGIN_M = 22.0
"""Distance of the outermost streets from the city's border, metres."""
ROUNDABOUT_BLOCKS = 70
"""Number of blocks per roundabout, at most."""
CLEAR_RAD = math.radians(58.0)
"""Smallest angle between two arms of a junction, radians."""


class _Style(NamedTuple):
    """Average shares of the elements of a city.

    classes: weight of each street class.
    """

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
    "mixed": _Style(MIXED, 0.25, 0.13, 0.04, 0.45, 0.35, 0.10, 0.12, 0.25),
    "downtown": _Style(DOWNTOWN, 0.10, 0.08, 0.02, 0.15, 0.08, 0.03, 0.05, 0.35),
    "suburb": _Style(SUBURB, 0.28, 0.18, 0.05, 0.55, 0.55, 0.15, 0.15, 0.15),
}

PURPOSES = (
    "character",
    "lattice",
    "classes",
    "widths",
    "diagonals",
    "removal",
    "shapes",
    "roundabouts",
    "crosswalks",
    "lights",
    "driveways",
    "signals",
)
"""Purposes with a random generator each, in the order of their seeds."""


def plan_city(seed: int, size_m: float, style: str) -> CityPlan:
    """Plan a city; equal arguments give equal plans, bit for bit. Raises MapError for invalid
    arguments."""
    if style not in STYLES:
        raise unknown("city style", style, STYLES)
    if not _SIZE_M[0] <= size_m <= _SIZE_M[1]:
        raise MapError(
            f"a city's size_m must be in [{_SIZE_M[0]:g}, {_SIZE_M[1]:g}], not {size_m:g}"
        )
    if seed < 0:
        raise MapError(f"a city's seed cannot be negative: {seed}")
    entropy = (seed, round(size_m * 100), sorted(STYLES).index(style))
    seeds = np.random.SeedSequence(entropy).spawn(len(PURPOSES))
    rngs = {purpose: np.random.default_rng(s) for purpose, s in zip(PURPOSES, seeds, strict=True)}
    shares, pitch_m = _character(rngs["character"], STYLES[style])
    draft = _lattice(rngs["lattice"], rngs["classes"], rngs["widths"], size_m, pitch_m, shares)
    _diagonals(draft, rngs["diagonals"], shares.diagonals)
    _remove_streets(draft, rngs["removal"], shares.removed)
    _join_at_two_arms(draft)
    _bend_streets(draft, rngs["shapes"], shares)
    _place_roundabouts(draft, rngs["roundabouts"], shares.roundabouts)
    return plan_of(draft, rngs, shares.crosswalks)


def _character(rng: np.random.Generator, style: _Style) -> tuple[_Style, float]:
    """Draw the shares and the street distance of one city of a style, so that cities differ as a
    whole."""
    classes = {
        name: weight * float(rng.uniform(0.4, 1.6)) for name, weight in style.classes.items()
    }
    shares = [share * float(rng.uniform(0.6, 1.4)) for share in style[2:]]
    jitter = style.jitter * float(rng.uniform(0.5, 1.1))
    return _Style(classes, jitter, *shares), float(rng.uniform(*PITCH_M))


def _lattice(
    rng: np.random.Generator,
    class_rng: np.random.Generator,
    width_rng: np.random.Generator,
    size_m: float,
    pitch_m: float,
    style: _Style,
) -> Draft:
    cells = max(2, round((size_m - 2.0 * _MARGIN_M) / pitch_m))
    xs, ys = (_positions(rng, cells, size_m) for _ in range(2))
    sway = style.jitter * (min(b - a for line in (xs, ys) for a, b in pairwise(line)) - 55.0)
    wave_x, wave_y = (_Wave.draw(rng, size_m) for _ in range(2))
    at: dict[Cell, tuple[float, float]] = {}
    for i, x in enumerate(xs):
        for j, y in enumerate(ys):
            dx, dy = (float(d) for d in rng.uniform(-sway, sway, 2))
            # The border stays straight enough to remain inside the square.
            dx, dy = dx * (0.3 if i in (0, cells) else 1.0), dy * (0.3 if j in (0, cells) else 1.0)
            at[i, j] = (x + dx + wave_x.shift(x, y, size_m), y + dy + wave_y.shift(y, x, size_m))
    names = list(style.classes)
    weights = np.array(list(style.classes.values()))
    rows, columns = (
        class_rng.choice(names, cells + 1, p=weights / weights.sum()).tolist() for _ in range(2)
    )
    across, along = (
        [CLASSES[name].section(width_rng) for name in line] for line in (rows, columns)
    )
    links = [
        Link((i, j), (i + 1, j), rows[j], across[j]) for i in range(cells) for j in range(cells + 1)
    ]
    links += [
        Link((i, j), (i, j + 1), columns[i], along[i])
        for i in range(cells + 1)
        for j in range(cells)
    ]
    return Draft(at, links)


def _positions(rng: np.random.Generator, cells: int, size_m: float) -> list[float]:
    """Return the unevenly spaced positions of rows or columns, with room for every block."""
    pitch = (size_m - 2.0 * _MARGIN_M) / cells
    loose = max(0.0, 0.6 * (pitch - 75.0))
    gaps = [pitch + float(rng.uniform(-loose, loose)) for _ in range(cells)]
    scale = (size_m - 2.0 * _MARGIN_M) / sum(gaps)
    return [_MARGIN_M + scale * sum(gaps[:k]) for k in range(cells + 1)]


class _Wave(NamedTuple):
    """A slow bend of the whole lattice, zero at the city's border."""

    height_m: float
    length_m: float
    phase_rad: float

    @classmethod
    def draw(cls, rng: np.random.Generator, size_m: float) -> _Wave:
        length_m = float(rng.uniform(0.6, 1.2)) * size_m
        return cls(
            length_m * float(rng.uniform(0.0, 0.03)),
            length_m,
            float(rng.uniform(0.0, 2.0 * math.pi)),
        )

    def shift(self, along_m: float, across_m: float, size_m: float) -> float:
        """Return the displacement of a point along one axis, metres."""
        inside = math.sin(math.pi * (along_m - _MARGIN_M) / (size_m - 2.0 * _MARGIN_M))
        return (
            self.height_m
            * inside
            * math.sin(2.0 * math.pi * across_m / self.length_m + self.phase_rad)
        )


def _diagonals(draft: Draft, rng: np.random.Generator, share: float) -> None:
    """Replace two opposite sides of some blocks by one diagonal street, which creates Y
    junctions."""
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
            if {link.a, link.b} <= corners
            and (link.a[1] == link.b[1] if across else link.a[0] == link.b[0])
        ]
        remaining = [link for link in draft.links if link not in dropped]
        for degrees in (14.0, 20.0, 26.0):
            turn = math.radians(degrees if rising != across else -degrees)
            slant = Link(a, b, dropped[0].street_class, dropped[0].section, turns=(turn, turn))
            trial = Draft(draft.at, [*remaining, slant])
            arms = trial.arms()
            if min(trial.gap(a, arms[a]), trial.gap(b, arms[b])) >= CLEAR_RAD:
                draft.links = trial.links
                taken |= corners
                break


def _remove_streets(draft: Draft, rng: np.random.Generator, share: float) -> None:
    """Remove a share of the streets without disconnecting the network or creating dead ends."""
    neighbours: dict[Cell, set[Cell]] = defaultdict(set)
    for link in draft.links:
        neighbours[link.a].add(link.b)
        neighbours[link.b].add(link.a)
    slanting = {end for link in draft.links if link.turns != (0.0, 0.0) for end in (link.a, link.b)}
    wanted = round(share * len(draft.links))
    removed: set[tuple[Cell, Cell]] = set()
    for k in rng.permutation(len(draft.links)).tolist():
        if len(removed) == wanted:
            break
        link = draft.links[k]
        ends = (link.a, link.b)
        thin = [end for end in ends if len(neighbours[end]) == 3]
        if link.turns != (0.0, 0.0) or any(len(neighbours[end]) < 3 for end in ends):
            continue
        # Points with two arms make one longer street: rare, and never two in a row.
        if (
            any(len(neighbours[near]) < 3 for end in thin for near in neighbours[end])
            or len(thin) == 2
        ):
            continue
        if thin and (slanting & set(thin) or rng.random() > 0.3):
            continue
        neighbours[link.a].discard(link.b)
        neighbours[link.b].discard(link.a)
        if _is_connected(neighbours, link.a, link.b):
            removed.add(ends)
        else:
            neighbours[link.a].add(link.b)
            neighbours[link.b].add(link.a)
    draft.links = [link for link in draft.links if (link.a, link.b) not in removed]


def _is_connected(neighbours: dict[Cell, set[Cell]], start: Cell, goal: Cell) -> bool:
    seen = {start}
    queue = [start]
    while queue:
        cell = queue.pop()
        if cell == goal:
            return True
        new = neighbours[cell] - seen
        seen |= new
        queue += sorted(new)
    return False


def _join_at_two_arms(draft: Draft) -> None:
    """Join the two streets at every point with two arms into one with a rounded corner."""
    for cell, arms in draft.arms().items():
        if len(arms) != 2:
            continue
        one, two = arms
        if not (one.plain and two.plain):
            continue
        a = one.a if one.b == cell else one.b
        b = two.a if two.b == cell else two.b
        draft.links[draft.links.index(one)] = Link(a, b, one.street_class, one.section, via=cell)
        draft.links.remove(two)


def _bend_streets(draft: Draft, rng: np.random.Generator, style: _Style) -> None:
    """Create Y junctions, curves and S-bends where all angles between arms remain wide."""
    arms = draft.arms()
    for cell, own in arms.items():
        if rng.random() > style.ys or len(own) != 3 or draft.on_border(cell):
            continue
        headings = sorted(
            (draft.leaving(link, cell) % (2.0 * math.pi), i) for i, link in enumerate(own)
        )
        gaps = [(headings[(k + 1) % 3][0] - headings[k][0]) % (2.0 * math.pi) for k in range(3)]
        k = max(range(3), key=lambda i: gaps[i])
        fold = min((gaps[k] - 2.0 * math.pi / 3.0) / 2.0, math.radians(28.0))
        # Only the two arms next to the widest gap turn into it.
        _turn(draft, arms, own[headings[k][1]], cell, fold)
        _turn(draft, arms, own[headings[(k + 1) % 3][1]], cell, -fold)
    middle = max(draft.at)[0] / 2.0
    for link in draft.links:
        draw = rng.random()
        side = 1.0 if rng.integers(2) else -1.0
        if draft.on_border(link.a, link.b):
            # Bend towards the middle of the city, to remain inside its square.
            (x, y) = link.a
            (p, q) = link.b
            side = math.copysign(1.0, ((p - x) * (middle - y) - (q - y) * (middle - x)))
            draw = draw if draw < style.curves else 1.0
        turn = side * math.radians(rng.uniform(18.0, 42.0))
        if not link.plain or draw > style.curves + style.s_bends:
            continue
        for factor in (1.0, 0.75, 0.5):
            link.turns = (factor * turn, factor * turn * (-1.0 if draw < style.curves else 1.0))
            if min(draft.gap(end, arms[end]) for end in (link.a, link.b)) >= CLEAR_RAD:
                break
            link.turns = (0.0, 0.0)


def _turn(draft: Draft, arms: dict[Cell, list[Link]], link: Link, cell: Cell, turn: float) -> None:
    if link.via is not None:
        return
    before = link.turns
    end = 0 if link.a == cell else 1
    link.turns = (before[0] + turn, before[1]) if end == 0 else (before[0], before[1] + turn)
    if abs(link.turns[end]) > math.radians(40.0) or draft.gap(cell, arms[cell]) < CLEAR_RAD:
        link.turns = before


def _place_roundabouts(draft: Draft, rng: np.random.Generator, share: float) -> None:
    """Choose the radii of roundabouts at interior junctions of quiet streets, far enough from each
    other.

    A large city has a minimum number of them, where there is room.
    """
    last = max(draft.at)[0]
    arms = draft.arms()
    spare: dict[Cell, float] = {}
    for cell, own in arms.items():
        radius = float(rng.uniform(19.0, 22.0))
        draw = rng.random()
        if len(own) < 3 or {0, last} & set(cell):
            continue
        near = {end for link in own for end in (link.a, link.b)}
        quiet = all(
            CLASSES[link.street_class].lanes == 1 and draft.chord(link) > 85.0 for link in own
        )
        if quiet and not near & set(draft.rings) and draft.gap(cell, own) > math.radians(74.0):
            (spare if draw > share else draft.rings)[cell] = radius
    for cell, radius in spare.items():
        near = {end for link in arms[cell] for end in (link.a, link.b)}
        if len(draft.rings) < last * last // ROUNDABOUT_BLOCKS and not near & set(draft.rings):
            draft.rings[cell] = radius

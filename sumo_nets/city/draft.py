"""A city while it is drawn: lattice points, the streets between them, roundabouts. Metres and
radians."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from sumo_nets.city.blocks import Point, Section, direction

Cell = tuple[int, int]
"""Column and row of a lattice point."""


@dataclass(slots=True)
class Link:
    """A street between lattice points. turns: left turn off the chord at either end; via: a rounded
    corner."""

    a: Cell
    b: Cell
    street_class: str
    section: Section
    via: Cell | None = None
    turns: tuple[float, float] = (0.0, 0.0)

    @property
    def plain(self) -> bool:
        """Whether it runs straight so far."""
        return self.via is None and self.turns == (0.0, 0.0)


@dataclass(slots=True)
class Draft:
    """at: the lattice points. rings: radius of the roundabout at a point."""

    at: dict[Cell, Point]
    links: list[Link]
    rings: dict[Cell, float] = field(default_factory=dict)

    def arms(self) -> dict[Cell, list[Link]]:
        """The streets at each point."""
        arms: dict[Cell, list[Link]] = {cell: [] for cell in self.at}
        for link in self.links:
            arms[link.a].append(link)
            arms[link.b].append(link)
        return arms

    def leaving(self, link: Link, cell: Cell) -> float:
        """Heading with which `link` leaves the point of `cell`."""
        far = link.b if cell == link.a else link.a
        chord = direction(self.at[cell], self.at[far if link.via is None else link.via])
        return chord + link.turns[0 if cell == link.a else 1]

    def gap(self, cell: Cell, arms: list[Link]) -> float:
        """Smallest angle between two arms."""
        headings = sorted(self.leaving(link, cell) % (2.0 * math.pi) for link in arms)
        around = [*headings[1:], headings[0] + 2.0 * math.pi]
        return min(b - a for a, b in zip(headings, around, strict=True))

    def on_border(self, *cells: Cell) -> bool:
        """Whether all cells lie on one side of the lattice."""
        last = max(self.at)[0]
        return any(
            {cell[axis] for cell in cells} == {side} for axis in (0, 1) for side in (0, last)
        )

    def chord(self, link: Link) -> float:
        """Distance between the ends of a street."""
        return math.dist(self.at[link.a], self.at[link.b])

"""Entrances: who came into a simulated street, when and where, and who was taken out; kept, and
done again.

A street that is simulated a second time with something changed in it would soon have other people:
who enters depends on who is missing. With the first one's entrances done again both have the same
people and vehicles, from the same places, at the same times, and each of them can be compared with
itself.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, NamedTuple

from cosim.core.state import Age
from sumo_nets.crowd.proxy import KEEP_ROUTE, MATCH_M

if TYPE_CHECKING:  # a street that goes by itself does without SUMO
    from sumo_nets.engine import Sumo


class PersonEntry(NamedTuple):
    """A person sets out: on an edge, so far from its start, on a walk that ends so far on its last
    edge; at `xy`, m."""

    name: str
    edge: str
    at_m: float
    walk: tuple[str, ...]
    until_m: float
    mps: float
    xy: tuple[float, float]
    angle_deg: float

    def enter(self, engine: Sumo) -> None:
        """SUMO lets everybody enter on the right edge of the way; the move spreads them over its
        width."""
        engine.person.add(self.name, self.edge, self.at_m)
        engine.person.appendWalkingStage(self.name, list(self.walk), self.until_m, speed=self.mps)
        engine.person.moveToXY(self.name, "", *self.xy, self.angle_deg, KEEP_ROUTE, MATCH_M)


class VehicleEntry(NamedTuple):
    """A vehicle of a kind sets out on a route, so far from the start of its first edge."""

    name: str
    kind: str
    route: tuple[str, ...]
    at_m: float

    def enter(self, engine: Sumo) -> None:
        engine.route.add(self.name, list(self.route))
        engine.vehicle.add(
            self.name, self.name, typeID=self.kind, departLane="best", departPos=f"{self.at_m:.2f}"
        )


class Entrances:
    """Who came and went, in order, by the simulated time in seconds: entries, and the names of
    those taken out.

    ages: of the people, by name.
    """

    def __init__(self) -> None:
        self.ages: dict[str, Age] = {}
        self.people: dict[float, list[PersonEntry | str]] = defaultdict(list)
        self.vehicles: dict[float, list[VehicleEntry | str]] = defaultdict(list)

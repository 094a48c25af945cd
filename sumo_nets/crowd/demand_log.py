"""Records of entries and exits in a simulated street, for replay.

Entries depend on the persons present, so a second simulation with a change would soon differ in its
crowd. With replayed entries both runs have the same people and vehicles at the same times and
places, and each can be compared with itself.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, NamedTuple

from cosim.core.state import Age
from sumo_nets.crowd.proxy import KEEP_ROUTE, MATCH_M

if TYPE_CHECKING:  # an EmptyStreet does not need SUMO
    from sumo_nets.engine import Sumo


class PersonEntry(NamedTuple):
    """Entry of a person.

    edge, at_m: start edge and the distance from its start, metres.
    walk: edges of the walk.
    until_m: distance on the last edge at which the walk ends, metres.
    mps: walking speed, m/s.
    xy: start position, metres.
    angle_deg: SUMO's angle, degrees.
    gap_m: distance that the person keeps to people ahead, from front to back, metres.
    """

    name: str
    edge: str
    at_m: float
    walk: tuple[str, ...]
    until_m: float
    mps: float
    xy: tuple[float, float]
    angle_deg: float
    gap_m: float

    def enter(self, engine: Sumo) -> None:
        """Add the person to SUMO. SUMO starts everybody at the right edge, so the person is
        moved to `xy`."""
        engine.person.add(self.name, self.edge, self.at_m)
        engine.person.appendWalkingStage(self.name, list(self.walk), self.until_m, speed=self.mps)
        engine.person.moveToXY(self.name, "", *self.xy, self.angle_deg, KEEP_ROUTE, MATCH_M)


class VehicleEntry(NamedTuple):
    """Entry of a vehicle on a route, `at_m` metres from the start of its first edge."""

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
    """Entries, and names at exits, of persons and vehicles, in order, by simulated time in seconds.

    ages: ages of the persons, by name.
    """

    def __init__(self) -> None:
        self.ages: dict[str, Age] = {}
        self.people: dict[float, list[PersonEntry | str]] = defaultdict(list)
        self.vehicles: dict[float, list[VehicleEntry | str]] = defaultdict(list)

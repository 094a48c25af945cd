"""A street once more: the people and vehicles of a simulated street, let in and out again as they
were."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import groupby

import numpy as np

from cosim.place.street_map import Port, StreetMap
from cosim.spec.scenario import CrowdSpec
from sumo_nets.crowd.demand import VEHICLE_TYPES, Drivers, Pedestrians, Seen
from sumo_nets.crowd.demand_log import Entrances, PersonEntry
from sumo_nets.crowd.group_cohesion import Together
from sumo_nets.engine import Sumo


def replayed_demand(
    engine: Sumo,
    before: Entrances,
    street_map: StreetMap,
    spec: CrowdSpec,
    closed: frozenset[Port],
    together: Together,
) -> tuple[PedestriansAgain, DriversAgain]:
    """Those who let the same people and vehicles in and out at the same moments. They draw
    nothing."""
    nothing = np.random.default_rng(0)
    people = PedestriansAgain(engine, before, street_map, spec, nothing, closed, together)
    return people, DriversAgain(engine, before, street_map, spec, nothing)


class PedestriansAgain(Pedestrians):
    """People who enter and leave as they did before; who set out at one moment on one walk at one
    speed are a group."""

    def fill(self, x_m: float, y_m: float) -> None:
        self._again()

    def roll(
        self, x_m: float, y_m: float, seen: Mapping[str, Seen], at_red: Callable[[str], bool]
    ) -> None:
        self._together.forget(self._engine.person.getIDList())
        self._together.keep(seen)
        self._again()

    def _again(self) -> None:
        here = set(self._engine.person.getIDList())
        came = []
        for one in self._entrances.people.get(self._engine.simulation.getTime(), ()):
            if isinstance(one, PersonEntry):
                one.enter(self._engine)
                came.append(one)
            elif one in here:
                self._engine.person.remove(one)
        for (walk, mps), group in groupby(came, key=lambda one: (one.walk, one.mps)):
            self._together.join([one.name for one in group], mps, walk)


class DriversAgain(Drivers):
    """Vehicles that enter and leave as they did before."""

    def fill(self, x_m: float, y_m: float) -> None:
        self._again()

    def roll(self, x_m: float, y_m: float, seen: Mapping[str, Seen]) -> None:
        self._again()

    def _again(self) -> None:
        here = set(self._engine.vehicle.getIDList())
        for one in self._entrances.vehicles.get(self._engine.simulation.getTime(), ()):
            if not isinstance(one, str):
                one.enter(self._engine)
                self._size[one.name] = VEHICLE_TYPES[one.kind][:2]
            elif one in here:
                self._engine.vehicle.remove(one)

"""A street once more: the people and vehicles of a simulated street, let in and out again as they were."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from typing import Any

import libsumo
import numpy as np

from cosim.place.street_map import Port, StreetMap
from cosim.spec.scenario import CrowdSpec
from sumo_nets.crowd.demand import VEHICLE_TYPES, Drivers, Pedestrians
from sumo_nets.crowd.demand_log import ADDS, DRIVERS, PEDESTRIANS, Entrances, again
from sumo_nets.crowd.group_cohesion import Together


def replayed_demand(
    before: Entrances, street_map: StreetMap, spec: CrowdSpec, closed: frozenset[Port], together: Together
) -> tuple[PedestriansAgain, DriversAgain]:
    """Those who let the same people and vehicles in and out at the same moments. They draw nothing."""
    nothing = np.random.default_rng(0)
    people = PedestriansAgain(libsumo, street_map, spec, nothing, closed, together)
    drivers = DriversAgain(libsumo, street_map, spec, nothing)
    people.before = drivers.before = before
    people.ages = before.ages
    drivers.sizes = {
        str(call.arguments[0]): VEHICLE_TYPES[call.options["typeID"]][:2]
        for call in before.of(DRIVERS, ADDS)
        if call.domain == "vehicle"
    }
    return people, drivers


class PedestriansAgain(Pedestrians):
    """People who enter and leave as they did before; who set out at one moment on one walk at one speed are a group."""

    before: Entrances

    def fill(self, x_m: float, y_m: float) -> None:
        self._again()

    def roll(self, x_m: float, y_m: float, seen: Any, at_red: Any) -> None:
        self._together.forget(libsumo.person.getIDList())
        self._together.keep(seen)
        self._again()

    def _again(self) -> None:
        again(libsumo, self.before, PEDESTRIANS)
        calls = self.before.at(PEDESTRIANS, libsumo.simulation.getTime())
        walks = (call for call in calls if call.name == "appendWalkingStage")
        for (walk, mps), company in groupby(walks, key=lambda call: (call.arguments[1], call.options["speed"])):
            self._together.join([call.arguments[0] for call in company], mps, walk)


class DriversAgain(Drivers):
    """Vehicles that enter and leave as they did before. sizes: of each, length and width in metres."""

    before: Entrances
    sizes: Mapping[str, tuple[float, float]]

    def size_m(self, name: str) -> tuple[float, float]:
        return self.sizes[name]

    def fill(self, x_m: float, y_m: float) -> None:
        again(libsumo, self.before, DRIVERS)

    def roll(self, x_m: float, y_m: float, seen: Any) -> None:
        again(libsumo, self.before, DRIVERS)

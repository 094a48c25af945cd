"""A street once more: the people and vehicles of a simulated street, let in and out again as they were."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

import libsumo
import numpy as np

from cosim.place.street_map import Port, StreetMap
from cosim.spec.scenario import Scenario
from sumo_nets.crowd.crowd import DRIVERS, PEDESTRIANS, SumoCrowd
from sumo_nets.crowd.demand import VEHICLE_TYPES, Drivers, Pedestrians
from sumo_nets.crowd.demand_log import ADDS, Entrances, again


class StreetAgain(SumoCrowd):
    """The street of a scenario with the `before` entrances in place of drawn ones."""

    def __init__(self, net_path: Path, street_map: StreetMap, scenario: Scenario, before: Entrances) -> None:
        closed = frozenset(Port(barrier.strip, barrier.end) for barrier in scenario.barriers)
        super().__init__(net_path, street_map, scenario.crowd, scenario.seed, closed, scenario.start[:2])
        self._before = before

    def _demand(
        self, rng_persons: np.random.Generator, rng_vehicles: np.random.Generator
    ) -> tuple[Pedestrians, Drivers]:
        people = PedestriansAgain(libsumo, self._map, self._spec, rng_persons, self._closed, self._together)
        drivers = DriversAgain(libsumo, self._map, self._spec, rng_vehicles)
        people.before = drivers.before = self._before
        drivers.sizes = {
            str(call.arguments[0]): VEHICLE_TYPES[call.options["typeID"]][:2]
            for call in self._before.of(DRIVERS, ADDS)
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

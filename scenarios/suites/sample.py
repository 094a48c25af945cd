"""Draw suites of routes on any known map from a seed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from cosim.core.errors import MapError, SpecError, unknown
from cosim.place.street_map import StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventKinds
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import CityMap, Place, Scenario, Suite
from scenarios.events import EVENT_KINDS
from scenarios.places.nets import place
from scenarios.suites import long_horizon, reactive
from scenarios.suites.drawing import passable
from scenarios.suites.unit import STRUCTURES, build_unit
from sumo_nets.maps.place_names import resolve_place

_KINDS = ("long-horizon", "reactive", "unit")


def suite_on_map(
    kind: str,
    called: str,
    seed: int,
    count: int | None,
    roughness: float = 0.0,
    events: Sequence[str] = (),
    kinds: EventKinds = EVENT_KINDS,
    robot: Robot = COURIER,
) -> Suite:
    """Draw a suite on a place; the same arguments and net give the same suite.

    count: of long-horizon scenarios, 1 by default; of reactive and unit ones, whose events and
        structures take turns, one of each by default.
    events: which of them. Those for which the place has no room are left out, and the description
        says so, unless they were asked for.
    roughness: of the ground, from 0 (flat) to 1.
    kinds: table of events.
    robot: robot for which the ways are wide enough.

    Fewer people walk where sidewalks are few or narrow, and none in groups: a robot could not pass.
    Long routes prefer wide sidewalks: see `passable` and `build_long_horizon`.

    Raises UsageError for another kind of suite, and the errors of the place and the builder.
    """
    if kind not in _KINDS:
        raise unknown("suite for --map", kind, _KINDS)
    for event in events:
        if event not in kinds:
            raise unknown("event", event, kinds)
    where = resolve_place(called, roughness)
    _, street_map = place(where)
    name = where.map if isinstance(where, CityMap) else where.name
    drawn = _Drawn(where, street_map, WalkGraph(street_map), name, seed, kinds, robot)
    if kind == "long-horizon":
        scenarios, left_out = drawn.long(count or 1)
    elif kind == "unit":
        scenarios, left_out = drawn.unit(count)
    else:
        scenarios, left_out = drawn.reactive(count, events)
    return Suite(
        name=kind,
        version=f"map-{name}-{seed}" + (f"-rough{roughness:g}" if roughness else ""),
        scenarios=tuple(passable(scenario, street_map, robot) for scenario in scenarios),
        description=f"Drawn on {name}. {' '.join(left_out)}".strip(),
    )


class _Drawn(NamedTuple):
    """Inputs from which scenarios are drawn. seed: of the first scenario."""

    where: Place
    street_map: StreetMap
    graph: WalkGraph
    name: str
    seed: int
    kinds: EventKinds
    robot: Robot

    def long(self, count: int) -> tuple[list[Scenario], list[str]]:
        """Draw `count` long-horizon scenarios; the list of sentences is empty."""
        seeds = range(self.seed, self.seed + count)
        ids = [f"{self.name}-{seed:03d}" for seed in seeds]
        build = partial(
            long_horizon.build_long_horizon, self.where, self.street_map, self.graph, roomy=True
        )
        return [
            build(seed, name, self.robot, self.kinds) for seed, name in zip(seeds, ids, strict=True)
        ], []

    def reactive(self, count: int | None, asked: Sequence[str]) -> tuple[list[Scenario], list[str]]:
        """Draw `count` reactive scenarios, whose events take turns.

        Returns the scenarios, and a sentence for each event without room.
        """
        names = [name for name in self.kinds if name in asked or not asked]
        return self._in_turn("reactive", names, self._reactive, count, bool(asked))

    def unit(self, count: int | None) -> tuple[list[Scenario], list[str]]:
        """Draw `count` unit scenarios, whose structures take turns.

        Returns the scenarios, and a sentence for each structure without room.
        """
        return self._in_turn("unit", STRUCTURES, self._unit, count, False)

    def _in_turn(
        self,
        suite: str,
        names: Sequence[str],
        one: Callable[[str, int], Scenario],
        count: int | None,
        asked: bool,
    ) -> tuple[list[Scenario], list[str]]:
        left = list(names)
        found: list[Scenario] = []
        left_out: list[str] = []
        for seed in itertools.count(self.seed):
            for name in list(left):
                try:
                    found.append(one(name, seed))
                except (SpecError, MapError) as refusal:
                    if asked:
                        raise
                    left.remove(name)
                    left_out.append(f"No '{name}': {refusal}.")
                if count is not None and len(found) == count:
                    return found, left_out
            if count is None or not left:
                break
        if not found:
            raise SpecError(f"no {suite} scenario fits on '{self.name}': {' '.join(left_out)}")
        return found, left_out

    def _unit(self, structure: str, seed: int) -> Scenario:
        scenario_id = f"{structure}-{self.name}-{seed:03d}"
        return build_unit(
            structure,  # type: ignore[arg-type]
            self.where,
            self.street_map,
            self.graph,
            seed,
            scenario_id,
            self.robot,
        )

    def _reactive(self, event: str, seed: int) -> Scenario:
        scenario_id = f"{event}-{self.name}-{seed:03d}"
        return reactive.build_reactive(
            self.kinds[event],
            self.where,
            self.street_map,
            self.graph,
            seed,
            scenario_id,
            self.robot,
        )

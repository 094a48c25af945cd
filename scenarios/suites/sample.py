"""Draw suites of routes on any known map from a seed."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

from cosim.core.errors import MapError, SpecError, unknown
from cosim.place.street_map import StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventKind, EventKinds
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import CityMap, Place, Scenario, Suite
from scenarios.events import EVENT_KINDS
from scenarios.places.nets import place
from scenarios.suites import long_horizon, reactive
from scenarios.suites.drawing import passable
from sumo_nets.maps.place_names import resolve_place

_KINDS = ("long-horizon", "reactive")


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

    count: of long-horizon scenarios, 1 by default; of reactive ones, whose events take turns, one
    of each by default. events: which of them; those for which the place has no room are left out,
    and the description says so, unless they were asked for. Where sidewalks are few or narrow,
    fewer people walk, and none in groups; long routes prefer wide sidewalks: see `passable` and
    `build_long_horizon`. roughness: of the ground, from 0 (flat) to 1. kinds: the table of events
    that there are. robot: which one the ways are wide enough for.

    Fewer people walk where sidewalks are few or narrow, and none in groups: a robot could not pass.

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
    scenarios, left_out = (
        drawn.long(count or 1) if kind == "long-horizon" else drawn.reactive(count, events)
    )
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
        kinds = [kind for kind in self.kinds.values() if kind.name in asked or not asked]
        found: list[Scenario] = []
        left_out: list[str] = []
        for seed in itertools.count(self.seed):
            for kind in list(kinds):
                try:
                    found.append(self._one(kind, seed))
                except (SpecError, MapError) as refusal:
                    if asked:
                        raise
                    kinds.remove(kind)
                    left_out.append(f"No '{kind.name}': {refusal}.")
                if count is not None and len(found) == count:
                    return found, left_out
            if count is None or not kinds:
                break
        if not found:
            raise SpecError(f"no reactive scenario fits on '{self.name}': {' '.join(left_out)}")
        return found, left_out

    def _one(self, kind: EventKind, seed: int) -> Scenario:
        scenario_id = f"{kind.name}-{self.name}-{seed:03d}"
        return reactive.build_reactive(
            kind, self.where, self.street_map, self.graph, seed, scenario_id, self.robot
        )

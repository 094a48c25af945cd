"""Draw suites of routes on any known map from a seed."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple, cast

import msgspec

from cosim.core.errors import MapError, SpecError, UsageError, unknown
from cosim.place.street_map import StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventKinds
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import CityMap, Place, Scenario, Suite
from cosim.spec.selection import select_scenarios
from scenarios.events import EVENT_KINDS
from scenarios.places.nets import place
from scenarios.suites import long_horizon, reactive, unit
from scenarios.suites.drawing import passable
from scenarios.suites.unit import STRUCTURES
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

    count: of long-horizon scenarios, 1 by default; of reactive and unit ones, whose events or
        structures take turns, one of each by default.
    roughness: of the ground, from 0 (flat) to 1.
    events: draw only these. Without them, an event or structure for which the place has no room is
        left out, and the description says so.
    kinds: table of the existing events.
    robot: robot for which the ways are wide enough.

    Where sidewalks are few or narrow, fewer people walk, and none in groups: a robot could not
    pass. Long routes prefer wide sidewalks (`build_long_horizon`).

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
        scenarios, left_out = drawn.long(count or 1), list[str]()
    elif kind == "reactive":
        scenarios, left_out = drawn.in_turns(kind, kinds, drawn.event, count, events)
    else:
        scenarios, left_out = drawn.in_turns(kind, STRUCTURES, drawn.unit, count)
    return Suite(
        name=kind,
        version=f"map-{name}-{seed}" + (f"-rough{roughness:g}" if roughness else ""),
        scenarios=tuple(passable(scenario, street_map, robot) for scenario in scenarios),
        description=f"Drawn on {name}. {' '.join(left_out)}".strip(),
    )


def drawn_on_map(scenario_id: str, called: str, robot: Robot = COURIER) -> Suite:
    """Draw the scenario with an id of `suite_on_map` again: the suite with it alone.

    Raises UsageError for an id that is not drawn on this place, and the errors of `suite_on_map`.
    """
    where = resolve_place(called)
    name = where.map if isinstance(where, CityMap) else where.name
    of_place = re.fullmatch(rf"(?:(\w+)-)?{re.escape(name)}-(\d{{3,}})", scenario_id)
    what, seed = of_place.groups() if of_place else ("", "0")
    if of_place is None or not (what is None or what in EVENT_KINDS or what in STRUCTURES):
        raise UsageError(
            f"scenario '{scenario_id}' is none of map '{name}': its scenarios are called "
            f"EVENT-{name}-SEED, STRUCTURE-{name}-SEED and {name}-SEED, such as "
            f"straight-{name}-000"
        )
    if what in EVENT_KINDS:
        return suite_on_map("reactive", called, int(seed), 1, events=(what,), robot=robot)
    if what is None:
        return suite_on_map("long-horizon", called, int(seed), 1, robot=robot)
    drawn = suite_on_map("unit", called, int(seed), None, robot=robot)
    return msgspec.structs.replace(drawn, scenarios=select_scenarios(drawn, [scenario_id]))


class _Drawn(NamedTuple):
    """Inputs from which scenarios are drawn. seed: of the first scenario."""

    where: Place
    street_map: StreetMap
    graph: WalkGraph
    name: str
    seed: int
    kinds: EventKinds
    robot: Robot

    def long(self, count: int) -> list[Scenario]:
        """Draw `count` long-horizon scenarios."""
        seeds = range(self.seed, self.seed + count)
        ids = [f"{self.name}-{seed:03d}" for seed in seeds]
        build = partial(
            long_horizon.build_long_horizon, self.where, self.street_map, self.graph, roomy=True
        )
        return [
            build(seed, name, self.robot, self.kinds) for seed, name in zip(seeds, ids, strict=True)
        ]

    def in_turns(
        self,
        suite: str,
        names: Iterable[str],
        draw: Callable[[str, int], Scenario],
        count: int | None,
        required: Sequence[str] = (),
    ) -> tuple[list[Scenario], list[str]]:
        """Draw `count` scenarios by name, which take turns.

        required: only these names, each of which must have room.
        Returns the scenarios, and a sentence for each name without room.
        """
        left = [name for name in names if name in required or not required]
        found: list[Scenario] = []
        left_out: list[str] = []
        for seed in itertools.count(self.seed):
            for name in list(left):
                try:
                    found.append(draw(name, seed))
                except (SpecError, MapError) as refusal:
                    if required:
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

    def event(self, kind: str, seed: int) -> Scenario:
        """Draw a reactive scenario with an event of a kind."""
        return reactive.build_reactive(
            self.kinds[kind],
            self.where,
            self.street_map,
            self.graph,
            seed,
            f"{kind}-{self.name}-{seed:03d}",
            self.robot,
        )

    def unit(self, structure: str, seed: int) -> Scenario:
        """Draw a unit scenario of a structure."""
        return unit.build_unit(
            cast(unit.Structure, structure),
            self.where,
            self.street_map,
            self.graph,
            seed,
            f"{structure}-{self.name}-{seed:03d}",
            self.robot,
        )

"""New scenarios like those of the suites, drawn in generated cities that no suite uses."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final

import msgspec
import numpy as np

from cosim.core.errors import CosimError, UsageError, unknown
from cosim.core.progress import Progress, ignore
from cosim.spec.scenario import City, Scenario
from cosim.spec.selection import STATIC
from scenarios.events import EVENT_KINDS
from scenarios.ipc.parallel_map import parallel_map
from scenarios.suites.decoys import DECOY, decoy_of, paced
from scenarios.suites.recipes import LONG_WAY, Slot, candidate, repeated
from scenarios.suites.unit import STRUCTURES
from sumo_nets.city.store import SEEDS

_DRAWING: Final = "drawing scenarios"
_STRUCTURES: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "unit": STRUCTURES,
        "reactive": (*EVENT_KINDS, STATIC),
        "long-horizon": (LONG_WAY,),
    }
)
"""Structures of the suites that can be drawn again."""
_ROUTE_M: Final = (80.0, 200.0)
"""Shortest and longest drawn route, in metres."""
_MAX_SEED: Final = 2**31 - 1


class NewScenarios(msgspec.Struct, frozen=True, kw_only=True):
    """Endless sequence of scenarios.

    kind: suite that they resemble.
    structures: values of `structure`, which take turns; one with "-decoy" is the decoy of the
        scenario before it.
    seeds: seeds of the cities, which take turns after the structures.
    size_m: side of each city, in metres.
    """

    kind: str
    structures: tuple[str, ...]
    seeds: tuple[int, ...]
    size_m: float = 2000.0

    def drawn(
        self, first: int, count: int, jobs: int = 1, progress: Progress = ignore
    ) -> list[Scenario]:
        """Draw `count` scenarios from number `first` on; those without room in their city are left
        out.

        They are drawn city by city, by `jobs` processes; the result does not depend on `jobs`.
        Raises MachineError if a process is killed.
        """
        by_city: dict[int, list[int]] = {}
        for number in range(first, first + count):
            by_city.setdefault(number // len(self.structures) % len(self.seeds), []).append(number)
        found: dict[int, Scenario] = {}
        numbers = list(by_city.values())
        for drawn in parallel_map(self._in_city, numbers, jobs, progress, _DRAWING):
            found |= drawn
        return [found[number] for number in sorted(found)]

    def _in_city(self, numbers: Sequence[int]) -> dict[int, Scenario]:
        found = {}
        for number in numbers:
            try:
                found[number] = self._one(number)
            except CosimError:
                continue
        return found

    def _one(self, number: int) -> Scenario:
        """Draw scenario `number`. Raises CosimError if it has no room."""
        turn, structure = divmod(number, len(self.structures))
        again, city = divmod(turn, len(self.seeds))
        called, seed = self.structures[structure], self.seeds[city]
        if called.endswith(DECOY):
            return paced(decoy_of(self._one(number - 1)))
        length_m = np.random.default_rng([number, 0x1E46]).uniform(*_ROUTE_M)
        slot = Slot(
            name=f"{called}-{seed}-{again:03d}",
            suite=self.kind,
            structure=called,
            where=City(seed=seed, size_m=self.size_m),
            split="val",
            number=number,
            length_m=round(length_m, 1) if called == LONG_WAY else 0.0,
        )
        if called != STATIC:
            return paced(candidate(slot, again))
        return repeated(slot, candidate(replace(slot, structure=next(iter(EVENT_KINDS))), again))


def new_cities(words: str) -> tuple[int, ...]:
    """Return the seeds of a range such as "900:940", 900 to 939.

    Raises UsageError for cities that a suite uses.
    """
    found = re.fullmatch(r"([0-9]{1,10}):([0-9]{1,10})", words, re.ASCII)
    first, end = (int(part) for part in found.groups()) if found else (0, 0)
    if not first < end <= _MAX_SEED or end - first > 10_000:
        raise UsageError(
            f"--cities {words}: give FIRST:END, such as 900:940 for the 40 cities from 900 to 939"
        )
    if used := sorted({*SEEDS} & {*range(first, end)}):
        named = f"{used[0]}" if len(used) == 1 else f"{used[0]} to {used[-1]}"
        raise UsageError(
            f"--cities {words}: the suites use {named}, and a policy that has learnt there has "
            "seen where it is measured: choose others, such as 900:940"
        )
    return tuple(range(first, end))


def new_scenarios(
    kind: str,
    seeds: tuple[int, ...],
    structures: Sequence[str] = (),
    size_m: float = 2000.0,
    decoys: bool = False,
) -> NewScenarios:
    """Return new scenarios like those of a suite.

    structures: only these.
    decoys: whether each event is followed by its decoy.

    Raises UsageError with the valid names.
    """
    if kind not in _STRUCTURES:
        raise unknown("suite for --cities", kind, _STRUCTURES)
    there = _STRUCTURES[kind]
    for name in structures:
        if name not in there:
            raise unknown(f"structure of '{kind}'", name, there)
    picked = tuple(name for name in there if name in structures or not structures)
    if decoys:
        picked = tuple(
            one for name in picked for one in (name, name + DECOY)[: 1 + (name in EVENT_KINDS)]
        )
    return NewScenarios(kind=kind, structures=picked, seeds=seeds, size_m=size_m)

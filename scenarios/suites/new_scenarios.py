"""New scenarios like those of the suites, drawn in generated cities that no suite uses."""

from __future__ import annotations

import re
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing import get_context
from typing import Final

import msgspec

from cosim.core.errors import CosimError, MachineError, UsageError, unknown
from cosim.core.progress import Progress, ignore
from cosim.spec.scenario import City, Scenario
from cosim.spec.selection import STATIC
from scenarios.events import EVENT_KINDS
from scenarios.suites.recipes import Slot, candidate, repeated
from scenarios.suites.unit import STRUCTURES
from sumo_nets.city.store import SEEDS

_DRAWING: Final = "drawing scenarios"
_KINDS: Final = ("unit", "reactive")
_MOST_SEED: Final = 2**31 - 1


class Fresh(msgspec.Struct, frozen=True, kw_only=True):
    """Endless sequence of scenarios.

    kind: suite that they resemble.
    structures: values of `structure`, which take turns.
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
        """Draw `count` scenarios from number `first` on, without those that have no room in their
        city.

        They are drawn city by city, by `jobs` processes; the result does not depend on `jobs`.
        Raises MachineError if a process is killed.
        """
        by_city: dict[int, list[int]] = {}
        for number in range(first, first + count):
            by_city.setdefault(number // len(self.structures) % len(self.seeds), []).append(number)
        found: dict[int, Scenario] = {}
        with ExitStack() as stack:
            if min(jobs, len(by_city)) > 1:
                pool = ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_deaf_to_ctrl_c)
                stack.callback(pool.shutdown, cancel_futures=True)
                drawn = pool.map(self._in_city, by_city.values())
            else:
                drawn = map(self._in_city, by_city.values())
            for done in range(len(by_city)):
                progress(_DRAWING, done / len(by_city))
                try:
                    found |= next(drawn)
                except BrokenProcessPool as error:
                    raise MachineError(
                        "a process that drew scenarios was ended: is there enough memory?"
                    ) from error
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
        slot = Slot(
            name=f"{called}-{seed}-{again:03d}",
            suite=self.kind,
            structure=called,
            where=City(seed=seed, size_m=self.size_m),
            split="val",
            number=number,
        )
        if called != STATIC:
            return candidate(slot, again)
        return repeated(slot, candidate(replace(slot, structure=next(iter(EVENT_KINDS))), again))


def fresh_cities(words: str) -> tuple[int, ...]:
    """Return the seeds of a range such as "900:940", 900 to 939.

    Raises UsageError for cities that a suite uses.
    """
    found = re.fullmatch(r"([0-9]{1,10}):([0-9]{1,10})", words, re.ASCII)
    first, end = (int(part) for part in found.groups()) if found else (0, 0)
    if not first < end <= _MOST_SEED or end - first > 10_000:
        raise UsageError(
            f"--cities {words}: give FIRST:END, such as 900:940 for the 40 cities from 900 to 939"
        )
    if used := sorted({*SEEDS} & {*range(first, end)}):
        named = f"{used[0]}" if len(used) == 1 else f"{used[0]} to {used[-1]}"
        raise UsageError(
            f"--cities {words}: the suites use {named}, and a policy that has learnt there has "
            "seen where it is measured: take others, such as 900:940"
        )
    return tuple(range(first, end))


def fresh(
    kind: str, seeds: tuple[int, ...], structures: Sequence[str] = (), size_m: float = 2000.0
) -> Fresh:
    """Return new scenarios like those of a suite.

    structures: only these. Raises UsageError with the valid names.
    """
    if kind not in _KINDS:
        raise unknown("suite for --cities", kind, _KINDS)
    there = STRUCTURES if kind == "unit" else (*EVENT_KINDS, STATIC)
    for name in structures:
        if name not in there:
            raise unknown(f"structure of '{kind}'", name, there)
    picked = tuple(name for name in there if name in structures or not structures)
    return Fresh(kind=kind, structures=picked, seeds=seeds, size_m=size_m)


def _deaf_to_ctrl_c() -> None:
    """Ignore Ctrl-C in this process; its parent ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

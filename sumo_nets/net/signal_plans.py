"""Signal plans: the states of crossings over time, for signals with fixed programs.

A plan is built only if the program runs by the clock, all its elements are known and its durations
are whole steps of SUMO. Other signals are read from SUMO at run time.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from cosim.core.clock import Clock
from cosim.place.street_map import SignalPlan

_LOGIC: Final = frozenset(("id", "type", "programID", "offset"))
_PHASE: Final = frozenset(("duration", "state", "name"))
_SECONDS: Final = re.compile(r"(-?\d{1,9})(?:\.(\d{1,3}))?")
GREEN_LETTERS: Final = frozenset("Gg")
"""Letters of signal states in which a link may go."""
WALK_MPS: Final = 1.2
"""Walking speed for the required length of a green, m/s."""
REACTION_S: Final = 4.0
"""Latest start within a green for which it must suffice, seconds."""
_OFF: Final = "off"
_ROUNDING_S: Final = 1e-6


@dataclass(slots=True)
class SignalPrograms:
    """Traffic light elements of a net, collected one by one.

    others: whether the net has elements that switch programs.
    """

    logics: list[Mapping[str, str]] = field(default_factory=list)
    phases: list[list[Mapping[str, str]]] = field(default_factory=list)
    plain: list[bool] = field(default_factory=list)
    others: bool = False

    def add(self, tag: str, parent: str, attributes: Mapping[str, str]) -> None:
        """Add the next element of the net.

        parent: tag of the enclosing element.
        """
        if tag == "tlLogic":
            self.logics.append(attributes)
            self.phases.append([])
            self.plain.append(attributes.keys() <= _LOGIC)
        elif parent == "tlLogic" and tag == "phase":
            self.phases[-1].append(attributes)
        elif parent == "tlLogic":
            self.plain[-1] = False
        elif tag.startswith("WAUT"):
            self.others = True

    def plans(
        self, links: Sequence[Mapping[str, str]], crossings: Iterable[str]
    ) -> dict[str, SignalPlan]:
        """Return the plans of those crossings that have one.

        links: connections to the crossings.
        """
        names = [logic.get("id", "") for logic in self.logics]
        often = Counter(names)
        fixed = {} if self.others else {name: k for k, name in enumerate(names) if often[name] == 1}
        wanted = frozenset(crossings)
        first = dict[str, tuple[str, int]]()
        for link in links:
            if (to := link.get("to", "")) in wanted and "tl" in link:
                index = link.get("linkIndex", "")
                controlled = link["tl"], int(index) if index.isdecimal() else -1
                first[to] = min(first.get(to, controlled), controlled)
        plans = {
            to: self._plan(fixed[light], index)
            for to, (light, index) in first.items()
            if light in fixed
        }
        return {to: plan for to, plan in plans.items() if plan is not None}

    def _plan(self, k: int, index: int) -> SignalPlan | None:
        logic, phases = self.logics[k], self.phases[k]
        offset_ms = _ms(logic.get("offset", "0"))
        durations_ms = [ms for phase in phases if (ms := _ms(phase.get("duration", "")))]
        plain = self.plain[k] and logic.get("type") == "static" and logic.get("programID") != _OFF
        plain = plain and all(
            phase.keys() <= _PHASE and 0 <= index < len(phase.get("state", "")) for phase in phases
        )
        if not plain or not phases or offset_ms is None or len(durations_ms) < len(phases):
            return None
        return SignalPlan(
            offset_ms,
            tuple(durations_ms),
            tuple(phase["state"][index] in GREEN_LETTERS for phase in phases),
        )

    def short_greens(
        self, links: Sequence[Mapping[str, str]], lengths_m: Mapping[str, float]
    ) -> frozenset[str]:
        """Return those crossings that have a green too short to walk.

        links: connections to the crossings.
        lengths_m: lengths of the crossings, metres.
        """
        programs: dict[str, list[list[Mapping[str, str]]]] = {}
        for logic, phases in zip(self.logics, self.phases, strict=True):
            programs.setdefault(logic.get("id", ""), []).append(phases)
        return frozenset(
            to
            for link in links
            if (to := link.get("to", "")) in lengths_m
            and (index := link.get("linkIndex", "")).isdecimal()
            and any(
                green_s < required_green_s(lengths_m[to]) - _ROUNDING_S
                for phases in programs.get(link.get("tl", ""), ())
                for green_s in _greens_s(phases, int(index))
            )
        )


def required_green_s(length_m: float) -> float:
    """Return the seconds of green that a crossing of this length needs."""
    return length_m / WALK_MPS + REACTION_S


def greens(states: Sequence[str], link: int) -> list[list[int]]:
    """Return the phases of each green of a link, in cyclic order; empty for permanent green."""
    shown = [link < len(state) and state[link] in GREEN_LETTERS for state in states]
    if all(shown):
        return []
    runs: list[list[int]] = []
    first = shown.index(False)
    for k in range(first, first + len(shown)):
        if shown[k % len(shown)]:
            if not shown[(k - 1) % len(shown)]:
                runs.append([])
            runs[-1].append(k % len(shown))
    return runs


def _greens_s(phases: Sequence[Mapping[str, str]], link: int) -> list[float]:
    """Return the duration of each green of a link, seconds; empty if durations are no numbers."""
    try:
        durations_s = [float(phase.get("duration", "")) for phase in phases]
    except ValueError:
        return []
    runs = greens([phase.get("state", "") for phase in phases], link)
    return [sum(durations_s[p] for p in run) for run in runs]


def _ms(seconds: str) -> int | None:
    """Convert seconds to milliseconds, SUMO's unit; None if not a plain number or not whole
    steps."""
    found = _SECONDS.fullmatch(seconds)
    ms = int(found[1] + (found[2] or "").ljust(3, "0")) if found is not None else 1
    return ms if ms % Clock().tick_ms == 0 else None

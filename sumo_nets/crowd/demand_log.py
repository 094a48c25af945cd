"""Entrances: who came into a simulated street, when and where, and who was taken out; kept, and done again.

A street that is simulated a second time with something changed in it would soon have other people: who enters depends
on who is missing. With the first one's entrances done again both have the same people and vehicles, from the same
places, at the same times, and each of them can be compared with itself.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from cosim.core.state import Age

READS: Final = ("get", "subscribe")
"""Calls of SUMO that begin so change nothing."""
_KEPT: Final = ("person", "vehicle", "route")
ADDS: Final = "add"
PEDESTRIANS: Final = "pedestrians"
DRIVERS: Final = "drivers"


class Call(NamedTuple):
    """A call of SUMO: domain and name of the function, and its arguments; the first is whom it is about."""

    domain: str
    name: str
    arguments: tuple[Any, ...]
    options: Mapping[str, Any]


class Entrances:
    """The calls by which people and vehicles were let in and out, in order, by the simulated time in seconds.

    ages: of the people, by name.
    """

    def __init__(self) -> None:
        self.ages: dict[str, Age] = {}
        self._calls: dict[tuple[str, float], list[Call]] = defaultdict(list)

    def keep(self, whose: str, time_s: float, call: Call) -> None:
        """Remember a call made at a time. whose: who made it."""
        self._calls[whose, time_s].append(call)

    def at(self, whose: str, time_s: float) -> list[Call]:
        """The calls made by somebody at a time, in order."""
        return self._calls.get((whose, time_s), [])

    def of(self, whose: str, name: str) -> list[Call]:
        """All calls of a function made by somebody."""
        return [call for (who, _), calls in self._calls.items() if who == whose for call in calls if call.name == name]


class Kept:
    """SUMO as it is, but for remembering in `entrances` what `whose` changes of persons, vehicles and routes."""

    def __init__(self, engine: Any, entrances: Entrances, whose: str) -> None:
        self._engine, self._entrances, self._whose = engine, entrances, whose
        for domain in _KEPT:
            setattr(self, domain, _KeptDomain(self, domain, getattr(engine, domain)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def remember(self, call: Call) -> None:
        self._entrances.keep(self._whose, self._engine.simulation.getTime(), call)


class _KeptDomain:
    """One domain of SUMO's functions."""

    def __init__(self, kept: Kept, domain: str, functions: Any) -> None:
        self._kept, self._domain, self._functions = kept, domain, functions

    def __getattr__(self, name: str) -> Callable[..., Any]:
        function: Callable[..., Any] = getattr(self._functions, name)
        if name.startswith(READS):
            return function

        def remembered(*arguments: Any, **options: Any) -> Any:
            self._kept.remember(Call(self._domain, name, arguments, options))
            return function(*arguments, **options)

        return remembered


def again(engine: Any, entrances: Entrances, whose: str) -> None:
    """Make the calls that somebody made at this time. What is about one who is not there any more is left out."""
    domains = {name: getattr(engine, name) for name in _KEPT}
    calls = entrances.at(whose, engine.simulation.getTime())
    if not calls:
        return
    here = {name: set(domains[name].getIDList()) for name in _KEPT}
    for call in calls:
        name = str(call.arguments[0])
        if call.name == ADDS:
            here[call.domain].add(name)
        elif name not in here[call.domain]:
            continue
        getattr(domains[call.domain], call.name)(*call.arguments, **call.options)

"""Which failures stand in the gallery: few enough to draw, all runs, structures, events, causes,
real places."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from typing import Final, NamedTuple

from cosim.core.clock import Clock
from cosim.report.page.reasons import Mishap, event_of, mishaps_of
from cosim.report.page.runs import ReportedRun, example_of, place_in_words, table_of_paper
from cosim.spec.scenario import CityMap

MOST_FAILURES: Final = 48
LEAST_FAILURES: Final = 36
"""So many, if there are, also where fewer show everything."""
_START_S: Final = 15.0
"""To start an episode and draw a failure takes about as long as to simulate so much."""
_MOST_S: Final = 600.0
"""So many seconds are simulated again in all."""
WITHIN_S: Final = 150.0
"""Of an episode failures later than this are not shown where an earlier one is: to come there takes
long."""
_ENOUGH_ALIKE: Final = 30
"""Of failures with the same facets so many are looked at, the earliest."""
_OF_AN_EPISODE: Final = 40
"""Later failures of one long way are not looked at: to come there takes long."""


class FailureToShow(NamedTuple):
    """A failure that may be shown. run: its number; event: of its event, "" without; facets: what
    it is an example of; place: where."""

    run: int
    scenario: str
    mishap: Mishap
    event: str
    facets: frozenset[Hashable]
    place: str


def shown_of(runs: Sequence[ReportedRun]) -> list[FailureToShow]:
    """Every failure that can be shown again: of episodes that came to their end."""
    found = []
    for number, run in enumerate(runs):
        for record in run.records:
            if record.status != "done" or record.ended is None:
                continue
            scenario = run.scenarios[record.scenario.id]
            family, kind = table_of_paper(scenario), example_of(scenario)
            for mishap in mishaps_of(record)[:_OF_AN_EPISODE]:
                event = event_of(scenario, mishap)
                facets: set[Hashable] = {
                    (run.label, family, kind),
                    (run.label, family, mishap.cause),
                }
                if event is not None:
                    facets.add((run.label, family, "event", event.kind))
                if isinstance(scenario.place, CityMap):
                    facets.add(scenario.place.map)
                words = "" if event is None else event.kind
                where = place_in_words(scenario)
                found.append(
                    FailureToShow(
                        number, record.scenario.id, mishap, words, frozenset(facets), where
                    )
                )
    return found


class Chosen(NamedTuple):
    """The failures to show, and the limit that left others out, in words; "" where all are
    shown."""

    picks: list[FailureToShow]
    limit: str


def most_telling(
    candidates: Sequence[FailureToShow], most: int = MOST_FAILURES, within_s: float = WITHIN_S
) -> Chosen:
    """The most telling ones, the most telling first: each adds as many facets as it can for the
    time that it takes to come there, then a new episode and a new place. Stops when there is
    nothing new, but not below LEAST_FAILURES; what would take longer than _MOST_S in all is left
    out, and so are failures later than within_s of their episode, but for its first."""
    alike: Counter[frozenset[Hashable]] = Counter()
    left: list[FailureToShow] = []
    begun: set[tuple[int, str]] = set()
    for one in sorted(candidates, key=lambda one: (one.mishap.tick, one.scenario, one.run)):
        soon = (one.run, one.scenario) not in begun or Clock().time_s(one.mishap.tick) <= within_s
        begun.add((one.run, one.scenario))
        alike[one.facets] += soon
        if soon and alike[one.facets] <= _ENOUGH_ALIKE:
            left.append(one)
    choice = _Choice()
    limit = ""
    while left and not limit:
        best = max(left, key=choice.worth)
        if len(choice.picked) >= most:
            limit = f"--failures {most}"
        elif choice.further_s(best) > choice.room_s:
            limit = f"more than {_MOST_S:g} s would be simulated again"
        elif len(choice.picked) >= LEAST_FAILURES and not best.facets - choice.seen:
            limit = "the others show no other run, event, cause or place"
        else:
            choice.take(best)
            left.remove(best)
    if not limit and len(choice.picked) < len(candidates):
        limit = f"the others are alike, or later than --within {within_s:g} s"
    return Chosen(choice.picked, limit)


class _Choice:
    """What is taken so far. reached: of each episode, up to which second it is run again; room_s:
    what is left."""

    def __init__(self) -> None:
        self.picked: list[FailureToShow] = []
        self.seen: set[Hashable] = set()
        self.room_s = _MOST_S
        self._places: set[str] = set()
        self._reached: dict[tuple[int, str], float] = {}

    def further_s(self, one: FailureToShow) -> float:
        """How long its episode has to be simulated beyond what is taken already."""
        return max(
            Clock().time_s(one.mishap.tick) - self._reached.get((one.run, one.scenario), 0.0), 0.0
        )

    def worth(self, one: FailureToShow) -> tuple[bool, float, bool, bool]:
        """More is better: that there is room for it, new facets for its time, a new episode, a new
        place."""
        further_s = self.further_s(one)
        new_episode = (one.run, one.scenario) not in self._reached
        telling = len(one.facets - self.seen) / (_START_S + further_s)
        return further_s <= self.room_s, telling, new_episode, one.place not in self._places

    def take(self, one: FailureToShow) -> None:
        self.picked.append(one)
        self.seen |= one.facets
        self.room_s -= self.further_s(one)
        self._places.add(one.place)
        key = one.run, one.scenario
        self._reached[key] = max(self._reached.get(key, 0.0), Clock().time_s(one.mishap.tick))

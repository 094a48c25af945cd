"""Choice of the failures for the gallery: few, but covering runs, structures, events, causes and
places."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from typing import Final, NamedTuple

from cosim.core.clock import Clock
from cosim.report.page.reasons import Mishap, event_of, mishaps_of
from cosim.report.page.runs import ReportedRun, place_in_words, scenario_kind, table_of_paper
from cosim.spec.scenario import CityMap

MAX_FAILURES: Final = 48
MIN_FAILURES: Final = 36
"""Number of failures to show, if available, even without new facets."""
_START_S: Final = 15.0
"""Cost of starting an episode and drawing a failure, in seconds of simulation."""
_BUDGET_S: Final = 600.0
"""Budget of simulated time for all failures, seconds."""
WITHIN_S: Final = 150.0
"""Time in an episode, seconds, after which only its first failure is shown; replay is costly."""
_MAX_ALIKE: Final = 30
"""Maximum number of failures considered with the same facets, the earliest ones."""
_MAX_PER_EPISODE: Final = 40
"""Maximum number of failures considered per episode; later ones are costly to replay."""


class FailureToShow(NamedTuple):
    """Failure that may be shown.

    run: index of the run
    event: kind of its event, "" without one
    facets: categories that it is an example of
    """

    run: int
    scenario: str
    mishap: Mishap
    event: str
    facets: frozenset[Hashable]
    place: str


def showable_failures(runs: Sequence[ReportedRun]) -> list[FailureToShow]:
    """Return every failure that can be replayed: those of completed episodes."""
    found = []
    for number, run in enumerate(runs):
        for record in run.records:
            if record.status != "done" or record.ended is None:
                continue
            scenario = run.scenarios[record.scenario.id]
            family, kind = table_of_paper(scenario), scenario_kind(scenario)
            for mishap in mishaps_of(record)[:_MAX_PER_EPISODE]:
                event = event_of(scenario, mishap)
                facets: set[Hashable] = {
                    (run.label, family, kind),
                    (run.label, family, mishap.cause),
                }
                if event is not None:
                    facets.add((run.label, family, "event", event.kind))
                if isinstance(scenario.place, CityMap):
                    facets.add(scenario.place.map)
                event_kind = "" if event is None else event.kind
                place = place_in_words(scenario)
                found.append(
                    FailureToShow(
                        number, record.scenario.id, mishap, event_kind, frozenset(facets), place
                    )
                )
    return found


class FailureChoice(NamedTuple):
    """Failures to show, and the limit that excluded others, in words; "" if all are shown."""

    picks: list[FailureToShow]
    limit: str


def choose_failures(
    candidates: Sequence[FailureToShow], most: int = MAX_FAILURES, within_s: float = WITHIN_S
) -> FailureChoice:
    """Choose failures greedily, the most informative first.

    Each choice adds the most new facets per simulated time, then a new episode, then a new place.
    The choice ends without new facets, but not below MIN_FAILURES. It stays within _BUDGET_S of
    simulation. Failures later than within_s of their episode are skipped, except its first.
    """
    alike: Counter[frozenset[Hashable]] = Counter()
    left: list[FailureToShow] = []
    begun: set[tuple[int, str]] = set()
    for one in sorted(candidates, key=lambda one: (one.mishap.tick, one.scenario, one.run)):
        soon = (one.run, one.scenario) not in begun or Clock().time_s(one.mishap.tick) <= within_s
        begun.add((one.run, one.scenario))
        alike[one.facets] += soon
        if soon and alike[one.facets] <= _MAX_ALIKE:
            left.append(one)
    choice = _Choice()
    limit = ""
    while left and not limit:
        best = max(left, key=choice.worth)
        if len(choice.picked) >= most:
            limit = f"--failures {most}"
        elif choice.further_s(best) > choice.room_s:
            limit = f"more than {_BUDGET_S:g} s would be simulated again"
        elif len(choice.picked) >= MIN_FAILURES and not best.facets - choice.seen:
            limit = "the others show no other run, event, cause or place"
        else:
            choice.take(best)
            left.remove(best)
    if not limit and len(choice.picked) < len(candidates):
        limit = f"the others are alike, or later than --within {within_s:g} s"
    return FailureChoice(choice.picked, limit)


class _Choice:
    """Failures chosen so far. room_s: remaining simulation budget."""

    def __init__(self) -> None:
        self.picked: list[FailureToShow] = []
        self.seen: set[Hashable] = set()
        self.room_s = _BUDGET_S
        self._places: set[str] = set()
        self._reached: dict[tuple[int, str], float] = {}

    def further_s(self, one: FailureToShow) -> float:
        """Return the additional simulated time to reach a failure, seconds."""
        return max(
            Clock().time_s(one.mishap.tick) - self._reached.get((one.run, one.scenario), 0.0), 0.0
        )

    def worth(self, one: FailureToShow) -> tuple[bool, float, bool, bool]:
        """Return the sort key of a failure: fits the budget, new facets per time, new episode, new
        place."""
        further_s = self.further_s(one)
        new_episode = (one.run, one.scenario) not in self._reached
        telling = len(one.facets - self.seen) / (_START_S + further_s)
        return further_s <= self.room_s, telling, new_episode, one.place not in self._places

    def take(self, one: FailureToShow) -> None:
        """Add a failure to the choice."""
        self.picked.append(one)
        self.seen |= one.facets
        self.room_s -= self.further_s(one)
        self._places.add(one.place)
        key = one.run, one.scenario
        self._reached[key] = max(self._reached.get(key, 0.0), Clock().time_s(one.mishap.tick))

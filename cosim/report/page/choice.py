"""Which failures stand in the gallery: few enough to draw, all runs, structures, events, causes, real places."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Final, NamedTuple

from cosim.report.page.reasons import Mishap, event_of, mishaps_of
from cosim.report.page.runs import ReportedRun, example_of, place_in_words, table_of_paper
from cosim.spec.scenario import CityMap

MOST_FAILURES: Final = 48
LEAST_FAILURES: Final = 24
"""So many, if there are, also where fewer show everything."""
_OF_AN_EPISODE: Final = 40
"""Later failures of one long way are not looked at: to come there takes long."""


class FailureToShow(NamedTuple):
    """A failure that may be shown. run: its number; event: of its event, "" without; facets: what it is an example of;
    place: where."""

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
            scenario = run.scenarios[record.scenario]
            family, kind = table_of_paper(scenario), example_of(scenario)
            for mishap in mishaps_of(record)[:_OF_AN_EPISODE]:
                event = event_of(scenario, mishap)
                facets: set[Hashable] = {(run.label, family, kind), (run.label, family, mishap.cause)}
                if event is not None:
                    facets.add((run.label, family, "event", event.kind))
                if isinstance(scenario.place, CityMap):
                    facets.add(scenario.place.map)
                words = "" if event is None else event.kind
                found.append(
                    FailureToShow(number, record.scenario, mishap, words, frozenset(facets), place_in_words(scenario))
                )
    return found


def most_telling(candidates: Sequence[FailureToShow], most: int = MOST_FAILURES) -> list[FailureToShow]:
    """The most telling ones, the most telling first: each adds as many facets as it can, then a new place, and comes
    early in its episode. Stops when there is nothing new, but not below LEAST_FAILURES."""
    left = sorted(candidates, key=lambda one: (one.mishap.tick, one.scenario, one.run))
    picked: list[FailureToShow] = []
    seen: set[Hashable] = set()
    places: set[str] = set()
    episodes: set[tuple[int, str]] = set()
    while left and len(picked) < most:
        best = max(
            range(len(left)),
            key=lambda k: (
                len(left[k].facets - seen),
                (left[k].run, left[k].scenario) not in episodes,
                left[k].place not in places,
                -k,
            ),
        )
        if len(picked) >= min(LEAST_FAILURES, most) and not left[best].facets - seen:
            break
        one = left.pop(best)
        picked.append(one)
        seen |= one.facets
        places.add(one.place)
        episodes.add((one.run, one.scenario))
    return picked

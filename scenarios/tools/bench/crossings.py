"""Measures how a policy, the crowd and vehicles obey the lights of crossings: `cosim bench
crossings`.

Every crossing is an episode of its own with the real engines; each city has a process of its own,
because SUMO can end its process. Episodes that are not finished then count as crashed.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cache

import msgspec
import numpy as np

from cosim.core.child_process import exit_with_parent
from cosim.core.clock import Clock
from cosim.core.errors import SpecError
from cosim.core.progress import Progress
from cosim.episode.loop import Step
from cosim.episode.policy_caller import PolicyCaller
from cosim.people.yielding import ROBOT_STANDS_MPS
from cosim.place.walk_graph import WalkGraph
from cosim.policies.load import load_policy
from cosim.results.referee import Verdict
from cosim.spec.scenario import City, Scenario
from scenarios.episodes.run_episode import Outcome, run_episode
from scenarios.places.nets import place
from scenarios.suites.crossings import build_all
from scenarios.tools.bench.crowd import StreetCounter
from sumo_nets.crowd.stoplines import StopLines

_SIZE_M = 2000.0
"""Side of the cities, in metres; their seeds count from 1."""


class CrossingResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of driving over one crossing.

    ended: end of the episode; "crashed" if it did not reach one.
    waited_s: seconds that the robot waited at red.
    red_entries, vehicles_braked, carriageway_s: of the robot.
    failures: failures, with the kind of body in collisions.
    counts, at_red: of the surrounding street, see `StreetCounter`.
    entered: signalised crossings that a pedestrian entered.
    """

    scenario: str
    city: str
    crossing: str
    ended: str
    reason: str = ""
    waited_s: float = 0.0
    red_entries: int = 0
    vehicles_braked: int = 0
    carriageway_s: float = 0.0
    minutes: float = 0.0
    failures: tuple[str, ...] = ()
    counts: dict[str, float] = {}
    entered: tuple[str, ...] = ()
    at_red: tuple[str, ...] = ()


def cross_all(
    crossings: int, cities: int, policy: str, jobs: int, progress: Progress
) -> list[CrossingResult]:
    """Drive over crossings spread over cities, `jobs` cities at a time."""
    if cities > crossings:
        raise SpecError(
            f"{crossings} crossings cannot lie in {cities} cities: ask for fewer cities"
        )
    shares = [crossings // cities + (i < crossings % cities) for i in range(cities)]
    found: list[CrossingResult] = []

    def one(seed: int, count: int) -> None:
        for result in cross_city(City(seed=seed, size_m=_SIZE_M), count, policy):
            found.append(result)
            progress(f"driving: {len(found)} of {crossings} crossings")

    with ThreadPoolExecutor(jobs) as pool:
        try:
            for done in [pool.submit(one, 1 + i, count) for i, count in enumerate(shares)]:
                done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return sorted(found, key=lambda result: (result.city, result.scenario))


def cross_city(city: City, count: int, policy: str) -> Iterator[CrossingResult]:
    """Drive over crossings of one city, one after another, in a new process."""
    context = multiprocessing.get_context("spawn")
    names = [""] * count
    done = 0
    try:
        with ProcessPoolExecutor(
            1, context, initializer=exit_with_parent, initargs=(os.getpid(),)
        ) as alone:
            scenarios = alone.submit(_drawn, city, count).result()
            names = [scenario.id for scenario in scenarios]
            for scenario in scenarios:
                yield alone.submit(cross, scenario, policy).result()
                done += 1
    except BrokenProcessPool:
        for name in names[done:]:
            yield CrossingResult(
                scenario=name,
                city=city.name,
                crossing="",
                ended="crashed",
                reason="the process died",
            )


def _drawn(city: City, count: int) -> list[Scenario]:
    """Build crossings of a city."""
    _, street_map = place(city)
    return build_all(city, street_map, WalkGraph(street_map), 0, count)


@cache
def caller_of(policy: str) -> PolicyCaller:
    """Load the policy once for all crossings of this process."""
    return load_policy(policy)


def cross(scenario: Scenario, policy: str) -> CrossingResult:
    """Drive over one crossing, and count people and vehicles around it.

    A policy that raised is loaded again for the next crossing.
    """
    _, street_map = place(scenario.place)
    counter = StreetCounter(street_map, Clock().tick_s)
    lines = StopLines(Clock().tick_s)

    def watch(step: Step, verdict: Verdict) -> None:
        counter.update(step.street_after)
        counter.count_vehicles(lines.passed(step.street_after.vehicles.ids))

    outcome = run_episode(scenario, caller_of(policy), watches=[watch])
    if outcome.traceback:
        caller_of.cache_clear()
    return crossing_row(scenario, outcome, counter)


def crossing_row(scenario: Scenario, outcome: Outcome, counter: StreetCounter) -> CrossingResult:
    """Return an episode and the counts around it as a row."""
    record, log = outcome.record, outcome.log
    nothing = CrossingResult(
        scenario=scenario.id,
        city=scenario.place.name,
        crossing=scenario.crossings[0].id,
        ended="crashed",
        reason=record.reason,
    )
    if log is None:
        return nothing
    stood = log.waits_at_red & (np.abs(log.speed[:, 0]) < ROBOT_STANDS_MPS)
    return msgspec.structs.replace(
        nothing,
        ended=str(record.ended),
        waited_s=float(stood.sum()) * log.tick_s,
        red_entries=round(record.measures["red_light_entries"] or 0.0),
        vehicles_braked=round(record.measures["vehicles_braked"] or 0.0),
        carriageway_s=record.measures["carriageway_time_s"] or 0.0,
        minutes=len(log) * log.tick_s / 60.0,
        failures=tuple(f"{f.kind} {f.other_kind}".strip() for f in record.failures),
        counts=dict(counter.counts),
        entered=tuple(
            sorted(f"{scenario.place.name} {crossing}" for crossing in counter.crossings)
        ),
        at_red=tuple(counter.at_red),
    )


def crossings_entered(rows: Iterable[CrossingResult]) -> int:
    """Return how many different signalised crossings the crowd entered."""
    return len({crossing for row in rows for crossing in row.entered})

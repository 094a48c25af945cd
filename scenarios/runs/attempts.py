"""Queues the scenarios of a run, and counts their failed attempts."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import partial
from logging import WARNING
from typing import NamedTuple

from cosim.core.log_event import happened
from cosim.results.record import Status
from cosim.results.run_folder import FailedAttempt, RunFolder
from cosim.spec.episode_id import pseudonym_of
from cosim.spec.scenario import Scenario
from scenarios.ipc.faults import RULES, Failure


class GivenUp(NamedTuple):
    """The status and the reason of an episode after its last failed attempt."""

    status: Status
    reason: str


class AttemptQueue:
    """Holds the scenarios that wait to be run, in the order of their pseudonyms.

    A policy that counts its episodes thus does not learn which they are. Failed attempts are
    counted in the run folder, so that a resumed run continues the count.
    """

    def __init__(self, folder: RunFolder, scenarios: Sequence[Scenario]) -> None:
        self._folder = folder
        self._waiting = deque(sorted(scenarios, key=partial(pseudonym_of, folder.spec.setup.seed)))
        self._failed = folder.failed_attempts()

    def __len__(self) -> int:
        return len(self._waiting)

    def next(self) -> Scenario:
        """Remove the first scenario, and return it."""
        return self._waiting.popleft()

    def named(self, name: str) -> Scenario | None:
        """Return the scenario of this name if it waits."""
        return next((scenario for scenario in self._waiting if scenario.id == name), None)

    def remove(self, scenario: Scenario) -> None:
        """Remove a scenario that waits."""
        self._waiting.remove(scenario)

    def failed(self, scenario: Scenario, failure: Failure) -> GivenUp | None:
        """Queue a scenario again after a failed attempt; after the last one, return how it is
        recorded."""
        rule = RULES[failure.fault]
        if rule.attempts == 1:
            return GivenUp(rule.status, failure.why)
        attempt = FailedAttempt(scenario.id, failure.fault == "machine_lost")
        if rule.attempts is not None:
            self._failed[attempt] += 1
            self._folder.keep_failed_attempt(attempt)
            if self._failed[attempt] >= rule.attempts:
                times = f"{failure.why}, {rule.attempts} times; see logs/ in the run folder"
                return GivenUp(rule.status, times)
        facts = {"why": failure.why, "attempts": self._failed[attempt], "of": rule.attempts or 0}
        happened("retried", WARNING, scenario=scenario.id, **facts)
        self._waiting.appendleft(scenario)
        return None

"""Short scenarios that verify an installation, chosen from the shipped suites by one rule."""

from __future__ import annotations

from typing import Final

import msgspec

from cosim.spec.scenario import Scenario
from scenarios.suites.catalog import SUITES, load_suite

LASTS_S: Final = 10.0
"""Duration of a case, in seconds: the beginning of its scenario."""


def verified_cases() -> tuple[Scenario, ...]:
    """Return the first scenario of each structure, or kind of event, of the first suite with it.

    Scenarios with events are preferred. Each is cut to its first 10 seconds.

    >>> [case.id for case in verified_cases()][:4]
    ['straight-001', 'curve-001', 'crosswalk-001', 'obstructing-001']
    """
    cases: list[Scenario] = []
    for name in SUITES:
        scenarios = load_suite(name).scenarios
        wanted = [s for s in scenarios if s.events] or scenarios
        known = {case.structure for case in cases}
        first = {s.structure: s for s in reversed(wanted) if s.structure not in known}
        cases += [s for s in wanted if first.get(s.structure) is s]
    return tuple(msgspec.structs.replace(case, time_limit_s=LASTS_S) for case in cases)

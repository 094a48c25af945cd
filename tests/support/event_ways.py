"""Straight ways with one event in a small city, whose engines start fast."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from cosim.spec.scenario import Scenario
from scenarios.suites.user_scenarios.build import suite_of_own
from scenarios.suites.user_scenarios.read import read_own

_WAY = """
name = "way"
[place]
city = 1
size_m = 500
[way]
kind = "straight"
length_m = {length_m}
[[events]]
kind = "{kind}"
at_m = {at_m}
[limits]
time_s = {time_s}
ends_on_failure = true
ends_at = "{ends_at}"
"""


def event_way(
    kind: str,
    name: str,
    *,
    at_m: float,
    length_m: float = 20.0,
    time_s: float = 45.0,
    ends_at: str = "goal",
) -> Scenario:
    """Return a scenario that ends on a failure and whose event is `at_m` along its way."""
    text = _WAY.format(kind=kind, at_m=at_m, length_m=length_m, time_s=time_s, ends_at=ends_at)
    with TemporaryDirectory() as folder:
        path = Path(folder, "way.toml")
        path.write_text(text)
        (scenario,) = suite_of_own(read_own(path)).scenarios
    return msgspec.structs.replace(scenario, id=name, structure=kind)

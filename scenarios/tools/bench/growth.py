"""Whether what a process takes of memory grows from episode to episode."""

from __future__ import annotations

from typing import Final

from cosim.spec.scenario import Scenario
from scenarios.tools.bench.driving import FourHertz, own_memory_mib
from scenarios.tools.bench.figures import Figure

_SCENARIOS: Final = 20
_ROUNDS: Final = 10


def growing() -> list[Figure]:
    """A second of each of the same 20 scenarios in three cities, ten times over in this process."""
    from scenarios.suites.catalog import load_suite

    after = []
    for _ in range(_ROUNDS):
        for scenario in load_suite("reactive").scenarios[:_SCENARIOS]:
            _begin(scenario)
        after.append(own_memory_mib())
    first = after[0]
    last = after[-1]
    name = f"memory of its own after {_SCENARIOS * _ROUNDS} episodes, MiB"
    return [Figure(name, last, first, f"after {_SCENARIOS}", 1.05, reach_ratio=True)]


def _begin(scenario: Scenario) -> None:
    from scenarios.episodes.episode import Episode

    policy = FourHertz()
    with Episode(scenario, policy.manifest) as episode:
        observation = episode.reset()
        while not episode.over and episode.time_s < 1.0:
            observation = episode.advance(policy.act(observation))

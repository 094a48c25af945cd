"""Neither the arguments of a policy nor its process reveal the name of its scenario."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from cosim.results.run_folder import read_records
from cosim.spec.episode_id import episode_id_of
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Scenario, Suite
from scenarios.episodes.episode import Episode
from scenarios.runs import run as suite_run
from scenarios.suites.catalog import load_suite
from scenarios.tools.verify.doctor import small_scenario
from tests.support.cheats import Counter, NameReader
from tests.support.shared_policies import NOTES

pytestmark = pytest.mark.engine

BY = "gesturing-001"
"""A scenario that a blind policy solves if it knows which one it is: it has to stop in the right
place."""


def test_a_policy_that_knows_the_name_solves_the_scenario_and_a_run_hides_it() -> None:
    """With the name of its episode the name reader stops before the hand; in a run, which hides the
    name, it drives on."""
    (scenario,) = (one for one in load_suite("reactive").scenarios if one.id == BY)
    policy = NameReader()
    with Episode(scenario, policy.manifest) as episode:
        policy.reset(scenario.id, scenario.seed)
        observation = episode.reset()
        while not episode.over:
            observation = episode.advance(policy.act(observation))
    assert episode.result()[0].measures["success"] == 1.0
    table = suite_run.run("reactive", NameReader(), scenarios=[BY])
    assert list(table["success"]) == [0.0]


def test_counting_episodes_does_not_identify_them() -> None:
    """When a seed reverses the order of an event's first two scenarios, the counting policy takes
    each for the other."""
    first, second = (
        one
        for one in load_suite("reactive").scenarios
        if one.id in ("gesturing-001", "gesturing-002")
    )
    seed = next(
        seed for seed in range(100) if episode_id_of(seed, second) < episode_id_of(seed, first)
    )
    taken: list[tuple[str, str]] = []

    class RecordingCounter(Counter):
        def reset(self, episode_id: str, seed: int) -> None:
            super().reset(episode_id, seed)
            assert self.known is not None
            taken.append((episode_id, self.known.id))

    short = [msgspec.structs.replace(one, time_limit_s=0.5) for one in (first, second)]
    suite = Suite(name="two", version="1", scenarios=tuple(short))
    suite_run.run(suite, RecordingCounter(), options=EpisodeOptions(seed=seed))
    names = {episode_id_of(seed, one).episode: one.id for one in (first, second)}
    assert (
        [names[called] for called, _ in taken]
        == [second.id, first.id]
        != [guess for _, guess in taken]
    )


def test_nothing_that_a_policy_can_read_names_its_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Arguments of its calls, everything reachable from a privileged observation, and its process's
    arguments, environment, folder, files and threads contain no scenario, suite or event."""
    monkeypatch.setenv(NOTES, str(tmp_path / "notes"))
    short: Scenario = msgspec.structs.replace(
        small_scenario(), time_limit_s=0.5, suite="quagga-suite"
    )
    suite = Suite(
        name="quagga-run",
        version="1",
        scenarios=tuple(msgspec.structs.replace(short, id=f"quagga-{i}") for i in range(2)),
    )
    spy = "tests.support.shared_policies:Spy"
    suite_run.run(suite, spy, out=tmp_path / "run", options=EpisodeOptions(seed=3))
    read = (tmp_path / "notes").read_text()
    assert {one.status for one in read_records(tmp_path / "run")} == {"done"}
    assert (
        all(episode_id_of(3, one).episode in read for one in suite.scenarios) and "courier" in read
    )
    assert "quagga" not in read and not [event.kind for event in short.events if event.kind in read]

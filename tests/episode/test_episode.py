"""Episode: entered, driven period by period, and refused with a remedy when it is used out of
order."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from cosim.core.errors import EngineError, PolicyError, UsageError
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.episode.loop import Step
from cosim.results.referee import Verdict
from cosim.spec.camera import CameraSpec
from cosim.spec.episode_id import episode_id_of
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Scenario
from scenarios.episodes.episode import Episode
from scenarios.episodes.replay import RecordedEpisode, replay_state_hash
from scenarios.episodes.run_episode import run_episode
from scenarios.tools.verify.doctor import small_scenario
from tests.support.blind_policy import BEND, Blind

pytestmark = pytest.mark.engine

SEEING = Manifest("seeing", rate_hz=4.0, camera=CameraSpec(32, 24))
AHEAD = Command(0.8, 0.0)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """Two seconds of a long way in a small city."""
    return msgspec.structs.replace(small_scenario(), time_limit_s=2.0)


class Ahead:
    """Drives straight on."""

    manifest = SEEING

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: object) -> Command:
        return AHEAD


def test_an_episode_is_driven_by_hand_to_the_result_of_a_run(scenario: Scenario) -> None:
    """reset and advance give eight observations at 4 Hz, and then the record of the same run."""
    times = []
    with Episode(scenario, SEEING) as episode:
        observation = episode.reset()
        while not episode.over:
            times.append(observation.time_s)
            assert observation.rgb is not None and observation.rgb.shape == (24, 32, 3)
            assert observation.privileged is None
            observation = episode.advance(AHEAD)
        record, log = episode.result()
    assert times == [0.25 * k for k in range(8)]
    assert (record.ended, record.ticks, len(log), observation.time_s) == ("timeout", 40, 40, 2.0)
    assert episode.result()[0] is record
    assert run_episode(scenario, Ahead()).record.state_hash == record.state_hash


def test_waypoints_are_recorded_as_they_were_answered_and_the_record_replays(
    scenario: Scenario,
) -> None:
    """After a second of commands the trajectory has all waypoints with the followed one, and the
    replay has the same state hash."""
    result = run_episode(scenario, Blind())
    record, log = result.record, result.log
    assert log is not None and log.answers[:, 0].tolist() == [*range(0, 40, 4)]
    assert log.plan_sizes.tolist() == [0] * 5 + [8] * 5 and log.plan_index == 2
    assert np.array_equal(log.plan_points, np.tile(BEND.astype(np.float32), (5, 1)))
    assert log.command.tolist() == [[1.2, 0.0]] * 40
    assert replay_state_hash(RecordedEpisode(scenario, record, log)) == record.state_hash


def test_until_tick_stops_an_episode_within_a_period(scenario: Scenario) -> None:
    """until_tick ends a period early, and the next period ends where it would have ended."""
    with Episode(scenario, SEEING) as episode:
        episode.reset()
        assert episode.advance(AHEAD, until_tick=3).tick == 3
        assert episode.advance(AHEAD).tick == 5


def test_the_observation_after_a_teleport_has_reset_set() -> None:
    """Only the observation after the robot left its lane has `reset`; the first one has not."""
    blind = Manifest("blind", rate_hz=4.0, camera=None)
    put_back = []

    def watch(step: Step, verdict: Verdict) -> None:
        if verdict.reset is not None:
            put_back.append(step.tick)

    scenario = msgspec.structs.replace(small_scenario(), time_limit_s=12.0)
    with Episode(scenario, blind, watches=[watch]) as episode:
        seen = [episode.reset()]
        while not episode.over:
            seen.append(episode.advance(Command(1.5, 0.65)))
    assert put_back and not seen[0].reset
    assert [one.tick for one in seen if one.reset] == sorted(
        {5 * (tick // 5 + 1) for tick in put_back}
    )


def test_a_policy_gets_an_opaque_episode_name_and_a_seed(scenario: Scenario) -> None:
    """Both follow from the run's seed, are in every observation and the record, and do not change
    the street."""
    resets: list[tuple[str, int]] = []

    class Noting(Ahead):
        def reset(self, episode_id: str, seed: int) -> None:
            resets.append((episode_id, seed))

        def act(self, observation: Observation) -> Command:
            assert observation.episode == resets[-1][0]
            return AHEAD

    records = [run_episode(scenario, Noting(), EpisodeOptions(seed=seed)).record for seed in (1, 2)]
    assert resets == [episode_id_of(seed, scenario) for seed in (1, 2)] and resets[0] != resets[1]
    assert [(one.setup.seed, one.episode) for one in records] == [
        (1, resets[0][0]),
        (2, resets[1][0]),
    ]
    assert records[0].state_hash == records[1].state_hash


def test_an_episode_used_out_of_order_is_refused_with_the_remedy(scenario: Scenario) -> None:
    """Calls before entering, before reset, after the end or close, a second reset and a bad answer
    are refused."""
    episode = Episode(scenario, SEEING)
    with pytest.raises(UsageError, match="has not been entered: use it in a `with` block"):
        episode.reset()
    with episode:
        with pytest.raises(UsageError, match=r"has not begun: call reset\(\) first"):
            episode.advance(AHEAD)
        episode.reset()
        with pytest.raises(UsageError, match=r"has begun: .* make another Episode"):
            episode.reset()
        with pytest.raises(UsageError, match=r"is not over: advance\(\) it until"):
            episode.result()
        with pytest.raises(PolicyError, match="policy 'seeing' answered None"):
            episode.advance(None)
        with (
            pytest.raises(EngineError, match="already running in this process"),
            Episode(scenario, SEEING),
        ):
            pass
        while not episode.over:
            episode.advance(np.array([[0.2, 0.0]] * 3))
        with pytest.raises(UsageError, match=r"is over \(timeout\): ask for its result\(\)"):
            episode.advance(AHEAD)
    with pytest.raises(UsageError, match="is closed: make another"):
        episode.advance(AHEAD)
    with pytest.raises(UsageError, match="was used before"), episode:
        pass
    assert episode.result()[0].status == "done"

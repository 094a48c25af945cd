"""Latency: delayed commands, with a fixed delay and as measured in real time."""

from __future__ import annotations

import re
import time
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from cosim.cli.run_table import print_terms
from cosim.core.errors import UsageError
from cosim.core.geometry import Floats
from cosim.core.state import STILL, Command
from cosim.episode.command_delay import CommandDelay
from cosim.episode.interfaces import Observation
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.results.run_folder import read_records, read_spec
from cosim.results.table import table_of
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.run_config import RunConfig
from cosim.spec.scenario import Scenario, Suite, write_suite
from scenarios.episodes.replay import RecordedEpisode, replay_state_hash
from scenarios.episodes.run_episode import run_episode
from scenarios.runs import run as suite_run
from scenarios.runs.planning import check_real_time
from scenarios.suites.catalog import load_suite
from scenarios.tools.verify.doctor import small_scenario
from tests.cli.terminal.test_run_table import terminal
from tests.conftest import Cosim
from tests.run_specs import changed, record_of


def commands(answers: Floats, ticks: int) -> Floats:
    """Return (ticks, 2) the commands of an episode's answers tick by tick, without a reset."""
    in_effect = np.zeros((ticks, 2))
    for tick, delay, v_mps, w_radps in answers:
        in_effect[int(tick + delay) :] = v_mps, w_radps
    return in_effect


def test_delayed_commands_keep_their_order_and_a_reset_discards_them() -> None:
    """By hand: queries at 0, 5 and 10 with 7 ticks of delay, of which the last is pending at a
    reset."""
    way = CommandDelay()
    commands_sent = [Command(float(v), 0.0) for v in (1, 2, 3)]
    way.add(0, 7, commands_sent[0])
    assert [way.at(tick) for tick in (0, 4)] == [STILL, STILL]
    way.add(5, 7, commands_sent[1])
    assert [way.at(tick) for tick in (6, 7, 9)] == [STILL, commands_sent[0], commands_sent[0]]
    way.add(10, 7, commands_sent[2])
    assert [way.at(tick) for tick in (11, 12)] == [commands_sent[0], commands_sent[1]]
    way.on_reset()
    assert (way.at(13), way.at(17)) == (STILL, STILL)
    assert way.answers.tolist() == [[0, 7, 1, 0], [5, 7, 2, 0], [10, 7, 3, 0]]
    way.add(20, 0, commands_sent[0])
    assert way.at(20) == commands_sent[0]


@pytest.mark.parametrize(
    "latency_ms", [-1.0, float("nan"), 10_001.0], ids=["negative", "no number", "too much"]
)
def test_an_invalid_latency_is_refused(latency_ms: float) -> None:
    """The message has the range."""
    with pytest.raises(UsageError, match=r"latency_ms must be from 0 to 10000 ms, not"):
        EpisodeOptions(latency_ms=latency_ms)


def test_real_time_needs_one_process_and_no_latency() -> None:
    """Real time is refused with several processes, which would delay each other, and with a fixed
    latency."""
    with pytest.raises(UsageError, match="leave latency_ms out"):
        EpisodeOptions(latency_ms=50.0, real_time=True)
    for jobs, shared, named in ((2, False, "2 jobs"), (1, True, "a shared renderer")):
        check_real_time(EpisodeOptions(), jobs, shared)
        with pytest.raises(UsageError, match=f"{named} would be timed too: take one job"):
            check_real_time(EpisodeOptions(real_time=True), jobs, shared)


def test_tables_show_latency_only_where_there_is_any() -> None:
    """A fixed one is a number; a measured one has answer times and effective ticks of ended
    episodes, and its limits."""

    def printed_table(*records: Record) -> str:
        out, output = terminal()
        print_terms(out, table_of(records))
        return " ".join(output.getvalue().split())

    none = record_of(load_suite("reactive").scenarios[0], Manifest("m", camera=None))
    given = changed(none, latency_ms=200.0)
    crashed = changed(none, real_time=True)
    real = [
        changed(crashed, latency_ms=ms, ended="goal", clock={"answer_ms": took_ms})
        for ms, took_ms in ((50.0, 3.124), (50.0, 4.0), (400.0, 391.6))
    ]
    assert "latency" not in printed_table(none)
    assert "latency 200 ms: commands take effect so much later" in printed_table(given)
    assert (
        "in real time: the median answer took 4 ms (3.12 to 392 ms); commands took effect 50 "
        "ms (50 to 400 ms) "
        "after what they answer, at whole ticks of 50 ms" in printed_table(*real, crashed, crashed)
    )
    assert "no episode came to its end" in printed_table(crashed)
    assert "not to be had again from the seed" in printed_table(*real)


@pytest.mark.parametrize(
    "latency, real_time, expected",
    [
        ("soon", False, "--latency 'soon': give milliseconds, like 200, or 'measured'"),
        ("200", True, "--real-time measures the latency of every answer: leave --latency out"),
        ("-1", False, "--latency -1: milliseconds must be from 0 to 10000"),
        ("nan", False, "--latency nan: milliseconds must be from 0 to 10000"),
    ],
    ids=["a word", "both", "negative", "no number"],
)
def test_contradictory_latency_options_are_refused(
    latency: str, real_time: bool, expected: str
) -> None:
    """The options are named, with the remedy."""
    with pytest.raises(UsageError, match=re.escape(expected)):
        RunConfig(suite="reactive", latency=latency, real_time=real_time)


def small_scenario_of_2_s() -> Scenario:
    """Two seconds of a long way in a small city."""
    return msgspec.structs.replace(small_scenario(), time_limit_s=2.0)


SLOW_ONE = """
import time

from cosim import Command, Manifest


class Slow:
    manifest = Manifest("slow", rate_hz=4.0, camera=None)

    def reset(self, episode_id, seed): ...

    def act(self, observation):
        time.sleep(0.26)
        return Command(0.5, 0.0)
"""


class Accelerating:
    """A blind 5 Hz policy that is slow to answer and adds 0.1 m/s to its speed at each observation."""

    manifest = Manifest("faster", rate_hz=5.0, camera=None)

    def __init__(self, slow_s: float = 0.0) -> None:
        self.queried: list[int] = []
        self._slow_s = slow_s

    def reset(self, episode_id: str, seed: int) -> None:
        """Start slowly."""
        self.queried = []

    def act(self, observation: Observation) -> Command:
        self.queried.append(observation.tick)
        time.sleep(self._slow_s)
        return Command(0.1 * len(self.queried), 0.0)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return small_scenario_of_2_s()


@pytest.mark.engine
def test_a_fixed_latency_delays_each_command_to_the_tick(
    scenario: Scenario,
) -> None:
    """By hand: 120 ms are three ticks, so commands of observations every 4 ticks begin at 3, 7, 11,
    ..."""
    result = run_episode(scenario, Accelerating(), EpisodeOptions(latency_ms=120.0))
    assert result.log is not None and (
        result.record.setup.latency_ms,
        result.record.setup.real_time,
    ) == (
        120.0,
        False,
    )
    by_hand = [0.0] * 3 + [0.1 * k for k in range(1, 10) for _ in range(4)] + [0.1 * 10]
    assert np.allclose(result.log.command[:, 0], by_hand, atol=1e-12)
    assert result.log.answers[:, :2].tolist() == [[4 * k, 3] for k in range(10)]


@pytest.mark.engine
def test_real_time_delays_are_recorded_and_replayed(
    scenario: Scenario,
) -> None:
    """For a policy of 0.2 s the recorded delays were applied, queries do not overlap, and the
    replay has the same state hash."""
    slow = Accelerating(slow_s=0.2)
    result = run_episode(scenario, slow, EpisodeOptions(real_time=True))
    record, log = result.record, result.log
    assert log is not None and record.setup.real_time
    queried, delays = log.answers[:, 0], log.answers[:, 1]
    assert (
        (delays >= 4).all()
        and queried.tolist() == slow.queried
        and (queried[1:] >= (queried + delays)[:-1]).all()
    )
    assert np.array_equal(log.command, commands(log.answers, len(log)))
    assert record.setup.latency_ms == 50.0 * np.median(delays) and record.answer_ms is not None
    assert record.setup.latency_ms - 50.0 < record.answer_ms <= record.setup.latency_ms
    assert replay_state_hash(RecordedEpisode(scenario, record, log)) == record.state_hash


@pytest.mark.engine
def test_a_measured_latency_applies_to_every_command_of_the_run(
    scenario: Scenario, tmp_path: Path, cosim: Cosim
) -> None:
    """It is at least the policy's sleep, constant, in the row, and `--resume` uses it and refuses
    another."""
    (tmp_path / "slow_one.py").write_text(SLOW_ONE)
    short = msgspec.structs.replace(scenario, time_limit_s=1.0)
    write_suite(Suite(name="brief", version="1", scenarios=(short,)), tmp_path / "brief.json")
    words = ("run", "brief.json", "--policy", "slow_one:Slow", "--out", "mine")
    result = cosim(*words, "--latency", "measured", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    latency_ms = read_spec(tmp_path / "mine").setup.latency_ms
    (record,) = read_records(tmp_path / "mine")
    assert latency_ms == record.setup.latency_ms >= 300.0 and not record.setup.real_time
    assert f"latency {latency_ms:g} ms: commands take effect" in result.stdout
    assert "longer than its period of 250 ms" in result.stderr
    log = Log.load(tmp_path / "mine" / "episodes" / short.id / "trajectory.npz")
    assert (log.answers[:, 1] * 50.0 == latency_ms).all()
    assert cosim(*words, "--latency", "measured", "--resume", cwd=tmp_path).returncode == 0
    other = cosim(*words, "--resume", cwd=tmp_path)
    assert (
        other.returncode == 2
        and f"its latency_ms is {latency_ms}, and this command has 0.0" in other.stderr
    )


@pytest.mark.parametrize(("status", "ended"), [("crashed", None), ("invalid", float("nan"))])
def test_a_latency_is_not_measured_in_an_unfinished_episode(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch, status: str, ended: float | None
) -> None:
    """After a crash of the policy or an engine the measurement is refused with the reason, and is
    not 0 ms."""
    row = {"status": status, "ended": ended, "reason": "no memory", "latency_ms": 0.0}
    monkeypatch.setattr(suite_run, "run", lambda *_, **__: pd.DataFrame([row]))
    suite = Suite(name="brief", version="1", scenarios=(scenario,))
    with pytest.raises(
        UsageError, match=f"cannot be measured: {scenario.id} is {status}: no memory"
    ):
        suite_run.measured_latency(suite, scenario, "mine", EpisodeOptions())

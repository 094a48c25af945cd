"""Estimates of a run's duration: the announcement before it starts, and the stored durations of
runs."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from cosim.core.units import duration
from cosim.core.versions import versions
from cosim.results.run_folder import RunFolder
from cosim.spec.manifest import Manifest
from cosim.spec.scenario import Scenario, Suite
from scenarios.runs import eta as pace
from scenarios.runs.eta import (
    EpisodeDuration,
    Estimate,
    announcement,
    estimate,
    load_durations,
    makespan,
    recording_durations,
)
from tests.run_specs import record_of, spec_of
from tests.support.shipped import long_ways

GL = "gl: llvmpipe"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty cache, on a machine of two cores."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(pace.os, "sched_getaffinity", lambda _: {0, 1})
    return tmp_path / "cache"


def episodes(count: int, **changes: object) -> list[EpisodeDuration]:
    """Return durations of `route` over 100 m in 75 s of simulated time, at 6 simulated seconds a
    second, with a set-up of 4 s."""
    one = EpisodeDuration(
        machine=pace.machine(),
        policy="route",
        renderer=GL,
        jobs=1,
        short=False,
        compared=False,
        route_m=100.0,
        simulated_s=75.0,
        work_s=12.5,
        setup_s=4.0,
    )
    return [msgspec.structs.replace(one, **changes)] * count


def estimate_of(
    known: list[EpisodeDuration], policy: str = "route", jobs: int = 1, compared: bool = False
) -> Estimate:
    return estimate(long_ways()[:12], known, policy, GL, jobs, compared, cores=2)


def test_an_estimate_covers_the_measured_time_of_the_same_policy() -> None:
    """12 episodes of 4.8 km at 0.125 s a metre and 4 s each take 653 s. This lies in a span of less
    than a factor of three."""
    true_s = 12 * 4.0 + 0.125 * sum(s.route_line.length_m for s in long_ways()[:12])
    found = estimate_of(episodes(5))
    assert found.low_s < true_s < found.high_s and found.high_s < 3.0 * found.low_s
    assert found.basis == "measured in 5 episodes of 'route' on this machine"


def test_an_estimate_of_an_unknown_policy_is_wider() -> None:
    """It is wider than one of the policy's own episodes, and one without measurements is wider
    still; each states its basis."""
    own = estimate_of(episodes(5))
    others = estimate_of(episodes(5), policy="mine:Mine")
    nothing = estimate_of([])
    assert others.high_s / others.low_s > own.high_s / own.low_s
    assert nothing.high_s / nothing.low_s > others.high_s / others.low_s
    assert "simulates 6.0 s a second" in others.basis and "0.9 to 1.4 m/s" in others.basis
    assert nothing.basis.startswith("a guess, as nothing is measured on this machine yet")
    most_s = sum(s.time_limit_s for s in long_ways()[:12])
    assert f"up to {duration(12 * 6.0 + most_s / 3.6)} if it stands still" in others.basis
    assert "if it stands still" in nothing.basis and "longer if it thinks long" in nothing.basis


def test_durations_under_other_conditions_do_not_count() -> None:
    """Another renderer, a comparison, short episodes, and fewer than three episodes are not
    used."""
    for other in (
        episodes(9, renderer="bullet-tiny"),
        episodes(9, compared=True),
        episodes(2),
    ):
        assert "nothing is measured" in estimate_of(other).basis
    assert "simulates" in estimate_of(episodes(9, short=True)).basis


def test_processes_divide_the_time_up_to_the_number_of_cores() -> None:
    """Two processes take about half of the time, ten on two cores take as long as two, and the
    longest episode is a lower limit."""
    one, two, ten = (estimate_of(episodes(5), jobs=jobs) for jobs in (1, 2, 10))
    assert two.low_s < 0.55 * one.low_s < 0.65 * two.high_s and ten == two
    assert makespan([10.0, 1.0, 1.0], 2) == 10.0 and makespan([1.0, 1.0, 10.0], 2) == 11.0
    assert makespan([], 2) == 0.0


@pytest.mark.parametrize("known", [[], episodes(5)], ids=["unknown", "measured"])
@pytest.mark.parametrize("pace_x", [1.0, 2.0])
def test_a_paced_run_takes_its_real_time(known: list[EpisodeDuration], pace_x: float) -> None:
    """At 0.75 s a metre 12 episodes of 4.8 km take an hour of real time on any machine. Two
    processes take half of that, and four on two cores a quarter."""
    for jobs in (1, 2, 4):
        true_s = makespan([0.75 * s.route_line.length_m / pace_x for s in long_ways()[:12]], jobs)
        found = pace.paced_estimate(
            estimate_of(known, jobs=jobs), long_ways()[:12], known, "route", jobs, pace_x
        )
        assert found.low_s < 1.1 * true_s and 0.9 * true_s < found.high_s < 3.0 * true_s
        assert f"held to {pace_x:g} x real time" in found.basis
    assert pace.paced_estimate(
        estimate_of(known), long_ways()[:12], known, "route", 1, 100.0
    ) == estimate_of(known)


def test_the_announcement_has_episodes_length_limit_and_time() -> None:
    """One line says: 12 episodes of 4.8 km, 6 h 40 min simulated at most, and the time with one
    process and with one a core."""
    line = announcement(long_ways()[:12], "route", GL, 1, False)
    assert line.startswith(
        "12 episodes, 4.8 km of route, at most 6 h 40 min of simulated time. About "
    )
    assert " with --jobs 1, " in line and " with --jobs 2: a guess" in line and "\n" not in line
    assert "--jobs 2" not in announcement(long_ways()[:1], "route", GL, 1, False)
    assert announcement(long_ways()[:1], "route", GL, 1, False).startswith("1 episode, 482 m")


def save_finished_episode(folder: RunFolder, scenario: Scenario, status: str) -> None:
    """Save the record of an episode that took 20 s, 4 of them to set up."""
    record = msgspec.structs.replace(
        record_of(scenario, Manifest("route"), renderer=GL),
        status=status,
        ticks=1600,
        ended="goal" if status == "done" else None,
        clock={"wall_s": 20.0, "setup_s": 4.0},
    )
    folder.episode_folder(scenario.id).mkdir()
    record.save(folder.episode_folder(scenario.id) / "record.json")


def run_of(path: Path) -> RunFolder:
    suite = Suite(name="s", version="1", scenarios=long_ways()[:12])
    return RunFolder.create(path, spec_of(suite, "route", versions=versions(), renderer=GL), suite)


def test_durations_of_an_interrupted_run_are_stored(tmp_path: Path, cache: Path) -> None:
    """Finished episodes count, crashed and unstarted ones do not, and the next estimate uses
    them."""
    with (
        run_of(tmp_path / "run") as held,
        pytest.raises(KeyboardInterrupt),
        recording_durations(held, long_ways()[:6], 2),
    ):
        for scenario in long_ways()[:4]:
            save_finished_episode(
                held, scenario, "crashed" if scenario is long_ways()[:12][0] else "done"
            )
        raise KeyboardInterrupt
    known = load_durations()
    assert [(m.route_m, m.jobs, m.work_s, m.setup_s, m.simulated_s) for m in known] == [
        (s.route_line.length_m, 2, 16.0, 4.0, 80.0) for s in long_ways()[:12][1:4]
    ]
    assert "measured in 3 episodes of 'route' on this machine" in announcement(
        long_ways()[:12], "route", GL, 1, False
    )


def test_durations_of_a_paced_run_are_not_stored(tmp_path: Path, cache: Path) -> None:
    """Its durations say nothing of the machine's speed."""
    with run_of(tmp_path / "run") as held:
        save_finished_episode(held, long_ways()[:12][0], "done")
        with recording_durations(held, long_ways()[:12], 1, 1.0):
            pass
    assert load_durations() == []


def test_stored_durations_are_bounded_and_survive_damage(tmp_path: Path, cache: Path) -> None:
    """Lines of other machines and damaged lines are ignored, old ones are dropped, and a cache that
    cannot be written is ignored."""
    cache.mkdir()
    path = cache / pace.FILE
    line = msgspec.json.encode(episodes(1, machine="another")[0])
    path.write_bytes(b"nonsense\n\xff\n" + (line + b"\n") * (2 * pace.EPISODES_KEPT))
    assert load_durations() == []
    with run_of(tmp_path / "run") as held:
        save_finished_episode(held, long_ways()[:12][0], "done")
        with recording_durations(held, long_ways()[:12], 1):
            pass
        assert (
            len(path.read_bytes().splitlines()) == pace.EPISODES_KEPT and len(load_durations()) == 1
        )
        path.unlink()
        path.mkdir()
        with recording_durations(held, long_ways()[:12], 1):
            pass
    assert load_durations() == []

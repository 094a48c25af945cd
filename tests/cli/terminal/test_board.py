"""The progress display of a run: remaining time by distance, within 80 columns."""

from __future__ import annotations

import io

import msgspec
import pytest
from rich.console import Console

from cosim.cli.run_progress import SETUP_M, ProgressDisplay, RemainingWork
from cosim.core.units import duration
from scenarios.ipc.messages import Done, EpisodeProgress
from tests.support.shipped import long_ways, shipped


class Clock:
    """A clock whose seconds the test sets."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_remaining_time_is_estimated_by_distance_not_count() -> None:
    """After 100 m of 100 + 300 m in 40 s, 100 s remain rather than 40; before that there is no
    estimate."""
    left = RemainingWork({"a": 100.0, "b": 300.0})
    assert left.seconds(3.0) is None
    left.at("a", 1.0)
    assert left.seconds(40.0) == pytest.approx(40.0 * (300.0 + SETUP_M) / (100.0 + SETUP_M))
    left.at("b", 0.5)
    assert left.seconds(100.0) == pytest.approx(100.0 * 150.0 / (100.0 + SETUP_M + 150.0 + SETUP_M))
    left.at("b", 1.0)
    assert left.seconds(200.0) == 0.0


def board_of(
    scenarios: tuple, done: tuple[str, ...] = (), **options: object
) -> tuple[ProgressDisplay, Clock, io.StringIO]:
    clock = Clock()
    output = io.StringIO()
    console = Console(file=output, width=80)
    return (
        ProgressDisplay(scenarios, set(done), console=console, clock=clock, **options),
        clock,
        output,
    )  # type: ignore[arg-type]


def test_a_log_has_the_number_done_and_the_remaining_time() -> None:
    """Each finished episode logs one line with its status, the count of all, and the estimated
    rest."""
    board, clock, output = board_of(long_ways()[:3], done=(long_ways()[0].id,))
    clock.now_s = 40.0
    board.tell(Done(long_ways()[1].id, "done"))
    (line,) = output.getvalue().splitlines()
    rest_m, gone_m = (
        long_ways()[2].route_line.length_m + SETUP_M,
        long_ways()[1].route_line.length_m + SETUP_M,
    )
    assert (
        line == f"{long_ways()[1].id}: done, 2 of 3; about {duration(40.0 * rest_m / gone_m)} left"
    )
    clock.now_s = 160.0
    board.tell(Done(long_ways()[2].id, "crashed"))
    assert output.getvalue().splitlines()[1] == f"{long_ways()[2].id}: crashed, 3 of 3"


def test_a_stuck_episode_progresses_by_its_time_limit() -> None:
    """The progress of a robot that does not move is its share of the time limit, so the rest is
    known."""
    one = msgspec.structs.replace(shipped("reactive").scenarios[0], id="stuck")
    board, clock, _ = board_of((one,))
    clock.now_s = 30.0
    board.tell(EpisodeProgress(one.id, one.time_limit_s / 2, 0.0, 0))
    length_m = one.route_line.length_m
    assert board.left.seconds(30.0) == pytest.approx(
        30.0 * 0.5 * length_m / (0.5 * length_m + SETUP_M)
    )


def test_a_counterfactual_is_part_of_its_episode() -> None:
    """With --counterfactual an episode at its goal is not done until the street without the robot
    has run."""
    board, clock, _ = board_of(long_ways()[:1], compared=True)
    clock.now_s = 70.0
    board.tell(EpisodeProgress(long_ways()[0].id, 100.0, long_ways()[0].route_line.length_m, 0))
    at_goal_s = board.left.seconds(70.0)
    board.tell(EpisodeProgress(long_ways()[0].id, 1.0, 1.0, 0, compared=0.5))
    assert at_goal_s is not None and at_goal_s > 15.0
    assert (half_s := board.left.seconds(70.0)) is not None and half_s < at_goal_s / 1.5


def test_a_resumed_complete_run_shows_a_full_bar() -> None:
    """A run that is resumed after its last episode shows a full bar."""
    board, *_ = board_of(long_ways()[:1], done=(long_ways()[0].id,))
    assert board.left.share == 1.0 and "1/1" in str(board.bars.tasks[0].fields["count"])


def test_the_bars_fit_80_columns() -> None:
    """With the longest name, thousands of seconds and dozens of failures no line is broken and
    nothing is cut."""
    named = msgspec.structs.replace(long_ways()[7], id="ped_crossing-001")
    board, clock, output = board_of((named, *long_ways()[:2]))
    clock.now_s = 4000.0
    board.tell(EpisodeProgress(named.id, 3185.2, 630.4, 88))
    board.bars.refresh()
    Console(file=output, width=80).print(board.bars.get_renderable())
    lines = output.getvalue().splitlines()
    assert max(map(len, lines)) <= 80 and "…" not in output.getvalue()
    way = f"630/{long_ways()[7].route_line.length_m:.0f} m"
    assert any(
        "ped_crossing-001" in line and way in line and "88 failures" in line for line in lines
    )
    assert any("episodes" in line and "0/3" in line and "left" in line for line in lines)

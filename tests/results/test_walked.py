"""Metres travelled by a robot with legs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cosim.core.clock import Clock
from cosim.core.geometry import Floats, Pose
from cosim.core.state import STILL, Motion
from cosim.episode.command_delay import CommandDelay
from cosim.results.log import COLUMNS
from cosim.results.metrics import BRIEF_COLUMNS
from cosim.results.record import Recorder
from cosim.results.referee import Verdict
from cosim.results.rejudge import contradictions
from cosim.results.walked import walked_m
from cosim.spec.robot import ROBOTS, WALKER, Legs, Robot
from scenarios.tools.bench.legs import FLAT, walking
from tests.results.test_falls import with_legs
from tests.results.test_referee import step
from tests.support.driven_runs import episode_of, short_way

TICK_S = Clock().tick_s
LEGGED = [robot for robot in ROBOTS.values() if isinstance(robot.drive, Legs)]


@pytest.mark.parametrize("cycle_ticks", [4.2, 16.0])
def test_sway_adds_no_distance_and_the_path_counts_to_its_ends(cycle_ticks: float) -> None:
    """A robot that sways by 2 cm has the length of the straight, and a reset adds nothing."""
    ticks = np.arange(400)
    sway_m = 0.02 * np.sin(2.0 * np.pi * ticks / cycle_ticks)
    xy = np.column_stack([0.05 * ticks, sway_m])
    never = np.full(400, np.nan)
    straight_m = 0.05 * 399
    assert np.hypot(*np.diff(xy, axis=0).T).sum() > 1.005 * straight_m
    assert walked_m(xy, never, cycle_ticks).sum() == pytest.approx(straight_m, rel=2e-3)
    assert walked_m(xy * [0.0, 1.0], never, cycle_ticks).sum() < 0.15
    reset_s_m = never.copy()
    reset_s_m[199] = 3.0
    jumped = xy + np.where(ticks > 199, 50.0, 0.0)[:, None]
    assert walked_m(jumped, reset_s_m, cycle_ticks).sum() == pytest.approx(straight_m, rel=5e-3)


def test_a_curve_has_its_length() -> None:
    """A quarter circle of 2 m at 1 m/s loses less than 1 % by the averaging."""
    turn = np.arange(0.0, np.pi / 2.0, 0.025)
    xy = 2.0 * np.column_stack([np.sin(turn), 1.0 - np.cos(turn)])
    way_m = walked_m(xy, np.full(len(xy), np.nan), 16.0).sum()
    assert way_m == pytest.approx(2.0 * turn[-1], rel=0.01)


def test_a_distance_that_differs_from_the_poses_is_refused() -> None:
    """With legs neither a longer nor a shorter distance passes."""
    way = short_way("s", robot="dog")
    record, log = episode_of(way, "h")
    assert log is not None
    log = with_legs(log, range(0))
    assert [*contradictions(record, way, log)] == []
    for changed in (0.04, 0.06, np.nan):
        travelled_m = log.travelled_m.copy()
        travelled_m[20] = changed
        forged = dataclasses.replace(log, travelled_m=travelled_m)
        found = [one.what for one in contradictions(record, way, forged)]
        assert found == ["travelled_m at tick 20"]


@pytest.mark.parametrize("columns", [tuple(COLUMNS), BRIEF_COLUMNS])
def test_the_recorder_records_the_distance_of_the_poses(columns: tuple[str, ...]) -> None:
    """So it does with the columns of a search alone, and without a gait the distance is as driven."""

    def travelled_m(cycle_s: float) -> Floats:
        recorder = Recorder(TICK_S, (0.7, 0.3), columns, cycle_s)
        for tick in range(100):
            recorder.add(step(tick, 20.0 + 0.05 * tick, 0.02 * (-1) ** tick), Verdict())
        return recorder.log(np.zeros((0, 5)), CommandDelay()).travelled_m

    assert travelled_m(0.2).sum() == pytest.approx(99 * 0.05, abs=0.05)
    assert not travelled_m(0.0).any()


def way_of(robot: Robot, motions: list[Motion]) -> float:
    xy = np.array([motion.robot.pose.xy for motion in motions])
    return float(walked_m(xy, np.full(len(xy), np.nan), robot.drive.cycle_s / TICK_S).sum())


@pytest.mark.engine
@pytest.mark.parametrize("robot", LEGGED, ids=lambda robot: robot.name)
def test_the_metres_of_a_walk_are_those_of_its_straight(
    robot: Robot, request: pytest.FixtureRequest
) -> None:
    """10 m straight are 10 m within 1 %, and standing for a minute is none."""
    if robot is WALKER:
        request.getfixturevalue("walker_weights")
    with walking(robot, FLAT, Pose(-40.0, 0.0, 0.0)) as walk:
        motions = [walk.tick(STILL)]
        while walk.robot.pose.x_m < -30.0 and len(motions) < 600:
            motions.append(walk.along(robot.cruise_mps, 0.0))
        straight_m = walk.robot.pose.x_m - motions[0].robot.pose.x_m
        assert straight_m > 9.9 and way_of(robot, motions) == pytest.approx(straight_m, rel=0.01)
        walk.drive(STILL, 2.0)
        stood_m = way_of(robot, walk.drive(STILL, 60.0))
        assert stood_m < 0.1 and walk.fallen == 0

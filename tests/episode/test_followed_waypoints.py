"""Waypoints in a trajectory, and which of them are followed when."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import RunError
from cosim.core.geometry import Pose
from cosim.core.state import Command, RobotState, WaypointCommand
from cosim.episode.command_delay import CommandDelay
from cosim.episode.loop import Step
from cosim.results.log import Log
from cosim.results.waypoint_replay import WaypointReplay
from tests.support.driven_runs import driven, short_way

AHEAD = np.float32([[1.0, 0.0], [2.0, 0.5]])
TURNED = np.float32([[1.0, 0.0, 0.6, 0.8]])


def log_of(*answers: tuple[int, int, Command]) -> Log:
    """Ten ticks of a log with answers, given by their ticks, delays, and commands."""
    commands = CommandDelay()
    for answer in answers:
        commands.add(*answer)
    sizes, points, index = commands.plans
    log = driven(short_way("s-000"), [1.0] * 10)
    return dataclasses.replace(
        log, answers=commands.answers, plan_sizes=sizes, plan_points=points, plan_index=index
    )


def step_at(tick: int, pose: Pose) -> Step:
    """A step with only the robot's pose at its beginning."""
    return Step(tick, RobotState(pose), *[None] * 8)  # type: ignore[arg-type]


def test_waypoints_of_every_kind_are_stored_as_answered(tmp_path: Path) -> None:
    """Two, a command, and one with a heading are stored ragged with NaN headings; files without any
    omit the arrays."""
    log = log_of(
        (0, 0, WaypointCommand(1.0, 0.0, AHEAD, 1)),
        (4, 0, Command(1.0, 0.0)),
        (8, 0, WaypointCommand(1.0, 0.0, TURNED, 1)),
    )
    (tmp_path / "planned.npz").write_bytes(log.encoded())
    read = Log.load(tmp_path / "planned.npz")
    assert (
        read.plan_sizes.tolist() == [2, 0, 1]
        and read.plan_index == 1
        and read.plan_points.dtype == np.float32
    )
    expected = [
        [1.0, 0.0, math.nan, math.nan],
        [2.0, 0.5, math.nan, math.nan],
        [1.0, 0.0, np.float32(0.6), np.float32(0.8)],
    ]
    assert np.array_equal(read.plan_points, expected, equal_nan=True)
    plain = log_of((0, 0, Command(1.0, 0.0)))
    (tmp_path / "plain.npz").write_bytes(plain.encoded())
    with np.load(tmp_path / "plain.npz") as arrays:
        assert not [name for name in arrays if name.startswith("plan")]
    assert not len(Log.load(tmp_path / "plain.npz").plan_sizes)


@pytest.mark.parametrize("name", ["plan_sizes", "plan_points", "plan_index"])
def test_a_trajectory_with_incomplete_waypoints_is_refused(tmp_path: Path, name: str) -> None:
    """A missing array of waypoints is refused with the file's name."""
    arrays = dataclasses.asdict(log_of((0, 0, WaypointCommand(1.0, 0.0, AHEAD, 1))))
    del arrays[name]
    np.savez(tmp_path / "t.npz", **arrays)
    with pytest.raises(RunError, match=r"t\.npz: not a trajectory"):
        Log.load(tmp_path / "t.npz")


def test_waypoints_are_followed_from_their_effect_to_the_next_or_a_reset() -> None:
    """By hand, with a delay of 2: waypoints of tick 0, a command at 4, and waypoints of 6 that a
    reset discards."""
    planned = WaypointCommand(1.0, 0.0, AHEAD, 1)
    following = WaypointReplay(
        log_of((0, 2, planned), (4, 2, Command(1.0, 0.0)), (5, 2, planned), (6, 2, planned))
    )
    assert following.follows == 2
    poses = [Pose(1.0, 2.0 + tick, math.pi / 2.0) for tick in range(9)]
    followed = [
        following.update(step_at(tick, pose), reset=tick == 7) for tick, pose in enumerate(poses)
    ]
    assert [one is None for one in followed] == [
        True,
        True,
        False,
        False,
        False,
        False,
        True,
        False,
        True,
    ]
    assert all(one is followed[2] for one in followed[2:6])
    for tick, answered in ((2, 0), (7, 5)):
        assert np.allclose(
            followed[tick], [(1.0, 2.0 + answered), (1.0, 3.0 + answered), (0.5, 4.0 + answered)]
        )

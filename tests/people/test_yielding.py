"""Yielding: people step round the robot."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.geometry import Pose, box_disk_gap
from cosim.people.yielding import STEP_ROUND_GAP_M, RobotBody, stepped_around

HALF = (0.36, 0.29)
STEP_M = 1.4 * 0.05


def gap(xy: np.ndarray, robot: Pose) -> float:
    return float(box_disk_gap(np.array([robot]), *HALF, xy[None])[0, 0]) - 0.3


@pytest.mark.parametrize("aside_m", [0.0, 0.05, -0.3, 0.6])
@pytest.mark.parametrize("heading", [0.0, 0.7, math.pi / 2])
def test_a_person_passes_a_standing_robot_without_touching_it(
    aside_m: float, heading: float
) -> None:
    """From any lateral offset and against any robot heading the person arrives and never overlaps."""
    robot = Pose(0.0, 0.0, heading)
    xy = np.array([[4.0, aside_m]])
    goal = np.array([[-4.0, aside_m]])
    nearest = math.inf
    for _ in range(250):
        away = goal - xy
        far = max(float(np.hypot(*away[0])), 1e-9)
        xy = stepped_around(xy, xy + away / far * min(STEP_M, far), RobotBody(robot, HALF))
        nearest = min(nearest, gap(xy, robot))
    assert nearest > 0.0
    assert float(np.hypot(*(goal - xy)[0])) < 0.2


def test_a_robot_that_drives_at_a_standing_person_hits_them() -> None:
    """Only a person's own steps change, so a standing one is not moved out of the robot's way."""
    person = np.array([[1.0, 0.0]])
    for x_m in np.arange(0.0, 0.8, 0.1):
        assert np.array_equal(
            stepped_around(person, person, RobotBody(Pose(x_m, 0.0, 0.0), HALF, 2.0)), person
        )
    assert gap(person, Pose(0.7, 0.0, 0.0)) < 0.0


def test_people_far_from_the_robot_walk_as_wanted() -> None:
    """Far from the robot, beside it, and walking away from it nothing changes."""
    before = np.array([[5.0, 0.0], [0.0, 0.29 + 0.3 + STEP_ROUND_GAP_M + 0.05], [0.7, 0.0]])
    wanted = before + np.array([[-0.07, 0.0], [0.07, 0.0], [0.07, 0.0]])
    assert np.allclose(stepped_around(before, wanted, RobotBody(Pose(0.0, 0.0, 0.0), HALF)), wanted)


def test_a_person_steps_aside_for_an_oncoming_robot() -> None:
    """A person and a robot at 1.5 m/s meet head-on, and the person moves aside before they touch."""
    xy = np.array([[6.0, 0.1]])
    nearest = math.inf
    for tick in range(80):
        robot = Pose(1.5 * 0.05 * tick, 0.0, 0.0)
        xy = stepped_around(xy, xy - np.array([[STEP_M, 0.0]]), RobotBody(robot, HALF, 1.5))
        nearest = min(nearest, gap(xy, Pose(1.5 * 0.05 * (tick + 1), 0.0, 0.0)))
    assert nearest > 0.0
    assert float(xy[0, 0]) < 1.5 * 0.05 * 80 - 1.0


def test_a_person_does_not_see_a_robot_from_behind() -> None:
    """A slower person in front keeps walking and is hit, so the robot has to watch out."""
    before = np.array([[0.8, 0.0]])
    wanted = before + np.array([[0.03, 0.0]])
    assert np.allclose(
        stepped_around(before, wanted, RobotBody(Pose(0.0, 0.0, 0.0), HALF, 2.0)), wanted
    )


@pytest.mark.parametrize("x_m", [-0.3, 0.0, 0.5])
def test_a_person_who_wants_to_stand_at_the_robot_stops_beside_it(x_m: float) -> None:
    """The person comes within a hand's breadth of the robot and stops."""
    body = RobotBody(Pose(0.0, 0.0, 0.0), HALF)
    place = np.array([x_m, 0.45])
    xy = np.array([[2.0, 1.2]])
    ways = []
    for _ in range(100):
        away = place - xy
        step = away * (0.11 / max(float(np.hypot(*away[0])), 0.11))
        after = stepped_around(xy, xy + step, body, np.array([True]))
        ways.append(float(np.hypot(*(after - xy)[0])))
        xy = after
    assert sum(ways[60:]) < 1e-4
    assert STEP_ROUND_GAP_M - 1e-6 < gap(xy, body.pose) < STEP_ROUND_GAP_M + 0.11

"""Delays of pedestrians, and the counts of an event's monitor."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import People, RobotState
from cosim.results.delay import Tracks, delay_of
from cosim.results.event_monitor import (
    STANDARD_CAMERA,
    body_points,
    camera_position,
    in_picture,
    passed_between,
)
from cosim.results.record import TriggeredEvent
from cosim.results.validity import why_unseen
from cosim.spec.events import Event
from cosim.spec.robot import COURIER


def tracks(*ways: list[float]) -> Tracks:
    """Tracks of people c0, c1, ... on lines 20 m apart at these x, tick by tick; all of equal
    length."""
    result = Tracks()
    for xs in zip(*ways, strict=True):
        n = len(xs)
        names = tuple(f"c{i}" for i in range(n))
        xy = [(x, 20.0 * i) for i, x in enumerate(xs)]
        result.add(People.of(names, xy, np.zeros(n), np.zeros(n), ("walk",) * n))
    return result


WALK = [0.05 * k for k in range(201)]
"""Places of a person who walks for 10 s at 1 m/s."""
HELD_UP = [0.05 * min(k, 100) for k in range(201)]
"""Places of a person who walks for 5 s at 1 m/s, then stands for 5 s."""


def test_a_person_who_stands_for_5_s_is_delayed_by_5_s() -> None:
    """The person near the robot is delayed by 5 s less the time for half a metre, the far one by
    nothing."""
    robot = [(5.0, 1.0)] * 201
    found = delay_of(robot, tracks(HELD_UP, WALK), tracks(WALK, WALK), 0.05)
    assert found.delay_s == pytest.approx(4.5) and found.near_s == pytest.approx(4.5)
    assert (found.compared, found.near, found.unmatched) == (2, 1, 0)
    faster = delay_of(robot, tracks(WALK, WALK), tracks(HELD_UP, WALK), 0.05)
    assert faster.delay_s == pytest.approx(-4.5)


def test_sideways_steps_are_no_progress() -> None:
    """A person who waits for the last five seconds has the same delay when moving sideways
    meanwhile."""
    shuffling = [x + (0.3 * (k % 2) if k > 100 else 0.0) for k, x in enumerate(HELD_UP)]
    assert delay_of(
        [(5.0, 1.0)] * 201, tracks(shuffling), tracks(HELD_UP), 0.05
    ).delay_s == pytest.approx(0.0)


def test_another_person_of_the_same_name_is_not_compared() -> None:
    """A person who entered elsewhere is another person."""
    found = delay_of([(5.0, 1.0)] * 201, tracks(HELD_UP), tracks([3.0 + x for x in WALK]), 0.05)
    assert (found.compared, found.unmatched, found.delay_s) == (0, 1, 0.0)


def test_a_standing_person_is_not_delayed() -> None:
    """Without a pace there is no delay."""
    found = delay_of([(5.0, 1.0)] * 201, tracks([1.0] * 201), tracks([1.0] * 201), 0.05)
    assert (found.compared, found.delay_s) == (0, 0.0)


@pytest.mark.parametrize(
    ("before", "after", "between"),
    [
        ((-0.1, 0.0), (0.1, 0.0), True),
        ((-0.1, 0.9), (0.1, 0.9), True),
        ((-0.1, 1.1), (0.1, 1.1), False),
        ((-0.3, 0.0), (-0.1, 0.0), False),
        ((0.0, -2.0), (0.0, -1.5), False),
    ],
)
def test_passing_between_two_people_crosses_the_line_between_them(
    before: tuple[float, float], after: tuple[float, float], between: bool
) -> None:
    """For people at y = -1 and y = 1 a step over x = 0 counts only between them."""
    pair = np.array([(0.0, -1.0), (0.0, 1.0)])
    assert passed_between(np.array(before), np.array(after), pair) is between


def test_a_step_that_ends_on_the_line_counts_once() -> None:
    """Of two steps over the line that meet on it one counts, in either direction."""
    pair = np.array([(0.0, -1.0), (0.0, 1.0)])
    ways = [np.array([x, 0.0]) for x in (-0.1, 0.0, 0.1)]
    for a, b, c in (ways, ways[::-1]):
        assert passed_between(a, b, pair) is not passed_between(b, c, pair)


def test_any_two_of_a_group_count() -> None:
    """A way into a triangle of talkers crosses one of its sides, and one past it none."""
    trio = np.array([(0.0, 0.0), (2.0, 0.0), (1.0, 2.0)])
    assert passed_between(np.array([1.0, -0.2]), np.array([1.0, 0.2]), trio)
    assert not passed_between(np.array([-0.2, -0.2]), np.array([2.2, -0.2]), trio)


def share_in_picture(x_m: float, y_m: float) -> float:
    """Return how much of a person is in the standard picture of a robot at the origin that looks
    along y."""
    robot = RobotState(Pose(0.0, 0.0, math.pi / 2))
    mount = COURIER.mount("front")
    eye = camera_position(robot, mount)
    points = body_points(eye, np.array([x_m, y_m]), 0.0)
    return float(in_picture(robot.pose, mount, STANDARD_CAMERA, points - eye).mean())


def test_the_standard_camera_sees_what_lies_within_its_field() -> None:
    """In a picture 75 degrees wide the share of a person is 1 ahead, 0 at 45 degrees or behind,
    partial at half a metre."""
    aside = {
        deg: (8.0 * math.sin(math.radians(deg)), 0.3 + 8.0 * math.cos(math.radians(deg)))
        for deg in (30, 45)
    }
    assert share_in_picture(0.0, 5.0) == 1.0 and share_in_picture(*aside[30]) == 1.0
    assert share_in_picture(*aside[45]) == 0.0 and share_in_picture(0.0, -3.0) == 0.0
    assert 0.1 < share_in_picture(0.0, 0.8) < 0.9


def test_an_unseen_event_is_described() -> None:
    """An event is described as never triggered, never in view, or valid."""
    event = Event(
        id="e0", kind="frontal", x_m=0.0, y_m=0.0, heading_rad=0.0, route_s_m=5.0, half_width_m=1.5
    )
    outcome = TriggeredEvent(id="e0", kind="frontal", passed=False)
    assert why_unseen(event, outcome) == "event e0 (frontal) never triggered"
    blind = TriggeredEvent(id="e0", kind="frontal", passed=True, triggered_at_s=1.0)
    assert why_unseen(event, blind) == "nobody of event e0 (frontal) was seen"
    assert (
        why_unseen(
            event,
            TriggeredEvent(id="e0", kind="frontal", passed=True, triggered_at_s=1.0, seen=True),
        )
        == ""
    )

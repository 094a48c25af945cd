"""What is witnessed of an event, on cases made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import RobotState
from cosim.results.event_monitor import (
    STANDARD_CAMERA,
    body_points,
    eye_of,
    in_picture,
    went_between,
    why_unseen,
)
from cosim.results.record import TriggeredEvent
from cosim.spec.events import Event
from cosim.spec.robot import COURIER


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
def test_between_two_people_is_across_the_line_between_them(
    before: tuple[float, float], after: tuple[float, float], between: bool
) -> None:
    """Two stand at y = -1 and y = 1: a step over x = 0 counts only there."""
    pair = np.array([(0.0, -1.0), (0.0, 1.0)])
    assert went_between(np.array(before), np.array(after), pair) is between


def test_a_step_that_ends_on_the_line_is_no_way_round_it() -> None:
    """Of two steps over the line that meet on it one counts, in either direction."""
    pair = np.array([(0.0, -1.0), (0.0, 1.0)])
    ways = [np.array([x, 0.0]) for x in (-0.1, 0.0, 0.1)]
    for a, b, c in (ways, ways[::-1]):
        assert went_between(a, b, pair) is not went_between(b, c, pair)


def test_any_two_of_a_group_count() -> None:
    """Into a triangle of talkers goes over one of its sides; past it over none."""
    trio = np.array([(0.0, 0.0), (2.0, 0.0), (1.0, 2.0)])
    assert went_between(np.array([1.0, -0.2]), np.array([1.0, 0.2]), trio)
    assert not went_between(np.array([-0.2, -0.2]), np.array([2.2, -0.2]), trio)


def share_in_picture(x_m: float, y_m: float) -> float:
    """Of a person there, before a robot at the origin that looks along y: how much is in the
    standard picture."""
    robot = RobotState(Pose(0.0, 0.0, math.pi / 2))
    mount = COURIER.mount("front")
    eye = eye_of(robot, mount)
    points = body_points(eye, np.array([x_m, y_m]), 0.0)
    return float(in_picture(robot.pose, mount, STANDARD_CAMERA, points - eye).mean())


def test_the_standard_camera_sees_what_lies_within_its_field() -> None:
    """The share of a person in a picture 75 degrees wide is 1 ahead, 0 at 45 degrees or behind, and
    partial at half a metre."""
    aside = {
        deg: (8.0 * math.sin(math.radians(deg)), 0.3 + 8.0 * math.cos(math.radians(deg)))
        for deg in (30, 45)
    }
    assert share_in_picture(0.0, 5.0) == 1.0 and share_in_picture(*aside[30]) == 1.0
    assert share_in_picture(*aside[45]) == 0.0 and share_in_picture(0.0, -3.0) == 0.0
    assert 0.1 < share_in_picture(0.0, 0.8) < 0.9


def test_an_event_that_nobody_saw_is_told_in_words() -> None:
    """Never triggered, never in view, or a proper event."""
    event = Event(
        id="e0", kind="frontal", x_m=0.0, y_m=0.0, heading_rad=0.0, route_s_m=5.0, half_width_m=1.5
    )
    outcome = TriggeredEvent(id="e0", kind="frontal", passed=False)
    assert why_unseen(event, outcome) == "event e0 (frontal) never triggered"
    blind = TriggeredEvent(id="e0", kind="frontal", passed=True, triggered_at_s=1.0)
    assert why_unseen(event, blind) == "nobody of event e0 (frontal) could be seen"
    assert (
        why_unseen(
            event,
            TriggeredEvent(id="e0", kind="frontal", passed=True, triggered_at_s=1.0, seen=True),
        )
        == ""
    )

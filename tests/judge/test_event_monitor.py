"""What is witnessed of an event, on cases made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.judge.event_monitor import in_view, went_between, why_invalid
from cosim.records.record import TriggeredEvent
from cosim.spec.events import Event, Walker


def at(x_m: float, y_m: float) -> Walker:
    return Walker(x_m=x_m, y_m=y_m, heading_rad=0.0)


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
    pair = (at(0.0, -1.0), at(0.0, 1.0))
    assert went_between(np.array(before), np.array(after), pair) is between


def test_any_two_of_a_group_count() -> None:
    """Into a triangle of talkers goes over one of its sides; past it over none."""
    trio = (at(0.0, 0.0), at(2.0, 0.0), at(1.0, 2.0))
    assert went_between(np.array([1.0, -0.2]), np.array([1.0, 0.2]), trio)
    assert not went_between(np.array([-0.2, -0.2]), np.array([2.2, -0.2]), trio)


def test_in_view_is_before_the_robot() -> None:
    """Within 45 degrees of its heading and 30 m; not behind it, not beyond."""
    robot = Pose(0.0, 0.0, math.pi / 2)
    assert in_view(robot, at(0.0, 29.0)) and in_view(robot, at(9.9, 10.0))
    assert (
        not in_view(robot, at(10.1, 10.0)) and not in_view(robot, at(0.0, 31.0)) and not in_view(robot, at(0.0, -5.0))
    )


def test_an_event_that_nobody_saw_is_told_in_words() -> None:
    """Never triggered, never in view, or a proper event."""
    event = Event(id="e0", kind="frontal", x_m=0.0, y_m=0.0, heading_rad=0.0, route_s_m=5.0, half_width_m=1.5)
    outcome = TriggeredEvent(id="e0", kind="frontal", passed=False)
    assert why_invalid(event, outcome) == "event e0 (frontal) never triggered"
    blind = TriggeredEvent(id="e0", kind="frontal", passed=True, triggered_at_s=1.0)
    assert why_invalid(event, blind) == "nobody of event e0 (frontal) was ever in view"
    assert why_invalid(event, TriggeredEvent(id="e0", kind="frontal", passed=True, triggered_at_s=1.0, seen=True)) == ""

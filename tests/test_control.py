"""From a policy's answer to a command."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.clock import Clock
from cosim.control import Limits, command_from_waypoint, command_of
from cosim.errors import PolicyError, SpecError
from cosim.state import Command

LIMITS = Limits()


def of(answer: object) -> Command:
    return command_of(answer, waypoint_dt_s=0.25, limits=LIMITS, who="mine")


def test_a_waypoint_becomes_the_fields_pd_command() -> None:
    """v = dx / dt and w = atan2(dy, dx) / dt; a waypoint at the side turns on the spot; none stands still."""
    assert command_from_waypoint(0.5, 0.1, 0.25) == Command(2.0, math.atan2(0.1, 0.5) / 0.25)
    assert command_from_waypoint(0.0, -1.0, 0.25) == Command(0.0, -math.pi / 0.5)
    assert command_from_waypoint(0.0, 0.0, 0.25) == Command(0.0, 0.0)


def test_commands_are_clipped_to_the_robot() -> None:
    """Speeds beyond the robot's, and driving backwards, are clipped."""
    assert of(Command(9.0, -9.0)) == Command(2.5, -0.65)
    assert of(Command(-1.0, 0.1)) == Command(0.0, 0.1)
    assert of(np.array([[0.1, 0.0], [0.2, 0.0]])) == Command(0.4, 0.0)
    assert of([[0.1, 0.0]]) == Command(0.4, 0.0)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (Command(math.nan, 0.0), "both speeds must be finite numbers"),
        (Command("fast", 0.0), "both speeds must be finite numbers"),  # type: ignore[arg-type]
        (np.array([[math.nan, 0.0]]), "waypoints with NaN or infinity"),
        (np.zeros((3,)), "shape (3,)"),
        (np.zeros((0, 2)), "shape (0, 2)"),
        (np.zeros((4, 3)), "shape (4, 3)"),
        (None, "neither a Command nor waypoints"),
        ("go", "neither a Command nor waypoints"),
    ],
)
def test_an_unusable_answer_is_refused_with_the_policys_name(answer: object, message: str) -> None:
    """NaN, wrong shapes and other things raise PolicyError that says what came."""
    with pytest.raises(PolicyError) as caught:
        of(answer)
    assert "'mine'" in str(caught.value)
    assert message in str(caught.value) or "shape ()" in str(caught.value)


def test_a_clock_counts_in_whole_periods() -> None:
    """Ticks, substeps and policy periods come from integers, and a rate that does not divide is refused."""
    clock = Clock.for_rate(4)
    assert (clock.substeps, clock.time_s(7), clock.ticks(10.0)) == (10, 0.35, 200)
    assert [tick for tick in range(12) if clock.acts(tick)] == [0, 5, 10]
    with pytest.raises(SpecError, match="usual policy rates are 4, 5, 10, 20 Hz"):
        Clock.for_rate(7)

"""Conversion of a policy's answer to a command."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.clock import Clock
from cosim.core.errors import PolicyError, SpecError
from cosim.core.state import Command, WaypointCommand
from cosim.episode.control import command_of
from cosim.spec.manifest import WaypointRule
from cosim.spec.robot import COURIER, Robot

ATAN2 = WaypointRule(rule="atan2")
QUICK = dataclasses.replace(COURIER, w_max_radps=100.0)
"""A courier with practically no limit on turning."""


def command_for(
    answer: object, rule: WaypointRule = WaypointRule(), robot: Robot = COURIER
) -> Command:
    command = command_of(answer, rule=rule, robot=robot)
    assert isinstance(command, WaypointCommand) == (not isinstance(answer, Command))
    return Command(command.v_mps, command.w_radps)


# x, y, heading (None without one), then w by the shipped rule and by atan2, worked out by hand for
# a step of 0.25 s.
BY_HAND = {
    "ahead": (0.5, 0.0, None, 0.0, 0.0),
    "ahead-left": (0.5, 0.5, None, math.pi, math.pi),  # 45 degrees in a quarter of a second
    "ahead-right": (
        0.3,
        -0.3 * math.sqrt(3.0),
        None,
        -4.0 * math.pi / 3.0,
        -4.0 * math.pi / 3.0,
    ),  # -60 degrees
    "behind-left": (
        -1.0,
        0.5,
        None,
        -1.8545904360032244,
        10.711780178355947,
    ),  # arctan(-1/2) = -0.4636; pi - 0.4636
    "behind-right": (-1.0, -0.5, None, 1.8545904360032244, -10.711780178355947),
    "straight-behind": (-1.0, 0.0, None, 0.0, 4.0 * math.pi),
    "left": (0.0, 1.0, None, 2.0 * math.pi, 2.0 * math.pi),
    "right-with-heading": (
        0.0,
        -1.0,
        1.0,
        -2.0 * math.pi,
        -2.0 * math.pi,
    ),  # the heading counts at its own place alone
    "here": (0.0, 0.0, None, 0.0, 0.0),
    "here-turned-left": (0.0, 0.0, 0.5, 2.0, 2.0),
    "here-turned-right": (1e-9, -1e-9, -2.0, -8.0, -8.0),
    "ahead-with-heading": (0.5, 0.5, -1.0, math.pi, math.pi),
}


@pytest.mark.parametrize("name", BY_HAND)
@pytest.mark.parametrize("rule", [WaypointRule(), ATAN2], ids=["shipped", "atan2"])
def test_both_rules_turn_as_worked_out_by_hand(name: str, rule: WaypointRule) -> None:
    """v is x / dt, never negative, w follows the rule, and the two rules differ only behind the
    robot."""
    x_m, y_m, heading_rad, shipped, atan2 = BY_HAND[name]
    row = (
        [x_m, y_m]
        if heading_rad is None
        else [x_m, y_m, math.cos(heading_rad), math.sin(heading_rad)]
    )
    v_mps = 4.0 * x_m if x_m > 1e-8 else 0.0
    expected = (v_mps, shipped if rule is not ATAN2 else atan2)
    assert dataclasses.astuple(
        command_for([[9.0] * len(row), [9.0] * len(row), row], rule, QUICK)
    ) == pytest.approx(expected)


def test_a_waypoint_behind_the_robot_turns_it_as_the_models_were_driven() -> None:
    """(-1, 0.5) at 0.25 s gives -1.85 rad/s by the shipped rule, clipped to -0.65 for the courier,
    and +0.65 by atan2."""
    answer = [[-1.0, 0.5]] * 3
    assert command_for(answer, robot=QUICK).w_radps == pytest.approx(-1.85, abs=0.005)
    assert command_for(answer) == Command(0.0, -0.65) and command_for(answer, ATAN2) == Command(
        0.0, 0.65
    )


def test_the_manifest_says_which_waypoint_is_followed_and_in_which_units() -> None:
    """The default is the third one; x and y are multiplied by the unit over the declared step."""
    answer = np.array([[0.1, 0.0], [0.2, 0.1], [0.4, 0.0], [0.5, 0.5]])
    assert command_for(answer) == Command(1.6, 0.0)
    assert command_for(answer, WaypointRule(index=0)) == Command(0.4, 0.0)
    assert command_for(answer, WaypointRule(index=3, unit_m=0.5, dt_s=0.5), QUICK) == Command(
        0.5, math.pi / 2.0
    )
    scaled = WaypointRule(index=0, unit_m=10.0)
    assert command_for([[1e-9, 1e-9, 0.0, 1.0]], scaled, QUICK) == command_for(
        [[1e-8, 1e-8, 0.0, 1.0]], WaypointRule(index=0), QUICK
    )


def test_a_command_carries_the_waypoints_that_it_follows() -> None:
    """A command carries its waypoints in metres and the index of the followed one."""
    rule = WaypointRule(index=1, unit_m=0.5)
    command = command_of([[1.0, 0.5, 0.6, 0.8], [2.0, -1.0, 1.0, 0.0]], rule=rule, robot=COURIER)
    assert (
        isinstance(command, WaypointCommand)
        and command.index == 1
        and command.waypoints.dtype == np.float32
    )
    assert np.array_equal(
        command.waypoints, np.float32([[0.5, 0.25, 0.6, 0.8], [1.0, -0.5, 1.0, 0.0]])
    )
    again = command_of(command, rule=rule, robot=COURIER)
    assert (
        isinstance(again, WaypointCommand)
        and again == command
        and np.array_equal(again.waypoints, command.waypoints)
    )
    with pytest.raises(PolicyError, match=r"shape \(3,\)"):
        command_for(dataclasses.replace(command, waypoints=np.zeros(3, np.float32)))
    many = command_of([[1e300, 0.0]] * 1000, rule=WaypointRule(), robot=COURIER)
    assert (
        isinstance(many, WaypointCommand)
        and many.waypoints.shape == (256, 2)
        and np.isfinite(many.waypoints).all()
    )


def test_fewer_waypoints_than_the_rule_needs_are_refused_with_the_remedy() -> None:
    """Two waypoints are refused where the third is followed."""
    with pytest.raises(PolicyError) as caught:
        command_for([[0.1, 0.0], [0.2, 0.0]])
    assert str(caught.value) == (
        "answered waypoints of shape (2, 2), and waypoint 2 (from 0) is followed: answer at least "
        "3, or say which one in the manifest, as waypoints=WaypointRule(index=1)"
    )


@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(-math.pi, math.pi))
def test_the_rules_agree_ahead_of_the_robot_and_respect_its_limits(
    x_m: float, y_m: float, heading: float
) -> None:
    """For any waypoint commands stay within the limits, agree ahead of the robot, and mirror to the
    other side."""
    row, mirrored = (
        (x_m, side * y_m, math.cos(heading), side * math.sin(heading)) for side in (1.0, -1.0)
    )
    one = command_for([row] * 3)
    other = command_for([row] * 3, ATAN2)
    for command in (one, other):
        assert (
            0.0 <= command.v_mps <= COURIER.v_max_mps
            and abs(command.w_radps) <= COURIER.w_max_radps
        )
    assert x_m < 0.0 or (one.v_mps, one.w_radps) == pytest.approx(
        (other.v_mps, other.w_radps), rel=1e-12
    )
    turned = command_for([mirrored] * 3)
    assert turned.v_mps == one.v_mps and turned.w_radps == -one.w_radps


def test_commands_are_clipped_to_the_robot() -> None:
    """Speeds beyond the robot's, and driving backwards, are clipped."""
    assert command_for(Command(9.0, -9.0)) == Command(2.5, -0.65)
    assert command_for(Command(-1.0, 0.1)) == Command(0.0, 0.1)
    assert command_for(np.array([[9.0, 9.0], [9.0, 9.0], [9.0, 0.0]])) == Command(2.5, 0.0)
    assert command_for([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0]]) == Command(0.4, 0.0)


UNUSABLE: dict[str, tuple[object, str]] = {
    "nan": (Command(math.nan, 0.0), "Command(v_mps=nan, w_radps=0.0): both must be finite"),
    "infinity": (Command(0.0, -math.inf), "Command(v_mps=0.0, w_radps=-inf): both must be finite"),
    "text-in-command": (Command("fast", 0.0), "Command(v_mps='fast', w_radps=0.0): both must"),  # type: ignore[arg-type]
    "none-in-command": (Command(None, 0.0), "Command(v_mps=None, w_radps=0.0): both must"),  # type: ignore[arg-type]
    "complex-in-command": (Command(1j, 0.0), "Command(v_mps=1j, w_radps=0.0): both must"),  # type: ignore[arg-type]
    "truth-in-command": (Command(True, 0.0), "Command(v_mps=True, w_radps=0.0): both must"),
    "array-in-command": (Command(np.ones(2), 0.0), "both must be finite"),  # type: ignore[arg-type]
    "beyond-any-float": (
        Command(10**400, 0.0),
        "Command(v_mps=an integer of 1329 bits, w_radps=0.0): both must",
    ),
    "nan-waypoint": (np.array([[math.nan, 0.0]]), "waypoints with NaN or infinity: [nan, 0.0]"),
    "nan-later": (
        np.array([[1.0, 0.0], [math.inf, 0.0]]),
        "waypoints with NaN or infinity: [inf, 0.0]",
    ),
    "huge-waypoint": ([[10**400, 0]], "an array of object: waypoints are real numbers"),
    "one-row": (np.zeros((3,)), "an array of shape (3,): waypoints have shape (N, 2) or (N, 4)"),
    "no-row": (np.zeros((0, 2)), "an array of shape (0, 2)"),
    "three-columns": (np.zeros((4, 3)), "an array of shape (4, 3)"),
    "ragged": ([[1.0, 0.0], [1.0]], "neither a Command nor waypoints"),
    "none": (None, "answered None: neither a Command nor waypoints"),
    "text": ("go", "answered 'go': neither a Command nor waypoints"),
    "bytes": (b"go", "answered b'go': neither a Command nor waypoints"),
    "number": (1.0, "answered 1.0: neither a Command nor waypoints"),
    "dict": ({"v_mps": 1.0}, "answered {'v_mps': 1.0}: neither a Command nor waypoints"),
    "long": ({"v": "x" * 1000}, "answered a dict: neither a Command nor waypoints"),
    "generator": ((x for x in ()), "neither a Command nor waypoints"),
    "complex-waypoints": (
        np.array([[1.0 + 0j, 0.0]]),
        "an array of complex128: waypoints are real numbers",
    ),
    "text-waypoints": ([["1.0", "0.0"]], "an array of str96: waypoints are real numbers"),
    "truth-waypoints": (np.array([[True, False]]), "an array of bool: waypoints are real numbers"),
    "object-waypoints": (np.array([[1.0, None]]), "an array of object: waypoints are real numbers"),
    "dates": (
        np.array([["2020-01-01", "2020-01-02"]], dtype="datetime64[D]"),
        "waypoints are real numbers",
    ),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_an_unusable_answer_is_refused_with_its_value(name: str) -> None:
    """NaN, values that are not real numbers, wrong shapes and other objects raise PolicyError with
    the value."""
    answer, message = UNUSABLE[name]
    with pytest.raises(PolicyError) as caught:
        command_for(answer)
    assert message in str(caught.value)


def test_numbers_of_every_kind_are_commands() -> None:
    """Integers and numpy numbers of any width are read once, as floats."""
    assert command_for(Command(1, np.float32(0.5))) == Command(1.0, 0.5)
    assert command_for(Command(np.int64(1), np.float16(0.5))) == Command(1.0, 0.5)
    assert command_for(np.array([[1, 0]] * 3, dtype=np.uint8)) == Command(2.5, 0.0)
    assert command_for(np.array([[0.1, 0]] * 3, dtype=np.longdouble)) == Command(0.4, 0.0)
    assert command_for([(0.1, 0.0)] * 3) == Command(0.4, 0.0)


def test_a_clock_counts_in_whole_periods() -> None:
    """Ticks, substeps and policy periods are whole numbers, and a rate that does not divide is
    refused."""
    clock = Clock.for_rate(4)
    assert (clock.substeps, clock.time_s(7), clock.ticks(10.0)) == (10, 0.35, 200)
    assert [tick for tick in range(12) if clock.acts(tick)] == [0, 5, 10]
    with pytest.raises(SpecError, match="usual policy rates are 4, 5, 10, 20 Hz"):
        Clock.for_rate(7)

"""From a policy's answer to a command."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.clock import Clock
from cosim.core.errors import PolicyError, SpecError
from cosim.core.state import Command
from cosim.episode.control import command_from_waypoint, command_of
from cosim.spec.robot import COURIER


def of(answer: object) -> Command:
    return command_of(answer, waypoint_dt_s=0.25, robot=COURIER)


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


UNUSABLE: dict[str, tuple[object, str]] = {
    "nan": (Command(math.nan, 0.0), "Command(v_mps=nan, w_radps=0.0): both must be finite"),
    "infinity": (Command(0.0, -math.inf), "Command(v_mps=0.0, w_radps=-inf): both must be finite"),
    "text-in-command": (Command("fast", 0.0), "Command(v_mps='fast', w_radps=0.0): both must"),  # type: ignore[arg-type]
    "none-in-command": (Command(None, 0.0), "Command(v_mps=None, w_radps=0.0): both must"),  # type: ignore[arg-type]
    "complex-in-command": (Command(1j, 0.0), "Command(v_mps=1j, w_radps=0.0): both must"),  # type: ignore[arg-type]
    "truth-in-command": (Command(True, 0.0), "Command(v_mps=True, w_radps=0.0): both must"),
    "array-in-command": (Command(np.ones(2), 0.0), "both must be finite"),  # type: ignore[arg-type]
    "beyond-any-float": (Command(10**400, 0.0), "Command(v_mps=an integer of 1329 bits, w_radps=0.0): both must"),
    "nan-waypoint": (np.array([[math.nan, 0.0]]), "waypoints with NaN or infinity: [nan, 0.0]"),
    "nan-later": (np.array([[1.0, 0.0], [math.inf, 0.0]]), "waypoints with NaN or infinity: [inf, 0.0]"),
    "huge-waypoint": ([[10**400, 0]], "an array of object: waypoints are real numbers"),
    "one-row": (np.zeros((3,)), "an array of shape (3,): waypoints have shape (N, 2)"),
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
    "complex-waypoints": (np.array([[1.0 + 0j, 0.0]]), "an array of complex128: waypoints are real numbers"),
    "text-waypoints": ([["1.0", "0.0"]], "an array of str96: waypoints are real numbers"),
    "truth-waypoints": (np.array([[True, False]]), "an array of bool: waypoints are real numbers"),
    "object-waypoints": (np.array([[1.0, None]]), "an array of object: waypoints are real numbers"),
    "dates": (np.array([["2020-01-01", "2020-01-02"]], dtype="datetime64[D]"), "waypoints are real numbers"),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_an_unusable_answer_is_refused_with_what_came(name: str) -> None:
    """NaN, what is not real numbers, wrong shapes and other things raise PolicyError that says what came."""
    answer, message = UNUSABLE[name]
    with pytest.raises(PolicyError) as caught:
        of(answer)
    assert message in str(caught.value)


def test_numbers_of_every_kind_are_commands() -> None:
    """Integers and numpy's numbers of any width are read once, as floats."""
    assert of(Command(1, np.float32(0.5))) == Command(1.0, 0.5)
    assert of(Command(np.int64(1), np.float16(0.5))) == Command(1.0, 0.5)
    assert of(np.array([[1, 0]], dtype=np.uint8)) == Command(2.5, 0.0)
    assert of(np.array([[0.1, 0]], dtype=np.longdouble)) == Command(0.4, 0.0)
    assert of([(0.1, 0.0)]) == Command(0.4, 0.0)


def test_a_clock_counts_in_whole_periods() -> None:
    """Ticks, substeps and policy periods come from integers, and a rate that does not divide is refused."""
    clock = Clock.for_rate(4)
    assert (clock.substeps, clock.time_s(7), clock.ticks(10.0)) == (10, 0.35, 200)
    assert [tick for tick in range(12) if clock.acts(tick)] == [0, 5, 10]
    with pytest.raises(SpecError, match="usual policy rates are 4, 5, 10, 20 Hz"):
        Clock.for_rate(7)

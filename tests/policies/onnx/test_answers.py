"""Conversion of a graph's outputs to waypoints or a command."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from cosim.core.errors import PolicyError
from cosim.core.state import STILL, Command, WaypointCommand
from cosim.policies.onnx.outputs import GraphOutput, decode_answer
from cosim.spec.robot import COURIER, SCOUT

ROWS = np.array([[[1.0, 0.5], [2.0, 1.0], [3.0, 2.0]]])
WAYPOINTS = {"what": "waypoints", "name": "plan", "index": 1}


def answered(output: dict[str, Any], last: Command = STILL, **outputs: Any) -> Any:
    """Return the answer of a graph with this output."""
    arrays = {name: np.asarray(array, np.float32) for name, array in outputs.items()}
    return decode_answer(msgspec.convert(output, GraphOutput), arrays, COURIER, last)


PLANS: dict[str, tuple[dict[str, Any], Any, list[list[float]]]] = {
    "as-they-are": ({}, ROWS, [[1, 0.5], [2, 1], [3, 2]]),
    "steps": ({"steps": True}, ROWS, [[1, 0.5], [3, 1.5], [6, 3.5]]),
    "right-first": ({"columns": ["-y", "x"]}, ROWS, [[0.5, -1], [1, -2], [2, -3]]),
    "scaled": ({"scale": [2, 1], "offset": [0, 1]}, ROWS, [[2, 1.5], [4, 2], [6, 3]]),
    "in-one-row": ({}, ROWS.reshape(1, 6), [[1, 0.5], [2, 1], [3, 2]]),
    "first-sample": ({}, np.stack([ROWS, -ROWS]), [[1, 0.5], [2, 1], [3, 2]]),
    "heading": (
        {"columns": ["x", "y", "heading"]},
        [[[1, 0, math.pi / 2]] * 2],
        [[1, 0, 0, 1]] * 2,
    ),
    "cosine": (
        {"columns": ["x", "y", "cos", "sin"]},
        [[[1, 0, 0.6, 0.8]] * 2],
        [[1, 0, 0.6, 0.8]] * 2,
    ),
}


@pytest.mark.parametrize("name", PLANS)
def test_waypoints_are_read_by_their_columns(name: str) -> None:
    """They are summed, turned, scaled and offset as the output declares."""
    fields, expected, wanted = PLANS[name]
    np.testing.assert_allclose(answered(WAYPOINTS | fields, plan=expected), wanted, atol=1e-6)


def test_the_mode_with_the_highest_score_is_followed() -> None:
    """Scores are another output, or follow each mode's numbers and scales."""
    modes = np.stack([ROWS[0], -ROWS[0], 2 * ROWS[0]])[None]
    best = answered({**WAYPOINTS, "scores": "probs"}, plan=modes, probs=[[0.1, 0.2, 0.7]])
    np.testing.assert_allclose(best, 2 * ROWS[0])
    flat = [
        [*rows.ravel(), *np.ones(6), score] for rows, score in zip(modes[0], (0, 5, 1), strict=True)
    ]
    mixed = answered({**WAYPOINTS, "mixture": {"modes": 3, "points": 3}}, plan=np.ravel(flat)[None])
    np.testing.assert_allclose(mixed, -ROWS[0])


def test_speeds_of_a_plan_can_be_followed_in_place_of_its_waypoints() -> None:
    """The command is that of the declared row, and the waypoints are stored in metres."""
    output = {
        **WAYPOINTS,
        "columns": ["x", "y", "speed", "turn"],
        "follow": "speeds",
        "index": 0,
        "unit_m": 2,
    }
    answer = answered(output, plan=[[[1, 0, 0.7, 0.2], [2, 0, 0.8, 0.3]]])
    assert isinstance(answer, WaypointCommand) and (answer.v_mps, answer.w_radps) == pytest.approx(
        (0.7, 0.2)
    )
    np.testing.assert_allclose(answer.waypoints, [[2, 0], [4, 0]])


def test_wheel_speeds_turn_a_robot_by_its_track() -> None:
    """The same wheel speeds turn a narrower robot more."""
    wheels = {
        "what": "wheels",
        "left": {"name": "y"},
        "right": {"name": "y", "index": 1},
        "unit_mps": 2.0,
    }
    answer = answered(wheels, y=[[0.4, 0.5]])
    assert (answer.v_mps, answer.w_radps) == pytest.approx((0.9, 0.2 / COURIER.drive.span_m[1]))
    other = decode_answer(
        msgspec.convert(wheels, GraphOutput), {"y": np.array([[0.4, 0.5]])}, SCOUT
    )
    assert isinstance(other, Command) and other.w_radps == pytest.approx(
        0.2 / SCOUT.drive.span_m[1]
    )


def test_steering_slows_down_by_the_collision_probability() -> None:
    """Speed is scaled by 1 less the probability, and both are smoothed with the command before."""
    output = {"what": "steering", "turn": {"name": "steer"}, "unit_radps": -0.5, "speed_mps": 2.0}
    more = {"stop": {"name": "hit"}, "keep_speed": 0.75, "keep_turn": 0.5}
    answer = answered(output | more, last=Command(1.0, 0.2), steer=[[0.4]], hit=[[0.25]])
    assert (answer.v_mps, answer.w_radps) == pytest.approx((0.75 + 0.25 * 1.5, 0.1 - 0.1), abs=1e-6)
    assert answered(output, steer=[[0.4]]) == Command(2.0, pytest.approx(-0.2))


def test_a_command_is_two_numbers_in_their_units() -> None:
    """The two numbers are read from any place in the outputs."""
    output = {
        "what": "command",
        "v": {"name": "u", "index": 1},
        "w": {"name": "w"},
        "unit_mps": 2,
        "unit_radps": -1,
    }
    assert answered(output, u=[[9, 0.5]], w=[0.25]) == Command(1.0, -0.25)


def test_an_answer_with_nan_is_the_policys_crash() -> None:
    """The message names the output."""
    with pytest.raises(PolicyError, match="output 'plan' of the graph holds NaN or infinity"):
        answered(WAYPOINTS, plan=ROWS * np.nan)

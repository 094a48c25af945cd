"""From a graph's outputs to a policy's answer: waypoints, or a command."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import PolicyError, UsageError
from cosim.core.state import STILL, Command, Planned
from cosim.policies.onnx.graph import Tensor, TensorPort
from cosim.policies.onnx.outputs import (
    CommandOutput,
    Element,
    GraphOutput,
    SteeringOutput,
    WaypointsOutput,
    WheelsOutput,
)
from cosim.spec.robot import Robot

PolicyAnswer = Command | NDArray[np.float64]


def answer_of(output: GraphOutput, told: Mapping[str, Tensor], robot: Robot, last: Command = STILL) -> PolicyAnswer:
    """What the policy answers when the graph tells this; each tensor is of one observation. last: the answer before,
    STILL at the beginning. Raises PolicyError for what is not finite."""
    for name in output.outputs:
        if not np.isfinite(told[name]).all():
            raise PolicyError(f"output '{name}' of the graph holds NaN or infinity")
    if isinstance(output, WaypointsOutput):
        return _waypoints(output, told)
    if isinstance(output, WheelsOutput):
        left, right = (_number(told, one) * output.unit_mps for one in (output.left, output.right))
        return Command((left + right) / 2.0, (right - left) / robot.drive.span_m[1])
    if isinstance(output, CommandOutput):
        return Command(_number(told, output.v) * output.unit_mps, _number(told, output.w) * output.unit_radps)
    return _steered(output, told, last)


def check_outputs(output: GraphOutput, ports: Mapping[str, TensorPort]) -> None:
    """Raises UsageError for an output that the graph does not have."""
    for name in output.outputs:
        if name not in ports:
            raise UsageError(f"output: the graph has no output '{name}'. Valid choices: {', '.join(ports)}")


def _number(told: Mapping[str, Tensor], one: Element) -> float:
    numbers = told[one.name].ravel()
    if one.index >= numbers.size:
        raise UsageError(f"output: '{one.name}' holds {numbers.size} numbers, and number {one.index} (from 0) is asked")
    return float(numbers[one.index])


def _steered(output: SteeringOutput, told: Mapping[str, Tensor], last: Command) -> Command:
    v_mps = output.speed_mps
    if output.speed is not None:
        v_mps *= _number(told, output.speed)
    if output.stop is not None:
        v_mps *= 1.0 - _number(told, output.stop)
    w_radps = _number(told, output.turn) * output.unit_radps
    return Command(
        output.keep_speed * last.v_mps + (1.0 - output.keep_speed) * v_mps,
        output.keep_turn * last.w_radps + (1.0 - output.keep_turn) * w_radps,
    )


def _waypoints(output: WaypointsOutput, told: Mapping[str, Tensor]) -> PolicyAnswer:
    """(N, 2), or (N, 4) with cosine and sine of the heading, in the output's units; by the speeds a Planned."""
    rows = _rows(output, told)
    if output.scale:
        rows = rows * output.scale
    if output.offset:
        rows = rows + output.offset
    at = {
        column.removeprefix("-"): (i, -1.0 if column.startswith("-") else 1.0)
        for i, column in enumerate(output.columns)
    }

    def column(name: str) -> NDArray[np.float64]:
        index, sign = at[name]
        numbers: NDArray[np.float64] = rows[:, index] * sign
        return numbers

    x, y = (np.cumsum(column(name)) if output.steps else column(name) for name in "xy")
    if "heading" in at:
        turned = np.cumsum(column("heading")) if output.steps else column("heading")
        answer = np.stack([x, y, np.cos(turned), np.sin(turned)], axis=1)
    elif "cos" in at:
        answer = np.stack([x, y, column("cos"), column("sin")], axis=1)
    else:
        answer = np.stack([x, y], axis=1)
    if output.index >= len(answer):
        raise UsageError(
            f"output: '{output.name}' holds {len(answer)} waypoints, and waypoint {output.index} (from 0) is followed"
        )
    if output.follow == "waypoint":
        return answer
    answer[:, :2] *= output.unit_m
    v_mps, w_radps = (float(column(name)[output.index]) for name in ("speed", "turn"))
    return Planned(v_mps, w_radps, answer.astype(np.float32), output.index)


def _rows(output: WaypointsOutput, told: Mapping[str, Tensor]) -> NDArray[np.float64]:
    """The rows of the mode that is followed, (N, columns)."""
    numbers: NDArray[np.float64] = told[output.name].astype(float)
    width = len(output.columns)
    if output.mixture is not None:
        modes, points = output.mixture.modes, output.mixture.points
        if numbers.size != modes * (2 * points * width + 1):
            raise UsageError(
                f"output: '{output.name}' holds {numbers.size} numbers; {modes} modes of {points} points of {width} "
                f"values, their scales and a score are {modes * (2 * points * width + 1)}"
            )
        table = numbers.reshape(modes, -1)
        best: NDArray[np.float64] = table[int(np.argmax(table[:, -1])), : points * width].reshape(points, width)
        return best
    if numbers.shape[-1:] != (width,) or numbers.ndim < 2:
        if sum(side > 1 for side in numbers.shape) > 1 or numbers.size % width:
            raise UsageError(
                f"output: '{output.name}' is {numbers.shape}, and its last axis should hold the {width} columns "
                f"{list(output.columns)}"
            )
        return numbers.reshape(-1, width)
    points = numbers.shape[-2]
    modes_of = numbers.reshape(-1, points, width)
    scores = told[output.scores].ravel() if output.scores else np.zeros(len(modes_of))
    if len(scores) != len(modes_of):
        raise UsageError(f"output: '{output.scores}' holds {len(scores)} scores of {len(modes_of)} modes")
    rows: NDArray[np.float64] = modes_of[int(np.argmax(scores))]
    return rows

"""Outputs of a graph: the manifest field `output` and its decoding."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import PolicyError, UsageError
from cosim.core.state import STILL, Command, WaypointCommand
from cosim.policies.onnx.graph import Tensor, TensorPort
from cosim.spec.manifest import WaypointRule, WaypointRuleName
from cosim.spec.robot import Robot
from cosim.spec.validation import ItemCount, Ranged, Within

_NUMBER: Final = Within(-1e9, 1e9)
_ABOVE_0: Final = Within(0, 1e9, above=True)


class Element(Ranged, frozen=True, kw_only=True):
    """One number of an output.

    index: Index into the flattened output, from 0.
    """

    name: str
    index: Annotated[int, Within(0, 10**9)] = 0


class Mixture(Ranged, frozen=True, kw_only=True):
    """Waypoints of several modes in one row of numbers.

    Each of `modes` has the values of all points, an equal number of scales, and a score. The mode
    with the highest score is used.
    """

    modes: Annotated[int, Within(1, 10_000)]
    points: Annotated[int, Within(1, 10_000)]


class WaypointsOutput(Ranged, frozen=True, kw_only=True, tag="waypoints", tag_field="what"):
    """Waypoints in the robot's frame: the last axis holds `columns`, the one before the waypoints.

    Further axes are modes or samples. The first is used, or the one with the highest of the output
    `scores`.

    columns: Meaning of each column: x ahead, y left, -y right, heading in radians; "speed" in m/s,
        "turn" in rad/s; "" is unused.
    scale, offset: A number becomes number * scale + offset, one of each column; empty for 1 and 0.
    steps: Rows are differences; x, y and heading are summed.
    unit_m: Metres in one unit of x and y.
    index, dt_s, rule: Waypoint to follow, and how (`cosim.spec.manifest.WaypointRule`).
    follow: "speeds" uses speed and turn of row `index` as the command.
    scores: Output that selects the mode.
    """

    name: str
    columns: Annotated[
        tuple[
            Literal[
                "x",
                "-x",
                "y",
                "-y",
                "cos",
                "sin",
                "-sin",
                "heading",
                "-heading",
                "speed",
                "turn",
                "-turn",
                "",
            ],
            ...,
        ],
        ItemCount(2, 64),
    ] = ("x", "y")
    scale: Annotated[tuple[float, ...], ItemCount(0, 64)] = ()
    offset: Annotated[tuple[float, ...], ItemCount(0, 64)] = ()
    steps: bool = False
    unit_m: Annotated[float, _ABOVE_0] = 1.0
    index: Annotated[int, Within(0, 10_000)] = 2
    dt_s: Annotated[float, _ABOVE_0] = 0.25
    rule: WaypointRuleName = "shipped"
    follow: Literal["waypoint", "speeds"] = "waypoint"
    scores: str | None = None
    mixture: Mixture | None = None

    @property
    def prefix(self) -> str:
        return "waypoints "

    @property
    def waypoint_rule(self) -> WaypointRule:
        return WaypointRule(self.index, self.unit_m, self.dt_s, self.rule)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the graph's outputs that it reads."""
        return (self.name,) if self.scores is None else (self.name, self.scores)

    def contradictions(self) -> Iterator[str]:
        bare = [column.removeprefix("-") for column in self.columns if column]
        if len(set(bare)) != len(bare):
            yield f"waypoints columns must differ: {list(self.columns)}"
        wanted = {"x", "y"} | ({"speed", "turn"} if self.follow == "speeds" else set())
        if lacking := sorted(wanted - set(bare)):
            yield f"waypoints columns lack {', '.join(lacking)}: {list(self.columns)}"
        if ("cos" in bare) != ("sin" in bare) or ("cos" in bare and "heading" in bare):
            yield (
                f"waypoints columns must have cos and sin, or heading, or neither: "
                f"{list(self.columns)}"
            )
        for field in ("scale", "offset"):
            if (numbers := getattr(self, field)) and len(numbers) != len(self.columns):
                yield (
                    f"waypoints {field} must hold {len(self.columns)} numbers or none, not "
                    f"{len(numbers)}"
                )
        if self.mixture is not None and self.scores is not None:
            yield "waypoints mixture has scores of its own: leave scores out"
        if self.mixture is not None and self.index >= self.mixture.points:
            yield (
                f"waypoints index must be below mixture.points, {self.mixture.points}, not "
                f"{self.index}"
            )


class WheelsOutput(Ranged, frozen=True, kw_only=True, tag="wheels", tag_field="what"):
    """Speeds of the left and right wheels in units of `unit_mps`."""

    left: Element
    right: Element
    unit_mps: Annotated[float, _ABOVE_0] = 1.0

    @property
    def prefix(self) -> str:
        return "wheels "

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.left.name, self.right.name


class SteeringOutput(Ranged, frozen=True, kw_only=True, tag="steering", tag_field="what"):
    """Turning rate in units of `unit_radps`, positive to the left, and a speed.

    The speed is `speed_mps`, times the number `speed`, times 1 minus the number `stop`, if these
    are given.

    keep_turn, keep_speed: Fraction of the previous command in the next one (low-pass filter).
    """

    turn: Element
    unit_radps: Annotated[float, _NUMBER] = 1.0
    speed_mps: Annotated[float, _ABOVE_0] = 1.0
    speed: Element | None = None
    stop: Element | None = None
    keep_turn: Annotated[float, Within(0, 0.99)] = 0.0
    keep_speed: Annotated[float, Within(0, 0.99)] = 0.0

    @property
    def prefix(self) -> str:
        return "steering "

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(one.name for one in (self.turn, self.speed, self.stop) if one is not None)

    def contradictions(self) -> Iterator[str]:
        if self.unit_radps == 0.0:
            yield "steering unit_radps must not be 0"


class CommandOutput(Ranged, frozen=True, kw_only=True, tag="command", tag_field="what"):
    """Speed in units of `unit_mps`, and turning rate to the left in units of `unit_radps`."""

    v: Element
    w: Element
    unit_mps: Annotated[float, _ABOVE_0] = 1.0
    unit_radps: Annotated[float, _NUMBER] = 1.0

    @property
    def prefix(self) -> str:
        return "command "

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.v.name, self.w.name

    def contradictions(self) -> Iterator[str]:
        if self.unit_radps == 0.0:
            yield "command unit_radps must not be 0"


GraphOutput = WaypointsOutput | WheelsOutput | SteeringOutput | CommandOutput


PolicyAnswer = Command | NDArray[np.float64]


def decode_answer(
    output: GraphOutput, tensors: Mapping[str, Tensor], robot: Robot, last: Command = STILL
) -> PolicyAnswer:
    """Decode the outputs of a graph for one observation.

    last: Previous command, STILL at the beginning.
    Raises PolicyError for values that are not finite.
    """
    for name in output.outputs:
        if not np.isfinite(tensors[name]).all():
            raise PolicyError(f"output '{name}' of the graph holds NaN or infinity")
    if isinstance(output, WaypointsOutput):
        return _waypoints(output, tensors)
    if isinstance(output, WheelsOutput):
        left, right = (
            _number(tensors, one) * output.unit_mps for one in (output.left, output.right)
        )
        return Command((left + right) / 2.0, (right - left) / robot.drive.span_m[1])
    if isinstance(output, CommandOutput):
        return Command(
            _number(tensors, output.v) * output.unit_mps,
            _number(tensors, output.w) * output.unit_radps,
        )
    return _steered(output, tensors, last)


def check_outputs(output: GraphOutput, ports: Mapping[str, TensorPort]) -> None:
    """Raise UsageError for an output that the graph does not have."""
    for name in output.outputs:
        if name not in ports:
            raise UsageError(
                f"output: the graph has no output '{name}'. Valid choices: {', '.join(ports)}"
            )


def _number(tensors: Mapping[str, Tensor], one: Element) -> float:
    numbers = tensors[one.name].ravel()
    if one.index >= numbers.size:
        raise UsageError(
            f"output: '{one.name}' holds {numbers.size} numbers, and number {one.index} "
            f"(from 0) is requested"
        )
    return float(numbers[one.index])


def _steered(output: SteeringOutput, tensors: Mapping[str, Tensor], last: Command) -> Command:
    v_mps = output.speed_mps
    if output.speed is not None:
        v_mps *= _number(tensors, output.speed)
    if output.stop is not None:
        v_mps *= 1.0 - _number(tensors, output.stop)
    w_radps = _number(tensors, output.turn) * output.unit_radps
    return Command(
        output.keep_speed * last.v_mps + (1.0 - output.keep_speed) * v_mps,
        output.keep_turn * last.w_radps + (1.0 - output.keep_turn) * w_radps,
    )


def _waypoints(output: WaypointsOutput, tensors: Mapping[str, Tensor]) -> PolicyAnswer:
    """Return (N, 2), or (N, 4) with cosine and sine of the heading, in the output's units.

    A `WaypointCommand` if the speeds are followed.
    """
    rows = _rows(output, tensors)
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
            f"output: '{output.name}' holds {len(answer)} waypoints, and waypoint "
            f"{output.index} (from 0) is followed"
        )
    if output.follow == "waypoint":
        return answer
    answer[:, :2] *= output.unit_m
    v_mps, w_radps = (float(column(name)[output.index]) for name in ("speed", "turn"))
    return WaypointCommand(v_mps, w_radps, answer.astype(np.float32), output.index)


def _rows(output: WaypointsOutput, tensors: Mapping[str, Tensor]) -> NDArray[np.float64]:
    """Return the rows of the selected mode, (N, columns)."""
    numbers: NDArray[np.float64] = tensors[output.name].astype(float)
    width = len(output.columns)
    if output.mixture is not None:
        modes, points = output.mixture.modes, output.mixture.points
        if numbers.size != modes * (2 * points * width + 1):
            raise UsageError(
                f"output: '{output.name}' holds {numbers.size} numbers; {modes} modes of "
                f"{points} points of {width} "
                f"values, their scales and a score are {modes * (2 * points * width + 1)}"
            )
        table = numbers.reshape(modes, -1)
        best: NDArray[np.float64] = table[int(np.argmax(table[:, -1])), : points * width].reshape(
            points, width
        )
        return best
    if numbers.shape[-1:] != (width,) or numbers.ndim < 2:
        if sum(side > 1 for side in numbers.shape) > 1 or numbers.size % width:
            raise UsageError(
                f"output: '{output.name}' is {numbers.shape}, and its last axis should hold the "
                f"{width} columns {list(output.columns)}"
            )
        return numbers.reshape(-1, width)
    points = numbers.shape[-2]
    modes_of = numbers.reshape(-1, points, width)
    scores = tensors[output.scores].ravel() if output.scores else np.zeros(len(modes_of))
    if len(scores) != len(modes_of):
        raise UsageError(
            f"output: '{output.scores}' holds {len(scores)} scores of {len(modes_of)} modes"
        )
    rows: NDArray[np.float64] = modes_of[int(np.argmax(scores))]
    return rows

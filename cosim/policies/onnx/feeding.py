"""Convert observations to a graph's input tensors, including the history of an episode."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import UsageError
from cosim.core.geometry import wrap_angle
from cosim.episode.interfaces import Observation
from cosim.policies.onnx.graph import Tensor, TensorPort
from cosim.policies.onnx.inputs import (
    AnyInput,
    ConstantInput,
    GoalPictureInput,
    GoalPointInput,
    ImuInput,
    JoinedInput,
    MaskInput,
    NoiseInput,
    PastInput,
    PastPositionsInput,
    PeopleInput,
    PictureInput,
    PixelsInput,
    RoutePatchInput,
    ScanInput,
    SpeedsInput,
    StateInput,
    TurnInput,
    VectorInput,
)
from cosim.policies.onnx.pictures import (
    combine_frames,
    picture_tensor,
    tensor_shape,
    transpose_frame,
)
from cosim.spec.goal import PATCH_PX, Goal, ImageGoal, PointGoal, RoutePatch, TurningGoal

_GOAL_IS_GIVEN: Final = "a run gives the goals that the manifest asks for"


class Feeder:
    """Input tensors and history of one episode. Call `feed` once for each command of the policy.

    inputs: Inputs of the manifest by name.
    ports: Inputs of the graph by name.
    seed: Seed of noise inputs.
    Raises UsageError if a tensor cannot have the shape or type of the graph's input.
    """

    def __init__(
        self, inputs: Mapping[str, AnyInput], ports: Mapping[str, TensorPort], seed: int
    ) -> None:
        self._inputs = inputs
        self._ports = ports
        self._draws = np.random.default_rng(seed)
        self._past: dict[int, deque[Any]] = {}
        self._state: dict[str, Tensor] = {}
        for name, one in inputs.items():
            if isinstance(one, PixelsInput | RoutePatchInput):
                _check_pixels(name, one, ports[name])
        self.clear()

    def clear(self) -> None:
        """Clear the history after the robot was moved."""
        self._past.clear()
        for name, one in self._inputs.items():
            if isinstance(one, StateInput):
                self._state[name] = np.full(
                    _whole(name, self._ports[name]), one.begin, self._ports[name].dtype
                )

    def feed(self, seen: Observation) -> dict[str, Tensor]:
        """Return the input tensors, with a batch axis of length 1 if the graph has one."""
        return {name: self._tensor(name, one, seen) for name, one in self._inputs.items()}

    def remember(self, answer: Mapping[str, Tensor]) -> None:
        """Store the outputs that are the graph's state."""
        for name, one in self._inputs.items():
            if isinstance(one, StateInput):
                state = self._state[name]
                new = answer[one.output].astype(self._ports[name].dtype)
                if one.append:
                    row = new.reshape(state.shape[0], 1, *state.shape[2:])
                    new = np.concatenate([state, row], axis=1)[:, 1:]
                self._state[name] = new.reshape(state.shape)

    def _tensor(self, name: str, one: AnyInput, seen: Observation) -> Tensor:
        port = self._ports[name]
        if isinstance(one, StateInput):
            return self._state[name]
        if isinstance(one, NoiseInput):
            return self._draws.standard_normal(_whole(name, port)).astype(port.dtype)
        if isinstance(one, MaskInput):
            given = any(other.takes(seen.goal) for other in self._inputs.values())
            return np.full(_whole(name, port), one.given if given else one.missing, port.dtype)
        if isinstance(one, ConstantInput) and not isinstance(one.value, tuple):
            return np.full(_whole(name, port), one.value, port.dtype)
        if isinstance(one, PixelsInput | RoutePatchInput):
            return combine_frames(self._frames(one, seen), one.layout).astype(
                port.dtype, copy=False
            )
        return _shaped(name, self._numbers(one, seen), port)

    def _frames(self, one: PixelsInput | RoutePatchInput, seen: Observation) -> list[NDArray[Any]]:
        """Return the selected frames, transposed by `transpose_frame`."""
        now = _frame(one, seen)
        if now is None:
            assert (
                isinstance(one, GoalPictureInput | RoutePatchInput) and one.missing is not None
            ), _GOAL_IS_GIVEN
            now = np.full(_sides(one), one.missing, np.float32)
        now = transpose_frame(now, one.layout)
        return [np.zeros_like(now) if frame is None else frame for frame in self._past_of(one, now)]

    def _numbers(self, one: AnyInput, seen: Observation) -> NDArray[np.float64]:
        """Return the numbers of a vector, (frames, values) or fewer axes."""
        if isinstance(one, JoinedInput):
            return np.concatenate([self._numbers(part, seen).ravel() for part in one.parts])
        if isinstance(one, ConstantInput):
            return np.atleast_1d(np.asarray(one.value, float))
        if isinstance(one, TurnInput):
            return np.asarray(_turn_values(one, seen.goal), float)
        if isinstance(one, ScanInput | PeopleInput):
            now = _scan_values(one, seen) if isinstance(one, ScanInput) else _people(one, seen)
            past = self._past_of(one, now)
            return np.array([np.zeros_like(now) if row is None else row for row in past])
        assert isinstance(one, VectorInput)
        if isinstance(one, PastPositionsInput):
            rows: list[NDArray[np.float64] | None] = _seen_from_now(
                self._past_of(one, _place(seen)), one
            )
        else:
            now = (
                _goal_values(one, seen.goal)
                if isinstance(one, GoalPointInput)
                else _own_motion(one, seen)
            )
            rows = self._past_of(one, now)
        numbers = [
            None if row is None else (row - (one.mean or 0.0)) / (one.std or 1.0) for row in rows
        ]
        return np.array([np.zeros(len(one.values)) if row is None else row for row in numbers])

    def _past_of(self, one: PastInput, now: Any) -> list[Any]:
        """Add the newest value of an input and return its selected history; None means zeros."""
        past = self._past.get(id(one))
        if past is None:
            count = (one.frames - 1) * one.every
            past = self._past[id(one)] = deque(maxlen=count + 1)
            past.extend([now if one.before == "repeat" else None] * count)
        past.append(now)
        chosen = list(past)[:: one.every]
        return chosen if one.order == "oldest_first" else chosen[::-1]


def _frame(one: PixelsInput | RoutePatchInput, seen: Observation) -> NDArray[Any] | None:
    """Return (rows, columns, channels) of the current frame; None for another type of goal."""
    goal = seen.goal
    if isinstance(one, RoutePatchInput):
        if not isinstance(goal, RoutePatch):
            return None
        return np.where(goal.pixels[..., None] > 0, np.float32(one.on), np.float32(one.off))
    if isinstance(one, PictureInput):
        rgb = seen.pictures[one.camera].rgb if one.camera else seen.rgb
        assert rgb is not None, "the manifest asks for a camera"
        return picture_tensor(rgb, one)
    return picture_tensor(goal.rgb, one) if isinstance(goal, ImageGoal) else None


def _goal_values(one: GoalPointInput, goal: Goal | None) -> NDArray[np.float64]:
    """Return the values of a goal point in its units, or `missing` before normalisation."""
    if not isinstance(goal, PointGoal):
        assert one.missing is not None, _GOAL_IS_GIVEN
        return np.asarray(one.missing, float) * (one.std or 1.0) + (one.mean or 0.0)
    far_m = goal.distance_m
    scale = 1.0 if one.most_m is None or far_m <= one.most_m else one.most_m / far_m
    bearing = goal.bearing_rad
    known = {
        "x": goal.x_m * scale / one.unit_m,
        "y": goal.y_m * scale / one.unit_m,
        "distance": far_m * scale / one.unit_m,
        "cos": math.cos(bearing),
        "sin": math.sin(bearing),
        "bearing": bearing,
    }
    return _chosen(one.values, known)


def _own_motion(one: VectorInput, seen: Observation) -> NDArray[np.float64]:
    """Return the values of speeds or of an inertial sensor."""
    if isinstance(one, ImuInput):
        assert seen.imu is not None, "the manifest asks for an inertial sensor"
        gyro, accel = seen.imu.gyro_radps, seen.imu.accel_mps2
        read = {f"gyro_{axis}": v for axis, v in zip("xyz", gyro, strict=True)}
        read |= {f"accel_{axis}": v for axis, v in zip("xyz", accel, strict=True)}
        return _chosen(one.values, read)
    assert isinstance(one, SpeedsInput)
    return _chosen(one.values, {"v": seen.v_mps, "w": seen.w_radps})


def _scan_values(one: ScanInput, seen: Observation) -> NDArray[np.float64]:
    """Return the (rings, rays or sectors) distances of a scan in the input's units."""
    scan = seen.scan
    assert scan is not None, "the manifest asks for a lidar"
    most_m = scan.spec.range_m if one.most_m is None else one.most_m
    ranges = np.minimum(np.asarray(scan.ranges_m, np.float64), most_m)
    if one.sectors:
        ranges = ranges.reshape(len(ranges), one.sectors, -1).min(axis=2)
    return (ranges[:, ::-1] if one.clockwise else ranges) / one.unit_m


def _people(one: PeopleInput, seen: Observation) -> NDArray[np.float64]:
    """Return the (rows, values) numbers of tracked people."""
    tracks = seen.people
    assert tracks is not None, "the manifest asks for tracked people"
    rows = np.full((one.rows, len(one.values)), one.absent)
    numbers = np.asarray(tracks, np.float64)[: one.rows]
    for row, (x, y, vx, vy) in zip(rows, numbers.tolist(), strict=False):
        known = {"x": x, "y": y, "vx": vx, "vy": vy, "present": 1.0, "distance": math.hypot(x, y)}
        row[:] = _chosen(one.values, known)
    return rows


def _chosen(names: tuple[str, ...], known: Mapping[str, float]) -> NDArray[np.float64]:
    """Return values by name; a leading "-" negates."""
    return np.array([-known[name[1:]] if name.startswith("-") else known[name] for name in names])


def _place(seen: Observation) -> tuple[float, float, float]:
    """Return the odometry pose: x, y in metres and heading in radians."""
    odometry = seen.odometry
    assert odometry is not None and odometry.heading_rad is not None, (
        "the manifest asks for odometry with a heading"
    )
    return odometry.x_m, odometry.y_m, odometry.heading_rad


def _seen_from_now(past: list[Any], one: PastPositionsInput) -> list[NDArray[np.float64] | None]:
    """Return poses relative to the newest one, a row each; None where there is no pose."""
    x0, y0, heading0 = past[-1] if one.order == "oldest_first" else past[0]
    cos, sin = math.cos(heading0), math.sin(heading0)
    rows: list[NDArray[np.float64] | None] = []
    for place in past:
        if place is None:
            rows.append(None)
            continue
        dx = place[0] - x0
        dy = place[1] - y0
        turned = wrap_angle(place[2] - heading0)
        known = {
            "x": (cos * dx + sin * dy) / one.unit_m,
            "y": (-sin * dx + cos * dy) / one.unit_m,
            "heading": turned,
            "cos": math.cos(turned),
            "sin": math.sin(turned),
        }
        rows.append(_chosen(one.values, known))
    return rows


def _turn_values(one: TurnInput, goal: Goal | None) -> tuple[float, ...]:
    """Return the numbers of the direction to take."""
    if isinstance(goal, TurningGoal):
        turns = {"left": one.left, "straight": one.straight, "right": one.right}
        return turns[goal.turn(one.ahead_m, one.beyond_deg)]
    assert one.missing is not None, _GOAL_IS_GIVEN
    return one.missing


def _whole(name: str, port: TensorPort) -> tuple[int, ...]:
    """Return the shape of an input; only its first axis may be dynamic, and becomes 1."""
    if None in port.shape[1:]:
        raise UsageError(
            f"inputs.{name}: the graph wants {port.in_words}: export it with fixed sides but "
            f"the first"
        )
    return tuple(1 if side is None else side for side in port.shape)


def _shaped(name: str, numbers: NDArray[np.float64], port: TensorPort) -> Tensor:
    """Reshape numbers to an input, of which one axis in addition to the first may be dynamic."""
    shape = [1 if side is None and axis == 0 else side for axis, side in enumerate(port.shape)]
    free = shape.count(None)
    held = math.prod(side for side in shape if side is not None)
    if free > 1 or (numbers.size != held if not free else numbers.size % held):
        made = " x ".join(map(str, numbers.shape))
        raise UsageError(
            f"inputs.{name}: the graph wants {port.in_words}, and the manifest gives {made} numbers"
        )
    return numbers.reshape([-1 if side is None else side for side in shape]).astype(port.dtype)


def _check_pixels(name: str, one: PixelsInput | RoutePatchInput, port: TensorPort) -> None:
    """Raise UsageError unless a picture tensor matches the shape and type of an input."""
    shape = tensor_shape(_sides(one), one.frames, one.layout)
    if len(port.shape) != len(shape) or any(
        side not in (None, there) for side, there in zip(port.shape, shape, strict=True)
    ):
        raise UsageError(
            f"inputs.{name}: the graph wants {port.in_words}, and layout {one.layout!r} gives "
            f"{shape}: look at frames, size, colour and layout"
        )
    if port.dtype.kind in "iu" and isinstance(one, PixelsInput) and not one.keeps_bytes:
        raise UsageError(
            f"inputs.{name}: the graph wants {port.in_words}, whole numbers: say scale 1, "
            f"without mean and std"
        )


def _sides(one: PixelsInput | RoutePatchInput) -> tuple[int, int, int]:
    """Return rows, columns and channels of a frame."""
    return (
        (PATCH_PX, PATCH_PX, 1) if isinstance(one, RoutePatchInput) else (*one.sides, one.channels)
    )

"""Convert a policy's answer to a command: checks and waypoint rules.

The rules follow the robots of GNM (D. Shah et al., ICRA 2023), ViNT (D. Shah et al., CoRL 2023) and
NoMaD (A. Sridhar et al., ICRA 2024). One waypoint of the answer is reached in one time step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cosim.core.errors import PolicyError
from cosim.core.geometry import Floats
from cosim.core.state import STILL, Command, WaypointCommand
from cosim.spec.manifest import WaypointRule
from cosim.spec.robot import Robot

EPS_M = 1e-8
"""Coordinate in metres below which a waypoint counts as at the robot."""
MAX_NUMBERS = 100_000
"""Maximum number of numbers in a policy's answer."""
REAL_KINDS = "iuf"
"""numpy's kinds of real numbers: integers, unsigned integers, floats."""
_MAX_SHOWN = 80
"""Maximum length of an answer in a message, in characters."""
_COLUMNS = (2, 4)
"""Valid numbers of columns of waypoints."""
_MAX_RECORDED = 256
"""Maximum number of recorded waypoints of an answer; all up to the followed one are recorded."""
_LARGEST = float(np.finfo(np.float32).max)
"""Largest float32."""


def _command_for(x_m: float, y_m: float, heading_rad: float | None, rule: WaypointRule) -> Command:
    """Return the unclipped command for one waypoint (x forward, y left).

    heading_rad: heading of the waypoint, None without one.

    At the robot's own position the command turns to the heading, or stops without one. Exactly at
    its side it turns by a quarter turn. Otherwise v = x / dt, and w = arctan(y / x) / dt
    (`shipped`) or atan2(y, x) / dt (`atan2`).
    """
    if abs(x_m) < EPS_M and abs(y_m) < EPS_M:
        return STILL if heading_rad is None else Command(0.0, heading_rad / rule.dt_s)
    if abs(x_m) < EPS_M:
        return Command(0.0, math.copysign(math.pi / (2.0 * rule.dt_s), y_m))
    bearing_rad = math.atan(y_m / x_m) if rule.rule == "shipped" else math.atan2(y_m, x_m)
    return Command(x_m / rule.dt_s, bearing_rad / rule.dt_s)


def clipped(command: Command, robot: Robot) -> Command:
    """Return a command within a robot's limits. A negative speed becomes 0."""
    w_radps = min(max(command.w_radps, -robot.w_max_radps), robot.w_max_radps)
    return Command(min(max(command.v_mps, 0.0), robot.v_max_mps), w_radps)


def command_of(answer: object, *, rule: WaypointRule, robot: Robot) -> Command:
    """Return the clipped command of a policy's answer.

    answer: a Command, or waypoints (N, 2) or (N, 4), of which one is followed (the result is a
        WaypointCommand).
    Raises PolicyError with the answer for NaN, infinities, too few waypoints, more than
    MAX_NUMBERS numbers, and anything else than real numbers.
    """
    if isinstance(answer, Command):
        speeds = (answer.v_mps, answer.w_radps)
        numbers = [_number(speed) for speed in speeds]
        if not all(map(math.isfinite, numbers)):
            shown = ", ".join(
                f"{name}={_shown(s)}" for name, s in zip(("v_mps", "w_radps"), speeds, strict=True)
            )
            raise PolicyError(f"answered Command({shown}): both must be finite numbers")
        command = clipped(Command(*numbers), robot)
        if not isinstance(answer, WaypointCommand):
            return command
        return _with_waypoints(command, _waypoints(answer.waypoints, rule.index), rule.index)
    waypoints = _waypoints(answer, rule.index)
    x, y, *turn = waypoints[rule.index].tolist()
    heading_rad = math.atan2(turn[1], turn[0]) if turn else None
    command = clipped(_command_for(x * rule.unit_m, y * rule.unit_m, heading_rad, rule), robot)
    waypoints[:, :2] *= rule.unit_m
    return _with_waypoints(command, waypoints, rule.index)


def _with_waypoints(command: Command, waypoints: Floats, index: int) -> WaypointCommand:
    """Return a command together with its waypoints in metres."""
    recorded = np.clip(waypoints[: max(_MAX_RECORDED, index + 1)], -_LARGEST, _LARGEST).astype(
        np.float32
    )
    return WaypointCommand(command.v_mps, command.w_radps, recorded, index)


def _waypoints(answer: object, index: int) -> Floats:
    """Return a copy of an answer's waypoints, (N, 2) or (N, 4), finite and more than `index`."""
    try:
        array = np.asarray(answer)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise PolicyError(f"answered {_shown(answer)}: neither a Command nor waypoints") from error
    if array.ndim == 0:
        raise PolicyError(f"answered {_shown(answer)}: neither a Command nor waypoints")
    if array.dtype.kind not in REAL_KINDS:
        raise PolicyError(f"answered an array of {array.dtype.name}: waypoints are real numbers")
    check_numbers(array.shape)
    if array.ndim != 2 or array.shape[0] < 1 or array.shape[1] not in _COLUMNS:
        raise PolicyError(
            f"answered an array of shape {array.shape}: waypoints have shape (N, 2) or (N, "
            f"4), N >= 1"
        )
    with np.errstate(over="ignore"):
        waypoints = array.astype(float)
    if not np.isfinite(waypoints).all():
        first = waypoints[~np.isfinite(waypoints).all(axis=1)][0].tolist()
        raise PolicyError(f"answered waypoints with NaN or infinity: {first}")
    if len(waypoints) <= index:
        raise PolicyError(
            f"answered waypoints of shape {array.shape}, and waypoint {index} (from 0) is "
            f"followed: answer at least {index + 1}, or say which one in the manifest, as "
            f"waypoints=WaypointRule(index={len(waypoints) - 1})"
        )
    return waypoints


def check_numbers(shape: Sequence[int]) -> None:
    """Raise PolicyError for an array shape with too many numbers."""
    if (count := math.prod(shape)) > MAX_NUMBERS:
        shown = ", ".join(map(str, shape[:4])) + (
            ", ..." if len(shape) > 4 else "," * (len(shape) == 1)
        )
        raise PolicyError(
            f"answered an array of shape ({shown}): {count} numbers; an answer holds at most "
            f"{MAX_NUMBERS}"
        )


def _number(value: object) -> float:
    """Return a real number as float; NaN for other types, inf for a too large integer."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.floating | np.integer):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _shown(value: object) -> str:
    """Return an answer for a message: its repr if it is short and stable, else its type."""
    if isinstance(value, int) and value.bit_length() > _MAX_SHOWN:
        return f"an integer of {value.bit_length()} bits"
    try:
        text = repr(value)
    except Exception:  # noqa: BLE001  a repr may do anything
        return f"a {type(value).__name__}"
    stable = " at 0x" not in text
    short = len(text) <= _MAX_SHOWN and text.isprintable()
    return text if stable and short else f"a {type(value).__name__}"

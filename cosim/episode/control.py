"""From a policy's answer to a command: checks, and the field's PD rule for waypoints.

The rule is the one shipped with GNM, ViNT and NoMaD: v = dx / dt, w = atan2(dy, dx) / dt, clipped to the robot.
"""

from __future__ import annotations

import math

import numpy as np

from cosim.core.errors import PolicyError
from cosim.core.state import Command
from cosim.spec.robot import Robot

EPS_M = 1e-8
REAL_KINDS = "iuf"
"""The kinds of numpy that are real numbers: integers, unsigned, floating."""
_MOST_SHOWN = 80


def command_from_waypoint(dx_m: float, dy_m: float, dt_s: float) -> Command:
    """The PD rule for one waypoint (x forward, y left) to be reached in `dt_s`; not yet clipped."""
    if abs(dx_m) < EPS_M and abs(dy_m) < EPS_M:
        return Command(0.0, 0.0)
    if abs(dx_m) < EPS_M:
        return Command(0.0, math.copysign(math.pi / (2.0 * dt_s), dy_m))
    return Command(dx_m / dt_s, math.atan2(dy_m, dx_m) / dt_s)


def clipped(command: Command, robot: Robot) -> Command:
    """`command` within a robot's limits. Policies drive forward: a negative speed becomes 0."""
    w_radps = min(max(command.w_radps, -robot.w_max_radps), robot.w_max_radps)
    return Command(min(max(command.v_mps, 0.0), robot.v_max_mps), w_radps)


def command_of(answer: object, *, waypoint_dt_s: float, robot: Robot) -> Command:
    """The clipped command in a policy's answer: a Command, or waypoints (N, 2) of which the first is followed.

    Raises PolicyError, saying what was answered, for NaN, infinities, and anything that is not real numbers of that
    shape: truth values, texts and complex numbers are none.
    """
    if isinstance(answer, Command):
        speeds = (answer.v_mps, answer.w_radps)
        numbers = [_number(speed) for speed in speeds]
        if not all(map(math.isfinite, numbers)):
            shown = ", ".join(f"{name}={_shown(s)}" for name, s in zip(("v_mps", "w_radps"), speeds, strict=True))
            raise PolicyError(f"answered Command({shown}): both must be finite numbers")
        return clipped(Command(*numbers), robot)
    dx_m, dy_m = _first_waypoint(answer)
    return clipped(command_from_waypoint(dx_m, dy_m, waypoint_dt_s), robot)


def _first_waypoint(answer: object) -> tuple[float, float]:
    """The first of waypoints (N, 2), all of which must be finite."""
    try:
        array = np.asarray(answer)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise PolicyError(f"answered {_shown(answer)}: neither a Command nor waypoints") from error
    if array.ndim == 0:
        raise PolicyError(f"answered {_shown(answer)}: neither a Command nor waypoints")
    if array.dtype.kind not in REAL_KINDS:
        raise PolicyError(f"answered an array of {array.dtype.name}: waypoints are real numbers")
    if array.ndim != 2 or array.shape[0] < 1 or array.shape[1] != 2:
        raise PolicyError(f"answered an array of shape {array.shape}: waypoints have shape (N, 2), N >= 1")
    with np.errstate(over="ignore"):
        waypoints = array.astype(float)
    if not np.isfinite(waypoints).all():
        first = waypoints[~np.isfinite(waypoints).all(axis=1)][0].tolist()
        raise PolicyError(f"answered waypoints with NaN or infinity: {first}")
    return float(waypoints[0, 0]), float(waypoints[0, 1])


def _number(value: object) -> float:
    """A real number as float, read once; NaN for anything else, and for what is beyond any float."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.floating | np.integer):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _shown(value: object) -> str:
    """An answer as it is told: its repr if that is short and can be had, else its kind."""
    if isinstance(value, int) and value.bit_length() > _MOST_SHOWN:
        return f"an integer of {value.bit_length()} bits"
    try:
        text = repr(value)
    except Exception:  # noqa: BLE001  a repr may do anything
        return f"a {type(value).__name__}"
    tells = len(text) <= _MOST_SHOWN and text.isprintable() and " at 0x" not in text  # an address is another every time
    return text if tells else f"a {type(value).__name__}"

"""From a policy's answer to a command: checks, and the field's PD rule for waypoints.

The rule is the one shipped with GNM, ViNT and NoMaD: v = dx / dt, w = atan2(dy, dx) / dt, clipped to the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cosim.errors import PolicyError
from cosim.state import Command

EPS_M = 1e-8


@dataclass(frozen=True, slots=True)
class Limits:
    """What the robot is able to do: speeds as magnitudes."""

    v_mps: float = 2.5
    w_radps: float = 0.65


def command_from_waypoint(dx_m: float, dy_m: float, dt_s: float) -> Command:
    """The PD rule for one waypoint (x forward, y left) to be reached in `dt_s`; not yet clipped."""
    if abs(dx_m) < EPS_M and abs(dy_m) < EPS_M:
        return Command(0.0, 0.0)
    if abs(dx_m) < EPS_M:
        return Command(0.0, math.copysign(math.pi / (2.0 * dt_s), dy_m))
    return Command(dx_m / dt_s, math.atan2(dy_m, dx_m) / dt_s)


def clipped(command: Command, limits: Limits) -> Command:
    """`command` within the robot's limits. Policies drive forward: a negative speed becomes 0."""
    return Command(
        min(max(command.v_mps, 0.0), limits.v_mps), min(max(command.w_radps, -limits.w_radps), limits.w_radps)
    )


def command_of(answer: object, *, waypoint_dt_s: float, limits: Limits, who: str) -> Command:
    """The clipped command in a policy's answer: a Command, or waypoints (N, 2) of which the first is followed.

    Raises PolicyError, naming the policy and what it answered, for NaN, infinities and anything of another shape.
    """
    if isinstance(answer, Command):
        v_mps, w_radps = answer.v_mps, answer.w_radps
        if not (_is_number(v_mps) and _is_number(w_radps)):
            kinds = f"{type(v_mps).__name__}, {type(w_radps).__name__}"
            raise PolicyError(f"policy '{who}' answered a Command of {kinds}: both speeds must be finite numbers")
        return clipped(Command(float(v_mps), float(w_radps)), limits)
    try:
        waypoints = np.asarray(answer, dtype=float)
    except (TypeError, ValueError) as error:
        raise PolicyError(
            f"policy '{who}' answered a {type(answer).__name__}: neither a Command nor waypoints"
        ) from error
    if waypoints.ndim != 2 or waypoints.shape[0] < 1 or waypoints.shape[1] != 2:
        raise PolicyError(
            f"policy '{who}' answered an array of shape {waypoints.shape}: waypoints have shape (N, 2), N >= 1"
        )
    if not np.isfinite(waypoints).all():
        first = waypoints[~np.isfinite(waypoints).all(axis=1)][0].tolist()
        raise PolicyError(f"policy '{who}' answered waypoints with NaN or infinity: {first}")
    return clipped(command_from_waypoint(float(waypoints[0, 0]), float(waypoints[0, 1]), waypoint_dt_s), limits)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.floating | np.integer) and math.isfinite(value)

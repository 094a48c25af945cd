"""Skid steering: converts forward speed and yaw rate into wheel speeds.

Wheels that slide sideways turn the robot less than their speeds imply, depending on the floor. A
yaw-rate controller (feed-forward, proportional, integral) closes that gap, as on real robots. Speed
needs no controller because wheels hardly slip lengthwise. At rest the wheels are locked.
"""

from __future__ import annotations

import math
from typing import Final

from cosim.core.state import Command
from cosim.spec.robot import Robot

_FEED_FORWARD: Final = 1.2
"""Feed-forward gain of the yaw-rate controller."""

_PROPORTIONAL: Final = 0.5
"""Proportional gain of the yaw-rate controller."""

_INTEGRAL_HZ: Final = 5.0
"""Integral gain of the yaw-rate controller in 1/s."""

_INTEGRAL_MAX_RADPS: Final = 2.0
"""Limit of the integral term in rad/s."""


class SkidDrive:
    """Drive controller of one robot: acceleration ramps and yaw-rate integral."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._zero_speeds = [0.0] * len(robot.drive.joints)
        self.reset()

    def reset(self) -> None:
        """Reset the controller to rest."""
        self._v_mps = 0.0
        self._w_radps = 0.0
        self._integral_radps = 0.0

    def joint_speeds(self, command: Command, w_radps: float, dt_s: float) -> list[float]:
        """Return wheel speeds in rad/s, in the order of `Skid.joints`. Call once per substep.

        command: within the robot's limits (see `cosim.episode.control`)
        w_radps: measured yaw rate
        dt_s: duration of a substep
        """
        robot = self._robot
        drive = self._robot.drive
        self._v_mps = _towards(self._v_mps, command.v_mps, robot.acceleration_mps2 * dt_s)
        self._w_radps = _towards(self._w_radps, command.w_radps, robot.acceleration_radps2 * dt_s)
        if self._v_mps == 0.0 and self._w_radps == 0.0:
            self._integral_radps = 0.0
            return self._zero_speeds
        error = self._w_radps - w_radps
        integral = self._integral_radps + _INTEGRAL_HZ * error * dt_s
        self._integral_radps = min(max(integral, -_INTEGRAL_MAX_RADPS), _INTEGRAL_MAX_RADPS)
        turn = _FEED_FORWARD * self._w_radps + _PROPORTIONAL * error + self._integral_radps
        half_difference = 0.5 * drive.span_m[1] * turn
        radius_m = drive.wheel_radius_m
        left = (self._v_mps - half_difference) / radius_m
        right = (self._v_mps + half_difference) / radius_m
        return [left] * len(drive.left) + [right] * len(drive.right)


def _towards(value: float, goal: float, step: float) -> float:
    return goal if abs(goal - value) <= step else value + math.copysign(step, goal - value)

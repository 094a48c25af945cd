"""Skid steering: a command of forward speed and yaw rate becomes wheel speeds.

Wheels that must slide sideways turn a robot by less than their speeds say, and by how much depends
on the floor. As on real robots a yaw-rate loop (feed-forward, proportional, integral) closes that
gap; speed needs no loop, because the wheels hardly slip along their way. At rest the wheels are
simply locked.
"""

from __future__ import annotations

import math
from typing import Final

from cosim.core.state import Command
from cosim.spec.robot import Robot

_FORWARD: Final = 1.2
_PROPORTIONAL: Final = 0.5
_INTEGRAL_HZ: Final = 5.0
_EXTRA_MAX_RADPS: Final = 2.0


class SkidDrive:
    """The drive of one robot; remembers its ramps and the yaw loop's integral."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._still = [0.0] * len(robot.drive.joints)
        self.reset()

    def reset(self) -> None:
        """At rest."""
        self._v_mps = 0.0
        self._w_radps = 0.0
        self._extra_radps = 0.0

    def joint_speeds(self, command: Command, w_radps: float, dt_s: float) -> list[float]:
        """Speeds of the wheels in rad/s, in the order of `Skid.joints`, given the measured yaw
        rate; one call per substep. The command is within the robot's limits
        (`cosim.episode.control`)."""
        robot = self._robot
        skid = self._robot.drive
        self._v_mps = _towards(self._v_mps, command.v_mps, robot.acceleration_mps2 * dt_s)
        self._w_radps = _towards(self._w_radps, command.w_radps, robot.acceleration_radps2 * dt_s)
        if self._v_mps == 0.0 and self._w_radps == 0.0:
            self._extra_radps = 0.0
            return self._still
        error = self._w_radps - w_radps
        extra = self._extra_radps + _INTEGRAL_HZ * error * dt_s
        self._extra_radps = min(max(extra, -_EXTRA_MAX_RADPS), _EXTRA_MAX_RADPS)
        turn = _FORWARD * self._w_radps + _PROPORTIONAL * error + self._extra_radps
        apart = 0.5 * skid.span_m[1] * turn
        radius_m = skid.wheel_radius_m
        left = (self._v_mps - apart) / radius_m
        right = (self._v_mps + apart) / radius_m
        return [left] * len(skid.left) + [right] * len(skid.right)


def _towards(value: float, goal: float, step: float) -> float:
    return goal if abs(goal - value) <= step else value + math.copysign(step, goal - value)

"""Skid steering: a command of forward speed and yaw rate becomes wheel speeds.

Wheels that must slide sideways turn a robot by less than their speeds say, and by how much depends on the floor.
As on real robots a yaw-rate loop (feed-forward, proportional, integral) closes that gap; speed needs no loop,
because the wheels hardly slip along their way. At rest the wheels are simply locked.
"""

from __future__ import annotations

import math
from typing import Final

from cosim.core.state import Command
from physics.robots import RobotModel

_FORWARD: Final = 1.2
_PROPORTIONAL: Final = 0.5
_INTEGRAL_HZ: Final = 5.0
_EXTRA_MAX_RADPS: Final = 2.0


class SkidDrive:
    """The drive of one robot; remembers its ramps and the yaw loop's integral."""

    def __init__(self, model: RobotModel) -> None:
        self._model = model
        self.reset()

    def reset(self) -> None:
        """At rest."""
        self._v_mps = 0.0
        self._w_radps = 0.0
        self._extra_radps = 0.0

    def wheel_speeds(self, command: Command, w_radps: float, dt_s: float) -> tuple[float, float]:
        """Speeds of the left and right wheels in rad/s, given the measured yaw rate; one call per substep."""
        model = self._model
        v_goal = min(max(command.v_mps, -model.v_max_mps), model.v_max_mps)
        w_goal = min(max(command.w_radps, -model.w_max_radps), model.w_max_radps)
        self._v_mps = _towards(self._v_mps, v_goal, model.acceleration_mps2 * dt_s)
        self._w_radps = _towards(self._w_radps, w_goal, model.acceleration_radps2 * dt_s)
        if self._v_mps == 0.0 and self._w_radps == 0.0:
            self._extra_radps = 0.0
            return 0.0, 0.0
        error = self._w_radps - w_radps
        extra = self._extra_radps + _INTEGRAL_HZ * error * dt_s
        self._extra_radps = min(max(extra, -_EXTRA_MAX_RADPS), _EXTRA_MAX_RADPS)
        turn = _FORWARD * self._w_radps + _PROPORTIONAL * error + self._extra_radps
        apart = 0.5 * model.track_m * turn
        return (self._v_mps - apart) / model.wheel_radius_m, (self._v_mps + apart) / model.wheel_radius_m


def _towards(value: float, goal: float, step: float) -> float:
    return goal if abs(goal - value) <= step else value + math.copysign(step, goal - value)

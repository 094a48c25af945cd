"""Mean speeds over a gait cycle, falls and impossible states of a robot with legs."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Final

from cosim.core.errors import EngineError
from cosim.core.state import RobotState
from cosim.spec.robot import Legs

DOWN_RAD: Final = math.radians(60.0)
"""Lean of the trunk from the vertical above which the robot is down."""

DOWN_SHARE: Final = 0.45
"""Share of the trunk's height at rest below which the robot is down."""

_SINKS_M: Final = 0.3
"""Depth in metres of the trunk's middle below the ground that no sound simulation gives."""

_FLIES_M: Final = 3.0
"""Height in metres of the trunk's middle over its height at rest that no sound simulation gives."""


class LegMonitor:
    """Monitor of one robot with legs: mean speeds, falls and impossible states.

    cycle_s: duration of a gait cycle, over which speeds are averaged
    dt_s: duration of a substep
    """

    def __init__(self, legs: Legs, cycle_s: float, dt_s: float) -> None:
        self._legs = legs
        self._count = max(round(cycle_s / dt_s), 1)
        self.reset()

    def reset(self) -> None:
        """Clear the motion: the robot was reset and is at rest."""
        self._speeds = deque([(0.0, 0.0)] * self._count, maxlen=self._count)

    def add(self, speeds: tuple[float, float]) -> None:
        """Add the speed along the heading and the yaw rate after a substep."""
        self._speeds.append(speeds)

    def assess(self, robot: RobotState, ground_m: float, touches: bool) -> tuple[RobotState, bool]:
        """Return a state with mean speeds, and whether the robot is down.

        robot: state after the last substep
        ground_m: height of the ground below the robot
        touches: whether the trunk touches the ground

        Raises EngineError with the engine's values for an impossible state.
        """
        over_m = robot.z_m - ground_m
        if not -self._legs.stand_m - _SINKS_M < over_m < _FLIES_M:  # also true for NaN
            raise EngineError(
                f"PyBullet: the robot with legs is at ({robot.pose.x_m:.3g}, {robot.pose.y_m:.3g}, "
                f"{robot.z_m + self._legs.stand_m:.3g}) m over ground at {ground_m:.3g} m, with "
                f"{robot.v_mps:.3g} m/s and {robot.w_radps:.3g} rad/s: it sinks or flies"
            )
        down = (
            touches
            or robot.tilt_rad > DOWN_RAD
            or over_m + self._legs.stand_m < DOWN_SHARE * self._legs.stand_m
        )
        v_mps = math.fsum([v for v, _ in self._speeds]) / self._count
        w_radps = math.fsum([w for _, w in self._speeds]) / self._count
        return replace(robot, v_mps=v_mps, w_radps=w_radps), down

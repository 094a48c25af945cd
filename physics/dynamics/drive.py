"""Drives: convert commands into motions of a robot's joints.

Skid steering: wheels that slide sideways turn the robot less than their speeds imply, depending on
the floor. A yaw-rate controller (feed-forward, proportional, integral) closes that gap, as on real
robots. Speed needs no controller because wheels hardly slip lengthwise. At rest the wheels are
locked.

Legs are in `physics.dynamics.legs`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Protocol

from cosim.core.state import Command
from cosim.spec.robot import Robot, Skid

Vector = tuple[float, float, float]

SUBSTEP_S: Final = 0.005
"""Duration of a physics substep in seconds."""

_FEED_FORWARD: Final = 1.2
"""Feed-forward gain of the yaw-rate controller."""

_PROPORTIONAL: Final = 0.5
"""Proportional gain of the yaw-rate controller."""

_INTEGRAL_HZ: Final = 5.0
"""Integral gain of the yaw-rate controller in 1/s."""

_INTEGRAL_MAX_RADPS: Final = 2.0
"""Limit of the integral term in rad/s."""


class MeasuredBody(NamedTuple):
    """Measured state of a robot's base link and joints.

    at_m: position of the base frame in the world.
    rotation: nine entries of the base link's rotation matrix, by rows.
    velocity_mps, spin_radps: velocity of the base link's centre of mass and angular velocity, in
        the world.
    angles_rad, speeds_radps: of the joints, if `Drive.reads_joints`; else empty.
    """

    at_m: Vector
    rotation: tuple[float, ...]
    velocity_mps: Vector
    spin_radps: Vector
    angles_rad: tuple[float, ...] = ()
    speeds_radps: tuple[float, ...] = ()


class Motors(NamedTuple):
    """Values for the motors of all joints in a substep.

    values: target speeds in rad/s, or torques in Nm.
    limits_nm: limits of the torques that reach the target speeds; None if `values` are torques.
    """

    values: list[float]
    limits_nm: list[float] | None = None


class Drive(Protocol):
    """Controller of one robot's joints."""

    @property
    def reads_joints(self) -> bool:
        """Whether `MeasuredBody` must have the joints."""

    @property
    def cycle_s(self) -> float:
        """Duration of a gait cycle in seconds, over which speeds are averaged; 0 for wheels."""

    def reset(self) -> None:
        """Reset the controller to rest."""

    def step(self, command: Command, body: MeasuredBody) -> Motors:
        """Return the motors' values for the next substep. Call once per substep.

        command: within the robot's limits (see `cosim.episode.control`)
        """


class SkidDrive:
    """Drive of a robot on wheels: acceleration ramps and yaw-rate integral.

    dt_s: duration of a substep
    """

    reads_joints = False
    cycle_s = 0.0

    def __init__(self, robot: Robot, skid: Skid, dt_s: float) -> None:
        self._robot = robot
        self._skid = skid
        self._dt_s = dt_s
        self._zero_speeds = [0.0] * len(skid.joints)
        self._limits_nm = [skid.torque_nm] * len(skid.joints)
        self.reset()

    def reset(self) -> None:
        """Reset the controller to rest."""
        self._v_mps = 0.0
        self._w_radps = 0.0
        self._integral_radps = 0.0

    def step(self, command: Command, body: MeasuredBody) -> Motors:
        """Return wheel speeds in rad/s, in the order of `Skid.joints`."""
        return Motors(self._joint_speeds(command, body.spin_radps[2]), self._limits_nm)

    def _joint_speeds(self, command: Command, w_radps: float) -> list[float]:
        dt_s = self._dt_s
        robot = self._robot
        drive = self._skid
        self._v_mps = towards(self._v_mps, command.v_mps, robot.acceleration_mps2 * dt_s)
        self._w_radps = towards(self._w_radps, command.w_radps, robot.acceleration_radps2 * dt_s)
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


def towards(value: float, goal: float, step: float) -> float:
    """Return a value that is moved towards a goal by at most a step."""
    return goal if abs(goal - value) <= step else value + math.copysign(step, goal - value)

"""Trot of a quadruped: foot placement after Raibert, and inverse kinematics in closed form.

Diagonal pairs of feet carry the trunk in turn. Feet on the ground move backwards by the commanded
speed and yaw rate. The others swing to where the trunk's measured motion will balance over them.
Legs get longer on the lower side of a tilted trunk. Without a command the robot stands.

All arithmetic is in Python floats, so that no library changes the bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from cosim.core.state import Command
from cosim.spec.robot import Legs, Robot
from physics.dynamics.drive import MeasuredBody, towards
from physics.dynamics.legs.pd import torques_nm
from physics.robots.dog import HIP_AHEAD_M, HIP_ASIDE_M, SEGMENT_M, THIGH_ASIDE_M

_HIPS_M: Final = tuple(
    (ahead * HIP_AHEAD_M, left * HIP_ASIDE_M) for ahead in (1.0, -1.0) for left in (1.0, -1.0)
)
"""Hip joints in the trunk's frame: front left, front right, rear left, rear right."""
_SIDES: Final = (1.0, -1.0, 1.0, -1.0)
_PAIRS: Final = ((0, 3), (1, 2))
"""Diagonal pairs of legs, which swing together."""
_REACH_M: Final = (0.10, 0.42)
"""Smallest and largest distance in metres of a foot from its thigh joint."""
_STILL: Final = 1e-9


class TrotGains(NamedTuple):
    """Numbers of the trot, found by `scenarios.tools.bench.search_trot`.

    half_period_s: duration of one pair's swing.
    height_m: height of the trunk's middle over the balls of the feet.
    lift_m: height of the swinging feet.
    catch_s: shift of the touch-down per difference of measured and commanded speed.
    level: share of a tilt that the legs' lengths undo.
    v_start_mps: speed that cancels the drift of steps on the spot.
    v_factor, v_share, v_gain_hz: factor, proportional and integral gain of the speed.
    w_factor, w_share, w_gain_hz: the same of the yaw rate.
    y_share, y_gain_hz: share of a sideways speed, and rate of a sideways slip, that are undone.
    aside_m: distance of the feet outside of the legs' planes.
    ahead_m: distance of the feet ahead of the hips.
    sink_m: depth below the ground to which feet are pressed at touch-down.
    shake_mps, shake_rad: measured speed and tilt above which a standing robot steps.
    """

    half_period_s: float = 0.105
    height_m: float = 0.255
    lift_m: float = 0.066
    catch_s: float = 0.025
    level: float = 0.3
    v_start_mps: float = 0.15
    v_factor: float = 0.92
    v_share: float = 0.3
    v_gain_hz: float = 0.65
    w_factor: float = 1.0
    w_share: float = 0.85
    w_gain_hz: float = 2.0
    y_share: float = 0.6
    y_gain_hz: float = 1.0
    aside_m: float = 0.0
    ahead_m: float = 0.01
    sink_m: float = 0.0
    shake_mps: float = 0.25
    shake_rad: float = 0.25


GAINS: Final = TrotGains()
"""Numbers of the quadruped's trot."""

_INTEGRAL_MPS: Final = 0.4
"""Largest correction of the speed by its integral, in m/s."""
_INTEGRAL_RADPS: Final = 0.5
"""Largest correction of the yaw rate by its integral, in rad/s."""
_ASTRAY_M: Final = 0.15
"""Largest way in metres that the robot has slipped sideways and walks back."""
_STEPS_TO_STAND: Final = 4
"""Swings at zero command before the robot stands."""


def leg_angles(x_m: float, y_m: float, z_m: float, side: float) -> tuple[float, float, float]:
    """Return hip, thigh and calf angle in rad that put a foot at a point relative to its hip joint.

    side: 1 for a left leg, -1 for a right one. Points out of reach are approached.
    """
    down2 = y_m * y_m + z_m * z_m - THIGH_ASIDE_M * THIGH_ASIDE_M
    down_m = math.sqrt(max(down2, 1e-4))
    hip = math.atan2(y_m, -z_m) - math.atan2(side * THIGH_ASIDE_M, down_m)
    far_m = math.sqrt(x_m * x_m + down_m * down_m)
    far_m = min(max(far_m, _REACH_M[0]), _REACH_M[1])
    half = math.acos(far_m / (2.0 * SEGMENT_M))
    return hip, math.atan2(-x_m, down_m) + half, -2.0 * half


class Trot:
    """Trot of one robot.

    dt_s: duration of a substep.
    """

    def __init__(self, robot: Robot, legs: Legs, dt_s: float, gains: TrotGains = GAINS) -> None:
        self._ramps = robot.acceleration_mps2 * dt_s, robot.acceleration_radps2 * dt_s
        self.cycle_s = legs.cycle_s
        self._legs = legs
        self._dt_s = dt_s
        self._gains = gains
        aside = THIGH_ASIDE_M + gains.aside_m
        self._neutral = [(gains.ahead_m, side * aside) for side in _SIDES]
        self.reset()

    def reset(self) -> None:
        """Return to standing at rest with both feet of all pairs under the hips."""
        self._v_mps = self._w_radps = 0.0
        self._v_more, self._w_more = self._gains.v_start_mps, 0.0
        self._left_m = 0.0
        self._feet = [list(foot) for foot in self._neutral]
        self._lifted = [list(foot) for foot in self._neutral]
        self._phase_s = 0.0
        self._swings = 0
        self._left_steps = 0

    def step(self, command: Command, body: MeasuredBody) -> Sequence[float]:
        """Return the joints' torques in Nm for the next substep, without limits."""
        return torques_nm(self._legs.kp, self._legs.kd, self.targets(command, body), body)

    def targets(self, command: Command, body: MeasuredBody) -> Sequence[float]:
        """Return the 12 target angles for the next substep."""
        gains, dt_s = self._gains, self._dt_s
        m, (vx, vy, vz), spin = body.rotation, body.velocity_mps, body.spin_radps
        ahead = m[0] * vx + m[3] * vy + m[6] * vz
        left = m[1] * vx + m[4] * vy + m[7] * vz
        turn = spin[2]
        self._v_mps = towards(self._v_mps, command.v_mps, self._ramps[0])
        self._w_radps = towards(self._w_radps, command.w_radps, self._ramps[1])
        tilt = math.hypot(m[6], m[7])
        commanded = abs(self._v_mps) > _STILL or abs(self._w_radps) > _STILL
        shaken = math.hypot(ahead, left) > gains.shake_mps or tilt > gains.shake_rad
        if commanded or shaken:
            if not self._left_steps:
                self._begin()
            self._left_steps = _STEPS_TO_STAND
        if not self._left_steps:
            self._v_more, self._w_more, self._left_m = gains.v_start_mps, 0.0, 0.0
            return self._angles(m, 0.0)
        self._correct(command, ahead, turn)
        self._carry(ahead, left, turn)
        self._swing(ahead, left, turn)
        targets = self._angles(m, math.sin(math.pi * self._phase_s / gains.half_period_s))
        self._phase_s += dt_s
        if self._phase_s >= gains.half_period_s - 0.5 * dt_s:
            self._left_steps -= 1
            self._swings = 1 - self._swings
            self._begin()
        return targets

    def _begin(self) -> None:
        self._phase_s = 0.0
        for leg in _PAIRS[self._swings]:
            self._lifted[leg] = list(self._feet[leg])

    def _correct(self, command: Command, ahead: float, turn: float) -> None:
        """Integrate the errors of speed and yaw rate, except on the ramps."""
        gains, dt_s = self._gains, self._dt_s
        if self._v_mps == command.v_mps:
            v_more = self._v_more + gains.v_gain_hz * (self._v_mps - ahead) * dt_s
            self._v_more = min(max(v_more, -_INTEGRAL_MPS), _INTEGRAL_MPS)
        if self._w_radps == command.w_radps:
            w_more = self._w_more + gains.w_gain_hz * (self._w_radps - turn) * dt_s
            self._w_more = min(max(w_more, -_INTEGRAL_RADPS), _INTEGRAL_RADPS)

    def _carry(self, ahead: float, left: float, turn: float) -> None:
        """Move the feet on the ground backwards by the commanded motion."""
        gains, dt_s = self._gains, self._dt_s
        v = gains.v_factor * self._v_mps + self._v_more + gains.v_share * (self._v_mps - ahead)
        w = gains.w_factor * self._w_radps + self._w_more + gains.w_share * (self._w_radps - turn)
        self._left_m = min(max(self._left_m + left * dt_s, -_ASTRAY_M), _ASTRAY_M)
        aside = gains.y_share * left + gains.y_gain_hz * self._left_m
        for leg in _PAIRS[1 - self._swings]:
            foot, (hip_x, hip_y) = self._feet[leg], _HIPS_M[leg]
            x, y = hip_x + foot[0], hip_y + foot[1]
            foot[0] -= (v - w * y) * dt_s
            foot[1] -= (w * x - aside) * dt_s

    def _swing(self, ahead: float, left: float, turn: float) -> None:
        """Move the other feet towards their touch-down."""
        gains = self._gains
        share = min((self._phase_s + self._dt_s) / gains.half_period_s, 1.0)
        smooth = share * share * (3.0 - 2.0 * share)
        half_s = 0.5 * gains.half_period_s
        shift_x = ahead * half_s + gains.catch_s * (ahead - self._v_mps)
        shift_y = left * half_s + gains.catch_s * left
        spin = turn * half_s + gains.catch_s * (turn - self._w_radps)
        for leg in _PAIRS[self._swings]:
            (hip_x, hip_y), (rest_x, rest_y) = _HIPS_M[leg], self._neutral[leg]
            goal_x = rest_x + shift_x - spin * (hip_y + rest_y)
            goal_y = rest_y + shift_y + spin * (hip_x + rest_x)
            foot, begin = self._feet[leg], self._lifted[leg]
            foot[0] = begin[0] + (goal_x - begin[0]) * smooth
            foot[1] = begin[1] + (goal_y - begin[1]) * smooth

    def _angles(self, m: tuple[float, ...], lifted: float) -> list[float]:
        """Return the joint angles for the feet.

        lifted: share of the swing's height.
        """
        gains = self._gains
        swinging = _PAIRS[self._swings] if self._left_steps else ()
        angles: list[float] = []
        for leg in range(4):
            (hip_x, hip_y), (x, y) = _HIPS_M[leg], self._feet[leg]
            z = gains.level * (m[6] * hip_x + m[7] * (hip_y + self._neutral[leg][1]))
            z -= gains.height_m
            if leg in swinging:
                z += (gains.lift_m + gains.sink_m) * lifted - gains.sink_m
            angles += leg_angles(x, y, z, _SIDES[leg])
        return angles

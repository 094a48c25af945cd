"""Balance of a biped that stands: frozen joints, and ankle torques that shift the weight.

The robot is an inverted pendulum on its ankles. Its capture point is the centre of mass plus its
velocity divided by sqrt(g / h). The ankles push the centre of pressure beyond the capture point,
which returns to the middle of the soles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from cosim.spec.robot import Legs
from physics.dynamics.drive import MeasuredBody
from physics.dynamics.legs.pd import torques_nm
from physics.robots.kinematics import Frame, LinkTree, centre_of_mass, inverse, rotate, rows_of
from physics.robots.model import Model, Triple

_GRAVITY_MPS2: Final = 9.81
_GAIN: Final = 1.0
"""Distance of the centre of pressure beyond the capture point, as a share of the latter's error."""
_PRESSURE_M: Final = (-0.04, 0.105)
"""Range of the centre of pressure ahead of the ankles, within the soles."""
_HOLDS_M: Final = (-0.045, 0.11)
"""Range of the capture point ahead of the ankles in which the ankles can keep the balance."""
_ASIDE_M: Final = 0.10
"""Largest distance of the capture point from the middle of the feet to either side."""


@dataclass(frozen=True, slots=True)
class Stance:
    """Joints of a biped that stands, in the order of `Legs.joints`.

    ankles: pitch joints that shift the weight.
    sole_m: distance of a sole's middle ahead of its ankle.
    kp, kd: gains that hold the joints; kp of the ankles is 0.
    """

    ankles: tuple[str, str]
    sole_m: float
    kp: tuple[float, ...]
    kd: tuple[float, ...]


class Feet(NamedTuple):
    """Placement of two feet, in the world.

    apart_m: vector from the right foot to the left one.
    left, right: unit vectors upwards from the soles.
    """

    apart_m: Triple
    left: Triple
    right: Triple


class Balance:
    """Balance of one robot that stands on both feet."""

    def __init__(self, model: Model, tree: LinkTree, legs: Legs, stance: Stance) -> None:
        self._model = model
        self._tree = tree
        self._legs = legs
        self._stance = stance
        self._ankles = [legs.joints.index(name) for name in stance.ankles]
        self._weight_n = _GRAVITY_MPS2 * model.mass_kg
        self._angles: tuple[float, ...] = ()
        self._arm_m: Triple = (0.0, 0.0, 0.0)
        self._behind_m: Triple = (0.0, 0.0, 0.0)
        self._omega_hz = 1.0

    def feet(self, body: MeasuredBody) -> Feet:
        """Return how both feet are placed."""
        frames = self._frames(body)
        (turn_left, left), (turn_right, right) = (frames[foot] for foot in self._legs.feet)
        turn = rows_of(body.rotation)
        apart = left[0] - right[0], left[1] - right[1], left[2] - right[2]
        normals = (rotate(turn, inverse(one)[2]) for one in (turn_left, turn_right))
        return Feet(rotate(turn, apart), *normals)

    def begin(self, body: MeasuredBody) -> None:
        """Freeze the joints at their present angles."""
        frames = self._frames(body)
        left, right = self._feet(frames)
        x, y, z = centre_of_mass(self._model, frames)
        self._angles = body.angles_rad
        half = [0.5 * (a + b) for a, b in zip(left, right, strict=True)]
        self._arm_m = x - half[0], y - half[1], z - half[2]
        mx, my, mz = self._model.links[0].middle_m
        self._behind_m = x - mx, y - my, z - mz
        upright = self._arm_m[2] > 0.0
        self._omega_hz = math.sqrt(_GRAVITY_MPS2 / self._arm_m[2]) if upright else 0.0

    def holds(self, body: MeasuredBody) -> bool:
        """Return whether ankle torques can keep the balance.

        They cannot if the centre of mass was not above the ankles when the joints were frozen.
        """
        if not self._omega_hz:
            return False
        ahead, left = self._capture_m(body)
        return _HOLDS_M[0] < ahead < _HOLDS_M[1] and abs(left) < _ASIDE_M

    def torques_nm(self, body: MeasuredBody) -> list[float]:
        """Return the joints' torques."""
        stance = self._stance
        torques = torques_nm(stance.kp, stance.kd, self._angles, body)
        error_m = self._capture_m(body)[0] - stance.sole_m
        pressure_m = stance.sole_m + (1.0 + _GAIN) * error_m
        pressure_m = min(max(pressure_m, _PRESSURE_M[0]), _PRESSURE_M[1])
        for ankle in self._ankles:
            torques[ankle] += 0.5 * self._weight_n * pressure_m
        return torques

    def _capture_m(self, body: MeasuredBody) -> tuple[float, float]:
        """Return the capture point ahead and to the left of the middle of the ankles."""
        m, (vx, vy, _), (wx, wy, wz) = body.rotation, body.velocity_mps, body.spin_radps
        turn = rows_of(m)
        x, y, _ = rotate(turn, self._arm_m)
        dx, dy, dz = rotate(turn, self._behind_m)
        x += (vx + wy * dz - wz * dy) / self._omega_hz
        y += (vy + wz * dx - wx * dz) / self._omega_hz
        far = math.hypot(m[0], m[3])
        cos, sin = m[0] / far, m[3] / far
        return cos * x + sin * y, cos * y - sin * x

    def _frames(self, body: MeasuredBody) -> Mapping[str, Frame]:
        angles = dict(zip(self._legs.joints, body.angles_rad, strict=True))
        return self._tree.frames(angles)

    def _feet(self, frames: Mapping[str, Frame]) -> tuple[Triple, Triple]:
        """Return the positions of both ankles in the base frame."""
        left, right = (
            frames[joint.child][1]
            for name in self._stance.ankles
            for joint in self._tree.joints
            if joint.name == name
        )
        return left, right

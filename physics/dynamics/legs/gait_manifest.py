"""Manifest of a gait that is a neural network: joints, gains, rate and observation.

{"format": 1, "name": "mine", "robot": "dog", "model": "mine.onnx", "rate_hz": 50,
 "joints": {"front_left_hip": {"rest_rad": 0.0, "kp": 20, "kd": 0.5, "scale": 0.125}, ...},
 "observation": [{"what": "angular_velocity", "scale": 0.25}, {"what": "gravity"},
  {"what": "command"}, {"what": "joint_angles"}, {"what": "joint_speeds", "scale": 0.05},
  {"what": "actions"}]}
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from cosim.core.errors import SpecError, nearest
from cosim.policies.onnx.manifest import FileFacts
from cosim.spec.robot import Legs, Robot
from cosim.spec.spec_file import read_spec_file
from cosim.spec.validation import ItemCount, PathName, Ranged, Text, Within

_SCALE = Within(-1000, 1000)
_GAIN = Within(0, 2000)


class GaitPart(Ranged, frozen=True, kw_only=True):
    """Part of a manifest; messages name its place in the file."""

    @property
    def prefix(self) -> str:
        return ""


class ObservedTerm(GaitPart, frozen=True, kw_only=True, tag_field="what"):
    """Part of a network's observation.

    scale: factor of its numbers.
    """

    scale: Annotated[float, _SCALE] = 1.0

    def count(self, joints: int) -> int:
        """Return the number of values for a number of joints."""
        return 3


class AngularVelocity(ObservedTerm, frozen=True, kw_only=True, tag="angular_velocity"):
    """Angular velocity of the trunk in its frame, rad/s: 3 numbers."""


class LinearVelocity(ObservedTerm, frozen=True, kw_only=True, tag="linear_velocity"):
    """Velocity of the trunk's middle in its frame, m/s: 3 numbers."""


class Gravity(ObservedTerm, frozen=True, kw_only=True, tag="gravity"):
    """Unit vector downwards in the trunk's frame: 3 numbers."""


class CommandTerm(ObservedTerm, frozen=True, kw_only=True, tag="command"):
    """Speed ahead and to the left in m/s, and yaw rate in rad/s: 3 numbers.

    scales: factors of the three numbers, in addition to `scale`.
    """

    scales: tuple[float, float, float] = (1.0, 1.0, 1.0)


class JointAngles(ObservedTerm, frozen=True, kw_only=True, tag="joint_angles"):
    """Angles of the joints beyond `rest_rad`, rad."""

    def count(self, joints: int) -> int:
        return joints


class JointSpeeds(ObservedTerm, frozen=True, kw_only=True, tag="joint_speeds"):
    """Speeds of the joints, rad/s."""

    def count(self, joints: int) -> int:
        return joints


class PastActions(ObservedTerm, frozen=True, kw_only=True, tag="actions"):
    """Previous outputs of the network."""

    def count(self, joints: int) -> int:
        return joints


class Phase(ObservedTerm, frozen=True, kw_only=True, tag="phase"):
    """Sine and cosine of a phase that grows evenly: 2 numbers.

    period_s: duration of a cycle.
    """

    period_s: Annotated[float, Within(0.05, 10)]

    def count(self, joints: int) -> int:
        return 2


Term = (
    AngularVelocity
    | LinearVelocity
    | Gravity
    | CommandTerm
    | JointAngles
    | JointSpeeds
    | PastActions
    | Phase
)


class GaitJoint(GaitPart, frozen=True, kw_only=True):
    """Joint of a gait: its target is rest_rad + scale * output.

    kp, kd: gains, Nm/rad and Nm s/rad.
    stand_kp, stand_kd: gains while the robot balances.
    """

    rest_rad: Annotated[float, Within(-3.2, 3.2)]
    kp: Annotated[float, _GAIN]
    kd: Annotated[float, _GAIN]
    scale: Annotated[float, _SCALE]
    stand_kp: Annotated[float, _GAIN] = 0.0
    stand_kd: Annotated[float, _GAIN] = 0.0


class Correction(GaitPart, frozen=True, kw_only=True):
    """Correction of a commanded speed. The network gets factor * speed plus an integral.

    gain_hz: integral gain of the difference between commanded and measured speed.
    most: largest magnitude that the network gets, m/s or rad/s.
    """

    factor: Annotated[float, Within(0.5, 2)] = 1.0
    gain_hz: Annotated[float, Within(0, 10)] = 0.0
    most: Annotated[float, Within(0, 10, above=True)] = 10.0


class AnkleBalance(GaitPart, frozen=True, kw_only=True):
    """Standing of a biped on frozen joints (`physics.dynamics.legs.balance`).

    ankles: left and right pitch joint.
    sole_m: distance of a sole's middle ahead of its ankle.
    """

    ankles: tuple[str, str]
    sole_m: Annotated[float, Within(-0.2, 0.2)]


class GaitManifest(GaitPart, frozen=True, kw_only=True):
    """Manifest of a gait.

    robot: robot that it moves.
    model: file of the network in the folder of the manifest, .onnx or .npz.
    files: size and hashes of the model.
    joints: all joints of the robot, in the order of the network.
    observation: parts of the network's input, in its order.
    cycle_s: duration of a gait cycle, over which speeds are averaged; by default the longest period
        of a `phase`, or else the robot's `Legs.cycle_s`.
    most_observed, most_answered: limits of the magnitudes of inputs and outputs.
    most_memory: magnitude of the memory of an LSTM above which the memory is emptied.
    speed, turn: corrections of the commands.
    balance: standing of a robot with two feet; without it, the network holds the place by small
        commands.
    """

    format: Literal[1]
    name: Annotated[str, PathName("a gait")]
    robot: Annotated[str, PathName("a robot")]
    licence: Annotated[str, Text(400)] = ""
    source: Annotated[str, Text(400)] = ""
    model: Annotated[str, PathName("a file")]
    files: dict[str, FileFacts] = msgspec.field(default_factory=dict)
    rate_hz: Annotated[float, Within(5, 200)]
    joints: dict[str, GaitJoint]
    observation: Annotated[list[Term], ItemCount(1, 32)]
    cycle_s: Annotated[float, Within(0.05, 10)] | None = None
    most_observed: Annotated[float, Within(0, 1e6, above=True)] = 100.0
    most_answered: Annotated[float, Within(0, 1e6, above=True)] = 100.0
    most_memory: Annotated[float, Within(0, 1e6, above=True)] = 1e6
    speed: Correction = Correction()
    turn: Correction = Correction()
    balance: AnkleBalance | None = None

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of inputs and outputs of the network."""
        return sum(term.count(len(self.joints)) for term in self.observation), len(self.joints)

    def cycle_of(self, legs: Legs) -> float:
        """Return the duration of a gait cycle in seconds."""
        periods_s = [term.period_s for term in self.observation if isinstance(term, Phase)]
        return self.cycle_s or max(periods_s, default=legs.cycle_s)

    def contradictions(self) -> Iterator[str]:
        if not self.model.endswith((".onnx", ".npz")):
            yield f"model must end in .onnx or .npz, not {self.model!r}"
        if self.balance is not None:
            for name in self.balance.ankles:
                if name not in self.joints:
                    yield f"balance.ankles names {name!r}, which is not in joints"

    def check_robot(self, robot: Robot, substep_s: float) -> None:
        """Raise SpecError unless the gait fits the robot: joints, rate and balance."""
        legs = robot.drive
        if robot.name != self.robot or not isinstance(legs, Legs):
            raise SpecError(f"is a gait of robot '{self.robot}', not of '{robot.name}'")
        if unknown := [name for name in self.joints if name not in legs.joints]:
            raise SpecError(
                f"joints has {unknown[0]!r}, which robot '{robot.name}' lacks; its joints are "
                f"{', '.join(legs.joints)}.{nearest(unknown[0], legs.joints)}"
            )
        if missing := [name for name in legs.joints if name not in self.joints]:
            raise SpecError(f"joints lacks {', '.join(missing)} of robot '{robot.name}'")
        if self.balance is not None and len(legs.feet) != 2:
            raise SpecError(
                f"balance is for robots with two feet, and robot '{robot.name}' has "
                f"{len(legs.feet)}: leave it out"
            )
        every = 1.0 / (self.rate_hz * substep_s)
        if abs(every - round(every)) > 1e-9:
            raise SpecError(
                f"rate_hz is {self.rate_hz:g}: an interval must be a multiple of the substep of "
                f"{1000 * substep_s:g} ms, as at 200, 100, 50 or 25 Hz"
            )


def read_gait_manifest(path: Path) -> GaitManifest:
    """Read the manifest of a gait. Raises SpecError with every fault and the valid choices."""
    return read_spec_file(path, GaitManifest)

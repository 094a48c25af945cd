"""Drive of a robot with legs: a gait, followed by torques."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Final

from cosim.core.errors import EngineError, PolicyError
from cosim.core.state import STILL, Command
from cosim.spec.robot import Legs, Robot
from physics.dynamics.drive import MeasuredBody, Motors
from physics.dynamics.legs.gait import Gait
from physics.dynamics.legs.gait_file import published_gait
from physics.dynamics.legs.trot import Trot

SETTLE_S: Final = 0.5
"""Time in seconds that a robot with legs stands before its commands count, after it was placed."""

GAITS: Final[Mapping[str, Callable[[Robot, Legs, float], Gait]]] = MappingProxyType(
    {"trot": Trot, "network": published_gait}
)
"""Gaits by name. The arguments are the robot, its legs and the duration of a substep in seconds."""

_NONSENSE: Final = 20.0
"""Largest torque of a user's gait, as a multiple of the joint's limit.

Impacts of the feet cause some torques beyond the limit.
"""


class LegDrive:
    """Drive of a robot with legs.

    dt_s: duration of a substep
    gait: replaces the robot's own gait
    of_user: whether a failure of the gait is a PolicyError, not an EngineError
    """

    reads_joints = True

    def __init__(
        self,
        robot: Robot,
        legs: Legs,
        dt_s: float,
        gait: Gait | None = None,
        *,
        of_user: bool = False,
    ) -> None:
        self._of_user = of_user
        self._legs = legs
        self._gait = GAITS[legs.gait](robot, legs, dt_s) if gait is None else gait
        self.cycle_s = self._gait.cycle_s
        self._settle = round(SETTLE_S / dt_s)
        self.reset()

    def reset(self) -> None:
        """Reset the gait, and stand still for SETTLE_S."""
        self._gait.reset()
        self._waits = self._settle

    def step(self, command: Command, body: MeasuredBody) -> Motors:
        """Return the joints' torques in Nm, in the order of `Legs.joints`."""
        if self._waits:
            self._waits -= 1
            command = STILL
        if not math.isfinite(sum(body.at_m) + sum(body.angles_rad) + sum(body.speeds_radps)):
            raise EngineError(
                f"PyBullet: the robot is at {body.at_m} m, its joints at {body.angles_rad} rad "
                f"with {body.speeds_radps} rad/s"
            )
        try:
            torques_nm = self._gait.step(command, body)
        except PolicyError as error:
            if self._of_user:
                raise
            raise EngineError(str(error)) from error
        return Motors(self._limited(torques_nm))

    def _limited(self, torques_nm: Sequence[float]) -> list[float]:
        """Return torques within the joints' limits.

        Raises PolicyError for NaN, and for a torque that is far beyond its limit, of a user's gait.
        Raises EngineError for NaN of the robot's own gait.
        """
        limited: list[float] = []
        for torque, most in zip(torques_nm, self._legs.torque_nm, strict=True):
            if -most <= torque <= most:
                limited.append(torque)
            elif abs(torque) < _NONSENSE * most or not (self._of_user or math.isnan(torque)):
                limited.append(math.copysign(most, torque))
            else:
                name = self._legs.joints[len(limited)]
                fault = PolicyError if self._of_user else EngineError
                raise fault(
                    f"gait of the robot: torque of joint {name} is {torque:.4g} Nm; its limit is "
                    f"{most:g} Nm, and gaits may exceed it {_NONSENSE:g} times at most"
                )
        return limited

"""Interface of gaits: joint torques from a command and the measured motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from cosim.core.state import Command
from physics.dynamics.drive import MeasuredBody


class Gait(Protocol):
    """Gait of one robot with legs."""

    @property
    def cycle_s(self) -> float:
        """Duration of a gait cycle in seconds, over which speeds are averaged."""

    def reset(self) -> None:
        """Return to the first state: the robot stands at rest."""

    def step(self, command: Command, body: MeasuredBody) -> Sequence[float]:
        """Return the torques in Nm for the next substep, in the order of `Legs.joints`.

        command: within the robot's limits; `STILL` to stand
        body: with joints

        The drive limits the torques. Raises PolicyError for a gait that fails.
        """

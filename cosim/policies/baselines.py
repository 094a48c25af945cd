"""Baselines without sensors, and replay of recorded commands."""

from __future__ import annotations

from cosim.core.clock import Clock
from cosim.core.errors import RunError
from cosim.core.geometry import Floats
from cosim.core.state import STILL, Command
from cosim.episode.interfaces import Observation
from cosim.spec.manifest import Manifest


class Stop:
    """Never moves."""

    manifest = Manifest("stop", camera=None)

    def reset(self, episode_id: str, seed: int) -> None:
        """Do nothing: the policy has no state."""

    def act(self, observation: Observation) -> Command:
        return STILL


class Straight:
    """Drives straight ahead at four fifths of the robot's cruising speed."""

    manifest = Manifest("straight", camera=None)

    def reset(self, episode_id: str, seed: int) -> None:
        """Do nothing: the policy has no state."""

    def act(self, observation: Observation) -> Command:
        return Command(observation.robot.cruise_mps * 4 / 5, 0.0)


class Replay:
    """Returns the recorded command of each tick, without sensors.

    commands: (T, 2) in m/s and rad/s.
    """

    def __init__(self, commands: Floats) -> None:
        self.manifest = Manifest("replay", rate_hz=1.0 / Clock().tick_s, camera=None)
        self._commands = commands

    def reset(self, episode_id: str, seed: int) -> None:
        """Do nothing: the policy has no state."""

    def act(self, observation: Observation) -> Command:
        """Return the command of this tick. Raises RunError after the last recorded tick."""
        if observation.tick >= len(self._commands):
            raise RunError(
                f"the record ends after {len(self._commands)} ticks, and the "
                f"episode continues: it differs from the recorded one"
            )
        v_mps, w_radps = self._commands[observation.tick].tolist()
        return Command(v_mps, w_radps)

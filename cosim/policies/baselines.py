"""Baselines that look at nothing: they show what the failures of the benchmark mean."""

from __future__ import annotations

from cosim.core.state import STILL, Command
from cosim.episode.ports import Manifest, Observation


class Stop:
    """Never moves."""

    manifest = Manifest("stop")

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Command:
        return STILL


class Straight:
    """Drives straight ahead, four fifths as fast as the robot travels: the courier at walking speed."""

    manifest = Manifest("straight")

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Command:
        return Command(observation.robot.cruise_mps * 4 / 5, 0.0)

"""Baselines that look at nothing: they show what the failures of the benchmark mean."""

from __future__ import annotations

from cosim.core.state import STILL, Command
from cosim.episode.ports import Manifest, Observation


class Stop:
    """Never moves."""

    manifest = Manifest("stop")

    def reset(self, scenario_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Command:
        return STILL


class Straight:
    """Drives straight ahead at walking speed."""

    manifest = Manifest("straight")

    def reset(self, scenario_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Command:
        return Command(1.2, 0.0)

"""A policy that drives straight on and sees nothing."""

from __future__ import annotations

from cosim.core.state import Command
from cosim.episode.ports import Manifest, Observation


class Blind:
    """1.2 m/s, whatever comes; no camera, so that nothing is drawn for it."""

    manifest = Manifest("blind", rate_hz=5.0, camera=None)

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Command:
        """Straight on."""
        return Command(1.2, 0.0)

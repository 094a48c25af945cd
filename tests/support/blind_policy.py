"""A policy that drives straight ahead without a camera."""

from __future__ import annotations

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.spec.manifest import Manifest, WaypointRule

BEND = np.column_stack([0.5 * np.arange(1, 9), [0.0, 0.0, 0.0, 0.1, 0.3, 0.6, 1.0, 1.5]])
"""Eight waypoints, to the left beyond the third, which is 1.5 m ahead."""


class Blind:
    """Drives at 1.2 m/s without a camera, so nothing is drawn. From 1 s on it answers BEND."""

    manifest = Manifest(
        "blind", rate_hz=5.0, camera=None, waypoints=WaypointRule(index=2, dt_s=1.25)
    )

    def reset(self, episode_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, observation: Observation) -> Command | Floats:
        """Return the command straight ahead, or BEND."""
        return BEND if observation.time_s >= 1.0 else Command(1.2, 0.0)

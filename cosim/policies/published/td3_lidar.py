"""Lidar TD3: speed and turn from the nearest distance in 20 sectors, the goal and the last command.

The network of R. Cimurs, I. H. Suh and J. H. Lee, "Goal-driven autonomous exploration through deep
reinforcement learning", RA-L 2022, learned in a fork with moving obstacles. The wheels of its
simulated robot have each other's names, so that a positive turn is to the right.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.network import Network
from cosim.core.state import STILL, Command
from cosim.episode.control import clipped
from cosim.episode.interfaces import Observation
from cosim.policies.onnx.converting import PublishedArrays
from cosim.policies.onnx.torch_file import read_torch_file
from cosim.policies.published.network_policy import (
    POINT_GOALS,
    Arrays,
    NetworkPolicy,
    file_of,
    goal_point,
    torch_layer,
)
from cosim.spec.manifest import Manifest
from cosim.spec.sensors import Scan, ScanSpec

SECTORS: Final = 20
"""Number of sectors from right to left."""
RANGE_M: Final = 10.0
"""Largest distance in the input in metres."""
GOAL_MOST_M: Final = 10.0
"""Largest distance of the goal in metres, about that of training."""
_MARGIN_RAD: Final = 0.03
"""Angle by which the first and the last sector reach behind the robot's sides, in radians."""


def td3_network(arrays: Arrays) -> Network:
    """Return the network of the published arrays. Raises ValueError for others."""
    published = PublishedArrays(arrays)
    layers = [torch_layer(published, f"layer_{i}", "tanh" if i == 3 else "relu") for i in (1, 2, 3)]
    published.check_all_used()
    return Network(tuple(layers))


def sectors(scan: Scan) -> Floats:
    """Return (20,) the least distance in each sector from -90 to 90 degrees, at most 10 m."""
    angles = scan.spec.angles_rad
    quarter = math.pi / 2.0
    seen = (angles >= -quarter - _MARGIN_RAD) & (angles < quarter + _MARGIN_RAD)
    sector = np.floor((angles[seen] + quarter) / (math.pi / SECTORS)).astype(int)
    least = np.full(SECTORS, RANGE_M)
    nearest = scan.ranges_m.astype(float).min(axis=0)[seen]
    np.minimum.at(least, np.clip(sector, 0, SECTORS - 1), nearest)
    return least


def state(scan: Scan, goal: tuple[float, float], last: Command) -> NDArray[np.float32]:
    """Return (24,) the input: sectors, distance and bearing of the goal, last command."""
    return np.array([*sectors(scan), *goal, last.v_mps, -last.w_radps], np.float32)


class Td3Lidar(NetworkPolicy):
    """Lidar TD3 (Cimurs et al. 2022, another's training): a scan and a goal to speed and turn."""

    manifest = Manifest(
        "td3-lidar",
        rate_hz=10.0,
        camera=None,
        goal="route_point",
        goals=POINT_GOALS,
        scan=ScanSpec(rays=360, range_m=RANGE_M),
    )
    files = (
        file_of(
            "td3_goal_lidar",
            "TD3_velodyne_actor.pth",
            "SHITIANYU-hue/DRL-robot-navigation, commit 04d207ff, TD3/pytorch_models (MIT)",
            2009175,
            "8ef6a9c8740939abb83c774aaf17ffb0ec6db966988c46bedc90c0ca2dcd49e5",
        ),
    )

    def build(self, *files: bytes) -> None:
        self.network = td3_network(read_torch_file(files[0]))

    def on_reset(self) -> None:
        self._last = STILL

    def act(self, observation: Observation) -> Command:
        if observation.scan is None:
            raise ValueError("needs a lidar (manifest: scan)")
        given = state(observation.scan, goal_point(observation, GOAL_MOST_M), self._last)
        (speed, turn), _ = self.network.answer(given, ())
        command = Command((float(speed) + 1.0) / 2.0, -float(turn))
        self._last = clipped(command, observation.robot)
        return self._last

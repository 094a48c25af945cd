"""MetaUrban's PPO: steering and throttle from points of the route and a lidar.

W. Wu et al., "MetaUrban: an embodied AI simulation platform for urban micromobility", ICLR 2025;
the policy that is shipped with it, after 576,000 of 100 million steps of training. The input is
that of the code at the same commit: rays are counter-clockwise, nine points are filled, and the
robot's own state is mostly 0. One thing differs: the y axis of points is to the right, as the
code's comments say. With y to the left the network does not follow a straight line.

Steering and throttle move the car-like robot of the simulator; its speed and turning rate after a
step are the command.
"""

from __future__ import annotations

import io
import math
import zipfile
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.network import Network
from cosim.core.state import Command
from cosim.episode.control import clipped
from cosim.episode.interfaces import Observation
from cosim.policies.onnx.converting import PublishedArrays
from cosim.policies.onnx.torch_file import read_torch_file
from cosim.policies.published.network_policy import (
    Arrays,
    NetworkPolicy,
    file_of,
    torch_layer,
)
from cosim.spec.goal import RoutePoints
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Robot
from cosim.spec.sensors import Scan, ScanSpec

RAYS: Final = 240
"""Number of rays of the lidar."""
RANGE_M: Final = 50.0
"""Range of the lidar in metres."""
FIRST_POINT: Final = 2
"""First point of the route in the input, 4 m along it; the last one is 20 m along it."""
POINT_UNIT_M: Final = 30.0
"""Unit of a point's coordinates in metres."""
STEP_S: Final = 0.1
"""Time step in seconds."""
MAX_STEERING_RAD: Final = math.radians(60.0)
"""Steering angle of a steering of 1 in radians."""
WHEELBASE_M: Final = 1.36 + 1.45
"""Distance of the axles of the simulator's robot in metres."""
MASS_KG: Final = 1595.0
"""Mass of the simulator's robot in kilograms."""
ENGINE_N: Final = 4 * 800.0
"""Force of the four motors at full throttle in newtons; the mean of 750 to 850 each."""
BRAKE_MPS2: Final = 4 * 57.5 / (0.02 * MASS_KG)
"""Deceleration at full brake in m/s^2: the mean of 35 to 80 N s per wheel and step of 0.02 s."""
_INPUTS: Final = 271
_STATE: Final = 9
_ROUTE: Final = 22
OFFSET_MOST_M: Final = (2.25, 5.0)
"""Largest offsets from the route in the robot's state and in the route's part, in metres."""


def ppo_network(arrays: Arrays) -> Network:
    """Return the network of the published arrays. Raises ValueError for others."""
    published = PublishedArrays(arrays)
    layers = (
        torch_layer(published, "mlp_extractor.policy_net.0", "tanh"),
        torch_layer(published, "mlp_extractor.policy_net.2", "tanh"),
        torch_layer(published, "action_net", "linear"),
    )
    network = Network(layers)
    if network.sizes != (_INPUTS, 2):
        raise ValueError(f"has {network.sizes[0]} inputs and {network.sizes[1]} outputs")
    return network


def policy_of(data: bytes) -> bytes:
    """Return the policy's file in an archive of Stable-Baselines3. Raises ValueError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return archive.read("policy.pth")
    except (zipfile.BadZipFile, KeyError) as error:
        raise ValueError(f"is no archive of Stable-Baselines3: {error}") from None


def route_input(points: Floats) -> tuple[Floats, float]:
    """Return (22,) the route's part of the input, and the offset to the right of the route.

    points: (11, 2) as in `cosim.spec.goal.RoutePoints`.
    """
    ahead_m, left_m = (points[1] - points[0]).tolist()
    heading_rad = math.atan2(left_m, ahead_m) if (ahead_m, left_m) != (0.0, 0.0) else 0.0
    x, y = points[0].tolist()
    offset_m = y * math.cos(heading_rad) - x * math.sin(heading_rad)
    shown = points[FIRST_POINT:] * (1.0, -1.0) / POINT_UNIT_M
    last = 2 * len(shown)
    given = np.zeros(_ROUTE)
    given[:last] = (np.clip(shown, -1.0, 1.0).ravel() + 1.0) / 2.0
    given[last] = _share(offset_m / OFFSET_MOST_M[1])
    given[last + 1] = _share(heading_rad / math.pi)
    return given, offset_m


def _share(number: float) -> float:
    """Return a number from [-1, 1] as a share of 1."""
    return (min(max(number, -1.0), 1.0) + 1.0) / 2.0


def scan_input(scan: Scan) -> Floats:
    """Return (240,) shares of the range, counter-clockwise from straight ahead; 1 is free."""
    nearest = scan.ranges_m.astype(float).min(axis=0)
    return np.roll(np.minimum(nearest / RANGE_M, 1.0), -(RAYS // 2))


def state(scan: Scan, points: Floats, w_radps: float) -> NDArray[np.float32]:
    """Return (271,) the input. Arguments are those of `route_input` and `scan_input`."""
    route, offset_m = route_input(points)
    own = np.zeros(_STATE)
    own[-2:] = min(abs(w_radps), 1.0), _share(offset_m / OFFSET_MOST_M[0])
    return np.concatenate([own, route, scan_input(scan)]).astype(np.float32)


def driven(steering: float, throttle: float, v_mps: float, robot: Robot) -> Command:
    """Return speed and turning rate of the simulator's robot after a step.

    steering: from -1, right, to 1, left.
    throttle: from -1, full brake, to 1.
    The robot's cruising speed takes the place of 20 km/h.
    """
    force = ENGINE_N / MASS_KG if throttle >= 0.0 else BRAKE_MPS2
    speed = min(max(v_mps + STEP_S * force * throttle, 0.0), robot.cruise_mps)
    return Command(speed, speed * math.tan(MAX_STEERING_RAD * steering) / WHEELBASE_M)


class MetaurbanPpo(NetworkPolicy):
    """MetaUrban's PPO (Wu et al. 2025): a scan and points of the route to steering and throttle."""

    manifest = Manifest(
        "metaurban-ppo",
        rate_hz=10.0,
        camera=None,
        goal="route_points",
        goals=("route_points",),
        scan=ScanSpec(rays=RAYS, range_m=RANGE_M, height_m=0.6),
    )
    files = (
        file_of(
            "metaurban_ppo",
            "pretrained_policy_576k.zip",
            "metadriverse/metaurban, commit 6b8ff9aa (Apache-2.0)",
            655890,
            "fc0e86321d7c790b2ff547f79e58da253d589e066597864072ab2c1b8beedd99",
        ),
    )

    def build(self, *files: bytes) -> None:
        self.network = ppo_network(read_torch_file(policy_of(files[0])))

    def act(self, observation: Observation) -> Command:
        scan, goal = observation.scan, observation.goal
        if scan is None or not isinstance(goal, RoutePoints):
            raise ValueError("needs a lidar, and points of the route")
        given = state(scan, goal.points_m.astype(float), observation.w_radps)
        answer, _ = self.network.answer(given, ())
        steering, throttle = np.clip(answer, -1.0, 1.0).tolist()
        command = driven(steering, throttle, observation.v_mps, observation.robot)
        return clipped(command, observation.robot)

"""`nav`: classical navigation by a lidar, a stand-in for Nav2.

A rolling costmap of the scans, a local plan past obstacles along the route, and regulated pure
pursuit. It has no camera: it sees neither signals nor gestures, and takes people for obstacles.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.core.geometry import Floats, Pose, wrap_angle
from cosim.core.state import STILL, Command
from cosim.episode.control import clipped
from cosim.episode.interfaces import Observation
from cosim.policies.nav.costmap import Costmap
from cosim.policies.nav.local_plan import local_plan
from cosim.policies.nav.pursuit import can_turn, pursue, safe_speed
from cosim.policies.nav.route_path import path_to
from cosim.policies.nav.tracking import Movers, Tracker
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Robot
from cosim.spec.sensors import ScanSpec

MARGIN_M: Final = 0.12
"""Least planned distance from the robot's side to an obstacle, in metres."""
TIGHT_M: Final = 0.08
"""The same after PATIENCE_S without motion."""
PATIENCE_S: Final = 3.0
"""Time in seconds without motion after which the robot accepts smaller gaps."""
TURN_S: Final = 2.0
"""Time in seconds without motion after which the robot turns slowly towards the free side."""
RECOVER_S: Final = 7.5
"""The same with people nearby, who may go away; then it also accepts smaller gaps to them."""
_NEARBY_M: Final = 3.0
"""Distance in metres of people nearby."""
_LOOK_ASIDE_M: Final = 0.9
"""Distance in metres at which the room on both sides is compared."""
_ASIDE_RAD: Final = 0.8
"""Bearing in radians of these places."""
HOLD_S: Final = 4.5
"""Time in seconds for which the robot stands still after it stopped for a person who is before it:
turned on the spot, its corners would touch the person."""
_BEFORE_M: Final = 1.7
"""Distance in metres of a person who is before the robot."""
_BEFORE_RAD: Final = 1.3
"""Largest bearing in radians of such a person."""
_TURN_RADPS: Final = 0.3
"""Yaw rate of this turn in rad/s."""
_MOVED_M: Final = 0.5
"""Distance in metres below which the robot counts as standing."""


class Nav:
    """Follows the route by a lidar, without a map, a camera or privileged knowledge."""

    manifest = Manifest(
        "nav",
        rate_hz=10.0,
        camera=None,
        goal="route_patch",
        odometry="wheel",
        scan=ScanSpec(rays=360, range_m=12.0, height_m=0.3),
        goals=("route_patch", "route_point", "final_point"),
    )

    def __init__(self) -> None:
        self._costmap = Costmap()
        self._tracker = Tracker()
        self.reset("", 0)

    def reset(self, episode_id: str, seed: int) -> None:
        self._begin(0.0, Pose(0.0, 0.0, 0.0))

    def _begin(self, time_s: float, pose: Pose) -> None:
        """Forget the past: the robot is at rest, and heads along the route."""
        self._costmap.clear()
        self._tracker.clear()
        self._direction_rad = pose.heading_rad
        self._held_at, self._held_s, self._turn_radps = pose.xy, time_s, 0.0
        self._side = 0
        self._yielded_s = -math.inf

    def act(self, observation: Observation) -> Command:
        odometry, time_s = observation.odometry, observation.time_s
        if observation.scan is None or odometry is None or odometry.heading_rad is None:
            raise ValueError("nav needs a lidar and odometry with a heading")
        pose = Pose(odometry.x_m, odometry.y_m, odometry.heading_rad)
        if observation.reset or observation.tick == 0:
            self._begin(time_s, pose)
        self._tracker.update(observation.scan, pose, time_s)
        movers = self._tracker.movers(pose)
        self._costmap.update(observation.scan, pose, movers)
        if math.hypot(*(pose.xy - self._held_at)) > _MOVED_M:
            self._held_at, self._held_s, self._turn_radps = pose.xy, time_s, 0.0
        path = self._path(observation, pose)
        command = self._followed(path, movers, observation)
        walkers = self._tracker.walkers(pose)
        if time_s - self._yielded_s < HOLD_S and _within(walkers, _BEFORE_M, _BEFORE_RAD):
            command = STILL
        waits_s = RECOVER_S if _within(walkers, _NEARBY_M) else TURN_S
        if command == STILL and time_s - self._held_s > waits_s:
            command = self._free_turn(observation.robot)
        return clipped(command, observation.robot)

    def _path(self, observation: Observation, pose: Pose) -> Floats:
        """Return the route ahead, (N, 2) metres in the robot's frame, and keep its direction."""
        path = path_to(observation.goal, wrap_angle(self._direction_rad - pose.heading_rad))
        if len(path) > 2:
            ahead = path[2] - path[0]
            self._direction_rad = pose.heading_rad + math.atan2(ahead[1], ahead[0])
        return path

    def _followed(self, path: Floats, movers: Movers, observation: Observation) -> Command:
        """Return the command along a path, past obstacles and after people."""
        robot, v_mps = observation.robot, observation.v_mps
        if len(path) < 2:
            return STILL  # no route in sight, or it ends here
        stood_s = observation.time_s - self._held_s
        margin_m = MARGIN_M if stood_s < PATIENCE_S else TIGHT_M
        plan = local_plan(
            path, self._costmap, robot.width_m / 2, margin_m, self._side, movers, v_mps
        )
        self._side = plan.side
        safe_mps = safe_speed(plan, movers, robot, v_mps, stood_s < RECOVER_S)
        if safe_mps == 0.0:
            self._yielded_s = observation.time_s
        return pursue(plan, self._costmap, robot, v_mps, safe_mps)

    def _free_turn(self, robot: Robot) -> Command:
        """Return a slow turn to the side of the plan, or to the other one; none without room.

        Without a side it is the one with more room. It stays the same until the robot has moved.
        """
        sides = _LOOK_ASIDE_M * np.array([(math.cos(_ASIDE_RAD), math.sin(_ASIDE_RAD))] * 2)
        sides[1, 1] *= -1.0
        left_m, right_m = self._costmap.distances(sides).tolist()
        side = self._side or (1 if left_m >= right_m else -1)
        first = self._turn_radps or side * _TURN_RADPS
        for w_radps in (first, -first):
            if can_turn(self._costmap, robot, w_radps):
                self._turn_radps = w_radps
                return Command(0.0, w_radps)
        return STILL


def _within(people: Floats, range_m: float, bearing_rad: float = math.pi) -> bool:
    """Return whether one of (N, 2) people, metres in the robot's frame, is within a sector."""
    near = np.hypot(*people.T) < range_m
    return bool((near & (np.abs(np.arctan2(people[:, 1], people[:, 0])) <= bearing_rad)).any())

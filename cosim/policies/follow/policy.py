"""`follow`: what a student would write who has two networks that see.

ESPNetv2 says what is walkable, YOLOX-nano where people are; both are laid on the ground before the robot, and it takes
the arc that stays clear, has room to both sides, and leads to the goal if it is given one. It stands for people who
are near in the way, some seconds long, and turns on the spot, to the side where more is free, where no arc is.
"""

from __future__ import annotations

from typing import Final

from cosim.core.state import STILL, Command
from cosim.episode.ports import CameraSpec, Manifest, Observation
from cosim.policies.follow.ground import Ground, walkable_pixels
from cosim.policies.follow.networks import Networks
from cosim.policies.follow.people import people_in
from cosim.policies.follow.waiting import WaitForPeople
from cosim.policies.follow.ways import best_arc, command_along, turn_aside
from cosim.spec.goal import PointGoal

_STUCK_S: Final = 0.6
"""Having stood so long before what is not free it looks for a way on the spot."""


class Follow:
    """Keeps to the middle of the walkable ground that ESPNetv2 sees, and stops for the people that YOLOX-nano sees.

    Raises UsageError where the networks' weights are missing, saying where they are to be had.
    """

    manifest = Manifest(
        "follow",
        rate_hz=5.0,
        camera=CameraSpec(512, 288, 60.0),
        goal="route_point",
        goals=("route_point", "final_point", "random_point", "none"),
    )

    def __init__(self) -> None:
        self._networks = Networks()
        self.digest = self._networks.digest
        self.on_reset()

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing is remembered of the episode before."""
        self.on_reset()

    def on_reset(self) -> None:
        """It begins to wait anew."""
        self._waiting = WaitForPeople()
        self._last = 0.0
        self._stands_since_s: float | None = None
        self._turn: Command | None = None

    def act(self, observation: Observation) -> Command:
        rgb, camera = observation.rgb, observation.camera
        assert rgb is not None and camera is not None, "the manifest asks for a camera"
        robot, goal = observation.robot, observation.goal
        ground = Ground(camera, (rgb.shape[1], rgb.shape[0]))
        free = ground.free(walkable_pixels(rgb, self._networks.street))
        people = ground.feet_of(people_in(rgb, self._networks.people))
        if self._waiting.stands(observation.time_s, people):
            return STILL
        towards = goal.bearing_rad if isinstance(goal, PointGoal) else None
        arc = best_arc(free, people, robot, towards, self._last)
        self._last = arc.curvature
        command = command_along(arc, robot)
        if command != STILL:
            self._stands_since_s = self._turn = None
            return command
        if self._stands_since_s is None:
            self._stands_since_s = observation.time_s
        if self._turn is None and observation.time_s - self._stands_since_s >= _STUCK_S:
            self._turn = turn_aside(free, robot)
        return self._turn or STILL

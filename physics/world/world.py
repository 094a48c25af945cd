"""BulletWorld: the robot among streets, buildings, props, barriers, people and vehicles, stepped by PyBullet.

Only what the robot can touch is in the engine: ground, buildings and props of the tiles around it, and the people and
vehicles within reach. Pictures are drawn elsewhere (physics.cameras.bullet_camera), from the same values.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Final, Self

import numpy as np

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats, Pose, box_disk_gap, boxes_overlap
from cosim.core.state import PERSON_RADIUS_M, Command, Contact, Motion, RobotState, Street, write_protected
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import Barrier
from physics.world.bodies import Bodies
from physics.world.drive import SkidDrive
from physics.world.movers import Movers
from physics.world.surface import Surface
from physics.world.tiles import Key, distance_to, keys_within

SUBSTEP_S: Final = 0.005
PEOPLE_REACH_M: Final = 6.0
_VEHICLE_REACH_M: Final = 10.0
_LOAD_M: Final = 20.0
_UNLOAD_M: Final = 40.0


class BulletWorld:
    """The physics of one episode. Use it in a `with` block; one PyBullet client each, so several may live at once.

    surface: what it stands on. barriers: fences that stand for the whole episode.
    """

    def __init__(
        self,
        surface: Surface,
        barriers: Sequence[Barrier] = (),
        robot: Robot = COURIER,
    ) -> None:
        self.surface = surface
        self.robot = robot
        self.barriers = tuple(barriers)
        self._drive = SkidDrive(robot)
        self._bodies: Bodies | None = None
        self._tiles: dict[Key, list[int]] = {}

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Length and width of the robot."""
        return self.robot.footprint_m

    def __enter__(self) -> Self:
        if self._bodies is None:
            self._bodies = Bodies(self.robot, SUBSTEP_S)
            for barrier in self.barriers:
                size = (barrier.thickness_m, barrier.length_m)
                z = self.surface.foot(barrier.x_m, barrier.y_m, barrier.heading_rad, size)
                self._bodies.add_barrier(barrier, z)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the engine; a second call does nothing."""
        if self._bodies is not None:
            self._bodies.close()
            self._bodies = None
            self._tiles.clear()

    def place(self, pose: Pose) -> RobotState:
        """Put the robot at rest at a pose, its wheels on the ground."""
        bodies = self._engine
        self._stream(pose.x_m, pose.y_m)
        self._drive.reset()
        z, roll, pitch = self.surface.lean(pose, self.robot.drive.span_m)
        bodies.place_robot((pose.x_m, pose.y_m, z + 0.001), (roll, pitch, pose.heading_rad))
        return bodies.robot_state()

    def step(self, command: Command, before: Street, after: Street, substeps: int) -> Motion:
        """One tick of physics; people and vehicles move evenly from `before` to `after`."""
        bodies = self._engine
        state = bodies.robot_state()
        x, y = state.pose.x_m, state.pose.y_m
        self._stream(x, y)
        people = Movers.between(before.people, after.people).near(x, y, PEOPLE_REACH_M)
        half = 0.5 * after.vehicles.size
        cars_all = Movers.between(before.vehicles, after.vehicles)
        cars = cars_all.near(x, y, _VEHICLE_REACH_M)
        row = {name: i for i, name in enumerate(after.vehicles.ids)}
        car_half = half[[row[name] for name in cars.ids]] if len(cars) else np.zeros((0, 2))

        people_poses, car_poses = people.poses(substeps), cars.poses(substeps)
        people_z = self.surface.heights(people_poses[-1, :, :2]) if len(people) else np.zeros(0)
        bodies.show("pedestrian", people.ids, people_z)
        cars_z = self.surface.road(car_poses[-1, :, :2], car_poses[-1, :, 2], 2.0 * car_half)[:, 0]
        bodies.show("vehicle", cars.ids, cars_z, 2.0 * car_half)

        trace = np.empty((substeps, 3))
        found: list[Contact] = []
        for k in range(substeps):
            bodies.move("pedestrian", people_poses[k])
            bodies.move("vehicle", car_poses[k])
            bodies.turn_wheels(self._drive.joint_speeds(command, bodies.yaw_rate(), SUBSTEP_S))
            bodies.step()
            trace[k] = bodies.robot_pose()
            found += [Contact(kind, other, k) for kind, other in bodies.robot_contacts()]
        found += self._overlaps(trace, people.ids, people_poses, cars.ids, car_poses, car_half)
        contacts = tuple(sorted(set(found), key=lambda c: (c.substep, c.kind, c.other)))
        return Motion(bodies.robot_state(), write_protected(trace), contacts)

    def _overlaps(
        self,
        trace: Floats,
        people: tuple[str, ...],
        people_poses: Floats,
        cars: tuple[str, ...],
        car_poses: Floats,
        car_half: Floats,
    ) -> list[Contact]:
        """Overlaps of the footprint with disks and boxes, whatever the engine made of them."""
        half = 0.5 * np.array(self.footprint_m)
        found = []
        if people:
            gap = box_disk_gap(trace, half[0], half[1], people_poses[:, :, :2])
            found += [Contact("pedestrian", people[i], int(k)) for k, i in np.argwhere(gap < PERSON_RADIUS_M)]
        if cars:
            hit = boxes_overlap(trace[:, None], half, car_poses, car_half[None])
            found += [Contact("vehicle", cars[i], int(k)) for k, i in np.argwhere(hit)]
        return found

    def _stream(self, x_m: float, y_m: float) -> None:
        """Load the tiles around a point and drop those left behind."""
        bodies = self._engine
        for key in [k for k in self._tiles if distance_to(k, x_m, y_m) > _UNLOAD_M]:
            bodies.remove(self._tiles.pop(key))
        for key in keys_within(x_m, y_m, _LOAD_M):
            if key not in self._tiles:
                self._tiles[key] = bodies.add_chunk(self.surface.chunk(key))

    @property
    def _engine(self) -> Bodies:
        if self._bodies is None:
            raise EngineError("the physics is not running: use BulletWorld in a 'with' block")
        return self._bodies


__all__ = ["SUBSTEP_S", "BulletWorld"]

"""Physics world of one episode: the robot among ground, buildings, props, barriers and traffic.

Only nearby bodies are in the engine: the tiles around the robot, and people and vehicles within
reach. Images are rendered from the same values by `physics.cameras`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats, Pose, box_disk_gap, boxes_overlap
from cosim.core.state import (
    PERSON_RADIUS_M,
    Command,
    Contact,
    Motion,
    RobotState,
    Street,
    write_protected_copy,
)
from cosim.spec.obstacle import Obstacle
from cosim.spec.robot import COURIER, Legs, Robot
from cosim.spec.scenario import Barrier
from physics.dynamics.bodies import Bodies, MoverKind
from physics.dynamics.drive import SUBSTEP_S, Drive
from physics.dynamics.drives import drive_of
from physics.dynamics.legs.leg_monitor import LegMonitor
from physics.dynamics.movers import Mover, TickPoses, movers_near
from physics.ground.tiles import Key, tile_distance, tile_distances_within, tiles_within
from physics.street.surface import Surface, grounded_obstacles

PEOPLE_REACH_M: Final = 6.0
"""Distance in metres within which people have collision bodies."""

_VEHICLE_REACH_M: Final = 10.0
"""Distance in metres within which vehicles have collision bodies."""

_LOAD_M: Final = 20.0
"""Distance in metres within which tiles are loaded."""

_UNLOAD_M: Final = 40.0
"""Distance in metres beyond which tiles are unloaded."""

_STRAY_M: Final = 0.2
"""Movement of the robot in metres after which contact candidates are selected again."""
_CONTACT_MARGIN_M: Final = 0.5
"""Margin in metres around the robot for contact candidates.

It exceeds the distance that the robot strays before the next selection.
"""
_ROUNDING_M: Final = 1e-6
"""Margin in metres for rounding when deciding whether tiles must be loaded."""

_SIGHT_MARGIN_M: Final = 0.45
"""Length in metres ignored at both ends of a line of sight.

It covers the robot itself and the body of the target.
"""


class BulletWorld:
    """Physics of one episode, used in a `with` block.

    Each instance has its own PyBullet client, so several can run at once.

    surface: ground with buildings and props
    barriers, obstacles: additional static bodies of the episode
    grip: factor of the friction of the ground
    drive: replaces the robot's own drive, which is created when the robot is first placed
    """

    def __init__(
        self,
        surface: Surface,
        barriers: Sequence[Barrier] = (),
        robot: Robot = COURIER,
        obstacles: Sequence[Obstacle] = (),
        drive: Drive | None = None,
        grip: float = 1.0,
    ) -> None:
        self.surface = surface
        self.robot = robot
        self.barriers = tuple(barriers)
        self.obstacles = tuple(obstacles)
        self._drive = drive
        self._grip = grip
        self._leg_monitor: LegMonitor | None = None
        self._bodies: Bodies | None = None
        self._tiles: dict[Key, list[int]] = {}
        self._loaded_at_m = (0.0, 0.0)
        self._reload_after_m = 0.0
        self._reach_m = (
            math.hypot(0.5 * robot.length_m, 0.5 * robot.width_m, robot.height_m)
            + _CONTACT_MARGIN_M
        )

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Length and width of the robot in metres."""
        return self.robot.footprint_m

    def __enter__(self) -> Self:
        if self._bodies is None:
            self._bodies = Bodies(self.robot, SUBSTEP_S, self._grip)
            for barrier in self.barriers:
                size = (barrier.thickness_m, barrier.length_m)
                z = self.surface.foot(barrier.x_m, barrier.y_m, barrier.heading_rad, size)
                self._bodies.add_barrier(barrier, z)
            for prop, z in grounded_obstacles(self.obstacles, self.surface):
                self._bodies.add_prop(prop, z)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop the engine. Repeated calls do nothing."""
        if self._bodies is not None:
            self._bodies.close()
            self._bodies = None
            self._tiles.clear()
            self._reload_after_m = 0.0

    def place(self, pose: Pose) -> RobotState:
        """Put the robot at rest at a pose, with its wheels or feet on the ground."""
        bodies = self._engine
        self._load_tiles(pose.x_m, pose.y_m)
        self._ensured_drive().reset()
        if self._leg_monitor is not None:
            self._leg_monitor.reset()
        z, roll, pitch = self.surface.lean(pose, self.robot.drive.span_m)
        bodies.place_robot((pose.x_m, pose.y_m, z + 0.001), (roll, pitch, pose.heading_rad))
        return bodies.robot_state()

    def occluded(self, eye_m: Floats, points_m: Floats) -> NDArray[np.bool_]:
        """Return which of (N, 3) points are occluded from the robot's eye (3,), both in metres.

        Bodies within _SIGHT_MARGIN_M of either end of a line of sight are ignored. Occluders
        farther than _LOAD_M from the robot may be missing.
        """
        rays = points_m - eye_m
        far_m = np.sqrt((rays**2).sum(axis=1))
        occluded = np.zeros(len(points_m), dtype=bool)
        long = far_m > 2 * _SIGHT_MARGIN_M
        if long.any():
            inset = _SIGHT_MARGIN_M * rays[long] / far_m[long, None]
            occluded[long] = self._engine.lines_blocked(eye_m + inset, points_m[long] - inset)
        return occluded

    def step(self, command: Command, before: Street, after: Street, substeps: int) -> Motion:
        """Run one tick of physics; people and vehicles move uniformly from `before` to `after`."""
        bodies, drive = self._engine, self._ensured_drive()
        x, y, _ = pose = bodies.at_m
        self._load_tiles(x, y)
        near: dict[MoverKind, list[Mover]] = {
            "pedestrian": movers_near(before.people, after.people, x, y, PEOPLE_REACH_M),
            "vehicle": movers_near(before.vehicles, after.vehicles, x, y, _VEHICLE_REACH_M),
        }
        for kind, movers in near.items():
            bodies.activate(kind, movers)
            ways = {
                mover: mover.poses(substeps)
                for mover in movers
                if not bodies.is_at_rest(kind, mover)
            }
            bodies.set_paths(kind, ways, self._foot_heights(kind, ways) if ways else [])
        close = self._select_candidates(near, x, y)
        trace: list[float] = []
        found: set[Contact] = set()
        for k in range(substeps):
            if abs(pose[0] - x) > _STRAY_M or abs(pose[1] - y) > _STRAY_M:
                x, y, _ = pose
                close |= self._select_candidates(near, x, y)
            pose = bodies.step(k, drive.step(command, bodies.measured_body()))
            trace += pose
            if self._leg_monitor is not None:
                self._leg_monitor.add(bodies.speeds())
            if bodies.contact_candidates:
                found |= {Contact(what, other, k) for what, other in bodies.robot_contacts()}
        poses = write_protected_copy(trace, shape=(substeps, 3))
        for kind, mover in close:
            found.update(self._overlaps(kind, mover, poses))
        contacts = tuple(sorted(found, key=lambda c: (c.substep, c.kind, c.other))) if found else ()
        if self._leg_monitor is None:
            return Motion(bodies.robot_state(), poses, contacts)
        if not all(map(math.isfinite, pose)):
            raise EngineError(f"PyBullet: the robot with legs is at {pose} (m, m, rad)")
        ground_m = float(self.surface.heights(np.array([bodies.at_m[:2]]))[0])
        touches = bodies.trunk_touches_ground()
        robot, down = self._leg_monitor.assess(bodies.robot_state(), ground_m, touches)
        return Motion(robot, poses, contacts, down)

    def _select_candidates(
        self, near: Mapping[MoverKind, Sequence[Mover]], x_m: float, y_m: float
    ) -> set[tuple[MoverKind, Mover]]:
        """Select contact candidates for a robot near a point; return the movers among them."""
        close = {
            (kind, mover)
            for kind, movers in near.items()
            for mover in movers
            if mover.may_come_within(x_m, y_m, self._reach_m)
        }
        self._engine.select_candidates(self._reach_m, close)
        return close

    def _foot_heights(self, kind: MoverKind, ways: Mapping[Mover, TickPoses]) -> list[float]:
        """Return the ground height in metres under each mover at the end of the tick."""
        end = np.array([way[-1] for way in ways.values()])
        if kind == "pedestrian":
            z_m = self.surface.heights(end[:, :2])
        else:
            z_m = self.surface.road(end[:, :2], end[:, 2], [mover.size_m for mover in ways])[:, 0]
        return list(map(float, z_m))

    def _overlaps(self, kind: MoverKind, mover: Mover, trace: Floats) -> list[Contact]:
        """Return overlaps of the robot's footprint with a mover, independent of the engine."""
        half = 0.5 * np.array(self.footprint_m)
        way = np.array(mover.poses(len(trace)))[:, None]
        if kind == "pedestrian":
            hit = box_disk_gap(trace, half[0], half[1], way[:, :, :2]) < PERSON_RADIUS_M
        else:
            hit = boxes_overlap(trace[:, None], half, way, 0.5 * np.array([[mover.size_m]]))
        return [Contact(kind, mover.id, k) for k in np.flatnonzero(hit).tolist()]

    def _load_tiles(self, x_m: float, y_m: float) -> None:
        """Load tiles near a point and unload distant ones, once the robot has moved far enough."""
        if (
            math.hypot(x_m - self._loaded_at_m[0], y_m - self._loaded_at_m[1])
            < self._reload_after_m
        ):
            return
        bodies = self._engine
        for key in [k for k in self._tiles if tile_distance(k, x_m, y_m) > _UNLOAD_M]:
            bodies.remove(self._tiles.pop(key))
        for key in tiles_within(x_m, y_m, _LOAD_M):
            if key not in self._tiles:
                self._tiles[key] = bodies.add_chunk(self.surface.chunk(key))
        to_load_m = [
            far_m - _LOAD_M
            for far_m, key in tile_distances_within(x_m, y_m, _UNLOAD_M)
            if key not in self._tiles
        ]
        to_unload_m = [_UNLOAD_M - tile_distance(key, x_m, y_m) for key in self._tiles]
        self._loaded_at_m = (x_m, y_m)
        self._reload_after_m = min(to_load_m + to_unload_m) - _ROUNDING_M

    def _ensured_drive(self) -> Drive:
        """Return the drive; cameras of a world need none, nor the weights of its gait."""
        if self._drive is None:
            self._drive = drive_of(self.robot, SUBSTEP_S)
        if self._leg_monitor is None and isinstance(self.robot.drive, Legs):
            self._leg_monitor = LegMonitor(self.robot.drive, self._drive.cycle_s, SUBSTEP_S)
        return self._drive

    @property
    def _engine(self) -> Bodies:
        if self._bodies is None:
            raise EngineError("the physics is not running: use BulletWorld in a 'with' block")
        return self._bodies

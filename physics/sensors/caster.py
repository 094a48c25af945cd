"""Rays from a robot against the collision shapes of everything within a range.

The shapes are those of `physics.dynamics.bodies`. They are stored apart from the physics, which a
query therefore cannot change. The robot itself has no shape here.

Boxes and cylinders are arrays (`shapes`). The triangles of the ground and of scans are bodies of an
own Bullet client (`triangles`), for rays that reach below the highest triangle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats
from cosim.core.state import PERSON_RADIUS_M, Age, People, RobotState, Street, Vehicles
from cosim.spec.obstacle import Obstacle
from cosim.spec.robot import Robot
from cosim.spec.scenario import Barrier
from physics.cameras.posture import posture_of
from physics.dynamics.bodies import PERSON_HEIGHT_M, VEHICLE_HEIGHT_M, building_boxes
from physics.ground.mesh import join
from physics.ground.tiles import Key, tile_distance, tiles_within
from physics.robots.kinematics import Rotation, attitude, rotate
from physics.sensors.shapes import (
    Rays,
    Solids,
    boxes_of,
    cylinders_of,
    first_hits,
    joined,
    within,
)
from physics.sensors.triangles import TriangleRays
from physics.street.furniture import Prop, solids_of
from physics.street.surface import Chunk, Surface, grounded_obstacles

OVERHANG_M: Final = 20.0
"""Distance in metres by which a building may extend beyond its tile, as in `BulletWorld`."""

_SELECT_M: Final = 4.0
"""Distance in metres that the robot moves before nearby shapes are selected again."""
_MARGIN_M: Final = 0.1
"""Margin in metres around the heights of triangles for feet between their corners."""


_POINTS: Final = np.array([(0.0, 0.4), (0.0, 1.0), (0.0, 1.5), (0.15, 1.1), (-0.15, 1.1)])
"""Points of a standing adult's body that are searched: across the line of sight, and up; metres."""
_CHILD: Final = Age.CHILD.value
_SHORT: Final = 0.7
"""Height of children and of sitting people as a share of a standing adult's."""


@dataclass(frozen=True, slots=True)
class _Meshes:
    """Bodies of the triangles of a tile, and their lowest and highest corner in metres."""

    bodies: tuple[int, ...]
    low_m: float
    high_m: float


@dataclass(frozen=True, slots=True)
class _Near:
    """Static shapes around a point: valid while the robot is within _SELECT_M of it."""

    x_m: float
    y_m: float
    solids: Solids
    low_m: float
    high_m: float


class Moving:
    """People and vehicles of a street snapshot, with the heights of their feet as needed.

    short: (N,) whether a person is a child or sits.
    """

    def __init__(self, surface: Surface, street: Street) -> None:
        self._surface = surface
        self.street = street
        self._foot_m = np.full(len(street.people), np.nan)
        self.vehicles = _vehicle_boxes(surface, street.vehicles)
        sitting = np.array([doing == "sit" for doing in street.people.doing], dtype=bool)
        self.short: NDArray[np.bool_] = sitting | (street.people.age == _CHILD)

    def feet(self, rows: NDArray[np.intp]) -> Floats:
        """Return the (N,) heights in metres of the ground under the people in these rows."""
        new = rows[np.isnan(self._foot_m[rows])]
        if len(new):
            self._foot_m[new] = self._surface.heights(self.street.people.xy[new])
        return self._foot_m[rows]


class RayCaster:
    """Rays against the shapes of an episode's street; use it in a `with` block.

    surface, barriers, obstacles, robot: those of the episode's `BulletWorld`.
    range_m: largest range of a query.
    """

    def __init__(
        self,
        surface: Surface,
        barriers: Sequence[Barrier],
        obstacles: Sequence[Obstacle],
        robot: Robot,
        range_m: float,
    ) -> None:
        self._surface = surface
        self._robot = robot
        self._range_m = range_m
        self._client: TriangleRays | None = None
        self._tiles: dict[Key, Solids] = {}
        self._meshes: dict[Key, _Meshes] = {}
        self._near: _Near | None = None
        self._moving: Moving | None = None
        own = [_barrier_row(surface, barrier) for barrier in barriers]
        props = grounded_obstacles(obstacles, surface)
        self._own = joined([Solids(boxes_of(own), cylinders_of([])), _prop_solids(props)])

    def __enter__(self) -> Self:
        self._client = TriangleRays()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
            self._meshes.clear()
            self._near = None

    def distances(
        self, robot: RobotState, street: Street, height_m: float, directions: Floats, range_m: float
    ) -> Floats:
        """Return the (N,) distances in metres at which rays first hit; inf beyond the range.

        height_m: height of the sensor above the ground under a level robot.
        directions: (3, N) unit vectors in the frame of the robot's trunk.
        """
        rays = self._rays(robot, height_m, directions)
        near = self._select(robot.pose.x_m, robot.pose.y_m)
        moving = self._moved(street)
        people = _rows_within(street.people, robot, range_m)
        low_m, high_m = _levels_of(rays, range_m)
        if self._surface.level and low_m > near.high_m and high_m < near.low_m + PERSON_HEIGHT_M:
            feet = np.full(len(people), near.low_m)
        else:
            feet = moving.feet(people)
        found = joined(
            [near.solids, Solids(moving.vehicles, _cylinders(street.people, people, feet))]
        )
        distance = first_hits(rays, found).distance
        distance[distance > range_m] = np.inf
        return self._with_triangles(rays, distance, near, range_m)

    def seen_people(
        self, robot: RobotState, street: Street, height_m: float, range_m: float
    ) -> NDArray[np.intp]:
        """Return the rows of people within a range of whom a part is visible from a robot.

        height_m: height of the eye above the ground under a level robot.
        """
        people = street.people
        origin, _ = sensor_frame(self._surface, self._robot, robot, height_m)
        to_x, to_y = people.xy[:, 0] - origin[0], people.xy[:, 1] - origin[1]
        off = np.hypot(to_x, to_y)
        rows = np.flatnonzero(off <= range_m)
        if not len(rows):
            return rows
        near = self._select(robot.pose.x_m, robot.pose.y_m)
        moving = self._moved(street)
        feet = moving.feet(rows)
        to_x, to_y, off = to_x[rows], to_y[rows], np.maximum(off[rows], 1e-6)
        short = moving.short[rows]
        across, up = _POINTS[:, :1], _POINTS[:, 1:] * np.where(short, _SHORT, 1.0)
        x = (to_x - across * to_y / off).ravel()
        y = (to_y + across * to_x / off).ravel()
        z = (feet + up - origin[2]).ravel()
        far = np.sqrt(x * x + y * y + z * z)
        rays = Rays(origin, x / far, y / far, z / far)
        solids = near.solids
        bodies = Solids(moving.vehicles, _cylinders(people, rows, feet))
        hits = first_hits(rays, joined([solids, bodies]))
        first_body = len(solids) + moving.vehicles.shape[1]
        own = hits.solid == first_body + np.tile(np.arange(len(rows)), len(_POINTS))
        clear = np.where(own | (hits.distance >= far), far, 0.0)
        seen = self._with_triangles(rays, clear, near, range_m) >= far
        shown: NDArray[np.bool_] = seen.reshape(len(_POINTS), -1).any(axis=0)
        found: NDArray[np.intp] = rows[shown]
        return found

    def _rays(self, robot: RobotState, height_m: float, directions: Floats) -> Rays:
        """Return rays in the world frame."""
        origin, rows = sensor_frame(self._surface, self._robot, robot, height_m)
        x, y, z = directions
        return Rays(origin, *[a * x + b * y + c * z for a, b, c in rows])

    def _with_triangles(self, rays: Rays, distance: Floats, near: _Near, range_m: float) -> Floats:
        """Return distances of which some may be shortened by triangles."""
        z0 = rays.origin[2]
        reach = np.minimum(distance, range_m)
        low = np.flatnonzero(z0 + np.minimum(rays.z, 0.0) * reach <= near.high_m)
        if not len(low) or self._client is None:
            return distance
        begin, end = np.empty((2, len(low), 3))
        begin[:] = rays.origin
        for axis, way in enumerate((rays.x, rays.y, rays.z)):
            end[:, axis] = reach[low] * way[low]
        shares = self._client.hit_shares(begin, np.add(end, begin, out=end))
        hit = shares < 1.0
        distance[low[hit]] = shares[hit] * reach[low[hit]]
        return distance

    def _moved(self, street: Street) -> Moving:
        """Return the moving shapes of a street, those of the last query if it is the same."""
        if self._moving is None or self._moving.street is not street:
            self._moving = Moving(self._surface, street)
        return self._moving

    def _select(self, x_m: float, y_m: float) -> _Near:
        """Return the static shapes around a point; load and unload tiles."""
        last = self._near
        if last is not None and math.hypot(x_m - last.x_m, y_m - last.y_m) <= _SELECT_M:
            return last
        reach_m = self._range_m + _SELECT_M
        keys = tiles_within(x_m, y_m, reach_m + OVERHANG_M)
        self._tiles = {
            key: self._tiles[key] if key in self._tiles else _tile_solids(self._surface.chunk(key))
            for key in keys
        }
        self._load_meshes([key for key in keys if tile_distance(key, x_m, y_m) <= reach_m])
        solids = within(joined([self._own, *self._tiles.values()]), x_m, y_m, reach_m)
        low_m = min((mesh.low_m for mesh in self._meshes.values()), default=math.inf)
        high_m = max((mesh.high_m for mesh in self._meshes.values()), default=-math.inf)
        self._near = _Near(x_m, y_m, solids, low_m - _MARGIN_M, high_m + _MARGIN_M)
        return self._near

    def _load_meshes(self, keys: Sequence[Key]) -> None:
        """Load the triangles of exactly these tiles."""
        client = self._client
        if client is None:
            raise EngineError("the sensors are not running: use RayCaster in a 'with' block")
        for key in [key for key in self._meshes if key not in keys]:
            for body in self._meshes.pop(key).bodies:
                client.remove(body)
        for key in keys:
            if key not in self._meshes:
                chunk = self._surface.chunk(key)
                ground = join([patch.mesh for patch in chunk.ground])
                meshes = [mesh for mesh in (ground, *chunk.standing) if len(mesh)]
                heights = np.concatenate([np.zeros(0), *(mesh.vertices[:, 2] for mesh in meshes)])
                self._meshes[key] = _Meshes(
                    tuple([client.add(mesh) for mesh in meshes]),
                    float(heights.min(initial=math.inf)),
                    float(heights.max(initial=-math.inf)),
                )


def sensor_frame(
    surface: Surface, model: Robot, robot: RobotState, height_m: float
) -> tuple[tuple[float, float, float], Rotation]:
    """Return position and axes of a sensor above the middle of a robot.

    height_m: height above the ground under a level robot.
    """
    posture = posture_of(surface, model, robot)
    if robot.trunk is not None:
        turn = robot.trunk.rotation
    else:
        turn = attitude(posture.roll_rad, posture.pitch_rad, posture.heading_rad)
    shift = rotate(turn, (0.0, 0.0, height_m - model.drive.pivot_m))
    x, y, z = posture.at_m
    return (x + shift[0], y + shift[1], z + shift[2]), turn


def _levels_of(rays: Rays, range_m: float) -> tuple[float, float]:
    """Return the lowest and the highest point of rays in metres."""
    z0 = rays.origin[2]
    low, high = float(rays.z.min(initial=0.0)), float(rays.z.max(initial=0.0))
    return z0 + range_m * low, z0 + range_m * high


def _rows_within(people: People, robot: RobotState, range_m: float) -> NDArray[np.intp]:
    """Return the rows of people with a part within a range of the robot."""
    off = np.hypot(people.xy[:, 0] - robot.pose.x_m, people.xy[:, 1] - robot.pose.y_m)
    return np.flatnonzero(off <= range_m + PERSON_RADIUS_M + 1.0)


def _cylinders(people: People, rows: NDArray[np.intp], feet: Floats) -> Floats:
    """Return the bodies of people.

    feet: (N,) heights of the ground under them.
    """
    xy = people.xy[rows]
    radius = np.full(len(rows), PERSON_RADIUS_M)
    return np.stack([xy[:, 0], xy[:, 1], radius, feet, feet + PERSON_HEIGHT_M])


def _vehicle_boxes(surface: Surface, vehicles: Vehicles) -> Floats:
    """Return the bodies of vehicles."""
    xy, heading, half = vehicles.xy, vehicles.heading, 0.5 * vehicles.size
    foot = surface.road(xy, heading, vehicles.size)[:, 0]
    turn = np.cos(heading), np.sin(heading)
    return np.stack([*xy.T, *turn, *half.T, foot, foot + VEHICLE_HEIGHT_M])


def _barrier_row(surface: Surface, barrier: Barrier) -> tuple[float, ...]:
    x, y, heading = barrier.x_m, barrier.y_m, barrier.heading_rad
    size = (barrier.thickness_m, barrier.length_m)
    foot = surface.foot(x, y, heading, size)
    return x, y, heading, *size, foot, foot + barrier.height_m


def _tile_solids(chunk: Chunk) -> Solids:
    """Return the buildings and props of a tile."""
    rows: list[tuple[float, ...]] = [
        (x, y, heading, length, width, z, z + height)
        for building in chunk.buildings
        for (x, y, z), heading, (length, width, height) in building_boxes(building)
    ]
    return joined([Solids(boxes_of(rows), cylinders_of([])), _prop_solids(chunk.props)])


def _prop_solids(props: Sequence[tuple[Prop, float]]) -> Solids:
    """Return the shapes of props, each with the height of its foot."""
    boxes: list[tuple[float, ...]] = []
    cylinders: list[tuple[float, ...]] = []
    for prop, foot in props:
        cos, sin = math.cos(prop.heading_rad), math.sin(prop.heading_rad)
        for solid in solids_of(prop.kind, prop.variant):
            u, v = solid.at_m
            x, y = prop.x_m + cos * u - sin * v, prop.y_m + sin * u + cos * v
            length, width, height = solid.size_m
            if solid.shape == "box":
                boxes.append((x, y, prop.heading_rad, length, width, foot, foot + height))
            else:
                cylinders.append((x, y, 0.5 * length, foot, foot + height))
    return Solids(boxes_of(boxes), cylinders_of(cylinders))

"""Collision bodies in one PyBullet client: robot, ground, street and traffic."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError, SpecError
from cosim.core.geometry import Floats, Pose
from cosim.core.state import PERSON_RADIUS_M, LegState, RobotState, Trunk
from cosim.spec.robot import Legs, Robot
from cosim.spec.scenario import Barrier
from physics.dynamics.bullet import p
from physics.dynamics.client import UPRIGHT, BulletClient
from physics.dynamics.drive import MeasuredBody, Motors, Vector
from physics.dynamics.movers import Mover, TickPoses
from physics.ground.mesh import Mesh, join
from physics.ground.tiles import CURB_M
from physics.robots import urdf_path
from physics.robots.kinematics import rotate, rows_of
from physics.street.buildings import Building, Wall
from physics.street.furniture import Prop, solids_of
from physics.street.surface import Chunk

PERSON_HEIGHT_M: Final = 1.7
"""Height of a person's cylinder in metres."""

VEHICLE_HEIGHT_M: Final = 1.5
"""Height of a vehicle's box in metres."""

WALL_THICKNESS_M: Final = 0.2
"""Thickness of a mapped building's walls in metres."""

PARKED_Z_M: Final = -50.0
"""Height in metres at which inactive bodies are parked."""

_SEARCH_STEP_M: Final = 0.5
"""Distance in metres that the robot moves before nearby static bodies are searched again."""
_NO_CHANGE: Final = (0.0, 0.0, 0.0)
"""Change of the pose of a mover at rest."""
_UNKNOWN: Final = (math.inf, math.inf, math.inf)
"""Position before the first one is known."""
_BODY_FRICTION: Final = 0.4
"""Friction coefficient of a robot's links that do not carry it."""
_FOOT_FRICTION: Final = 1.0
"""Friction coefficient of feet."""
_TYRE: Final = {
    "lateralFriction": 1.0,
    "anisotropicFriction": (1.0, 0.3, 1.0),
    "contactStiffness": 30_000.0,
    "contactDamping": 1_000.0,
}
"""Contact parameters of a tyre.

Soft tyres share the load evenly and slide more easily sideways (y is the axle). With stiff tyres,
or with the friction cone, skid turns are jerky.
"""

BodyKind = Literal["pedestrian", "vehicle", "wall", "object"]
"""Kinds of bodies in contacts."""
MoverKind = Literal["pedestrian", "vehicle"]
"""Kinds of bodies that move."""
Box = tuple[tuple[float, float, float], float, tuple[float, float, float]]
"""Foot of an upright box's centre, its heading in radians, and length, width and height."""

_Placement = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Position of a body's centre, and its orientation as a quaternion."""


class Bodies(BulletClient):
    """A running PyBullet client with all collision bodies of an episode.

    grip: factor of the friction of the ground
    at_m: position of the robot's base frame
    contact_candidates: bodies that `robot_contacts` checks

    Inactive bodies of people and vehicles are parked far below the ground and reused.
    """

    def __init__(self, robot: Robot, substep_s: float, grip: float = 1.0) -> None:
        super().__init__()
        self._grip = grip
        self._com_height_m = robot.com_height_m
        self._legs = robot.drive if isinstance(robot.drive, Legs) else None
        self._identities: dict[int, tuple[BodyKind, str]] = {}
        self._idle: dict[Any, list[int]] = {}
        self._active: dict[MoverKind, dict[str, tuple[int, Any]]] = {
            "pedestrian": {},
            "vehicle": {},
        }
        self._paths: dict[MoverKind, list[tuple[int, list[_Placement]]]] = {}
        self._final_poses: dict[int, tuple[float, float, float]] = {}
        self.at_m = _UNKNOWN
        self._searched_at_m = _UNKNOWN
        self._static_near: dict[int, Any] = {}
        self.contact_candidates: list[int] = []
        self._target_radps: list[float] = []
        self._angles: tuple[float, ...] = ()
        self._speeds: tuple[float, ...] = ()
        self._shapes: dict[Any, int] = {}
        self._call("setGravity", 0.0, 0.0, -9.81)
        self._call(
            "setPhysicsEngineParameter",
            fixedTimeStep=substep_s,
            numSubSteps=0,
            deterministicOverlappingPairs=1,
            enableConeFriction=0,
        )
        path = str(urdf_path(robot))
        try:
            self._robot: int = self._call("loadURDF", path, flags=p.URDF_USE_INERTIA_FROM_FILE)
        except EngineError as error:
            raise SpecError(f"{path}: {error}") from error
        infos = [
            self._call("getJointInfo", self._robot, j)
            for j in range(self._call("getNumJoints", self._robot))
        ]
        joints = {info[1].decode(): info[0] for info in infos}
        self._joints = [joints[name] for name in robot.drive.joints]
        if isinstance(robot.drive, Legs):
            links = {"base": -1} | {info[12].decode(): info[0] for info in infos}
            self._set_up_legs(robot.drive, links)
        else:
            self._set_dynamics(-1, lateralFriction=_BODY_FRICTION)
            for wheel in self._joints:
                self._set_dynamics(wheel, **_TYRE)
        self._read()

    def _set_dynamics(self, link: int, **more: Any) -> None:
        """Set contact parameters of a link of the robot, and remove Bullet's damping."""
        self._call(
            "changeDynamics", self._robot, link, linearDamping=0.0, angularDamping=0.0, **more
        )

    def _set_up_legs(self, legs: Legs, links: Mapping[str, int]) -> None:
        """Set the contacts of feet and body, and make the joints follow torques."""
        feet = {links[name] for name in legs.feet}
        for link in links.values():
            friction = _FOOT_FRICTION if link in feet else _BODY_FRICTION
            self._set_dynamics(link, lateralFriction=friction)
        self._trunk = [links[name] for name in legs.trunk]
        dynamics = self._call("getDynamicsInfo", self._robot, -1)
        self._middle_m: tuple[float, float, float] = dynamics[3]
        for joint in self._joints:
            self._call("changeDynamics", self._robot, joint, jointDamping=0.0)
            self._call("setJointMotorControl2", self._robot, joint, p.VELOCITY_CONTROL, force=0.0)

    def add_chunk(self, chunk: Chunk) -> list[int]:
        """Add the bodies of a tile; return their ids for `remove`."""
        self._searched_at_m = _UNKNOWN
        of_friction: dict[float, list[Mesh]] = {}
        for patch in chunk.ground:
            of_friction.setdefault(patch.friction, []).append(patch.mesh)
        ground = [self._add_ground(join(meshes), value) for value, meshes in of_friction.items()]
        houses = [body for b in chunk.buildings for body in self._add_building(b)]
        scanned = [self.add_concave(mesh) for mesh in chunk.standing]
        self._identities |= dict.fromkeys(scanned, ("wall", "scan"))
        props = [self.add_prop(prop, z) for prop, z in chunk.props]
        return [*ground, *houses, *scanned, *props]

    def _add_ground(self, mesh: Mesh, value: float) -> int:
        ground = self.add_concave(mesh)
        self._call("changeDynamics", ground, -1, lateralFriction=self._grip * value)
        return ground

    def _add_building(self, building: Building) -> list[int]:
        bodies = []
        for foot, heading, size in building_boxes(building):
            bodies.append(self._add_box(foot, heading, size))
            self._identities[bodies[-1]] = ("wall", building.id)
        return bodies

    def _add_box(
        self,
        foot_m: tuple[float, float, float],
        heading_rad: float,
        size_m: tuple[float, float, float],
    ) -> int:
        half = [0.5 * size for size in size_m]
        shape = self._call("createCollisionShape", p.GEOM_BOX, halfExtents=half)
        x, y, z = foot_m
        turn = p.getQuaternionFromEuler((0.0, 0.0, heading_rad))
        return self._create_body(shape, (x, y, z + half[2]), turn)

    def add_prop(self, prop: Prop, z_m: float) -> int:
        """Add a prop whose foot is at height `z_m`; return its body id."""
        pool = (prop.kind, prop.variant)
        if pool not in self._shapes:
            solids = solids_of(*pool)
            self._shapes[pool] = self._call(
                "createCollisionShapeArray",
                shapeTypes=[p.GEOM_BOX if s.shape == "box" else p.GEOM_CYLINDER for s in solids],
                halfExtents=[[0.5 * c for c in s.size_m] for s in solids],
                radii=[0.5 * s.size_m[0] for s in solids],
                lengths=[s.size_m[2] for s in solids],
                collisionFramePositions=[[*s.at_m, 0.5 * s.size_m[2]] for s in solids],
            )
        turn = p.getQuaternionFromEuler((0.0, 0.0, prop.heading_rad))
        body = self._create_body(self._shapes[pool], (prop.x_m, prop.y_m, z_m), turn)
        self._identities[body] = ("object", prop.id)
        return body

    def add_barrier(self, barrier: Barrier, z_m: float) -> int:
        """Add a barrier whose foot is at height `z_m`; return its body id."""
        size = (barrier.thickness_m, barrier.length_m, barrier.height_m)
        body = self._add_box((barrier.x_m, barrier.y_m, z_m), barrier.heading_rad, size)
        self._identities[body] = ("object", f"barrier:{barrier.strip}:{barrier.end}")
        return body

    def remove(self, bodies: Sequence[int]) -> None:
        """Remove bodies."""
        self._searched_at_m = _UNKNOWN
        for body in bodies:
            self.remove_body(body)
            self._identities.pop(body, None)

    def activate(self, kind: MoverKind, movers: Sequence[Mover]) -> None:
        """Activate a body for exactly these people or vehicles.

        A body stays at its place until `set_paths` moves it.
        """
        shown = self._active[kind]
        ids = [mover.id for mover in movers]
        if list(shown) == ids:
            return
        for name in [name for name in shown if name not in ids]:
            body, pool = shown.pop(name)
            self._identities.pop(body)
            self._idle[pool].append(body)
            self._park(body)
        for mover in movers:
            if mover.id not in shown:
                pool = kind if kind == "pedestrian" else (kind, *mover.size_m)
                body = self._acquire(pool)
                shown[mover.id] = (body, pool)
                self._identities[body] = (kind, mover.id)
        self._active[kind] = {name: shown[name] for name in ids}

    def is_at_rest(self, kind: MoverKind, mover: Mover) -> bool:
        """Return whether an active body is at rest where `set_paths` last put it."""
        return (
            mover.change == _NO_CHANGE
            and self._final_poses.get(self._active[kind][mover.id][0]) == mover.start
        )

    def set_paths(
        self, kind: MoverKind, ways: Mapping[Mover, TickPoses], z_m: Sequence[float]
    ) -> None:
        """Set the poses of active bodies for each substep of the next tick; all others stay.

        ways: poses after each substep
        z_m: height of the ground under each body
        """
        half = 0.5 * (PERSON_HEIGHT_M if kind == "pedestrian" else VEHICLE_HEIGHT_M)
        self._paths[kind] = []
        for (mover, way), z in zip(ways.items(), z_m, strict=True):
            body = self._active[kind][mover.id][0]
            self._final_poses[body] = way[-1]
            placements = [
                ((x, y, z + half), (0.0, 0.0, math.sin(0.5 * heading), math.cos(0.5 * heading)))
                for x, y, heading in way
            ]
            self._paths[kind].append((body, placements))

    def place_on_paths(self, substep: int) -> None:
        """Put the bodies of `set_paths` where they are after a substep.

        People that are not candidates cannot touch the robot: they move at the end of the tick.
        """
        for kind, led in self._paths.items():
            for body, way in led:
                if kind == "vehicle" or substep + 1 == len(way) or body in self.contact_candidates:
                    p.resetBasePositionAndOrientation(body, *way[substep], self._client)

    def _park(self, body: int) -> None:
        self._final_poses.pop(body, None)
        p.resetBasePositionAndOrientation(body, (0.0, 0.0, PARKED_Z_M), UPRIGHT, self._client)

    def _acquire(self, pool: Any) -> int:
        waiting = self._idle.setdefault(pool, [])
        if waiting:
            return waiting.pop()
        if pool not in self._shapes:
            if pool == "pedestrian":
                shape = self._call(
                    "createCollisionShape",
                    p.GEOM_CYLINDER,
                    radius=PERSON_RADIUS_M,
                    height=PERSON_HEIGHT_M,
                )
            else:
                half = (0.5 * pool[1], 0.5 * pool[2], 0.5 * VEHICLE_HEIGHT_M)
                shape = self._call("createCollisionShape", p.GEOM_BOX, halfExtents=half)
            self._shapes[pool] = shape
        return self._create_body(self._shapes[pool], (0.0, 0.0, PARKED_Z_M))

    def place_robot(
        self, xyz_m: tuple[float, float, float], roll_pitch_yaw: tuple[float, float, float]
    ) -> None:
        """Put the robot at rest with its base frame at a position and attitude."""
        turn = p.getQuaternionFromEuler(roll_pitch_yaw)
        m = p.getMatrixFromQuaternion(turn)
        if self._legs is None:
            h = self._com_height_m
            middle = [c + h * up for c, up in zip(xyz_m, (m[2], m[5], m[8]), strict=True)]
        else:
            shift = rotate(rows_of(m), self._middle_m)
            middle = [c + d for c, d in zip(xyz_m, shift, strict=True)]
            middle[2] += self._legs.stand_m
        self._call("resetBasePositionAndOrientation", self._robot, middle, turn)
        self._call("resetBaseVelocity", self._robot, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        rest = (0.0,) * len(self._joints) if self._legs is None else self._legs.rest_rad
        for joint, angle in zip(self._joints, rest, strict=True):
            self._call("resetJointState", self._robot, joint, angle, 0.0)
        self._read()

    def step(self, substep: int, motors: Motors) -> tuple[float, float, float]:
        """Run one substep; return x, y and heading of the robot's base frame.

        substep: index within the tick, from 0
        motors: values for the joints, in the order of the drive's joints
        """
        self.place_on_paths(substep)
        if motors.limits_nm is None:  # PyBullet forgets torques after a substep
            p.setJointMotorControlArray(
                self._robot,
                self._joints,
                p.TORQUE_CONTROL,
                forces=motors.values,
                physicsClientId=self._client,
            )
        elif motors.values != self._target_radps:  # PyBullet keeps the last targets
            self._target_radps = motors.values
            p.setJointMotorControlArray(
                self._robot,
                self._joints,
                p.VELOCITY_CONTROL,
                targetVelocities=motors.values,
                forces=motors.limits_nm,
                physicsClientId=self._client,
            )
        p.stepSimulation(self._client)
        return self._read()

    def _read(self) -> tuple[float, float, float]:
        """Read the robot's pose and velocity from the engine."""
        self._velocity: tuple[Vector, Vector] = p.getBaseVelocity(self._robot, self._client)
        (x, y, z), turn = p.getBasePositionAndOrientation(self._robot, self._client)
        self._rotation = m = p.getMatrixFromQuaternion(turn)
        if self._legs is None:
            h = self._com_height_m  # PyBullet reports the centre of mass
            self.at_m = x, y, _ = x - h * m[2], y - h * m[5], z - h * m[8]
        else:
            dx, dy, dz = rotate(rows_of(m), self._middle_m)
            self.at_m = x, y, _ = x - dx, y - dy, z - dz - self._legs.stand_m
            states = p.getJointStates(self._robot, self._joints, self._client)
            self._angles = tuple([state[0] for state in states])
            self._speeds = tuple([state[1] for state in states])
        return x, y, math.atan2(m[3], m[0])

    def measured_body(self) -> MeasuredBody:
        """Return the measured state of the base link and the joints."""
        linear, angular = self._velocity
        return MeasuredBody(self.at_m, self._rotation, linear, angular, self._angles, self._speeds)

    def trunk_touches_ground(self) -> bool:
        """Return whether a link of the trunk touches the ground, which alone has no identity."""
        return any(
            contact[8] <= 0.0 and contact[2] not in self._identities
            for link in self._trunk
            for contact in p.getContactPoints(
                bodyA=self._robot, linkIndexA=link, physicsClientId=self._client
            )
        )

    def speeds(self) -> tuple[float, float]:
        """Return the speed along the heading and the yaw rate."""
        m = self._rotation
        (linear, angular) = self._velocity
        forward = linear[0] * m[0] + linear[1] * m[3] + linear[2] * m[6]
        turn = angular[0] * m[2] + angular[1] * m[5] + angular[2] * m[8]
        return forward, turn

    def robot_state(self) -> RobotState:
        """Return the robot's pose, velocities and tilt."""
        (x, y, z) = self.at_m
        m = self._rotation
        forward, turn = self.speeds()
        pose = Pose(x, y, math.atan2(m[3], m[0]))
        trunk = Trunk(rows_of(m), *self._velocity)
        tilt = math.acos(min(max(m[8], -1.0), 1.0))
        state = RobotState(pose, forward, turn, z, tilt, trunk=trunk)
        if self._legs is None:
            return state
        roll, pitch = math.atan2(m[7], m[8]), math.asin(min(max(-m[6], -1.0), 1.0))
        return replace(state, legs=LegState(roll, pitch, self._angles))

    def select_candidates(self, reach_m: float, movers: Iterable[tuple[MoverKind, Mover]]) -> None:
        """Select the candidates for contacts with the robot.

        These are the given movers, and static bodies within reach of the robot.
        """
        x, y, z = self.at_m
        if math.dist(self.at_m, self._searched_at_m) > _SEARCH_STEP_M:
            far_m = reach_m + _SEARCH_STEP_M
            found = p.getOverlappingObjects(
                (x - far_m, y - far_m, z - far_m), (x + far_m, y + far_m, z + far_m), self._client
            )
            standing = {
                body
                for body, _ in found or ()
                if body in self._identities and self._identities[body][0] in ("wall", "object")
            }
            self._static_near = {
                body: p.getAABB(body, -1, self._client) for body in sorted(standing)
            }
            self._searched_at_m = self.at_m
        self.contact_candidates = [
            body
            for body, ((x0, y0, _), (x1, y1, _)) in self._static_near.items()
            if x0 - reach_m <= x <= x1 + reach_m and y0 - reach_m <= y <= y1 + reach_m
        ]
        self.contact_candidates += [self._active[kind][mover.id][0] for kind, mover in movers]

    def robot_contacts(self) -> list[tuple[BodyKind, str]]:
        """Return kind and id of each candidate that the robot touches."""
        return [
            self._identities[body]
            for body in self.contact_candidates
            if any(
                c[8] <= 0.0
                for c in p.getContactPoints(self._robot, body, physicsClientId=self._client)
            )
        ]

    def lines_blocked(self, begin_m: Floats, end_m: Floats) -> NDArray[np.bool_]:
        """Return which of N lines, from (N, 3) to (N, 3) points in metres, hit a body."""
        return np.isfinite(self.hit_shares(begin_m, end_m))


def building_boxes(building: Building) -> list[Box]:
    """Return the boxes of a building: its walls if it is mapped."""
    height = building.size_m[2] + building.floor_m - building.base_m
    foot_m = building.base_m + CURB_M
    if building.outline is None:
        at = (building.x_m, building.y_m, foot_m)
        return [(at, building.heading_rad, (*building.size_m[:2], height))]
    boxes = [_wall_box(wall, height) for wall in building.walls]
    return [((*at, foot_m), heading, size) for at, heading, size in boxes]


def _wall_box(
    wall: Wall, height_m: float
) -> tuple[tuple[float, float], float, tuple[float, float, float]]:
    """Return centre, heading and size of a wall.

    The wall is WALL_THICKNESS_M thick. Its outer face is on the line, the outside on the right.
    """
    x0, y0, x1, y1 = wall
    length, heading = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
    x = 0.5 * (x0 + x1) - 0.5 * WALL_THICKNESS_M * math.sin(heading)
    y = 0.5 * (y0 + y1) + 0.5 * WALL_THICKNESS_M * math.cos(heading)
    return (x, y), heading, (length, WALL_THICKNESS_M, height_m)

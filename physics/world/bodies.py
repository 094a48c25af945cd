"""The collision bodies in one PyBullet client: robot, ground, buildings, barriers, and what moves near the robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, Literal

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats, Pose
from cosim.core.state import PERSON_RADIUS_M, RobotState
from cosim.spec.robot import Robot
from cosim.spec.scenario import Barrier
from physics.robots import urdf_of
from physics.street.buildings import Building, Wall
from physics.street.furniture import Prop, solids_of
from physics.world.bullet import p
from physics.world.mesh import Mesh, as_lists, join
from physics.world.surface import Chunk
from physics.world.tiles import CURB_M

PERSON_M: Final = 1.7
VEHICLE_M: Final = 1.5
WALL_M: Final = 0.2
"""How thick the walls of mapped buildings are."""

FAR_BELOW_M: Final = -50.0
_UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0)
_TYRE: Final = {
    "lateralFriction": 1.0,
    "anisotropicFriction": (1.0, 0.3, 1.0),
    "contactStiffness": 30_000.0,
    "contactDamping": 1_000.0,
}
"""Soft tyres share the load evenly and slide more easily sideways (y is the axle): without both, and with the
friction cone, skid turns come in jerks."""

BodyKind = Literal["pedestrian", "vehicle", "wall", "object"]
Moving = Literal["pedestrian", "vehicle"]


class Bodies:
    """A running engine. Bodies that are not shown wait far below the ground for their next use."""

    def __init__(self, robot: Robot, substep_s: float) -> None:
        self._client: int = p.connect(p.DIRECT)
        if self._client < 0:
            raise EngineError("PyBullet did not start")
        self._com_height_m = robot.com_height_m
        self._what: dict[int, tuple[BodyKind, str]] = {}
        self._pools: dict[Any, list[int]] = {}
        self._shown: dict[Moving, dict[str, tuple[int, Any]]] = {"pedestrian": {}, "vehicle": {}}
        self._z: dict[Moving, list[float]] = {"pedestrian": [], "vehicle": []}
        self._shapes: dict[Any, int] = {}
        self._do("setGravity", 0.0, 0.0, -9.81)
        self._do(
            "setPhysicsEngineParameter",
            fixedTimeStep=substep_s,
            numSubSteps=0,
            deterministicOverlappingPairs=1,
            enableConeFriction=0,
        )
        self._robot: int = self._do("loadURDF", str(urdf_of(robot)), flags=p.URDF_USE_INERTIA_FROM_FILE)
        infos = [self._do("getJointInfo", self._robot, j) for j in range(self._do("getNumJoints", self._robot))]
        joints = {info[1].decode(): info[0] for info in infos}
        self._wheels = [joints[name] for name in robot.drive.joints]
        self._torques = [robot.drive.torque_nm] * len(self._wheels)
        self._do("changeDynamics", self._robot, -1, lateralFriction=0.4, linearDamping=0.0, angularDamping=0.0)
        for wheel in self._wheels:
            self._do("changeDynamics", self._robot, wheel, linearDamping=0.0, angularDamping=0.0, **_TYRE)

    def close(self) -> None:
        p.disconnect(self._client)

    def add_chunk(self, chunk: Chunk) -> list[int]:
        """What is in a square of a surface; returns what `remove` takes."""
        of_friction: dict[float, list[Mesh]] = {}
        for patch in chunk.ground:
            of_friction.setdefault(patch.friction, []).append(patch.mesh)
        ground = [self._add_ground(join(meshes), value) for value, meshes in of_friction.items()]
        houses = [body for b in chunk.buildings for body in self._add_building(b)]
        return [*ground, *houses, *(self._add_prop(prop, z) for prop, z in chunk.props)]

    def _add_ground(self, mesh: Mesh, value: float) -> int:
        middle = mesh.vertices.mean(axis=0) * (1.0, 1.0, 0.0)
        flags = p.GEOM_FORCE_CONCAVE_TRIMESH
        with as_lists(mesh.triangles, mesh.vertices - middle) as (indices, (vertices,)):
            shape = self._do("createCollisionShape", p.GEOM_MESH, vertices=vertices, indices=indices, flags=flags)
        ground = self._body(shape, middle)
        self._do("changeDynamics", ground, -1, lateralFriction=value)
        return ground

    def _add_building(self, building: Building) -> list[int]:
        height = building.size_m[2] + building.floor_m - building.base_m
        boxes = [((building.x_m, building.y_m), building.heading_rad, (*building.size_m[:2], height))]
        if building.outline is not None:
            boxes = [_wall_box(wall, height) for wall in building.walls]
        bodies = []
        for (x, y), heading, size in boxes:
            half = [0.5 * s for s in size]
            shape = self._do("createCollisionShape", p.GEOM_BOX, halfExtents=half)
            turn = p.getQuaternionFromEuler((0.0, 0.0, heading))
            bodies.append(self._body(shape, (x, y, building.base_m + CURB_M + half[2]), turn))
            self._what[bodies[-1]] = ("wall", building.id)
        return bodies

    def _add_prop(self, prop: Prop, z_m: float) -> int:
        pool = (prop.kind, prop.variant)
        if pool not in self._shapes:
            solids = solids_of(*pool)
            self._shapes[pool] = self._do(
                "createCollisionShapeArray",
                shapeTypes=[p.GEOM_BOX if s.shape == "box" else p.GEOM_CYLINDER for s in solids],
                halfExtents=[[0.5 * c for c in s.size_m] for s in solids],
                radii=[0.5 * s.size_m[0] for s in solids],
                lengths=[s.size_m[2] for s in solids],
                collisionFramePositions=[[*s.at_m, 0.5 * s.size_m[2]] for s in solids],
            )
        turn = p.getQuaternionFromEuler((0.0, 0.0, prop.heading_rad))
        body = self._body(self._shapes[pool], (prop.x_m, prop.y_m, z_m), turn)
        self._what[body] = ("object", prop.id)
        return body

    def add_barrier(self, barrier: Barrier, z_m: float) -> int:
        half = (0.5 * barrier.thickness_m, 0.5 * barrier.length_m, 0.5 * barrier.height_m)
        shape = self._do("createCollisionShape", p.GEOM_BOX, halfExtents=half)
        turn = p.getQuaternionFromEuler((0.0, 0.0, barrier.heading_rad))
        body = self._body(shape, (barrier.x_m, barrier.y_m, z_m + half[2]), turn)
        self._what[body] = ("object", f"barrier:{barrier.strip}:{barrier.end}")
        return body

    def remove(self, bodies: Sequence[int]) -> None:
        for body in bodies:
            self._do("removeBody", body)
            self._what.pop(body, None)

    def show(self, kind: Moving, ids: Sequence[str], z_m: Floats, size_m: Floats | None = None) -> None:
        """Let exactly these people or vehicles be there; z_m: (N,) height of the ground under each; size_m: (N, 2)."""
        shown = self._shown[kind]
        for name in [name for name in shown if name not in set(ids)]:
            body, pool = shown.pop(name)
            self._what.pop(body)
            self._pools[pool].append(body)
            self._do("resetBasePositionAndOrientation", body, (0.0, 0.0, FAR_BELOW_M), _UPRIGHT)
        for i, name in enumerate(ids):
            if name not in shown:
                pool = kind if size_m is None else (kind, float(size_m[i, 0]), float(size_m[i, 1]))
                body = self._taken(pool)
                shown[name] = (body, pool)
                self._what[body] = (kind, name)
        self._z[kind] = [float(z) for z in z_m]
        self._shown[kind] = {name: shown[name] for name in ids}

    def move(self, kind: Moving, poses: Floats) -> None:
        """Put what is shown at (N, 3) x, y, heading, in the order of `show`."""
        half = 0.5 * (PERSON_M if kind == "pedestrian" else VEHICLE_M)
        for (body, _), z, (x, y, heading) in zip(
            self._shown[kind].values(), self._z[kind], poses.tolist(), strict=True
        ):
            turn = (0.0, 0.0, math.sin(0.5 * heading), math.cos(0.5 * heading))
            p.resetBasePositionAndOrientation(body, (x, y, z + half), turn, self._client)

    def _taken(self, pool: Any) -> int:
        waiting = self._pools.setdefault(pool, [])
        if waiting:
            return waiting.pop()
        if pool not in self._shapes:
            if pool == "pedestrian":
                shape = self._do("createCollisionShape", p.GEOM_CYLINDER, radius=PERSON_RADIUS_M, height=PERSON_M)
            else:
                half = (0.5 * pool[1], 0.5 * pool[2], 0.5 * VEHICLE_M)
                shape = self._do("createCollisionShape", p.GEOM_BOX, halfExtents=half)
            self._shapes[pool] = shape
        return self._body(self._shapes[pool], (0.0, 0.0, FAR_BELOW_M))

    def _body(self, shape: int, at: Any, turn: Any = _UPRIGHT) -> int:
        body: int = self._do(
            "createMultiBody",
            baseMass=0.0,
            baseCollisionShapeIndex=shape,
            basePosition=[float(c) for c in at],
            baseOrientation=turn,
            useMaximalCoordinates=True,
        )
        return body

    def place_robot(self, xyz_m: tuple[float, float, float], roll_pitch_yaw: tuple[float, float, float]) -> None:
        """The robot at rest with its base frame there."""
        turn = p.getQuaternionFromEuler(roll_pitch_yaw)
        m, h = p.getMatrixFromQuaternion(turn), self._com_height_m
        middle = [c + h * up for c, up in zip(xyz_m, (m[2], m[5], m[8]), strict=True)]
        self._do("resetBasePositionAndOrientation", self._robot, middle, turn)
        self._do("resetBaseVelocity", self._robot, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        for wheel in self._wheels:
            self._do("resetJointState", self._robot, wheel, 0.0, 0.0)

    def turn_wheels(self, speeds_radps: Sequence[float]) -> None:
        """Let the motors turn the drive's joints, in the order of `Skid.joints`, until told otherwise."""
        p.setJointMotorControlArray(
            self._robot,
            self._wheels,
            p.VELOCITY_CONTROL,
            targetVelocities=speeds_radps,
            forces=self._torques,
            physicsClientId=self._client,
        )

    def step(self) -> None:
        p.stepSimulation(self._client)

    def yaw_rate(self) -> float:
        """Rate of turn about the vertical, rad/s."""
        rate: float = p.getBaseVelocity(self._robot, self._client)[1][2]
        return rate

    def robot_pose(self) -> tuple[float, float, float]:
        """x, y, heading of the base frame."""
        (x, y, _), m = self._frame()
        return x, y, math.atan2(m[3], m[0])

    def robot_state(self) -> RobotState:
        (x, y, z), m = self._frame()
        linear, angular = p.getBaseVelocity(self._robot, self._client)
        forward = linear[0] * m[0] + linear[1] * m[3] + linear[2] * m[6]
        turn = angular[0] * m[2] + angular[1] * m[5] + angular[2] * m[8]
        pose = Pose(x, y, math.atan2(m[3], m[0]))
        return RobotState(pose, forward, turn, z, math.acos(min(max(m[8], -1.0), 1.0)))

    def _frame(self) -> tuple[tuple[float, float, float], tuple[float, ...]]:
        """Position of the base frame, and its rotation row by row. The engine reports the centre of mass."""
        (x, y, z), turn = p.getBasePositionAndOrientation(self._robot, self._client)
        m: tuple[float, ...] = p.getMatrixFromQuaternion(turn)
        h = self._com_height_m
        return (x - h * m[2], y - h * m[5], z - h * m[8]), m

    def robot_contacts(self) -> set[tuple[BodyKind, str]]:
        """Everything but the ground that the robot touches now."""
        points = p.getContactPoints(bodyA=self._robot, physicsClientId=self._client)
        return {self._what[c[2]] for c in points if c[2] in self._what and c[8] <= 0.0}

    def _do(self, call: str, *args: Any, **options: Any) -> Any:
        try:
            return getattr(p, call)(*args, **options, physicsClientId=self._client)
        except p.error as error:
            raise EngineError(f"PyBullet: {call}: {error}") from error


def _wall_box(wall: Wall, height_m: float) -> tuple[tuple[float, float], float, tuple[float, float, float]]:
    """Middle, heading and size of a wall: WALL_M thick, its outer face on the line, the outside to the line's right."""
    x0, y0, x1, y1 = wall
    length, heading = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
    x, y = 0.5 * (x0 + x1) - 0.5 * WALL_M * math.sin(heading), 0.5 * (y0 + y1) + 0.5 * WALL_M * math.cos(heading)
    return (x, y), heading, (length, WALL_M, height_m)

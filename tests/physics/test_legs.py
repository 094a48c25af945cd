"""Robots with legs in the engine: walking, standing, falling, and their pictures."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cosim.cli.legs import bench_legs
from cosim.core.errors import EngineError, UsageError
from cosim.core.geometry import Pose, wrap_angle
from cosim.core.progress import Progress
from cosim.core.state import STILL, Command, LegState, Motion, RobotState, Street
from cosim.policies.privileged.orca import axis_points
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import DOG, ROBOTS, Legs, Robot
from cosim.spec.scenario import Barrier
from physics.cameras.choice import camera_of
from physics.cameras.gl.robot_body import link_parts
from physics.cameras.posture import posture_of
from physics.cameras.view import robot_shot
from physics.dynamics.bullet import p
from physics.dynamics.drive import Drive, MeasuredBody, Motors
from physics.dynamics.legs.leg_monitor import LegMonitor
from physics.dynamics.legs.trot import leg_angles
from physics.dynamics.world import BulletWorld
from physics.robots import urdf_path
from physics.robots.dog import SEGMENT_M, THIGH_ASIDE_M
from physics.robots.kinematics import link_tree, turned
from physics.robots.make_urdf import MODELS
from physics.street.street_surface import StreetSurface
from scenarios.tools.bench import legs
from scenarios.tools.bench.legs import (
    FLAT,
    RAMPS,
    STEPS,
    MakeDrive,
    Walk,
    down_curb,
    mean_speeds,
    stand,
    stop,
    straight,
    up_curb,
    walking,
    wander,
)
from tests.support.gaits import written_gait
from tests.support.tiny_street import tiny_map

pytestmark = pytest.mark.engine

LEGGED = {name: one for name, one in ROBOTS.items() if isinstance(one.drive, Legs)}
MASSES_KG = {"dog": 15.0, "walker": 32.1}
STRAIGHT_MPS = {"dog": 1.0, "walker": 0.8}
WITHIN_S = {"dog": 12.0, "walker": 14.0}
START = Pose(-40.0, 0.0, 0.0)


def legs_of(robot: Robot) -> Legs:
    assert isinstance(robot.drive, Legs)
    return robot.drive


@pytest.fixture(params=LEGGED.values(), ids=LEGGED)
def robot(request: pytest.FixtureRequest) -> Robot:
    if request.param.drive.gait == "network":
        request.getfixturevalue("walker_weights")
    return request.param  # type: ignore[no-any-return]


@pytest.fixture
def walk(robot: Robot) -> Iterator[Walk]:
    with walking(robot, FLAT, START) as walk:
        yield walk


def engine_of(walk: Walk) -> tuple[int, int]:
    """Return the body of the robot, and the PyBullet client."""
    bodies = walk.world._engine
    return bodies._robot, bodies._client


def test_a_urdf_matches_its_table(robot: Robot) -> None:
    """The file is what the table writes, Bullet has its positive masses and inertias, and the drawn
    body at rest fills the outline."""
    model, legs = MODELS[robot.name], legs_of(robot)
    assert urdf_path(robot).read_text() == model.urdf()
    assert model.mass_kg == pytest.approx(MASSES_KG[robot.name], abs=0.05)
    client = p.connect(p.DIRECT)
    try:
        body = p.loadURDF(
            str(urdf_path(robot)), flags=p.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
        )
        infos = [p.getJointInfo(body, j, client) for j in range(p.getNumJoints(body, client))]
        names = ["base", *(info[12].decode() for info in infos)]
        dynamics = [p.getDynamicsInfo(body, k - 1, client) for k in range(len(names))]
        middle = p.getBasePositionAndOrientation(body, client)[0]
    finally:
        p.disconnect(client)
    for link in model.links:
        mass, _, inertia, at, turn = dynamics[names.index(link.name)][:5]
        assert mass == pytest.approx(link.mass_kg)
        assert inertia == pytest.approx(model.inertia_kgm2(link), rel=1e-5) and min(inertia) > 0.0
        assert at == pytest.approx(link.middle_m) and turn == (0.0, 0.0, 0.0, 1.0)
    parts, rest = link_parts(urdf_path(robot)), dict(zip(legs.joints, legs.rest_rad, strict=True))
    drawn = [
        part.mesh.vertices @ turn.T + shift
        for link, (turn, shift) in link_tree(urdf_path(robot)).places(rest).items()
        for part in parts[link]
    ]
    low, high = np.concatenate(drawn).min(axis=0), np.concatenate(drawn).max(axis=0)
    assert middle == pytest.approx(dynamics[0][3])
    half = (robot.length_m / 2, robot.width_m / 2)
    assert high == pytest.approx([*half, robot.height_m - legs.stand_m], abs=0.015)
    assert low == pytest.approx([-half[0], -half[1], -legs.stand_m], abs=0.015)


def test_leg_angles_put_the_foot_at_its_target() -> None:
    """Inverse kinematics hold on either side."""
    for side in (1.0, -1.0):
        for x, y, z in ((0.0, 0.0955, -0.25), (0.1, 0.12, -0.3), (-0.12, 0.02, -0.2)):
            hip, thigh, calf = leg_angles(x, side * y, z, side)
            ahead = -SEGMENT_M * (math.sin(thigh) + math.sin(thigh + calf))
            down = -SEGMENT_M * (math.cos(thigh) + math.cos(thigh + calf))
            left = side * THIGH_ASIDE_M * math.cos(hip) - down * math.sin(hip)
            up = side * THIGH_ASIDE_M * math.sin(hip) + down * math.cos(hip)
            assert (ahead, left, up) == pytest.approx((x, side * y, z))


def test_a_robot_walks_straight_turns_and_stops(robot: Robot) -> None:
    """It walks 10 m in time and on the line, turns within 15 % of the yaw rate, also in place, and
    stops within half a metre."""
    v_mps = STRAIGHT_MPS[robot.name]
    with walking(robot, FLAT, START) as walk:
        found = straight(walk, v_mps)
    assert found.time_s <= WITHIN_S[robot.name] and found.aside_m < 0.3 and not found.fallen
    for v in (0.0, v_mps):
        with walking(robot, FLAT, START) as walk:
            walk.drive(Command(v, robot.w_max_radps), 2.0)
            _, w_radps = mean_speeds(walk.drive(Command(v, robot.w_max_radps), 4.0))
        assert w_radps == pytest.approx(robot.w_max_radps, rel=0.15)
    with walking(robot, FLAT, START) as walk:
        _, way_m = stop(walk, v_mps)
    assert way_m < 0.5


def test_the_oracle_plans_with_the_outline_of_the_moving_legs(robot: Robot, walk: Walk) -> None:
    """While walking, turning and stopping, every point of the body is within the disks that the
    oracle checks."""
    tree, parts = link_tree(urdf_path(robot)), link_parts(urdf_path(robot))
    axis = np.array([(x, 0.0) for x in axis_points(robot)])
    v, w = robot.cruise_mps, robot.w_max_radps
    for command in (Command(v, 0.0), Command(0.5 * v, w), Command(0.0, -w), STILL):
        for motion in walk.drive(command, 1.5):
            posture = posture_of(FLAT, robot, motion.robot)
            base = turned(posture.roll_rad, posture.pitch_rad, 0.0)
            for link, (turn, shift) in tree.places(posture.angles_rad).items():
                for part in parts[link]:
                    points = (part.mesh.vertices @ (base @ turn).T + base @ shift)[:, None, :2]
                    off_m = np.hypot(*(points - axis).transpose(2, 0, 1)).min(axis=1)
                    assert off_m.max() < robot.width_m / 2 + 0.05


def test_a_robot_stands_for_a_minute(walk: Walk) -> None:
    """It drifts less than 5 cm and 3 degrees, and its mean speed counts as standing."""
    drift_m, turned_deg = stand(walk, 60.0)
    assert drift_m < 0.05 and turned_deg < 3.0
    assert abs(walk.robot.v_mps) < 0.05 and abs(walk.robot.w_radps) < 0.05


def test_a_robot_follows_random_commands(robot: Robot) -> None:
    """On level ground, ramps of 1:12 and steps of 3 cm it does not fall, with mean errors up to 0.1
    m/s and 0.1 rad/s. `cosim bench legs` takes an hour of it."""
    found = []
    for seed, course in enumerate((FLAT, RAMPS, STEPS)):
        with walking(robot, course, START) as walk:
            found.append(wander(walk, robot, 1.0, seed))
    assert sum(one.fallen for one in found) == 0
    assert np.mean([one.error_mps for one in found]) < 0.1
    assert np.mean([one.error_radps for one in found]) < 0.1


def test_a_robot_walks_down_curbs(robot: Robot) -> None:
    """At 0.5 m/s it does not fall from 12 cm in 20 phases of the gait."""
    assert sum(down_curb(robot, 0.5, 0.6 + 0.011 * k) for k in range(20)) == 0


@pytest.mark.parametrize(("v_mps", "height_m"), [(0.5, 0.12), (1.0, 0.12), (1.0, 0.06)])
def test_a_walk_up_a_curb_ends_in_a_valid_state(
    robot: Robot, v_mps: float, height_m: float
) -> None:
    """The robot climbs, falls or stops, and its base is finite and not below the ground."""
    state, _ = up_curb(robot, v_mps, height_m)
    assert np.isfinite([*state.pose, state.z_m]).all()
    assert -0.1 < state.z_m < height_m + 0.1


def digest(motions: list[Motion]) -> str:
    seen = hashlib.blake2b(digest_size=8)
    for motion in motions:
        assert motion.robot.legs is not None
        seen.update(motion.trace.tobytes())
        seen.update(np.array(motion.robot.legs.angles_rad).tobytes())
    return seen.hexdigest()


def wandered(walk: Walk, ticks: int = 100) -> str:
    """Return the hash of a walk with changing commands."""
    commands = [Command(0.8, 0.3), Command(0.3, -0.6), STILL, Command(1.2, 0.0)]
    return digest([walk.tick(commands[4 * k // ticks]) for k in range(ticks)])


def push(walk: Walk, impulse_ns: float) -> None:
    """Push the trunk to the left within the next substep."""
    body, client = engine_of(walk)
    at, _ = p.getBasePositionAndOrientation(body, client)
    force = (0.0, impulse_ns / 0.005, 0.0)
    p.applyExternalForce(body, -1, force, at, p.WORLD_FRAME, physicsClientId=client)


def test_a_pushed_robot_falls_once_and_restarts_like_a_new_one(robot: Robot, walk: Walk) -> None:
    """After 60 N s it has fallen once; put back, it walks within 2 s, to the bit like a robot that
    starts there."""
    walk.drive(Command(0.5, 0.0), 2.0)
    assert walk.fallen == 0
    push(walk, 60.0)
    for _ in range(60):
        walk.tick(Command(0.5, 0.0))
        if walk.fallen:
            break
    assert walk.fallen == 1 and walk.robot.tilt_rad < 0.02
    pose = walk.robot.pose
    walk.world.place(pose)
    after = wandered(walk)
    walk.world.place(pose)
    assert walk.drive(Command(0.5, 0.0), 2.0)[-1].robot.v_mps > 0.3 and walk.fallen == 1
    with walking(robot, FLAT, pose) as fresh:
        assert wandered(fresh) == after


PROCESS = """
import cosim
from cosim.spec.robot import robot_called
from tests.physics.test_legs import START, FLAT, walking, wandered
with walking(robot_called("{name}"), FLAT, START) as walk:
    print(wandered(walk))
"""


def test_a_walk_has_the_same_hash_in_every_process(robot: Robot, walk: Walk) -> None:
    """Other processes and other kernels of OpenBLAS give the same hash."""
    expected = wandered(walk)
    for kernel in ("Haswell", "Nehalem"):
        done = subprocess.run(
            [sys.executable, "-c", PROCESS.format(name=robot.name)],
            env={**os.environ, "OPENBLAS_CORETYPE": kernel},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.split()[-1] == expected


def test_drawn_legs_touch_the_ground(robot: Robot, walk: Walk) -> None:
    """The lowest drawn point is within 1 cm of the ground, and Bullet's links are where the
    recorded joint angles put them."""
    tree, parts = link_tree(urdf_path(robot)), link_parts(urdf_path(robot))
    body, client = engine_of(walk)
    for command in (STILL, Command(0.8, 0.2), Command(0.8, 0.2)):
        state = walk.drive(command, 1.0)[-1].robot
        posture = posture_of(FLAT, robot, state)
        base = turned(posture.roll_rad, posture.pitch_rad, posture.heading_rad)
        lowest = []
        for link, (turn, shift) in tree.places(posture.angles_rad).items():
            rotation, at = base @ turn, base @ shift + posture.at_m
            lowest += [float((m.mesh.vertices @ rotation.T + at)[:, 2].min()) for m in parts[link]]
        assert min(lowest) == pytest.approx(0.0, abs=0.01)
        for number in range(p.getNumJoints(body, client)):
            link = p.getJointInfo(body, number, client)[12].decode()
            spot = p.getLinkState(body, number, 0, 1, physicsClientId=client)[4]
            _, shift = tree.places(posture.angles_rad)[link]
            assert spot == pytest.approx((base @ shift + posture.at_m).tolist(), abs=1e-4)


def test_a_camera_moves_with_the_trunk(robot: Robot) -> None:
    """A trunk that leans forward by 0.2 rad lowers the camera and tilts its view by as much."""
    legs = legs_of(robot)
    level = RobotState(Pose(0.0, 0.0, 0.3), legs=LegState(0.0, 0.0, legs.rest_rad))
    leant = dataclasses.replace(level, legs=LegState(0.0, 0.2, legs.rest_rad))
    before, after = (robot_shot(FLAT, robot, CameraSpec(), one) for one in (level, leant))
    x, _, z = robot.mounts["front"].at_m
    assert before.eye_m[2] == pytest.approx(z)
    moved = (z - legs.stand_m) * (math.cos(0.2) - 1.0) - x * math.sin(0.2)
    assert after.eye_m[2] - before.eye_m[2] == pytest.approx(moved)
    assert after.steep_rad - before.steep_rad == pytest.approx(0.2)


def test_legs_collide_with_a_low_fence_and_not_with_the_ground(robot: Robot) -> None:
    """Walking has no contacts until a fence of 10 cm, below the trunk."""
    fence = Barrier(
        x_m=-38.0, y_m=0.0, heading_rad=0.0, length_m=4.0, strip="s", end=0, height_m=0.1
    )
    with BulletWorld(FLAT, [fence], robot=robot) as world:
        walk = Walk(world, START)
        before = walk.drive(Command(0.5, 0.0), 2.0)
        assert not any(motion.contacts for motion in before)
        motions = walk.drive(Command(0.5, 0.0), 4.0)
    assert {c.other for motion in motions for c in motion.contacts} == {"barrier:s:0"}


def test_a_body_that_sinks_or_flies_is_an_engine_error(robot: Robot) -> None:
    """The error has the engine's values; a robot that lies or stands is valid."""
    legs = legs_of(robot)
    monitor = LegMonitor(legs, legs.cycle_s, 0.005)
    for z_m, sound in ((0.0, True), (-legs.stand_m, True), (-2.0, False), (5.0, False)):
        state = RobotState(Pose(1.0, 2.0, 0.0), z_m=z_m)
        if sound:
            assert monitor.assess(state, 0.0, touches=False)[1] == (z_m < 0.0)
        else:
            with pytest.raises(EngineError, match=r"at \(1, 2, .*it sinks or flies"):
                monitor.assess(state, 0.0, touches=False)
    with pytest.raises(EngineError, match="nan"):
        monitor.assess(RobotState(Pose(1.0, 2.0, 0.0), z_m=math.nan), 0.0, touches=False)


class NanDrive:
    """A drive whose torques are NaN."""

    reads_joints = True
    cycle_s = 0.2

    def reset(self) -> None:
        pass

    def step(self, command: Command, body: MeasuredBody) -> Motors:
        return Motors([math.nan] * len(body.angles_rad))


def test_a_pose_that_is_nan_is_an_engine_error() -> None:
    """The error is raised before the ground below the robot is looked up."""
    with BulletWorld(StreetSurface(tiny_map(), 0), robot=DOG, drive=NanDrive()) as world:
        world.place(Pose(0.0, 0.0, 0.0))
        with pytest.raises(EngineError, match=r"PyBullet: the robot with legs is at \(nan, nan"):
            world.step(STILL, Street(0), Street(0), 1)


def test_drawing_needs_no_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A world of a walker without weights has a camera, and only placing the robot reports them
    missing."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with BulletWorld(FLAT, robot=ROBOTS["walker"]) as world:
        spec = CameraSpec(width=32, height=24)
        with camera_of("bullet", world, spec) as camera:
            frame = camera.render(RobotState(Pose(0.0, 0.0, 0.0)), Street(0))
        assert frame.rgb.shape == (24, 32, 3)
        with pytest.raises(UsageError, match=r"walker\.npz is missing"):
            world.place(Pose(0.0, 0.0, 0.0))


def test_speeds_are_means_over_a_gait_cycle(walk: Walk) -> None:
    """The speed of a steady walk differs by less than 0.1 m/s from tick to tick, and its mean is
    the distance over time."""
    walk.drive(Command(0.8, 0.0), 3.0)
    motions = walk.drive(Command(0.8, 0.0), 2.0)
    speeds = [motion.robot.v_mps for motion in motions]
    assert max(abs(b - a) for a, b in pairwise(speeds)) < 0.1
    way_m = sum(math.dist(a.robot.pose.xy, b.robot.pose.xy) for a, b in pairwise(motions)) / (
        0.05 * (len(motions) - 1)
    )
    assert np.mean(speeds) == pytest.approx(way_m, abs=0.05)
    assert abs(wrap_angle(motions[-1].robot.pose.heading_rad)) < 0.5


def test_the_bench_uses_the_gait_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each walk has a separate drive with that gait, and the table names it."""
    made: list[Drive | None] = []

    def measure(robot: Robot, minutes: float, progress: Progress, drive: MakeDrive) -> list[str]:
        made.extend([drive(), drive()])
        return []

    monkeypatch.setattr(legs, "measure", measure)
    path = written_gait(tmp_path, cycle_s=0.4)
    bench_legs("dog", 0.1, f"onnx:{path}")
    assert [one.cycle_s for one in made if one] == [0.4, 0.4] and made[0] is not made[1]
    assert "dog, gait tiny.onnx (" in capsys.readouterr().out

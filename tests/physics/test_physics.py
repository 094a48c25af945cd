"""The robot in the engine: driving, ramps, curbs, contacts, determinism, and camera pictures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import pytest

from cosim.core.errors import EngineError, UsageError
from cosim.core.geometry import Pose
from cosim.core.state import (
    LABELS,
    Command,
    Frame,
    Motion,
    People,
    RobotState,
    Signal,
    Street,
    Vehicles,
)
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import ROBOTS, robot_called
from cosim.spec.scenario import Barrier
from physics.cameras.bullet_camera import BulletCamera
from physics.dynamics.bullet import p
from physics.dynamics.world import BulletWorld
from physics.robots import urdf_path
from physics.street.street_surface import StreetSurface
from tests.support.tiny_street import tiny_map

MAP = tiny_map()

EMPTY = Street(0)
OPEN = Pose(-40.0, 100.0, 0.0)
"""A wide flat place far from the street."""


@pytest.fixture
def world() -> Iterator[BulletWorld]:
    with BulletWorld(StreetSurface(MAP, seed=1)) as world:
        yield world


def drive(
    world: BulletWorld, v_mps: float, w_radps: float, ticks: int, street: Street = EMPTY
) -> list[Motion]:
    return [world.step(Command(v_mps, w_radps), street, street, 10) for _ in range(ticks)]


def person(x_m: float, y_m: float, heading_rad: float = 0.0, name: str = "c1") -> Street:
    return Street(0, people=People.of((name,), [[x_m, y_m]], [heading_rad], [0.0], ("stand",)))


@pytest.mark.engine
@pytest.mark.parametrize(
    ("v_mps", "w_radps"),
    [(0.5, 0.0), (1.0, 0.3), (2.5, 0.0), (2.5, 0.65), (0.0, 0.65), (0.0, -0.2), (-0.5, 0.0)],
)
def test_the_robot_reaches_the_commanded_speeds(
    world: BulletWorld, v_mps: float, w_radps: float
) -> None:
    """Mean speed and yaw rate are within 5 % of the command, and the robot stays upright."""
    world.place(OPEN)
    drive(world, v_mps, w_radps, 50)
    robots = [motion.robot for motion in drive(world, v_mps, w_radps, 40)]
    assert np.mean([r.v_mps for r in robots]) == pytest.approx(v_mps, rel=0.05, abs=0.01)
    assert np.mean([r.w_radps for r in robots]) == pytest.approx(w_radps, rel=0.05, abs=0.01)
    assert max(r.tilt_rad for r in robots) < 0.02


@pytest.mark.engine
def test_speed_follows_the_acceleration_limit(world: BulletWorld) -> None:
    """2 m/s take 0.8 s from rest at 2.5 m/s2, and as long to stop."""
    world.place(OPEN)
    speeds = [m.robot.v_mps for m in [*drive(world, 2.0, 0.0, 20), *drive(world, 0.0, 0.0, 20)]]
    assert speeds[7] == pytest.approx(1.0, abs=0.1)
    assert speeds[17] == pytest.approx(2.0, abs=0.1)
    assert speeds[37] == pytest.approx(0.0, abs=0.02)


@pytest.mark.engine
@pytest.mark.parametrize("heading_rad", [math.pi / 2, -math.pi / 2, 0.4])
def test_the_robot_stands_still_on_a_ramp(world: BulletWorld, heading_rad: float) -> None:
    """Ten seconds at zero command move it less than two millimetres on a slope of 1:12."""
    start = world.place(Pose(0.0, 4.2, heading_rad)).pose
    end = drive(world, 0.0, 0.0, 200)[-1].robot.pose
    assert math.dist(start[:2], end[:2]) < 2e-3


@pytest.mark.engine
def test_the_robot_climbs_the_curb_ramp(world: BulletWorld) -> None:
    """From the crossing onto the sidewalk it rises by the height of the curb, without a contact."""
    world.place(Pose(0.0, 1.0, math.pi / 2))
    motions = drive(world, 1.0, 0.0, 100)
    assert motions[-1].robot.z_m == pytest.approx(0.12, abs=0.005)
    assert motions[-1].robot.v_mps == pytest.approx(1.0, abs=0.05)
    assert not any(m.contacts for m in motions)


@pytest.mark.engine
def test_the_robot_does_not_climb_a_curb(world: BulletWorld) -> None:
    """A robot that drives at a full curb stays on the road, and the curb counts as ground."""
    world.place(Pose(-20.0, 1.0, math.pi / 2))
    motions = drive(world, 1.0, 0.0, 100)
    assert motions[-1].robot.z_m < 0.02
    assert motions[-1].robot.pose.y_m < 3.5
    assert not any(m.contacts for m in motions)


@pytest.mark.engine
def test_tile_seams_do_not_shake_the_robot(world: BulletWorld) -> None:
    """Along 30 m of sidewalk across a tile border it drives straight and level."""
    world.place(Pose(-62.0, 5.0, 0.0))
    robots = [m.robot for m in drive(world, 1.5, 0.0, 400)]
    assert max(r.tilt_rad for r in robots) < 0.01
    assert robots[-1].pose.y_m == pytest.approx(5.0, abs=0.05)
    assert robots[-1].pose.x_m == pytest.approx(-62.0 + 1.5 * 20.0, abs=1.0)


@pytest.mark.engine
def test_a_person_blocks_the_robot_and_is_named(world: BulletWorld) -> None:
    """A standing person stops the robot, and contacts name the person once per substep."""
    world.place(Pose(-20.0, 5.0, 0.0))
    motions = drive(world, 1.0, 0.0, 80, person(-18.0, 5.0, name="e7"))
    contacts = [c for m in motions for c in m.contacts]
    assert {(c.kind, c.other) for c in contacts} == {("pedestrian", "e7")}
    assert all(len(set(m.contacts)) == len(m.contacts) for m in motions)
    assert motions[-1].robot.pose.x_m == pytest.approx(-18.0 - 0.3 - 0.35, abs=0.05)


@pytest.mark.engine
def test_a_walking_person_is_met_within_the_tick(world: BulletWorld) -> None:
    """A person who passes over the robot between two snapshots touches it at the substep of the
    overlap."""
    world.place(Pose(-20.0, 5.0, 0.0))
    motion = world.step(Command(0.0, 0.0), person(-19.0, 5.0), person(-21.0, 5.0), 10)
    substeps = [c.substep for c in motion.contacts if c.other == "c1"]
    assert substeps and substeps[0] == 1
    assert 9 not in substeps


@pytest.mark.engine
def test_people_out_of_reach_change_nothing() -> None:
    """With people and a vehicle some two metres from its path the robot moves to the bit as in an
    empty street."""
    crowd = People.of(
        ("c1", "c2"), [[-18.0, 7.2], [-16.0, 2.8]], [0.0, 1.0], [0.0, 0.0], ("stand", "stand")
    )
    cars = Vehicles.of(("v1",), [[-17.0, -1.0]], [0.0], [0.0], [[4.5, 1.8]])
    traces = []
    for street in (EMPTY, Street(0, people=crowd, vehicles=cars)):
        with BulletWorld(StreetSurface(MAP, seed=1)) as world:
            world.place(Pose(-20.0, 5.0, 0.0))
            traces.append(
                b"".join(motion.trace.tobytes() for motion in drive(world, 1.0, 0.1, 60, street))
            )
    assert traces[0] == traces[1]


@pytest.mark.engine
def test_a_robot_that_is_thrown_touches_a_distant_person(world: BulletWorld) -> None:
    """A person who was out of reach when the tick began stops the robot within the tick, and is
    named."""
    world.place(Pose(-20.0, 5.0, 0.0))
    drive(world, 0.0, 0.0, 5)
    p.resetBaseVelocity(
        world._engine._robot, (40.0, 0.0, 0.0), (0.0, 0.0, 0.0), world._engine._client
    )
    motion = world.step(Command(0.0, 0.0), person(-18.3, 5.0), person(-18.3, 5.0), 10)
    assert {(c.kind, c.other) for c in motion.contacts} == {("pedestrian", "c1")}
    assert motion.robot.v_mps < 10.0


@pytest.mark.engine
def test_a_vehicle_is_named(world: BulletWorld) -> None:
    """Driving into a standing vehicle is a contact with its id."""
    world.place(Pose(-20.0, -1.75, 0.0))
    vehicles = Vehicles.of(("v3",), [[-16.0, -1.75]], [0.0], [0.0], [[4.5, 1.8]])
    motions = drive(world, 1.0, 0.0, 60, Street(0, vehicles=vehicles))
    assert {(c.kind, c.other) for m in motions for c in m.contacts} == {("vehicle", "v3")}


@pytest.mark.engine
def test_a_barrier_is_an_object() -> None:
    """A fence across the sidewalk stops the robot and is named by the port it closes."""
    fence = Barrier(x_m=-17.0, y_m=5.0, heading_rad=0.0, length_m=3.0, strip="nw", end=1)
    with BulletWorld(StreetSurface(MAP, seed=1), [fence]) as world:
        world.place(Pose(-20.0, 5.0, 0.0))
        motions = drive(world, 1.0, 0.0, 80)
    assert {(c.kind, c.other) for m in motions for c in m.contacts} == {("object", "barrier:nw:1")}
    assert motions[-1].robot.pose.x_m < -17.0 - 0.06 - 0.34


@pytest.mark.engine
def test_a_building_is_a_wall(world: BulletWorld) -> None:
    """Driving at the frontage ends at a building of the strip."""
    world.place(Pose(-30.0, 5.5, math.pi / 2))
    contacts = [c for m in drive(world, 1.0, 0.0, 120) for c in m.contacts]
    assert contacts
    assert all(c.kind == "wall" and c.other.startswith("building:nw:") for c in contacts)


@pytest.mark.engine
def test_the_same_commands_give_the_same_trace() -> None:
    """Two new worlds agree bit for bit, with a turn, a ramp and a person in the way."""

    def traces() -> list[bytes]:
        with BulletWorld(StreetSurface(MAP, seed=3)) as world:
            world.place(Pose(0.0, -1.0, math.pi / 2))
            motions = [*drive(world, 1.2, 0.1, 80), *drive(world, 1.0, -0.5, 80, person(1.0, 6.0))]
            return [m.trace.tobytes() for m in motions]

    assert traces() == traces()


@pytest.mark.engine
def test_a_world_outside_its_with_block_is_refused() -> None:
    """Before and after the block the message names the remedy, and closing twice is allowed."""
    world = BulletWorld(StreetSurface(MAP, seed=1))
    with pytest.raises(EngineError, match="'with' block"):
        world.place(OPEN)
    with world:
        world.place(OPEN)
    world.close()
    with pytest.raises(EngineError, match="'with' block"):
        world.step(Command(0.0, 0.0), EMPTY, EMPTY, 10)


def test_an_unknown_robot_is_refused_with_the_known_ones() -> None:
    """A wrong name is a usage error with the choices."""
    with pytest.raises(UsageError, match="Valid choices: courier"):
        robot_called("rover")
    assert all(urdf_path(robot).is_file() for robot in ROBOTS.values())


SPEC = CameraSpec(width=96, height=96)


def label_pixels(frame: Frame, name: str) -> np.ndarray:
    """Return rows and columns of the pixels with a label, (N, 2)."""
    assert frame.labels is not None
    return np.argwhere(frame.labels == LABELS[name])


@pytest.mark.engine
def test_the_camera_sees_the_street() -> None:
    """From the sidewalk, sky is above, sidewalk below, and a person ahead in the middle with the
    feet on the ground."""
    world = BulletWorld(StreetSurface(MAP, seed=1))
    with BulletCamera(world, SPEC, depth=True) as camera:
        robot = RobotState(Pose(-20.0, 5.0, 0.0), z_m=0.12)
        frame = camera.render(robot, person(-15.0, 5.0, math.pi))
    assert frame.rgb.shape == (96, 96, 3) and frame.rgb.dtype == np.uint8
    assert frame.labels is not None and frame.depth is not None
    assert (frame.labels[:3, 46:60] == LABELS["sky"]).all()
    assert (frame.labels[-3:, 20:76] == LABELS["sidewalk"]).all()
    rows, columns = label_pixels(frame, "person").T
    assert abs(columns.mean() - 47.5) < 2.0
    assert frame.depth[rows, columns].mean() == pytest.approx(
        4.7 * math.cos(math.radians(10.0)), abs=0.3
    )
    down = math.atan(0.62 / 4.7) - math.radians(10.0)
    assert rows.max() == pytest.approx(
        47.5 + 48.0 * math.tan(down) / math.tan(math.radians(37.5)), abs=2.0
    )


@pytest.mark.engine
def test_a_moved_person_is_drawn_where_the_snapshot_says() -> None:
    """A person to the left is left in the picture, one to the right is right, and one behind is not
    in it."""
    with BulletCamera(BulletWorld(StreetSurface(MAP, seed=1)), SPEC) as camera:
        robot = RobotState(Pose(-20.0, 5.0, 0.0), z_m=0.12)
        assert label_pixels(camera.render(robot, person(-15.0, 6.0)), "person")[:, 1].mean() < 40.0
        assert label_pixels(camera.render(robot, person(-15.0, 4.0)), "person")[:, 1].mean() > 56.0
        assert len(label_pixels(camera.render(robot, person(-25.0, 5.0)), "person")) == 0


@pytest.mark.engine
def test_a_picture_depends_only_on_the_current_state() -> None:
    """The same state gives the same picture, whatever was drawn before and in any camera."""
    robot = RobotState(Pose(-4.0, 5.0, 0.3), z_m=0.12)
    street = person(-1.0, 5.5, math.pi)
    with BulletCamera(BulletWorld(StreetSurface(MAP, seed=1)), SPEC) as camera:
        first = camera.render(robot, street)
        camera.render(RobotState(Pose(60.0, -6.0, 1.0), z_m=0.12), person(62.0, -6.0))
        camera.picture((0.0, 0.0, 5.0), (5.0, 5.0, 0.0), street, robot, size=(64, 48))
        again = camera.render(robot, street)
    with BulletCamera(BulletWorld(StreetSurface(MAP, seed=1)), SPEC) as other:
        fresh = other.render(robot, street)
    for frame in (again, fresh):
        assert np.array_equal(frame.rgb, first.rgb)
        assert np.array_equal(frame.labels, first.labels)


@pytest.mark.engine
def test_everything_has_its_label() -> None:
    """One view over the street has every label but props, and the lamp is red or green as the
    signal says."""
    strips = {
        k: dataclasses.replace(s, signalised=s.kind == "crossing") for k, s in MAP.strips.items()
    }
    street_map = dataclasses.replace(MAP, strips=strips)
    fence = Barrier(x_m=4.0, y_m=5.0, heading_rad=0.0, length_m=3.0, strip="ne", end=0)
    vehicles = Vehicles.of(("v1",), [[-6.0, 1.75]], [math.pi], [5.0], [[4.5, 1.8]])
    people = person(-8.0, 5.0).people
    robot = RobotState(Pose(-10.0, 5.0, 0.0), z_m=0.12)
    lit = {}
    with BulletCamera(BulletWorld(StreetSurface(street_map, seed=1), [fence]), SPEC) as camera:
        for walk in (True, False):
            street = Street(0, people, vehicles, {":c0": Signal(walk)})
            frame = camera.picture(
                (-16.0, 1.0, 5.0), (0.0, 1.0, 0.0), street, robot, size=(320, 240)
            )
            assert frame.labels is not None
            assert {LABELS[n] for n in LABELS if n != "prop"} <= set(
                np.unique(frame.labels).tolist()
            )
            lamp = frame.rgb[frame.labels == LABELS["signal"]].astype(int)
            lit[walk] = (lamp[:, 1] - lamp[:, 0]).max() > 60, (lamp[:, 0] - lamp[:, 1]).max() > 60
    assert lit == {True: (True, False), False: (False, True)}


@pytest.mark.engine
def test_the_camera_leans_with_the_ramp() -> None:
    """Facing up a ramp a person's head is lower in the picture by the slope's angle."""
    heads = []
    with BulletCamera(BulletWorld(StreetSurface(MAP, seed=1)), SPEC) as camera:
        for y, z in ((-1.0, 0.0), (4.22, 0.06)):
            robot = RobotState(Pose(0.0, y, math.pi / 2), z_m=z)
            heads.append(
                label_pixels(camera.render(robot, person(0.0, y + 6.0)), "person")[:, 0].min()
            )
    assert heads[1] - heads[0] == pytest.approx(
        48.0 * math.tan(1.0 / 12.0) / math.tan(math.radians(37.5)), abs=2.0
    )


@pytest.mark.engine
def test_a_camera_outside_its_with_block_is_refused() -> None:
    """The message names the remedy, and closing twice is allowed."""
    camera = BulletCamera(BulletWorld(StreetSurface(MAP, seed=1)), SPEC)
    with pytest.raises(EngineError, match="'with' block"):
        camera.render(RobotState(OPEN), EMPTY)
    with camera:
        pass
    camera.close()

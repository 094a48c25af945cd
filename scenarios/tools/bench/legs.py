"""Measures how a robot with legs walks: speeds, standing, curbs, pushes and random commands."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cosim.core.clock import Clock
from cosim.core.geometry import Floats, Pose, wrap_angle
from cosim.core.progress import Progress
from cosim.core.state import STILL, Command, Motion, RobotState, Street
from cosim.core.units import duration
from cosim.results.referee import FALL_S
from cosim.spec.robot import COURIER, Robot
from physics.dynamics.drive import Drive
from physics.dynamics.world import BulletWorld
from physics.ground.mesh import Mesh
from physics.ground.tiles import CURB_M, Key, tile_bounds
from physics.street.surface import Chunk, Patch, Surface

COMMAND_S: Final = 2.0
"""Duration of a random command, seconds."""
_CLOCK: Final = Clock()
_TIMED_S: Final = 20.0
"""Simulated seconds of the measured CPU time."""
_EMPTY: Final = Street(0)
_FRICTION: Final = 0.9
_COLOUR: Final = (0.6, 0.6, 0.6)


class Course(Surface):
    """Ground whose height depends on x alone.

    profile: (x, z) of the corners of one period in metres, in order of x. Two corners at one x are
        a step. The last corner is the first of the next period.
    """

    def __init__(self, profile: Sequence[tuple[float, float]]) -> None:
        self._profile = profile
        self._period_m = profile[-1][0] - profile[0][0]

    def heights(self, xy: ArrayLike) -> Floats:
        """Return the (N,) heights at (N, 2) points; above a step its upper side."""
        x = np.asarray(xy, dtype=float).reshape(-1, 2)[:, 0]
        x0 = self._profile[0][0]
        x = (x - x0) % self._period_m + x0
        height = np.full(len(x), -np.inf)
        for (x0, z0), (x1, z1) in pairwise(self._profile):
            here = (x0 <= x) & (x <= x1)
            share = (x - x0) / (x1 - x0) if x1 > x0 else np.zeros(len(x))
            slope = z0 + share * (z1 - z0) if x1 > x0 else np.full(len(x), max(z0, z1))
            height = np.where(here, np.maximum(height, slope), height)
        return height

    def chunk(self, key: Key) -> Chunk:
        """Return the strips of ground of a tile."""
        left, low, right, high = tile_bounds(key)
        begin = self._profile[0][0]
        corners: list[tuple[float, float]] = []
        first = math.floor((left - begin) / self._period_m)
        last = math.floor((right - begin) / self._period_m)
        for number in range(first, last + 1):
            shift = number * self._period_m
            corners += [(x + shift, z) for x, z in self._profile]
        quads = []
        for (x0, z0), (x1, z1) in pairwise(corners):
            a, b = max(x0, left), min(x1, right)
            if a > b or (x0, z0) == (x1, z1):
                continue
            if x1 > x0:
                z0, z1 = (z0 + (x - x0) / (x1 - x0) * (z1 - z0) for x in (a, b))
                if a == b:
                    continue
            quads.append([(a, low, z0), (b, low, z1), (b, high, z1), (a, high, z0)])
        vertices = np.array(quads, dtype=float).reshape(-1, 3)
        triangles = np.concatenate(
            [np.array([[0, 1, 2], [0, 2, 3]], np.int32) + 4 * k for k in range(len(quads))]
        ).astype(np.int32)
        normals = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
        mesh = Mesh(vertices, normals, triangles)
        return Chunk((Patch("ground", mesh, _FRICTION, "ground", _COLOUR, "asphalt"),))


FLAT: Final = Course([(0.0, 0.0), (96.0, 0.0)])
"""Level ground."""
RAMPS: Final = Course([(0.0, 0.0), (2.0, 0.0), (3.44, 0.12), (6.0, 0.12), (7.44, 0.0), (9.6, 0.0)])
"""Ramps of 1:12 to the height of a curb."""
STEPS: Final = Course([(0.0, 0.0), (1.5, 0.0), (1.5, 0.03), (3.0, 0.03), (3.0, 0.0)])
"""Steps of 3 cm."""
CURB: Final = Course([(-48.0, CURB_M), (0.0, CURB_M), (0.0, 0.0), (48.0, 0.0), (48.0, CURB_M)])
"""A curb at x = 0: down in the direction of x, up against it."""


class Walk:
    """A robot on a course, driven by commands.

    fallen: number of falls so far
    robot: its last state
    """

    def __init__(self, world: BulletWorld, pose: Pose) -> None:
        self.world = world
        self._down_ticks = 0
        self.fallen = 0
        self.robot = world.place(pose)

    def drive(self, command: Command, seconds: float) -> list[Motion]:
        """Drive for some time; return the motion of each tick."""
        return [self.tick(command) for _ in range(_CLOCK.ticks(seconds))]

    def tick(self, command: Command) -> Motion:
        """Run one tick. A fallen robot is put back standing at its place."""
        motion = self.world.step(command, _EMPTY, _EMPTY, _CLOCK.substeps)
        self.robot = motion.robot
        self._down_ticks = self._down_ticks + 1 if motion.down else 0
        if self._down_ticks > _CLOCK.ticks(FALL_S):
            self.fallen += 1
            self._down_ticks = 0
            self.robot = self.world.place(motion.robot.pose)
        return motion

    def along(self, v_mps: float, heading_rad: float, most_radps: float = 0.65) -> Motion:
        """Run one tick of a loop that holds the line y = 0 of a heading."""
        error = wrap_angle(heading_rad - self.robot.pose.heading_rad)
        aside = -math.sin(heading_rad) * self.robot.pose.x_m
        aside += math.cos(heading_rad) * self.robot.pose.y_m
        w = min(max(2.0 * error - 1.5 * aside, -most_radps), most_radps)
        return self.tick(Command(v_mps, w))


@contextmanager
def walking(robot: Robot, course: Course, pose: Pose, drive: Drive | None = None) -> Iterator[Walk]:
    """Provide a robot on a course."""
    with BulletWorld(course, robot=robot, drive=drive) as world:
        yield Walk(world, pose)


class Straight(NamedTuple):
    """A straight of 10 m: time, largest distance from the line, falls."""

    time_s: float
    aside_m: float
    fallen: int


def straight(walk: Walk, v_mps: float, way_m: float = 10.0) -> Straight:
    """Walk straight ahead from the walk's pose, along y = 0, for at most a minute."""
    begin_m, aside_m, ticks = walk.robot.pose.x_m, 0.0, 0
    walk.drive(STILL, 0.5)
    while walk.robot.pose.x_m - begin_m < way_m and ticks < _CLOCK.ticks(60.0):
        walk.along(v_mps, 0.0)
        aside_m = max(aside_m, abs(walk.robot.pose.y_m))
        ticks += 1
    return Straight(_CLOCK.time_s(ticks), aside_m, walk.fallen)


def mean_speeds(motions: Sequence[Motion]) -> tuple[float, float]:
    """Return the mean speed and yaw rate."""
    robots = [motion.robot for motion in motions]
    return (
        sum(robot.v_mps for robot in robots) / len(robots),
        sum(robot.w_radps for robot in robots) / len(robots),
    )


def stop(walk: Walk, v_mps: float) -> tuple[float, float]:
    """Return time and way of a stop from a speed, until the mean speed is below 0.05 m/s."""
    walk.drive(STILL, 0.5)
    walk.drive(Command(v_mps, 0.0), 4.0)
    begin = walk.robot.pose
    ticks = 0
    while ticks < _CLOCK.ticks(5.0) and (ticks == 0 or abs(walk.robot.v_mps) >= 0.05):
        walk.tick(STILL)
        ticks += 1
    return _CLOCK.time_s(ticks), math.dist(begin.xy, walk.robot.pose.xy)


def stand(walk: Walk, seconds: float) -> tuple[float, float]:
    """Return the drift in metres and in degrees of standing."""
    walk.drive(STILL, 1.0)
    begin = walk.robot.pose
    walk.drive(STILL, seconds)
    end = walk.robot.pose
    turned = abs(wrap_angle(end.heading_rad - begin.heading_rad))
    return math.dist(begin.xy, end.xy), math.degrees(turned)


class RandomMotion(NamedTuple):
    """Motion by random commands.

    commands, fallen: number of commands, and of falls.
    error_mps, error_radps: mean errors of the mean speeds over the second half of each command.
    sway_mps, sway_radps: mean standard deviations of the speeds, means of a gait cycle, there.
    jitter_deg: standard deviation of the trunk's pitch.
    """

    commands: int
    fallen: int
    error_mps: float
    error_radps: float
    sway_mps: float
    sway_radps: float
    jitter_deg: float


def wander(walk: Walk, robot: Robot, minutes: float, seed: int) -> RandomMotion:
    """Follow random commands of COMMAND_S each.

    A tenth are to stand.
    """
    draws = np.random.default_rng(seed)
    count = round(60.0 * minutes / COMMAND_S)
    errors, pitches = [], []
    for _ in range(count):
        v, w, rests = draws.random(3).tolist()
        command = Command(v * robot.v_max_mps, (2.0 * w - 1.0) * robot.w_max_radps)
        command = STILL if rests < 0.1 else command
        motions = walk.drive(command, COMMAND_S)
        half = motions[len(motions) // 2 :]
        speeds = np.array([(m.robot.v_mps, m.robot.w_radps) for m in half])
        error = np.abs(speeds.mean(axis=0) - (command.v_mps, command.w_radps))
        errors.append([*error.tolist(), *speeds.std(axis=0).tolist()])
        pitches += [m.robot.legs.pitch_rad for m in motions if m.robot.legs is not None]
    v, w, v_sway, w_sway = np.array(errors).mean(axis=0).tolist()
    jitter_deg = math.degrees(float(np.std(pitches))) if pitches else 0.0
    return RandomMotion(count, walk.fallen, v, w, v_sway, w_sway, jitter_deg)


def down_curb(robot: Robot, v_mps: float, start_m: float, drive: Drive | None = None) -> int:
    """Return the falls of a walk down a curb.

    start_m: distance of the start from the curb, which sets the phase of the gait
    """
    with walking(robot, CURB, Pose(-start_m, 0.0, 0.0), drive) as walk:
        walk.drive(STILL, 0.5)
        for _ in range(_CLOCK.ticks((start_m + 1.5) / v_mps)):
            walk.along(v_mps, 0.0)
        return walk.fallen


def up_curb(
    robot: Robot, v_mps: float, height_m: float, drive: Drive | None = None
) -> tuple[RobotState, int]:
    """Return the last state of a walk against a step, and its falls."""
    course = Course([(-48.0, 0.0), (0.0, 0.0), (0.0, height_m), (48.0, height_m), (48.0, 0.0)])
    with walking(robot, course, Pose(-1.0, 0.0, 0.0), drive) as walk:
        walk.drive(STILL, 0.5)
        for _ in range(_CLOCK.ticks(2.5 / v_mps)):
            walk.along(v_mps, 0.0)
        return walk.robot, walk.fallen


class LegFigure(NamedTuple):
    """Measured figure of a robot with legs, and what it should be."""

    name: str
    value: str
    target: str = ""


MakeDrive = Callable[[], Drive | None]
"""Maker of the drive of a walk; None is the robot's own."""


def own_drive() -> None:
    """Choose the robot's own drive."""


CURB_PHASES: Final = 20
"""Phases of the gait in which a curb is walked down."""


def measure(
    robot: Robot, minutes: float, progress: Progress, drive: MakeDrive = own_drive
) -> list[LegFigure]:
    """Measure a robot with legs.

    minutes: simulated time of random commands in all, a third of it on each ground
    drive: makes the drive of each walk
    """
    start = Pose(-40.0, 0.0, 0.0)
    v_mps = 5 / 6 * robot.cruise_mps
    rows = []
    with walking(robot, FLAT, start, drive()) as walk:
        found = straight(walk, v_mps)
    rows.append(
        LegFigure(
            f"10 m at {v_mps:.2g} m/s",
            f"{found.time_s:.1f} s, {found.aside_m:.2f} m off the line, {found.fallen} falls",
            "off by less than 0.3 m, no fall",
        )
    )
    rows += [_steady(robot, start, v, 0.0, "", drive()) for v in (0.5, v_mps, robot.v_max_mps)]
    rows += [
        _steady(robot, start, v, robot.w_max_radps, "yaw rate within 15 %", drive())
        for v in (v_mps, 0.0)
    ]
    with walking(robot, FLAT, start, drive()) as walk:
        stop_s, way_m = stop(walk, v_mps)
    rows.append(LegFigure("stop", f"{stop_s:.2f} s, {way_m:.2f} m", "0.5 m"))
    with walking(robot, FLAT, start, drive()) as walk:
        drift_m, turned_deg = stand(walk, 60.0)
    drift = f"{100 * drift_m:.1f} cm, {turned_deg:.1f} deg"
    rows.append(LegFigure("standing for 60 s", drift, "5 cm, 3 deg"))
    rows += _curbs(robot, v_mps, drive)
    for number, (name, course) in enumerate(
        (("level ground", FLAT), ("ramps of 1:12", RAMPS), ("steps of 3 cm", STEPS))
    ):
        progress(f"random commands on {name}", number / 3)
        with walking(robot, course, start, drive()) as walk:
            wandered = wander(walk, robot, minutes / 3, number)
        rows.append(
            LegFigure(
                f"{duration(20.0 * minutes)} of random commands, {name}",
                f"{wandered.fallen} falls; errors {wandered.error_mps:.3f} m/s, "
                f"{wandered.error_radps:.3f} rad/s; sway {wandered.sway_mps:.3f} m/s, "
                f"{wandered.sway_radps:.3f} rad/s; pitch {wandered.jitter_deg:.1f} deg",
                "1 fall in an hour; 0.1 m/s, 0.1 rad/s",
            )
        )
    own, courier = cpu_ms_per_s(robot, drive()), cpu_ms_per_s(COURIER)
    rows.append(
        LegFigure(
            "physics, CPU ms per simulated s",
            f"{own:.1f}; courier {courier:.1f}",
            "1.3 x the courier's in `cosim bench`",
        )
    )
    return rows


def _steady(
    robot: Robot, start: Pose, v_mps: float, w_radps: float, target: str, drive: Drive | None
) -> LegFigure:
    """Measure the mean speeds of a steady command."""
    command = Command(v_mps, w_radps)
    with walking(robot, FLAT, start, drive) as walk:
        walk.drive(command, 3.0)
        v, w = mean_speeds(walk.drive(command, 4.0))
    commanded = f"{v_mps:.2g} m/s, {w_radps:.2g} rad/s commanded"
    return LegFigure(commanded, f"{v:.2f} m/s, {w:.2f} rad/s", target)


def _curbs(robot: Robot, v_mps: float, drive: MakeDrive) -> Iterator[LegFigure]:
    """Measure walks down and up curbs."""
    for v in (0.5, v_mps):
        falls = sum(down_curb(robot, v, 0.6 + 0.011 * k, drive()) for k in range(CURB_PHASES))
        target = "no fall" if v == 0.5 else ""
        name = f"down {100 * CURB_M:.0f} cm at {v:.2g} m/s, {CURB_PHASES} phases"
        yield LegFigure(name, f"{falls} falls", target)
        for height_m in (0.03, 0.06, CURB_M):
            state, fallen = up_curb(robot, v, height_m, drive())
            over = state.pose.x_m > 0.3
            said = "falls" if fallen else "climbs" if over else "does not climb"
            yield LegFigure(f"up {100 * height_m:.0f} cm at {v:.2g} m/s", said)


def cpu_ms_per_s(robot: Robot, drive: Drive | None = None) -> float:
    """Return the CPU time in ms of a simulated second of walking or driving at its pace."""
    with walking(robot, FLAT, Pose(-40.0, 0.0, 0.0), drive) as walk:
        walk.drive(Command(robot.cruise_mps, 0.2), 1.0)
        began_s = time.process_time()
        walk.drive(Command(robot.cruise_mps, 0.2), _TIMED_S)
        return 1000.0 * (time.process_time() - began_s) / _TIMED_S

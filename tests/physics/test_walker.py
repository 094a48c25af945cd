"""The humanoid between walking and standing: it stops, balances on its ankles, and walks again."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import STILL, Command
from cosim.spec.robot import WALKER
from physics.dynamics.bullet import p
from physics.dynamics.legs.leg_drive import LegDrive
from physics.dynamics.legs.network_gait import NetworkGait
from scenarios.tools.bench.legs import FLAT, STEPS, Course, Walk, stand, walking

pytestmark = [pytest.mark.engine, pytest.mark.usefixtures("walker_weights")]

START = Pose(-40.0, 0.0, 0.0)


@pytest.fixture
def walk(walker_weights: object) -> Iterator[Walk]:
    with walking(WALKER, FLAT, START) as walk:
        yield walk


def is_standing(walk: Walk) -> bool:
    """Return whether it balances on frozen joints."""
    drive = walk.world._drive
    assert isinstance(drive, LegDrive) and isinstance(drive._gait, NetworkGait)
    return drive._gait._stands


def test_the_walker_stops_stands_and_walks_again(walk: Walk) -> None:
    """After a dozen random walks it stands within 3 s of the stop, hardly moves, and does not
    fall."""
    rng = np.random.default_rng(1)
    for _ in range(12):
        v, w, seconds = rng.uniform((0.0, -0.65, 0.5), (1.2, 0.65, 2.5)).tolist()
        walk.drive(Command(v, w), seconds)
        ticks = next(k for k in range(60) if not walk.tick(STILL) or is_standing(walk))
        assert ticks < 59
        walk.drive(STILL, 2.0)
        assert abs(walk.robot.v_mps) < 0.05 and is_standing(walk)
    assert walk.fallen == 0


def test_the_walker_holds_its_place_after_a_walk(walk: Walk) -> None:
    """It drifts less than 5 cm and 3 degrees in half a minute."""
    walk.drive(Command(0.8, 0.3), 3.0)
    walk.drive(STILL, 2.0)
    drift_m, turned_deg = stand(walk, 30.0)
    assert drift_m < 0.05 and turned_deg < 3.0 and is_standing(walk)


def test_a_pushed_walker_steps_and_stands_again(walk: Walk) -> None:
    """After 15 N s from any side it does not fall, and 4 s later it stands again."""
    for heading in (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi):
        walk.world.place(START)
        walk.drive(STILL, 1.0)
        engine = walk.world._engine
        at, _ = p.getBasePositionAndOrientation(engine._robot, engine._client)
        force = [15.0 / 0.005 * side for side in (math.cos(heading), math.sin(heading))]
        p.applyExternalForce(
            engine._robot, -1, [*force, 0.0], at, p.WORLD_FRAME, physicsClientId=engine._client
        )
        walk.tick(STILL)
        walk.drive(STILL, 4.0)
        assert walk.fallen == 0 and abs(walk.robot.v_mps) < 0.1


SLOPE = Course([(-48.0, 0.0), (0.0, 4.0), (48.0, 0.0)])
"""A slope of 1:12 along x."""


@pytest.mark.parametrize(
    ("course", "heading_deg", "seconds"),
    [
        (STEPS, 60.0, 1.55),
        (SLOPE, 45.0, 1.55),
        (SLOPE, 90.0, 1.55),
        (SLOPE, 135.0, 1.5),
        (SLOPE, -90.0, 1.5),
    ],
)
def test_the_walker_holds_its_place_on_uneven_ground(
    course: Course, heading_deg: float, seconds: float
) -> None:
    """Next to an edge of 3 cm and across a slope of 1:12 it drifts less than 5 cm and 3 degrees in a
    minute. The walks before end in different phases."""
    with walking(WALKER, course, Pose(-40.0, 0.0, math.radians(heading_deg))) as walk:
        walk.drive(Command(0.5, 0.0), seconds)
        walk.drive(STILL, 2.0)
        drift_m, turned_deg = stand(walk, 60.0)
        assert drift_m < 0.05 and turned_deg < 3.0 and walk.fallen == 0


def test_marking_time_on_a_slope_does_not_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    """Across a slope, without standing, it drifts less than 5 cm in 20 s."""
    monkeypatch.setattr(NetworkGait, "_on_both_feet", lambda gait: False)
    with walking(WALKER, SLOPE, Pose(-40.0, 0.0, 0.5 * math.pi)) as walk:
        walk.drive(Command(0.5, 0.0), 1.55)
        walk.drive(STILL, 2.0)
        drift_m, _ = stand(walk, 20.0)
        assert drift_m < 0.05 and walk.fallen == 0 and not is_standing(walk)


def test_a_displaced_walker_stays_at_its_new_place() -> None:
    """Moved 1 m aside while it marks time on a slope, it does not walk back: it drifts by less than
    0.4 m."""
    with walking(WALKER, SLOPE, Pose(-40.0, 0.0, 0.5 * math.pi)) as walk:
        walk.drive(Command(0.5, 0.0), 1.5)
        walk.drive(STILL, 1.0)
        assert not is_standing(walk)
        engine = walk.world._engine
        (x, y, z), turn = p.getBasePositionAndOrientation(engine._robot, engine._client)
        velocity, spin = p.getBaseVelocity(engine._robot, engine._client)
        p.resetBasePositionAndOrientation(engine._robot, (x, y + 1.0, z), turn, engine._client)
        p.resetBaseVelocity(engine._robot, velocity, spin, engine._client)
        carried = walk.tick(STILL).robot.pose
        motions = walk.drive(STILL, 3.0)
        assert max(math.dist(carried.xy, m.robot.pose.xy) for m in motions) < 0.4
        assert max(abs(m.robot.v_mps) for m in motions[20:]) < 0.3 and walk.fallen == 0

"""Feet of robots with legs on the triangles of a street: none of several hundred falls through."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from cosim.spec.robot import ROBOTS, WALKER, Legs, Robot
from physics.dynamics.bodies import Bodies
from physics.dynamics.bullet import p
from physics.ground.tiles import CURB_M, tile_at
from physics.robots.make_urdf import MODELS
from physics.robots.model import Solid
from physics.street.street_surface import StreetSurface
from tests.support.tiny_street import tiny_map

pytestmark = pytest.mark.engine

MIDDLE_M = (-20.0, 5.0)
"""Middle of the part of the northern sidewalk onto which feet are dropped."""
SUBSTEP_S = 0.005
MASS_KG = 3.0
DOWN_N = 150.0
"""Load of a foot that has landed, besides its weight."""
THIN_SOLE = Solid("box", (0.17, 0.06, 0.025), touches=True)
"""A sole that is as thick as the visible one."""


def foot_of(robot: Robot) -> Solid:
    """Return the one shape by which the feet of a robot touch the ground."""
    assert isinstance(robot.drive, Legs)
    links = [link for link in MODELS[robot.name].links if link.name in robot.drive.feet]
    shapes = {s for link in links for s in link.solids if s.touches}
    (shape,) = {s._replace(at_m=(0.0, 0.0, 0.0)) for s in shapes}
    return shape


@contextmanager
def sidewalk_client() -> Iterator[int]:
    """Yield a client with a tile of a street, and its robot far above."""
    bodies = Bodies(WALKER, SUBSTEP_S)
    bodies.add_chunk(StreetSurface(tiny_map(), seed=1).chunk(tile_at(*MIDDLE_M)))
    p.resetBasePositionAndOrientation(bodies._robot, (0, 0, 50), (0, 0, 0, 1), bodies._client)
    try:
        yield bodies._client
    finally:
        bodies.close()


def count_sunk(shape: Solid, count: int = 400, at_once: int = 50) -> int:
    """Return how many of `count` feet end with their middle below the sidewalk, which they hit at
    1.2 m/s, tilted by up to 0.3 rad."""
    rng, below = np.random.default_rng(1), 0
    with sidewalk_client() as client:
        if shape.shape == "box":
            options = {"shapeType": p.GEOM_BOX, "halfExtents": [0.5 * c for c in shape.size_m]}
        else:
            options = {"shapeType": p.GEOM_SPHERE, "radius": 0.5 * shape.size_m[0]}
        made = p.createCollisionShape(physicsClientId=client, **options)
        for _ in range(count // at_once):
            feet: list[int] = []
            for _ in range(at_once):
                feet.append(drop_foot(made, shape.size_m[-1], rng, client))
                for other in feet[:-1]:
                    p.setCollisionFilterPair(feet[-1], other, -1, -1, 0, physicsClientId=client)
            for substep in range(100):
                for foot in feet if substep > 20 else ():
                    at, _ = p.getBasePositionAndOrientation(foot, client)
                    force = (0.0, 0.0, -DOWN_N)
                    p.applyExternalForce(foot, -1, force, at, p.WORLD_FRAME, client)
                p.stepSimulation(client)
            for foot in feet:
                below += p.getBasePositionAndOrientation(foot, client)[0][2] < CURB_M
                p.removeBody(foot, client)
    return below


def drop_foot(shape: int, height_m: float, rng: np.random.Generator, client: int) -> int:
    """Make a foot that falls just above the sidewalk, and return its body."""
    x, y = MIDDLE_M + rng.uniform((-8.0, -1.3), (8.0, 1.3))
    roll, pitch, yaw = rng.uniform((-0.3, -0.3, -np.pi), (0.3, 0.3, np.pi))
    z = CURB_M + 0.5 * height_m + 0.04
    turn = p.getQuaternionFromEuler((roll, pitch, yaw))
    foot: int = p.createMultiBody(MASS_KG, shape, -1, (x, y, z), turn, physicsClientId=client)
    p.changeDynamics(
        foot,
        -1,
        linearDamping=0.0,
        angularDamping=0.0,
        lateralFriction=1.0,
        physicsClientId=client,
    )
    aside = rng.uniform(-0.3, 0.3, 2)
    p.resetBaseVelocity(foot, (*aside, -1.2), (0.0, 0.0, 0.0), physicsClientId=client)
    return foot


@pytest.mark.parametrize(
    "robot", [r for r in ROBOTS.values() if isinstance(r.drive, Legs)], ids=lambda r: r.name
)
def test_no_foot_falls_through_the_ground(robot: Robot) -> None:
    """All of 400 feet stay on the triangles of a sidewalk."""
    assert count_sunk(foot_of(robot)) == 0


def test_a_thin_sole_falls_through_the_ground() -> None:
    """Some boxes as thin as the visible sole fall through, so the drop test can fail."""
    assert count_sunk(THIN_SOLE) > 0

"""What hides somebody from the robot, held against what the camera shows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import LABELS, People, PersonKind, Street
from cosim.results.event_monitor import STANDARD_CAMERA, body_points, eye_of, in_picture
from cosim.spec.robot import COURIER
from cosim.spec.scenario import Barrier
from physics.cameras.choice import camera_of
from physics.dynamics.world import BulletWorld
from physics.street.street_surface import StreetSurface
from tests.support.tiny_street import tiny_map

LOW = Barrier(x_m=-16.0, y_m=5.0, heading_rad=0.0, length_m=3.0, strip="nw", end=0, height_m=0.6)
"""Across the northern sidewalk."""


@pytest.mark.engine
@pytest.mark.parametrize(
    ("at", "heading_deg", "fences", "shown"),
    [
        ((-12.0, 5.0), 0.0, (), True),
        ((-12.0, 5.0), 0.0, (LOW,), True),
        ((-18.5, 5.2), 0.0, (), True),
        ((-20.0, -6.5), -90.0, (), True),
        ((-28.0, 5.0), 0.0, (), False),
        ((-20.0, 22.0), 90.0, (), False),
    ],
    ids=[
        "free",
        "behind a low fence",
        "near",
        "over the road",
        "behind the robot",
        "behind a house",
    ],
)
def test_who_is_seen_has_pixels_and_who_is_hidden_has_none(
    at: tuple[float, float], heading_deg: float, fences: Sequence[Barrier], shown: bool
) -> None:
    """A tenth of the body unhidden by rays where the standard camera shows it; no ray where it
    shows nothing."""
    people = People.of(("e0",), np.array([at]), [math.pi], [0.0], ("stand",), kind=PersonKind.EVENT)
    street = Street(0, people)
    with BulletWorld(StreetSurface(tiny_map(), seed=0), fences) as world:
        robot = world.place(Pose(-20.0, 5.0, math.radians(heading_deg)))
        mount = COURIER.mount("front")
        eye = eye_of(robot, mount)
        points = body_points(eye, np.array(at), robot.z_m)
        inside = points[in_picture(robot.pose, mount, STANDARD_CAMERA, points - eye)]
        unhidden = (~world.hidden(eye, inside)).sum() / len(points)
        with camera_of("bullet", world, STANDARD_CAMERA) as camera:
            pixels = (camera.render(robot, street).labels == LABELS["person"]).sum()
    assert (unhidden >= 0.1) == shown and (pixels >= 3) == shown

"""Visible and hidden places of a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Pose
from cosim.core.state import LABELS, People, PersonKind, Street
from cosim.results.event_monitor import STANDARD_CAMERA, body_points, camera_position, in_picture
from cosim.spec.robot import COURIER
from cosim.spec.scenario import Barrier
from physics.cameras.choice import camera_of
from physics.cameras.view import Shot, shot
from physics.dynamics.world import BulletWorld
from physics.street.street_surface import StreetSurface
from tests.support.tiny_street import tiny_map

LOW = Barrier(x_m=-16.0, y_m=5.0, heading_rad=0.0, length_m=3.0, strip="nw", end=0, height_m=0.6)
"""A low fence across the northern sidewalk."""


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
def test_visible_people_have_pixels_and_hidden_ones_have_none(
    at: tuple[float, float], heading_deg: float, fences: Sequence[Barrier], shown: bool
) -> None:
    """Rays reach a tenth of a body exactly where the standard camera shows it."""
    people = People.of(("e0",), np.array([at]), [math.pi], [0.0], ("stand",), kind=PersonKind.EVENT)
    street = Street(0, people)
    with BulletWorld(StreetSurface(tiny_map(), seed=0), fences) as world:
        robot = world.place(Pose(-20.0, 5.0, math.radians(heading_deg)))
        mount = COURIER.mount("front")
        eye = camera_position(robot, mount)
        points = body_points(eye, np.array(at), robot.z_m)
        inside = points[in_picture(robot.pose, mount, STANDARD_CAMERA, points - eye)]
        unhidden = (~world.occluded(eye, inside)).sum() / len(points)
        with camera_of("bullet", world, STANDARD_CAMERA) as camera:
            pixels = (camera.render(robot, street).labels == LABELS["person"]).sum()
    assert (unhidden >= 0.1) == shown and (pixels >= 3) == shown


SHOTS = {
    "the robot's": shot([0.0, 0.0, 0.74], [1.0, 0.2, 0.56], (384, 288), 75.0),
    "from behind": shot([-4.6, 0.0, 2.5], [3.0, 0.0, 0.5], (896, 676), 62.0),
    "a slanted one from above": shot([3.0, -2.0, 28.0], [18.0, 2.0, 0.0], (1280, 720), 60.0),
    "a steep one from above": shot([1.0, 5.0, 10.0], [2.0, 3.2, 0.0], (896, 676), 62.0),
    "straight down": shot([4.0, 4.0, 12.0], [4.0, 4.0, 0.0], (500, 800), 70.0),
    "a downward mount": shot([0.0, 0.0, 2.0], [0.1, 0.0, 1.0], (96, 96), 110.0),
}


def on_picture(taken: Shot, xy: Floats) -> NDArray[np.bool_]:
    """Return whether each of (N, 2) places on the ground lies in the picture."""
    right, up, ahead = taken.axes @ (np.column_stack([xy, np.zeros(len(xy))]) - taken.eye_m).T
    wide, tall = taken.half_picture
    return np.asarray((ahead > 0.0) & (np.abs(right) < wide * ahead) & (np.abs(up) < tall * ahead))


@pytest.mark.parametrize("name", SHOTS)
def test_all_places_of_a_picture_count_as_visible(name: str) -> None:
    """Of ten thousand places around the eye, all in the picture count as visible, and of a level
    picture most others do not."""
    taken = SHOTS[name]
    xy = taken.eye_m[:2] + np.random.default_rng(3).uniform(-30.0, 30.0, (10_000, 2))
    shown = on_picture(taken, xy)
    seen = taken.view.sees(xy, 0.0)
    assert shown.sum() > 5 and not (shown & ~seen).any()
    if taken.steep_rad < 0.5:
        assert seen.mean() < 0.5

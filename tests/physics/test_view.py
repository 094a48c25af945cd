"""What can be in a picture: no camera leaves out what its picture shows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.cameras.view import Shot, shot

SHOTS = {
    "the robot's": shot([0.0, 0.0, 0.74], [1.0, 0.2, 0.56], (384, 288), 75.0),
    "from behind": shot([-4.6, 0.0, 2.5], [3.0, 0.0, 0.5], (896, 676), 62.0),
    "a slanted one from above": shot([3.0, -2.0, 28.0], [18.0, 2.0, 0.0], (1280, 720), 60.0),
    "a steep one from above": shot([1.0, 5.0, 10.0], [2.0, 3.2, 0.0], (896, 676), 62.0),
    "straight down": shot([4.0, 4.0, 12.0], [4.0, 4.0, 0.0], (500, 800), 70.0),
    "a downward mount": shot([0.0, 0.0, 2.0], [0.1, 0.0, 1.0], (96, 96), 110.0),
}


def in_picture(taken: Shot, xy: Floats) -> NDArray[np.bool_]:
    """Whether each of (N, 2) places on the ground lies in the picture."""
    right, up, ahead = taken.axes @ (np.column_stack([xy, np.zeros(len(xy))]) - taken.eye_m).T
    wide, tall = taken.half_picture
    return np.asarray((ahead > 0.0) & (np.abs(right) < wide * ahead) & (np.abs(up) < tall * ahead))


@pytest.mark.parametrize("name", SHOTS)
def test_nothing_that_a_picture_shows_is_left_out(name: str) -> None:
    """Of ten thousand places around the eye, all that lie in the picture are taken for seen, and
    most others are not where the picture is level."""
    taken = SHOTS[name]
    xy = taken.eye_m[:2] + np.random.default_rng(3).uniform(-30.0, 30.0, (10_000, 2))
    shown = in_picture(taken, xy)
    seen = taken.view.sees(xy, 0.0)
    assert shown.sum() > 5 and not (shown & ~seen).any()
    if taken.steep_rad < 0.5:
        assert seen.mean() < 0.5

"""Projection of a way on the ground into a picture."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import Command
from cosim.spec.camera import Lens
from physics.cameras.view import Shot
from scenarios.tools.viewing.drawn_route import led_to, way_in_picture

LEVEL = Shot(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 1.0]), (200, 100), 90.0)
"""From 1 m above the origin along x: a focal length is 50 pixels; the ground 45 degrees down is at
the lower edge."""


def test_ground_points_are_projected_as_worked_out_by_hand() -> None:
    """2 m ahead is 25 pixels below the middle, 1 m aside 25 pixels aside, 1 m ahead the lower edge;
    others are outside."""
    way = np.array(
        [
            [-1.0, 0.0, 0.0],
            [0.5, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [2.0, 0.0, 0.0],
            [2.0, 1.0, 0.0],
            [2.0, -9.0, 0.0],
        ]
    )
    drawn = way_in_picture(LEVEL, Lens(), way)
    out = [math.nan, math.nan]
    expected = [out, out, [100.0, 100.0], [100.0, 75.0], [75.0, 75.0], out]
    assert np.allclose(drawn.points, expected, equal_nan=True)
    (line,) = drawn.lines
    assert np.allclose(line[0], (100.0, 110.0)) and np.allclose(line[-1, 0], 210.0)
    assert any(np.allclose(at, (75.0, 75.0)) for at in line)


def test_a_camera_that_looks_down_has_the_ground_under_its_axis_in_the_middle() -> None:
    """45 degrees down from 2 m, 2 m ahead is the middle, and 1 m aside of it 50 / sqrt(8) pixels
    aside."""
    shot = Shot(np.array([0.0, 0.0, 2.0]), np.array([0.0, 2.0, 0.0]), (200, 100), 90.0)
    middle, aside = way_in_picture(
        shot, Lens(), np.array([[0.0, 2.0, 0.0], [1.0, 2.0, 0.0]])
    ).points
    assert np.allclose(middle, (100.0, 50.0)) and np.allclose(
        aside, (100.0 + 50.0 / math.sqrt(8.0), 50.0)
    )


def test_a_lens_bends_the_way() -> None:
    """By Brown's first term, at r^2 = 1/2 and k1 = 0.1, points move out by a twentieth; folded ones
    are left out."""
    way = np.array([[2.0, 0.0, 0.0], [2.0, 1.0, 0.0]])
    assert np.allclose(
        way_in_picture(LEVEL, Lens(k1=0.1), way).points[1], (100.0 - 26.25, 50.0 + 26.25)
    )
    aside = np.array([[1.0, 1.5, 0.0], [1.0, 1.6, 0.0]])
    assert not way_in_picture(LEVEL, Lens(k1=-0.4), aside).lines and way_in_picture(
        LEVEL, Lens(), aside
    ).points.shape == (2, 2)


@pytest.mark.parametrize("w_radps", [0.0, 0.5], ids=["straight", "turning"])
def test_a_command_leads_along_its_arc(w_radps: float) -> None:
    """1 m/s for 1.5 s from a pose heading north is 1.5 m on the circle of its radius to the left."""
    way = led_to(Command(1.0, w_radps), Pose(3.0, 4.0, math.pi / 2.0))
    assert np.allclose(way[0], (3.0, 4.0)) and np.hypot(
        *np.diff(way, axis=0).T
    ).sum() == pytest.approx(1.5, abs=2e-3)
    if w_radps:
        assert np.allclose(np.hypot(*(way - (1.0, 4.0)).T), 2.0)
    else:
        assert np.allclose(way[-1], (3.0, 5.5))

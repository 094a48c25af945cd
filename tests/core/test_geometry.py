"""Poses, polylines and overlaps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.geometry import (
    Polyline,
    box_disk_gap,
    boxes_overlap,
    heading_from_sumo,
    heading_to_sumo,
    headings_from_sumo,
    hypot,
    wrap_angle,
    wrap_angles,
)

L_SHAPE = Polyline([(0, 0), (10, 0), (10, 10)])


@given(st.floats(-1000, 1000))
def test_wrapped_angles_lie_in_the_half_open_circle_and_agree(angle: float) -> None:
    """A wrapped angle lies in (-pi, pi] and points the same way, one by one and as an array."""
    wrapped = wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)
    assert math.isclose(
        abs(wrap_angle(wrapped - float(wrap_angles([angle])[0]))), 0.0, abs_tol=1e-9
    )


def test_sumo_angles_are_clockwise_from_north() -> None:
    """SUMO's 0 is north, its 90 is east, and the conversion goes both ways."""
    assert math.isclose(headings_from_sumo(0.0), math.pi / 2)
    assert math.isclose(headings_from_sumo(90.0), 0.0)
    for degrees in (0.0, 45.0, 200.0, 359.0):
        assert math.isclose(heading_to_sumo(headings_from_sumo(degrees)), degrees, abs_tol=1e-9)


@given(st.floats(-1000, 1000), st.floats(-1000, 1000))
def test_single_lengths_and_angles_have_the_bits_of_arrays(x: float, y: float) -> None:
    """A length and a heading of SUMO are the same to the bit, one by one and as an array."""
    assert hypot(x, y) == np.hypot(np.array([x]), np.array([y]))[0]
    assert heading_from_sumo(x) == headings_from_sumo([x])[0]


def test_a_polyline_is_measured_along_itself() -> None:
    """Arc length, pose and projection of an L-shaped line are those worked out by hand."""
    assert L_SHAPE.length_m == 20.0
    assert L_SHAPE.at(5.0) == (5.0, 0.0, 0.0)
    assert L_SHAPE.at(15.0) == (10.0, 5.0, math.pi / 2)
    assert L_SHAPE.at(99.0)[:2] == (10.0, 10.0)
    assert L_SHAPE.project(4.0, 2.0) == (4.0, 2.0)
    assert L_SHAPE.project(12.0, 6.0) == (16.0, -2.0)


def test_a_projection_near_an_arc_length_ignores_the_rest_of_the_line() -> None:
    """A route that passes near itself is projected onto the requested part."""
    hairpin = Polyline([(0, 0), (50, 0), (50, 2), (0, 2)])
    assert hairpin.project(10.0, 1.9)[0] == pytest.approx(92.0)
    assert hairpin.project(10.0, 1.9, (0.0, 20.0))[0] == pytest.approx(10.0)


def test_a_polyline_needs_two_points() -> None:
    """A line of one repeated point is refused."""
    with pytest.raises(ValueError, match="two distinct points"):
        Polyline([(1, 1), (1, 1)])


def test_the_distance_from_a_box_to_a_point_is_exact() -> None:
    """Distances at the sides, the front and a corner equal those by hand, and inside it is 0."""
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, math.pi / 2]])
    centres = np.array([[[3.0, 0.0], [0.0, 3.0], [4.0, 5.0], [0.5, 0.1]]])
    gaps = box_disk_gap(poses, 1.0, 0.5, centres)
    assert gaps[0] == pytest.approx([2.0, 2.5, math.hypot(3.0, 4.5), 0.0])
    assert gaps[1] == pytest.approx([2.5, 2.0, math.hypot(3.5, 4.0), 0.0])


def test_overlaps_of_boxes_are_exact() -> None:
    """Parallel, turned and corner-to-corner boxes are distinguished by the separating axes."""
    one = np.array([0.0, 0.0, 0.0])
    half = np.array([1.0, 0.5])
    others = np.array(
        [[1.9, 0.0, 0.0], [2.1, 0.0, 0.0], [1.4, 0.0, math.pi / 2], [1.55, 0.0, math.pi / 2]]
    )
    assert boxes_overlap(one, half, others, half).tolist() == [True, False, True, False]
    diagonal = np.array([1.6, 1.1, math.pi / 4])
    assert not boxes_overlap(one, half, diagonal, np.array([0.5, 0.5]))

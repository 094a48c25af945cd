"""Medial axis of walkable ground."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Polyline
from cosim.place import overlay
from cosim.place.medial_axis import medial_axis

box = shapely.box


def test_the_axis_of_a_sidewalk_is_its_middle() -> None:
    """It runs from end to end, without branches into corners, with the sidewalk's width."""
    axis = medial_axis(box(0, 0, 45, 3))
    (piece,) = axis.pieces
    assert np.abs(piece.line[:, 1] - 1.5).max() < 0.02
    assert sorted(piece.line[[0, -1], 0]) == pytest.approx([0.3, 44.7], abs=0.05)
    assert piece.clear_m == pytest.approx(3.0, abs=0.05)


def test_long_sidewalks_and_rings_are_cut() -> None:
    """No piece is longer than 50 m, and a ring has nodes."""
    assert len(medial_axis(box(0, 0, 120, 3)).pieces) == 3
    ring = medial_axis(box(0, 0, 30, 20) - box(3, 3, 27, 17))
    assert len(ring.pieces) >= 3 and len(ring.nodes) == len(ring.pieces)


def test_the_axis_is_cut_where_the_width_changes() -> None:
    """A narrow place has a piece of its own, and the rest stays wide."""
    ground = box(0, 0, 40, 3) - box(18, 1.8, 20, 3)
    axis = medial_axis(ground)
    widths = [round(piece.clear_m, 1) for piece in axis.pieces]
    assert len(widths) == 3 and sorted(widths)[0] == pytest.approx(1.8, abs=0.15)
    assert sorted(widths)[1:] == pytest.approx([3.0, 3.0], abs=0.25)
    narrow = min(axis.pieces, key=lambda piece: piece.clear_m)
    assert 4.0 <= Polyline(narrow.line).length_m <= 11.0


def test_forks_join_and_obstacles_are_passed_on_wide_sides() -> None:
    """A cross has four arms at one node, and a post near an edge is passed on its wider side."""
    cross = medial_axis(overlay.union_all([box(-20, -1.5, 20, 1.5), box(-1.5, -20, 1.5, 20)]))
    degrees = np.bincount([end for piece in cross.pieces for end in (piece.start, piece.end)])
    assert len(cross.pieces) == 4 and degrees.max() == 4
    post = box(19, 0.6, 19.4, 1.0)
    axis = medial_axis(box(0, 0, 40, 3) - post)
    assert len(axis.nodes) == len(axis.pieces) + 1
    assert all(not shapely.LineString(piece.line).intersects(post) for piece in axis.pieces)
    wide = medial_axis(box(0, 0, 40, 8) - box(19, 3.5, 21, 4.5))
    assert len(wide.nodes) == len(wide.pieces)


def test_narrow_ground_has_no_axis() -> None:
    """Ground too narrow for a robot is left out."""
    assert not medial_axis(box(0, 0, 20, 0.7)).pieces
    joined = overlay.union_all([box(0, 0, 20, 3), box(20, 1, 30, 1.6), box(30, 0, 50, 3)])
    assert len(medial_axis(joined).pieces) == 2

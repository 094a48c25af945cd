"""ORCA's half-planes and its linear programme, on cases worked out by hand and against a search of
all velocities."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.people.orca import HalfPlane, best_velocity, half_plane

FASTEST_MPS = 2.0


def half_plane_for(
    apart: tuple[float, float],
    mine: tuple[float, float],
    other: tuple[float, float],
    **about: float,
) -> HalfPlane:
    """A half-plane with full responsibility, radius 1 m, a horizon of 2 s."""
    known = {"radius_m": 1.0, "horizon_s": 2.0, "share": 1.0, "step_s": 0.1} | about
    return half_plane(np.array(apart), np.array(mine), np.array(other), **known)


def test_standing_still_before_a_standing_disk_is_permitted_and_driving_into_it_is_not() -> None:
    """A disk of radius 1 m at 6 m is reached in 2 s at 2.5 m/s, which is the edge, square to the
    way."""
    plane = half_plane_for((6.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    assert plane == pytest.approx((-1.0, 0.0, -2.5))
    assert plane.excess(np.array([0.0, 0.0])) == pytest.approx(2.5)
    assert plane.excess(np.array([2.6, 0.0])) == pytest.approx(-0.1)


def test_the_edge_of_a_head_on_approach_is_the_leg_of_the_cone() -> None:
    """Two disks 5 m apart that close at 4 m/s must cross the leg at asin(1/5) to the line between
    them."""
    plane = half_plane_for((5.0, 0.0), (2.0, 0.0), (-2.0, 0.0))
    sin = 0.2
    assert (plane.nx, plane.ny) == pytest.approx((-sin, math.sqrt(1 - sin**2)))
    assert plane.excess(np.array([2.0, 0.0])) == pytest.approx(-4.0 * sin)
    shared = half_plane_for((5.0, 0.0), (2.0, 0.0), (-2.0, 0.0), share=0.5)
    assert shared.excess(np.array([2.0, 0.0])) == pytest.approx(-2.0 * sin)


def test_a_crossing_person_is_passed_behind() -> None:
    """A person walking left to right ahead forbids going straight on, and permits left."""
    plane = half_plane_for((2.5, 1.0), (1.0, 0.0), (0.0, -0.5))
    assert plane.excess(np.array([1.0, 0.0])) < 0.0
    v = best_velocity([plane], np.array([1.0, 0.0]), FASTEST_MPS)
    assert plane.excess(v) == pytest.approx(0.0, abs=1e-9)
    assert closest(np.array([2.5, 1.0]), v - [0.0, -0.5], 2.0) >= 1.0 - 1e-6


def test_overlapping_disks_separate_within_a_step() -> None:
    """Disks of radius 1 m at 0.9 m separate by the missing 0.1 m in 0.1 s, at 1 m/s."""
    plane = half_plane_for((0.9, 0.0), (0.0, 0.0), (0.0, 0.0))
    assert plane == pytest.approx((-1.0, 0.0, 1.0))


def test_a_permitted_velocity_is_kept_and_a_too_fast_one_is_clipped() -> None:
    """Without half-planes the preferred velocity comes out, no faster than allowed."""
    assert best_velocity([], np.array([1.0, 0.5]), FASTEST_MPS).tolist() == [1.0, 0.5]
    assert best_velocity([], np.array([3.0, 4.0]), FASTEST_MPS) == pytest.approx([1.2, 1.6])


def test_the_worst_violation_is_minimal_where_nothing_is_permitted() -> None:
    """x >= 1 and x <= -1 meet half way; with y >= 1.5 and y <= -0.5 added, the midpoint of the
    worse pair wins."""
    east = HalfPlane(1.0, 0.0, 1.0)
    west = HalfPlane(-1.0, 0.0, 1.0)
    v = best_velocity([east, west], np.array([0.3, 0.0]), FASTEST_MPS)
    assert max(-p.excess(v) for p in (east, west)) == pytest.approx(1.0)
    assert v[0] == pytest.approx(0.0, abs=1e-9)
    north = HalfPlane(0.0, 1.0, 1.9)
    v = best_velocity([east, west, north], np.array([0.0, -1.0]), FASTEST_MPS)
    assert max(-p.excess(v) for p in (east, west, north)) == pytest.approx(1.0)


def closest(apart: np.ndarray, relative: np.ndarray, horizon_s: float) -> float:
    """Return the least distance of two centres within a time."""
    t = min(max(float(apart @ relative) / max(float(relative @ relative), 1e-12), 0.0), horizon_s)
    return float(np.hypot(*(apart - t * relative)))


numbers = st.floats(-2.5, 2.5, allow_nan=False)
pairs = st.tuples(numbers, numbers)
directions = st.floats(-math.pi, math.pi)


@settings(max_examples=200)
@given(st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0)), pairs, pairs)
def test_a_permitted_velocity_keeps_clear_for_the_horizon(
    apart: tuple[float, float], mine: tuple[float, float], other: tuple[float, float]
) -> None:
    """With full responsibility a velocity of the half-plane avoids the other disk for tau."""
    if math.hypot(*apart) <= 1.01:
        return
    plane = half_plane_for(apart, mine, other)
    v = best_velocity([plane], np.array(mine), 20.0)
    assert plane.excess(v) >= -1e-6
    assert closest(np.array(apart), v - np.array(other), 2.0) >= 1.0 - 1e-4


@settings(max_examples=150)
@given(st.lists(st.tuples(directions, st.floats(-1.8, 1.8)), min_size=1, max_size=7), pairs)
def test_the_programme_agrees_with_a_search_of_all_velocities(
    made: list[tuple[float, float]], preferred: tuple[float, float]
) -> None:
    """The solution violates no satisfiable half-plane, is nearest to the wish, and otherwise has
    the least worst violation."""
    planes = [HalfPlane(math.cos(a), math.sin(a), c) for a, c in made]
    v = best_velocity(planes, np.array(preferred), FASTEST_MPS)
    wish = np.array(preferred)
    assert np.hypot(*v) <= FASTEST_MPS + 1e-6
    axis = np.linspace(-FASTEST_MPS, FASTEST_MPS, 81)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(*grid.T) <= FASTEST_MPS]
    excess = np.min([grid @ [p.nx, p.ny] - p.offset for p in planes], axis=0)
    mine = min(p.excess(v) for p in planes)
    assert mine >= min(excess.max(), 0.0) - 1e-6
    if (excess >= 0.0).any():
        assert mine >= -1e-6
        assert np.hypot(*(v - wish)) <= np.hypot(*(grid[excess >= 0.0] - wish).T).min() + 1e-6

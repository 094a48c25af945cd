"""Optimal reciprocal collision avoidance (ORCA) of disks.

Source: J. van den Berg, S. J. Guy, M. Lin, D. Manocha, "Reciprocal n-body collision avoidance",
    Robotics Research (ISRR 2009), Springer 2011, whose names are used. The linear programme follows
    de Berg et al., "Computational Geometry", chapter 4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cosim.core.geometry import Floats

_EPS = 1e-9
"""Tolerance for rounding, in the units of its use."""

_Vector = Floats | tuple[float, float]
"""Vector of two numbers, in metres or metres per second."""


class HalfPlane(NamedTuple):
    """Permitted velocities v (m/s): normal . v >= offset.

    nx, ny: unit normal into the permitted side.
    """

    nx: float
    ny: float
    offset: float

    def excess(self, v: Floats) -> float:
        """Return the distance of a velocity (2,) from the edge in m/s, positive inside."""
        return self.nx * float(v[0]) + self.ny * float(v[1]) - self.offset


def half_plane(
    offset_m: _Vector,
    own_mps: _Vector,
    other_mps: _Vector,
    radius_m: float,
    horizon_s: float,
    share: float,
    step_s: float,
) -> HalfPlane:
    """Return the velocities with which a disk does its share to avoid another one, ORCA^tau.

    offset_m: (2,) vector to the other disk.
    own_mps, other_mps: (2,) velocities.
    radius_m: sum of both radii.
    horizon_s: tau.
    share: own share of the avoidance: 1/2 if both avoid, 1 if the other does not.
    step_s: time in which overlapping disks are separated.

    The velocity obstacle VO^tau is the set of relative velocities that lead into the disk of radius
    `radius_m` at `offset_m` within tau. It is a cone with a round tip: a disk of radius r/tau at
    offset/tau, and its tangents. u is the smallest change of the relative velocity to the
    obstacle's boundary; n is the outward normal there.
    """
    ax, ay = float(offset_m[0]), float(offset_m[1])
    mx, my = float(own_mps[0]), float(own_mps[1])
    rx, ry = mx - float(other_mps[0]), my - float(other_mps[1])
    distance_m = math.hypot(ax, ay)
    if distance_m <= radius_m:
        horizon_s = step_s
    wx, wy = rx - ax / horizon_s, ry - ay / horizon_s
    along = wx * ax + wy * ay
    before_disk = along < 0.0 and along**2 >= radius_m**2 * (wx * wx + wy * wy)
    if distance_m <= radius_m or before_disk:
        size = math.hypot(wx, wy)
        far_m = max(distance_m, _EPS)
        nx, ny = (wx / size, wy / size) if size > _EPS else (-ax / far_m, -ay / far_m)
        inside = radius_m / horizon_s - (wx * nx + wy * ny)
    else:
        sin = radius_m / distance_m
        cos = math.sqrt(1.0 - sin**2)
        left = 1.0 if ax * ry - ay * rx >= 0.0 else -1.0
        nx = (-left * cos * ay - sin * ax) / distance_m
        ny = (left * cos * ax - sin * ay) / distance_m
        inside = -(rx * nx + ry * ny)
    return HalfPlane(nx, ny, (mx + share * inside * nx) * nx + (my + share * inside * ny) * ny)


def best_velocity(planes: Sequence[HalfPlane], preferred_mps: Floats, fastest_mps: float) -> Floats:
    """Return the permitted velocity (2,) nearest to the preferred one, at most `fastest_mps`.

    If no velocity is permitted, return the one with the least maximum violation.
    """
    speed = math.hypot(*preferred_mps)
    v = preferred_mps * min(1.0, fastest_mps / max(speed, _EPS))
    for i, plane in enumerate(planes):
        if plane.excess(v) < -_EPS:
            found = _on_edge(plane, planes[:i], fastest_mps, preferred_mps, toward=False)
            if found is None:
                return _least_violating(planes, i, v, fastest_mps)
            v = found
    return v


def _on_edge(
    plane: HalfPlane, others: Sequence[HalfPlane], fastest_mps: float, goal: Floats, *, toward: bool
) -> Floats | None:
    """Return the best velocity on the edge of a half-plane that all others permit, or None.

    goal: preferred velocity; with `toward`, a direction to maximize.
    """
    if abs(plane.offset) > fastest_mps:
        return None
    half = math.sqrt(fastest_mps**2 - plane.offset**2)
    low = -half
    high = half
    dx = plane.ny
    dy = -plane.nx
    x0, y0 = plane.nx * plane.offset, plane.ny * plane.offset
    for other in others:
        gain = dx * other.nx + dy * other.ny
        short = other.offset - (x0 * other.nx + y0 * other.ny)
        if abs(gain) < _EPS:
            if short > _EPS:
                return None
        elif gain > 0.0:
            low = max(low, short / gain)
        else:
            high = min(high, short / gain)
        if low > high:
            return None
    wanted = dx * float(goal[0]) + dy * float(goal[1])
    if toward:
        t = high if wanted > 0.0 else low
    else:
        t = min(max(wanted, low), high)
    return np.array([x0 + t * dx, y0 + t * dy])


def _least_violating(
    planes: Sequence[HalfPlane], first: int, v: Floats, fastest_mps: float
) -> Floats:
    """Return the velocity with the least maximum violation of the half-planes.

    v permits the half-planes before `first`. A half-plane that is violated more than all earlier
    ones becomes the worst. Its violation is minimized while no earlier one exceeds it. This
    constraint is again a half-plane: (n_j - n_i) . v >= c_j - c_i.
    """
    worst = 0.0
    for i in range(first, len(planes)):
        plane = planes[i]
        if -plane.excess(v) <= worst + _EPS:
            continue
        no_worse = [h for other in planes[:i] if (h := _no_worse(other, plane)) is not None]
        toward = np.array([plane.nx, plane.ny])
        found: Floats | None = toward * fastest_mps
        for k, bound in enumerate(no_worse):
            if found is not None and bound.excess(found) < -_EPS:
                found = _on_edge(bound, no_worse[:k], fastest_mps, toward, toward=True)
        if found is not None:
            v = found
        worst = -plane.excess(v)
    return v


def _no_worse(other: HalfPlane, plane: HalfPlane) -> HalfPlane | None:
    """Return where `other` is violated no more than `plane`; None for parallel ones."""
    nx, ny = other.nx - plane.nx, other.ny - plane.ny
    size = math.hypot(nx, ny)
    return (
        None
        if size < 1e-7
        else HalfPlane(nx / size, ny / size, (other.offset - plane.offset) / size)
    )

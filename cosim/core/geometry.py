"""Poses in the plane, angles, polylines by arc length, and overlaps of simple shapes.

World frame: x east, y north, metres. Headings: radians, counter-clockwise from +x, in (-pi, pi].
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class Pose(NamedTuple):
    """Pose in the world frame."""

    x_m: float
    y_m: float
    heading_rad: float

    @property
    def xy(self) -> Floats:
        """Position in metres, shape (2,)."""
        return np.array([self.x_m, self.y_m])


class Circle(NamedTuple):
    """A disk in the plane; the default one contains nothing.

    It bounds where a result that was found at its centre stays valid.
    """

    x_m: float = math.nan
    y_m: float = math.nan
    radius_m: float = 0.0

    def holds(self, x_m: float, y_m: float) -> bool:
        """Return whether a point lies in the disk. The centre always does."""
        return math.hypot(x_m - self.x_m, y_m - self.y_m) <= self.radius_m


def wrap_angle(angle_rad: float) -> float:
    """Return an angle wrapped into (-pi, pi]."""
    wrapped = math.fmod(angle_rad + math.pi, 2.0 * math.pi)
    return wrapped + math.pi if wrapped <= 0.0 else wrapped - math.pi


def wrap_angles(angles_rad: ArrayLike) -> Floats:
    """Return every angle of an array wrapped into (-pi, pi]."""
    wrapped = np.subtract(np.pi, angles_rad, dtype=float)
    wrapped = np.remainder(wrapped, 2.0 * np.pi)
    wrapped_rad: Floats = np.subtract(np.pi, wrapped)
    return wrapped_rad


def hypot(x: float, y: float) -> float:
    """Return the length of a vector with the bits of `np.hypot`; `math.hypot` rounds
    differently."""
    return abs(complex(x, y))


def heading_from_sumo(angle_deg: float) -> float:
    """Convert one angle with the bits of `headings_from_sumo`."""
    return math.pi - (math.pi - math.radians(90.0 - angle_deg)) % (2.0 * math.pi)


def headings_from_sumo(angles_deg: ArrayLike) -> Floats:
    """Convert SUMO's navigational degrees (0 north, clockwise) to headings in radians."""
    return wrap_angles(np.radians(np.subtract(90.0, angles_deg, dtype=float)))


def heading_to_sumo(heading_rad: float) -> float:
    """Convert a heading in radians to SUMO's navigational degrees in [0, 360)."""
    return (90.0 - math.degrees(heading_rad)) % 360.0


class Polyline:
    """Open polyline with points addressed by arc length.

    points: (N, 2) metres, N >= 2; consecutive equal points are dropped. Raises ValueError if fewer
        than two distinct points remain.
    """

    def __init__(self, points: ArrayLike) -> None:
        xy = np.asarray(points, dtype=float).reshape(-1, 2)
        keep = np.ones(len(xy), dtype=bool)
        keep[1:] = np.hypot(*np.diff(xy, axis=0).T) > 1e-9
        xy = xy[keep]
        if len(xy) < 2:
            raise ValueError("a polyline needs two distinct points")
        steps = np.diff(xy, axis=0)
        self.points: Floats = xy
        self._lengths = np.hypot(steps[:, 0], steps[:, 1])
        self._directions = steps / self._lengths[:, None]
        self.s_m: Floats = np.concatenate([[0.0], np.cumsum(self._lengths)])
        self._rows: list[list[float]] | None = None
        self._starts_m: list[float] = []
        for array in (self.points, self.s_m):
            array.flags.writeable = False

    @property
    def length_m(self) -> float:
        return float(self.s_m[-1])

    def at(self, s_m: float) -> Pose:
        """Return the pose at arc length `s_m`, clamped to the ends, heading along the polyline."""
        if self._rows is None:
            columns = (self.points[:-1], self._directions, self._lengths[:, None])
            self._starts_m = self.s_m.tolist()
            self._rows = np.column_stack(columns).tolist()
        s_m = float(s_m)
        i = min(max(bisect_right(self._starts_m, s_m) - 1, 0), len(self._rows) - 1)
        x, y, dx, dy, length_m = self._rows[i]
        along = min(max(s_m - self._starts_m[i], 0.0), length_m)
        return Pose(x + along * dx, y + along * dy, math.atan2(dy, dx))

    def project(
        self, x_m: float, y_m: float, near_s_m: tuple[float, float] | None = None
    ) -> tuple[float, float]:
        """Return arc length and signed offset (left positive) of the nearest point, in metres.

        near_s_m: interval of arc length to search. A route that passes near itself needs it for an
            unambiguous result.
        """
        first = 0
        last = len(self._lengths)
        if near_s_m is not None:
            first = max(bisect_right(self.s_m, near_s_m[0]) - 1, 0)
            last = min(bisect_left(self.s_m, near_s_m[1]), last)
            first = min(first, len(self._lengths) - 1)
            last = max(last, first + 1)
        start, direction = self.points[first:last], self._directions[first:last]
        dx, dy = x_m - start[:, 0], y_m - start[:, 1]
        along = np.maximum(dx * direction[:, 0] + dy * direction[:, 1], 0.0)
        along = np.minimum(along, self._lengths[first:last])
        ox, oy = dx - along * direction[:, 0], dy - along * direction[:, 1]
        i = int(np.argmin(ox * ox + oy * oy))
        side = direction[i, 0] * dy[i] - direction[i, 1] * dx[i]
        return float(self.s_m[first + i] + along[i]), math.copysign(math.hypot(ox[i], oy[i]), side)

    def resampled(self, step_m: float) -> Polyline:
        """Return the line with a point about every `step_m` metres and the same ends."""
        count = max(round(self.length_m / step_m), 1)
        s = np.linspace(0.0, self.length_m, count + 1)
        xy = np.column_stack(
            [np.interp(s, self.s_m, self.points[:, 0]), np.interp(s, self.s_m, self.points[:, 1])]
        )
        return Polyline(xy)


def box_disk_gap(
    poses: Floats, half_length_m: float, half_width_m: float, centres: Floats
) -> Floats:
    """Return the distance from oriented boxes to points; 0 inside.

    poses: (T, 3) x, y, heading of the box's centre.
    centres: (T, N, 2) or (1, N, 2) points in metres.
    Returns (T, N) metres. Subtract a disk's radius to get the gap to the disk.
    """
    offset = centres - poses[:, None, :2]
    cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    ahead = np.abs(cos * offset[..., 0] + sin * offset[..., 1]) - half_length_m
    aside = np.abs(-sin * offset[..., 0] + cos * offset[..., 1]) - half_width_m
    return np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0))


def boxes_overlap(
    pose_a: Floats, half_a: ArrayLike, pose_b: Floats, half_b: ArrayLike
) -> NDArray[np.bool_]:
    """Return whether oriented boxes overlap, by the separating-axis theorem.

    pose_a, pose_b: (..., 3) x, y, heading.
    half_a, half_b: (..., 2) half length, half width, in metres.
    Returns booleans in the broadcast shape.
    """
    pose_a, pose_b = np.asarray(pose_a, float), np.asarray(pose_b, float)
    half_a, half_b = np.asarray(half_a, float), np.asarray(half_b, float)
    offset = pose_b[..., :2] - pose_a[..., :2]
    turn = pose_b[..., 2] - pose_a[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    apart = np.zeros(np.broadcast_shapes(pose_a.shape[:-1], pose_b.shape[:-1]), dtype=bool)
    for pose, mine, other in ((pose_a, half_a, half_b), (pose_b, half_b, half_a)):
        c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        ahead = np.abs(c * offset[..., 0] + s * offset[..., 1])
        aside = np.abs(-s * offset[..., 0] + c * offset[..., 1])
        apart |= ahead > mine[..., 0] + cos * other[..., 0] + sin * other[..., 1]
        apart |= aside > mine[..., 1] + sin * other[..., 0] + cos * other[..., 1]
    return ~apart

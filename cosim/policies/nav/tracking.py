"""Tracks of moving bodies of a person's size, from the scans of a lidar."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Pose
from cosim.core.state import PERSON_RADIUS_M
from cosim.spec.sensors import Scan

_WITHIN_M: Final = 9.0
"""Range in metres within which bodies are tracked."""
_BREAK_M: Final = 0.35
"""Distance in metres between neighbouring returns from which they are two bodies."""
_WIDEST_M: Final = 0.9
"""Largest width of a tracked body in metres."""
_FEWEST: Final = 0.25
"""Least width of a body in the scan, as a share of a person's radius."""
_SURFACE_M: Final = 0.22
"""Mean distance in metres of a person's visible outline from the middle."""
_MATCH_M: Final = 0.5
"""Largest distance in metres between a track and its body in the next scan."""
_GAIN_POSITION: Final = 0.5
"""Gain of the filter of a track on its position."""
_GAIN_VELOCITY: Final = 0.35
"""Gain of the filter of a track on its velocity."""
_SCANS: Final = 3
"""Number of scans from which a track has a velocity."""
_MISSED: Final = 3
"""Number of scans without its body after which a track ends."""
_MOVES_MPS: Final = 0.35
"""Speed in m/s from which a body moves."""
_MOVED_M: Final = 0.15
"""Distance in metres from its first place from which a body moves."""
_WALKED_M: Final = 0.6
"""Distance in metres from its first place from which a body has walked."""
_FASTEST_MPS: Final = 4.0
"""Largest speed of a track in m/s."""


class Movers(NamedTuple):
    """Moving bodies in the robot's frame.

    at: (N, 2) places in metres.
    velocity: (N, 2) m/s.
    """

    at: Floats
    velocity: Floats

    def gaps_m(self, points: Floats, times_s: Floats) -> Floats:
        """Return (T, M) distances in metres of points to the nearest outline of a body.

        points: (T, M, 2) metres, of each time; inf without a body.
        times_s: (T,) from now on.
        """
        if not len(self.at):
            return np.full(points.shape[:2], np.inf)
        later = self.at + times_s[:, None, None] * self.velocity
        off = points[:, :, None] - later[:, None]
        gaps: Floats = np.sqrt((off * off).sum(axis=-1)).min(axis=-1) - PERSON_RADIUS_M
        return gaps


NO_MOVERS: Final = Movers(np.zeros((0, 2)), np.zeros((0, 2)))
"""Nothing moves."""


class _Tracks(NamedTuple):
    """Bodies in the frame of the odometry.

    first: (N, 2) places at which they appeared, metres.
    at: (N, 2) middles, metres.
    velocity: (N, 2) m/s.
    scans: (N,) number of scans of each.
    missed: (N,) number of scans since it was in one.
    """

    first: Floats
    at: Floats
    velocity: Floats
    scans: NDArray[np.int64]
    missed: NDArray[np.int64]

    def only(self, rows: NDArray[np.bool_]) -> _Tracks:
        """Return some tracks."""
        return _Tracks(
            self.first[rows],
            self.at[rows],
            self.velocity[rows],
            self.scans[rows],
            self.missed[rows],
        )

    def joined(self, other: _Tracks) -> _Tracks:
        """Return the tracks of both."""
        return _Tracks(
            np.concatenate([self.first, other.first]),
            np.concatenate([self.at, other.at]),
            np.concatenate([self.velocity, other.velocity]),
            np.concatenate([self.scans, other.scans]),
            np.concatenate([self.missed, other.missed]),
        )


def _new_tracks(bodies: Floats) -> _Tracks:
    """Return tracks that begin at (N, 2) places."""
    count = len(bodies)
    ones, zeros = np.ones(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    return _Tracks(bodies, bodies, np.zeros((count, 2)), ones, zeros)


class Tracker:
    """Tracks of an episode."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all tracks."""
        self._tracks = _new_tracks(np.zeros((0, 2)))
        self._time_s = 0.0

    def update(self, scan: Scan, pose: Pose, time_s: float) -> None:
        """Take a scan from a pose in the frame of the odometry."""
        dt_s, self._time_s = max(time_s - self._time_s, 1e-3), time_s
        bodies = bodies_in(scan, pose)
        tracks = self._tracks
        expected = tracks.at + dt_s * tracks.velocity
        of_track = _matched(expected, bodies, tracks.scans)
        found = of_track >= 0
        off = np.where(found[:, None], bodies[of_track] - expected, 0.0) if len(bodies) else 0.0
        kept = _Tracks(
            tracks.first,
            expected + _GAIN_POSITION * off,
            tracks.velocity + _GAIN_VELOCITY / dt_s * off,
            tracks.scans + found,
            np.where(found, 0, tracks.missed + 1),
        ).only(found | (tracks.missed < _MISSED))
        new = np.ones(len(bodies), dtype=bool)
        new[of_track[found]] = False
        self._tracks = kept.joined(_new_tracks(bodies[new]))

    def movers(self, pose: Pose) -> Movers:
        """Return the moving bodies in the frame of a robot at a pose."""
        tracks = self._tracks
        speed = np.hypot(*tracks.velocity.T)
        moves = (tracks.scans >= _SCANS) & (speed > _MOVES_MPS) & (speed < _FASTEST_MPS)
        moves &= np.hypot(*(tracks.at - tracks.first).T) > _MOVED_M
        turn = _into_frame(pose)
        return Movers((tracks.at[moves] - pose.xy) @ turn, tracks.velocity[moves] @ turn)

    def walkers(self, pose: Pose) -> Floats:
        """Return the places (N, 2) of bodies that have walked, also of those that stand now."""
        tracks = self._tracks
        walked = np.hypot(*(tracks.at - tracks.first).T) > _WALKED_M
        places: Floats = (tracks.at[walked] - pose.xy) @ _into_frame(pose)
        return places


def _into_frame(pose: Pose) -> Floats:
    """Return the (2, 2) matrix that turns rows into the frame of a robot at a pose."""
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _matched(expected: Floats, bodies: Floats, scans: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the row of each track's body, -1 without one: nearest pairs first.

    Of pairs about equally near, the one of the older track is first.
    """
    found = np.full(len(expected), -1, dtype=np.int64)
    gaps = np.hypot(*np.moveaxis(expected[:, None] - bodies, -1, 0))
    rows, columns = np.nonzero(gaps <= _MATCH_M)
    order = np.lexsort((-scans[rows], gaps[rows, columns]))
    taken: set[int] = set()
    for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        if found[row] < 0 and column not in taken:
            found[row] = column
            taken.add(column)
    return found


def bodies_in(scan: Scan, pose: Pose) -> Floats:
    """Return the middles (N, 2) of bodies of a person's size, in the frame of the odometry."""
    ranges = scan.ranges_m[0].astype(float)
    rays = np.flatnonzero((ranges < _WITHIN_M) & (ranges > 0.1))
    if not len(rays):
        return np.zeros((0, 2))
    heading = scan.spec.angles_rad[rays] + pose.heading_rad
    unit = np.column_stack([np.cos(heading), np.sin(heading)])
    points = ranges[rays][:, None] * unit + pose.xy
    apart = (np.hypot(*np.diff(points, axis=0).T) > _BREAK_M) | (np.diff(rays) > 1)
    starts = np.concatenate([[0], np.flatnonzero(apart) + 1])
    ends = np.concatenate([starts[1:], [len(rays)]])
    count = (ends - starts)[:, None]
    middle = np.add.reduceat(points + _SURFACE_M * unit, starts) / count
    width_m = np.hypot(*(points[ends - 1] - points[starts]).T)
    seen_rad = count[:, 0] * 2.0 * math.pi / scan.spec.rays
    wide = seen_rad * ranges[rays[starts]] >= _FEWEST * PERSON_RADIUS_M
    bodies: Floats = middle[(width_m <= _WIDEST_M) & wide]
    return bodies

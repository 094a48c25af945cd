"""Spots: where persons and vehicles may enter the street."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from cosim.core.geometry import Floats, Polyline, Pose


class EntrySpot(NamedTuple):
    """A place on the middle line of an edge, heading along it; share: of the edge's length that lies before it."""

    edge: str
    share: float
    pose: Pose

    def beside(self, left_m: float, ahead_m: float) -> tuple[float, float]:
        """A point so far to the left of it and ahead of it, in metres."""
        cos, sin = math.cos(self.pose.heading_rad), math.sin(self.pose.heading_rad)
        return self.pose.x_m - left_m * sin + ahead_m * cos, self.pose.y_m + left_m * cos + ahead_m * sin


class Spots:
    """Where somebody may enter: points every `step_m` along lines, found by their distance."""

    def __init__(self, lines: Iterable[tuple[str, Floats, float, float]], step_m: float) -> None:
        """lines: edge id, (N, 2) metres, and how much to leave free at its start and end in metres."""
        self._edges: list[str] = []
        shares: list[Floats] = [np.zeros(0)]
        poses: list[Floats] = [np.zeros((0, 3))]
        for edge, xy, start_m, end_m in lines:
            line = Polyline(xy)
            s = np.arange(start_m, line.length_m - end_m, step_m)
            x, y = (np.interp([s - 0.1, s, s + 0.1], line.s_m, line.points[:, k]) for k in (0, 1))
            self._edges += [edge] * len(s)
            shares.append(s / line.length_m)
            poses.append(np.column_stack([x[1], y[1], np.arctan2(y[2] - y[0], x[2] - x[0])]))
        self._shares = np.concatenate(shares)
        self._poses = np.concatenate(poses)

    def ring(self, x_m: float, y_m: float, low_m: float, high_m: float) -> list[int]:
        """The numbers of the spots at a distance in [low_m, high_m)."""
        gap = self._poses[:, :2] - (x_m, y_m)
        inside = np.flatnonzero((gap * gap).sum(axis=1) <= high_m * high_m)
        near: list[int] = inside[np.hypot(*gap[inside].T) >= low_m].tolist()
        return near

    def __getitem__(self, number: int) -> EntrySpot:
        return EntrySpot(self._edges[number], float(self._shares[number]), Pose(*self._poses[number].tolist()))

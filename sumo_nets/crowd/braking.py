"""Braking of vehicles for a robot in their path.

SUMO's vehicles brake for people on crossings and on lanes, but not on corners and sidewalks that
their paths cross. Here every vehicle whose swept path passes too near to the robot gets a speed
with which it stops before it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import (
    Circle,
    Floats,
    Polyline,
    Pose,
    boxes_overlap,
    heading_from_sumo,
    hypot,
)
from sumo_nets.engine import NearVehicles, Sumo

MARGIN_M: Final = 0.3
"""Gap between a vehicle and the robot below which the vehicle stops, metres."""
STOP_SHORT_M: Final = 0.7
"""Additional distance at which a vehicle stops before the robot, metres."""
_BRAKES_MPS2: Final = 3.0
"""Deceleration of a vehicle that sees the robot in time, m/s2."""
_HARDEST_MPS2: Final = 9.0
"""Deceleration of a vehicle that sees the robot late, m/s2: SUMO's emergency braking."""
_NEAR_M: Final = 8.0
"""Distance from a vehicle's front in addition to its braking distance, metres: its length and the
robot's."""
_REACTION_S: Final = 1.0
_SWINGS_M: Final = 1.0
"""Largest distance of a vehicle's middle from its path in the tightest turns, metres."""
_AHEAD_M: Final = 60.0
"""Length of a path beyond the end of a vehicle's lane, metres."""
_SAMPLE_M: Final = 0.4
_ROUNDING_M: Final = 1e-6
"""Tolerance for rounding, metres."""
_ROUND_M: Final = 5.0
"""A vehicle's front is searched on its path within this distance of SUMO's position, metres."""
_BOUND: Final = 31
"""SUMO's default speed mode: all its rules hold."""
_BOUND_BUT_BRAKES: Final = 27
"""The same speed mode without SUMO's limit of the deceleration."""


class _Path(NamedTuple):
    """Path of a vehicle from the start of its lane.

    clear: where the robot is far from it.
    """

    lane: str
    line: Polyline
    clear: Circle


class BrakingForRobot:
    """Vehicles' view of the robot.

    half_m: half length and half width of the robot, metres.
    size_m: returns length and width of a vehicle by its name, metres.
    tick_s: duration of a SUMO step, seconds.
    """

    def __init__(
        self,
        engine: Sumo,
        half_m: tuple[float, float],
        size_m: Callable[[str], tuple[float, float]],
        tick_s: float,
    ) -> None:
        self._engine = engine
        self._half = np.array(half_m)
        self._size_m = size_m
        self._tick_s = tick_s
        self._reach_m = math.hypot(*half_m) + MARGIN_M + _SWINGS_M
        self._paths: dict[str, _Path] = {}
        self._held: set[str] = set()
        self._lines: dict[str, Floats] = {}
        self._onward: dict[str, list[tuple[str, str]]] = {}

    def update(self, near: NearVehicles, robot: Pose | None) -> None:
        """Set the speeds of vehicles for the next step. Required before every step.

        near: the vehicles in the simulation near the robot.
        robot: its pose; None without a robot.
        """
        slow: set[str] = set()
        if robot is not None:
            for row in _approaching(near, robot):
                name = near.names[row]
                way_m = self._free_m(name, near, row, robot)
                if way_m is not None and self._hold(name, float(near.mps[row]), way_m):
                    slow.add(name)
        for name in sorted(self._held - slow):
            if name in near.names:
                self._engine.vehicle.setSpeed(name, -1.0)
                self._engine.vehicle.setSpeedMode(name, _BOUND)
        self._held = slow
        if len(self._paths) > 2 * len(near.names):
            self._paths = {name: path for name, path in self._paths.items() if name in near.names}

    def _hold(self, name: str, mps: float, way_m: float) -> bool:
        """Limit a vehicle's speed so that it stops within a distance. Returns whether that is
        necessary yet."""
        step_mps = _BRAKES_MPS2 * self._tick_s
        most_mps = math.sqrt(step_mps * step_mps + 2.0 * _BRAKES_MPS2 * way_m) - step_mps
        if most_mps > mps + step_mps:
            return False
        if name not in self._held:
            self._engine.vehicle.setSpeedMode(name, _BOUND_BUT_BRAKES)
        self._engine.vehicle.setSpeed(name, max(most_mps, mps - _HARDEST_MPS2 * self._tick_s, 0.0))
        return True

    def _free_m(self, name: str, near: NearVehicles, row: int, robot: Pose) -> float | None:
        """Return the distance in metres that a vehicle may drive on; None if the robot is not in
        its path."""
        lane = self._engine.vehicle.getLaneID(name)
        path = self._paths.get(name)
        if path is not None and path.lane == lane and path.clear.holds(*robot[:2]):
            return None
        length_m, width_m = self._size_m(name)
        heading = heading_from_sumo(float(near.angle_deg[row]))
        ahead = np.array([math.cos(heading), math.sin(heading)])
        front: Floats = near.xy[row]
        back = front - length_m * ahead
        if path is None or path.lane != lane:
            path = _Path(lane, self._line(name, lane), Circle())
        far_m = min(abs(path.line.project(*robot[:2])[1]), math.hypot(*(back - robot[:2]).tolist()))
        clear_m = far_m - self._reach_m - width_m / 2.0
        clear = Circle(*robot[:2], clear_m) if clear_m > 0.0 else Circle()
        self._paths[name] = path._replace(clear=clear)
        if clear_m > 0.0:
            return None
        boxes = self._swept(name, path, back, front)
        half = np.array([length_m / 2.0, width_m / 2.0])
        for margin_m, short_m in ((MARGIN_M, STOP_SHORT_M), (0.0, 0.0)):
            hit = boxes_overlap(np.array(robot), self._half + margin_m, boxes, half)
            if not hit.any():
                return None
            if not hit[0]:
                return max((int(hit.argmax()) - 1) * _SAMPLE_M - short_m, 0.0)
        return 0.0

    def _swept(self, name: str, path: _Path, back: Floats, front: Floats) -> Floats:
        """Return the boxes (K, 3) of a vehicle along its path, the first one now."""
        vehicle, line = self._engine.vehicle, path.line
        lane_m = self._engine.lane.getLength(path.lane)
        shape_m = float(_length_m(self._lines[path.lane]))
        at_m = vehicle.getLanePosition(name) * shape_m / max(lane_m, 1e-6)
        x_m, y_m = front.tolist()
        s_m, _ = line.project(x_m, y_m, (at_m - _ROUND_M, at_m + _ROUND_M))
        points = np.concatenate([[back, front], line.points[line.s_m > s_m + 1e-6]])
        steps = np.hypot(*np.diff(points, axis=0).T)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        length_m = along[1]
        fronts = np.arange(length_m, min(along[-1], length_m + _AHEAD_M), _SAMPLE_M)
        tips = np.column_stack([np.interp(fronts, along, points[:, k]) for k in (0, 1)])
        tails = np.column_stack([np.interp(fronts - length_m, along, points[:, k]) for k in (0, 1)])
        heading = np.arctan2(tips[:, 1] - tails[:, 1], tips[:, 0] - tails[:, 0])
        ahead = np.column_stack([np.cos(heading), np.sin(heading)])
        return np.column_stack([tips - 0.5 * length_m * ahead, heading])

    def _line(self, name: str, lane: str) -> Polyline:
        """Return the path of a vehicle from the start of its lane, along its route."""
        route = self._engine.vehicle.getRoute(name)
        at = self._engine.vehicle.getRouteIndex(name)
        lines = [self._line_of(lane)]
        left_m = _AHEAD_M
        while left_m > 0.0:
            onward = self._links(lane)
            if lane[0] != ":":
                following = route[at + 1] if at + 1 < len(route) else ""
                onward = [link for link in onward if link[0] == following]
            if not onward:
                break
            lane = onward[0][1]
            at += lane[0] != ":"
            lines.append(self._line_of(lane))
            left_m -= float(_length_m(lines[-1]))
        return Polyline(np.concatenate(lines))

    def _links(self, lane: str) -> list[tuple[str, str]]:
        """Return the edge and the next lane of each link of a lane."""
        if lane not in self._onward:
            self._onward[lane] = [
                (to.rsplit("_", 1)[0], via or to)
                for to, _, _, _, via, *_ in self._engine.lane.getLinks(lane)
            ]
        return self._onward[lane]

    def _line_of(self, lane: str) -> Floats:
        if lane not in self._lines:
            shape = self._engine.lane.getShape(lane)
            self._lines[lane] = np.array([point[:2] for point in shape], dtype=float)
        return self._lines[lane]


def _approaching(near: NearVehicles, robot: Pose) -> list[int]:
    """Return the rows of the vehicles whose braking distance reaches a robot."""
    x_m, y_m, _ = robot
    moved_m = math.hypot(x_m - near.from_xy[0], y_m - near.from_xy[1]) + _ROUNDING_M
    rows = []
    for row, (away_m, mps) in enumerate(zip(near.away_m.tolist(), near.mps.tolist(), strict=True)):
        reach_m = _NEAR_M + mps * (_REACTION_S + mps / (2.0 * _BRAKES_MPS2))
        if away_m < reach_m + moved_m:
            at_x, at_y = near.xy[row].tolist()
            if hypot(at_x - x_m, at_y - y_m) < reach_m:
                rows.append(row)
    return rows


def _length_m(line: Floats) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())

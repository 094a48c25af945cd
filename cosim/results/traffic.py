"""Monitor of the robot among vehicles: time on the carriageway and vehicles that brake.

- carriageway: the base centre is on a road outside the crossings, or on a crossing at red, between
  the ends of its line. The strip that joins a crossing to its kerb is no road, nor is a sidewalk or
  corner that overlaps a lane. The inside of a junction is road.
- braked: a vehicle slows down by more than BRAKING_MPS2 while the robot, without right of way, is
  the nearest body straight ahead of it. It counts once until the vehicle has not braked for
  _APART_S. At a green crossing vehicles stop for their own red light or for pedestrians, so nothing
  is counted.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import shapely

from cosim.core.geometry import Circle, Floats, Pose
from cosim.core.state import PERSON_RADIUS_M, Street
from cosim.episode.loop import Step
from cosim.place import overlay
from cosim.place.street_map import StreetMap, Strip

BRAKING_MPS2: Final = 2.0
"""Deceleration above which a vehicle counts as braking."""
_AHEAD_M: Final = 40.0
IN_WAY_MARGIN_M: Final = 1.0
"""Margin, metres, added to half a vehicle's width: bodies within it block the vehicle."""

_APART_S: Final = 2.0
_ROUNDING_M: Final = 1e-6


class RoadState(NamedTuple):
    """State of the robot on the road in one tick.

    carriageway: see the module
    braked: number of vehicles that began to brake for the robot
    """

    carriageway: bool = False
    braked: int = 0


class TrafficMonitor:
    """Monitor of the Steps of one episode, called in order."""

    def __init__(self, street_map: StreetMap, tick_s: float) -> None:
        self._map = street_map
        self._tick_s = tick_s
        self._last: dict[str, int] = {}
        self._off_road_here: shapely.Geometry | None = None
        self._inside = Circle()
        self._off_road_parts: dict[str, shapely.Geometry] = {}

    def update(self, step: Step) -> RoadState:
        """Process one tick."""
        pose = step.motion.robot.pose
        if self._inside.holds(pose.x_m, pose.y_m):
            return RoadState()
        if self._off_road_here is not None and shapely.contains_xy(
            self._off_road_here, pose.x_m, pose.y_m
        ):
            room_m = shapely.distance(
                shapely.boundary(self._off_road_here), shapely.Point(pose.x_m, pose.y_m)
            )
            self._inside = Circle(pose.x_m, pose.y_m, max(float(room_m) - _ROUNDING_M, 0.0))
            return RoadState()
        place = self._map.locate(pose.x_m, pose.y_m, 0.0)
        self._off_road_here = self._off_road_part(place.edge) if place.kind == "walk" else None
        strip = self._map.strips.get(place.edge) if place.kind == "walk" else None
        crossing = strip is not None and strip.kind == "crossing"
        signal = step.street.signals.get(place.edge) if crossing else None
        inside = place.kind == "off" and bool(
            self._map.near("junction", shapely.Point(pose.x_m, pose.y_m))
        )
        at_red = (
            strip is not None
            and signal is not None
            and not signal.walk
            and projects_onto_strip(strip, pose)
        )
        carriageway = place.kind == "road" or inside or at_red
        if not carriageway and (not crossing or signal is not None):
            return RoadState()
        names = vehicles_braking_for(pose, step.street, step.street_after, self._tick_s)
        new = [
            name
            for name in names
            if (step.tick - self._last.get(name, -(10**9))) * self._tick_s > _APART_S
        ]
        self._last |= dict.fromkeys(names, step.tick)
        return RoadState(carriageway, len(new))

    def _off_road_part(self, edge: str) -> shapely.Geometry | None:
        """Return the part of a walkable piece that is never road; None for a crossing.

        This is all of a corner, and a sidewalk without the crossings that overlap it.
        """
        strip = self._map.strips.get(edge)
        if strip is not None and strip.kind == "crossing":
            return None
        if edge not in self._off_road_parts:
            piece: shapely.Geometry = (
                strip.polygon if strip is not None else self._map.corners[edge].polygon
            )
            if strip is not None:
                others = [s for s in self._map.near("strip", piece) if isinstance(s, Strip)]
                crossings = [s.polygon for s in others if s.kind == "crossing"]
                piece = overlay.difference(piece, overlay.union_all(crossings))
            shapely.prepare(piece)
            self._off_road_parts[edge] = piece
        return self._off_road_parts[edge]


def projects_onto_strip(strip: Strip, pose: Pose) -> bool:
    """Return whether a pose projects onto a strip's line, not beyond its ends."""
    first = strip.line[0, :2]
    last = strip.line[-1, :2]
    along = last - first
    return bool(0.0 < (pose.xy - first) @ along < along @ along)


def vehicles_braking_for(robot: Pose, before: Street, after: Street, tick_s: float) -> list[str]:
    """Return ids of the vehicles that brake in a tick with the robot nearest straight ahead."""
    vehicles = after.vehicles
    speed_mps = dict(zip(before.vehicles.ids, before.vehicles.speed.tolist(), strict=True))
    found = []
    for k, name in enumerate(vehicles.ids):
        if (speed_mps.get(name, 0.0) - float(vehicles.speed[k])) / tick_s <= BRAKING_MPS2:
            continue
        others = np.concatenate([after.people.xy, np.delete(vehicles.xy, k, axis=0)])
        front = _ahead_m(
            vehicles.xy[k], float(vehicles.heading[k]), vehicles.size[k], robot.xy[None]
        )[0]
        if front < _AHEAD_M and front <= _ahead_m(
            vehicles.xy[k], float(vehicles.heading[k]), vehicles.size[k], others
        ).min(initial=math.inf):
            found.append(name)
    return found


def _ahead_m(xy: Floats, heading_rad: float, size_m: Floats, points: Floats) -> Floats:
    """Return (N,) distances, metres, from a vehicle's bumper to bodies at (N, 2); inf if not in its
    way."""
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    dx, dy = (points - xy).T
    along = cos * dx + sin * dy - 0.5 * size_m[0]
    in_way = (np.abs(cos * dy - sin * dx) < 0.5 * size_m[1] + IN_WAY_MARGIN_M) & (
        along > -PERSON_RADIUS_M
    )
    return np.where(in_way, along, math.inf)

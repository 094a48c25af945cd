"""The robot among vehicles: whether it is on the carriageway without right, and which vehicles it
makes brake.

- carriageway: the base centre is on a road outside the crossings, or on a crossing whose signal
  says stop, between the ends of its line: what closes the seam before its kerb is no road. Nor is a
  sidewalk or corner that reaches over a lane; the inside of a junction is.
- braked: a vehicle slows down by more than BRAKES_MPS2 while the robot, on the carriageway or on a
  crossing that gives it no green, is the nearest body in the vehicle's straight way. Once per
  vehicle until it has not done so for APART_S. At a green crossing vehicles stop for their own red
  light or for whoever walks: that is not counted.
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

BRAKES_MPS2: Final = 2.0
_AHEAD_M: Final = 40.0
ASIDE_M: Final = 1.0
"""Within half the vehicle's width and this of its middle line somebody is in its way."""

_APART_S: Final = 2.0
_ROUNDING_M: Final = 1e-6


class OnRoad(NamedTuple):
    """carriageway: see above; braked: number of vehicles that the robot has begun to make brake in
    this tick."""

    carriageway: bool = False
    braked: int = 0


class TrafficMonitor:
    """Judges the Steps of one episode, in order."""

    def __init__(self, street_map: StreetMap, tick_s: float) -> None:
        self._map = street_map
        self._tick_s = tick_s
        self._last: dict[str, int] = {}
        self._here: shapely.Geometry | None = None
        self._inside = Circle()
        self._beside: dict[str, shapely.Geometry] = {}

    def see(self, step: Step) -> OnRoad:
        """What a tick did."""
        pose = step.motion.robot.pose
        if self._inside.holds(pose.x_m, pose.y_m):
            return OnRoad()
        if self._here is not None and shapely.contains_xy(self._here, pose.x_m, pose.y_m):
            room_m = shapely.distance(
                shapely.boundary(self._here), shapely.Point(pose.x_m, pose.y_m)
            )
            self._inside = Circle(pose.x_m, pose.y_m, max(float(room_m) - _ROUNDING_M, 0.0))
            return OnRoad()
        place = self._map.locate(pose.x_m, pose.y_m, 0.0)
        self._here = self._beside_the_road(place.edge) if place.kind == "walk" else None
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
            and between_its_ends(strip, pose)
        )
        carriageway = place.kind == "road" or inside or at_red
        if not carriageway and (not crossing or signal is not None):
            return OnRoad()
        names = braking_for(pose, step.street, step.street_after, self._tick_s)
        new = [
            name
            for name in names
            if (step.tick - self._last.get(name, -(10**9))) * self._tick_s > _APART_S
        ]
        self._last |= dict.fromkeys(names, step.tick)
        return OnRoad(carriageway, len(new))

    def _beside_the_road(self, edge: str) -> shapely.Geometry | None:
        """The part of a walkable piece that is beside the road whatever its signals show: all of a
        corner, and a sidewalk less the crossings that reach into it. None for a crossing."""
        strip = self._map.strips.get(edge)
        if strip is not None and strip.kind == "crossing":
            return None
        if edge not in self._beside:
            piece: shapely.Geometry = (
                strip.polygon if strip is not None else self._map.corners[edge].polygon
            )
            if strip is not None:
                others = [s for s in self._map.near("strip", piece) if isinstance(s, Strip)]
                crossings = [s.polygon for s in others if s.kind == "crossing"]
                piece = overlay.difference(piece, overlay.union_all(crossings))
            shapely.prepare(piece)
            self._beside[edge] = piece
        return self._beside[edge]


def between_its_ends(strip: Strip, pose: Pose) -> bool:
    """Whether a point of a strip lies beside its line, and not beyond one of its ends."""
    first = strip.line[0, :2]
    last = strip.line[-1, :2]
    along = last - first
    return bool(0.0 < (pose.xy - first) @ along < along @ along)


def braking_for(robot: Pose, before: Street, after: Street, tick_s: float) -> list[str]:
    """Ids of the vehicles that brake in a tick and have the robot next in their straight way."""
    vehicles = after.vehicles
    speed_mps = dict(zip(before.vehicles.ids, before.vehicles.speed.tolist(), strict=True))
    found = []
    for k, name in enumerate(vehicles.ids):
        if (speed_mps.get(name, 0.0) - float(vehicles.speed[k])) / tick_s <= BRAKES_MPS2:
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
    """(N,) metres from a vehicle's bumper to bodies at (N, 2) points in its way; inf for those that
    are not."""
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    dx, dy = (points - xy).T
    along = cos * dx + sin * dy - 0.5 * size_m[0]
    in_way = (np.abs(cos * dy - sin * dx) < 0.5 * size_m[1] + ASIDE_M) & (along > -PERSON_RADIUS_M)
    return np.where(in_way, along, math.inf)

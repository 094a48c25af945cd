"""The rolling crowd: persons and vehicles kept around the robot, wherever in the city it goes.

They enter out of its sight and are taken out once they are far from it, so a step costs the same in any city. Each
kind draws from its own generator; ids are "c<n>" and "v<n>".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from cosim.geometry import Floats, Polyline, Pose, heading_to_sumo
from cosim.scenario import CrowdSpec
from cosim.streetmap import Port, StreetMap
from cosim.walks import WalkGraph
from sumo_nets.proxy import END_M, KEEP_ROUTE, MATCH_M
from sumo_nets.room import Room

SIGHT_M = 35.0
"""Nobody appears nearer to the robot than this."""

CLEAR_M = 8.0
"""In the first fill, when nobody watches yet, nobody appears nearer than this."""

ENTER_M = 40.0
"""People enter in the outer part of the crowd's radius, so wide."""

LINGER_M = 20.0
"""How far beyond the crowd's radius a person may stray before it is taken out."""

STUCK_S = 60.0
"""A person that has waited this long, but not at a red light, is taken out."""

EDGE_M = 0.4
PERSON_MPS = (1.1, 1.65)
PERSONAL_SPACE_M = 1.5
WALK_EDGES = 30
BARRIER_MARGIN_M = 1.0
PERSONS_AT_ONCE = 8

VEHICLE_RING_M = (60.0, 220.0)
VEHICLE_FIRST_M = 25.0
VEHICLE_FAR_M = 120.0
VEHICLE_REACH_M = 250.0
VEHICLE_STUCK_S = 180.0
ROUTE_EDGES = 60
VEHICLES_AT_ONCE = 3

VEHICLE_TYPES: Mapping[str, tuple[float, float, float]] = {
    "small": (3.8, 1.7, 0.25),
    "car": (4.6, 1.8, 0.55),
    "van": (5.6, 2.0, 0.20),
}
"""Vehicle type -> length m, width m, share."""


class Seen(NamedTuple):
    """A person or vehicle near the robot: position (for vehicles of the front bumper) m, and seconds without moving."""

    x_m: float
    y_m: float
    waiting_s: float


class Spot(NamedTuple):
    """A place on the middle line of an edge, heading along it; share: of the edge's length that lies before it."""

    edge: str
    share: float
    pose: Pose


def shifted(pose: Pose, left_m: float) -> tuple[float, float]:
    """The point `left_m` to the left of a pose."""
    return pose.x_m - left_m * math.sin(pose.heading_rad), pose.y_m + left_m * math.cos(pose.heading_rad)


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
        self._tree = cKDTree(self._poses[:, :2])

    def ring(self, x_m: float, y_m: float, low_m: float, high_m: float) -> list[int]:
        """The numbers of the spots at a distance in [low_m, high_m)."""
        hits = np.array(self._tree.query_ball_point((x_m, y_m), high_m, return_sorted=True), dtype=np.intp)
        gap = self._poses[hits, :2] - (x_m, y_m)
        near: list[int] = hits[np.hypot(gap[:, 0], gap[:, 1]) >= low_m].tolist()
        return near

    def __getitem__(self, number: int) -> Spot:
        return Spot(self._edges[number], float(self._shares[number]), Pose(*self._poses[number].tolist()))


class Pedestrians:
    """The background persons."""

    def __init__(
        self, engine: Any, street_map: StreetMap, spec: CrowdSpec, rng: np.random.Generator, closed: frozenset[Port]
    ) -> None:
        self._engine, self._spec, self._rng, self._closed = engine, spec, rng, closed
        self._graph = WalkGraph(street_map)
        self._widths_m = {s.id: s.width_m for s in street_map.strips.values()}
        self._spots = Spots(
            (
                (s.id, s.line, self._margin_m(Port(s.id, 0)), self._margin_m(Port(s.id, 1)))
                for s in street_map.strips.values()
                if s.kind == "sidewalk"
            ),
            step_m=2.0,
        )
        self._count = 0
        self._room = Room(street_map, spec.radius_m)

    def fill(self, x_m: float, y_m: float) -> None:
        """Everybody at once, before the episode."""
        self._enter(self.wanted(x_m, y_m), x_m, y_m, CLEAR_M, {})

    def wanted(self, x_m: float, y_m: float) -> int:
        """How many persons there should be within the crowd's radius of a point."""
        if isinstance(self._spec.density, msgspec.UnsetType):
            return self._spec.persons
        return round(self._spec.density * self._room.area_m2(x_m, y_m) / 1000.0)

    def roll(self, x_m: float, y_m: float, seen: Mapping[str, Seen], at_red: Callable[[str], bool]) -> None:
        """Take out who is far away or stuck, let others in instead.

        seen: the persons within the crowd's radius and LINGER_M. at_red: whether a person waits at a red light.
        """
        person, radius_m = self._engine.person, self._spec.radius_m
        for name in sorted(person.getIDList()):
            if not name.startswith("c"):
                continue
            here = seen.get(name)
            if here is None or (here.waiting_s > STUCK_S and not at_red(name)):
                person.remove(name)
        away_m = {name: math.hypot(p.x_m - x_m, p.y_m - y_m) for name, p in seen.items()}
        inside = [name for name, far_m in away_m.items() if far_m < radius_m]
        low_m = min(max(SIGHT_M, radius_m - ENTER_M), radius_m - 10.0)
        missing = self.wanted(x_m, y_m) - len(inside)
        if not isinstance(self._spec.density, msgspec.UnsetType):
            far = sorted((name for name in inside if away_m[name] > low_m), key=lambda name: (-away_m[name], name))
            for name in far[: max(-missing, 0)]:
                if name in person.getIDList():
                    person.remove(name)
        self._enter(min(missing, PERSONS_AT_ONCE), x_m, y_m, low_m, seen)

    def _margin_m(self, port: Port) -> float:
        return self._widths_m[port.strip] + END_M + (BARRIER_MARGIN_M if port in self._closed else 0.0)

    def _enter(self, count: int, x_m: float, y_m: float, low_m: float, seen: Mapping[str, Seen]) -> None:
        if count <= 0 or not (ring := self._spots.ring(x_m, y_m, low_m, self._spec.radius_m)):
            return
        taken = [(p.x_m, p.y_m) for p in seen.values()]
        for _ in range(4 * count):
            spot = self._spots[ring[int(self._rng.integers(len(ring)))]]
            forward, speed_mps = bool(self._rng.random() < 0.5), float(self._rng.uniform(*PERSON_MPS))
            half_m = max(self._widths_m[spot.edge] / 2 - EDGE_M, 0.0)
            x, y = shifted(spot.pose, float(self._rng.uniform(-half_m, half_m)))
            if any(np.hypot(x - other_x, y - other_y) < PERSONAL_SPACE_M for other_x, other_y in taken):
                continue
            walk = self._graph.wander(self._rng, spot.edge, forward, WALK_EDGES, self._closed)
            if len(walk) == 1:
                continue
            self._add(spot, self._one_way(walk, forward), speed_mps, (x, y))
            taken.append((x, y))
            count -= 1
            if count == 0:
                return

    def _one_way(self, walk: list[str], forward: bool) -> list[str]:
        """A walk that SUMO takes in one direction only.

        From one sidewalk onto another between the same junctions SUMO may set out in either direction, and dies where
        the two do not meet: there the corner between them is named.
        """
        first, second = ({self._engine.edge.getFromJunction(e), self._engine.edge.getToJunction(e)} for e in walk[:2])
        corner = self._graph.street_map.strips[walk[0]].corners[1 if forward else 0]
        return walk if first != second or corner is None else [walk[0], corner, *walk[1:]]

    def _add(self, spot: Spot, walk: list[str], speed_mps: float, xy: tuple[float, float]) -> None:
        """SUMO lets everybody enter on the right edge of the way; the move spreads them over its width."""
        name = f"c{self._count}"
        self._count += 1
        first_m, last_m = (self._engine.lane.getLength(f"{edge}_0") for edge in (walk[0], walk[-1]))
        self._engine.person.add(name, spot.edge, spot.share * first_m)
        self._engine.person.appendWalkingStage(name, walk, last_m / 2, speed=speed_mps)
        self._engine.person.moveToXY(name, "", *xy, heading_to_sumo(spot.pose.heading_rad), KEEP_ROUTE, MATCH_M)


class Drivers:
    """The vehicles."""

    def __init__(self, engine: Any, street_map: StreetMap, spec: CrowdSpec, rng: np.random.Generator) -> None:
        self._engine, self._spec, self._rng = engine, spec, rng
        lanes = [lane for lane in street_map.lanes.values() if lane.kind == "road" and not lane.internal]
        self._lanes: dict[str, list[str]] = {}
        lines: dict[str, Floats] = {}
        for lane in lanes:
            allowed = engine.lane.getAllowed(lane.id)
            if not allowed or "passenger" in allowed:
                self._lanes.setdefault(lane.edge, []).append(lane.id)
                lines.setdefault(lane.edge, lane.line)
        self._spots = Spots(((edge, line, 8.0, 12.0) for edge, line in lines.items()), step_m=10.0)
        self._next: dict[str, tuple[str, ...]] = {}
        self._size: dict[str, tuple[float, float]] = {}
        self._count = 0
        for kind, (length_m, width_m, _) in VEHICLE_TYPES.items():
            engine.vehicletype.copy("DEFAULT_VEHTYPE", kind)
            engine.vehicletype.setLength(kind, length_m)
            engine.vehicletype.setWidth(kind, width_m)

    def size_m(self, name: str) -> tuple[float, float]:
        """Length and width of a vehicle in metres."""
        return self._size[name]

    def fill(self, x_m: float, y_m: float) -> None:
        """All at once, before the episode."""
        ring = self._spots.ring(x_m, y_m, VEHICLE_FIRST_M, VEHICLE_RING_M[1])
        for _ in range(self._spec.vehicles if ring else 0):
            self._enter(ring)

    def roll(self, x_m: float, y_m: float, seen: Mapping[str, Seen]) -> None:
        """Take out what is far away or stuck out of sight, let others in instead, far away when possible."""
        vehicle = self._engine.vehicle
        staying = 0
        for name in sorted(vehicle.getIDList()):
            here = seen.get(name)
            if here is None or (
                here.waiting_s > VEHICLE_STUCK_S and np.hypot(here.x_m - x_m, here.y_m - y_m) > VEHICLE_RING_M[0]
            ):
                vehicle.remove(name)
                self._size.pop(name)
            else:
                staying += 1
        missing = min(self._spec.vehicles - staying, VEHICLES_AT_ONCE)
        if missing > 0:
            ring = self._spots.ring(x_m, y_m, VEHICLE_FAR_M, VEHICLE_RING_M[1])
            ring = ring or self._spots.ring(x_m, y_m, *VEHICLE_RING_M)
            for _ in range(missing if ring else 0):
                self._enter(ring)

    def _enter(self, ring: list[int]) -> None:
        spot = self._spots[ring[int(self._rng.integers(len(ring)))]]
        route = self._route(spot.edge)
        kinds = list(VEHICLE_TYPES)
        kind = kinds[int(self._rng.choice(len(kinds), p=[share for _, _, share in VEHICLE_TYPES.values()]))]
        name = f"v{self._count}"
        self._count += 1
        position_m = spot.share * self._engine.lane.getLength(self._lanes[spot.edge][0])
        self._engine.route.add(name, route)
        self._engine.vehicle.add(name, name, typeID=kind, departLane="best", departPos=f"{position_m:.2f}")
        self._size[name] = VEHICLE_TYPES[kind][:2]

    def _route(self, edge: str) -> list[str]:
        route = [edge]
        while len(route) < ROUTE_EDGES and (choices := self._onward(route[-1])):
            route.append(choices[int(self._rng.integers(len(choices)))])
        return route

    def _onward(self, edge: str) -> tuple[str, ...]:
        """The edges a car can go on to; a turn back only where there is nothing else."""
        if edge not in self._next:
            onward: dict[str, bool] = {}
            for lane in self._lanes[edge]:
                for to, *_, turn, _ in self._engine.lane.getLinks(lane):
                    to_edge = to.rsplit("_", 1)[0]
                    if to in self._lanes.get(to_edge, ()):
                        onward[to_edge] = turn in "tT" and onward.get(to_edge, True)
            ahead = tuple(to for to, back in sorted(onward.items()) if not back)
            self._next[edge] = ahead or tuple(sorted(onward))
        return self._next[edge]

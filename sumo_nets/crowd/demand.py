"""Demand: entries and exits of persons and vehicles around the robot, random or replayed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from itertools import groupby
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats, heading_to_sumo
from cosim.core.state import Age
from cosim.place.street_map import Port, StreetMap
from cosim.place.walk_graph import walk_graph_of
from cosim.spec.scenario import CrowdSpec
from cosim.spec.weather import CLEAR, WEATHERS, Weather
from sumo_nets.crowd.demand_log import Entrances, PersonEntry, VehicleEntry
from sumo_nets.crowd.following_gaps import FollowingGaps
from sumo_nets.crowd.free_space import EntrySpot, LocalWalkableArea, Ring, Spots
from sumo_nets.crowd.group_cohesion import GroupCohesion
from sumo_nets.crowd.group_sampling import GROUP_STRIPE_M, GroupDraws
from sumo_nets.crowd.proxy import ROUND_THE_CORNER_M
from sumo_nets.engine import Sumo

SIGHT_M = 35.0
"""Smallest distance from the robot at which a person enters, metres."""
FIRST_FILL_CLEAR_M = 8.0
"""Smallest distance from the robot in the first fill, before the episode starts, metres."""
ENTER_M = 40.0
"""Width of the outer part of the crowd's radius in which people enter, metres."""
LEAVE_MARGIN_M = 20.0
"""Distance beyond the crowd's radius at which a person is removed, metres."""
STUCK_S = 60.0
"""A person that has waited longer, except at a red light, is removed, seconds."""
_EDGE_M = 0.4
"""Distance of entering persons from the edge of the sidewalk, metres."""
_PERSONAL_SPACE_M = 1.5
"""Smallest distance of an entering person from others, metres."""
_WALK_EDGES = 30
"""Number of edges of a random walk."""
_END_SHARES: Final[Mapping[int | None, float]] = {None: 0.5, 0: 0.01, 1: 0.99}
"""Share of the last edge's length at which a walk ends, by the dead end of that edge."""
BARRIER_MARGIN_M = 1.0
"""Additional distance of entries from a closed port, metres."""
PERSONS_AT_ONCE = 8
"""Largest number of persons that enter in one update."""
VEHICLE_RING_M = (60.0, 220.0)
"""Range of distances from the robot at which vehicles enter, metres."""
VEHICLE_FIRST_M = 25.0
"""Smallest distance from the robot in the first fill, metres."""
VEHICLE_FAR_M = 120.0
"""Preferred smallest distance of later entries, metres."""
VEHICLE_REACH_M = 250.0
"""Distance at which a vehicle is removed, metres."""
VEHICLE_STUCK_S = 180.0
"""A vehicle outside of VEHICLE_RING_M that has waited longer is removed, seconds."""
ROUTE_EDGES = 60
"""Largest number of edges of a vehicle's route."""
VEHICLES_AT_ONCE = 3
"""Largest number of vehicles that enter in one update."""
VEHICLE_TYPES: Mapping[str, tuple[float, float, float]] = {
    "small": (3.8, 1.7, 0.25),
    "car": (4.6, 1.8, 0.55),
    "van": (5.6, 2.0, 0.20),
}
"""Length in metres, width in metres and share of each vehicle type."""


class Seen(NamedTuple):
    """Position of a person (middle) or vehicle (front bumper), metres in the net's frame, with its
    waiting time in seconds."""

    x_m: float
    y_m: float
    waiting_s: float


class Pedestrians:
    """The background pedestrians. ages: ages of all persons that ever entered, by name."""

    def __init__(
        self,
        engine: Sumo,
        entrances: Entrances,
        street_map: StreetMap,
        spec: CrowdSpec,
        rng: np.random.Generator,
        closed: frozenset[Port],
        cohesion: GroupCohesion,
        gaps: FollowingGaps,
        weather: Weather = WEATHERS[CLEAR],
    ) -> None:
        self._engine = engine
        self._entrances = entrances
        self._spec = spec
        self._rng = rng
        self._closed = closed
        self._cohesion = cohesion
        self._gaps = gaps
        self._hurry = weather.hurry
        self.ages = entrances.ages
        self._graph = walk_graph_of(street_map)
        self._widths_m = {s.id: s.width_m for s in street_map.strips.values()}
        self._spots = Spots(
            (
                (s.id, s.line, self._margin_m(Port(s.id, 0)), self._margin_m(Port(s.id, 1)))
                for s in street_map.strips.values()
                if s.kind == "sidewalk" and s.id not in street_map.uncrowded
            ),
            step_m=2.0,
        )
        self._edge_spots = Spots(_at_edge(street_map) if street_map.scanned else (), step_m=2.0)
        self._room = None if spec.density is None else LocalWalkableArea(street_map, spec.radius_m)
        rng_groups, self._rng_gaps = rng.spawn(2)
        self._groups = GroupDraws(spec, rng_groups, weather.children)

    def fill(self, x_m: float, y_m: float) -> None:
        """Let all persons enter before the episode."""
        self._enter(self.wanted(x_m, y_m), x_m, y_m, FIRST_FILL_CLEAR_M, {})

    def wanted(self, x_m: float, y_m: float) -> int:
        """Return the target number of persons within the crowd's radius of a point."""
        if self._room is None or self._spec.density is None:
            return self._spec.persons
        return round(self._spec.density * self._room.area_m2(x_m, y_m) / 1000.0)

    def update(
        self, x_m: float, y_m: float, seen: Mapping[str, Seen], at_red: Callable[[str], bool]
    ) -> None:
        """Remove persons that are far away or stuck, with their groups; let others enter; keep
        groups together.

        seen: persons within the crowd's radius plus LEAVE_MARGIN_M.
        at_red: returns whether a person waits at a red light.
        """
        person, radius_m = self._engine.person, self._spec.radius_m
        fellows = self._cohesion.group_of
        here = self.ages.keys() & set(person.getIDList())
        present = sorted(here)
        self._cohesion.remove_absent(present)
        for name in present:
            one = seen.get(name)
            if one is not None and one.waiting_s <= STUCK_S:
                continue
            if name in here and (
                one is None or not any(at_red(fellow) for fellow in fellows(name))
            ):
                self._remove(name, here)
        hypot = math.hypot
        away_m = {name: hypot(x - x_m, y - y_m) for name, (x, y, _) in seen.items()}
        inside = [name for name, far_m in away_m.items() if far_m < radius_m]
        low_m = min(max(SIGHT_M, radius_m - ENTER_M), radius_m - 10.0)
        missing = self.wanted(x_m, y_m) - len(inside)
        if self._spec.density is not None:
            far = sorted(
                (name for name in inside if away_m[name] > low_m),
                key=lambda name: (-away_m[name], name),
            )
            spare = -missing - (0 if self._groups.plain else 1)
            for name in far:
                if len(fellows(name)) <= spare:
                    spare -= len(fellows(name))
                    self._remove(name, here)
        self._cohesion.update(seen)
        self._enter(min(missing, PERSONS_AT_ONCE), x_m, y_m, low_m, seen)

    def _remove(self, name: str, here: set[str]) -> None:
        """Remove a person with its group.

        here: persons in the simulation; it is updated.
        """
        if name in here:
            for fellow in self._cohesion.dissolve(name):
                self._entrances.people[self._engine.simulation.getTime()].append(fellow)
                self._engine.person.remove(fellow)
                here.discard(fellow)

    def _margin_m(self, port: Port) -> float:
        return (
            self._widths_m[port.strip]
            + ROUND_THE_CORNER_M
            + (BARRIER_MARGIN_M if port in self._closed else 0.0)
        )

    def _enter(
        self, count: int, x_m: float, y_m: float, low_m: float, seen: Mapping[str, Seen]
    ) -> None:
        if count <= 0 or 2 * count < self._groups.coming.size:
            return
        ring, at_edge = self._rings(x_m, y_m, low_m)
        spots = len(ring) + len(at_edge)
        if not spots:
            return
        taken = np.array([(p.x_m, p.y_m) for p in seen.values()], dtype=float).reshape(-1, 2)
        for _ in range(4 * count):
            group = self._groups.coming
            if 2 * count < group.size:
                return
            pick = int(self._rng.integers(spots))
            spot = ring[pick] if pick < len(ring) else at_edge[pick - len(ring)]
            forward = bool(self._rng.random() < 0.5)
            drawn_mps = float(self._rng.uniform(*group.pace_mps))
            width_m = self._widths_m[spot.edge]
            half_m = max(
                width_m / 2 - _EDGE_M - (group.abreast(width_m) - 1) * GROUP_STRIPE_M / 2, 0.0
            )
            middle_m = float(self._rng.uniform(-half_m, half_m))
            back = -1.0 if forward else 1.0
            places = [
                spot.beside(middle_m + left_m, back * row_m)
                for left_m, row_m in group.places(width_m)
            ]
            gap = np.array(places)[:, None] - taken
            if (np.hypot(gap[..., 0], gap[..., 1]) < _PERSONAL_SPACE_M).any():
                continue
            walk = self._graph.wander(self._rng, spot.edge, forward, _WALK_EDGES, self._closed)
            if len(walk) == 1:
                continue
            walk = self._one_way(walk, forward)
            speed_mps = self._hurry * group.speed_at(drawn_mps)
            names = [self._name(age) for age in group.ages]
            gaps_m = group.gaps_m(self._rng_gaps)
            for name, xy, gap_m in zip(names, places, gaps_m, strict=True):
                self._add(name, spot, walk, speed_mps, xy, gap_m)
            self._cohesion.form(names, speed_mps, walk)
            self._groups.entered()
            taken = np.concatenate([taken, places])
            count -= group.size
            if count <= 0:
                return

    def _rings(self, x_m: float, y_m: float, low_m: float) -> tuple[Ring, Ring]:
        """Return the spots where persons may enter; those at the edge of a scan may be in sight."""
        ring = self._spots.ring(x_m, y_m, low_m, self._spec.radius_m)
        return ring, self._edge_spots.ring(x_m, y_m, FIRST_FILL_CLEAR_M, low_m)

    def _one_way(self, walk: list[str], forward: bool) -> list[str]:
        """Return a walk with a unique direction for SUMO.

        Between two sidewalks that join the same two junctions SUMO may start in either direction,
        and aborts where they do not meet. There the corner between them is added to the walk.
        """
        first, second = (
            {self._engine.edge.getFromJunction(e), self._engine.edge.getToJunction(e)}
            for e in walk[:2]
        )
        corner = self._graph.street_map.strips[walk[0]].corners[1 if forward else 0]
        return walk if first != second or corner is None else [walk[0], corner, *walk[1:]]

    def _name(self, age: Age) -> str:
        """Return a new name and store the person's age under it."""
        name = f"c{len(self.ages)}"
        self.ages[name] = age
        return name

    def _add(
        self,
        name: str,
        spot: EntrySpot,
        walk: list[str],
        speed_mps: float,
        xy: tuple[float, float],
        gap_m: float,
    ) -> None:
        first_m, last_m = (self._engine.lane.getLength(f"{edge}_0") for edge in (walk[0], walk[-1]))
        until_m = _END_SHARES[self._dead_end(walk[-1])] * last_m
        angle_deg = heading_to_sumo(spot.pose.heading_rad)
        entry = PersonEntry(
            name,
            spot.edge,
            spot.share * first_m,
            tuple(walk),
            until_m,
            speed_mps,
            xy,
            angle_deg,
            gap_m,
        )
        self._entrances.people[self._engine.simulation.getTime()].append(entry)
        self._let_in(entry)

    def _let_in(self, entry: PersonEntry) -> None:
        entry.enter(self._engine)
        self._gaps.enter(entry.name, entry.gap_m)

    def _dead_end(self, edge: str) -> int | None:
        """Return the end of a walk's last edge at the edge of a scan; None elsewhere."""
        strip = self._graph.street_map.strips.get(edge)
        if strip is None or not self._graph.street_map.scanned or None not in strip.corners:
            return None
        return strip.corners.index(None)


def _at_edge(street_map: StreetMap) -> Iterator[tuple[str, Floats, float, float]]:
    """Yield lines as for `Spots`, with a spot at each dead end."""
    for strip in street_map.strips.values():
        room_m = strip.length_m - 2.0 * _EDGE_M
        if strip.kind == "sidewalk" and strip.id not in street_map.uncrowded and room_m > _EDGE_M:
            if strip.corners[0] is None:
                yield strip.id, strip.line, _EDGE_M, room_m
            if strip.corners[1] is None:
                yield strip.id, strip.line, room_m, _EDGE_M


class Drivers:
    """The background vehicles."""

    def __init__(
        self,
        engine: Sumo,
        entrances: Entrances,
        street_map: StreetMap,
        spec: CrowdSpec,
        rng: np.random.Generator,
    ) -> None:
        self._engine = engine
        self._entrances = entrances
        self._spec = spec
        self._rng = rng
        lanes = [
            lane for lane in street_map.lanes.values() if lane.kind == "road" and not lane.internal
        ]
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
        """Return the length and width of a vehicle, metres."""
        return self._size[name]

    def fill(self, x_m: float, y_m: float) -> None:
        """Let all vehicles enter before the episode."""
        ring = self._spots.ring(x_m, y_m, VEHICLE_FIRST_M, VEHICLE_RING_M[1])
        for _ in range(self._spec.vehicles if ring else 0):
            self._enter(ring)

    def update(self, x_m: float, y_m: float, seen: Mapping[str, Seen]) -> None:
        """Remove vehicles that are far away, or stuck out of sight, and let others enter, if
        possible far away."""
        vehicle = self._engine.vehicle
        staying = 0
        for name in sorted(vehicle.getIDList()):
            here = seen.get(name)
            if here is None or (
                here.waiting_s > VEHICLE_STUCK_S
                and np.hypot(here.x_m - x_m, here.y_m - y_m) > VEHICLE_RING_M[0]
            ):
                self._entrances.vehicles[self._engine.simulation.getTime()].append(name)
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

    def _enter(self, ring: Ring) -> None:
        spot = ring[int(self._rng.integers(len(ring)))]
        route = self._route(spot.edge)
        kinds = list(VEHICLE_TYPES)
        kind = kinds[
            int(self._rng.choice(len(kinds), p=[share for _, _, share in VEHICLE_TYPES.values()]))
        ]
        name = f"v{self._count}"
        self._count += 1
        position_m = spot.share * self._engine.lane.getLength(self._lanes[spot.edge][0])
        entry = VehicleEntry(name, kind, tuple(route), position_m)
        self._entrances.vehicles[self._engine.simulation.getTime()].append(entry)
        entry.enter(self._engine)
        self._size[name] = VEHICLE_TYPES[kind][:2]

    def _route(self, edge: str) -> list[str]:
        route = [edge]
        while len(route) < ROUTE_EDGES and (choices := self._onward(route[-1])):
            route.append(choices[int(self._rng.integers(len(choices)))])
        return route

    def _onward(self, edge: str) -> tuple[str, ...]:
        """Return the edges that a car can continue on; a U-turn only at dead ends."""
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


def replayed_demand(
    engine: Sumo,
    recorded: Entrances,
    street_map: StreetMap,
    spec: CrowdSpec,
    closed: frozenset[Port],
    cohesion: GroupCohesion,
    gaps: FollowingGaps,
) -> tuple[ReplayedPedestrians, ReplayedDrivers]:
    """Return pedestrians and vehicles that repeat the entries and exits of `recorded` at the same
    times."""
    unused_rng = np.random.default_rng(0)
    people = ReplayedPedestrians(
        engine, recorded, street_map, spec, unused_rng, closed, cohesion, gaps
    )
    return people, ReplayedDrivers(engine, recorded, street_map, spec, unused_rng)


class ReplayedPedestrians(Pedestrians):
    """Pedestrians that repeat recorded entries and exits.

    Those who enter together with the same walk and speed form a group.
    """

    def fill(self, x_m: float, y_m: float) -> None:
        self._replay()

    def update(
        self, x_m: float, y_m: float, seen: Mapping[str, Seen], at_red: Callable[[str], bool]
    ) -> None:
        self._cohesion.remove_absent(self._engine.person.getIDList())
        self._cohesion.update(seen)
        self._replay()

    def _replay(self) -> None:
        here = set(self._engine.person.getIDList())
        entered = []
        for one in self._entrances.people.get(self._engine.simulation.getTime(), ()):
            if isinstance(one, PersonEntry):
                self._let_in(one)
                entered.append(one)
            elif one in here:
                self._engine.person.remove(one)
        for (walk, mps), group in groupby(entered, key=lambda one: (one.walk, one.mps)):
            self._cohesion.form([one.name for one in group], mps, walk)


class ReplayedDrivers(Drivers):
    """Vehicles that repeat recorded entries and exits."""

    def fill(self, x_m: float, y_m: float) -> None:
        self._replay()

    def update(self, x_m: float, y_m: float, seen: Mapping[str, Seen]) -> None:
        self._replay()

    def _replay(self) -> None:
        here = set(self._engine.vehicle.getIDList())
        for one in self._entrances.vehicles.get(self._engine.simulation.getTime(), ()):
            if not isinstance(one, str):
                one.enter(self._engine)
                self._size[one.name] = VEHICLE_TYPES[one.kind][:2]
            elif one in here:
                self._engine.vehicle.remove(one)

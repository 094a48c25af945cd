"""Tally: how people keep apart, keep out of things and keep to the lights; how vehicles do. Counted
tick by tick.

Everything is about what is shown: the people and vehicles of a `Street`, after every filter.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cosim.core.geometry import Floats, boxes_overlap
from cosim.core.state import DIRECTED, PERSON_RADIUS_M, People, PersonKind, Street, Vehicles
from cosim.place.street_map import StreetMap, Strip

if TYPE_CHECKING:
    from sumo_nets.crowd.stoplines import Passed

CONTACT_M: Final = 1.5
"""Two people whose centres are nearer than this are in contact range."""

OVERLAP_M: Final = 0.3
"""Two people whose centres are nearer than this stand in each other."""

ENTERING_S: Final = 3.0
"""So long after somebody has appeared it counts as entering."""

_NARROW_M: Final = 2.5
"""A sidewalk narrower than this counts as narrow."""

EVERY_TICKS: Final = 5
"""How often things, crossings and vehicles are looked at; pairs of people at every tick."""

INTO_M: Final = 1.0
"""Who is this far beyond the end of a crossing's line has entered it."""

GRACE_S: Final = 1.0
"""A slow walker who steps off at the end of green has INTO_M behind it this long after."""

ROLLING_MPS: Final = 0.5
NEAR_BOX_M: Final = 1.0


class Tally:
    """Counts of one place. `counts`: seconds of pairs, seconds of persons, numbers of entries, by
    name.

    things: what cannot be walked through, as (kind, ground). crossings: ids of the signalised ones
    that were entered. at_red: who and what went at red, when and where, in words. A light that is
    red when it comes into view has been red at least since then; who is on its crossing at that
    moment has not entered it.
    """

    def __init__(
        self,
        street_map: StreetMap,
        tick_s: float,
        things: Sequence[tuple[str, shapely.Geometry]] = (),
    ) -> None:
        self.counts: defaultdict[str, float] = defaultdict(float)
        self.crossings: set[str] = set()
        self.at_red: list[str] = []
        self._map = street_map
        self._tick_s = tick_s
        self._kinds = [kind for kind, _ in things]
        self._things = shapely.STRtree([ground for _, ground in things])
        self._tick = -1
        self._since: dict[str, int] = {}
        self._red_s: dict[str, float] = {}
        self._new: set[str] = set()
        self._on: set[str] = set()
        self._over: set[tuple[str, str]] = set()
        self._boxes: dict[str, tuple[Floats, Floats]] = {}

    def see(self, street: Street) -> None:
        """Take in the street of the next tick."""
        people = street.people
        self._since = {name: self._since.get(name, street.tick) for name in people.ids}
        self._pairs(street.tick, people)
        self._new = street.signals.keys() - self._red_s.keys()
        self._red_s = {
            crossing: 0.0 if signal.walk else self._red_s.get(crossing, 0.0) + self._tick_s
            for crossing, signal in street.signals.items()
        }
        if street.tick % EVERY_TICKS == 0 and len(people):
            self._penetrations(people, street.vehicles)
        self._signals(street)
        self._tick = street.tick

    def drove(self, passed: Iterable[Passed]) -> None:
        """Take in the vehicles that drove over stop lines in the last tick."""
        for one in passed:
            self.counts["vehicles passed stop lines"] += 1
            if one.light in "Gg":
                self.counts["vehicles passed at green"] += 1
            elif one.light in "yY":
                self.counts["vehicles passed at yellow"] += 1
            elif one.light == "r" and one.red_s > GRACE_S:
                self.counts["vehicles passed at red"] += 1
                self.at_red.append(f"{one.vehicle} at tick {self._tick}, red for {one.red_s:.2f} s")
            elif one.light == "r":
                self.counts["vehicles passed within a second of red"] += 1

    def _pairs(self, tick: int, people: People) -> None:
        if len(people) < 2:
            return
        pairs = cKDTree(people.xy).query_pairs(CONTACT_M, output_type="ndarray")
        gap = np.hypot(*(people.xy[pairs[:, 0]] - people.xy[pairs[:, 1]]).T)
        event = people.are(*DIRECTED)
        own = ~(event[pairs].all(axis=1)) if len(pairs) else np.zeros(0, dtype=bool)
        self.counts["pairs in contact range"] += float(own.sum()) * self._tick_s
        self.counts["pairs nearer than 0.6 m"] += (
            float((own & (gap < 2 * PERSON_RADIUS_M)).sum()) * self._tick_s
        )
        self.counts["pairs nearer than 0.45 m"] += float((own & (gap < 0.45)).sum()) * self._tick_s
        self.counts["event pairs nearer than 0.3 m"] += (
            float((~own & (gap < OVERLAP_M)).sum()) * self._tick_s
        )
        for i, j in pairs[own & (gap < OVERLAP_M)].tolist():
            self.counts["overlaps"] += self._tick_s
            self.counts[f"overlaps: {self._where(tick, people, i, j)}"] += self._tick_s

    def _where(self, tick: int, people: People, i: int, j: int) -> str:
        pair = people.kind[[i, j]]
        if np.isin(pair, DIRECTED).any():
            return "with an event pedestrian"
        if PersonKind.RESIDENT in pair:
            return "with a resident"
        if (
            tick - max(self._since[people.ids[i]], self._since[people.ids[j]])
        ) * self._tick_s < ENTERING_S:
            return "entering"
        x_m, y_m = (0.5 * (people.xy[i] + people.xy[j])).tolist()
        edge = self._map.locate(x_m, y_m).edge
        if edge in self._map.corners:
            return "on corners"
        strip = self._map.strips.get(edge)
        if strip is None:
            return "off the sidewalks"
        if strip.kind == "crossing":
            return "on crossings"
        return "on narrow sidewalks" if strip.width_m < _NARROW_M else "on sidewalks"

    def _penetrations(self, people: People, vehicles: Vehicles) -> None:
        seconds = self._tick_s * EVERY_TICKS
        self.counts["persons"] += len(people) * seconds
        points = np.atleast_1d(np.asarray(shapely.points(people.xy), dtype=object))
        off = [self._map.locate(x_m, y_m, 0.0).kind for x_m, y_m in people.xy.tolist()]
        self.counts["off the walkable area"] += (len(off) - off.count("walk")) * seconds
        who, what = self._things.query(points, predicate="within")
        for i, thing in zip(who.tolist(), what.tolist(), strict=True):
            self.counts[f"in a {self._kinds[thing]}"] += seconds
            place = self._map.strips.get(self._map.locate(*people.xy[i]).edge)
            if place is not None and place.kind == "sidewalk" and self._in_middle(place, points[i]):
                self.counts["in a thing in the clear band"] += seconds
        who, _ = self._things.query(points, predicate="dwithin", distance=0.15)
        self.counts["within 0.15 m of a thing"] += len(set(who.tolist())) * seconds
        if len(vehicles):
            gap = box_gaps(vehicles, people.xy)
            self.counts["in a vehicle"] += float((gap <= 0.0).any(axis=0).sum()) * seconds
            crowd = people.are(PersonKind.CROWD)
            moving = (gap <= 0.0) & (vehicles.speed[:, None] > ROLLING_MPS)
            self.counts["in a vehicle that moves"] += (
                float((moving.any(axis=0) & crowd).sum()) * seconds
            )

    @staticmethod
    def _in_middle(strip: Strip, point: shapely.Point) -> bool:
        return bool(shapely.distance(shapely.linestrings(strip.line[:, :2]), point) < 0.6)

    def _signals(self, street: Street) -> None:
        """Entries of people, tick by tick; vehicles on crossings at walk, now and then."""
        people, vehicles = street.people, street.vehicles
        crowd = people.are(PersonKind.CROWD)
        now: set[str] = set()
        over: set[tuple[str, str]] = set()
        looks = street.tick % EVERY_TICKS == 0
        for crossing, signal in street.signals.items():
            middle, half = self._box(crossing)
            inside = crowd & (point_gaps(middle, half - (INTO_M, 0.0), people.xy) <= 0.0)
            for i in np.flatnonzero(inside).tolist():
                name = people.ids[i]
                # Crossings of one junction may overlap: who walks on one of them does not enter
                # another.
                begins = (
                    name not in now and name not in self._on and street.tick > self._since[name]
                )
                if begins and crossing not in self._new:
                    self._entered(name, crossing, self._red_s[crossing], street.tick)
                now.add(name)
            if looks and signal.walk and len(vehicles):
                boxes = np.column_stack([vehicles.xy, vehicles.heading])
                hit = boxes_overlap(middle, half, boxes, vehicles.size / 2) & (
                    vehicles.speed > ROLLING_MPS
                )
                over |= {(crossing, vehicles.ids[k]) for k in np.flatnonzero(hit).tolist()}
                self._driven(crossing, hit, inside, street)
        self._on = now
        if looks:
            self._over = over

    def _entered(self, person: str, crossing: str, red_s: float, tick: int) -> None:
        self.crossings.add(crossing)
        self.counts["persons entered signalised crossings"] += 1
        if red_s > GRACE_S:
            self.counts["persons entered at red"] += 1
            self.at_red.append(f"{person} on {crossing} at tick {tick}, red for {red_s:.2f} s")
        elif red_s > 0.0:
            self.counts["persons entered within a second of red"] += 1

    def _driven(
        self, crossing: str, hit: NDArray[np.bool_], walking: NDArray[np.bool_], street: Street
    ) -> None:
        vehicles = street.vehicles
        for k in np.flatnonzero(hit).tolist():
            if (crossing, vehicles.ids[k]) not in self._over:
                self.counts["vehicles drove over a crossing at walk"] += 1
            on = street.people.xy[walking]
            if len(on) and box_gaps(vehicles, on)[k].min() < NEAR_BOX_M:
                self.counts["vehicles within 1 m of a walker on it"] += self._tick_s * EVERY_TICKS

    def _box(self, crossing: str) -> tuple[Floats, Floats]:
        """A crossing as a box: (3,) x, y, heading of its middle and (2,) half its length and
        width."""
        if crossing not in self._boxes:
            strip = self._map.strips[crossing]
            first = strip.line[0, :2]
            last = strip.line[-1, :2]
            along = last - first
            middle = np.array([*(0.5 * (first + last)), np.arctan2(along[1], along[0])])
            self._boxes[crossing] = middle, np.array([0.5 * np.hypot(*along), 0.5 * strip.width_m])
        return self._boxes[crossing]


def point_gaps(middle: Floats, half: Floats, xy: Floats) -> Floats:
    """(N,) distances of points from a box; 0 inside, and inf from a box without room."""
    if (half <= 0.0).any():
        return np.full(len(xy), np.inf)
    dx, dy = (xy - middle[:2]).T
    cos, sin = np.cos(middle[2]), np.sin(middle[2])
    ahead = np.abs(cos * dx + sin * dy) - half[0]
    aside = np.abs(cos * dy - sin * dx) - half[1]
    return np.asarray(np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0)))


def box_gaps(vehicles: Vehicles, xy: Floats) -> Floats:
    """(V, N) distances of points from the boxes of vehicles; 0 inside."""
    offset = xy[None] - vehicles.xy[:, None]
    cos, sin = np.cos(vehicles.heading)[:, None], np.sin(vehicles.heading)[:, None]
    ahead = np.abs(cos * offset[..., 0] + sin * offset[..., 1]) - 0.5 * vehicles.size[:, :1]
    aside = np.abs(cos * offset[..., 1] - sin * offset[..., 0]) - 0.5 * vehicles.size[:, 1:]
    return np.asarray(np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0)))

"""Signals: what the crosswalk signals near the robot show, and when that changes."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import numpy as np

from cosim.core.state import Signal
from cosim.place.street_map import SignalPlan, StreetMap

if TYPE_CHECKING:  # who shows planned lights does without SUMO
    from sumo_nets.engine import Sumo

import shapely

from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.street_map import Lane

_NEAR_M = 80.0
"""The signals of crossings within this distance of the robot are shown."""

RESELECT_M = 5.0
"""How far the robot moves before the near crossings are looked up again."""

_WALK = "Gg"

_MS: Final = 1000


class Showing(NamedTuple):
    """What a signal shows: whether one may walk, the time at which that changes, None for unknown
    or never, and the time until which this holds, in seconds of SUMO's time."""

    walk: bool
    change_s: float | None
    until_s: float


class Lights(Protocol):
    """Tells what signals show. crossings: those that have one."""

    crossings: Collection[str]

    def now_s(self) -> float:
        """SUMO's time."""

    def showing(self, crossing: str) -> Showing:
        """What a crossing's signal shows now."""


class Signals:
    """The signals of all crossings; their lights are asked once per switch."""

    def __init__(self, lights: Lights, street_map: StreetMap) -> None:
        self._lights = lights
        self._ids = sorted(lights.crossings)
        self._lit = frozenset(self._ids)
        middles = [street_map.strips[i].line.mean(axis=0) for i in self._ids]
        self._xy = np.array(middles, dtype=float).reshape(-1, 2)
        self._shown: dict[str, Showing] = {}
        self._centre: tuple[float, float] | None = None
        self._near: list[str] = []

    def near(self, x_m: float, y_m: float) -> Mapping[str, Signal]:
        """The signals within NEAR_M (up to RESELECT_M more or less) of a point, now."""
        if (
            self._centre is None
            or np.hypot(x_m - self._centre[0], y_m - self._centre[1]) > RESELECT_M
        ):
            self._centre = (x_m, y_m)
            gap = self._xy - (x_m, y_m)
            self._near = [
                self._ids[i] for i in np.flatnonzero((gap * gap).sum(axis=1) <= _NEAR_M * _NEAR_M)
            ]
        now_s = self._lights.now_s()
        signals = {}
        for crossing in self._near:
            walk, change_s, _ = self._state(crossing, now_s)
            signals[crossing] = Signal(
                walk, None if change_s is None else round(change_s - now_s, 3)
            )
        return MappingProxyType(signals)

    def red(self, crossings: Sequence[str]) -> list[int]:
        """The places in `crossings` of those that have a signal that forbids walking."""
        now_s = self._lights.now_s()
        return [
            i
            for i, one in enumerate(crossings)
            if one in self._lit and not self._state(one, now_s).walk
        ]

    def is_red(self, crossing: str) -> bool:
        """Whether a crossing has a signal and it forbids walking."""
        return bool(self.red([crossing]))

    def _state(self, crossing: str, now_s: float) -> Showing:
        shown = self._shown.get(crossing)
        if shown is None or now_s >= shown.until_s:
            self._shown[crossing] = shown = self._lights.showing(crossing)
        return shown


class PlannedLights:
    """The signals of a map whose plans tell all of them: what SUMO would show, without it. begin_s:
    when SUMO would have been started; `now_ms` is set to its time."""

    def __init__(self, street_map: StreetMap, begin_s: int) -> None:
        self._strips = street_map.strips
        self.crossings: Collection[str] = [
            strip.id for strip in self._strips.values() if strip.plan is not None
        ]
        self.now_ms = _MS * begin_s

    def now_s(self) -> float:
        return self.now_ms / _MS

    def showing(self, crossing: str) -> Showing:
        """SUMO switches within the step that begins with or before the moment of it, so that the
        moment itself still shows what was before."""
        plan: SignalPlan | None = self._strips[crossing].plan
        assert plan is not None, crossing
        ends_ms = list(itertools.accumulate(plan.durations_ms))
        last_ms = self.now_ms - 1
        since_ms = (last_ms - plan.offset_ms) % ends_ms[-1]
        now = next(k for k, end_ms in enumerate(ends_ms) if since_ms < end_ms)
        until_ms = change_ms = last_ms + ends_ms[now] - since_ms
        for k in range(now + 1, now + len(ends_ms)):
            if plan.walks[k % len(ends_ms)] != plan.walks[now]:
                return Showing(plan.walks[now], change_ms / _MS, until_ms / _MS)
            change_ms += plan.durations_ms[k % len(ends_ms)]
        return Showing(plan.walks[now], None, until_ms / _MS)


class SumoLights:
    """The signals that SUMO simulates; programs are read once."""

    def __init__(self, engine: Sumo, street_map: StreetMap) -> None:
        self._engine = engine
        self._link: dict[str, tuple[str, int]] = {}
        for light in sorted(engine.trafficlight.getIDList()):
            for index, links in enumerate(engine.trafficlight.getControlledLinks(light)):
                for _, to, _ in links:
                    edge = to.rsplit("_", 1)[0]
                    if edge in street_map.strips and street_map.strips[edge].kind == "crossing":
                        self._link.setdefault(edge, (light, index))
        self.crossings: Collection[str] = self._link.keys()
        self.now_s = engine.simulation.getTime
        self._phases: dict[str, tuple[tuple[float, str], ...] | None] = {}

    def showing(self, crossing: str) -> Showing:
        light, index = self._link[crossing]
        traffic_light = self._engine.trafficlight
        next_s = traffic_light.getNextSwitch(light)
        walk = traffic_light.getRedYellowGreenState(light)[index] in _WALK
        return Showing(
            walk,
            self._change(light, index, walk, next_s),
            next_s if self._program(light) else self.now_s(),
        )

    def _change(self, light: str, index: int, walk: bool, next_s: float) -> float | None:
        phases = self._program(light)
        if phases is None:
            return None
        current = self._engine.trafficlight.getPhase(light)
        change_s = next_s
        for k in range(1, len(phases)):
            duration_s, state = phases[(current + k) % len(phases)]
            if (state[index] in _WALK) != walk:
                return change_s
            change_s += duration_s
        return None

    def _program(self, light: str) -> tuple[tuple[float, str], ...] | None:
        """Durations and states of a static program; None for one that decides while it runs."""
        if light not in self._phases:
            traffic_light = self._engine.trafficlight
            name = traffic_light.getProgram(light)
            logic = next(p for p in traffic_light.getAllProgramLogics(light) if p.programID == name)
            static = logic.type == 0
            self._phases[light] = (
                tuple((p.duration, p.state) for p in logic.phases) if static else None
            )
        return self._phases[light]


_ROOM_M: Final = 0.3
_KEPT: Final = 4096

_Key = tuple[str, float, float]
"""A crossing, and the point x, y in metres of somebody before it."""


class Kerbs:
    """The kerbs of a map, made when they are first asked for."""

    def __init__(self, street_map: StreetMap) -> None:
        self._map = street_map
        self._ends: dict[str, tuple[list[str], list[shapely.Geometry | None]]] = {}
        self._ground: dict[str, shapely.Geometry] = {}
        self._spots: dict[_Key, tuple[float, float]] = {}

    def behind(self, crossings: Sequence[str], xy: Floats) -> Floats:
        """The nearest places (N, 2) to points (N, 2) where one can wait before crossings (N,), in
        metres."""
        if len(self._spots) > _KEPT:
            self._spots.clear()
        asked = [
            (crossing, x_m, y_m)
            for crossing, (x_m, y_m) in zip(crossings, xy.tolist(), strict=True)
        ]
        if new := [key for key in asked if key not in self._spots]:
            self._find(new)
        return np.array([self._spots[key] for key in asked]).reshape(-1, 2)

    def _find(self, new: list[_Key]) -> None:
        """Find the spots of those who were not here before."""
        xy = np.array([key[1:] for key in new])
        ends = [self._corners(crossing) for crossing, _, _ in new]
        outlines = np.array([outline for _, outline in ends], dtype=object)
        # Mostly somebody is on a corner; GEOS says that much faster than how far away the corners
        # are.
        on = shapely.intersects_xy(outlines, xy[:, :1], xy[:, 1:])
        away_m = np.where(on, 0.0, 1.0)
        off = ~on.any(axis=1)
        if off.any():
            away_m[off] = shapely.distance(
                outlines[off], np.array(shapely.points(xy[off]))[:, None]
            )
        last = (away_m[:, 1] < away_m[:, 0]).tolist()
        grounds = [
            self._standing(corners[k]) if corners else None
            for (corners, _), k in zip(ends, last, strict=True)
        ]
        ground = np.array(grounds, dtype=object)
        aside = ~(
            shapely.contains_xy(ground, *xy.T)
            | shapely.is_missing(ground)
            | shapely.is_empty(ground)
        )
        if aside.any():
            ways = shapely.shortest_line(shapely.points(xy[aside]), ground[aside])
            xy[aside] = shapely.get_coordinates(ways)[1::2]
        self._spots.update(zip(new, map(tuple, xy.tolist()), strict=True))

    def _corners(self, crossing: str) -> tuple[list[str], list[shapely.Geometry | None]]:
        """The corners at the ends of a crossing and two outlines, None for want of a corner."""
        if crossing not in self._ends:
            corners = [
                corner for corner in self._map.strips[crossing].corners if corner is not None
            ]
            outlines: list[shapely.Geometry] = [
                self._map.corners[corner].polygon for corner in corners
            ]
            shapely.prepare(outlines)
            self._ends[crossing] = corners, [*outlines, None, None][:2]
        return self._ends[crossing]

    def _standing(self, corner: str) -> shapely.Geometry:
        """A corner without the crossings and the road that reach into it, less ROOM_M at its
        edge."""
        if corner not in self._ground:
            polygon = self._map.corners[corner].polygon
            taken = [s.polygon for s in self._map.near("strip", polygon) if s.id.startswith(":")]
            taken += [
                s.polygon
                for s in self._map.near("lane", polygon)
                if isinstance(s, Lane) and s.kind == "road"
            ]
            free = overlay.difference(polygon, overlay.union_all(taken)) if taken else polygon
            ground = shapely.buffer(free, -_ROOM_M)
            shapely.prepare(ground)
            self._ground[corner] = ground
        return self._ground[corner]

"""Crosswalk signals near the robot, and waiting positions of pedestrians at red."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats, hypot
from cosim.core.state import Signal
from cosim.place import overlay
from cosim.place.street_map import Lane, SignalPlan, StreetMap

if TYPE_CHECKING:  # planned lights do not need SUMO
    from sumo_nets.engine import Sumo

_NEAR_M = 80.0
"""Signals of crossings within this distance of the robot are shown, metres."""

RESELECT_M = 5.0
"""Distance that the robot moves before the near crossings are selected again, metres."""

_WALK = "Gg"

_MS: Final = 1000


class SignalState(NamedTuple):
    """State of a signal.

    walk: whether walking is permitted.
    change_s: SUMO time at which `walk` changes, None for unknown or never.
    until_s: SUMO time until which this state is valid.
    """

    walk: bool
    change_s: float | None
    until_s: float


class Lights(Protocol):
    """Source of signal states.

    crossings: ids of the signalised crossings.
    """

    crossings: Collection[str]

    def now_s(self) -> float:
        """Return SUMO's time, seconds."""

    def showing(self, crossing: str) -> SignalState:
        """Return the current state of a crossing's signal."""


class Signals:
    """The signals of all crossings; each state is queried once per switch."""

    def __init__(self, lights: Lights, street_map: StreetMap) -> None:
        self._lights = lights
        self._ids = sorted(lights.crossings)
        self._signalised = frozenset(self._ids)
        middles = [street_map.strips[i].line.mean(axis=0) for i in self._ids]
        self._xy = np.array(middles, dtype=float).reshape(-1, 2)
        self._shown: dict[str, SignalState] = {}
        self._centre: tuple[float, float] | None = None
        self._near: list[str] = []

    def near(self, x_m: float, y_m: float) -> Mapping[str, Signal]:
        """Return the current signals within about _NEAR_M of a point."""
        if self._centre is None or hypot(x_m - self._centre[0], y_m - self._centre[1]) > RESELECT_M:
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
        """Return the indices of those `crossings` with a signal that forbids walking."""
        signalised = self._signalised.intersection(crossings)
        if not signalised:
            return []
        now_s = self._lights.now_s()
        red = {one for one in signalised if not self._state(one, now_s).walk}
        return [i for i, one in enumerate(crossings) if one in red] if red else []

    def is_red(self, crossing: str) -> bool:
        """Return whether a crossing has a signal that forbids walking."""
        return bool(self.red([crossing]))

    def _state(self, crossing: str, now_s: float) -> SignalState:
        shown = self._shown.get(crossing)
        if shown is None or now_s >= shown.until_s:
            self._shown[crossing] = shown = self._lights.showing(crossing)
        return shown


class PlannedLights:
    """Signal states computed from plans, equal to SUMO's.

    begin_s: SUMO's start time, seconds.
    now_ms: SUMO's current time, milliseconds, set by the caller.
    """

    def __init__(self, street_map: StreetMap, begin_s: int) -> None:
        self._strips = street_map.strips
        self.crossings: Collection[str] = [
            strip.id for strip in self._strips.values() if strip.plan is not None
        ]
        self.now_ms = _MS * begin_s

    def now_s(self) -> float:
        return self.now_ms / _MS

    def showing(self, crossing: str) -> SignalState:
        """Return the current state of a crossing's signal.

        SUMO switches at the end of a step, so at the exact switching time the previous state is
        still shown.
        """
        plan: SignalPlan | None = self._strips[crossing].plan
        assert plan is not None, crossing
        ends_ms = list(itertools.accumulate(plan.durations_ms))
        last_ms = self.now_ms - 1
        since_ms = (last_ms - plan.offset_ms) % ends_ms[-1]
        now = next(k for k, end_ms in enumerate(ends_ms) if since_ms < end_ms)
        until_ms = change_ms = last_ms + ends_ms[now] - since_ms
        for k in range(now + 1, now + len(ends_ms)):
            if plan.walks[k % len(ends_ms)] != plan.walks[now]:
                return SignalState(plan.walks[now], change_ms / _MS, until_ms / _MS)
            change_ms += plan.durations_ms[k % len(ends_ms)]
        return SignalState(plan.walks[now], None, until_ms / _MS)


class SumoLights:
    """Signal states read from SUMO; programs are read once."""

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

    def showing(self, crossing: str) -> SignalState:
        light, index = self._link[crossing]
        traffic_light = self._engine.trafficlight
        next_s = traffic_light.getNextSwitch(light)
        walk = traffic_light.getRedYellowGreenState(light)[index] in _WALK
        return SignalState(
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
        """Return durations and states of a static program; None for an adaptive one."""
        if light not in self._phases:
            traffic_light = self._engine.trafficlight
            name = traffic_light.getProgram(light)
            logic = next(p for p in traffic_light.getAllProgramLogics(light) if p.programID == name)
            static = logic.type == 0
            self._phases[light] = (
                tuple((p.duration, p.state) for p in logic.phases) if static else None
            )
        return self._phases[light]


_CURB_ROOM_M: Final = 0.3
"""Distance of waiting pedestrians from the road, metres."""
_CACHED_SPOTS: Final = 4096
"""Largest number of cached waiting positions."""

_Key = tuple[str, float, float]
"""A crossing id and the position x, y in metres of a person before it."""


class WaitingSpots:
    """Waiting positions at the kerbs of a map, computed on demand.

    SUMO lets people wait at the end of a crossing. Where a crossing meets its corner at an angle,
    that end may lie on the road. Displayed people wait on the corner instead, at a shoulder's
    distance from the road.
    """

    def __init__(self, street_map: StreetMap) -> None:
        self._map = street_map
        self._ends: dict[str, tuple[list[str], list[shapely.Geometry | None]]] = {}
        self._ground: dict[str, shapely.Geometry] = {}
        self._spots: dict[_Key, tuple[float, float]] = {}

    def behind(self, crossings: Sequence[str], xy: Floats) -> Floats:
        """Return the nearest waiting positions (N, 2) before `crossings` (N,) for positions `xy`
        (N, 2), metres."""
        if len(self._spots) > _CACHED_SPOTS:
            self._spots.clear()
        keys = [
            (crossing, x_m, y_m)
            for crossing, (x_m, y_m) in zip(crossings, xy.tolist(), strict=True)
        ]
        if new := [key for key in keys if key not in self._spots]:
            self._spots.update((key, key[1:]) for key in new)
            if aside := self._not_waiting(new):
                self._find(aside)
        return np.array([self._spots[key] for key in keys]).reshape(-1, 2)

    def _not_waiting(self, new: list[_Key]) -> list[_Key]:
        """Return the keys of persons that are not on ground to wait on. Most are on it, and on one
        corner, which GEOS tests much faster than it computes distances."""
        _, x_m, y_m = zip(*new, strict=True)
        ends = [self._corners(crossing) for crossing, _, _ in new]
        on_first = shapely.intersects_xy(_array([first for _, (first, _) in ends]), x_m, y_m)
        grounds = [
            self._standing(corners[0 if on else 1])
            if corners and (on or len(corners) > 1)
            else None
            for (corners, _), on in zip(ends, on_first.tolist(), strict=True)
        ]
        waiting = shapely.contains_xy(_array(grounds), x_m, y_m).tolist()
        return [key for key, waits in zip(new, waiting, strict=True) if not waits]

    def _find(self, new: list[_Key]) -> None:
        """Compute waiting positions of persons elsewhere."""
        xy = np.array([key[1:] for key in new])
        ends = [self._corners(crossing) for crossing, _, _ in new]
        outlines = np.array([outline for _, outline in ends], dtype=object)
        away_m = shapely.distance(outlines, np.array(shapely.points(xy))[:, None])
        last = (away_m[:, 1] < away_m[:, 0]).tolist()
        ground = _array(
            [
                self._standing(corners[k]) if corners else None
                for (corners, _), k in zip(ends, last, strict=True)
            ]
        )
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
        """Return the corners at the ends of a crossing and two outlines, None without a corner."""
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
        """Return a corner without its crossings and roads, shrunk by _CURB_ROOM_M."""
        if corner not in self._ground:
            polygon = self._map.corners[corner].polygon
            taken = [s.polygon for s in self._map.near("strip", polygon) if s.id.startswith(":")]
            taken += [
                s.polygon
                for s in self._map.near("lane", polygon)
                if isinstance(s, Lane) and s.kind == "road"
            ]
            free = overlay.difference(polygon, overlay.union_all(taken)) if taken else polygon
            ground = shapely.buffer(free, -_CURB_ROOM_M)
            shapely.prepare(ground)
            self._ground[corner] = ground
        return self._ground[corner]


def _array(geometries: list[shapely.Geometry | None]) -> NDArray[np.object_]:
    """Return geometries as an array (N,)."""
    array = np.empty(len(geometries), dtype=object)
    array[:] = geometries
    return array

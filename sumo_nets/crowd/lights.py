"""Signals: what the crosswalk signals near the robot show, and when that changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from cosim.core.state import Signal
from cosim.place.street_map import StreetMap
from sumo_nets.engine import Sumo

_NEAR_M = 80.0
"""The signals of crossings within this distance of the robot are shown."""

RESELECT_M = 5.0
"""How far the robot moves before the near crossings are looked up again."""

_WALK = "Gg"


class Signals:
    """Every signalised crossing's link; programs are read once, states once per switch."""

    def __init__(self, engine: Sumo, street_map: StreetMap) -> None:
        self._engine = engine
        self._link: dict[str, tuple[str, int]] = {}
        for light in sorted(engine.trafficlight.getIDList()):
            for index, links in enumerate(engine.trafficlight.getControlledLinks(light)):
                for _, to, _ in links:
                    edge = to.rsplit("_", 1)[0]
                    if edge in street_map.strips and street_map.strips[edge].kind == "crossing":
                        self._link.setdefault(edge, (light, index))
        self._ids = sorted(self._link)
        middles = [street_map.strips[i].line.mean(axis=0) for i in self._ids]
        self._xy = np.array(middles, dtype=float).reshape(-1, 2)
        self._phases: dict[str, tuple[tuple[float, str], ...] | None] = {}
        self._until: dict[str, float] = {}
        self._shown: dict[str, tuple[bool, float | None]] = {}
        self._centre: tuple[float, float] | None = None
        self._near: list[str] = []

    def near(self, x_m: float, y_m: float) -> Mapping[str, Signal]:
        """The signals within NEAR_M (up to RESELECT_M more or less) of a point, now."""
        if self._centre is None or np.hypot(x_m - self._centre[0], y_m - self._centre[1]) > RESELECT_M:
            self._centre = (x_m, y_m)
            gap = self._xy - (x_m, y_m)
            self._near = [self._ids[i] for i in np.flatnonzero((gap * gap).sum(axis=1) <= _NEAR_M * _NEAR_M)]
        now_s = self._engine.simulation.getTime()
        signals = {}
        for crossing in self._near:
            walk, change_s = self._state(crossing, now_s)
            signals[crossing] = Signal(walk, None if change_s is None else round(change_s - now_s, 3))
        return MappingProxyType(signals)

    def red(self, crossings: Sequence[str]) -> list[int]:
        """The places in `crossings` of those that have a signal that forbids walking."""
        now_s = self._engine.simulation.getTime()
        return [i for i, one in enumerate(crossings) if one in self._link and not self._state(one, now_s)[0]]

    def is_red(self, crossing: str) -> bool:
        """Whether a crossing has a signal and it forbids walking."""
        return crossing in self._link and not self._state(crossing, self._engine.simulation.getTime())[0]

    def _state(self, crossing: str, now_s: float) -> tuple[bool, float | None]:
        """Whether one may walk, and the time at which that changes."""
        if now_s >= self._until.get(crossing, 0.0):
            light, index = self._link[crossing]
            traffic_light = self._engine.trafficlight
            next_s = traffic_light.getNextSwitch(light)
            walk = traffic_light.getRedYellowGreenState(light)[index] in _WALK
            self._until[crossing] = next_s if self._program(light) else now_s
            self._shown[crossing] = (walk, self._change(light, index, walk, next_s))
        return self._shown[crossing]

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
            self._phases[light] = tuple((p.duration, p.state) for p in logic.phases) if static else None
        return self._phases[light]

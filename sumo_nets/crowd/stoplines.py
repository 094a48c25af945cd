"""Stop line crossings of vehicles and the state of their lights, for measurements only."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

from sumo_nets.engine import sumo


class StopLineCrossing(NamedTuple):
    """A vehicle that crossed a stop line.

    light: SUMO's letter of its link (G or g, y, r, ...).
    red_s: observed time since the light turned red, seconds.
    """

    vehicle: str
    light: str
    red_s: float


class StopLines:
    """Observer of the vehicles in the running simulation."""

    def __init__(self, tick_s: float) -> None:
        self._tick_s = tick_s
        self._next: dict[str, tuple[str, int, float]] = {}
        self._red_s: dict[tuple[str, int], float] = {}

    def passed(self, vehicles: Collection[str]) -> list[StopLineCrossing]:
        """Return the vehicles that crossed a stop line since the last call, with the current
        state of the light."""
        next_lights = {}
        for name in vehicles:
            lights = sumo.vehicle.getNextTLS(name)
            if lights:
                next_lights[name] = lights[0][:3]
        lit = {
            link: sumo.trafficlight.getRedYellowGreenState(link[0])[link[1]]
            for link in {
                (light, link) for light, link, _ in (*next_lights.values(), *self._next.values())
            }
        }
        self._red_s = {
            k: self._red_s.get(k, 0.0) + self._tick_s for k, letter in lit.items() if letter == "r"
        }
        found = []
        for name, (light, link, away_m) in self._next.items():
            # A distant light that disappears means a changed route. The same junction at a short
            # distance means a lane change at the stop line.
            next_light, _, next_m = next_lights.get(name, ("", -1, 0.0))
            if name in vehicles and away_m < 3.0 and (next_light != light or next_m > away_m + 3.0):
                found.append(
                    StopLineCrossing(name, lit[light, link], self._red_s.get((light, link), 0.0))
                )
        self._next = next_lights
        return found

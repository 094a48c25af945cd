"""Stop lines: which vehicles drive over them, and what their lights show. For measuring; the crowd
does without."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

from sumo_nets.engine import sumo


class Passed(NamedTuple):
    """A vehicle drove over a stop line. light: SUMO's letter of its link (G or g, y, r, ...);
    red_s: for how long it has been red, as far as anybody was there to see."""

    vehicle: str
    light: str
    red_s: float


class StopLines:
    """Watches the vehicles of the running simulation, tick by tick."""

    def __init__(self, tick_s: float) -> None:
        self._tick_s = tick_s
        self._next: dict[str, tuple[str, int, float]] = {}
        self._red_s: dict[tuple[str, int], float] = {}

    def passed(self, vehicles: Collection[str]) -> list[Passed]:
        """The vehicles that have driven over a stop line since the last call, with what the light
        shows now."""
        ahead = {}
        for name in vehicles:
            lights = sumo.vehicle.getNextTLS(name)
            if lights:
                ahead[name] = lights[0][:3]
        lit = {
            link: _letter(link)
            for link in {
                (light, link) for light, link, _ in (*ahead.values(), *self._next.values())
            }
        }
        self._red_s = {
            k: self._red_s.get(k, 0.0) + self._tick_s for k, letter in lit.items() if letter == "r"
        }
        found = []
        for name, (light, link, away_m) in self._next.items():
            # A light farther than a tick's way that is gone was turned away from; one that stays at
            # hand is another lane's of the same junction: the vehicle has changed lanes at the stop
            # line.
            next_light, _, next_m = ahead.get(name, ("", -1, 0.0))
            if name in vehicles and away_m < 3.0 and (next_light != light or next_m > away_m + 3.0):
                found.append(Passed(name, lit[light, link], self._red_s.get((light, link), 0.0)))
        self._next = ahead
        return found


def _letter(link: tuple[str, int]) -> str:
    return sumo.trafficlight.getRedYellowGreenState(link[0])[link[1]]

"""EmptyStreet: a street without background crowd or vehicles, which needs no SUMO.

Of SUMO's walkers only the crowd is read, so that where there is none all that SUMO would tell is
what the signals show, and where they go by the clock their plans tell that too. Actors are where
they are, signals as with SUMO: the streets are those of a `SumoCrowd` with the same seed, bit for
bit.
"""

from __future__ import annotations

from types import TracebackType
from typing import Final, Self

import numpy as np

from cosim.core.errors import EngineError
from cosim.core.state import RobotState, Street
from cosim.episode.interfaces import Crowd
from cosim.place.street_map import StreetMap
from cosim.spec.events import Actor, EventReply
from cosim.spec.scenario import CrowdSpec
from sumo_nets.crowd.demand_log import Entrances
from sumo_nets.crowd.lights import PlannedLights, Signals
from sumo_nets.crowd.shown_people import ShownPeople, cast_in_order

TICK_MS: Final = 50
"""One step of SUMO."""

_SIGNAL_CLOCK_S: Final = 3600
"""The signals' clocks start somewhere in this span, drawn from the seed."""


def goes_by_itself(street_map: StreetMap, spec: CrowdSpec, before: Entrances | None = None) -> bool:
    """Whether a street needs no SUMO. before: who came and went, in place of who would be drawn."""
    nobody = spec.empty if before is None else not (before.people or before.vehicles)
    return nobody and street_map.signals_by_the_clock


def start_of(seed: int) -> tuple[int, int]:
    """SUMO's seed, and the second at which it begins."""
    rng = np.random.default_rng(seed).spawn(1)[0]
    return int(rng.integers(2**31)), int(rng.integers(_SIGNAL_CLOCK_S))


class EmptyStreet(Crowd):
    """The street of a map around actors and signals alone; `goes_by_itself` says where that is all.
    seed: of when the signals begin; start_xy: where the robot starts, metres. Use as a context
    manager. entrances: nobody's."""

    def __init__(self, street_map: StreetMap, seed: int, start_xy: tuple[float, float]) -> None:
        self._map = street_map
        self._seed = seed
        self._start_xy = start_xy
        self._street: Street | None = None
        self.entrances = Entrances()

    def __enter__(self) -> Self:
        self._lights = PlannedLights(self._map, start_of(self._seed)[1])
        self._signals = Signals(self._lights, self._map)
        self._shown = ShownPeople(TICK_MS / 1000)
        self._street = self._read(0, *self._start_xy, ())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._street = None

    @property
    def street(self) -> Street:
        """The street now."""
        if self._street is None:
            raise EngineError("this EmptyStreet is not running: use it as a context manager")
        return self._street

    def step(self, robot: RobotState, reply: EventReply, *, absent: bool = False) -> Street:
        """One tick on, with the event pedestrians where they are now. absent: makes no
        difference."""
        self._street = self._read(
            self.street.tick + 1, robot.pose.x_m, robot.pose.y_m, reply.actors
        )
        return self._street

    def _read(self, tick: int, x_m: float, y_m: float, actors: tuple[Actor, ...]) -> Street:
        self._lights.now_ms += TICK_MS
        people = self._shown.together(
            cast_in_order(actors, self.entrances.ages), self.entrances.ages
        )
        return Street(tick, people, signals=self._signals.near(x_m, y_m))

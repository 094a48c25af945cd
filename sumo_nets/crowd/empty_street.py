"""EmptyStreet: a street without background crowd, which does not need SUMO.

Without a crowd only the signals would be read from SUMO. If all signals have fixed plans, their
states are computed instead. The streets equal those of a `SumoCrowd` with the same seed, bit for
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
from sumo_nets.crowd.shown_people import ShownPeople, sorted_actors

TICK_MS: Final = 50
"""Duration of a SUMO step, milliseconds."""

_SIGNAL_CLOCK_S: Final = 3600
"""Range of the start time of the signals, drawn from the seed, seconds."""


def needs_no_sumo(
    street_map: StreetMap, spec: CrowdSpec, recorded: Entrances | None = None
) -> bool:
    """Return whether a street does not need SUMO.

    recorded: entries to replay instead of random ones.
    """
    no_crowd = spec.empty if recorded is None else not (recorded.people or recorded.vehicles)
    return no_crowd and street_map.signals_fixed_time


def sumo_start(seed: int) -> tuple[int, int]:
    """Return SUMO's seed and its start time in seconds."""
    rng = np.random.default_rng(seed).spawn(1)[0]
    return int(rng.integers(2**31)), int(rng.integers(_SIGNAL_CLOCK_S))


class EmptyStreet(Crowd):
    """A street with event pedestrians and planned signals only, see `needs_no_sumo`. Use it as a
    context manager.

    seed: seed of the signals' start time.
    start_xy: start position of the robot, metres.
    entrances: always empty.
    """

    def __init__(self, street_map: StreetMap, seed: int, start_xy: tuple[float, float]) -> None:
        self._map = street_map
        self._seed = seed
        self._start_xy = start_xy
        self._street: Street | None = None
        self.entrances = Entrances()

    def __enter__(self) -> Self:
        self._lights = PlannedLights(self._map, sumo_start(self._seed)[1])
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
        """The current street."""
        if self._street is None:
            raise EngineError("this EmptyStreet is not running: use it as a context manager")
        return self._street

    def step(self, robot: RobotState, reply: EventReply, *, absent: bool = False) -> Street:
        """Advance by one tick, with the event pedestrians at their current poses.

        absent: has no effect.
        """
        self._street = self._read(
            self.street.tick + 1, robot.pose.x_m, robot.pose.y_m, reply.actors
        )
        return self._street

    def _read(self, tick: int, x_m: float, y_m: float, actors: tuple[Actor, ...]) -> Street:
        self._lights.now_ms += TICK_MS
        people = self._shown.merged(sorted_actors(actors, self.entrances.ages), self.entrances.ages)
        return Street(tick, people, signals=self._signals.near(x_m, y_m))

"""Integer time: ticks of the crowd, periods of the policy, substeps of the physics.

The simulation never reads a wall clock. A `Pacer` can slow it down to real time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from cosim.core.errors import SpecError


@dataclass(frozen=True, slots=True)
class Clock:
    """Periods of an episode in whole milliseconds; each divides the next larger one.

    tick_ms: period of crowd, director and referee.
    substep_ms: period of the physics.
    policy_ms: period of the policy; its command holds in between. Raises SpecError.
    """

    tick_ms: int = 50
    substep_ms: int = 5
    policy_ms: int = 250

    def __post_init__(self) -> None:
        if min(self.tick_ms, self.substep_ms, self.policy_ms) <= 0:
            raise SpecError(f"periods must be positive: {self}")
        if self.tick_ms % self.substep_ms:
            raise SpecError(
                f"a tick of {self.tick_ms} ms is no whole number of {self.substep_ms} ms substeps"
            )
        if self.policy_ms % self.tick_ms:
            rates = ", ".join(f"{1000 // n}" for n in (250, 200, 100, 50))
            raise SpecError(
                f"a policy period of {self.policy_ms} ms is no whole number of {self.tick_ms} ms "
                f"ticks; usual policy rates are {rates} Hz"
            )

    @classmethod
    def for_rate(cls, policy_hz: float) -> Clock:
        """Return the clock of a policy that acts `policy_hz` times per simulated second."""
        if not policy_hz > 0:
            raise SpecError(f"a policy rate must be positive, not {policy_hz} Hz")
        return cls(policy_ms=round(1000 / policy_hz))

    @property
    def substeps(self) -> int:
        """Number of physics substeps per tick."""
        return self.tick_ms // self.substep_ms

    @property
    def tick_s(self) -> float:
        return self.tick_ms / 1000

    def time_s(self, tick: int) -> float:
        """Return the simulated time at the start of a tick, in seconds."""
        return tick * self.tick_ms / 1000

    def ticks(self, seconds: float) -> int:
        """Return the number of ticks in `seconds`, rounded to the nearest."""
        return round(seconds * 1000 / self.tick_ms)

    def acts(self, tick: int) -> bool:
        """Return whether the policy acts at a tick."""
        return tick % (self.policy_ms // self.tick_ms) == 0


class Pacer:
    """Slows a simulation down to a multiple of real time.

    pace: simulated seconds per second of wall-clock time.
    clock: function that returns the wall-clock time in seconds.
    sleep: function that waits for a time in seconds.
    """

    CATCH_UP_S: Final = 1.0
    """Maximum delay that the simulation catches up after it was slow, in seconds."""

    def __init__(
        self,
        pace: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._pace = pace
        self._clock = clock
        self._sleep = sleep
        self._due_s: float | None = None

    def wait(self, simulated_s: float) -> None:
        """Wait until `simulated_s` more simulated seconds may have passed."""
        now_s = self._clock()
        due_s = now_s if self._due_s is None else self._due_s
        self._due_s = max(due_s + simulated_s / self._pace, now_s - self.CATCH_UP_S)
        if self._due_s > now_s:
            self._sleep(self._due_s - now_s)

"""Integer time. A tick is one step of the crowd; the policy acts every few ticks; physics runs
substeps.

The simulation never reads a wall clock; a `Pacer` can hold it back to one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from cosim.core.errors import SpecError


@dataclass(frozen=True, slots=True)
class Clock:
    """The three periods of an episode, in whole milliseconds, checked once to divide each other.

    tick_ms: one step of crowd, director and referee. substep_ms: one step of the physics.
    policy_ms: the policy's own period; its command is held in between.
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
        """The clock of a policy that acts `policy_hz` times a simulated second."""
        if not policy_hz > 0:
            raise SpecError(f"a policy rate must be positive, not {policy_hz} Hz")
        return cls(policy_ms=round(1000 / policy_hz))

    @property
    def substeps(self) -> int:
        """Physics substeps per tick."""
        return self.tick_ms // self.substep_ms

    @property
    def tick_s(self) -> float:
        return self.tick_ms / 1000

    def time_s(self, tick: int) -> float:
        """Simulated seconds at the start of `tick`."""
        return tick * self.tick_ms / 1000

    def ticks(self, seconds: float) -> int:
        """Ticks in `seconds`, to the nearest."""
        return round(seconds * 1000 / self.tick_ms)

    def acts(self, tick: int) -> bool:
        """Whether the policy is asked at `tick`."""
        return tick % (self.policy_ms // self.tick_ms) == 0


class Pacer:
    """Holds a simulation back to a multiple of real time.

    pace: simulated seconds for each second of the wall clock. clock, sleep: that wall clock, and
    how to wait, in seconds.
    """

    CATCH_UP_S: Final = 1.0
    """A simulation that fell behind, because a policy thought or the machine was busy, makes up for
    so much at most."""

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
        """Wait until so many more simulated seconds may be over."""
        now_s = self._clock()
        due_s = now_s if self._due_s is None else self._due_s
        self._due_s = max(due_s + simulated_s / self._pace, now_s - self.CATCH_UP_S)
        if self._due_s > now_s:
            self._sleep(self._due_s - now_s)

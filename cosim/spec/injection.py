"""Injected pedestrians: what an outside client may send into a running episode, and what it is told.

An injection is applied at the boundary of a step, in the order of arrival; the tick is in the acknowledgement and in
the episode's record, so that the record alone replays the episode.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec

from cosim.core.errors import SpecError
from cosim.core.state import Doing
from cosim.spec.connection import Connection

_FASTEST_MPS = 3.0
LONGEST_S = 3600.0

Name = Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9_-]{1,32}$")]


class Injection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A pedestrian: it appears at the first point of `path` (x, y in metres), walks along it, stays, and is gone.

    heading_rad: which way it faces at the end; by default the way it came. doing: what it shows while it stands there.
    """

    id: Name
    path: Annotated[tuple[tuple[float, float], ...], msgspec.Meta(min_length=1, max_length=200)]
    speed_mps: float = 1.3
    heading_rad: float | None = None
    doing: Doing = "stand"
    age: Literal["adult", "child", "elderly"] = "adult"
    stay_s: float = 30.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for point in self.path for value in point):
            raise SpecError(f"pedestrian '{self.id}': path holds a value that is no number")
        if not 0.0 < self.speed_mps <= _FASTEST_MPS:
            raise SpecError(
                f"pedestrian '{self.id}': speed_mps must be above 0 and at most {_FASTEST_MPS:g}, "
                f"not {self.speed_mps:g}"
            )
        if not 0.0 <= self.stay_s <= LONGEST_S:
            raise SpecError(f"pedestrian '{self.id}': stay_s must be 0 to {LONGEST_S:g}, not {self.stay_s:g}")
        if self.heading_rad is not None and not math.isfinite(self.heading_rad):
            raise SpecError(f"pedestrian '{self.id}': heading_rad is no number")


class Injected(msgspec.Struct, frozen=True, kw_only=True):
    """An injection and the tick from which it takes effect: an entry of the episode's log."""

    tick: int
    injection: Injection


class Ack(msgspec.Struct, frozen=True, kw_only=True):
    """The answer to an injection. tick, time_s: when it takes effect; reason: why it was refused."""

    id: str
    status: Literal["accepted", "refused"]
    tick: int | None = None
    time_s: float | None = None
    reason: str = ""


class Live(msgspec.Struct, frozen=True, kw_only=True):
    """Where a run is on the air. connection: to its hub; run: its name in the keys."""

    connection: Connection
    run: str

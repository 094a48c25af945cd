"""Deadlines of policies: the pending call of a policy, in shared memory, and how long it may take.

A policy that hangs may hold the interpreter's lock or be stopped by a signal, so that its process
sends nothing more. The run reads the pending call here, and enforces the deadline.
"""

from __future__ import annotations

import struct
import time
from typing import Final, NamedTuple, get_args

from cosim.episode.policy_caller import LOADED_WITHIN_S, PolicyCall, when
from scenarios.ipc.shared_memory import SharedMemory

_DOINGS: Final[tuple[PolicyCall, ...]] = get_args(PolicyCall)
_LAYOUT: Final = struct.Struct(
    "dqq"
)  # since when, 0.0 while nothing is asked; what it is doing; at which tick


class Patience(NamedTuple):
    """Seconds a policy may take: for an answer; for being loaded, for a reset, for the first answer
    after it."""

    answer_s: float = 60.0
    start_s: float = LOADED_WITHIN_S

    def of(self, doing: PolicyCall) -> float:
        return self.start_s if doing in ("loading", "reset", "first act") else self.answer_s


class ServerTimes(NamedTuple):
    """Seconds by which a policy behind Zenoh is queried.

    found_s: to find a server for the next episode, before the run ends. first_found_s: the same
    before a run begins. lost_after_s: a server that is not reached for so long is gone; a link that
    was cut is up again sooner. try_s: for one attempt of a request, which is then repeated. end_s:
    for the reply to the end of an episode. pause_s: between two attempts.
    """

    found_s: float = 60.0
    first_found_s: float = 10.0
    lost_after_s: float = 3.0
    try_s: float = 5.0
    end_s: float = 1.0
    pause_s: float = 0.05


class Question(NamedTuple):
    """What a policy is asked. since_s: on the monotonic clock, which all processes of a machine
    share."""

    since_s: float
    doing: PolicyCall
    tick: int

    def overdue(self, patience: Patience) -> bool:
        """Whether the answer has taken too long."""
        return time.monotonic() - self.since_s > patience.of(self.doing)

    @property
    def when(self) -> str:
        """In words: "reset", or "act at 3.2 s"."""
        return when(self.doing, self.tick)


class Asked(SharedMemory):
    """The pending call: made by the run, opened by the policy's process, whose `Timer` it is."""

    def starts(self, doing: PolicyCall, tick: int) -> None:
        _LAYOUT.pack_into(self.map, 0, time.monotonic(), _DOINGS.index(doing), tick)

    def stops(self) -> None:
        _LAYOUT.pack_into(self.map, 0, 0.0, 0, 0)

    @property
    def question(self) -> Question | None:
        """The pending call; None while the policy has nothing to do."""
        since_s, doing, tick = _LAYOUT.unpack_from(self.map, 0)
        return Question(since_s, _DOINGS[doing], tick) if since_s else None

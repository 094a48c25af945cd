"""What the policy of an environment process is asked right now, and since when: told to the run in
shared memory.

A policy that hangs may hold the interpreter's lock or be stopped by a signal, so that its process
says nothing more. The run reads here whom it waits for.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from typing import Final, NamedTuple, get_args

from cosim.episode.policy_caller import LOADED_WITHIN_S, PolicyCall, when

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


class Asked:
    """The shared memory: made by the run, `opened` by the process, which is the policy's
    `Timer`."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._memory = mmap.mmap(descriptor, _LAYOUT.size)

    @classmethod
    def new(cls) -> Asked:
        """Memory that nobody else has yet; its descriptor can be handed to a child."""
        descriptor = os.memfd_create("cosim-asked")
        os.ftruncate(descriptor, _LAYOUT.size)
        return cls(descriptor)

    def starts(self, doing: PolicyCall, tick: int) -> None:
        _LAYOUT.pack_into(self._memory, 0, time.monotonic(), _DOINGS.index(doing), tick)

    def stops(self) -> None:
        _LAYOUT.pack_into(self._memory, 0, 0.0, 0, 0)

    @property
    def question(self) -> Question | None:
        """What is being asked; None while the policy has nothing to do."""
        since_s, doing, tick = _LAYOUT.unpack_from(self._memory, 0)
        return Question(since_s, _DOINGS[doing], tick) if since_s else None

    def close(self) -> None:
        self._memory.close()
        os.close(self.descriptor)

"""Deadlines of policy calls, enforced by the run through shared memory.

A policy that hangs may hold the interpreter's lock or be stopped by a signal, so that its process
sends nothing more. The run reads the pending call from shared memory, and enforces the deadline.
"""

from __future__ import annotations

import struct
import time
from typing import Final, NamedTuple, get_args

from cosim.episode.policy_caller import LOAD_TIMEOUT_S, PolicyCall, call_in_words
from scenarios.ipc.shared_memory import SharedMemory

_CALL_KINDS: Final[tuple[PolicyCall, ...]] = get_args(PolicyCall)
_LAYOUT: Final = struct.Struct("dqq")
"""Layout of a pending call: its start time in s, 0.0 without a call; its kind; its tick."""


class Patience(NamedTuple):
    """Timeouts of policy calls in seconds.

    answer_s: of an answer.
    start_s: of loading, of a reset, and of the first answer after it.
    """

    answer_s: float = 60.0
    start_s: float = LOAD_TIMEOUT_S

    def of(self, kind: PolicyCall) -> float:
        """Return the timeout of a kind of call."""
        return self.start_s if kind in ("loading", "reset", "first act") else self.answer_s


class ServerTimes(NamedTuple):
    """Timeouts of a policy behind Zenoh, in seconds.

    found_s: to find a server for the next episode, before the run ends.
    first_found_s: the same before a run begins.
    lost_after_s: until an unreachable server is lost; a broken link recovers sooner.
    try_s: of one attempt of a request, which is then repeated.
    end_s: of the reply to the end of an episode.
    pause_s: between two attempts.
    """

    found_s: float = 60.0
    first_found_s: float = 10.0
    lost_after_s: float = 3.0
    try_s: float = 5.0
    end_s: float = 1.0
    pause_s: float = 0.05


class PendingCall(NamedTuple):
    """A pending call of a policy.

    since_s: its start on the monotonic clock, which all processes of a machine share.
    """

    since_s: float
    kind: PolicyCall
    tick: int

    def overdue(self, patience: Patience) -> bool:
        """Return whether the call has exceeded its timeout."""
        return time.monotonic() - self.since_s > patience.of(self.kind)

    @property
    def when(self) -> str:
        """Return the call in words: "reset", or "act at 3.2 s"."""
        return call_in_words(self.kind, self.tick)


class PendingCallMemory(SharedMemory):
    """Shared memory with the pending call: created by the run, written as `Timer` by the policy's
    process."""

    def starts(self, kind: PolicyCall, tick: int) -> None:
        _LAYOUT.pack_into(self.map, 0, time.monotonic(), _CALL_KINDS.index(kind), tick)

    def stops(self) -> None:
        _LAYOUT.pack_into(self.map, 0, 0.0, 0, 0)

    @property
    def pending_call(self) -> PendingCall | None:
        """Return the pending call; None without one. An entry that a policy has damaged is an
        overdue call."""
        since_s, kind, tick = _LAYOUT.unpack_from(self.map, 0)
        if not since_s:
            return None
        known = 0.0 < since_s <= time.monotonic() and 0 <= kind < len(_CALL_KINDS)
        return (
            PendingCall(since_s, _CALL_KINDS[kind], tick) if known else PendingCall(0.0, "act", 0)
        )

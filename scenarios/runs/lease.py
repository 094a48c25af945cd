"""Lease of a job by a worker on another machine, over Zenoh or Ray."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from cosim.core.progress import ignore
from scenarios.ipc.faults import AttemptFailure
from scenarios.ipc.messages import Done, Message, MessageHandler
from scenarios.runs.protocol import Reply

ReplyCallback = Callable[[Reply], None]


class _Reported(NamedTuple):
    """A report that the run has not processed."""

    messages: Sequence[Message]
    failure: AttemptFailure | None
    answer: ReplyCallback

    @property
    def ends(self) -> bool:
        """Whether it ends the lease."""
        return self.failure is not None or any(
            isinstance(message, Done) for message in self.messages
        )


class Lease:
    """Lease of a job, which expires after `lasts_s` seconds without a report of the worker.

    holder: name of the worker.
    number: identifies this lease among those of the same worker.
    ended: the job is done, has failed, or is taken away.
    expired: no report came in time.
    """

    def __init__(self, holder: str, number: int, lasts_s: float, scenario: str = "") -> None:
        self.number = number
        self.scenario = scenario
        self.ended = False
        self.expired = False
        self._holder = holder
        self._lasts_s = lasts_s
        self._reported_s = time.monotonic()
        self._reports: deque[_Reported] = deque()
        self._lost = ""

    def add_report(
        self,
        messages: Sequence[Message],
        failure: AttemptFailure | None,
        answer: ReplyCallback = ignore,
    ) -> None:
        """Take in a report. It is answered once the run has processed it, so that nothing unwritten
        is acknowledged."""
        self._reported_s = time.monotonic()
        self._reports.append(_Reported(messages, failure, answer))

    def mark_lost(self, reason: str) -> None:
        """Note that the worker is lost, with all that runs on its machine."""
        self._lost = self._lost or reason

    def poll(self, handle: MessageHandler) -> AttemptFailure | None:
        """Pass on reported messages. Returns the failure of the job if it has failed or its worker
        is lost."""
        while self._reports and not self.ended:
            report = self._reports.popleft()
            for message in report.messages:
                if isinstance(message, Done) or getattr(message, "scenario", "") == self.scenario:
                    handle(message)
            self.ended = report.ends
            report.answer(Reply("kept" if self.ended else "renewed"))
            if report.failure is not None:
                return report.failure
        if self.ended:
            return None
        self.expired = not self._lost and time.monotonic() - self._reported_s > self._lasts_s
        if self.expired:
            self._lost = f"worker {self._holder} fell silent"
        if not self._lost:
            return None
        self.ended = True
        return AttemptFailure("machine_lost", self._lost)

    def revoke(self, *, silently: bool = False) -> None:
        """Take the job away. A result that was not processed is not answered: the worker sends it
        again."""
        self.ended = True
        for report in self._reports:
            if not silently and not report.ends:
                report.answer(Reply("revoked"))
        self._reports.clear()

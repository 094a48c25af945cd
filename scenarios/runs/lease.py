"""A worker on another machine as long as it has one lease: what it has said, and what has to be
answered."""

from __future__ import annotations

import time
from collections import deque
from typing import Final, Protocol

from bridge.session import Query
from scenarios.ipc.deadlines import Question
from scenarios.ipc.messages import Done, FrameDrawn, Job, Message, MessageHandler, Ready
from scenarios.runs.protocol import (
    CoordinatorSays,
    GoOn,
    Lease,
    LetGo,
    NoResult,
    Received,
    Renewal,
    reply_in_bytes,
)

LEASE_S: Final = 15.0
"""A worker that does not renew its lease for so long has lost it, whatever Zenoh says of it."""


class Keeper(Protocol):
    """Who keeps the leases."""

    def forget(self, one: LeasedWorker) -> None:
        """Its lease has ended."""

    def with_net(self, job: Job) -> Job:
        """A job, with the hash of its place."""

    def given(self, one: LeasedWorker) -> None:
        """It has been given its job."""

    def ended_late(self, one: LeasedWorker) -> None:
        """It did not renew its lease."""


class LeasedWorker:
    """A worker as long as it has one lease (`scenarios.runs.transport.Worker`)."""

    away = in_engine = False

    def __init__(
        self,
        keeper: Keeper,
        at: tuple[str, int],
        number: int,
        claim: Query | None,
        scenario: str = "",
    ) -> None:
        self.at = at
        self.number = number
        self.scenario = scenario
        self.name = f"{at[0]}/{at[1]}"
        self.log = f"logs/{at[0]}-{at[1]}.log"
        self.job: Job | None = None
        self._keeper = keeper
        self._claim = claim
        self._said: deque[tuple[Message | None, Query | None, CoordinatorSays]] = deque(
            [(Ready(), None, GoOn())]
        )
        self._heard_s = time.monotonic()
        self._held = False
        self._asks: Renewal | NoResult | None = None
        self._why: str | None = None

    @property
    def question(self) -> Question | None:
        """As old as it was when the worker last told of it: what came after that is not known
        here."""
        if self._asks is None or self._asks.asks is None:
            return None
        return self._asks.asks.question(time.monotonic())

    @property
    def ended(self) -> bool:
        """Whether there is nothing to be expected of this lease any more."""
        return self._why is not None

    def give(self, job: Job) -> None:
        self.job = self._keeper.with_net(job)
        self.scenario = job.scenario.id
        if self._claim is not None:
            self._claim.answer(reply_in_bytes(Lease(self.number, self.job)))
            self._keeper.given(self)

    def renew(self, renewal: Renewal, query: Query) -> None:
        """It is alive. It is told so once its frames are written, and once the run knows of it."""
        self._heard_s = time.monotonic()
        self._asks = renewal
        self._said.extend(
            (message, None, GoOn()) for message in renewal.said if message.scenario == self.scenario
        )
        if self._held and not any(isinstance(message, FrameDrawn) for message in renewal.said):
            query.answer(reply_in_bytes(GoOn()))
        else:
            self._said.append((None, query, GoOn()))

    def deliver(self, done: Done, query: Query) -> None:
        self._heard_s = time.monotonic()
        self._said.append((done, query, Received()))

    def fail(self, failure: NoResult) -> None:
        """Its process has ended, or it leaves."""
        self._asks = failure
        self.in_engine = failure.in_engine
        self.away = failure.how != "ended"
        self._why = "" if self.away else failure.why

    def lose(self, why: str) -> None:
        if self._why is None:
            self._why = why
            self.away = True
            self._asks = None

    def listen(self, hear: MessageHandler) -> bool:
        self._held = True
        while self._said:
            message, query, reply = self._said.popleft()
            if message is not None:
                hear(message)
            if query is not None:
                query.answer(reply_in_bytes(reply))
            if isinstance(message, Done):
                self._why = ""
        if self._why is None and time.monotonic() - self._heard_s > LEASE_S:
            self._keeper.ended_late(self)
            self.lose(f"worker {self.at[0]} fell silent")
        return self._why is None

    def hang_up(self) -> None:
        """It has one job, and ends with it."""

    def kill(self, *, wait: bool = True) -> None:
        """Its lease is over: when it renews it next it is told so."""
        self._keeper.forget(self)
        for message, query, _ in self._said:
            if (
                query is not None and wait and not isinstance(message, Done)
            ):  # a result is sent again
                query.answer(reply_in_bytes(LetGo()))
        self._said.clear()

    def end(self) -> str:
        self._keeper.forget(self)
        return self._why or ""

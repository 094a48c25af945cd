"""Defines how jobs reach the workers that run episodes, and how their messages and results come
back.

A transport starts workers; what a run does about a failed episode is decided in
`scenarios.runs.pool`, and is the same for all transports. A record and its log travel as
bytes, so that a worker needs no access to the run folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Literal, NamedTuple, Protocol

from cosim.results.run_folder import RunFolder
from cosim.spec.scenario import Scenario
from scenarios.ipc.faults import Failure
from scenarios.ipc.messages import Done, Hello, Job, MessageHandler


class Worker(Protocol):
    """Runs episodes, one at a time, with the policy of its Hello."""

    @property
    def log(self) -> str:
        """Path of the file with its output."""

    @property
    def ended(self) -> bool:
        """Whether it takes no more jobs."""

    def give(self, job: Job) -> None:
        """Send it a job."""

    def poll(self, hear: MessageHandler) -> Failure | None:
        """Pass on the messages that have arrived, without waiting; return the failure of its job if
        it has failed."""

    def cancel(self) -> None:
        """Take its job away."""

    def stop(self) -> None:
        """Tell it to end, by force if it is busy, without waiting for that."""

    def end(self) -> None:
        """Wait until it has ended."""


Reception = Literal["kept", "duplicate", "conflict", "refused"]
"""What became of a result: it is kept, equals or contradicts the one in the run folder, or is of no
use."""


class AdoptedJob(NamedTuple):
    """A scenario that a worker runs already: the run was resumed, or had given the worker up for
    lost."""

    scenario: str
    worker: Worker


class LateResult(NamedTuple):
    """A result that arrives after the job was reassigned. `answer` is called with what became of
    it."""

    done: Done
    answer: Callable[[Reception], None]


class Transport(Protocol):
    """Starts workers."""

    def room(self, busy: int) -> int:
        """Return how many more jobs can be given now, while `busy` workers have one."""

    def unsolicited(self) -> Iterable[AdoptedJob | LateResult]:
        """Return the jobs and results that have arrived since the last call without being
        requested."""

    def start(self, hello: Hello) -> Worker:
        """Start one more worker. Raises MachineError when that is impossible."""

    def wait(self, timeout_s: float) -> None:
        """Wait until a worker may have something to report, or the time is over."""


class HeldRun(NamedTuple):
    """A run whose folder is locked by this process.

    hello: introduces its policy.
    picked: its scenarios, of a shard those of the shard.
    todo: those of them that are to be run.
    """

    held: RunFolder
    hello: Hello
    picked: Sequence[Scenario]
    todo: Sequence[Scenario]


TransportFactory = Callable[
    [HeldRun, MessageHandler], AbstractContextManager[tuple[Transport, MessageHandler]]
]
"""Creates the transport for a run and wraps its progress callback."""

"""Interfaces of transports and workers, which carry jobs to processes and results back.

`scenarios.runs.pool` decides about failed episodes, in the same way for all transports. A record
and its log are sent as bytes, so that a worker needs no access to the run folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Literal, NamedTuple, Protocol

from cosim.results.run_folder import RunFolder
from cosim.spec.scenario import Scenario
from scenarios.ipc.faults import AttemptFailure
from scenarios.ipc.messages import Done, Hello, Job, MessageHandler


class Worker(Protocol):
    """Interface of a worker, which runs one episode at a time with the policy of its Hello."""

    @property
    def log(self) -> str:
        """Path of the file with its output."""

    @property
    def ended(self) -> bool:
        """Whether it takes no more jobs."""

    def give(self, job: Job) -> None:
        """Send it a job."""

    def poll(self, handle: MessageHandler) -> AttemptFailure | None:
        """Pass on the messages that have arrived, without waiting; return the failure of its job if
        it has failed."""

    def cancel(self) -> None:
        """Take its job away."""

    def stop(self) -> None:
        """Request it to end, by force if it is busy, without waiting."""

    def end(self) -> None:
        """Wait until it has ended."""


ResultOutcome = Literal["kept", "duplicate", "conflict", "refused"]
"""Outcome of a result: it is stored, equals or contradicts the stored one, or is unusable."""


class AdoptedJob(NamedTuple):
    """A scenario that a worker runs already, because the run was resumed or the lease expired."""

    scenario: str
    worker: Worker


class LateResult(NamedTuple):
    """A result that arrives after the job was reassigned. `answer` is called with its outcome."""

    done: Done
    answer: Callable[[ResultOutcome], None]


class Transport(Protocol):
    """Interface of a transport, which starts workers."""

    def room(self, busy: int) -> int:
        """Return how many more jobs can be given now, while `busy` workers have one."""

    def unsolicited(self) -> Iterable[AdoptedJob | LateResult]:
        """Return the unrequested jobs and results that have arrived since the last call."""

    def start(self, hello: Hello) -> Worker:
        """Start one more worker. Raises MachineError when that is impossible."""

    def wait(self, timeout_s: float) -> None:
        """Wait until a worker may have something to report, or the time is over."""


class LockedRun(NamedTuple):
    """A run whose folder is locked by this process.

    hello: introduces its policy.
    scenarios: its scenarios, or those of its shard.
    todo: those of them without a result.
    """

    folder: RunFolder
    hello: Hello
    scenarios: Sequence[Scenario]
    todo: Sequence[Scenario]


TransportFactory = Callable[
    [LockedRun, MessageHandler], AbstractContextManager[tuple[Transport, MessageHandler]]
]
"""Creates the transport for a run and wraps its progress callback."""

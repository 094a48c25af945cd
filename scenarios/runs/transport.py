"""Transport: how jobs reach the workers that run episodes, and how what those say comes back.

A transport carries, and nothing else: what a run does when a worker dies, falls silent or reports a
damaged record stands above it, in `scenarios.runs.pool`, and is the same for all of them. A record
and its log travel as bytes, so that a worker needs no folder of the run's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Literal, NamedTuple, Protocol

from cosim.episode.policy_caller import Driver
from cosim.results.run_folder import RunFolder
from cosim.spec.scenario import Scenario
from scenarios.ipc.deadlines import Patience, Question
from scenarios.ipc.messages import Done, Hello, Job, MessageHandler
from scenarios.runs.worker import run_job


class Worker(Protocol):
    """Runs episodes, one at a time, with the policy of its Hello."""

    @property
    def log(self) -> str:
        """Where one can read what it has printed."""

    @property
    def question(self) -> Question | None:
        """What its policy is asked right now, or was asked when it ended; None where nothing can be
        known."""

    @property
    def in_engine(self) -> bool:
        """Whether it was a fault of compiled code that ended it, while its policy was asked
        nothing."""

    @property
    def away(self) -> bool:
        """Whether it has left, or was lost with all that is beside it: its end tells nothing of its
        episode."""

    def give(self, job: Job) -> None:
        """Hand it a job. One that has died does not hear it: the next `listen` tells."""

    def listen(self, hear: MessageHandler) -> bool:
        """Tell what it has said since, whole messages in their order, without waiting for more;
        False when it has ended and nothing more will come."""

    def hang_up(self) -> None:
        """It gets no more jobs, and ends when it has none."""

    def kill(self, *, wait: bool = True) -> None:
        """End it by force, with everything that it has started."""

    def end(self) -> str:
        """Wait until it has ended, by force if need be. Returns how it ended, in words."""


Reception = Literal["kept", "duplicate", "conflict", "refused"]
"""What became of a result: kept; there already, alike; there already, with other content; of no
use."""


class GoesOn(NamedTuple):
    """A worker that runs a scenario of this run though nobody here has given it that: the run was
    begun anew, or had given it up for lost."""

    scenario: str
    worker: Worker


class Late(NamedTuple):
    """A result from a worker that the job had been taken from. answer: to be told what became of
    it."""

    done: Done
    answer: Callable[[Reception], None]


class Transport(Protocol):
    """Starts workers. A worker tells that it is `Ready` or `Unable` before it says anything
    else."""

    def room(self, busy: int) -> int:
        """How many more jobs can be given now, while so many are."""

    def unasked(self) -> Iterable[GoesOn | Late]:
        """What has come without having been asked for since the last time."""

    def start(self, hello: Hello) -> Worker:
        """One more worker. Raises MachineError when there can be none."""

    def wait(self, timeout_s: float) -> None:
        """Until a worker that has not ended may have something to tell, or the time is over."""


class HeldRun(NamedTuple):
    """A run whose folder is held. hello: its policy; patience: with that; picked: its scenarios, of
    a shard those of that; todo: what of these is to be run."""

    held: RunFolder
    hello: Hello
    patience: Patience
    picked: Sequence[Scenario]
    todo: Sequence[Scenario]


Reaches = Callable[
    [HeldRun, MessageHandler], AbstractContextManager[tuple[Transport, MessageHandler]]
]
"""How workers are reached for a run, and what is to be told of their episodes in place of what was
to be."""


class InProcess:
    """Episodes run in this process, one after another, while they are listened to, by a policy that
    was loaded here.

    One that hangs or dies takes the run with it: no time limit of an answer can be kept.
    """

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    def room(self, busy: int) -> int:
        return 1 - busy

    def unasked(self) -> tuple[()]:
        return ()

    def start(self, hello: Hello) -> _Here:
        return _Here(self._driver)

    def wait(self, timeout_s: float) -> None:
        """Nothing: who listens has the next job done."""


class _Here:
    """A worker that works when it is listened to."""

    log = "this process's own output"
    question: Question | None = None
    in_engine = away = False

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._job: Job | None = None

    def give(self, job: Job) -> None:
        self._job = job

    def listen(self, hear: MessageHandler) -> bool:
        job = self._job
        self._job = None
        if job is None:
            return True
        done, _ = run_job(job, self._driver, hear)
        hear(done)
        return True

    def hang_up(self) -> None:
        """It has nothing that would have to end."""

    def kill(self, *, wait: bool = True) -> None:
        """Nobody who could is left while it works."""

    def end(self) -> str:
        return "this process goes on"

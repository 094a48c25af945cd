"""A worker: holds the session with the coordinator, and starts the processes that run episodes.

No engine is loaded in this process: what takes an environment process down, or hangs in it, does
not touch the session. It needs nothing of the run but the address: policy, options and scenarios
come with the jobs.
"""

from __future__ import annotations

import os
import queue
import secrets
import select
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Final

from bridge import keys
from bridge.session import Session, open_session
from cosim.core.errors import CosimError, EngineError, MachineError
from cosim.core.files import temp_folder
from cosim.core.progress import Progress
from cosim.spec.connection import Connection
from scenarios.runs.environment_slot import NET, RunEnded, Wish, WorkSlot
from scenarios.runs.protocol import installed_here, reply_in

_RETRY_S: Final = 0.5
_WAIT_S: Final = 0.25
_LOOKS_S: Final = 5.0
"""So long nothing is heard of the run before it is looked for another one at the same place."""
_PARTING_S: Final = 10.0
"""How long a worker that leaves goes on trying to hand over what it has."""
_TELLING_S: Final = 2.0
GIVEN_UP_S: Final = 600.0
"""A worker that is there for one run ends when it has heard of none for so long: that it is over
may have been told when nobody could hear it."""


class Leaving:
    """Whether the process was asked to leave, and by which signal; and a bell that ends a wait."""

    def __init__(self) -> None:
        self.signal = 0
        self.bell = os.eventfd(0, os.EFD_NONBLOCK)

    def ring(self) -> None:
        os.eventfd_write(self.bell, 1)

    def wait(self, descriptors: list[int], timeout_s: float) -> None:
        """Until the bell rings, something can be read, or the time is over."""
        poll = select.poll()
        for descriptor in (self.bell, *descriptors):
            poll.register(descriptor, select.POLLIN)
        poll.poll(max(timeout_s, 0.0) * 1000.0)
        with suppress(BlockingIOError):
            os.eventfd_read(self.bell)

    def leave(self, number: int, frame: FrameType | None) -> None:
        self.signal = self.signal or number
        self.ring()


@contextmanager
def _signals_heard() -> Iterator[Leaving]:
    """SIGTERM and Ctrl-C are requests to leave, meanwhile."""
    leaving = Leaving()
    before = {
        number: signal.signal(number, leaving.leave) for number in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield leaving
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(leaving.bell)


def work(
    connection: Connection,
    jobs: int,
    say: Progress,
    *,
    once: bool = False,
    logs: Path | None = None,
) -> int:
    """Work for the runs that are to be found at an address, `jobs` episodes at a time, until asked
    to leave, or with `once` until one is over. Returns the number of the signal that asked, 0 if
    none did.

    logs: the folder for what processes print, by default one that is gone afterwards. say: what to
    tell the user, a line each. Raises UsageError when the run refuses this worker, MachineError
    when no episode can be run here, or with `once` when no run is heard of any more."""
    with ExitStack() as stack:
        leaving = stack.enter_context(_signals_heard())
        if logs is None:
            logs = stack.enter_context(temp_folder("cosim-worker-"))
        logs.mkdir(parents=True, exist_ok=True)
        heard = _Heard(connection.endpoint, once)
        session = _reached(connection, leaving, heard, say)
        if session is None:
            return leaving.signal
        stack.enter_context(session)
        told = False
        over = ""
        over_s = 0.0
        while not leaving.signal:
            runs = [key.split("/")[1] for key in session.answers(keys.EVERY_RUN, timeout_s=5.0)]
            if not runs or (runs[0] == over and time.monotonic() - over_s < _PARTING_S):
                if not told:
                    say(f"waits for a run at {connection.endpoint}")
                told = True
                heard.look()
                leaving.wait([], _RETRY_S)
                continue
            told = False
            if _Service(session, connection, runs[0], jobs, logs, leaving, heard, say).serve():
                if once:
                    return 0
                over = runs[0]
                over_s = time.monotonic()
        return leaving.signal


class _Heard:
    """When something was heard of a run. once: whether it is waited for no longer than
    GIVEN_UP_S."""

    def __init__(self, endpoint: str, once: bool) -> None:
        self._endpoint = endpoint
        self._once = once
        self.now()

    def now(self) -> None:
        self._at_s = time.monotonic()

    def look(self) -> None:
        """Raises MachineError when nothing was for too long."""
        if self._once and time.monotonic() - self._at_s > GIVEN_UP_S:
            raise MachineError(
                f"no run was heard of at {self._endpoint} for {GIVEN_UP_S:g} s: is it over? "
                "Without --once a worker waits for the next one"
            )


def _reached(
    connection: Connection, leaving: Leaving, heard: _Heard, say: Progress
) -> Session | None:
    """A session with the coordinator, waited for; None when asked to leave before that. Raises
    AccessError."""
    told = False
    while not leaving.signal:
        heard.look()
        try:
            return open_session(connection, say)
        except EngineError:
            if not told:
                say(f"waits for a coordinator at {connection.endpoint}")
                told = True
        leaving.wait([], _RETRY_S)
    return None


class _Service:
    """For one run."""

    def __init__(
        self,
        session: Session,
        reach: Connection,
        run: str,
        jobs: int,
        logs: Path,
        leaving: Leaving,
        heard: _Heard,
        say: Progress,
    ) -> None:
        self._session = session
        self._run = run
        self._leaving = leaving
        self._heard = heard
        self._say = say
        host = socket.gethostname()
        self._name = keys.chunk(f"{host[:40]}-{os.getpid()}-{secrets.token_hex(3)}")
        installed = installed_here()
        self._slots = [
            WorkSlot(self._name, number, host, installed, logs, reach) for number in range(jobs)
        ]
        self._replies: queue.SimpleQueue[tuple[WorkSlot | None, str, bytes | None, str]] = (
            queue.SimpleQueue()
        )
        self._looks_s = time.monotonic() + _LOOKS_S
        self._quiet = False
        self._told = ""

    def serve(self) -> bool:
        """Until the run is over (True), another one is at its place, or this process is asked to
        leave."""
        leave = self._session.stand(keys.worker(self._run, self._name))
        self._say(f"works for run {self._run} as {self._name}")
        try:
            while not self._leaving.signal:
                self._turn(listen=True)
                if self._other_run():
                    self._say("another run is there now")
                    return False
            self._part()
        except RunEnded:
            self._say(f"run {self._run} is over")
            return True
        except CosimError as error:
            self._send(None, self._slots[0].unable(str(error)))
            self._leaving.wait([], _TELLING_S)
            raise
        finally:
            leave()
            for slot in self._slots:
                slot.end()
        return False

    def _turn(self, *, listen: bool) -> None:
        """Say what is to be said, wait until something happens, take it in."""
        now_s = time.monotonic()
        for slot in self._slots:
            for wish in slot.wishes(now_s):
                self._send(slot, wish)
        found = [slot.descriptor for slot in self._slots]
        self._leaving.wait([one for one in found if one is not None and listen], _WAIT_S)
        while not self._replies.empty():
            self._take(*self._replies.get_nowait())
        if listen:
            for slot in self._slots:
                slot.listen()

    def _send(self, slot: WorkSlot | None, wish: Wish) -> None:
        def replied(payload: bytes | None, error: str) -> None:
            self._replies.put((slot, wish.act, payload, error))
            self._leaving.ring()

        is_net, digest = wish.act.startswith(NET), wish.act.removeprefix(NET)
        key = keys.net(self._run, digest) if is_net else keys.job(self._run, wish.act)
        self._session.send(key, wish.payload, replied, timeout_s=wish.timeout_s)

    def _take(self, slot: WorkSlot | None, act: str, payload: bytes | None, error: str) -> None:
        if payload is not None:
            self._heard.now()
            self._looks_s = time.monotonic() + _LOOKS_S
            if self._quiet:
                self._say("the coordinator is there again")
            self._quiet = False
        if error and error != self._told:
            self._told = error
            self._say(f"the coordinator refused a '{act}': {error}")
        if slot is not None and act.startswith(NET):
            slot.part_came(payload, error)
        elif slot is not None:
            slot.replied(act, None if payload is None else reply_in(payload))

    def _other_run(self) -> bool:
        """Whether another run is to be found where this one was; looked for when nothing is heard
        of it."""
        if time.monotonic() < self._looks_s:
            return False
        self._heard.look()
        if not self._quiet:
            self._say("the coordinator does not answer: waits for it")
        self._quiet = True
        self._looks_s = time.monotonic() + 1.0
        runs = [key.split("/")[1] for key in self._session.answers(keys.EVERY_RUN, timeout_s=2.0)]
        return bool(runs) and self._run not in runs

    def _part(self) -> None:
        """Hand the jobs back, and over what is done."""
        for slot in self._slots:
            slot.release()
        until_s = time.monotonic() + _PARTING_S
        while any(slot.holds_result for slot in self._slots) and time.monotonic() < until_s:
            self._turn(listen=False)
        self._say("has left")

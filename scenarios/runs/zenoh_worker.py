"""Worker for runs on other machines, with a Zenoh session to the coordinator and environment slots.

No engine is loaded in this process, so that a crash of an engine does not end the session. It needs
only the run's address: policy, options and scenarios are sent with the jobs.
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
from scenarios.runs.job_client import CoordinatorRequest, JobClient, RunEnded, WorkerIdentity
from scenarios.runs.protocol import installed_here

_RETRY_S: Final = 0.5
"""Seconds between two attempts to find a coordinator or a run."""
_WAIT_S: Final = 0.25
"""Longest time in seconds between two checks of the environment slots."""
_LOOK_AFTER_S: Final = 5.0
"""Seconds without a reply after which a worker looks for another run at the same address."""
_PARTING_S: Final = 10.0
"""Seconds for which a worker that leaves tries to deliver its results."""
_LAST_REPORT_S: Final = 2.0
"""Seconds that the report of a worker that can run nothing may take."""
GIVEN_UP_S: Final = 600.0
"""Seconds without a reply after which a worker for one run ends: it may have missed that the run is
over."""


class Leaving:
    """The signal that requests this process to leave, 0 for none, and a bell that ends a wait."""

    def __init__(self) -> None:
        self.signal = 0
        self.bell = os.eventfd(0, os.EFD_NONBLOCK)

    def ring(self) -> None:
        os.eventfd_write(self.bell, 1)

    def wait(self, descriptors: list[int], timeout_s: float) -> None:
        """Wait until the bell rings, a descriptor is readable, or the time is over."""
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
def _signals_caught() -> Iterator[Leaving]:
    """Take SIGTERM and Ctrl-C as requests to leave, inside the block."""
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
    """Work for the runs at an address until a signal requests to leave, or with `once` until a run
    is over.

    jobs: number of episodes at a time.
    say: called with each line for the user.
    logs: folder for the output of the processes; by default a temporary one.

    Returns the number of the signal, or 0. Raises UsageError if the run refuses this worker.
    Raises MachineError if no episode can be run here, or with `once` without a run for GIVEN_UP_S.
    """
    with ExitStack() as stack:
        leaving = stack.enter_context(_signals_caught())
        if logs is None:
            logs = stack.enter_context(temp_folder("cosim-worker-"))
        logs.mkdir(parents=True, exist_ok=True)
        contact = _Contact(connection.endpoint, once, say)
        session = _connected(connection, leaving, contact, say)
        if session is None:
            return leaving.signal
        stack.enter_context(session)
        over = ""
        over_s = 0.0
        while not leaving.signal:
            runs = [key.split("/")[1] for key in session.query_all(keys.EVERY_RUN, timeout_s=5.0)]
            if not runs or (runs[0] == over and time.monotonic() - over_s < _PARTING_S):
                contact.missing(f"waits for a run at {connection.endpoint}")
                leaving.wait([], _RETRY_S)
                continue
            if _Service(session, connection, runs[0], jobs, logs, leaving, contact, say).serve():
                if once:
                    return 0
                over = runs[0]
                over_s = time.monotonic()
        return leaving.signal


class _Contact:
    """The time of the last contact with a run. With `once` a run is waited for no longer than
    GIVEN_UP_S."""

    def __init__(self, endpoint: str, once: bool, say: Progress) -> None:
        self._endpoint = endpoint
        self._once = once
        self._say = say
        self._quiet = False
        self.made()

    def made(self, words: str = "") -> None:
        """Note a contact, and say so if there was none for a while."""
        if words and self._quiet:
            self._say(words)
        self._quiet = False
        self._at_s = time.monotonic()

    def missing(self, words: str) -> None:
        """Report, once, that there is no contact. Raises MachineError if the last one is too long
        ago."""
        if self._once and time.monotonic() - self._at_s > GIVEN_UP_S:
            raise MachineError(
                f"no run replied at {self._endpoint} for {GIVEN_UP_S:g} s: is it over? "
                "Without --once a worker waits for the next one"
            )
        if not self._quiet:
            self._say(words)
        self._quiet = True


def _connected(
    connection: Connection, leaving: Leaving, contact: _Contact, say: Progress
) -> Session | None:
    """Wait for a session with the coordinator, and return it; None after a request to leave. Raises
    AccessError."""
    while not leaving.signal:
        try:
            return open_session(connection, say)
        except EngineError:
            contact.missing(f"waits for a coordinator at {connection.endpoint}")
        leaving.wait([], _RETRY_S)
    return None


class _Service:
    """Works for one run, with `jobs` environment slots."""

    def __init__(
        self,
        session: Session,
        connection: Connection,
        run: str,
        jobs: int,
        logs: Path,
        leaving: Leaving,
        contact: _Contact,
        say: Progress,
    ) -> None:
        self._session = session
        self._run = run
        self._leaving = leaving
        self._contact = contact
        self._say = say
        host = socket.gethostname()
        self._name = keys.chunk(f"{host[:40]}-{os.getpid()}-{secrets.token_hex(3)}")
        identity = WorkerIdentity(self._name, host, installed_here(), connection)
        self._clients = [JobClient(run, number, identity, logs) for number in range(jobs)]
        self._replies: queue.SimpleQueue[
            tuple[JobClient | None, CoordinatorRequest, bytes | None, str]
        ] = queue.SimpleQueue()
        self._next_look_s = time.monotonic() + _LOOK_AFTER_S
        self._refusal = ""

    def serve(self) -> bool:
        """Work until the run is over (True), another one takes its place, or this process is to
        leave."""
        leave = self._session.declare_token(keys.worker(self._run, self._name))
        self._say(f"works for run {self._run} as {self._name}")
        try:
            while not self._leaving.signal:
                self._turn(listen=True)
                if self._other_run():
                    self._say("another run has replaced it")
                    return False
            self._hand_back()
        except RunEnded:
            self._say(f"run {self._run} is over")
            return True
        except CosimError as error:
            self._send(None, self._clients[0].unable(str(error)))
            self._leaving.wait([], _LAST_REPORT_S)
            raise
        finally:
            leave()
            for client in self._clients:
                client.close()
        return False

    def _turn(self, *, listen: bool) -> None:
        """Send the requests that are due, wait until something happens, and take it in."""
        now_s = time.monotonic()
        for client in self._clients:
            for request in client.requests(now_s):
                self._send(client, request)
        found = [client.descriptor for client in self._clients]
        self._leaving.wait([one for one in found if one is not None and listen], _WAIT_S)
        while not self._replies.empty():
            self._take(*self._replies.get_nowait())
        if listen:
            for client in self._clients:
                client.poll()

    def _send(self, client: JobClient | None, request: CoordinatorRequest) -> None:
        def replied(payload: bytes | None, error: str) -> None:
            self._replies.put((client, request, payload, error))
            self._leaving.ring()

        self._session.send_query(request.key, request.payload, replied, timeout_s=request.timeout_s)

    def _take(
        self,
        client: JobClient | None,
        request: CoordinatorRequest,
        payload: bytes | None,
        error: str,
    ) -> None:
        if payload is not None:
            self._contact.made("the coordinator answers again")
            self._next_look_s = time.monotonic() + _LOOK_AFTER_S
        if error and error != self._refusal:
            self._refusal = error
            self._say(f"the coordinator refused a '{request.act}': {error}")
        if client is not None:
            client.answered(request, payload, error)

    def _other_run(self) -> bool:
        """Return whether another run has taken the place of this one; checked while it does not
        answer."""
        if time.monotonic() < self._next_look_s:
            return False
        self._contact.missing("the coordinator does not answer: waits for it")
        self._next_look_s = time.monotonic() + 1.0
        runs = [key.split("/")[1] for key in self._session.query_all(keys.EVERY_RUN, timeout_s=2.0)]
        return bool(runs) and self._run not in runs

    def _hand_back(self) -> None:
        """Return the jobs to the run, and deliver the results that are ready."""
        for client in self._clients:
            client.release()
        until_s = time.monotonic() + _PARTING_S
        while any(client.has_unsent for client in self._clients) and time.monotonic() < until_s:
            self._turn(listen=False)
        self._say("has left")

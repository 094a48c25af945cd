"""Client of the coordinator for one environment slot of a worker: claims jobs and reports on them.

It holds no session: it returns the requests that are due, and takes in the replies. A request is
repeated until there is a reply.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from logging import WARNING
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec

from bridge import keys
from bridge.codec import encode
from cosim.core.errors import MachineError, UsageError
from cosim.core.log_event import log_event
from cosim.spec.connection import Connection
from cosim.spec.scenario import CityMap
from scenarios.ipc.child_process import ChildProcess
from scenarios.ipc.faults import AttemptFailure
from scenarios.ipc.messages import Done, EpisodeProgress, FrameDrawn, Hello, Message, Waits
from scenarios.runs.environment_slot import EnvironmentSlot, new_output, start_environment
from scenarios.runs.protocol import (
    MAX_DRIVEN_BYTES,
    MAX_SENT_BYTES,
    MAX_WORDS,
    Assignment,
    Claim,
    CoordinatorReply,
    Installed,
    Reply,
    Report,
    decode_reply,
    digest_of,
)

if TYPE_CHECKING:
    from scenarios.runs.net_transfer import MapDownload

REPORT_S: Final = 1.0
"""Seconds between two reports, each of which renews the lease."""
_FRAMES_BYTES: Final = 4 << 20
"""Size limit in bytes of the camera frames of one report."""
_PROGRESS_BYTES: Final = 100
"""Size in bytes of any other message of the environment process, about."""
_RESULT_BYTES: Final = MAX_SENT_BYTES - (1 << 17)
"""Size limit in bytes of a result: the rest is room for the other fields of a report."""
_LAST_PRINTED: Final = 60_000
"""Number of bytes that are sent of the output of a process."""
_FIRST_PAUSE_S: Final = 0.1
"""Seconds before an unanswered claim is repeated; each further pause is twice as long."""
_LONGEST_PAUSE_S: Final = 1.0


def _driven_in(failure: AttemptFailure | None) -> bytes:
    """Return the record of what was driven, unless it is more than can be sent."""
    driven = b"" if failure is None else failure.driven
    return driven if len(driven) <= MAX_DRIVEN_BYTES else b""


class RunEnded(Exception):
    """The run is over."""


class CoordinatorRequest(NamedTuple):
    """A request to the coordinator: its kind, the key that it is sent to, and the seconds it may
    take."""

    act: Literal["claim", "net", "report"]
    key: str
    payload: bytes
    timeout_s: float


class WorkerIdentity(NamedTuple):
    """The worker of a client: its unique name, its host's name, and the installed versions."""

    worker: str
    host: str
    installed: Installed
    connection: Connection


class JobClient:
    """Runs the jobs of a run in slot `number` of a worker.

    The output of its processes, which `start` starts, goes to the folder `logs`.
    """

    def __init__(
        self,
        run: str,
        number: int,
        identity: WorkerIdentity,
        logs: Path,
        start: Callable[[Path, Hello], ChildProcess] = start_environment,
    ) -> None:
        self._run = run
        self._number = number
        self._identity = identity
        self._start = start
        self._log = logs / f"{number}.log"
        self._log_sent = 0
        self._log_size = 0
        self._slot: EnvironmentSlot | None = None
        self._leaving = False
        self._claiming = False
        self._claim_at_s = 0.0
        self._pause_s = _FIRST_PAUSE_S
        self._download: MapDownload | None = None
        self._lease: Assignment | None = None
        self._reporting = False
        self._report_at_s = 0.0
        self._said: list[EpisodeProgress | Waits | FrameDrawn] = []
        self._said_sent = 0
        self._done: Done | None = None
        self._failure: AttemptFailure | None = None

    @property
    def descriptor(self) -> int | None:
        """File descriptor that is readable when the process has a message."""
        return None if self._slot is None else self._slot.descriptor

    @property
    def has_unsent(self) -> bool:
        """Whether there is a result or a failure that the coordinator has not acknowledged."""
        return self._done is not None or self._failure is not None

    def requests(self, now_s: float) -> list[CoordinatorRequest]:
        """Return the requests that are due. Each is answered by `answered`."""
        found = []
        if (
            not self._claiming
            and now_s >= self._claim_at_s
            and (request := self._claim()) is not None
        ):
            self._claiming = True
            found.append(request)
        if self._lease is not None and not self._reporting and now_s >= self._report_at_s:
            self._reporting = True
            self._report_at_s = now_s + REPORT_S
            timeout_s = 30.0 if self.has_unsent else 5.0
            found.append(
                CoordinatorRequest(
                    "report",
                    keys.job(self._run, "report"),
                    encode(self._report(self._lease)),
                    timeout_s,
                )
            )
        return found

    def answered(self, request: CoordinatorRequest, payload: bytes | None, error: str) -> None:
        """Take in the reply to a request, None if there was none.

        Raises RunEnded, UsageError if this worker cannot work for the run, MachineError if a map
        cannot be had."""
        if request.act == "report":
            self._reporting = False
            if payload is not None:
                self._report_answered(decode_reply(payload))
            return
        self._claiming = False
        if request.act == "net" and error and self._download is not None:
            raise MachineError(f"a map of the run cannot be had: {error}")
        if payload is None:
            self._claim_at_s = time.monotonic() + self._pause_s
            self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
            return
        self._pause_s = _FIRST_PAUSE_S
        if request.act == "claim":
            self._claim_answered(decode_reply(payload))
        elif self._download is not None and self._download.take(payload):
            self._download = None
            self._give()

    def poll(self) -> None:
        """Take in messages of the process. Raises UsageError or MachineError when it can run
        nothing."""
        if self._slot is None or self._leaving:
            return
        self._slot.start()
        failure = self._slot.poll(self._take)
        if failure is not None:
            self._fail(failure)

    def release(self) -> None:
        """Hand the job back, if it is not done: this worker leaves."""
        if self._lease is not None and not self.has_unsent:
            self._fail(AttemptFailure("handed_back"))
        self._leaving = True
        self.close()

    def close(self) -> None:
        """End the process."""
        self._download = None
        if self._slot is not None:
            self._slot.cancel()

    def unable(self, why: str) -> CoordinatorRequest:
        """Return the request that reports, once, that nothing can be run here."""
        self._failure = AttemptFailure("worker_unable", why)
        report = self._report(self._lease)
        return CoordinatorRequest("report", keys.job(self._run, "report"), encode(report), 5.0)

    def _claim(self) -> CoordinatorRequest | None:
        """Return the next request of this slot: for a map, the policy's introduction, or a job."""
        if self._download is not None:
            return CoordinatorRequest(
                "net", keys.net(self._run, self._download.digest), self._download.request, 10.0
            )
        if (
            self._leaving
            or self._lease is not None
            or (self._slot is not None and not self._slot.ready)
        ):
            return None
        claim = Claim(
            worker=self._identity.worker,
            slot=self._number,
            host=self._identity.host,
            installed=dict(self._identity.installed),
            ready=self._slot is not None,
        )
        return CoordinatorRequest("claim", keys.job(self._run, "claim"), encode(claim), 10.0)

    def _claim_answered(self, reply: CoordinatorReply) -> None:
        match reply:
            case Hello():
                host = reply.host.seen_by(self._identity.connection)
                hello = msgspec.structs.replace(reply, host=host)
                self._slot = EnvironmentSlot(partial(self._start, self._log), hello)
            case Assignment():
                self._begin(reply)
            case Reply(kind="turned_away"):
                raise UsageError(reply.why)
            case Reply(kind="over"):
                raise RunEnded
            case _:
                pass

    def _begin(self, lease: Assignment) -> None:
        log_event("claimed", scenario=lease.job.scenario.id, slot=self._number, lease=lease.lease)
        self._lease = lease
        self._report_at_s = time.monotonic() + REPORT_S
        where = lease.job.scenario.place
        if isinstance(where, CityMap):
            # Imported only where needed: it loads the importer of maps.
            from scenarios.runs.net_transfer import MapDownload, is_missing

            if is_missing(where):
                self._download = MapDownload(where, lease.job.net_hash)
        self._give()

    def _give(self) -> None:
        """Run the job once its map is here."""
        if self._slot is not None and self._lease is not None and self._download is None:
            self._slot.give(self._lease.job)

    def _take(self, message: Message) -> None:
        if isinstance(message, Done):
            self._done = message
            self._report_at_s = 0.0
        elif isinstance(message, EpisodeProgress | Waits | FrameDrawn):
            if isinstance(message, EpisodeProgress):
                unsent = self._said[self._said_sent :]
                self._said[self._said_sent :] = [
                    one for one in unsent if not isinstance(one, EpisodeProgress)
                ]
            self._said.append(message)
            if isinstance(message, FrameDrawn):
                self._report_at_s = 0.0

    def _fail(self, failure: AttemptFailure) -> None:
        assert self._lease is not None
        event = "handed back" if failure.fault == "handed_back" else "failed"
        log_event(event, WARNING, scenario=self._lease.job.scenario.id, why=failure.why)
        self._failure = failure
        self._done = None
        self._said.clear()
        self._report_at_s = 0.0

    def _report(self, lease: Assignment | None) -> Report:
        """Return a report with as much as one message holds; a result goes with the last one."""
        size = self._fill()
        done = self._done if self._said_sent == len(self._said) else None
        if done is not None and size + len(done.record) + len(done.log) > _RESULT_BYTES:
            if not self._said:
                megabytes = (len(done.record) + len(done.log)) >> 20
                words = f"its result of {megabytes} MB is more than can be sent"
                self._fail(AttemptFailure("engine_failed", words))
            done = None
        failure = self._failure
        printed = b""
        if done is not None or failure is not None:
            printed, self._log_size = new_output(self._log, self._log_sent, _LAST_PRINTED)
        return Report(
            worker=self._identity.worker,
            slot=self._number,
            lease=0 if lease is None else lease.lease,
            scenario="" if lease is None else lease.job.scenario.id,
            said=tuple(self._said[: self._said_sent]),
            done=done,
            digest="" if done is None else digest_of(done),
            fault=None if failure is None else failure.fault,
            why="" if failure is None else failure.why[:MAX_WORDS],
            found="" if failure is None else failure.found,
            driven=_driven_in(failure),
            printed=printed,
        )

    def _fill(self) -> int:
        """Choose the messages that go with the next report; return their size."""
        self._said_sent = 0
        size = 0
        for message in self._said:
            more = len(message.png) if isinstance(message, FrameDrawn) else _PROGRESS_BYTES
            if self._said_sent and size + more > _FRAMES_BYTES:
                break
            self._said_sent += 1
            size += more
        return size

    def _report_answered(self, reply: CoordinatorReply) -> None:
        if not isinstance(reply, Reply):
            return
        if reply.kind == "turned_away":
            raise UsageError(reply.why)
        if reply.kind == "renewed":
            del self._said[: self._said_sent]
            if self._said or self.has_unsent:
                self._report_at_s = 0.0
        elif reply.kind != "revoked":
            if self._done is not None:
                log_event(
                    "done", scenario=self._done.scenario, status=self._done.status, how=reply.kind
                )
            self._log_sent = self._log_size
            self._drop_job()
        elif self.has_unsent:  # the run may still use the result
            self._said.clear()
            self._report_at_s = 0.0
        else:
            self._drop_job()
            self.close()
        self._said_sent = 0

    def _drop_job(self) -> None:
        self._lease = None
        self._done = None
        self._failure = None
        self._said.clear()

"""Registry of connected workers, their progress and protocol errors, for `cosim status` and the run
folder."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from logging import DEBUG, WARNING
from pathlib import Path
from typing import Final, Literal

import msgspec

from cosim.core.errors import EngineError
from cosim.core.files import write_atomic
from cosim.core.log_event import log_event
from cosim.results.run_folder import RunFolder
from cosim.spec.scenario import Scenario
from scenarios.ipc.messages import Done, EpisodeProgress, Message, MessageHandler, Waits
from scenarios.runs.protocol import Report

STATUS_FILE: Final = "status.json"
LOG_FILE: Final = "logs/coordinator.log"
CONFLICT: Final = "CONFLICT"
SILENT_S: Final = 4.0
"""Seconds without a report after which a worker is shown as silent: it reports every second."""
_WRITTEN_EVERY_S: Final = 2.0
_MAX_REFUSED: Final = 1000
"""Number of refused messages that are logged."""
_MAX_GONE: Final = 1000
"""Number of workers that have left or were lost and are still listed."""
_MAX_PRINTED: Final = 4 << 20
"""Size limit in bytes of the log of each environment process."""

State = Literal["working", "idle", "silent", "lost", "left", "turned away"]


class RunningEpisode(msgspec.Struct, kw_only=True):
    """An episode that a worker runs.

    time_s: simulated seconds.
    share: driven part of its route, 0 to 1.
    moved_at_s: wall clock of its last progress.
    waits: reason for which it waits, "" if it does not.
    """

    scenario: str
    time_s: float = 0.0
    share: float = 0.0
    moved_at_s: float = msgspec.field(default_factory=time.time)
    waits: str = ""

    def take(self, message: Message, length_m: float) -> None:
        """Note a message about the episode, whose route has this length."""
        self.moved_at_s = time.time()
        self.waits = message.reason if isinstance(message, Waits) else ""
        if isinstance(message, EpisodeProgress) and message.compared is not None:
            self.share = 1.0
            self.waits = f"is compared, {message.compared:.0%}"
        elif isinstance(message, EpisodeProgress):
            self.time_s = message.time_s
            self.share = min(max(message.route_s_m / length_m, 0.0), 1.0)


class WorkerStatus(msgspec.Struct, kw_only=True):
    """The state of a worker, and the reason for it.

    heard_at_s: wall clock of its last message.
    done: number of its results.
    episodes: running episodes by slot number.
    """

    name: str
    host: str
    state: State = "idle"
    why: str = ""
    connected: bool = True
    heard_at_s: float = msgspec.field(default_factory=time.time)
    done: int = 0
    episodes: dict[int, RunningEpisode] = msgspec.field(default_factory=dict)

    def state_at(self, at_s: float) -> State:
        """Return its state as of a moment: "silent" after a few seconds without a message."""
        silent = self.state in ("working", "idle") and at_s - self.heard_at_s > SILENT_S
        return "silent" if silent else self.state


class RunStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The progress of a run.

    since_s: seconds since it began, or was resumed.
    at_s: wall clock when the status was taken.
    per_hour: episodes an hour; None before the first is done.
    left_s: estimated seconds to its end; None before the first is done.
    lost: number of episodes that were lost with their workers.
    refused: number of messages that were refused.
    """

    suite: str
    policy: str
    folder: str
    total: int
    finished: int
    since_s: float = 0.0
    at_s: float = 0.0
    per_hour: float | None = None
    left_s: float | None = None
    lost: int = 0
    refused: int = 0
    workers: tuple[WorkerStatus, ...] = ()
    conflicts: tuple[str, ...] = ()


class WorkerRegistry:
    """Registry of the workers of one run, whose folder is locked by this process.

    handle: progress callback of the run.
    """

    def __init__(
        self, held: RunFolder, scenarios: Sequence[Scenario], finished: int, handle: MessageHandler
    ) -> None:
        self._held = held
        self._handle = handle
        self._lengths_m = {one.id: max(one.route_line.length_m, 1.0) for one in scenarios}
        self._before = finished
        self._finished = finished
        self._began_s = time.monotonic()
        self._written_s = 0.0
        self._workers: dict[str, WorkerStatus] = {}
        self._lost = 0
        self._refused = 0
        self._conflicts = [line for line in _lines(held.path / LOG_FILE) if CONFLICT in line]

    @property
    def any_connected(self) -> bool:
        """Whether a worker is connected."""
        return any(one.connected for one in self._workers.values())

    def handle(self, message: Message) -> None:
        """Pass on a message about an episode."""
        self._finished += isinstance(message, Done)
        self._handle(message)

    def claimed(self, worker: str, host: str, slot: int) -> None:
        """Note that a slot of a worker has no job."""
        one = self._of(worker, host)
        one.episodes.pop(slot, None)
        one.state = "working" if one.episodes else "idle"
        one.why = ""

    def assigned(self, worker: str, slot: int, scenario: str) -> None:
        """Note the job that a slot of a worker has been given."""
        one = self._of(worker, "")
        one.state = "working"
        one.episodes[slot] = RunningEpisode(scenario=scenario)

    def reported(self, report: Report) -> None:
        """Note the progress or the end of a job."""
        one = self._of(report.worker, "")
        if report.done is not None:
            one.episodes.pop(report.slot, None)
            one.done += 1
        elif report.fault is not None:
            one.episodes.pop(report.slot, None)
            where = f"{report.worker}/{report.slot}: {report.scenario or 'no episode'}"
            self.note(f"{where}: {report.fault.replace('_', ' ')}: {report.why}".rstrip(": "))
            if report.fault == "worker_unable":
                one.state = "turned away"
                one.why = report.why
            elif report.fault == "handed_back":
                one.state = "left"
        else:
            one.state = "working"
            one.why = ""
            episode = one.episodes.get(report.slot)
            if episode is None or episode.scenario != report.scenario:
                episode = one.episodes[report.slot] = RunningEpisode(scenario=report.scenario)
            for message in report.said:
                episode.take(message, self._lengths_m.get(message.scenario, 1.0))

    def disconnected(self, worker: str) -> None:
        """Note that a worker is lost, or has left."""
        one = self._workers.get(worker)
        if one is not None:
            one.connected = False
        if one is None or one.state in ("left", "turned away"):
            return
        self._lost += len(one.episodes)
        one.state = "lost" if one.episodes else "left"
        one.why = ", ".join(episode.scenario for episode in one.episodes.values())
        self.note(f"{worker}: {'lost, with ' + one.why if one.episodes else 'has left'}")

    def left(self, worker: str) -> None:
        """Note that a worker knows that the run is over."""
        if worker in self._workers:
            self._workers[worker].state = "left"

    def turned_away(self, worker: str, host: str, why: str) -> None:
        """Note that a worker cannot work for this run."""
        one = self._of(worker, host)
        if (one.state, one.why) != ("turned away", why):
            self.note(f"{worker}: turned away: {why}")
            log_event("refused", WARNING, worker=worker, host=host, why=why)
        one.state = "turned away"
        one.why = why

    def conflict(self, words: str) -> None:
        """Note that two results of a scenario contradict each other."""
        self._conflicts.append(self.note(f"{CONFLICT}: {words}"))

    def refused(self, words: str) -> None:
        """Note a message that cannot be read, or is of another run."""
        self._refused += 1
        if self._refused <= _MAX_REFUSED:
            self.note(words)

    def note(self, words: str) -> str:
        """Add a line to the run's log, and return it."""
        log_event("noted", DEBUG, words=words)
        line = f"{datetime.now(UTC).strftime('%Y-%m-%d %H:%M:%S')} {' '.join(words.split())}"
        with (
            suppress(OSError),
            (self._held.path / LOG_FILE).open("a") as log,
        ):  # a full disk is reported elsewhere
            log.write(line + "\n")
        return line

    def printed(self, report: Report) -> None:
        """Keep the output of an environment process."""
        path = self._held.path / "logs" / f"{report.worker}-{report.slot}.log"
        text = report.printed
        with suppress(OSError):
            if text and (not path.exists() or path.stat().st_size < _MAX_PRINTED):
                with path.open("ab") as log:
                    log.write(text)

    def write(self) -> None:
        """Write the status to the run folder, unless that was done just before."""
        if time.monotonic() - self._written_s > _WRITTEN_EVERY_S:
            self._written_s = time.monotonic()
            path = self._held.path / STATUS_FILE
            with suppress(OSError):
                write_atomic(path, msgspec.json.encode(self.status()))

    def status(self) -> RunStatus:
        """Return the progress of the run."""
        now_s = time.monotonic()
        spec = self._held.spec
        since_s = now_s - self._began_s
        here = self._finished - self._before
        total = len(spec.scenarios)
        parts = sum(
            episode.share for one in self._workers.values() for episode in one.episodes.values()
        )
        per_s = (here + parts) / since_s if here else None
        return RunStatus(
            suite=spec.suite,
            policy=spec.policy,
            folder=str(self._held.path),
            total=total,
            finished=self._finished,
            since_s=since_s,
            at_s=time.time(),
            per_hour=None if per_s is None else here / since_s * 3600.0,
            left_s=None if per_s is None else max(total - self._finished - parts, 0.0) / per_s,
            lost=self._lost,
            refused=self._refused,
            workers=tuple(one for _, one in sorted(self._workers.items())),
            conflicts=tuple(self._conflicts),
        )

    def _of(self, worker: str, host: str) -> WorkerStatus:
        one = self._workers.get(worker)
        if one is None:
            absent = [
                name for name, one in self._workers.items() if one.state not in ("working", "idle")
            ]
            for name in absent[: max(len(absent) - _MAX_GONE, 0)]:
                del self._workers[name]
            one = self._workers[worker] = WorkerStatus(name=worker, host=host or worker)
            self.note(f"{worker}: is connected")
        one.heard_at_s = time.time()
        one.connected = True
        return one


def decode_status(payload: bytes) -> RunStatus:
    """Decode a status. Raises EngineError."""
    try:
        return msgspec.json.decode(payload, type=RunStatus)
    except (msgspec.DecodeError, RecursionError) as error:
        raise EngineError(f"the status of the run cannot be read: {error}") from error


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(errors="replace").splitlines()
    except OSError:
        return []

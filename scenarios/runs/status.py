"""The roll of a run's workers: who is there, how far each is, and whatever is odd; for `cosim
status`, and kept in the run folder."""

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
from cosim.core.log_event import happened
from cosim.results.run_folder import RunFolder
from cosim.spec.scenario import Scenario
from scenarios.ipc.messages import Compares, Done, Message, MessageHandler, Progress, Waits
from scenarios.runs.protocol import Asking, NoResult, Renewal, Result

STATUS_FILE: Final = "status.json"
LOG_FILE: Final = "logs/coordinator.log"
CONFLICT: Final = "CONFLICT"
SILENT_S: Final = 4.0
"""A worker renews every second."""
_WRITTEN_EVERY_S: Final = 2.0
_MOST_ODD: Final = 1000
_MOST_GONE: Final = 1000
_MOST_PRINTED: Final = 4 << 20

State = Literal["working", "idle", "silent", "lost", "left", "turned away"]


class Under(msgspec.Struct, frozen=True, kw_only=True):
    """An episode under way. time_s: simulated; share: of its route, 0 to 1; for_s: how long it has
    been run; still_s: since it came on; waits: what for, "" if for nothing."""

    scenario: str
    time_s: float = 0.0
    share: float = 0.0
    for_s: float = 0.0
    still_s: float = 0.0
    waits: str = ""


class WorkerHealth(msgspec.Struct, frozen=True, kw_only=True):
    """How a worker is. silent_s: since it was heard last; done: how many results it has brought;
    why: of its state."""

    name: str
    host: str
    state: State
    silent_s: float
    done: int
    why: str
    under_way: tuple[Under, ...]


class RunStatus(msgspec.Struct, frozen=True, kw_only=True):
    """How a run goes. since_s: since it was begun, or begun anew; at_s: of the wall clock;
    per_hour: episodes; left_s: None while it cannot be told; lost: how many episodes were lost with
    their workers; odd: messages refused."""

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
    odd: int = 0
    workers: tuple[WorkerHealth, ...] = ()
    conflicts: tuple[str, ...] = ()


class _Underway:
    """An episode that a worker runs."""

    def __init__(self, scenario: str) -> None:
        self.scenario = scenario
        self.time_s = 0.0
        self.share = 0.0
        self.waits = ""
        self.begun_s = self.moved_s = time.monotonic()

    def told(self, now_s: float) -> Under:
        return Under(
            scenario=self.scenario,
            time_s=self.time_s,
            share=self.share,
            for_s=now_s - self.begun_s,
            still_s=now_s - self.moved_s,
            waits=self.waits,
        )


class _Known:
    """What is known of a worker."""

    def __init__(self, host: str) -> None:
        self.host = host
        self.state = "idle"
        self.why = ""
        self.done = 0
        self.there = True
        self.heard_s = time.monotonic()
        self.under_way: dict[int, _Underway] = {}


class Roll:
    """Of one run, whose folder is held. tell: is told on what the workers say."""

    def __init__(
        self, held: RunFolder, scenarios: Sequence[Scenario], finished: int, tell: MessageHandler
    ) -> None:
        self._held = held
        self._tell_on = tell
        self._lengths_m = {one.id: max(one.route_line.length_m, 1.0) for one in scenarios}
        self._before = finished
        self._finished = finished
        self._began_s = time.monotonic()
        self._written_s = 0.0
        self._known: dict[str, _Known] = {}
        self._lost = self._odd = 0
        self._conflicts = [line for line in _lines(held.path / LOG_FILE) if CONFLICT in line]

    @property
    def anybody(self) -> bool:
        """Whether a worker is there."""
        return any(one.there for one in self._known.values())

    def tell(self, message: Message) -> None:
        """Something that a worker has said of its episode."""
        self._finished += isinstance(message, Done)
        self._tell_on(message)

    def heard(self, worker: str, host: str, slot: int) -> None:
        """A worker has asked for a job."""
        one = self._of(worker, host)
        one.under_way.pop(slot, None)
        one.state = "working" if one.under_way else "idle"
        one.why = ""

    def leased(self, worker: str, slot: int, scenario: str) -> None:
        """A worker has been given a job."""
        one = self._of(worker, "")
        one.state = "working"
        one.under_way[slot] = _Underway(scenario)

    def renewed(self, renewal: Renewal) -> None:
        one = self._of(renewal.worker, "")
        one.state = "working"
        one.why = ""
        under = one.under_way.get(renewal.slot)
        if under is None or under.scenario != renewal.scenario:
            under = one.under_way[renewal.slot] = _Underway(renewal.scenario)
        for message in renewal.said:
            under.moved_s = time.monotonic()
            under.waits = ""
            if isinstance(message, Progress):
                far = message.route_s_m / self._lengths_m.get(message.scenario, 1.0)
                under.time_s = message.time_s
                under.share = min(max(far, 0.0), 1.0)
            elif isinstance(message, Compares):
                under.share = 1.0
                under.waits = f"is compared, {message.share:.0%}"
            elif isinstance(message, Waits):
                under.waits = message.reason

    def delivered(self, result: Result) -> None:
        one = self._of(result.worker, "")
        one.under_way.pop(result.slot, None)
        one.done += 1

    def failed(self, failure: NoResult) -> None:
        one = self._of(failure.worker, "")
        one.under_way.pop(failure.slot, None)
        words = (
            f"{failure.worker}/{failure.slot}: {failure.scenario or 'no episode'}: "
            f"{failure.how}: {failure.why}"
        )
        self.note(words.rstrip(": "))
        if failure.how == "unable":
            one.state = "turned away"
            one.why = failure.why
        elif failure.how == "released":
            one.state = "left"

    def gone(self, worker: str) -> None:
        """A worker is not seen any more."""
        one = self._known.get(worker)
        if one is not None:
            one.there = False
        if one is None or one.state in ("left", "turned away"):
            return
        self._lost += len(one.under_way)
        one.state, one.why = (
            "lost" if one.under_way else "left",
            ", ".join(u.scenario for u in one.under_way.values()),
        )
        self.note(f"{worker}: {'lost, with ' + one.why if one.under_way else 'has left'}")

    def left(self, worker: str) -> None:
        """It knows that the run is over."""
        if worker in self._known:
            self._known[worker].state = "left"

    def refused(self, worker: str, host: str, why: str) -> None:
        """A worker can do nothing for this run."""
        one = self._of(worker, host)
        if (one.state, one.why) != ("turned away", why):
            self.note(f"{worker}: turned away: {why}")
            happened("refused", WARNING, worker=worker, host=host, why=why)
        one.state = "turned away"
        one.why = why

    def conflict(self, words: str) -> None:
        self._conflicts.append(self.note(words))

    def odd(self, words: str) -> None:
        """Something that cannot be read, or is none of this run's."""
        self._odd += 1
        if self._odd <= _MOST_ODD:
            self.note(words)

    def note(self, words: str) -> str:
        """Keep a line in the run's log. Returns it."""
        happened("noted", DEBUG, words=words)
        line = f"{datetime.now(UTC).strftime('%Y-%m-%d %H:%M:%S')} {' '.join(words.split())}"
        with (
            suppress(OSError),
            (self._held.path / LOG_FILE).open("a") as log,
        ):  # a full disk is told elsewhere
            log.write(line + "\n")
        return line

    def printed(self, who: Asking, text: bytes) -> None:
        """Keep what an environment process has printed."""
        path = self._held.path / "logs" / f"{who.worker}-{who.slot}.log"
        with suppress(OSError):
            if text and (not path.exists() or path.stat().st_size < _MOST_PRINTED):
                with path.open("ab") as log:
                    log.write(text)

    def tend(self) -> None:
        """Write the status to the run folder, every now and then."""
        if time.monotonic() - self._written_s > _WRITTEN_EVERY_S:
            self._written_s = time.monotonic()
            path = self._held.path / STATUS_FILE
            with suppress(OSError):
                write_atomic(path, msgspec.json.encode(self.status()))

    def status(self) -> RunStatus:
        """How the run goes by now."""
        now_s = time.monotonic()
        spec = self._held.spec
        since_s = now_s - self._began_s
        here = self._finished - self._before
        total = len(spec.scenarios)
        halves = sum(
            under.share for one in self._known.values() for under in one.under_way.values()
        )
        per_s = (here + halves) / since_s if here else None
        return RunStatus(
            suite=spec.suite,
            policy=spec.policy,
            folder=str(self._held.path),
            total=total,
            finished=self._finished,
            since_s=since_s,
            at_s=time.time(),
            per_hour=None if per_s is None else here / since_s * 3600.0,
            left_s=None if per_s is None else max(total - self._finished - halves, 0.0) / per_s,
            lost=self._lost,
            odd=self._odd,
            workers=tuple(_health(name, one, now_s) for name, one in sorted(self._known.items())),
            conflicts=tuple(self._conflicts),
        )

    def _of(self, worker: str, host: str) -> _Known:
        one = self._known.get(worker)
        if one is None:
            absent = [
                name for name, one in self._known.items() if one.state not in ("working", "idle")
            ]
            for name in absent[: max(len(absent) - _MOST_GONE, 0)]:
                del self._known[name]
            one = self._known[worker] = _Known(host or worker)
            self.note(f"{worker}: is there")
        one.heard_s = time.monotonic()
        one.there = True
        return one


def status_in(payload: bytes) -> RunStatus:
    """A status as it was told or kept. Raises EngineError for what is none."""
    try:
        return msgspec.json.decode(payload, type=RunStatus)
    except (msgspec.DecodeError, RecursionError) as error:
        raise EngineError(f"the status of the run cannot be read: {error}") from error


def _health(name: str, one: _Known, now_s: float) -> WorkerHealth:
    silent_s = now_s - one.heard_s
    state: State = one.state  # type: ignore[assignment]
    if state in ("working", "idle") and silent_s > SILENT_S:
        state = "silent"
    return WorkerHealth(
        name=name,
        host=one.host,
        state=state,
        silent_s=silent_s,
        done=one.done,
        why=one.why,
        under_way=tuple(under.told(now_s) for under in one.under_way.values()),
    )


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(errors="replace").splitlines()
    except OSError:
        return []

"""A worker: takes scenarios, runs them, tells how they go and what came out. It writes no file of
the run.

One that is a process takes them over a socket; its shepherd starts it, keeps its log and clears up
after it (`scenarios.ipc.supervisor`).
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from socket import socket

import msgspec

from bridge.policy_server import said_by
from cosim.core.clock import Clock
from cosim.core.errors import MachineError, RendererLost, UsageError
from cosim.core.framing import Wire
from cosim.core.versions import versions
from cosim.episode.policy_caller import Driver
from cosim.episode.step import Step
from cosim.policies.load import load_policy
from cosim.results.referee import Verdict
from scenarios.ipc.deadlines import Asked
from scenarios.ipc.messages import (
    Done,
    FrameDrawn,
    Hello,
    Job,
    LostRenderer,
    Message,
    MessageHandler,
    Progress,
    Ready,
    Unable,
    Waits,
    decode_hello,
    decode_job,
    encode_message,
)
from scenarios.ipc.render_link import link_to
from scenarios.runs.policy_host import policy_driver, shared_driver

REPORT_EVERY_TICKS = 20
CANNOT_START = "an environment process cannot start:"


def serve_jobs(socket_descriptor: int, asked_descriptor: int) -> None:
    """Serve jobs until the socket closes. An exception outside an episode ends the process; its run
    starts another."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    wire = Wire(socket(fileno=socket_descriptor))
    home = Path.cwd()
    printed_to = _printed_to()
    say = partial(said_to_run, wire, os.getpid())
    hello = decode_hello(wire.receive())
    _import_engines(say)
    timer = Asked(asked_descriptor)
    drivers: DriversHere | None = drivers_here(hello, timer, say)
    say(Ready())
    while True:
        try:
            job = decode_job(wire.receive())
        except EOFError:
            return
        os.chdir(home)  # the policy may have gone elsewhere
        drivers = drivers or drivers_here(hello, timer, say, again=True)
        try:
            done, trouble = run_job(job, drivers.policy, say, drivers.learner)
        except MachineError as lack:
            say(Unable(str(lack), blames_policy=False))
            raise
        if trouble or drivers.spent:
            drivers.close()
            drivers = None  # made anew for the next one
        say(done)
        if _printed_to() != printed_to:
            # the policy has closed it: what was opened since may have its number, and would be
            # written into
            return


def _printed_to() -> list[tuple[int, int]]:
    """What standard output and standard error are; without what is closed."""
    found = []
    for descriptor in (1, 2):
        with suppress(OSError):
            what = os.fstat(descriptor)
            found.append((what.st_dev, what.st_ino))
    return found


def _import_engines(say: MessageHandler) -> None:
    """An engine that cannot be imported is told, and ends the process."""
    try:
        import scenarios.episodes.run_episode  # noqa: F401  the engines greet on stdout when they are imported
    except (ImportError, OSError) as error:
        say(
            Unable(
                f"{CANNOT_START} {said_by(error)}. `cosim doctor` says more", blames_policy=False
            )
        )
        raise


@dataclass(frozen=True)
class DriversHere:
    """What drives here: the policy, or who asks the shared renderer's; and the learner where drives
    are collected."""

    policy: Driver
    learner: Driver | None

    @property
    def spent(self) -> bool:
        return self.policy.spent

    def close(self) -> None:
        self.policy.close()
        if self.learner is not None:
            self.learner.close()


def drivers_here(
    hello: Hello, timer: Asked, say: MessageHandler, *, again: bool = False
) -> DriversHere:
    """See `policy_here`; the learner is held against what it was for the run in the same way."""
    if hello.renderer is not None and hello.renderer.asks:
        driver: Driver = shared_driver(
            hello.manifest, hello.source_hash, hello.renderer, hello.host.run
        )
    else:
        driver = policy_here(hello, timer, say, again=again)
    if (learner := hello.learner) is None:
        return DriversHere(driver, None)
    with _unable_told(say):
        return DriversHere(driver, _as_begun(load_policy(learner.policy, timer), learner, again))


def policy_here(hello: Hello, timer: Asked, say: MessageHandler, *, again: bool = False) -> Driver:
    """The policy of the run. One that cannot be loaded here, or is another one here, is told, and
    ends the process.

    again: it was loaded here before; what it has made of its class's manifest since means
    nothing."""
    with _unable_told(say):
        return _as_begun(
            policy_driver(hello.policy, hello.host, timer, hello.manifest), hello, again
        )


@contextmanager
def _unable_told(say: MessageHandler) -> Iterator[None]:
    try:
        yield
    except (UsageError, MachineError) as error:
        say(Unable(str(error), blames_policy=isinstance(error, UsageError)))
        raise


def _as_begun(driver: Driver, begun: Hello, again: bool) -> Driver:
    """A driver that was loaded here, if it is what it was for the run. Raises UsageError."""
    if driver.source_hash != begun.source_hash:
        raise UsageError(
            f"policy '{begun.policy}' was edited while the run was going on: begin another "
            f"run. Or it is a network "
            "on another kind of processor than the run's, which answers otherwise in the last bit"
        )
    if again:
        driver.manifest = begun.manifest
    if driver.manifest != begun.manifest:
        raise UsageError(
            f"policy '{begun.policy}' has another manifest in each process: {driver.manifest} in "
            f"this one, {begun.manifest} in the first"
        )
    return driver


def run_job(
    job: Job, driver: Driver, say: MessageHandler, learner: Driver | None = None
) -> tuple[Done | LostRenderer, bool]:
    """Run one episode and tell how it goes. Returns what came out, and whether anything went wrong:
    its traceback is printed, because a record holds the message alone. learner: of a job that is
    collected."""
    from scenarios.episodes.run_episode import run_episode
    from scenarios.places.nets import check_place

    if job.net_hash:
        check_place(job.scenario.place, job.net_hash)
    name = job.scenario.id
    expert = None
    if (collecting := job.options.collecting) is not None:
        from scenarios.episodes.demonstrator import Demonstrator

        expert = Demonstrator(driver, collecting, job.options.goal, learner)
    watcher = _Watcher(job, say)
    try:
        if job.renderer is not None:
            link_to(job.renderer.address, lambda: say(Waits(name, "waits for the shared renderer")))
        outcome = run_episode(
            job.scenario,
            expert or driver,
            job.options,
            setup=job.setup and msgspec.structs.replace(job.setup, versions=versions()),
            renderer=job.renderer,
            watches=[watcher.watch],
            waiting=lambda reason, _=None: say(Waits(name, reason)),
            comparing=watcher.compared,
        )
    except RendererLost as lost:
        return LostRenderer(name, lost.number, lost.asked), False
    if outcome.traceback:
        print(f"--- {name}\n{outcome.traceback}", file=sys.stderr, flush=True)
    log = b"" if outcome.log is None else outcome.log.encoded()
    shown = b"" if expert is None else expert.kept(job.scenario, outcome.record, outcome.log)
    done = Done(name, outcome.record.status, outcome.record.encoded(), log, outcome.again, shown)
    return done, bool(outcome.traceback)


class _Watcher:
    """Reports the progress of an episode, and the camera frames that its job asks for."""

    def __init__(self, job: Job, say: MessageHandler) -> None:
        self._every_s = job.options.frames_every_s
        self._say = say
        self._next_frame_s = 0.0
        self._progress = Progress(job.scenario.id, 0.0, 0.0, 0)

    def watch(self, step: Step, verdict: Verdict) -> None:
        time_s = Clock().time_s(step.tick)
        name = self._progress.scenario
        failures = self._progress.failures + len(verdict.failures)
        self._progress = Progress(name, time_s, step.route_s_after_m, failures)
        if step.frame is not None and self._every_s and time_s >= self._next_frame_s:
            import cv2

            self._next_frame_s += self._every_s
            _, png = cv2.imencode(".png", step.frame.rgb[..., ::-1])
            self._say(FrameDrawn(name, step.tick, png.tobytes()))
        if step.tick % REPORT_EVERY_TICKS == 0:
            self._say(self._progress)

    def compared(self, _stage: str, share: float | None = None) -> None:
        self._say(msgspec.structs.replace(self._progress, compared=share or 0.0))


def said_to_run(wire: Wire, worker: int, message: Message) -> None:
    """Say something to the run. When it is gone this process ends at once: that is no crash of the
    episode. So does a copy of the worker that its policy has forked: one process speaks on a
    socket."""
    try:
        if os.getpid() == worker:
            wire.send(encode_message(message))
            return
    except OSError:
        pass
    os._exit(1)

"""Worker: runs the episodes of jobs, and sends progress and results. It writes no file of the run.

An environment process receives jobs over a socket; its supervisor writes its log and ends it
(`scenarios.ipc.supervisor`).
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
from typing import TYPE_CHECKING

import msgspec

from bridge.policy_server import error_text
from cosim.core.clock import Clock
from cosim.core.errors import MachineError, RendererLost, UsageError
from cosim.core.framing import MessageSocket
from cosim.core.versions import versions
from cosim.episode.loop import Step
from cosim.episode.manifest_checks import with_goal
from cosim.episode.policy_caller import PolicyCaller
from cosim.policies.load import load_policy
from cosim.results.record import Record
from cosim.results.referee import Verdict
from cosim.results.run_setup import RunSetup
from cosim.spec.options import RendererAddress
from cosim.spec.scenario import Scenario
from scenarios.ipc.command_log import CommandLog, commands_of
from scenarios.ipc.deadlines import PendingCallMemory
from scenarios.ipc.messages import (
    Done,
    EpisodeProgress,
    FrameDrawn,
    Hello,
    Job,
    LostRenderer,
    Message,
    MessageHandler,
    Ready,
    Repeated,
    Unable,
    Waits,
    decode_hello,
    decode_job,
    encode_message,
)
from scenarios.ipc.process_state import ProcessState, end_at_once
from scenarios.ipc.render_link import link_to
from scenarios.runs.policy_host import policy_caller, shared_caller

if TYPE_CHECKING:
    from scenarios.episodes.demonstrator import Demonstrator
    from scenarios.episodes.episode import Watch
    from scenarios.episodes.run_episode import Outcome

REPORT_EVERY_TICKS = 20
"""Ticks between two progress messages."""
CANNOT_START = "an environment process cannot start:"
"""Beginning of the message that engines cannot be loaded."""


def serve_jobs(socket_descriptor: int, call_descriptor: int) -> None:
    """Run jobs until the socket closes. An exception outside an episode ends the process, which the
    run then replaces."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    wire = MessageSocket(socket(fileno=socket_descriptor))
    send = partial(send_to_run, wire, os.getpid())
    hello = decode_hello(wire.receive())
    _import_engines(send)
    timer = PendingCallMemory(call_descriptor)
    commands = CommandLog(timer)
    if hello.repeat is not None:
        with _load_errors_sent(send):
            send(repeat_job(hello, commands, send))
    home = _working_folder()
    callers: WorkerCallers | None = load_callers(hello, timer, send)
    initial_state = ProcessState.now()
    send(Ready())
    while True:
        try:
            job = decode_job(wire.receive())
        except EOFError:
            if callers is not None:
                callers.close()  # an open session would keep this process alive
            return
        with suppress(OSError):  # the policy may have deleted it
            os.chdir(home)
        try:
            callers = callers or load_callers(hello, timer, ignore_message, again=True)
        except (UsageError, MachineError):
            break  # a new process says whether the policy can be loaded there, and runs the job
        done, failed = _run(job, callers, send, hello, commands)
        if failed or callers.has_exited:
            callers.close()
            callers = None  # loaded again for the next job
        send(done)
        engine_failed = failed and isinstance(done, Done) and done.status == "invalid"
        if engine_failed or ProcessState.now() != initial_state:
            break  # a policy has changed the process; the run starts another one
    end_at_once()


def _run(
    job: Job, callers: WorkerCallers, send: MessageHandler, hello: Hello, commands: CommandLog
) -> tuple[Done | LostRenderer, bool]:
    """Run one episode as `run_job`. What the machine lacks, the policy may have taken away: this is
    an engine error, and a replay without the policy finds out."""
    try:
        return run_job(job, callers.policy, send, callers.learner, hello.renderer, commands)
    except MachineError as lack:
        print(f"--- {job.scenario.id}\n{lack}", file=sys.stderr, flush=True)
        setup = job.setup or RunSetup.of(job.options)
        record = Record.begun(job.scenario, with_goal(hello.manifest, job.options.goal), setup)
        record = msgspec.structs.replace(record, status="invalid", reason=str(lack))
        return Done(job.scenario.id, "invalid", record.encoded(), again=True), True


def ignore_message(message: Message) -> None:
    """Do nothing with a message."""


def _working_folder() -> Path:
    """Return the working folder, or the root if a policy has deleted it."""
    try:
        return Path.cwd()
    except OSError:
        return Path("/")


def _import_engines(send: MessageHandler) -> None:
    """Import the engines. An error is sent to the run, and ends the process."""
    try:
        import scenarios.episodes.run_episode  # noqa: F401  engines print a greeting on import
    except (ImportError, OSError) as error:
        send(
            Unable(
                f"{CANNOT_START} {error_text(error)}. `cosim doctor` says more", blames_policy=False
            )
        )
        raise


def repeat_job(hello: Hello, commands: CommandLog, send: MessageHandler) -> Repeated:
    """Simulate the commands of a failed episode again, without the policy.

    Raises MachineError if the machine lacks something.
    """
    from scenarios.episodes.attribution import repeat_commands  # see `run_job`
    from scenarios.places.nets import check_place

    assert hello.repeat is not None
    job = hello.repeat.job
    name = job.scenario.id
    send(Waits(name, "its commands run again without the policy"))
    if job.net_hash:
        check_place(job.scenario.place, job.net_hash)
    commands.begins()
    replayed = repeat_commands(
        job.scenario,
        hello.manifest,
        commands_of(hello.repeat.commands),
        job.options,
        setup=job.setup and msgspec.structs.replace(job.setup, versions=versions()),
        renderer=hello.renderer,
        log=commands,
        watches=[_tick_logger(commands)],
        waiting=lambda reason, _=None: send(Waits(name, reason)),
    )
    commands.ends()
    return Repeated(name, replayed.record.encoded(), replayed.error)


def _tick_logger(commands: CommandLog) -> Watch:
    """Return a callback that notes each simulated tick in a log."""
    return lambda step, verdict: commands.simulated(step.tick + 1, over=verdict.ended is not None)


@dataclass(frozen=True)
class WorkerCallers:
    """The callers of a worker: of the run's policy, and of the learner of a collection."""

    policy: PolicyCaller
    learner: PolicyCaller | None

    @property
    def has_exited(self) -> bool:
        return self.policy.has_exited

    def close(self) -> None:
        self.policy.close()
        if self.learner is not None:
            self.learner.close()


def load_callers(
    hello: Hello, timer: PendingCallMemory, send: MessageHandler, *, again: bool = False
) -> WorkerCallers:
    """Load the callers of a worker, with the checks of `load_run_policy`."""
    if hello.renderer is not None and hello.renderer.asks:
        caller: PolicyCaller = shared_caller(
            hello.manifest, hello.source_hash, hello.renderer, hello.host.run
        )
    else:
        caller = load_run_policy(hello, timer, send, again=again)
    if (learner := hello.learner) is None:
        return WorkerCallers(caller, None)
    with _load_errors_sent(send):
        return WorkerCallers(caller, _checked(load_policy(learner.policy, timer), learner, again))


def load_run_policy(
    hello: Hello, timer: PendingCallMemory, send: MessageHandler, *, again: bool = False
) -> PolicyCaller:
    """Load the policy of the run. An error, or a policy that differs from the run's, is sent to the
    run, and ends the process.

    again: whether it was loaded in this process before, so that it may have changed the manifest of
        its class.
    """
    with _load_errors_sent(send):
        caller = policy_caller(hello.policy, hello.host, timer, hello.manifest)
        return _checked(caller, hello, again)


@contextmanager
def _load_errors_sent(send: MessageHandler) -> Iterator[None]:
    """Send UsageError and MachineError of the block to the run, and raise them again."""
    try:
        yield
    except (UsageError, MachineError) as error:
        send(Unable(str(error), blames_policy=isinstance(error, UsageError)))
        raise


def _checked(caller: PolicyCaller, expected: Hello, again: bool) -> PolicyCaller:
    """Return a caller if it equals that of the run. Raises UsageError."""
    if caller.source_hash != expected.source_hash:
        raise UsageError(
            f"policy '{expected.policy}' was edited during the run: begin another run. Or it is a "
            "network on another kind of processor than the run's, whose answers differ in the last "
            "bit"
        )
    if again:
        caller.manifest = expected.manifest
    if caller.manifest != expected.manifest:
        raise UsageError(
            f"policy '{expected.policy}' has another manifest in each process: "
            f"{caller.manifest} in this one, {expected.manifest} in the first"
        )
    return caller


def run_job(
    job: Job,
    caller: PolicyCaller,
    send: MessageHandler,
    learner: PolicyCaller | None = None,
    renderer: RendererAddress | None = None,
    commands: CommandLog | None = None,
) -> tuple[Done | LostRenderer, bool]:
    """Run one episode, and send its progress.

    Returns the result, and whether there was an error, whose traceback is printed.

    learner: drives at times while demonstrations are collected.
    renderer: shared renderer of the run.
    commands: log of the commands for a replay without the policy.
    """
    # Imported here, so that `_import_engines` can report a failure.
    from scenarios.episodes.run_episode import run_episode
    from scenarios.places.nets import check_place

    if job.net_hash:
        check_place(job.scenario.place, job.net_hash)
    name = job.scenario.id
    expert = None
    if (collecting := job.options.collecting) is not None:
        from scenarios.episodes.demonstrator import Demonstrator

        expert = Demonstrator(caller, collecting, job.options.goal, learner)
    caller.on_reason(lambda reason: send(Waits(name, reason)))
    watcher = _Watcher(job, send)
    watches: list[Watch] = [watcher.watch]
    if commands is not None:
        commands.begins()
        watches.append(_tick_logger(commands))
    try:
        if renderer is not None:
            link_to(renderer.address, lambda: send(Waits(name, "waits for the shared renderer")))
        outcome = run_episode(
            job.scenario,
            expert or caller,
            job.options,
            setup=job.setup and msgspec.structs.replace(job.setup, versions=versions()),
            renderer=renderer,
            watches=watches,
            waiting=lambda reason, _=None: send(Waits(name, reason)),
            comparing=watcher.compared,
            commands=commands,
        )
        if commands is not None:
            commands.ends()
    except RendererLost as lost:
        return LostRenderer(name, lost.number, lost.asked), False
    if outcome.traceback:
        print(f"--- {name}\n{outcome.traceback}", file=sys.stderr, flush=True)
    return _done(job.scenario, outcome, expert), bool(outcome.traceback)


def _done(scenario: Scenario, outcome: Outcome, expert: Demonstrator | None) -> Done:
    """Return the message with the result of an episode."""
    record = outcome.record
    log = b"" if outcome.log is None else outcome.log.encoded()
    demonstration = (
        b"" if expert is None else expert.encoded_demonstration(scenario, record, outcome.log)
    )
    return Done(scenario.id, record.status, record.encoded(), log, outcome.again, demonstration)


class _Watcher:
    """Sender of the progress of an episode, and of the camera frames that its job requests."""

    def __init__(self, job: Job, send: MessageHandler) -> None:
        self._every_s = job.options.frames_every_s
        self._send = send
        self._next_frame_s = 0.0
        self._progress = EpisodeProgress(job.scenario.id, 0.0, 0.0, 0)

    def watch(self, step: Step, verdict: Verdict) -> None:
        time_s = Clock().time_s(step.tick)
        name = self._progress.scenario
        failures = self._progress.failures + len(verdict.failures)
        self._progress = EpisodeProgress(name, time_s, step.route_s_after_m, failures)
        if step.frame is not None and self._every_s and time_s >= self._next_frame_s:
            import cv2

            self._next_frame_s += self._every_s
            _, png = cv2.imencode(".png", step.frame.rgb[..., ::-1])
            self._send(FrameDrawn(name, step.tick, png.tobytes()))
        if step.tick % REPORT_EVERY_TICKS == 0:
            self._send(self._progress)

    def compared(self, _stage: str, share: float | None = None) -> None:
        self._send(msgspec.structs.replace(self._progress, compared=share or 0.0))


def send_to_run(wire: MessageSocket, worker: int, message: Message) -> None:
    """Send a message to the run. If the run has ended, or this is a fork of the worker by its
    policy, end this process at once."""
    try:
        if os.getpid() == worker:
            wire.send(encode_message(message))
            return
    except OSError:
        pass
    os._exit(1)

"""One environment process: takes scenarios over a pipe, runs them, leaves their files, reports.

It is started by its shepherd, which keeps its log and clears up after it (`scenarios.execution.shepherd`).
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.core.clock import Clock
from cosim.core.errors import UsageError
from cosim.episode.driver import Driver, said_by
from cosim.episode.step import Step
from cosim.judge.referee import Verdict
from cosim.policies.load import load_policy
from scenarios.execution.asked import Asked
from scenarios.execution.messages import (
    Compares,
    Done,
    Hello,
    Job,
    Message,
    Progress,
    Ready,
    Unable,
    Unsaved,
    Waits,
    decode_hello,
    decode_job,
    encode_message,
)

if TYPE_CHECKING:
    from scenarios.execution.episode import Watch
    from scenarios.execution.run import Outcome

REPORT_EVERY_TICKS = 20
CANNOT_START = "an environment process cannot start:"


def serve_jobs(pipe_descriptor: int, asked_descriptor: int) -> None:
    """Serve jobs until the pipe closes. An exception outside an episode ends the process; its parent starts anew."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe, home = Connection(pipe_descriptor), Path.cwd()
    hello = decode_hello(pipe.recv_bytes())
    run_episode = engines(pipe)
    timer = Asked(asked_descriptor)
    driver: Driver | None = loaded(hello, timer, pipe)
    send(pipe, Ready())
    while True:
        try:
            job = decode_job(pipe.recv_bytes())
        except EOFError:
            return
        os.chdir(home)  # the policy may have gone elsewhere
        driver = driver or loaded(hello, timer, pipe)
        outcome = run_episode(
            job.scenario,
            driver,
            job.options,
            watches=[watcher(job, pipe)],
            waiting=partial(waits, job, pipe),
            comparing=partial(comparing, job, pipe),
        )
        if outcome.traceback:
            print(f"--- {job.scenario.id}\n{outcome.traceback}", file=sys.stderr, flush=True)
            driver = None  # made anew for the next one
        leave(job, outcome, pipe)


def engines(pipe: Connection) -> Callable[..., Outcome]:
    """`scenarios.execution.run.run_episode`. An engine that cannot be imported is told, and ends the process."""
    try:
        from scenarios.execution.run import run_episode  # the engines greet on stdout when they are imported
    except (ImportError, OSError) as error:
        send(pipe, Unable(f"{CANNOT_START} {said_by(error)}. `cosim doctor` says more", blames_policy=False))
        raise
    return run_episode


def loaded(hello: Hello, timer: Asked, pipe: Connection) -> Driver:
    """The policy of the run. One that cannot be loaded here, or is another one here, is told, and ends the process."""
    try:
        driver = load_policy(hello.policy, timer)
        if driver.source_hash != hello.source_hash:
            raise UsageError(f"policy '{hello.policy}' was edited while the run was going on: begin another run")
        if driver.manifest != hello.manifest:
            raise UsageError(
                f"policy '{hello.policy}' has another manifest in each process: {driver.manifest} in this one, "
                f"{hello.manifest} in the first"
            )
    except UsageError as error:
        send(pipe, Unable(str(error), blames_policy=True))
        raise
    return driver


def leave(job: Job, outcome: Outcome, pipe: Connection) -> None:
    """Write what came out of an episode, and report it."""
    from scenarios.execution.run import keep

    folder = Path(job.folder)
    try:
        keep(outcome, folder)
    except OSError as error:
        send(pipe, Unsaved(job.scenario.id, f"{folder}: {error.strerror}"))
    else:
        send(pipe, Done(job.scenario.id, outcome.record.status))


def waits(job: Job, pipe: Connection, reason: str) -> None:
    """Reports what the episode waits for."""
    send(pipe, Waits(job.scenario.id, reason))


def comparing(job: Job, pipe: Connection, share: float) -> None:
    """Reports how much of the street without the robot is simulated."""
    send(pipe, Compares(job.scenario.id, share))


def watcher(job: Job, pipe: Connection) -> Watch:
    """Reports progress, and keeps camera frames where the job asks for them."""
    import cv2

    failures = 0
    next_frame_s = 0.0
    frames = Path(job.folder) / "frames"
    if job.options.frames_every_s:
        shutil.rmtree(frames, ignore_errors=True)
        frames.mkdir(parents=True)

    def watch(step: Step, verdict: Verdict) -> None:
        nonlocal failures, next_frame_s
        failures += verdict.failure is not None
        time_s = Clock().time_s(step.tick)
        if step.frame is not None and job.options.frames_every_s and time_s >= next_frame_s:
            next_frame_s += job.options.frames_every_s
            cv2.imwrite(str(frames / f"{step.tick:06d}.png"), step.frame.rgb[..., ::-1])
        if step.tick % REPORT_EVERY_TICKS == 0:
            send(pipe, Progress(job.scenario.id, time_s, step.route_s_after_m, failures))

    return watch


def send(pipe: Connection, message: Message) -> None:
    """Say something to the run. When it is gone this process ends at once: that is no crash of the episode."""
    try:
        pipe.send_bytes(encode_message(message))
    except OSError:
        os._exit(1)

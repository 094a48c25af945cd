"""One environment process: takes scenarios over a pipe, runs them, leaves their files, reports.

Spawned, never forked. It dies with its parent; what the engines print goes to its log.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import sys
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from cosim.clock import Clock
from cosim.policies.load import load_policy
from cosim.referee import Verdict
from cosim.step import Step
from scenarios.messages import Compares, Done, Job, Message, Progress, Unsaved, Waits, decode_job, encode

if TYPE_CHECKING:
    from scenarios.directing import Direct
    from scenarios.run import Watch

REPORT_EVERY_TICKS = 20
PR_SET_PDEATHSIG = 1


def main(pipe: Connection, policy: str, log_path: str, parent: int) -> None:
    """Serve jobs until the pipe closes. An exception outside an episode ends the process; its parent starts anew.

    parent: process id of the run that started this one; without it there is nobody to work for.
    """
    die_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Path(log_path).open("ab", buffering=0) as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    from scenarios.run import episode  # the engines greet on stdout when they are imported

    driver = load_policy(policy)
    while True:
        try:
            job = decode_job(pipe.recv_bytes())
        except EOFError:
            return
        watch = watcher(job, pipe)
        outcome = episode(
            job.scenario,
            driver,
            suite_hash=job.suite_hash,
            camera=job.camera,
            watch=watch,
            live=job.live,
            direct=director_of(job, pipe),
            counterfactual=job.counterfactual,
            comparing=partial(comparing, job, pipe),
        )
        if outcome.traceback:
            print(f"--- {job.scenario.id}\n{outcome.traceback}", file=sys.stderr, flush=True)
            driver = load_policy(policy)
        folder = Path(job.folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if outcome.log is not None:
                outcome.log.save(folder / "trajectory.npz")
            outcome.record.save(folder / "record.json")
        except OSError as error:
            send(pipe, Unsaved(job.scenario.id, f"{folder}: {error.strerror}"))
            continue
        send(pipe, Done(job.scenario.id, outcome.record.status))


def director_of(job: Job, pipe: Connection) -> Direct:
    """The episode's own director, or the one outside that the job names; waits for that one are reported."""
    from scenarios.directing import directed, directed_by

    if job.outside is None:
        return directed
    return partial(directed_by, job.outside, lambda reason: send(pipe, Waits(job.scenario.id, reason)))


def comparing(job: Job, pipe: Connection, share: float) -> None:
    """Reports how much of the street without the robot is simulated."""
    send(pipe, Compares(job.scenario.id, share))


def watcher(job: Job, pipe: Connection) -> Watch:
    """Reports progress, and keeps camera frames where the job asks for them."""
    failures = 0
    next_frame_s = 0.0
    frames = Path(job.folder) / "frames"
    if job.frames_every_s:
        shutil.rmtree(frames, ignore_errors=True)
        frames.mkdir(parents=True)

    def watch(step: Step, verdict: Verdict) -> None:
        nonlocal failures, next_frame_s
        failures += verdict.failure is not None
        time_s = Clock().time_s(step.tick)
        if step.frame is not None and job.frames_every_s and time_s >= next_frame_s:
            next_frame_s += job.frames_every_s
            cv2.imwrite(str(frames / f"{step.tick:06d}.png"), step.frame.rgb[..., ::-1])
        if step.tick % REPORT_EVERY_TICKS == 0:
            send(pipe, Progress(job.scenario.id, time_s, step.route_s_after_m, failures))

    return watch


def send(pipe: Connection, message: Message) -> None:
    """Say something to the run. When it is gone this process ends at once: that is no crash of the episode."""
    try:
        pipe.send_bytes(encode(message))
    except OSError:
        os._exit(1)


def die_with(parent: int) -> None:
    """Ask Linux to kill this process when its parent dies, however that happens; end if it is dead already."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)

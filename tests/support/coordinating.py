"""Measures a run's coordinator: its cost per episode, and how many workers it serves. Coordinator,
transport and run folder are real; the workers fabricate their results. Usage: python -m
tests.support.coordinating --workers 200 --jobs 100000"""

from __future__ import annotations

import argparse
import os
import queue
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from bridge import keys
from bridge.codec import encode
from bridge.session import Session, open_session
from cosim.core.errors import EngineError
from cosim.core.state import STILL, Command
from cosim.policies.load import load_policy
from cosim.results.record import Record
from cosim.results.run_folder import RunFolder
from cosim.spec.connection import Connection
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import City, Scenario, Suite
from scenarios.ipc.messages import Done, Hello, Job
from scenarios.runs.planning import run_spec
from scenarios.runs.pool import run_all
from scenarios.runs.protocol import (
    Assignment,
    Claim,
    Reply,
    Report,
    decode_reply,
    digest_of,
    installed_here,
)
from scenarios.runs.transport import LockedRun
from scenarios.runs.zenoh_transport import workers_of_run

_MODULE: Final = "tests.support.coordinating"
_POLICY: Final = f"{_MODULE}:Unseeing"
_LOG_BYTES: Final = 30_000
"""Size of the log of a short episode."""
_WORKERS: Final = 200
_JOBS: Final = 3000


class Unseeing:
    """A policy that is never queried."""

    manifest = Manifest("unseeing", camera=None)

    def reset(self, episode_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, observation: object) -> Command:
        return STILL


class Served(NamedTuple):
    """Cost of a run with fabricated results. wall_s, cpu_s: of the coordinator from the first job
    on; memory_mb: maximum; round_s: median from a result that is ready to the next job, for one of
    the workers."""

    jobs: int
    wall_s: float
    cpu_s: float
    memory_mb: float
    round_s: float


def serve_fabricated(workers: int, jobs: int) -> Served:
    """Coordinate a number of jobs of a number of workers, which are all in one other process."""
    one = Scenario(
        id="j",
        suite="load",
        place=City(seed=0, net_hash="h"),
        seed=0,
        start=(0.0, 0.0, 0.0),
        goal=(9.0, 0.0),
        route=((0.0, 0.0), (9.0, 0.0)),
    )
    scenarios = tuple(msgspec.structs.replace(one, id=f"j-{i:06d}", seed=i) for i in range(jobs))
    suite = Suite(name="load", version="1", scenarios=scenarios)
    driver = load_policy(_POLICY)
    options = EpisodeOptions(seed=1)
    spec = run_spec(suite, scenarios, _POLICY, driver, options)
    hello = Hello(_POLICY, driver.manifest, driver.source_hash)
    with tempfile.TemporaryDirectory() as folder:
        endpoint = f"unixsock-stream/{folder}/hub.sock"
        command = [sys.executable, "-m", _MODULE, "--load", endpoint, "--workers", str(workers)]
        with (
            RunFolder.create(Path(folder) / "run", spec, suite) as run_folder,
            open_session(Connection(role="coordinator", listen=endpoint)) as session,
            workers_of_run(
                session,
                LockedRun(run_folder, hello, scenarios, scenarios),
                lambda _: None,
                resumed=False,
            ) as transport_and_handle,
        ):
            load = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            transport, handle = transport_and_handle
            while not transport.room(0):
                transport.wait(1.0)
            began_s, cpu_s = time.monotonic(), time.process_time()
            run_all(run_folder, scenarios, hello, transport, handle=handle, options=options)
            took_s, cpu_s = time.monotonic() - began_s, time.process_time() - cpu_s
        output, _ = load.communicate()
    if load.returncode:
        raise EngineError(f"the made-up workers ended with exit code {load.returncode}")
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return Served(jobs, took_s, cpu_s, memory_mb, float(output))


class _FabricatingWorker:
    """A worker that has every result at once."""

    def __init__(
        self,
        session: Session,
        run: str,
        number: int,
        replies: queue.SimpleQueue[tuple[_FabricatingWorker, bytes]],
    ) -> None:
        self._session = session
        self._run = run
        self._replies = replies
        self._me = {"worker": f"w-{os.getpid()}-{number}", "slot": 0}
        session.declare_token(keys.worker(run, f"w-{os.getpid()}-{number}"))
        self._claim = encode(
            Claim(**self._me, host="here", installed=dict(installed_here()), ready=True)
        )  # type: ignore[arg-type]
        self._manifest = load_policy(_POLICY).manifest
        self._said: tuple[str, bytes] = ("", b"")
        self.rounds_s: list[float] = []
        self._done_s = 0.0
        self._say("claim", self._claim)

    def take(self, payload: bytes | None) -> bool:
        """Handle a reply, and return whether the run is over."""
        if payload is None:
            time.sleep(0.001)
            self._say(*self._said)
            return False
        reply = decode_reply(payload)
        if reply == Reply("over"):
            return True
        if isinstance(reply, Reply) and reply.kind == "turned_away":
            raise EngineError(reply.why)
        if isinstance(reply, Assignment):
            if self._done_s:
                self.rounds_s.append(time.monotonic() - self._done_s)
            result = encode(self._result(reply.lease, reply.job))
            self._done_s = time.monotonic()
            self._say("report", result)
        else:
            self._say("claim", self._claim)
        return False

    def _say(self, act: str, payload: bytes) -> None:
        self._said = (act, payload)
        self._session.send_query(keys.job(self._run, act), payload, self._heard, timeout_s=30.0)

    def _heard(self, payload: bytes | None, error: str) -> None:
        self._replies.put((self, payload))  # type: ignore[arg-type]

    def _result(self, lease: int, job: Job) -> Report:
        assert job.setup is not None
        record = Record.begun(job.scenario, self._manifest, job.setup)
        data = msgspec.structs.replace(
            record, status="done", ended="goal", ticks=40, state_hash="0" * 32
        ).encoded()
        done = Done(job.scenario.id, "done", data, bytes(_LOG_BYTES))
        return Report(
            **self._me, lease=lease, scenario=done.scenario, done=done, digest=digest_of(done)
        )  # type: ignore[arg-type]


def _load(endpoint: str, workers: int) -> None:
    """Run a number of fabricating workers until the run is over."""
    replies: queue.SimpleQueue[tuple[_FabricatingWorker, bytes]] = queue.SimpleQueue()
    with open_session(Connection(role="worker", connect=endpoint)) as session:
        while not (runs := session.query_all(keys.EVERY_RUN, timeout_s=5.0)):
            time.sleep(0.05)
        run = next(iter(runs)).split("/")[1]
        fabricating = [
            _FabricatingWorker(session, run, number, replies) for number in range(workers)
        ]
        over = 0
        while over < workers:
            one, payload = replies.get()
            over += one.take(payload)
    rounds_s = sorted(took for one in fabricating for took in one.rounds_s)
    print(rounds_s[len(rounds_s) // 2] if rounds_s else 0.0)


def _main() -> None:
    parser = argparse.ArgumentParser(description="How many workers a coordinator serves.")
    parser.add_argument("--workers", type=int, default=_WORKERS)
    parser.add_argument("--jobs", type=int, default=_JOBS)
    parser.add_argument("--load", metavar="ENDPOINT", default="", help="be the workers there")
    given = parser.parse_args()
    if given.load:
        _load(given.load, given.workers)
        return
    found = serve_fabricated(given.workers, given.jobs)
    print(
        f"{found.jobs} jobs by {given.workers} workers: {found.jobs / found.wall_s:.0f} a second, "
        f"{1000.0 * found.cpu_s / found.jobs:.2f} ms CPU each, {found.memory_mb:.0f} MB, "
        f"{1000.0 * found.round_s:.1f} ms from a result to the next job"
    )


if __name__ == "__main__":
    _main()

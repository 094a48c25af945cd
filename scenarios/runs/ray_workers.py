"""Transport to workers on a Ray cluster.

Ray places the workers, and waits for nodes; `scenarios.runs.pool` decides about an episode whose
worker is lost. Ray sends Python objects: every machine that can connect to the cluster must be
trusted.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import sysconfig
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

import msgspec

from cosim.core.errors import MachineError, UsageError
from cosim.policies.user_module import importable_name
from cosim.results.run_spec import RunSpec
from cosim.spec.scenario import Place
from scenarios.ipc.child_process import raise_unable
from scenarios.ipc.faults import AttemptFailure
from scenarios.ipc.messages import (
    Done,
    Hello,
    Job,
    MessageHandler,
    Unable,
    decode_message,
    encode_message,
)
from scenarios.runs.lease import Lease
from scenarios.runs.net_transfer import RunMaps, is_imported
from scenarios.runs.protocol import difference, installed_for, other_renderer
from scenarios.runs.ray_actor import EnvironmentActor, NodeFound, SlotReport
from scenarios.runs.transport import LockedRun, Transport, TransportFactory

_POLL_S: Final = 1.0
"""Longest time in seconds between two reports of an actor."""
LEASE_S: Final = 60.0
"""Seconds without a report after which an actor has lost its lease, whether or not Ray still lists
its node."""
_ENDING_S: Final = 60.0
"""Seconds that an idle actor may take to end."""
_NOTE_PERIOD_S: Final = 30.0
"""Seconds between two notes that Ray places no worker."""
_STARTS: Final = 3
"""Number of actors in a row that may fail to start."""
_Say = Callable[[str], None]
_Packed = Callable[[Job], tuple[bytes, Place, str, Any]]


def check_ray(on: str) -> Any:
    """Import Ray, and return it. Raises UsageError if it is missing, or if `on` is no cluster."""
    if on not in ("ray", "auto") and not on.startswith("ray://"):
        raise UsageError(
            f"--on {on}: give ray, auto, or the address of a cluster, like ray://head.lan:10001"
        )
    try:
        import ray
    except ImportError:
        remedy = "pip install -e '.[ray]' in the checkout"
        raise UsageError(f"--on {on} needs Ray, here and on each node: {remedy}") from None
    return ray


def check_on_ray(on: str, local_options: Mapping[str, object]) -> None:
    """Check the options of a run on Ray.

    local_options: whether options are set that need processes of this machine, by name.
    Raises UsageError if one is set, if Ray is missing, or if `on` is no cluster.
    """
    check_ray(on)
    for name in (name for name, is_set in local_options.items() if is_set):
        raise UsageError(
            f"{name} needs processes of this machine, and this run uses those of a cluster: "
            f"leave one of both out"
        )


@contextmanager
def ray_workers(on: str, jobs: int | None, policy: str, say: _Say) -> Iterator[TransportFactory]:
    """Connect to a cluster, and create the factory of its transport.

    jobs: number of workers, by default one for each CPU."""

    @contextmanager
    def create_transport(
        run: LockedRun, handle: MessageHandler
    ) -> Iterator[tuple[Transport, MessageHandler]]:
        workers = RayWorkers(run.folder.spec, run.folder.path / "logs", jobs, len(run.todo), say)
        say(f"{workers.wanted} workers on Ray")
        yield workers, handle

    with ray_cluster(on, policy, say):
        yield create_transport


@contextmanager
def ray_cluster(on: str, policy: str, say: _Say) -> Iterator[None]:
    """Connect to a cluster, and send the policy's package there unless it is installed.

    on: "ray" for the cluster of RAY_ADDRESS or of this machine; "auto" for the same; or
        "ray://HOST:PORT". "ray" starts a cluster on this machine for the block if there is none.

    Raises UsageError if there is no cluster, or one of another Ray or Python."""
    ray = check_ray(on)
    address = {"ray": os.environ.get("RAY_ADDRESS", "auto"), "auto": "auto"}.get(on, on)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    before = signal.getsignal(signal.SIGTERM)
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if module := _own_module(policy):
        options["runtime_env"] = {"py_modules": [module]}
    try:
        try:
            ray.init(address, **options)
        except ConnectionError as error:
            if on != "ray" or address != "auto":
                raise UsageError(
                    f"--on {on}: there is no Ray cluster: {_first_line(error)}"
                ) from None
            ray.init("local", include_dashboard=False, **options)
            say("no Ray cluster is there: one was started on this machine, for this run")
        except (RuntimeError, ValueError, OSError) as error:
            raise UsageError(f"--on {on}: {_first_line(error)}") from None
        signal.signal(signal.SIGTERM, before)  # Ray replaces it
        yield
    finally:
        with suppress(Exception):
            ray.shutdown()
        signal.signal(signal.SIGTERM, before)


class RayWorkers:
    """Transport to workers that are Ray actors of one CPU each.

    jobs: their number, by default one for each CPU of the cluster; never more than there are
    episodes.
    logs: folder for their output.
    wanted: the number of actors; there are fewer while Ray finds no place for more.
    """

    def __init__(
        self, spec: RunSpec, logs: Path, jobs: int | None, episodes: int, say: _Say
    ) -> None:
        self._ray = check_ray("ray")
        self._spec = spec
        self._logs = logs
        self._say = say
        self._here = installed_for(spec)
        self.wanted = min(
            jobs or max(1, int(self._ray.cluster_resources().get("CPU", 1))), episodes
        )
        self._actor = self._ray.remote(
            num_cpus=1, max_restarts=0, max_concurrency=2, scheduling_strategy="SPREAD"
        )(EnvironmentActor)
        self._coming: dict[Any, Any] = {}
        self._placed: list[tuple[Any, NodeFound]] = []
        self._workers: list[_RayWorker] = []
        self._count = self._failed = 0
        self._noted_s = time.monotonic()
        self._maps = RunMaps()
        self._sent = cache(lambda digest: self._ray.put(self._maps.packed(digest)))

    def room(self, busy: int) -> int:
        self._request_actors()
        return len(self._placed) + len(self._workers) - busy

    def unsolicited(self) -> tuple[()]:
        return ()

    def start(self, hello: Hello) -> _RayWorker:
        actor, found = self._placed.pop(0)
        log = self._logs / f"ray-{self._count}-{found.host}.log"
        self._count += 1
        worker = _RayWorker(
            self._ray, actor, log, hello, self._spec.setup.renderer, self._packed_job
        )
        self._workers.append(worker)
        return worker

    def _packed_job(self, job: Job) -> tuple[bytes, Place, str, Any]:
        """Return the arguments of an actor's `give`: a job, its place, the hash of its net, and a
        reference to an imported map."""
        where = job.scenario.place
        digest = self._maps.hash_of(where)
        message = encode_message(msgspec.structs.replace(job, net_hash=digest))
        return message, where, digest, self._sent(digest) if is_imported(where) else None

    def wait(self, timeout_s: float) -> None:
        refs = [*self._coming, *(one.pending for one in self._workers if not one.ended)]
        if not refs:
            time.sleep(min(timeout_s, 0.1))
            return
        try:
            self._ray.wait(refs, num_returns=1, timeout=timeout_s)
        except ConnectionError as error:
            raise MachineError(
                f"the Ray cluster was lost: {_first_line(error)}: finished episodes are "
                f"stored, continue with --resume"
            ) from None

    def _request_actors(self) -> None:
        """Request the missing actors from Ray, and take in those that it has placed."""
        self._workers = [one for one in self._workers if not one.ended]
        for _ in range(self.wanted - len(self._coming) - len(self._placed) - len(self._workers)):
            actor = self._actor.remote()
            self._coming[actor.found.remote()] = actor
        for ref in [*self._coming]:
            if self._ray.wait([ref], timeout=0)[0]:
                self._take(ref, self._coming.pop(ref))
        now_s = time.monotonic()
        if self._placed or self._workers or now_s - self._noted_s < _NOTE_PERIOD_S:
            return
        self._noted_s = now_s
        free = self._ray.available_resources().get("CPU", 0)
        self._say(
            f"waits for Ray to place a worker, which takes one CPU: {free:g} of the "
            f"cluster's are free"
        )

    def _take(self, ref: Any, actor: Any) -> None:
        try:
            found: NodeFound = self._ray.get(ref)
        except self._ray.exceptions.RayError as error:
            self._failed += 1
            if self._failed >= _STARTS:
                raise MachineError(
                    f"no worker starts on the Ray cluster: {_last_line(error)}: is cosim "
                    f"installed on its nodes?"
                ) from None
            return
        self._failed = 0
        if other := difference(found.installed, self._here):
            raise UsageError(
                f"node {found.host} has {other}: install on the nodes what is installed here"
            )
        self._placed.append((actor, found))


class _RayWorker:
    """An actor that runs jobs (`scenarios.runs.transport.Worker`). `pending` is its next
    report."""

    def __init__(
        self, ray: Any, actor: Any, log: Path, hello: Hello, renderer: str, packed: _Packed
    ) -> None:
        self.log = str(log)
        self.ended = False
        self._ray = ray
        self._actor = actor
        self._renderer = renderer
        self._packed = packed
        self._lease: Lease | None = None
        self._leases = 0
        self._closing: Any = None
        self._actor.begin.remote(encode_message(hello))
        self.pending = self._actor.report.remote(_POLL_S)

    def give(self, job: Job) -> None:
        self._leases += 1
        self._lease = Lease(Path(self.log).stem, self._leases, LEASE_S, job.scenario.id)
        self._actor.give.remote(*self._packed(job))

    def poll(self, handle: MessageHandler) -> AttemptFailure | None:
        while not self.ended and self._ray.wait([self.pending], timeout=0)[0]:
            try:
                report: SlotReport = self._ray.get(self.pending)
            except self._ray.exceptions.RayError as error:
                self.ended = True
                if self._lease is not None:
                    self._lease.mark_lost(f"its Ray worker was lost ({type(error).__name__})")
                break
            self.pending = self._actor.report.remote(_POLL_S)
            self._take(report)
        if self._lease is None:
            return None
        failure = self._lease.poll(handle)
        if self._lease.ended:
            self._lease = None
        if failure is not None and failure.fault == "machine_lost":
            self.cancel()
        return failure

    def _take(self, report: SlotReport) -> None:
        self._keep_output(report.printed)
        messages = [decode_message(one) for one in report.said]
        for message in messages:
            if isinstance(message, Unable):
                raise_unable(message)
            if isinstance(message, Done) and (other := other_renderer(message, self._renderer)):
                raise UsageError(f"{other}: take nodes alike, or --camera bullet")
        if self._lease is not None:
            self._lease.add_report(messages, report.failure)

    def _keep_output(self, printed: bytes) -> None:
        if printed:
            with suppress(OSError), Path(self.log).open("ab") as log:
                log.write(printed)

    def cancel(self) -> None:
        self._ray.kill(self._actor)
        self._lease = None
        self.ended = True

    def stop(self) -> None:
        if self._lease is not None:
            self.cancel()
        elif not self.ended:
            self._closing = self._actor.close.remote()

    def end(self) -> None:
        if self._closing is not None:
            with suppress(self._ray.exceptions.RayError):
                self._keep_output(self._ray.get(self._closing, timeout=_ENDING_S))
        if not self.ended:
            self.cancel()


def _own_module(policy: str) -> str:
    """Return the path of the package or file of a policy that is not installed; "" if it is."""
    policy = importable_name(policy)
    name = policy.partition(":")[0].partition(".")[0] if ":" in policy else ""
    spec = importlib.util.find_spec(name) if name else None
    if spec is None:
        return ""
    where = [*(spec.submodule_search_locations or ()), *([spec.origin] if spec.origin else ())]
    path = Path(where[0]).absolute() if where else None
    installed = {Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib", "stdlib")}
    if path is None or any(path.is_relative_to(folder) for folder in installed):
        return ""
    return str(path)


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0][:300]


def _last_line(error: BaseException) -> str:
    return str(error).strip().rpartition("\n")[2][:300]

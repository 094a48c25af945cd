"""Workers on a Ray cluster, as a transport.

Ray decides where they are and waits for nodes that are yet to come; what becomes of an episode
whose worker was lost is decided by `scenarios.runs.pool`, as ever. Ray sends Python objects: a
cluster is as trusted as whoever reaches it.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import sysconfig
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import msgspec

from bridge.codec import decode, encode
from cosim.core.errors import MachineError, UsageError
from cosim.policies.user_module import importable
from cosim.results.run_spec import RunSpec
from cosim.spec.scenario import Place
from scenarios.ipc.deadlines import Question
from scenarios.ipc.messages import Done, Hear, Hello, Job, decode_message, encode_message
from scenarios.runs.net_transfer import Nets, travels
from scenarios.runs.protocol import Asks, NetAsked, NetPart, installed_here
from scenarios.runs.ray_actor import EnvironmentActor, Heard, NodeFound, ProcessEnd
from scenarios.runs.transport import HeldRun, Reaches, Transport

_POLL_S: Final = 1.0
_ANSWERS_S: Final = 10.0
"""A worker of which nothing was heard for so long may have stopped: what its policy is asked is not
known then."""
_ENDING_S: Final = 60.0
_TELLS_S: Final = 30.0
_STARTS: Final = 3
"""So many actors in a row may fail to start."""
_Say = Callable[[str], None]


def check_ray(on: str) -> Any:
    """The package. Raises UsageError where it is not installed, or where a cluster cannot be called
    so."""
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


def check_on_ray(on: str, of_here: Mapping[str, object]) -> None:
    """Raises UsageError without Ray, for what is no cluster's name, and where something is asked
    for that is of processes of this machine. of_here: what is, by its name."""
    check_ray(on)
    for name in (name for name, asked in of_here.items() if asked):
        raise UsageError(
            f"{name} is of processes of this machine, and these are of a cluster: leave it, "
            f"or that, out"
        )


@contextmanager
def by_ray(on: str, jobs: int | None, policy: str, say: _Say) -> Iterator[Reaches]:
    """A connection to a cluster, as for `ray_cluster`, and how its workers are reached: so many
    `jobs`, or None for as many as it has CPUs."""

    @contextmanager
    def reached(run: HeldRun, tell: Hear) -> Iterator[tuple[Transport, Hear]]:
        workers = RayWorkers(run.held.spec, run.held.path / "logs", jobs, len(run.todo), say)
        say(f"{workers.wanted} workers on Ray")
        yield workers, tell

    with ray_cluster(on, policy, say):
        yield reached


@contextmanager
def ray_cluster(on: str, policy: str, say: _Say) -> Iterator[None]:
    """A connection to a cluster: on is "ray", the cluster of this machine or RAY_ADDRESS, else one
    that is started here and ends with the block; "auto", the same but never started; or
    "ray://HOST:PORT". The policy's own package goes there, unless it is installed. Raises
    UsageError where there is none, or one of another Ray or Python."""
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
        signal.signal(signal.SIGTERM, before)  # Ray puts its own in place
        yield
    finally:
        with suppress(Exception):
            ray.shutdown()
        signal.signal(signal.SIGTERM, before)


class RayWorkers:
    """Workers that are Ray actors of one CPU each: so many `jobs`, or None for as many as the
    cluster has CPUs now; no more than there are episodes, and fewer while Ray finds no place for
    more.

    logs: the folder for what they print. wanted: how many there are to be."""

    def __init__(
        self, spec: RunSpec, logs: Path, jobs: int | None, episodes: int, say: _Say
    ) -> None:
        self._ray = check_ray("ray")
        self._spec = spec
        self._logs = logs
        self._say = say
        self._here = msgspec.structs.replace(installed_here(), versions=spec.versions)
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
        self._told_s = time.monotonic()
        self._maps = _Maps(self._ray)

    def room(self, busy: int) -> int:
        self._tend()
        return len(self._placed) + len(self._workers) - busy

    def unasked(self) -> tuple[()]:
        return ()

    def start(self, hello: Hello) -> _RayWorker:
        actor, found = self._placed.pop(0)
        log = self._logs / f"ray-{self._count}-{found.host}.log"
        self._count += 1
        worker = _RayWorker(self._ray, actor, log, hello, self._spec.renderer, self._maps)
        self._workers.append(worker)
        return worker

    def wait(self, timeout_s: float) -> None:
        refs = [*self._coming, *(one.hearing for one in self._workers if one.open)]
        if not refs:
            time.sleep(min(timeout_s, 0.1))
            return
        try:
            self._ray.wait(refs, num_returns=1, timeout=timeout_s)
        except ConnectionError as error:
            raise MachineError(
                f"the Ray cluster was lost: {_first_line(error)}: finished episodes are "
                f"kept, go on with --resume"
            ) from None

    def _tend(self) -> None:
        """Ask Ray for what is wanted, and see what it has placed."""
        self._workers = [one for one in self._workers if one.open]
        for _ in range(self.wanted - len(self._coming) - len(self._placed) - len(self._workers)):
            actor = self._actor.remote()
            self._coming[actor.found.remote()] = actor
        for ref in [*self._coming]:
            if self._ray.wait([ref], timeout=0)[0]:
                self._take(ref, self._coming.pop(ref))
        now_s = time.monotonic()
        if self._placed or self._workers or now_s - self._told_s < _TELLS_S:
            return
        self._told_s = now_s
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
        if other := found.installed.differs_from(self._here):
            raise UsageError(
                f"node {found.host} has {other}: install on the nodes what is installed here"
            )
        self._placed.append((actor, found))


class _RayWorker:
    """What the run knows of an actor and its process. hearing: the answer that is awaited."""

    in_engine = away = False

    def __init__(
        self, ray: Any, actor: Any, log: Path, hello: Hello, renderer: str, maps: _Maps
    ) -> None:
        self._maps = maps
        self._renderer = renderer
        self._ray = ray
        self._actor = actor
        self.log = str(log)
        self.open = True
        self._asks: Asks | None = None
        self._heard_s = time.monotonic()
        self._lost = ""
        self._actor.send.remote(encode_message(hello))
        self.hearing = self._actor.hear.remote(_POLL_S)

    @property
    def question(self) -> Question | None:
        quiet_s = time.monotonic() - self._heard_s
        if self._asks is None or (self.open and quiet_s > _ANSWERS_S):
            return None
        return self._asks.question(self._heard_s + 2.0 * _POLL_S)

    def give(self, job: Job) -> None:
        where = job.scenario.place
        digest = self._maps.hash_of(where)
        message = encode_message(msgspec.structs.replace(job, net_hash=digest))
        self._actor.give.remote(message, where, digest, self._maps.parts_of(where))

    def listen(self, hear: Hear) -> bool:
        while self.open and self._ray.wait([self.hearing], timeout=0)[0]:
            try:
                heard: Heard = self._ray.get(self.hearing)
            except self._ray.exceptions.RayError as error:
                self._lost = f"its Ray worker was lost ({type(error).__name__})"
                self.away = True
                return False
            self._heard_s = time.monotonic()
            self._asks = heard.asks
            if not heard.ended:
                self.hearing = self._actor.hear.remote(_POLL_S)
            for message in map(decode_message, heard.said):
                if isinstance(message, Done):
                    self._check_renderer(message.record)
                hear(message)
            if heard.ended:
                return False
        return True

    def _check_renderer(self, record: bytes) -> None:
        told = msgspec.json.decode(record, type=_Told)
        if told.ended is not None and told.renderer != self._renderer:
            raise UsageError(
                f"pictures are drawn by {told.renderer} on the cluster, and by {self._renderer} "
                "here, where the run began: take nodes alike, or --camera bullet"
            )

    def hang_up(self) -> None:
        self._actor.hang_up.remote()

    def kill(self, *, wait: bool = True) -> None:
        self._ray.kill(self._actor)
        self._lost = self._lost or "its Ray worker was killed"
        self.open = False

    def end(self) -> str:
        if not self._lost:
            try:
                ended: ProcessEnd = self._ray.get(self._actor.end.remote(), timeout=_ENDING_S)
                self._asks = ended.asks
                self.in_engine = ended.in_engine
                words = ended.words
                Path(self.log).write_bytes(ended.printed)
            except self._ray.exceptions.RayError as error:
                self.away = True
                words = f"its Ray worker was lost ({type(error).__name__})"
            self._lost = words
        if self.open:
            self.kill()
        return self._lost


class _Maps:
    """The imported maps of a run, in the cluster's memory once they are needed."""

    def __init__(self, ray: Any) -> None:
        self._ray = ray
        self._nets = Nets()
        self._there: dict[str, Any] = {}

    def hash_of(self, where: Place) -> str:
        return self._nets.hash_of(where)

    def parts_of(self, where: Place) -> Any:
        """A reference to what is sent of a place; nothing for one that every node makes by
        itself."""
        if not travels(where):
            return ()
        digest = self.hash_of(where)
        if digest not in self._there:
            parts: list[bytes] = []
            begin = 0
            whole = 1
            while begin < whole:
                parts.append(self._nets.part(digest, encode(NetAsked(begin))))
                one = decode(parts[-1], NetPart)
                begin = begin + len(one.data)
                whole = one.whole
            self._there[digest] = self._ray.put(parts)
        return self._there[digest]


class _Told(msgspec.Struct):
    """What a record says of its pictures."""

    renderer: str
    ended: str | None = None


def _own_module(policy: str) -> str:
    """The package, or the file, of a policy that is not installed; "" for all others."""
    policy = importable(policy)
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

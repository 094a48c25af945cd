"""Chaos test: a run of tiny episodes by several workers, while workers and coordinator are killed,
stopped and replaced. Usage: python -m tests.support.chaos --episodes 500 --workers 4 --seeds 5. The
results must equal those of an undisturbed `cosim run` to the byte. One scenario kills whatever
process runs it."""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, Literal, NamedTuple

import msgspec

from cosim.core.errors import EngineError
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.results.run_folder import read_records
from cosim.spec.episode_id import episode_id_of
from cosim.spec.manifest import Manifest
from cosim.spec.scenario import Suite, write_suite
from scenarios.runs.status import CONFLICT, LOG_FILE
from scenarios.tools.verify.doctor import small_scenario

Blow = Literal["kill worker", "kill process", "stop worker", "end worker", "kill coordinator"]
_BLOWS: Final[Sequence[Blow]] = (
    "kill worker",
    "kill worker",
    "stop worker",
    "end worker",
    "kill coordinator",
)
_POISON: Final = "COSIM_CHAOS_POISON"
_SEED: Final = 7
_LIMIT_S: Final = 2.0
_STOPPED_S: Final = (0.5, 5.0)
_AWAY_S: Final = (0.0, 2.0)
_POLL_S: Final = 0.05


class Poisoned:
    """Drives straight ahead; kills its own process in the episode that the environment names."""

    manifest = Manifest("poisoned", camera=None)

    def reset(self, episode_id: str, seed: int) -> None:
        if episode_id == os.environ.get(_POISON):
            os.kill(os.getpid(), signal.SIGKILL)

    def act(self, observation: Observation) -> Command:
        return Command(0.8, 0.0)


class PlannedFault(NamedTuple):
    """A fault, and the number of finished episodes at which it happens."""

    finished: int
    fault: Blow


class ChaosResult(NamedTuple):
    """Result of a chaos run: episodes, faults that happened, seconds, and why it did not end, in
    words."""

    episodes: int
    faults: Counter[str]
    wall_s: float
    wrong: list[str]


def planned_faults(episodes: int, seed: int) -> list[PlannedFault]:
    """Return random faults, one for about ten episodes, and two of environment processes."""
    draw = random.Random(seed)
    faults: list[Blow] = [draw.choice(_BLOWS) for _ in range(max(episodes // 10, 4))]
    planned = [
        PlannedFault(draw.randrange(1, max(int(0.95 * episodes), 2)), fault) for fault in faults
    ]
    apart = [PlannedFault(share * episodes // 3, "kill process") for share in (1, 2)]
    return sorted([*planned, *apart])


def tiny_suite(folder: Path, episodes: int) -> None:
    """Write the suite of all runs in `folder`, and the episode name of its poison."""
    one = small_scenario()
    suite = Suite(
        name="chaos",
        version="1",
        scenarios=tuple(
            msgspec.structs.replace(one, id=f"tiny-{i:03d}", seed=i, time_limit_s=_LIMIT_S)
            for i in range(episodes)
        ),
    )
    write_suite(suite, folder / "suite.json")
    poison = episode_id_of(_SEED, suite.scenarios[episodes // 2]).episode
    (folder / "poison").write_text(poison)


def undisturbed(folder: Path, jobs: int) -> Path:
    """Run the suite in `folder` without faults, and return the run folder."""
    done = subprocess.run(
        _command(folder, "run", "quiet", "--jobs", str(jobs)),
        env=_env(folder),
        check=False,
        capture_output=True,
        text=True,
    )
    if done.returncode != 1:  # the poison crashes
        raise EngineError(
            f"the quiet run ended with exit code {done.returncode}: {done.stderr[-1000:]}"
        )
    return folder / "quiet"


def chaos(
    folder: Path,
    name: str,
    workers: int,
    planned: Sequence[PlannedFault],
    seed: int,
    *,
    replaced: bool = True,
) -> ChaosResult:
    """Run the suite in `folder` by `workers` workers and with faults, into the run folder `name`.
    replaced: whether ended workers are replaced."""
    run = folder / name
    began_s = time.monotonic()
    happened = Counter[str]()
    draw = random.Random(seed)
    left = list(planned)
    with _processes(folder, name, workers, replaced) as crew:
        while (code := crew.coordinator.poll()) is None or code not in (0, 1):
            if code is not None:
                log = (folder / f"{name}.log").read_text(errors="replace")[-1000:]
                return ChaosResult(
                    0,
                    happened,
                    time.monotonic() - began_s,
                    [f"coordinator: exit code {code}: {log}"],
                )
            crew.tend()
            finished = len(list(run.glob("episodes/*/record.json")))
            if left and finished >= left[0].finished:
                fault = left[0].fault
                if crew.suffer(fault, draw):
                    happened[left.pop(0).fault] += 1
            time.sleep(_POLL_S)
    return ChaosResult(len(read_records(run)), happened, time.monotonic() - began_s, [])


class _Processes:
    """The processes of a run."""

    def __init__(self, folder: Path, name: str, workers: int, replaced: bool) -> None:
        self._folder = folder
        self._name = name
        self._replaced = replaced
        self._endpoint = f"unixsock-stream/{folder}/{name}.sock"
        self._stopped: list[tuple[float, subprocess.Popen[bytes]]] = []
        self.coordinator = self._coordinate()
        self.workers = [self._work() for _ in range(workers)]

    def tend(self) -> None:
        """Continue workers that were stopped for long enough, and replace ended ones."""
        for at, (until_s, one) in reversed(list(enumerate(self._stopped))):
            if time.monotonic() > until_s:
                one.send_signal(signal.SIGCONT)
                del self._stopped[at]
        running = [one for one in self.workers if one.poll() is None]
        self.workers = running + [
            self._work() for _ in self.workers[len(running) :] if self._replaced
        ]

    def suffer(self, fault: Blow, draw: random.Random) -> bool:
        """Apply a fault, and return whether it was possible."""
        one = draw.choice(self.workers)
        if fault == "kill worker":
            one.kill()
        elif fault == "end worker":
            one.terminate()
        elif fault == "stop worker":
            one.send_signal(signal.SIGSTOP)
            self._stopped.append((time.monotonic() + draw.uniform(*_STOPPED_S), one))
        elif fault == "kill process":
            return any(_kill_environment_process(one.pid) for one in self.workers)
        else:
            self.coordinator.kill()
            self.coordinator.wait()
            time.sleep(draw.uniform(*_AWAY_S))
            self.coordinator = self._coordinate()
        return True

    def end(self) -> None:
        for one in [self.coordinator, *self.workers]:
            with suppress(ProcessLookupError):
                one.send_signal(signal.SIGCONT)
            one.kill()
            one.wait()

    def _coordinate(self) -> subprocess.Popen[bytes]:
        more = ["--resume"] if (self._folder / self._name / "run.json").exists() else []
        command = _command(
            self._folder, "coordinator", self._name, "--listen", self._endpoint, *more
        )
        return self._started(command, self._name)

    def _work(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "cosim", "worker", "--connect", self._endpoint]
        return self._started(command, f"{self._name}-workers")

    def _started(self, command: list[str], log: str) -> subprocess.Popen[bytes]:
        with (self._folder / f"{log}.log").open("ab") as said:
            return subprocess.Popen(command, env=_env(self._folder), stdout=said, stderr=said)


@contextmanager
def _processes(folder: Path, name: str, workers: int, replaced: bool) -> Iterator[_Processes]:
    crew = _Processes(folder, name, workers, replaced)
    try:
        yield crew
    finally:
        crew.end()


def _command(folder: Path, verb: str, name: str, *more: str) -> list[str]:
    policy = f"{__spec__.name if __spec__ else __name__}:{Poisoned.__name__}"
    words = [
        verb,
        str(folder / "suite.json"),
        "--policy",
        policy,
        "--seed",
        str(_SEED),
        "--out",
        str(folder / name),
    ]
    return [sys.executable, "-m", "cosim", *words, *more]


def _env(folder: Path) -> dict[str, str]:
    return os.environ | {_POISON: (folder / "poison").read_text()}


def _kill_environment_process(pid: int) -> bool:
    """Kill an environment process of a worker, the child of its shepherd. Return False if there is
    none."""
    for shepherd in _children(pid):
        for process in _children(shepherd):
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
                return True
    return False


def _children(pid: int) -> list[int]:
    found = []
    for path in Path("/proc", str(pid), "task").glob("*/children"):
        with suppress(OSError):
            found += [int(word) for word in path.read_text().split()]
    return found


def differences(reference: Path, run: Path) -> list[str]:
    """Return the differences of a run from an undisturbed one, in words."""
    wrong = []
    quiet_csv, csv = ((one / "results.csv").read_bytes() for one in (reference, run))
    if quiet_csv != csv:
        lines = zip(quiet_csv.decode().splitlines(), csv.decode().splitlines(), strict=False)
        other = next((f"{b} in place of {a}" for a, b in lines if a != b), "of other length")
        wrong.append(f"results.csv differs: {other[:400]}")
    hashes = [
        sorted((r.scenario.id, r.state_hash) for r in read_records(one)) for one in (reference, run)
    ]
    if hashes[0] != hashes[1]:
        wrong.append("state hashes differ")
    if CONFLICT in (log := (run / LOG_FILE).read_text(errors="replace")):
        wrong += [line for line in log.splitlines() if CONFLICT in line]
    return wrong


def _main() -> int:
    parser = argparse.ArgumentParser(
        description="Runs under fire: results must be those of a quiet run."
    )
    for option, value in (("episodes", 500), ("workers", 4), ("seeds", 5), ("first", 0)):
        parser.add_argument(f"--{option}", type=int, default=value)
    parser.add_argument("--folder", type=Path, help="a new one, kept; default: a temporary one")
    given = parser.parse_args()
    folder = (given.folder or Path(tempfile.mkdtemp(prefix="cosim-chaos-"))).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    began_s = time.monotonic()
    tiny_suite(folder, given.episodes)
    reference = undisturbed(folder, given.workers)
    print(f"quiet run: {time.monotonic() - began_s:.0f} s", flush=True)
    wrong = 0
    for seed in range(given.first, given.first + given.seeds):
        found = chaos(
            folder, f"chaos-{seed}", given.workers, planned_faults(given.episodes, seed), seed
        )
        faulty = found.wrong or differences(reference, folder / f"chaos-{seed}")
        wrong += bool(faulty)
        faults = ", ".join(f"{count} x {fault}" for fault, count in sorted(found.faults.items()))
        ends = "; ".join(faulty) or "as in the quiet run to the byte"
        print(
            f"seed {seed}: {found.episodes} episodes in {found.wall_s:.0f} s, {faults}: {ends}",
            flush=True,
        )
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(_main())

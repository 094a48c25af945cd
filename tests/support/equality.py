"""Equality test: thirty scenarios of `unit`, `reactive` and `long-horizon`, run by each mechanism,
give the same results.csv to the byte. Usage: python -m tests.support.equality [FOLDER]. The
mechanisms are one process, four, three merged shards, Ray, and a coordinator whose three workers
are killed in turn. Prints the hash of each table; exit code 1 if one differs."""

from __future__ import annotations

import hashlib
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Final

import msgspec

from cosim.spec.scenario import Scenario, Suite, write_suite
from scenarios.suites.catalog import load_suite

_EACH: Final = {"unit": 4, "reactive": 2, "long-horizon": 2}
"""Number of scenarios of each structure or event of a suite; the shortest are taken."""
_SEED: Final = 7
_SHARDS = 3
_WORKERS = 3
_KILLS = 5
_LIMIT_S: Final = 3600.0


def thirty_scenarios() -> Suite:
    """Return a suite of thirty scenarios without decoys."""
    found: list[Scenario] = []
    for name, count in _EACH.items():
        suite = load_suite(name).scenarios
        for _, of_kind in groupby(sorted(suite, key=_kind_and_length), key=_kind):
            found += [*of_kind][:count]
    chosen = tuple(
        msgspec.structs.replace(one, suite="thirty")
        for one in found
        if not (one.id.startswith("static") or one.decoy_of)
    )
    return Suite(name="thirty", version="1", scenarios=chosen)


def _kind(scenario: Scenario) -> str:
    of = {"long-horizon": scenario.suite, "unit": scenario.structure}
    return of.get(scenario.suite, scenario.id.rpartition("-")[0])


def _kind_and_length(scenario: Scenario) -> tuple[str, float]:
    return _kind(scenario), scenario.route_line.length_m


def _cosim(*words: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "cosim", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _done(process: subprocess.Popen[bytes]) -> None:
    if (code := process.wait(_LIMIT_S)) != 0:
        raise SystemExit(f"{' '.join(map(str, process.args))}: exit code {code}")  # type: ignore[arg-type]


class _Mechanisms:
    """Each method runs the suite by one mechanism into a separate folder, and returns it."""

    def __init__(self, suite: Path, folder: Path) -> None:
        self._folder = folder
        self._words = (str(suite), "--policy", "orca", "--seed", str(_SEED))

    def one_process(self) -> Path:
        return self._run("one", "--jobs", "1")

    def four_processes(self) -> Path:
        return self._run("four", "--jobs", "4")

    def shards_merged(self) -> Path:
        parts = [
            self._run(f"shard-{i}", "--shard", f"{i}/{_SHARDS}") for i in range(1, _SHARDS + 1)
        ]
        _done(_cosim("merge", *map(str, parts), "--out", str(self._folder / "merged")))
        return self._folder / "merged"

    def ray(self) -> Path:
        return self._run("ray", "--on", "ray")

    def workers_killed(self) -> Path:
        with socket.create_server(("127.0.0.1", 0)) as free:
            at = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        out = self._folder / "workers"
        coordinator = _cosim("coordinator", *self._words, "--out", str(out), "--listen", at)
        workers = [_cosim("worker", "--connect", at, "--once") for _ in range(_WORKERS)]
        kills = _at_each(
            _KILLS,
            lambda: len([*out.glob("episodes/*/record.json")]),
            len(thirty_scenarios().scenarios),
        )
        try:
            while coordinator.poll() is None:
                time.sleep(0.1)
                if (number := next(kills)) is not None:
                    workers[number % _WORKERS].send_signal(signal.SIGKILL)
                    workers[number % _WORKERS].wait()
                    workers[number % _WORKERS] = _cosim("worker", "--connect", at, "--once")
            _done(coordinator)
        finally:
            for one in (coordinator, *workers):
                one.kill()
                one.wait()
        return out

    def _run(self, name: str, *how: str) -> Path:
        out = self._folder / name
        _done(_cosim("run", *self._words, "--out", str(out), *how))
        return out


def _at_each(times: int, done: Callable[[], int], total: int) -> Iterator[int | None]:
    """Yield numbers from 0 on, spread over the run, as it reaches each share; else None."""
    number = 0
    while True:
        if number < times and done() > (number + 0.5) * total / times:
            yield number
            number += 1
        else:
            yield None


def main_of(arguments: Sequence[str]) -> int:
    """Run all mechanisms and print the results."""
    with tempfile.TemporaryDirectory(prefix="cosim-equality-") as name:
        folder = Path(arguments[0]).absolute() if arguments else Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        suite = thirty_scenarios()
        write_suite(suite, folder / "thirty.json")
        print(f"{len(suite.scenarios)} scenarios", flush=True)
        hashes = []
        mechanisms = _Mechanisms(folder / "thirty.json", folder)
        for mechanism in (
            mechanisms.one_process,
            mechanisms.four_processes,
            mechanisms.shards_merged,
            mechanisms.ray,
            mechanisms.workers_killed,
        ):
            began_s = time.monotonic()
            table = (mechanism() / "results.csv").read_bytes()
            hashes.append(hashlib.sha256(table).hexdigest())
            rows = table.count(b"\n") - 1
            name = mechanism.__name__.replace("_", " ")
            print(
                f"{hashes[-1][:16]}  {name}, {rows} rows, {time.monotonic() - began_s:.0f} s",
                flush=True,
            )
    return int(len(set(hashes)) > 1)


if __name__ == "__main__":
    raise SystemExit(main_of(sys.argv[1:]))

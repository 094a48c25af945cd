"""Equality: thirty scenarios, run by each mechanism, give the same results.csv to the byte.

They are of `unit`, `reactive` and `long-horizon`.

    python -m tests.support.equality [FOLDER]

By one process, by four, in three shards that are merged, by Ray, and by a coordinator with three
workers that are killed in turn. Prints the hash of each table; exit code 1 if one differs.
"""

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
"""Number of scenarios of each structure or event of a suite, the shortest first."""
_SEED: Final = 7
_SHARDS = 3
_WORKERS = 3
_KILLS = 5
_LIMIT_S: Final = 3600.0


def thirty() -> Suite:
    """Thirty scenarios without decoys, as a suite."""
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


def _kind(one: Scenario) -> str:
    of = {"long-horizon": one.suite, "unit": one.structure}
    return of.get(one.suite, one.id.rpartition("-")[0])


def _kind_and_length(one: Scenario) -> tuple[str, float]:
    return _kind(one), one.route_line.length_m


def _cosim(*words: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "cosim", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _done(process: subprocess.Popen[bytes]) -> None:
    if (code := process.wait(_LIMIT_S)) != 0:
        raise SystemExit(f"{' '.join(map(str, process.args))}: exit code {code}")  # type: ignore[arg-type]


class _Ways:
    """Each runs the suite into a folder of its own, and returns it."""

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
            _KILLS, lambda: len([*out.glob("episodes/*/record.json")]), len(thirty().scenarios)
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


def _at_each(times: int, done: Callable[[], int], of: int) -> Iterator[int | None]:
    """Asked again and again, says a number from 0 on, spread over the run, when it has come so
    far; else None."""
    number = 0
    while True:
        if number < times and done() > (number + 0.5) * of / times:
            yield number
            number += 1
        else:
            yield None


def main_of(arguments: Sequence[str]) -> int:
    """Run all ways and print what came out."""
    with tempfile.TemporaryDirectory(prefix="cosim-equality-") as name:
        folder = Path(arguments[0]).absolute() if arguments else Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        suite = thirty()
        write_suite(suite, folder / "thirty.json")
        print(f"{len(suite.scenarios)} scenarios", flush=True)
        hashes = []
        ways = _Ways(folder / "thirty.json", folder)
        for way in (
            ways.one_process,
            ways.four_processes,
            ways.shards_merged,
            ways.ray,
            ways.workers_killed,
        ):
            began_s = time.monotonic()
            table = (way() / "results.csv").read_bytes()
            hashes.append(hashlib.sha256(table).hexdigest())
            rows = table.count(b"\n") - 1
            name = way.__name__.replace("_", " ")
            print(
                f"{hashes[-1][:16]}  {name}, {rows} rows, {time.monotonic() - began_s:.0f} s",
                flush=True,
            )
    return int(len(set(hashes)) > 1)


if __name__ == "__main__":
    raise SystemExit(main_of(sys.argv[1:]))

"""Expected results of an installation, shipped as verify.json with the suites."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec

from cosim.core.errors import EngineError, RunError, unwritable
from cosim.core.files import write_atomic
from cosim.core.progress import Progress
from cosim.core.versions import versions
from cosim.spec.scenario import Scenario
from physics.cameras.choice import camera_of_choice, renderer_of
from scenarios.episodes.run_episode import error_message
from scenarios.suites.catalog import SUITES, load_suite
from scenarios.tools.verify.engines import DRIVER, engines_alone, source_hashes, textures
from scenarios.tools.verify.traces import Trace, traced

SHIPPED: Final = next(iter(SUITES.values())).parent / "verify.json"
_SCHEMA: Final = 1


class Results(msgspec.Struct, frozen=True, kw_only=True):
    """Results of an installation.

    renderer: of the gl camera, "" without one.
    traces: by case, or the reason for a missing trace.
    """

    schema: int = _SCHEMA
    versions: dict[str, str]
    renderer: str
    suites: dict[str, str]
    sources: dict[str, str]
    alone: dict[str, str]
    textures: dict[str, str]
    traces: dict[str, Trace | str]

    def save(self, path: Path) -> None:
        """Write as JSON, whole or not at all. Raises MachineError."""
        data = msgspec.json.format(msgspec.json.encode(self), indent=1) + b"\n"
        try:
            write_atomic(path, data)
        except OSError as error:
            raise unwritable(path, error) from error

    @classmethod
    def load(cls, path: Path) -> Results:
        """Raises RunError that names the file and the remedy."""
        try:
            results = msgspec.json.decode(path.read_bytes(), type=cls)
        except (OSError, msgspec.DecodeError) as error:
            raise RunError(f"{path}: holds nothing to verify by: {error}. Install again") from error
        if results.schema != _SCHEMA:
            raise RunError(
                f"{path}: schema {results.schema}; this version reads {_SCHEMA}. Install again"
            )
        return results


def results_here(cases: Sequence[Scenario], jobs: int, progress: Progress) -> Results:
    """Return the results of this installation.

    jobs: number of processes; this one is used for 1.
    progress: receives the name of the running part.

    Raises EngineError if a process dies.
    """
    work: dict[str, Callable[[], Any]] = {"the engines alone": engines_alone, "textures": textures}
    work |= {case.id: partial(trace_of, case) for case in cases}
    alone, layers, *traces = (
        _done_here(work, progress) if jobs == 1 else _done_in_processes(work, jobs, progress)
    )
    return Results(
        versions=versions(),
        renderer=renderer_of(camera_of_choice("gl")) if DRIVER in alone else "",
        suites={name: load_suite(name).content_hash for name in SUITES},
        sources=source_hashes(),
        alone=alone,
        textures=layers,
        traces={case.id: trace for case, trace in zip(cases, traces, strict=True)},
    )


def _done_here(work: Mapping[str, Callable[[], Any]], progress: Progress) -> list[Any]:
    done = []
    for name, do in work.items():
        progress(name)
        done.append(do())
    return done


def _done_in_processes(
    work: Mapping[str, Callable[[], Any]], jobs: int, progress: Progress
) -> list[Any]:
    done = []
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        for name, one in {name: pool.submit(do) for name, do in work.items()}.items():
            progress(name)
            try:
                done.append(one.result())
            except BrokenProcessPool:
                where = f"a process died in {name}, or in what was under way beside it"
                raise EngineError(
                    f"{where}: `cosim verify --jobs 1` shows where, `cosim doctor` what works"
                ) from None
    return done


def trace_of(case: Scenario) -> Trace | str:
    """Return the trace of a case, or the error message if it fails."""
    try:
        return traced(case)
    except Exception as error:  # noqa: BLE001  wrong package versions are reported too
        return error_message(error)


def writable(results: Results, cases: Sequence[str]) -> Results:
    """Return results that may be shipped: all cases, each run, by both cameras. Raises RunError."""
    broken = [
        f"{name} ({trace})" for name, trace in results.traces.items() if isinstance(trace, str)
    ]
    lacking = [name for name in cases if name not in results.traces]
    if broken or lacking or not results.renderer:
        why = (
            f"cases that did not run: {', '.join(broken + lacking)}"
            if broken or lacking
            else "there is no gl camera"
        )
        raise RunError(f"what is shipped is made of all cases and both cameras, and here {why}")
    return results

"""Build a suite with a process for each place.

Proofs are stored scenario by scenario, so a stopped build can be resumed. A process that dies or
hangs costs one candidate.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Final

import msgspec

import cosim
import physics
import scenarios
import sumo_nets
from cosim.core.cache import sources_hash
from cosim.core.child_process import limit_threads
from cosim.core.errors import CosimError, RunError, SpecError, UsageError
from cosim.core.files import write_atomic
from cosim.core.progress import Progress, ignore
from cosim.spec.scenario import Place, Scenario, Suite, write_suite
from scenarios.suites.catalog import SUITES
from scenarios.suites.decoys import decoy_of, has_decoy, must_give_way
from scenarios.suites.proofs import Dropped, Proof, Proofs, write_proofs
from scenarios.suites.recipes import Slot, SuiteRecipe, candidate, recipe_of, repeated
from scenarios.tools.build.claims import on_one_spot
from scenarios.tools.build.proving import accepted

CANDIDATES: Final = 6
"""Largest number of candidates of a scenario."""
_MADE_BY: Final = "made-by.txt"
_HANGS_S: Final = {"long-horizon": 900.0}
_HANGS_SHORT_S: Final = 240.0
"""Timeout of a candidate, in seconds: many times its usual duration."""
_BEGUN: Final = 2
"""Largest number of starts of a candidate. The first may end with the build; a second end is its
own fault.
"""
_POLL_S: Final = 0.1


class AcceptedScenario(msgspec.Struct, frozen=True):
    """Accepted scenario with its proof."""

    scenario: Scenario
    proof: Proof


class _Tried(msgspec.Struct, frozen=True):
    """Progress of a slot. begun: number of starts of the current candidate, after the rejected
    ones.
    """

    dropped: tuple[Dropped, ...] = ()
    begun: int = 0


@dataclass(frozen=True)
class _Piece:
    """Scenarios of one suite in one place, in order: the work of a process."""

    suite: str
    where: Place
    slots: tuple[Slot, ...]


def build_suite(
    name: str,
    out: Path,
    jobs: int = 1,
    tries: int = CANDIDATES,
    progress: Progress = ignore,
    only: Sequence[str] = (),
    redraw: int = 0,
) -> tuple[Suite, Proofs]:
    """Build a suite at a path, with its proofs; the result does not depend on the number of
    processes.

    tries: candidates of each scenario.
    only: names of scenarios, to build a part of the suite for inspection.
    redraw: number of a redraw with other seeds; 0 for the shipped suite.

    Proofs are stored in the folder OUT.parts until the suite is complete. Call it again to resume.

    Raises SpecError with the scenarios whose candidates all failed. Raises RunError if OUT.parts is
    of another version, UsageError if a redraw would replace a shipped suite.
    """
    if redraw and out.resolve() in {path.resolve() for path in SUITES.values()}:
        raise UsageError(f"{out} is the shipped suite: write a redraw to a file of its own")
    recipe = recipe_of(name, redraw)
    folder = out.with_suffix(".parts")
    slots = _with_needed(recipe, only) if only else list(recipe.slots)
    _open(folder, f"{name} {redraw}" if redraw else name)
    for line, done in _run(_pieces(slots), folder, jobs, tries):
        progress(f"{done}/{len(slots)} {line}", done / len(slots))
    found = [_read_accepted(folder, slot) for slot in slots]
    if lacking := [slot.name for slot, one in zip(slots, found, strict=True) if one is None]:
        reasons = [f"{name}: {_in_words(_tried(folder, name).dropped)}" for name in lacking]
        raise SpecError(
            f"no candidate of {len(lacking)} scenarios is solved: {'; '.join(reasons)}. "
            f"Build again with more --tries"
        )
    stored = [one for one in found if one is not None]
    suite = Suite(
        name=name,
        version=recipe.version,
        description=recipe.description,
        scenarios=tuple(one.scenario for one in stored),
    )
    write_suite(suite, out)
    return suite, write_proofs(out, name, suite.content_hash, [one.proof for one in stored])


def _with_needed(recipe: SuiteRecipe, only: Sequence[str]) -> list[Slot]:
    """Return the slots of these names, the slots that they repeat, and the decoys of all."""
    named = {slot.name: slot for slot in recipe.slots}
    needed = [named[name] for name in only if name in named]
    names = {name for slot in needed for name in (slot.decoy_of or slot.name, slot.like)}
    return [slot for slot in recipe.slots if {slot.name, slot.decoy_of} & (names - {""})]


def _open(folder: Path, name: str) -> None:
    """Create the folder of the parts, or continue in it. Raises RunError if another version of the
    code made its contents."""
    rooms = [Path(room.__file__ or "").parent for room in (cosim, physics, scenarios, sumo_nets)]
    made_by = f"{name} {sources_hash(*rooms)}"
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / _MADE_BY
    if note.exists() and note.read_text() != made_by:
        raise RunError(f"{folder}: begun by another version of the code: delete it and build again")
    write_atomic(note, made_by.encode())


def _pieces(slots: Sequence[Slot]) -> list[_Piece]:
    """Return the pieces of work, longest first."""
    by_place: dict[Place, list[Slot]] = {}
    for slot in slots:
        by_place.setdefault(slot.where, []).append(slot)
    pieces = [_Piece(those[0].suite, where, tuple(those)) for where, those in by_place.items()]
    return sorted(pieces, key=lambda piece: -sum(1.0 + slot.length_m for slot in piece.slots))


@dataclass
class _Worker:
    piece: _Piece
    process: BaseProcess
    last_done_s: float
    restarts: int = 0


def _run(
    pieces: Sequence[_Piece], folder: Path, jobs: int, tries: int
) -> Iterator[tuple[str, int]]:
    """Work on all pieces.

    Yields a line for each finished scenario, and the number of finished ones.
    """
    waiting = [(piece, 0) for piece in pieces]
    working = list[_Worker]()
    open_slots = {slot.name: slot for piece in pieces for slot in piece.slots}
    done = 0
    try:
        while waiting or working:
            while waiting and len(working) < jobs:
                piece, restarts = waiting.pop(0)
                working.append(
                    _Worker(piece, _started(piece, folder, tries), time.monotonic(), restarts)
                )
            time.sleep(_POLL_S)
            for worker in list(working):
                over = [
                    slot
                    for slot in worker.piece.slots
                    if slot.name in open_slots and _over(folder, slot, tries)
                ]
                for slot in over:
                    del open_slots[slot.name]
                    done += 1
                    worker.last_done_s = time.monotonic()
                    yield _line(folder, slot), done
                if worker.process.is_alive():
                    _kill_if_hung(worker, folder)
                    continue
                working.remove(worker)
                worker.process.join()
                most = _BEGUN * tries * len(worker.piece.slots)
                if worker.restarts < most and any(
                    slot.name in open_slots for slot in worker.piece.slots
                ):
                    waiting.insert(0, (worker.piece, worker.restarts + 1))
    finally:
        # Stopping the build does not use up a candidate.
        for worker in working:
            worker.process.kill()
            worker.process.join()
            for slot in worker.piece.slots:
                if (tried := _tried(folder, slot.name)).begun:
                    _note(folder, slot, _Tried(tried.dropped, tried.begun - 1))


def _kill_if_hung(worker: _Worker, folder: Path) -> None:
    """Kill a process whose candidate takes too long. Another process continues with the next
    candidate."""
    marks = [
        path.stat().st_mtime
        for slot in worker.piece.slots
        if (path := _trying(folder, slot.name)).exists()
    ]
    since_s = time.time() - max(marks, default=0.0)
    limit_s = _HANGS_S.get(worker.piece.suite, _HANGS_SHORT_S)
    if min(since_s, time.monotonic() - worker.last_done_s) > limit_s:
        worker.process.kill()
        worker.process.join()
        for slot in worker.piece.slots:
            if (tried := _tried(folder, slot.name)).begun:
                hung = Dropped(slot.seed(len(tried.dropped)), "hung")
                _note(folder, slot, _Tried((*tried.dropped, hung)))


def _started(piece: _Piece, folder: Path, tries: int) -> BaseProcess:
    limit_threads()
    process = get_context("spawn").Process(target=_work, args=(piece, folder, tries))
    process.start()
    return process


def _work(piece: _Piece, folder: Path, tries: int) -> None:
    """Prove the open slots of a piece, in a worker process."""
    for number, slot in enumerate(piece.slots):
        if not _over(folder, slot, tries):
            there = (_read_accepted(folder, one) for one in piece.slots[:number])
            _fill(slot, folder, tries, [one.scenario for one in there if one is not None])


def _fill(slot: Slot, folder: Path, tries: int, there: Sequence[Scenario] = ()) -> None:
    """Find and store the first candidate on a spot of its own that the expert solves.

    there: accepted scenarios of the place.
    """
    tried = _tried(folder, slot.name)
    dropped = list(tried.dropped)
    begun = tried.begun
    if begun >= _BEGUN:
        dropped.append(Dropped(slot.seed(len(dropped)), "its process died"))
        begun = 0
    for attempt in itertools.count(len(dropped)):
        if attempt >= tries:
            _note(folder, slot, _Tried(tuple(dropped)))
            return
        seed = slot.seed(attempt)
        _note(folder, slot, _Tried(tuple(dropped), begun + 1))
        begun = 0
        try:
            scenario = _drawn(slot, folder, seed)
        except CosimError as error:
            dropped.append(Dropped(seed, "none drawn", str(error)[:300]))
            continue
        if not slot.like and (twin := _twin(scenario, there)):
            dropped.append(Dropped(seed, "on the spot of another", twin))
            continue
        found = _accepted(scenario)
        if isinstance(found, Dropped):
            dropped.append(msgspec.structs.replace(found, seed=seed))
            continue
        for one, proof in reversed(found):  # the decoy first: the scenario's file ends the slot
            before = () if one.decoy_of else tuple(dropped)
            accepted_scenario = AcceptedScenario(
                one, msgspec.structs.replace(proof, dropped=before)
            )
            write_atomic(folder / f"{one.id}.json", msgspec.json.encode(accepted_scenario))
        _trying(folder, slot.name).unlink()
        return


def _twin(scenario: Scenario, there: Sequence[Scenario]) -> str:
    """Return the id of an accepted scenario of the same structure on the same spot, or ""."""
    return next(
        (
            one.id
            for one in there
            if one.structure == scenario.structure
            and not one.decoy_of
            and on_one_spot(one, scenario)
        ),
        "",
    )


def _accepted(scenario: Scenario) -> list[tuple[Scenario, Proof]] | Dropped:
    """Return a scenario, and its decoy if it is to have one, or why the expert fails in either."""
    first = accepted(scenario)
    if isinstance(first, Dropped):
        return first
    if not has_decoy(scenario):
        return [first]
    decoy = accepted(
        msgspec.structs.replace(decoy_of(first[0]), time_limit_s=scenario.time_limit_s)
    )
    if isinstance(decoy, Dropped):
        return msgspec.structs.replace(decoy, reason=f"decoy: {decoy.reason}")
    if must_give_way(scenario):
        first = accepted(msgspec.structs.replace(scenario, go_on_mps=decoy[0].go_on_mps))
        if isinstance(first, Dropped):
            return first
    return [first, decoy]


def _drawn(slot: Slot, folder: Path, seed: int) -> Scenario:
    if slot.decoy_of:
        raise SpecError(f"'{slot.decoy_of}', whose decoy it is, was not solved")
    if not slot.like:
        return candidate(slot, seed)
    path = folder / f"{slot.like}.json"
    if not path.exists():
        raise SpecError(f"'{slot.like}', which it repeats, was not solved")
    return repeated(slot, msgspec.json.decode(path.read_bytes(), type=AcceptedScenario).scenario)


def _trying(folder: Path, name: str) -> Path:
    return folder / f"{name}.trying"


def _note(folder: Path, slot: Slot, tried: _Tried) -> None:
    write_atomic(_trying(folder, slot.name), msgspec.json.encode(tried))


def _tried(folder: Path, name: str) -> _Tried:
    path = _trying(folder, name)
    return msgspec.json.decode(path.read_bytes(), type=_Tried) if path.exists() else _Tried()


def _over(folder: Path, slot: Slot, tries: int) -> bool:
    """Return whether a slot is filled, or all its candidates were tried."""
    if (folder / f"{slot.name}.json").exists():
        return True
    tried = _tried(folder, slot.name)
    return not tried.begun and len(tried.dropped) >= tries


def _read_accepted(folder: Path, slot: Slot) -> AcceptedScenario | None:
    path = folder / f"{slot.name}.json"
    return msgspec.json.decode(path.read_bytes(), type=AcceptedScenario) if path.exists() else None


def _line(folder: Path, slot: Slot) -> str:
    """Describe the result of a slot."""
    stored = _read_accepted(folder, slot)
    if stored is None:
        return f"{slot.name}: NOT SOLVED; {_in_words(_tried(folder, slot.name).dropped)}"
    length_m = stored.scenario.route_line.length_m
    line = f"{slot.name}: {length_m:.0f} m, {stored.proof.time_s:.0f} s"
    return f"{line}; dropped: {_in_words(stored.proof.dropped)}" if stored.proof.dropped else line


def _in_words(dropped: Sequence[Dropped]) -> str:
    return ", ".join(f"{one.seed} {one.reason} {one.details}".strip() for one in dropped)

"""One run folder from the shards of a run, wherever they ran. The shards are read, and not a byte
of them changes."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import pandas as pd

from cosim.core.errors import RunError, unwritable
from cosim.core.files import atomic_folder
from cosim.core.npz import read_npz
from cosim.core.progress import Progress
from cosim.results.finished_run import check_records, read_record
from cosim.results.record import Record
from cosim.results.run_folder import (
    RUN_AGAIN,
    TRAJECTORY,
    RunFolder,
    read_records,
    read_spec,
    record_file,
    refuse_in_use,
    told_apart,
)
from cosim.results.run_spec import RunSpec
from cosim.spec.scenario import Scenario, read_suite


class Merged(NamedTuple):
    """What became of a merge. table: of the merged run, as in results.csv; missing: scenarios that
    no shard has, without which there is no results.csv yet; twice: scenarios that several have,
    equal to the bit."""

    spec: RunSpec
    table: pd.DataFrame
    missing: tuple[str, ...]
    twice: tuple[str, ...]


class _Part(NamedTuple):
    """A folder that is merged. records: by scenario id."""

    path: Path
    spec: RunSpec
    records: Mapping[str, Record]


def merge_runs(folders: Sequence[Path], target: Path, progress: Progress) -> Merged:
    """Make the run folder `target`, whole or not at all, of run folders that are the same run but
    for their shard.

    Raises UsageError where there is no run, RunError, naming both sides, for folders of different
    runs, for one that is in use or damaged, for a scenario of which two folders have different
    episodes, and where `target` is not free.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise RunError(f"{target} exists already: choose another --out")
    parts: list[_Part] = []
    for folder in folders:
        progress(f"reading {folder}")
        parts.append(_read(folder, parts[0] if parts else None))
    spec = msgspec.structs.replace(parts[0].spec, shard=None)
    taken: dict[str, _Part] = {}
    twice: list[str] = []
    for part in parts:
        for name in part.records:
            if name in taken:
                _check_equal(name, taken[name], part)
                twice.append(name)
            else:
                taken[name] = part
    try:
        with atomic_folder(target, existing="refuse") as made:
            for name, part in taken.items():
                progress(f"copying the episodes of {part.path}")
                shutil.copytree(part.path / "episodes" / name, made / "episodes" / name)
            for number, part in enumerate(parts, 1):
                if (part.path / "logs").is_dir():
                    shutil.copytree(
                        part.path / "logs", made / "logs" / f"{number}-{part.path.resolve().name}"
                    )
            progress("making the tables")
            missing = tuple(name for name in spec.scenarios if name not in taken)
            with RunFolder.create(made, spec, read_suite(parts[0].path / "scenarios.json")) as held:
                table = held.finish()
            if missing:
                (made / "results.csv").unlink()
    except (OSError, shutil.Error) as error:
        why = error if isinstance(error, OSError) and error.errno else OSError(str(error))
        raise unwritable(target, why) from error
    return Merged(spec, table, missing, tuple(twice))


def _read(path: Path, first: _Part | None) -> _Part:
    """A folder, held against the first one and against itself."""
    spec = read_spec(path)
    refuse_in_use(path)
    if first is not None:
        if (apart := spec.apart(first.spec, but="shard")) is not None:
            raise RunError(
                f"{path} is of another run than {first.path}: its {apart.field} is {apart.mine}, "
                f"there it is {apart.theirs}: only what is of one run can be merged.{apart.hint}"
            )
        if _bytes(path / "scenarios.json") != _bytes(first.path / "scenarios.json"):
            raise RunError(
                f"{path / 'scenarios.json'} is not that of {first.path}: one of them was edited"
            )
    scenarios = {
        scenario.id: scenario for scenario in read_suite(path / "scenarios.json").scenarios
    }
    in_table = {record.scenario.id: record for record in read_records(path, untouched=True)}
    check_records(path, in_table, scenarios)
    records: dict[str, Record] = {}
    for name in spec.scenarios:
        file = record_file(path, name)
        if file.exists():
            records[name] = (
                in_table[name] if name in in_table else _not_in_table(path, file, scenarios)
            )
            if records[name].ended is not None and not file.with_name(TRAJECTORY).exists():
                raise RunError(f"{file.with_name(TRAJECTORY)}: not there: {RUN_AGAIN}")
    return _Part(path, spec, records)


def _not_in_table(path: Path, file: Path, scenarios: Mapping[str, Scenario]) -> Record:
    """A record that was written a moment before its run was killed."""
    record = read_record(file)
    if record.scenario.id != file.parent.name:
        raise RunError(f"{file} is of scenario '{record.scenario.id}': {RUN_AGAIN}")
    check_records(path, {record.scenario.id: record}, scenarios)
    return record


def _check_equal(name: str, one: _Part, other: _Part) -> None:
    """Raises RunError where two folders have different episodes of a scenario. Wall times may
    differ."""
    mine, theirs = (msgspec.structs.replace(part.records[name], clock={}) for part in (other, one))
    apart = told_apart(mine, theirs)
    if not apart:
        logs = [record_file(part.path, name).with_name(TRAJECTORY) for part in (one, other)]
        apart = "" if _same_arrays(*logs) else "trajectory.npz is another one"
    if apart:
        raise RunError(
            f"CONFLICT: {other.path} and {one.path} have different episodes of '{name}': in the "
            f"first {apart}. `cosim replay {other.path} {name}` says whether that is what comes "
            "out here; leave out the folder that is wrong"
        )


def _same_arrays(one: Path, other: Path) -> bool:
    """Whether two trajectories hold the same bits; how they are compressed is another matter."""
    if not (one.exists() and other.exists()):
        return one.exists() == other.exists()
    if one.read_bytes() == other.read_bytes():
        return True
    try:
        mine, theirs = read_npz(one), read_npz(other)
        return {*mine} == {*theirs} and all(
            mine[name].dtype == theirs[name].dtype
            and mine[name].tobytes() == theirs[name].tobytes()
            for name in mine
        )
    except (OSError, ValueError) as error:
        raise RunError(f"{one} and {other}: one is no trajectory: {error}") from error


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RunError(
            f"{path}: cannot be read: {error.strerror}: it is not a whole run folder"
        ) from error

"""Merge the shards of a run into one run folder, without changing the shards."""

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
from cosim.results.record import Record
from cosim.results.run_folder import (
    RUN_AGAIN,
    RunFolder,
    check_not_in_use,
    read_records,
    read_scenarios,
    read_spec,
    record_difference,
    record_file,
    trajectory_file,
)
from cosim.results.run_spec import RunSpec
from cosim.results.verified_run import check_records, read_record
from cosim.spec.scenario import Scenario, read_suite


class MergeResult(NamedTuple):
    """Result of a merge.

    table: table of the merged run, as in results.csv
    missing: scenarios that no shard has; results.csv is not written while there are any
    twice: scenarios that several shards have, with bit-identical episodes
    """

    spec: RunSpec
    table: pd.DataFrame
    missing: tuple[str, ...]
    twice: tuple[str, ...]


class _Part(NamedTuple):
    """Folder to be merged.

    records: by scenario id.
    """

    path: Path
    spec: RunSpec
    records: Mapping[str, Record]


def merge_runs(folders: Sequence[Path], target: Path, progress: Progress) -> MergeResult:
    """Merge run folders that differ only in their shard into `target`, atomically.

    Raises UsageError if a folder holds no run. Raises RunError for folders of different runs, a
    folder in use or damaged, conflicting episodes of one scenario, and a `target` that is not
    empty.
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
        with atomic_folder(target, existing="refuse") as target_part:
            for name, part in taken.items():
                progress(f"copying the episodes of {part.path}")
                shutil.copytree(part.path / "episodes" / name, target_part / "episodes" / name)
            for number, part in enumerate(parts, 1):
                if (part.path / "logs").is_dir():
                    shutil.copytree(
                        part.path / "logs",
                        target_part / "logs" / f"{number}-{part.path.resolve().name}",
                    )
            progress("making the tables")
            missing = tuple(name for name in spec.scenarios if name not in taken)
            with RunFolder.create(
                target_part, spec, read_suite(parts[0].path / "scenarios.json")
            ) as run_folder:
                table = run_folder.finish()
            if missing:
                (target_part / "results.csv").unlink()
    except (OSError, shutil.Error) as error:
        cause = error if isinstance(error, OSError) and error.errno else OSError(str(error))
        raise unwritable(target, cause) from error
    return MergeResult(spec, table, missing, tuple(twice))


def _read(path: Path, first: _Part | None) -> _Part:
    """Read a folder and check it against the first folder and its own database."""
    spec = read_spec(path)
    check_not_in_use(path)
    if first is not None:
        if (difference := spec.difference_from(first.spec, ignored="shard")) is not None:
            raise RunError(
                f"{path} is of another run than {first.path}: its {difference.field} is "
                f"{difference.mine}, there it is {difference.theirs}: only what is of one run "
                f"can be merged.{difference.hint}"
            )
        if _bytes(path / "scenarios.json") != _bytes(first.path / "scenarios.json"):
            raise RunError(
                f"{path / 'scenarios.json'} is not that of {first.path}: one of them was edited"
            )
    scenarios = read_scenarios(path)
    in_table = {record.scenario.id: record for record in read_records(path, untouched=True)}
    check_records(path, in_table, scenarios)
    records: dict[str, Record] = {}
    for name in spec.scenarios:
        file = record_file(path, name)
        if file.exists():
            records[name] = (
                in_table[name] if name in in_table else _not_in_table(path, file, scenarios)
            )
            trajectory = trajectory_file(path, name)
            if records[name].ended is not None and not trajectory.exists():
                raise RunError(f"{trajectory}: not there: {RUN_AGAIN}")
    return _Part(path, spec, records)


def _not_in_table(path: Path, file: Path, scenarios: Mapping[str, Scenario]) -> Record:
    """Load a record that was written just before its run was killed, so that it has no row."""
    record = read_record(file)
    if record.scenario.id != file.parent.name:
        raise RunError(f"{file} is of scenario '{record.scenario.id}': {RUN_AGAIN}")
    check_records(path, {record.scenario.id: record}, scenarios)
    return record


def _check_equal(name: str, one: _Part, other: _Part) -> None:
    """Raise RunError if two folders have different episodes of a scenario, ignoring wall times."""
    other_record, record = (
        msgspec.structs.replace(part.records[name], clock={}) for part in (other, one)
    )
    difference = record_difference(other_record, record)
    if not difference:
        logs = [trajectory_file(part.path, name) for part in (one, other)]
        difference = "" if _same_arrays(*logs) else "trajectory.npz is another one"
    if difference:
        raise RunError(
            f"CONFLICT: {other.path} and {one.path} have different episodes of '{name}': in the "
            f"first {difference}. `cosim replay {other.path} {name}` says whether that is what "
            "comes out here; leave out the folder that is wrong"
        )


def _same_arrays(one: Path, other: Path) -> bool:
    """Return whether two trajectories hold the same bits, regardless of compression."""
    if not (one.exists() and other.exists()):
        return one.exists() == other.exists()
    if one.read_bytes() == other.read_bytes():
        return True
    try:
        arrays, other_arrays = read_npz(one), read_npz(other)
        return {*arrays} == {*other_arrays} and all(
            arrays[name].dtype == other_arrays[name].dtype
            and arrays[name].tobytes() == other_arrays[name].tobytes()
            for name in arrays
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

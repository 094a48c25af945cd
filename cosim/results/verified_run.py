"""Read a run folder and verify that its files are consistent."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from cosim.core.errors import RunError
from cosim.results.record import Record
from cosim.results.run_folder import (
    DATABASE,
    RUN_AGAIN,
    check_not_in_use,
    read_records,
    read_scenarios,
    read_spec,
    record_difference,
    record_file,
)
from cosim.results.run_setup import METRIC_SCHEMA
from cosim.results.run_spec import RunSpec
from cosim.spec.scenario import Scenario, content_hash

_UNKNOWN_SCHEMA = "an earlier version, which did not record its metric schema"


class VerifiedRun(NamedTuple):
    """Run whose files are consistent, with at least one ended episode.

    scenarios: all scheduled scenarios by id
    records: records of the ended episodes by scenario id
    """

    path: Path
    spec: RunSpec
    scenarios: Mapping[str, Scenario]
    records: Mapping[str, Record]


def read_verified_run(path: Path) -> VerifiedRun:
    """Read and verify the run in a folder.

    Raises UsageError if the folder holds no run, SpecError for a damaged `scenarios.json`. Raises
    RunError, naming file and remedy, if the run is in progress or has no ended episode. The same
    holds for a missing, damaged or inconsistent record, edited scenarios and another metric schema.
    """
    spec = read_spec(path)
    check_not_in_use(path)
    records = {
        record.scenario.id: record
        for record in sorted(read_records(path), key=lambda r: r.scenario.id)
    }
    if not records:
        raise RunError(
            f"{path}: no episode of it has ended: give the command of the run again with --resume"
        )
    scenarios = read_scenarios(path)
    check_records(path, records, scenarios)
    return VerifiedRun(path, spec, scenarios, records)


def check_records(
    path: Path, records: Mapping[str, Record], scenarios: Mapping[str, Scenario]
) -> None:
    """Check records of `results.sqlite` against the files of a run folder.

    Raises RunError as `read_verified_run` does.
    """
    for name, record in records.items():
        _check_schema(path, record)
        if name not in scenarios or content_hash(scenarios[name]) != record.scenario.hash:
            raise RunError(
                f"{path / 'scenarios.json'}: scenario '{name}' is not the one that was run, it was "
                "edited since: put the file back as it was, or run it again into another --out"
            )
        check_record_file(path, record)


def check_record_file(path: Path, record: Record) -> None:
    """Raise RunError if a record of `results.sqlite` differs from its file, or the file is
    unreadable."""
    file = record_file(path, record.scenario.id)
    if not file.exists():
        if record.ended is not None:
            raise RunError(f"{file}: not there: {RUN_AGAIN}")
    elif difference := record_difference(read_record(file), record):
        raise RunError(
            f"{file}: not what {DATABASE} has of this episode: {difference}: {RUN_AGAIN}"
        )


def read_record(file: Path) -> Record:
    """Load a record of a run folder. Raises RunError with the remedy."""
    try:
        return Record.load(file)
    except RunError as error:
        raise RunError(f"{error}: {RUN_AGAIN}") from error


def other_schema(record: Record) -> str:
    """Return in words that measures have another metric schema than this version; "" if not."""
    if (schema := record.setup.metric_schema) == METRIC_SCHEMA:
        return ""
    recorded = f"metric schema {schema}" if schema else _UNKNOWN_SCHEMA
    return (
        f"the measures of '{record.scenario.id}' are of {recorded}; this version has "
        f"{METRIC_SCHEMA}"
    )


def _check_schema(path: Path, record: Record) -> None:
    """Raise RunError if the measures have another metric schema."""
    if words := other_schema(record):
        raise RunError(
            f"{path}: {words}, and other definitions are not compared: run it again with this "
            "version"
        )

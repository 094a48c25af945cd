"""WholeRun: a run that has ended, read with care: what in its folder does not belong together is
refused, by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from cosim.core.errors import RunError
from cosim.results.record import Record
from cosim.results.run_folder import (
    DATABASE,
    RUN_AGAIN,
    read_records,
    read_spec,
    record_file,
    refuse_in_use,
    told_apart,
)
from cosim.results.run_setup import METRIC_SCHEMA
from cosim.results.run_spec import RunSpec
from cosim.spec.scenario import Scenario, content_hash, read_suite

_UNTOLD = "an earlier version, which did not tell its metric schema"


class WholeRun(NamedTuple):
    """scenarios: that were to be run; records: of those that have ended. Both by scenario id."""

    path: Path
    spec: RunSpec
    scenarios: Mapping[str, Scenario]
    records: Mapping[str, Record]


def read_whole_run(path: Path) -> WholeRun:
    """The run in a folder.

    Raises UsageError where there is none; RunError, naming file and remedy, while it is going on,
    before an episode has ended, for a record that is gone, truncated or not what `results.sqlite`
    has, for scenarios that were edited since, and for measures of another metric schema; SpecError
    for a damaged `scenarios.json`.
    """
    spec = read_spec(path)
    refuse_in_use(path)
    records = {
        record.scenario.id: record
        for record in sorted(read_records(path), key=lambda r: r.scenario.id)
    }
    if not records:
        raise RunError(
            f"{path}: no episode of it has ended: give the command of the run again with --resume"
        )
    scenarios = {
        scenario.id: scenario for scenario in read_suite(path / "scenarios.json").scenarios
    }
    check_records(path, records, scenarios)
    return WholeRun(path, spec, scenarios, records)


def check_records(
    path: Path, records: Mapping[str, Record], scenarios: Mapping[str, Scenario]
) -> None:
    """Hold records of `results.sqlite` against the files of a run folder. Raises RunError as
    `read_whole_run` does."""
    for name, record in records.items():
        _check_schema(path, record)
        if name not in scenarios or content_hash(scenarios[name]) != record.scenario.hash:
            raise RunError(
                f"{path / 'scenarios.json'}: scenario '{name}' is not the one that was run, it was "
                "edited since: put the file back as it was, or run it again into another --out"
            )
        check_record_file(path, record)


def check_record_file(path: Path, record: Record) -> None:
    """Raises RunError, naming file and remedy, where the record of an episode that `results.sqlite`
    has is not the one in its file, or that is gone or damaged."""
    file = record_file(path, record.scenario.id)
    if not file.exists():
        if record.ended is not None:
            raise RunError(f"{file}: not there: {RUN_AGAIN}")
    elif apart := told_apart(read_record(file), record):
        raise RunError(f"{file}: not what {DATABASE} has of this episode: {apart}: {RUN_AGAIN}")


def read_record(file: Path) -> Record:
    """The record in a file of a run folder. Raises RunError, with what mends it."""
    try:
        return Record.load(file)
    except RunError as error:
        raise RunError(f"{error}: {RUN_AGAIN}") from error


def _check_schema(path: Path, record: Record) -> None:
    """Raises RunError where measures are not by the definitions of this version."""
    if (schema := record.setup.metric_schema) != METRIC_SCHEMA:
        made = f"metric schema {schema}" if schema else _UNTOLD
        raise RunError(
            f"{path}: the measures of '{record.scenario.id}' are of {made}; this version has "
            f"{METRIC_SCHEMA}, and "
            "other definitions are not compared: run it again with this version"
        )

"""The files of an episode in a run folder: where they are, and whether they are whole."""

from __future__ import annotations

from pathlib import Path

import msgspec

from cosim.core.errors import RunError
from cosim.core.npz import read_npz
from cosim.episode.log import Log
from cosim.records.record import Record
from cosim.spec.ranges import shown

TRAJECTORY = "trajectory.npz"
DEMONSTRATION = "demonstration.npz"
RUN_AGAIN = "give the command of the run again with --resume, which runs this episode again and keeps the others"
"""The remedy for files that are damaged or missing."""


def record_file(path: Path, scenario_id: str) -> Path:
    """Where the record of an episode is."""
    return path / "episodes" / scenario_id / "record.json"


def damage_of_episode(path: Path, scenario_id: str, row: Record | None = None) -> str:
    """What is wrong with the files of an episode that has ended, with the file; "" if nothing is. row: the record that
    the run's database holds, with which the file must agree."""
    file = record_file(path, scenario_id)
    if row is not None and row.ended is None and not file.exists():
        return ""  # it was given up, and left no file
    try:
        record = Record.load(file)
        if record.scenario != scenario_id:
            return f"{file} is of scenario {shown(record.scenario)}"
        if row is not None and (apart := told_apart(record, row)):
            return f"{file}: not what results.sqlite has of this episode: {apart}"
        trajectory = file.with_name(TRAJECTORY)
        if record.ended is not None and (ticks := len(Log.load(trajectory))) != record.ticks:
            return f"{trajectory}: holds {ticks} ticks, and its record {record.ticks}"
    except RunError as error:
        return str(error)
    return _damage_of_demonstration(file.with_name(DEMONSTRATION))


def _damage_of_demonstration(file: Path) -> str:
    try:
        if file.exists():
            read_npz(file)
    except (OSError, ValueError) as error:
        return f"{file}: no demonstration: {error}"
    return ""


def told_apart(mine: Record, theirs: Record) -> str:
    """Where two records of an episode are first apart, in words; "" where they are not."""
    told, other = (msgspec.to_builtins(record) for record in (mine, theirs))
    for field, value in told.items():
        if isinstance(value, dict):
            for name in dict.fromkeys([*value, *other[field]]):
                if value.get(name) != other[field].get(name):
                    return f"{field}.{name} is {value.get(name)}, there {other[field].get(name)}"
        elif value != other[field]:
            return f"{field} is {shown(value)}, there {shown(other[field])}"
    return ""

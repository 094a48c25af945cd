"""A run folder: what was asked for, and what came out, episode by episode; survives a kill at any moment.

run.json                         what is run: suite, policy, scenarios, versions, renderer
scenarios.json                   the resolved specs
episodes/<scenario>/record.json  and trajectory.npz, written by the worker, whole or not at all
results.sqlite                   one row per finished episode, in the order in which they ended
results.csv                      the same, sorted by scenario, written at the end
logs/                            what the engines of each worker printed
lock                             held while a run is going on
"""

from __future__ import annotations

import fcntl
import json
import os
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
import pandas as pd

from cosim.errors import MachineError, RunError, unknown, unwritable
from cosim.record import Record
from cosim.results import row_of, table_of
from cosim.scenario import Suite, write_suite

UNFINISHED = {"episodes", "logs", "scenarios.json", "run.json.part"}
"""All that a run leaves that was killed before it began."""


class RunSpec(msgspec.Struct, frozen=True, kw_only=True):
    """What a run is. Two runs with the same RunSpec have the same results. renderer: what draws the pictures.
    counterfactual: whether each episode is compared with its street without the robot."""

    suite: str
    suite_version: str
    suite_hash: str
    policy: str
    policy_name: str
    policy_version: str
    scenarios: tuple[str, ...]
    versions: dict[str, str]
    renderer: str = "unknown"
    counterfactual: bool = False
    schema: int = 1


class RunFolder:
    """A run folder held by this process. Use as a context manager: it is locked meanwhile."""

    def __init__(self, path: Path, spec: RunSpec) -> None:
        self.path = path
        self.spec = spec
        self._lock = -1

    @classmethod
    def create(cls, path: Path, spec: RunSpec, suite: Suite) -> RunFolder:
        """A new run folder. Raises RunError when one is there already or the place cannot be written."""
        if (path / "run.json").exists():
            raise RunError(f"{path} already holds a run. Add --resume to finish it, or choose another --out.")
        if path.exists() and (not path.is_dir() or {p.name for p in path.iterdir()} - UNFINISHED):
            raise RunError(f"{path} exists and is no run folder. Choose another --out.")
        try:
            for folder in (path, path / "episodes", path / "logs"):
                folder.mkdir(parents=True, exist_ok=True)
            wanted = set(spec.scenarios)
            chosen = msgspec.structs.replace(suite, scenarios=tuple(s for s in suite.scenarios if s.id in wanted))
            write_suite(chosen, path / "scenarios.json")
            temporary = path / "run.json.part"
            temporary.write_bytes(msgspec.json.format(msgspec.json.encode(spec), indent=1) + b"\n")
            temporary.replace(path / "run.json")
        except OSError as error:
            raise unwritable(path, error) from error
        return cls(path, spec)

    @classmethod
    def resume(cls, path: Path, spec: RunSpec) -> RunFolder:
        """The run folder at `path`, to be finished. Raises RunError, naming the difference, if it is of another run."""
        found = read_spec(path)
        same = (
            "suite",
            "suite_version",
            "suite_hash",
            "policy",
            "policy_version",
            "scenarios",
            "versions",
            "renderer",
            "counterfactual",
        )
        for field in same:
            mine, theirs = getattr(spec, field), getattr(found, field)
            if mine != theirs:
                if isinstance(mine, dict) and isinstance(theirs, dict):
                    changed = {name for name in mine.keys() | theirs.keys() if mine.get(name) != theirs.get(name)}
                    mine, theirs = ({n: of.get(n) for n in sorted(changed)} for of in (mine, theirs))
                raise RunError(
                    f"{path} is of another run: its {field} is {_brief(theirs)}, now asked for is {_brief(mine)}. "
                    "Resume with the same command, or choose another --out."
                )
        return cls(path, found)

    def __enter__(self) -> Self:
        self._lock = os.open(self.path / "lock", os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(self._lock, 32, 0).decode().strip() or "?"
            os.close(self._lock)
            raise RunError(
                f"{self.path} is in use by process {holder}: another cosim run is writing to it. "
                "Wait for it to end, or choose another --out."
            ) from None
        os.ftruncate(self._lock, 0)
        os.pwrite(self._lock, str(os.getpid()).encode(), 0)
        with closing(self._database()) as database, database:
            database.execute("create table if not exists episodes (scenario text primary key, row text, record text)")
        for scenario_id in sorted(set(self.spec.scenarios) - self.finished()):
            self.adopt(scenario_id)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._lock)

    def episode_folder(self, scenario_id: str) -> Path:
        return self.path / "episodes" / scenario_id

    def finished(self) -> set[str]:
        """Ids of the scenarios that have a row."""
        with closing(self._database()) as database:
            return {scenario for (scenario,) in database.execute("select scenario from episodes")}

    def add(self, record: Record) -> None:
        """Append a finished episode. A second one of the same scenario is not taken."""
        row = json.dumps(row_of(record), sort_keys=True)
        text = msgspec.json.encode(record).decode()
        try:
            with closing(self._database()) as database, database:
                database.execute("insert or ignore into episodes values (?, ?, ?)", (record.scenario, row, text))
        except sqlite3.Error as error:
            raise MachineError(f"{self.path / 'results.sqlite'}: {error}. Finished episodes are safe.") from error

    def finish(self) -> pd.DataFrame:
        """Write results.csv and return its table."""
        table = table_of(read_records(self.path))
        temporary = self.path / "results.csv.part"
        try:
            table.to_csv(temporary, index=False)
            temporary.replace(self.path / "results.csv")
        except OSError as error:
            raise unwritable(
                self.path / "results.csv", error, "all episodes are kept; make room and add --resume"
            ) from error
        return table

    def adopt(self, scenario_id: str) -> bool:
        """Take in the record that a worker wrote for a scenario; False when there is none."""
        path = self.episode_folder(scenario_id) / "record.json"
        if path.exists():
            self.add(Record.load(path))
        return path.exists()

    def _database(self) -> sqlite3.Connection:
        return _connect(self.path)


def read_spec(path: Path) -> RunSpec:
    """What the run in a folder is. Raises UsageError, with the runs beside it, when it holds none."""
    try:
        return msgspec.json.decode((path / "run.json").read_bytes(), type=RunSpec)
    except FileNotFoundError:
        beside = [p.parent.name for p in path.parent.glob("*/run.json")] if path.parent.is_dir() else []
        raise unknown("run", str(path), beside) from None
    except (OSError, msgspec.DecodeError) as error:
        raise RunError(f"{path / 'run.json'}: {error}") from error


def read_records(path: Path) -> list[Record]:
    """The records of a run folder, finished or not, in the order in which they ended."""
    read_spec(path)
    if not (path / "results.sqlite").exists():
        return []
    try:
        with closing(_connect(path)) as database:
            rows: Sequence[tuple[str]] = database.execute("select record from episodes order by rowid").fetchall()
        return [msgspec.json.decode(text, type=Record) for (text,) in rows]
    except (sqlite3.Error, msgspec.DecodeError) as error:
        raise RunError(f"{path / 'results.sqlite'}: {error}") from error


def _connect(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(path / "results.sqlite", timeout=30.0)
    database.execute("pragma journal_mode = wal")
    database.execute("pragma synchronous = full")
    return database


def _brief(value: object) -> str:
    text = str(value)
    return text if len(text) <= 80 else text[:77] + "..."

"""Run folder: episode files, the database `results.sqlite`, locking and resuming.

run.json                         the run: suite, policy, scenarios, versions, renderer
scenarios.json                   the resolved specs
episodes/<scenario>/record.json  and trajectory.npz, written atomically by the run's process;
                                 frames/ and demonstration.npz where these are collected
results.sqlite                   one row per finished episode, in the order in which they ended
results.csv                      the same, sorted by scenario, written at the end
attempts.jsonl                   failed attempts, one a line; counted again by --resume
figures.json                     throughput of each start of the run
logs/                            output of the engines of each worker
lock                             locked while the run is in progress
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple, Self

import msgspec
from filelock import FileLock

from cosim.core.errors import MachineError, RunError, UsageError, listed, unknown, unwritable
from cosim.core.files import is_locked, lock, read_limited, write_atomic
from cosim.core.npz import read_npz
from cosim.results.folder_guard import FolderGuard
from cosim.results.log import Log
from cosim.results.record import RECORD_FILE, Record
from cosim.results.run_spec import RUN_FILE, RunSpec, decode_spec
from cosim.spec.scenario import Scenario, Suite, read_suite, write_suite
from cosim.spec.validation import shown

if TYPE_CHECKING:
    import pandas as pd

DATABASE = "results.sqlite"
REMEDY = "give the command of the run again with --resume, which builds it from the records on disk"
"""Remedy for a missing or damaged database."""
_DAMAGE_CODES = {
    sqlite3.SQLITE_ERROR,
    sqlite3.SQLITE_CORRUPT,
    sqlite3.SQLITE_NOTADB,
    sqlite3.SQLITE_MISMATCH,
    sqlite3.SQLITE_SCHEMA,
}


def connect_database(path: Path) -> sqlite3.Connection:
    """Open the database of a run folder; create it if missing."""
    database = sqlite3.connect(path / DATABASE, timeout=30.0)
    try:
        database.execute("pragma journal_mode = wal")
        database.execute("pragma synchronous = full")
    except sqlite3.Error:
        database.close()
        raise
    return database


def check_database(path: Path) -> None:
    """Read the whole database; create it if missing.

    Raises sqlite3.Error or DecodeError if it is damaged.
    """
    with closing(connect_database(path)) as database, database:
        database.execute(
            "create table if not exists episodes (scenario text primary key, record text)"
        )
        faults = [fault for (fault,) in database.execute("pragma quick_check")]
        if faults != ["ok"]:
            raise sqlite3.DatabaseError(faults[0])
        select_records(database)


def select_records(database: sqlite3.Connection) -> list[Record]:
    """Return all records in the order in which their episodes ended.

    Raises sqlite3.Error for a damaged database, DecodeError for a damaged row.
    """
    rows: Sequence[tuple[object]] = database.execute(
        "select record from episodes order by rowid"
    ).fetchall()
    try:
        return [RECORD_FILE.decode(_text(value)) for (value,) in rows]
    except RecursionError as error:
        raise msgspec.DecodeError("a row is nested too deep") from error


def _text(value: object) -> str:
    """Return the text of a row. Raises DecodeError for another type."""
    if not isinstance(value, str):
        raise msgspec.DecodeError("a row holds no text")
    return value


def is_damaged(error: sqlite3.Error) -> bool:
    """Return whether an error means a damaged file, not a full disk or a lock."""
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT)
    return code & 0xFF in _DAMAGE_CODES or code == sqlite3.SQLITE_IOERR_SHORT_READ


def damaged_error(path: Path, error: Exception) -> RunError:
    """Return the error for a damaged database of a run folder."""
    return RunError(f"{path / DATABASE} is damaged ({error}): {REMEDY}")


def database_error(path: Path, error: sqlite3.Error) -> RunError | MachineError:
    """Return the error to raise for a database error."""
    if is_damaged(error):
        return damaged_error(path, error)
    return MachineError(
        f"{path / DATABASE}: {error}. Finished episodes are safe: make room and add --resume."
    )


TRAJECTORY = "trajectory.npz"
DEMONSTRATION = "demonstration.npz"
RUN_AGAIN = (
    "give the command of the run again with --resume, which runs this episode again and keeps "
    "the others"
)
"""Remedy for files that are damaged or missing."""


def record_file(path: Path, scenario_id: str) -> Path:
    """Return the path of an episode's record."""
    return path / "episodes" / scenario_id / "record.json"


def trajectory_file(path: Path, scenario_id: str) -> Path:
    """Return the path of an episode's trajectory."""
    return record_file(path, scenario_id).with_name(TRAJECTORY)


def load_log(path: Path, scenario_id: str) -> Log:
    """Load the log of an episode. Raises RunError with the remedy."""
    try:
        return Log.load(trajectory_file(path, scenario_id))
    except RunError as error:
        raise RunError(f"{error}: {RUN_AGAIN}") from error


def damage_of_episode(path: Path, scenario_id: str, row: Record | None = None) -> str:
    """Return what is wrong with the files of an ended episode, naming the file; "" if nothing is.

    row: record in the run's database, which the file must match
    """
    file = record_file(path, scenario_id)
    if row is not None and row.ended is None and not file.exists():
        return ""  # an episode without files, whose attempts all failed
    try:
        record = Record.load(file)
        if record.scenario.id != scenario_id:
            return f"{file} is of scenario {shown(record.scenario.id)}"
        if row is not None and (difference := record_difference(record, row)):
            return f"{file}: not what results.sqlite has of this episode: {difference}"
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


def record_difference(mine: Record, theirs: Record) -> str:
    """Return the first difference between two records, in words; "" if they are equal."""
    fields, their_fields = (
        msgspec.to_builtins(RECORD_FILE.flat(record)) for record in (mine, theirs)
    )
    for field, value in fields.items():
        their_value = their_fields[field]
        if isinstance(value, dict) and isinstance(their_value, dict):
            for name in dict.fromkeys([*value, *their_value]):
                if value.get(name) != their_value.get(name):
                    return f"{field}.{name} is {value.get(name)}, there {their_value.get(name)}"
        elif value != their_value:
            return f"{field} is {shown(value)}, there {shown(their_value)}"
    return ""


_ATTEMPTS = "attempts.jsonl"
_MAX_BYTES = 256 << 20
_ROOM_REMEDY = "finished episodes are safe: make room, and continue with --resume"
UNFINISHED = {"episodes", "logs", "lock", "scenarios.json", "run.json.part"}
"""Files that a run leaves if it was killed before it began."""


class FailedAttempt(NamedTuple):
    """Failed attempt at a scenario.

    away: whether its worker left, or its machine was lost
    """

    scenario: str
    away: bool


class RunFolder:
    """Run folder locked by this process; use as a context manager.

    path: absolute path
    notes: repairs made on opening, in words
    """

    def __init__(self, path: Path, spec: RunSpec, suite: Suite | None = None) -> None:
        self.path = path.absolute()
        self.spec = spec
        self.notes: list[str] = []
        self._suite = suite
        self._lock = lock(path / "lock", wait=False)
        self._connection: sqlite3.Connection | None = None
        self._guard: FolderGuard | None = None
        self._rows: dict[str, bytes] = {}
        self._start_files: dict[str, bytes] = {}

    @classmethod
    def create(cls, path: Path, spec: RunSpec, suite: Suite) -> RunFolder:
        """Prepare a new run folder.

        Raises RunError if the folder holds a run, MachineError if it cannot be written.
        """
        check_unused(path)
        return cls(path, spec, suite)

    @classmethod
    def resume(cls, path: Path, spec: RunSpec, suite: Suite | None = None) -> RunFolder:
        """Prepare to resume the run folder at `path`.

        suite: suite from which the scenarios of `spec` were selected

        Raises RunError, naming the difference, if the folder holds another run.
        """
        check_begun(path)
        found = read_spec(path)
        if found.policy == spec.policy and found.setup.policy_source != spec.setup.policy_source:
            raise RunError(
                f"{path} is of another run: the source of policy '{spec.policy}' was edited since "
                "it began. Resume with the source as it was, or choose another --out."
            )
        if (difference := found.difference_from(spec, suite=suite)) is not None:
            raise RunError(
                f"{path} is of another run: its {difference.field} is "
                f"{difference.mine}, and this command has {difference.theirs}. "
                f"Resume with the same command, or choose another --out.{difference.hint}"
            )
        return cls(path, found)

    def __enter__(self) -> Self:
        with _write_errors(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            _acquire(self._lock, self.path)
        try:
            if self._suite is not None:
                check_unused(self.path)
                self._begin(self._suite)
            self._open_database()
            self._note_files()
        except BaseException:
            self._lock.release()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._guard is not None:
            self._guard.close()
            self._guard = None
        self._lock.release()

    def episode_folder(self, scenario_id: str) -> Path:
        """Return the folder of an episode."""
        return self.path / "episodes" / scenario_id

    def finished_ids(self) -> set[str]:
        """Return ids of the scenarios with a row."""
        with _database_errors(self.path), closing(connect_database(self.path)) as database:
            return {scenario for (scenario,) in database.execute("select scenario from episodes")}

    def add_row(self, record: Record) -> None:
        """Append the row of a finished episode; a second one of the same scenario is ignored.

        A database that was damaged during the run is written again.
        """
        row = RECORD_FILE.encode(record)
        self._rows.setdefault(record.scenario.id, row)
        values = record.scenario.id, row.decode()
        try:
            if self._connection is None:  # reused: opening takes longer than adding
                self._connection = connect_database(self.path)
            with self._connection as database:
                database.execute(
                    "insert or ignore into episodes (scenario, record) values (?, ?)", values
                )
        except sqlite3.Error as error:
            if not is_damaged(error):
                raise database_error(self.path, error) from error
            self._replace_database(self.path / DATABASE)

    def _remove_rows(self, scenarios: Sequence[str]) -> None:
        """Delete the rows of episodes that will run again."""
        with (
            _database_errors(self.path),
            closing(connect_database(self.path)) as database,
            database,
        ):
            database.executemany(
                "delete from episodes where scenario = ?", [(name,) for name in scenarios]
            )

    def write_episode(self, record: Record, log: bytes = b"", demonstration: bytes = b"") -> None:
        """Write the files of an episode, the record last, and add its row.

        log: bytes of the `Log`
        """
        target = self.episode_folder(record.scenario.id)
        self.mend()
        with _write_errors(target, _ROOM_REMEDY):
            target.mkdir(parents=True, exist_ok=True)
            for name, data in ((TRAJECTORY, log), (DEMONSTRATION, demonstration)):
                if data:
                    write_atomic(target / name, data)
            record.save(target / "record.json")
        self.add_row(record)

    def write_frame(self, scenario_id: str, tick: int, png: bytes) -> None:
        """Write a camera frame of an episode."""
        frames = self.episode_folder(scenario_id) / "frames"
        with _write_errors(frames, _ROOM_REMEDY):
            frames.mkdir(parents=True, exist_ok=True)
            (frames / f"{tick:06d}.png").write_bytes(png)

    def failed_attempts(self) -> Counter[FailedAttempt]:
        """Count the failed attempts since the run began, by scenario and cause. Raises MachineError
        or UsageError if the file cannot be read."""
        try:
            lines = (self.path / _ATTEMPTS).read_bytes().splitlines()
        except FileNotFoundError:
            return Counter()
        except OSError as error:
            raise unwritable(self.path / _ATTEMPTS, error, _ROOM_REMEDY) from error
        found: Counter[FailedAttempt] = Counter()
        for line in lines:
            with suppress(ValueError, RecursionError):  # an incomplete last line
                found[msgspec.json.decode(line, type=FailedAttempt)] += 1
        return found

    def add_failed_attempt(self, attempt: FailedAttempt) -> None:
        """Append a failed attempt to the run's file."""
        path = self.path / _ATTEMPTS
        self.mend()
        with _write_errors(path, _ROOM_REMEDY), path.open("ab") as file:
            file.write(msgspec.json.encode(attempt) + b"\n")

    def _is_valid(self, scenario_id: str, row: Record | None = None) -> bool:
        """Return whether the files of an episode are valid; note any damage."""
        if damage := damage_of_episode(self.path, scenario_id, row):
            self.notes.append(f"{damage}. This episode is run again.")
        return not damage

    def delete_episode(self, scenario_id: str) -> None:
        """Delete the files of an earlier attempt at a scenario."""
        folder = self.episode_folder(scenario_id)
        shutil.rmtree(folder / "frames", ignore_errors=True)
        with _write_errors(folder):
            for name in ("record.json", TRAJECTORY, DEMONSTRATION):
                (folder / name).unlink(missing_ok=True)
                (folder / f"{name}.part").unlink(missing_ok=True)

    def finish(self) -> pd.DataFrame:
        """Write results.csv and return its table."""
        # Imported only here: replays read run folders, and have no use for pandas.
        from cosim.results.table import table_of

        table = table_of(self.restore())
        path = self.path / "results.csv"
        with _write_errors(path, "all episodes are safe: make room and add --resume"):
            write_atomic(path, table.to_csv(index=False).encode())
        return table

    def mend(self) -> None:
        """Restore the folder, its spec, its scenarios and its rows if a policy has moved or deleted
        them. Raises MachineError if that is impossible."""
        if self._guard is None:
            return
        database = self.path / DATABASE
        with _write_errors(self.path):
            lost = self._guard.mend()
            if not lost and database.exists():
                return
            for folder in (self.path / "episodes", self.path / "logs"):
                folder.mkdir(exist_ok=True)
            for name, data in self._start_files.items():
                write_atomic(self.path / name, data)
            self._replace_database(database)

    def _replace_database(self, database: Path) -> None:
        """Write the database again from the rows of this process."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        for end in ("", "-wal", "-shm"):
            database.with_name(DATABASE + end).unlink(missing_ok=True)
        with _database_errors(self.path):
            check_database(self.path)
            with closing(connect_database(self.path)) as connection, connection:
                connection.executemany(
                    "insert into episodes (scenario, record) values (?, ?)",
                    [(name, row.decode()) for name, row in self._rows.items()],
                )

    def _note_files(self) -> None:
        """Read what `mend` restores: the folder, its spec, its scenarios and its rows."""
        self._guard = FolderGuard(self.path)
        for name in ("scenarios.json", "run.json"):
            self._start_files[name] = (self.path / name).read_bytes()
        for record in read_records(self.path):
            self._rows.setdefault(record.scenario.id, RECORD_FILE.encode(record))

    def restore(self) -> list[Record]:
        """Return all records. Records and rows that a policy has changed or deleted are written
        again. Raises MachineError if that is impossible."""
        self.mend()
        mine = {name: RECORD_FILE.decode(row) for name, row in self._rows.items()}
        try:
            same = {one.scenario.id: one for one in read_records(self.path)} == mine
        except RunError:
            same = False
        with _write_errors(self.path, _ROOM_REMEDY):
            if not same:
                self._replace_database(self.path / DATABASE)
            for name, record in mine.items():
                file = self.episode_folder(name) / "record.json"
                data = record.encoded()
                if not file.exists() or file.read_bytes() != data:
                    file.parent.mkdir(parents=True, exist_ok=True)
                    write_atomic(file, data)
        return list(mine.values())

    def _begin(self, suite: Suite) -> None:
        """Write the spec and scenarios; run.json last, since it marks the folder as resumable."""
        with _write_errors(self.path):
            for folder in (self.path / "episodes", self.path / "logs"):
                folder.mkdir(exist_ok=True)
            wanted = set(self.spec.scenarios)
            chosen = msgspec.structs.replace(
                suite, scenarios=tuple(s for s in suite.scenarios if s.id in wanted)
            )
            write_suite(chosen, self.path / "scenarios.json")
            write_atomic(self.path / "run.json", RUN_FILE.encode_indented(self.spec))

    def _open_database(self) -> None:
        """Repair the database, so that exactly the episodes with valid files have a row."""
        database = self.path / DATABASE
        damage = ""
        try:
            check_database(self.path)
        except (sqlite3.Error, msgspec.DecodeError) as error:
            if isinstance(error, sqlite3.Error) and not is_damaged(error):
                raise database_error(self.path, error) from error
            damage = str(error)
            for end in ("-wal", "-shm"):
                database.with_name(DATABASE + end).unlink(missing_ok=True)
            database.replace(database.with_name(DATABASE + ".damaged"))
            check_database(self.path)
        rows = [] if self._suite is not None else read_records(self.path)
        if invalid := [row.scenario.id for row in rows if not self._is_valid(row.scenario.id, row)]:
            self._remove_rows(invalid)
        on_disk = {
            p.parent.name: p.stat().st_mtime_ns for p in self.path.glob("episodes/*/record.json")
        }
        without_row = set(self.spec.scenarios) & on_disk.keys() - self.finished_ids() - {*invalid}
        restored = [
            name for name in sorted(without_row, key=on_disk.__getitem__) if self._is_valid(name)
        ]
        for name in restored:
            self.add_row(Record.load(self.episode_folder(name) / "record.json"))
        if damage:
            repair = f"it was built again from {len(restored)} records on disk"
            self.notes.append(
                f"{database} was damaged ({damage}): {repair}; the old file is {DATABASE}.damaged"
            )


@contextmanager
def _write_errors(path: Path, remedy: str = "") -> Iterator[None]:
    """Convert an OSError in a block to the error for an unwritable path."""
    try:
        yield
    except OSError as error:
        raise unwritable(path, error, remedy) from error


@contextmanager
def _database_errors(path: Path) -> Iterator[None]:
    """Convert a sqlite3.Error in a block to the error for the database of a run folder."""
    try:
        yield
    except sqlite3.Error as error:
        raise database_error(path, error) from error


def read_scenarios(path: Path) -> Mapping[str, Scenario]:
    """Load the scenarios of a run folder by id. Raises SpecError."""
    return {one.id: one for one in read_suite(path / "scenarios.json").scenarios}


def read_spec(path: Path) -> RunSpec:
    """Load the spec of a run. Raises UsageError, listing nearby runs, if the folder holds none."""
    try:
        return decode_spec(read_limited(path / "run.json", _MAX_BYTES), path / "run.json")
    except FileNotFoundError:
        near = [
            str(run.parent) for run in (*path.glob("*/run.json"), *path.parent.glob("*/run.json"))
        ]
        if path.is_dir():
            check_begun(path)
            nearby = f"Runs in it and next to it: {listed(str(path), near)}"
            raise UsageError(f"{path} is no run folder: it holds no run.json. {nearby}") from None
        raise unknown("run", str(path), near) from None
    except NotADirectoryError:
        raise UsageError(
            f"{path} is no run folder: a file is there, and a run is a folder with run.json"
        ) from None
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", error)
        raise RunError(
            f"{path / 'run.json'}: cannot be read: {why}: name another run, or run it again"
        ) from error


def check_begun(path: Path) -> None:
    """Raise UsageError if a folder to be resumed is missing or was stopped before its run began."""
    if not path.exists() or (
        path.is_dir() and {entry.name for entry in path.iterdir()} <= UNFINISHED
    ):
        raise UsageError(
            f"{path}: no run has begun there, so there is nothing to resume: give the command of "
            f"the run without --resume"
        )


def read_records(path: Path, *, untouched: bool = False) -> list[Record]:
    """Load the records of a run folder in the order in which their episodes ended.

    untouched: read a copy of the database, so that no byte of the folder changes
    """
    read_spec(path)
    if not (path / DATABASE).exists():
        if any(path.glob("episodes/*/record.json")):
            raise RunError(f"{path / DATABASE} is gone: {REMEDY}")
        return []
    try:
        with ExitStack() as stack:
            where = Path(stack.enter_context(TemporaryDirectory())) if untouched else path
            for file in path.glob(f"{DATABASE}*") if untouched else ():
                shutil.copyfile(file, where / file.name)
            return select_records(stack.enter_context(closing(connect_database(where))))
    except msgspec.DecodeError as error:
        raise damaged_error(path, error) from error
    except sqlite3.Error as error:
        raise database_error(path, error) from error
    except OSError as error:
        raise RunError(f"{path / DATABASE}: cannot be read: {error.strerror or error}") from error


def check_not_in_use(path: Path) -> None:
    """Raise RunError, naming the process, while a run is writing to its folder."""
    if is_locked(path / "lock"):
        raise _in_use(path)


def check_unused(path: Path) -> None:
    """Raise RunError if a folder holds a run, or files other than the start of one."""
    try:
        if (path / "run.json").exists():
            raise RunError(
                f"{path} already holds a run. Add --resume to finish it, or choose another --out."
            )
        if path.exists() and (not path.is_dir() or {p.name for p in path.iterdir()} - UNFINISHED):
            raise RunError(f"{path} exists and is no run folder. Choose another --out.")
    except OSError as error:
        raise unwritable(path, error) from error


def _acquire(folder_lock: FileLock, path: Path) -> None:
    """Lock the folder. Raises RunError, naming the process that holds it."""
    try:
        folder_lock.acquire()
    except TimeoutError:
        raise _in_use(path) from None
    (path / "lock").write_text(str(os.getpid()))


def _in_use(path: Path) -> RunError:
    holder = (path / "lock").read_text(errors="replace").strip() or "?"
    return RunError(
        f"{path} is in use by process {holder}: another cosim run is writing to it. "
        "Wait for it to end, or choose another --out."
    )

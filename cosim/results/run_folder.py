"""A run folder: what was asked for, and what came out, episode by episode; survives a kill at any
moment.

run.json                         what is run: suite, policy, scenarios, versions, renderer
scenarios.json                   the resolved specs
episodes/<scenario>/record.json  and trajectory.npz, written by the run's process, whole or not at
                                 all; frames/;
                                 demonstration.npz where these are collected
results.sqlite                   one row per finished episode, in the order in which they ended
results.csv                      the same, sorted by scenario, written at the end
attempts.jsonl                   scenarios that were begun in vain, a line each time: whoever goes
                                 on counts on
figures.json                     how fast it was, each time that it went on
logs/                            what the engines of each worker printed
lock                             held while a run is going on
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import NamedTuple, Self

import msgspec
import pandas as pd
from filelock import FileLock

from cosim.core.errors import MachineError, RunError, UsageError, listed, unknown, unwritable
from cosim.core.files import is_locked, lock, read_within, write_atomic
from cosim.core.npz import read_npz
from cosim.results.log import Log
from cosim.results.record import RECORD_FILE, Record
from cosim.results.run_spec import RUN_FILE, RunSpec, decoded_spec
from cosim.results.table import table_of
from cosim.spec.scenario import Suite, write_suite
from cosim.spec.validation import shown

DATABASE = "results.sqlite"
REMEDY = (
    "give the command of the run again with --resume, which makes it anew from the records on disk"
)
_DAMAGE = {
    sqlite3.SQLITE_ERROR,
    sqlite3.SQLITE_CORRUPT,
    sqlite3.SQLITE_NOTADB,
    sqlite3.SQLITE_MISMATCH,
    sqlite3.SQLITE_SCHEMA,
}


def connected(path: Path) -> sqlite3.Connection:
    """The database of a run folder, opened; made where there is none."""
    database = sqlite3.connect(path / DATABASE, timeout=30.0)
    try:
        database.execute("pragma journal_mode = wal")
        database.execute("pragma synchronous = full")
    except sqlite3.Error:
        database.close()
        raise
    return database


def check_database(path: Path) -> None:
    """Read all of the database, made where there is none. Raises sqlite3.Error or DecodeError if it
    is damaged."""
    with closing(connected(path)) as database, database:
        database.execute(
            "create table if not exists episodes (scenario text primary key, record text)"
        )
        faults = [fault for (fault,) in database.execute("pragma quick_check")]
        if faults != ["ok"]:
            raise sqlite3.DatabaseError(faults[0])
        records_in(database)


def records_in(database: sqlite3.Connection) -> list[Record]:
    """All records, in the order in which their episodes ended. Raises sqlite3.Error,
    DecodeError."""
    rows: Sequence[tuple[object]] = database.execute(
        "select record from episodes order by rowid"
    ).fetchall()
    return [RECORD_FILE.decode(_text(value)) for (value,) in rows]


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise msgspec.DecodeError("a row holds no text")
    return value


def is_damaged(error: sqlite3.Error) -> bool:
    """Whether it is the file that is wrong, not the disk or who holds it."""
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT)
    return code & 0xFF in _DAMAGE or code == sqlite3.SQLITE_IOERR_SHORT_READ


def damaged(path: Path, error: Exception) -> RunError:
    """The error for the damaged database of a run folder."""
    return RunError(f"{path / DATABASE} is damaged ({error}): {REMEDY}")


def trouble_with(path: Path, error: sqlite3.Error) -> RunError | MachineError:
    """What is said of an error of the database."""
    if is_damaged(error):
        return damaged(path, error)
    return MachineError(
        f"{path / DATABASE}: {error}. Finished episodes are safe: make room and add --resume."
    )


TRAJECTORY = "trajectory.npz"
DEMONSTRATION = "demonstration.npz"
RUN_AGAIN = (
    "give the command of the run again with --resume, which runs this episode again and keeps "
    "the others"
)
"""The remedy for files that are damaged or missing."""


def record_file(path: Path, scenario_id: str) -> Path:
    """Where the record of an episode is."""
    return path / "episodes" / scenario_id / "record.json"


def damage_of_episode(path: Path, scenario_id: str, row: Record | None = None) -> str:
    """What is wrong with the files of an episode that has ended, with the file; "" if nothing is.
    row: the record that the run's database holds, with which the file must agree."""
    file = record_file(path, scenario_id)
    if row is not None and row.ended is None and not file.exists():
        return ""  # it was given up, and left no file
    try:
        record = Record.load(file)
        if record.scenario.id != scenario_id:
            return f"{file} is of scenario {shown(record.scenario.id)}"
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
    told, other = (msgspec.to_builtins(RECORD_FILE.flat(record)) for record in (mine, theirs))
    for field, value in told.items():
        if isinstance(value, dict):
            for name in dict.fromkeys([*value, *other[field]]):
                if value.get(name) != other[field].get(name):
                    return f"{field}.{name} is {value.get(name)}, there {other[field].get(name)}"
        elif value != other[field]:
            return f"{field} is {shown(value)}, there {shown(other[field])}"
    return ""


_ATTEMPTS = "attempts.jsonl"
_MOST_BYTES = 256 << 20
_KEPT = "finished episodes are kept; make room and go on with --resume"
UNFINISHED = {"episodes", "logs", "lock", "scenarios.json", "run.json.part"}
"""All that a run leaves that was killed before it began."""


class FailedAttempt(NamedTuple):
    """A scenario that was begun in vain. away: its worker was lost together with its machine, or
    left."""

    scenario: str
    away: bool


class RunFolder:
    """A run folder held by this process. Use as a context manager: it is locked meanwhile, before
    anything is written.

    path: absolute, so that it stays what it is wherever the process goes. notes: what was mended as
    it was opened, in words.
    """

    def __init__(self, path: Path, spec: RunSpec, suite: Suite | None = None) -> None:
        self.path = path.absolute()
        self.spec = spec
        self.notes: list[str] = []
        self._suite = suite
        self._lock = lock(path / "lock", wait=False)
        self._adding: sqlite3.Connection | None = None

    @classmethod
    def create(cls, path: Path, spec: RunSpec, suite: Suite) -> RunFolder:
        """A new run folder. Raises RunError when one is there already, MachineError where nothing
        can be written."""
        refuse_used(path)
        return cls(path, spec, suite)

    @classmethod
    def resume(cls, path: Path, spec: RunSpec, whole: Suite | None = None) -> RunFolder:
        """The run folder at `path`, to be finished. Raises RunError, naming the difference, if it
        is of another run. whole: the suite that its scenarios are of."""
        refuse_unbegun(path)
        found = read_spec(path)
        if found.policy == spec.policy and found.setup.policy_source != spec.setup.policy_source:
            raise RunError(
                f"{path} is of another run: the source of policy '{spec.policy}' was edited since "
                "it began. Resume with the source as it was, or choose another --out."
            )
        if (apart := found.apart(spec, whole=whole)) is not None:
            raise RunError(
                f"{path} is of another run: its {apart.field} is {apart.mine}, now asked for "
                f"is {apart.theirs}. "
                f"Resume with the same command, or choose another --out.{apart.hint}"
            )
        return cls(path, found)

    def __enter__(self) -> Self:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            _acquire(self._lock, self.path)
        except OSError as error:
            raise unwritable(self.path, error) from error
        try:
            if self._suite is not None:
                refuse_used(self.path)
                self._begin(self._suite)
            self._open_database()
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
        if self._adding is not None:
            self._adding.close()
            self._adding = None
        self._lock.release()

    def episode_folder(self, scenario_id: str) -> Path:
        return self.path / "episodes" / scenario_id

    def finished(self) -> set[str]:
        """Ids of the scenarios that have a row."""
        try:
            with closing(connected(self.path)) as database:
                return {
                    scenario for (scenario,) in database.execute("select scenario from episodes")
                }
        except sqlite3.Error as error:
            raise trouble_with(self.path, error) from error

    def add(self, record: Record) -> None:
        """Append a finished episode. A second one of the same scenario is not taken."""
        values = record.scenario.id, RECORD_FILE.encode(record).decode()
        try:
            if self._adding is None:  # kept open: opening and closing takes longer than adding
                self._adding = connected(self.path)
            with self._adding as database:
                database.execute(
                    "insert or ignore into episodes (scenario, record) values (?, ?)", values
                )
        except sqlite3.Error as error:
            raise trouble_with(self.path, error) from error

    def _remove(self, scenarios: Sequence[str]) -> None:
        """Remove the rows of episodes that are to be run again."""
        try:
            with closing(connected(self.path)) as database, database:
                database.executemany(
                    "delete from episodes where scenario = ?", [(name,) for name in scenarios]
                )
        except sqlite3.Error as error:
            raise trouble_with(self.path, error) from error

    def keep(self, record: Record, log: bytes = b"", demonstration: bytes = b"") -> None:
        """Write what came out of an episode, the record last, and add its row. log: the bytes of
        its `Log`."""
        target = self.episode_folder(record.scenario.id)
        try:
            target.mkdir(parents=True, exist_ok=True)
            for name, data in ((TRAJECTORY, log), (DEMONSTRATION, demonstration)):
                if data:
                    write_atomic(target / name, data)
            record.save(target / "record.json")
        except OSError as error:
            raise unwritable(target, error, _KEPT) from error
        self.add(record)

    def keep_frame(self, scenario_id: str, tick: int, png: bytes) -> None:
        """Write a camera frame of an episode."""
        frames = self.episode_folder(scenario_id) / "frames"
        try:
            frames.mkdir(parents=True, exist_ok=True)
            (frames / f"{tick:06d}.png").write_bytes(png)
        except OSError as error:
            raise unwritable(frames, error, _KEPT) from error

    def failed_attempts(self) -> Counter[FailedAttempt]:
        """How often each scenario was begun in vain, since the run began: whoever coordinated it
        then."""
        try:
            lines = (self.path / _ATTEMPTS).read_bytes().splitlines()
        except FileNotFoundError:
            return Counter()
        except OSError as error:
            raise unwritable(self.path / _ATTEMPTS, error, _KEPT) from error
        found: Counter[FailedAttempt] = Counter()
        for line in lines:
            with suppress(ValueError, RecursionError):  # the last line of a machine that failed
                found[msgspec.json.decode(line, type=FailedAttempt)] += 1
        return found

    def keep_failed_attempt(self, attempt: FailedAttempt) -> None:
        """Write down that a scenario was begun in vain."""
        try:
            with (self.path / _ATTEMPTS).open("ab") as file:
                file.write(msgspec.json.encode(attempt) + b"\n")
        except OSError as error:
            raise unwritable(self.path / _ATTEMPTS, error, _KEPT) from error

    def _is_whole(self, scenario_id: str, row: Record | None = None) -> bool:
        """Whether what an episode has left can be kept; what is damaged is noted."""
        if damage := damage_of_episode(self.path, scenario_id, row):
            self.notes.append(f"{damage}. This episode is run again.")
        return not damage

    def forget(self, scenario_id: str) -> None:
        """Remove what an earlier attempt at a scenario has left."""
        folder = self.episode_folder(scenario_id)
        shutil.rmtree(folder / "frames", ignore_errors=True)
        try:
            for name in ("record.json", TRAJECTORY, DEMONSTRATION):
                (folder / name).unlink(missing_ok=True)
                (folder / f"{name}.part").unlink(missing_ok=True)
        except OSError as error:
            raise unwritable(folder, error) from error

    def finish(self) -> pd.DataFrame:
        """Write results.csv and return its table."""
        table = table_of(read_records(self.path))
        try:
            write_atomic(self.path / "results.csv", table.to_csv(index=False).encode())
        except OSError as error:
            remedy = "all episodes are kept; make room and add --resume"
            raise unwritable(self.path / "results.csv", error, remedy) from error
        return table

    def _begin(self, suite: Suite) -> None:
        """Write what is run; run.json last, because a folder with it can be resumed."""
        try:
            for folder in (self.path / "episodes", self.path / "logs"):
                folder.mkdir(exist_ok=True)
            wanted = set(self.spec.scenarios)
            chosen = msgspec.structs.replace(
                suite, scenarios=tuple(s for s in suite.scenarios if s.id in wanted)
            )
            write_suite(chosen, self.path / "scenarios.json")
            write_atomic(self.path / "run.json", RUN_FILE.in_lines(self.spec))
        except OSError as error:
            raise unwritable(self.path, error) from error

    def _open_database(self) -> None:
        """Make sure of a sound database with a row for each episode that is whole on disk, and for
        no other."""
        database = self.path / DATABASE
        mended = ""
        try:
            check_database(self.path)
        except (sqlite3.Error, msgspec.DecodeError) as error:
            if isinstance(error, sqlite3.Error) and not is_damaged(error):
                raise trouble_with(self.path, error) from error
            mended = str(error)
            for end in ("-wal", "-shm"):
                database.with_name(DATABASE + end).unlink(missing_ok=True)
            database.replace(database.with_name(DATABASE + ".damaged"))
            check_database(self.path)
        rows = [] if self._suite is not None else read_records(self.path)
        if gone := [row.scenario.id for row in rows if not self._is_whole(row.scenario.id, row)]:
            self._remove(gone)
        on_disk = {
            p.parent.name: p.stat().st_mtime_ns for p in self.path.glob("episodes/*/record.json")
        }
        lacking = set(self.spec.scenarios) & on_disk.keys() - self.finished() - {*gone}
        whole = [name for name in sorted(lacking, key=on_disk.__getitem__) if self._is_whole(name)]
        for name in whole:
            self.add(Record.load(self.episode_folder(name) / "record.json"))
        if mended:
            made = f"made anew from {len(whole)} records on disk, kept as {DATABASE}.damaged"
            self.notes.append(f"{database} was damaged ({mended}): {made}")


def read_spec(path: Path) -> RunSpec:
    """What the run in a folder is. Raises UsageError, with the runs in it and beside it, when it
    holds none."""
    try:
        return decoded_spec(read_within(path / "run.json", _MOST_BYTES), path / "run.json")
    except FileNotFoundError:
        near = [
            str(run.parent) for run in (*path.glob("*/run.json"), *path.parent.glob("*/run.json"))
        ]
        if path.is_dir():
            refuse_unbegun(path)
            there = f"Runs in it and beside it: {listed(str(path), near)}"
            raise UsageError(f"{path} is no run folder: it holds no run.json. {there}") from None
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


def refuse_unbegun(path: Path) -> None:
    """Raises UsageError where a run is to be resumed that was stopped before its folder was
    written, or never given."""
    if not path.exists() or (
        path.is_dir() and {entry.name for entry in path.iterdir()} <= UNFINISHED
    ):
        raise UsageError(
            f"{path}: no run has begun there, so that nothing is kept: give the command of "
            f"the run without --resume"
        )


def read_records(path: Path, *, untouched: bool = False) -> list[Record]:
    """The records of a run folder, finished or not, in the order in which they ended. untouched: no
    byte of the folder changes, also where a run was killed: a copy of its database is read."""
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
            return records_in(stack.enter_context(closing(connected(where))))
    except msgspec.DecodeError as error:
        raise damaged(path, error) from error
    except sqlite3.Error as error:
        raise trouble_with(path, error) from error
    except OSError as error:
        raise RunError(f"{path / DATABASE}: cannot be read: {error.strerror or error}") from error


def refuse_in_use(path: Path) -> None:
    """Raises RunError, naming the process, while a run is writing to its folder."""
    if is_locked(path / "lock"):
        raise _in_use(path)


def refuse_used(path: Path) -> None:
    """Raises RunError when a folder holds a run, or something else that is not a run's
    beginning."""
    try:
        if (path / "run.json").exists():
            raise RunError(
                f"{path} already holds a run. Add --resume to finish it, or choose another --out."
            )
        if path.exists() and (not path.is_dir() or {p.name for p in path.iterdir()} - UNFINISHED):
            raise RunError(f"{path} exists and is no run folder. Choose another --out.")
    except OSError as error:
        raise unwritable(path, error) from error


def _acquire(held: FileLock, path: Path) -> None:
    """Lock the folder. Raises RunError, naming the process that holds it."""
    try:
        held.acquire()
    except TimeoutError:
        raise _in_use(path) from None
    (path / "lock").write_text(str(os.getpid()))


def _in_use(path: Path) -> RunError:
    holder = (path / "lock").read_text(errors="replace").strip() or "?"
    return RunError(
        f"{path} is in use by process {holder}: another cosim run is writing to it. "
        "Wait for it to end, or choose another --out."
    )

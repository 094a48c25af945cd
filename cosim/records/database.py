"""The database of a run folder, `results.sqlite`: a row for each finished episode; and the errors of a damaged one."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import msgspec

from cosim.core.errors import MachineError, RunError
from cosim.records.record import Record

DATABASE = "results.sqlite"
REMEDY = "give the command of the run again with --resume, which makes it anew from the records on disk"
_DAMAGE = {
    sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_MISMATCH, sqlite3.SQLITE_SCHEMA,
}  # fmt: skip


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
    """Read all of the database, made where there is none. Raises sqlite3.Error or DecodeError if it is damaged."""
    with closing(connected(path)) as database, database:
        database.execute("create table if not exists episodes (scenario text primary key, row text, record text)")
        faults = [fault for (fault,) in database.execute("pragma quick_check")]
        if faults != ["ok"]:
            raise sqlite3.DatabaseError(faults[0])
        records_in(database)


def records_in(database: sqlite3.Connection) -> list[Record]:
    """All records, in the order in which their episodes ended. Raises sqlite3.Error, DecodeError."""
    rows: Sequence[tuple[object]] = database.execute("select record from episodes order by rowid").fetchall()
    return [msgspec.json.decode(_text(value), type=Record) for (value,) in rows]


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
    return MachineError(f"{path / DATABASE}: {error}. Finished episodes are safe: make room and add --resume.")

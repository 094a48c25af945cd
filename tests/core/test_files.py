"""Files and folders that appear whole or not at all, temporary folders, and locks."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import pytest
from filelock import Timeout

from cosim.core.files import (
    UNFINISHED_PREFIX,
    atomic_file,
    atomic_folder,
    folder_holds,
    is_locked,
    lock,
    remove_dead,
    temp_folder,
    write_atomic,
)
from tests.conftest import PATIENCE_S

BEGIN = (
    "import sys\nfrom pathlib import Path\nfrom cosim.core.files import *\nhere = "
    "Path(sys.argv[1])\n"
)


@contextmanager
def process_in(folder: Path, code: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process, and the line that it prints before it waits; it is killed at the end."""
    command = [sys.executable, "-c", f"{BEGIN}{code}", str(folder)]
    with subprocess.Popen(command, stdin=-1, stdout=-1, text=True) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


HOLDS_FOLDER = """
with temp_folder("made-", here) as folder:
    (folder / "log").write_text("printed")
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("shared", [False, True])
def test_a_file_appears_whole_or_not_at_all(tmp_path: Path, shared: bool) -> None:
    """An error during writing leaves the old file and nothing else."""
    path = tmp_path / "a"
    write_atomic(path, b"one", shared=shared)
    with pytest.raises(RuntimeError), atomic_file(path, shared=shared) as part:
        part.write_bytes(b"tw")
        raise RuntimeError
    assert path.read_bytes() == b"one"
    write_atomic(path, b"two", shared=shared)
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [b"two"]


def test_processes_that_write_one_shared_file_never_mix(tmp_path: Path) -> None:
    """Every reader finds the complete text of one of four writers, also when these are killed."""
    code = (
        "for n in range(10**9): write_atomic(here / 'a', sys.argv[2].encode() * 50000, shared=True)"
    )
    writers = [
        subprocess.Popen([sys.executable, "-c", BEGIN + code, str(tmp_path), str(n)])
        for n in range(4)
    ]
    ends_s = time.monotonic() + PATIENCE_S
    found = set[bytes]()
    while len(found) < 2 and time.monotonic() < ends_s:
        if (tmp_path / "a").exists():
            data = (tmp_path / "a").read_bytes()
            assert len(data) == 50000 and len({*data}) == 1
            found.add(data[:1])
    for writer in writers:
        writer.send_signal(signal.SIGKILL)
        writer.wait()
    assert len({*(tmp_path / "a").read_bytes()}) == 1


def test_the_folder_of_a_process_that_was_killed_is_removed_by_the_next(tmp_path: Path) -> None:
    """The folder of a living process stays, and the own folder is removed at the end of the block."""
    with (
        process_in(tmp_path, HOLDS_FOLDER) as (dies, left),
        process_in(tmp_path, HOLDS_FOLDER) as (_, stays),
    ):
        dies.kill()
        dies.wait()
        assert Path(left).is_dir()
        with temp_folder("made-", tmp_path) as mine:
            assert {*tmp_path.iterdir()} == {Path(stays), mine}
        assert {*tmp_path.iterdir()} == {Path(stays)}


def test_recent_unfinished_files_stay(tmp_path: Path) -> None:
    """Without a lock, unfinished files and folders are removed when they are an hour old."""
    for name in ("young", "old"):
        (tmp_path / f"x-file-{name}").touch()
        (tmp_path / f"x-folder-{name}").mkdir()
    for path in tmp_path.glob("*-old"):
        os.utime(path, (0.0, 0.0))
    remove_dead(tmp_path, "x-")
    assert {path.name for path in tmp_path.iterdir()} == {"x-file-young", "x-folder-young"}


@pytest.mark.parametrize(("existing", "left"), [("replace", "2"), ("keep", "1"), ("refuse", "1")])
def test_a_finished_folder_takes_its_place(
    tmp_path: Path, existing: Literal["replace", "keep", "refuse"], left: str
) -> None:
    """An existing folder is replaced, preserved or refused, and nothing unfinished is left."""
    for number in (1, 2):
        try:
            with atomic_folder(tmp_path / "maps" / "town", existing=existing) as folder:
                (folder / "net.xml").write_text(str(number))
        except OSError:
            assert (existing, number) == ("refuse", 2)
    assert [path.name for path in (tmp_path / "maps").iterdir()] == ["town"]
    assert (tmp_path / "maps" / "town" / "net.xml").read_text() == left


def test_an_error_in_the_block_leaves_the_old_folder(tmp_path: Path) -> None:
    """The new folder is removed, and the old one stays."""
    for _ in range(2):
        with pytest.raises(RuntimeError), atomic_folder(tmp_path / "town") as folder:
            (folder / "half").touch()
            raise RuntimeError
        assert not list(tmp_path.iterdir())


def dead_replacement(maps: Path) -> Path:
    """Leave what a process leaves that was killed while it replaced the folder `town`."""
    dead = maps / f"{UNFINISHED_PREFIX}dead"
    (dead / ".old" / "town").mkdir(parents=True)
    (dead / ".old" / "town" / "net.xml").write_text("<net/>")
    (dead / ".held").touch()
    return dead


def test_a_folder_that_was_being_replaced_by_a_killed_process_is_put_back(tmp_path: Path) -> None:
    """The next process that writes or reads there restores the folder."""
    dead_replacement(tmp_path / "writer")
    with temp_folder(UNFINISHED_PREFIX, tmp_path / "writer"):
        assert (tmp_path / "writer" / "town" / "net.xml").read_text() == "<net/>"
    dead_replacement(tmp_path / "reader")
    assert folder_holds(tmp_path / "reader" / "town", "net.xml")
    assert not folder_holds(tmp_path / "reader" / "city", "net.xml")
    assert [path.name for path in (tmp_path / "reader").iterdir()] == ["town"]


def test_a_reader_waits_while_a_folder_is_replaced(tmp_path: Path) -> None:
    """A reader succeeds between the removal of the old folder and the arrival of the new one."""
    dead = dead_replacement(tmp_path)
    with lock(dead / ".held"):
        made = tmp_path / "new"
        made.mkdir()
        (made / "net.xml").touch()
        timer = threading.Timer(0.1, lambda: made.rename(tmp_path / "town"))
        timer.start()
        assert not (tmp_path / "town").exists() and folder_holds(tmp_path / "town", "net.xml")
        timer.join()


def test_processes_replace_one_folder_at_once(tmp_path: Path) -> None:
    """Readers always find a complete folder, also when some of the writers are killed."""
    code = """
number = 0
while True:
    number += 1
    with atomic_folder(here / "town") as folder:
        for name in "ab":
            (folder / name).write_text(f"{id(here)} {number}")
    print(number, flush=True)
"""
    command = [sys.executable, "-c", BEGIN + code, str(tmp_path)]
    writers = [subprocess.Popen(command, stdout=-1, text=True) for _ in range(3)]
    for writer in writers:
        assert writer.stdout is not None
        while int(writer.stdout.readline()) < 5:
            assert folder_holds(tmp_path / "town", "a")
        writer.kill()
        writer.wait()
    with atomic_folder(tmp_path / "other"):
        pass
    assert {
        path.name for path in tmp_path.iterdir() if not path.name.startswith(UNFINISHED_PREFIX)
    } == {
        "town",
        "other",
    }
    assert len({(tmp_path / "town" / name).read_text() for name in "ab"}) == 1


@pytest.mark.parametrize("existing", ["replace", "keep"])
def test_a_folder_appears_though_another_process_removes_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, existing: Literal["replace", "keep"]
) -> None:
    """The write succeeds even if the old folder disappears right after it was found."""
    (tmp_path / "town").mkdir()
    (tmp_path / "town" / "old").touch()
    rename = Path.rename

    def rename_then_remove(path: Path, target: Path) -> Path:
        try:
            return rename(path, target)
        except OSError:
            shutil.rmtree(tmp_path / "town")
            raise

    monkeypatch.setattr(Path, "rename", rename_then_remove)
    with atomic_folder(tmp_path / "town", existing=existing) as folder:
        (folder / "new").touch()
    assert [path.name for path in tmp_path.glob("town/*")] == ["new"]


def test_a_lock_ends_with_its_process(tmp_path: Path) -> None:
    """A lock cannot be acquired while another process holds it, and is free once that is killed."""
    path = tmp_path / "lock"
    assert not is_locked(path)
    with process_in(
        tmp_path, "with lock(here / 'lock'):\n    print('', flush=True)\n    sys.stdin.read()"
    ) as (
        other,
        _,
    ):
        assert is_locked(path)
        with pytest.raises(Timeout):
            lock(path, wait=False).acquire()
        other.kill()
        other.wait()
    with lock(path, wait=False):
        assert is_locked(path)
    assert not is_locked(path)

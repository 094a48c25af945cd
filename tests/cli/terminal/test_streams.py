"""What the command line prints where it cannot be written: said in one line, or not at all; never a
traceback."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = (sys.executable, "-m", "cosim")
pytestmark = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")


@pytest.mark.parametrize(
    "words", [("list",), ("list", "reactive"), ("--help",), ("--version",)], ids="-".join
)
def test_a_full_disk_is_told_in_one_line(words: tuple[str, ...]) -> None:
    """`cosim list > /dev/full`: what is wrong with standard output, exit code 3."""
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 3
    assert done.stderr == f"error: standard output cannot be written: {os.strerror(errno.ENOSPC)}\n"


@pytest.mark.parametrize("words", [("list", "reactive"), ("--help",)], ids="-".join)
def test_who_stops_reading_is_told_nothing(words: tuple[str, ...]) -> None:
    """`cosim list reactive | head -1`: no word, and the exit code of a program that a closed pipe
    ended."""
    ours, theirs = os.pipe()
    os.close(ours)
    done = subprocess.run(
        [*COMMAND, *words], stdout=theirs, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(theirs)
    assert done.returncode == 128 + 13 and done.stderr == ""


def test_errors_that_cannot_be_written_leave_the_exit_code() -> None:
    """With standard error on a full disk nothing can be said, and wrong use is 3, as the machine
    is."""
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, "list", "nowhere"], stdout=subprocess.PIPE, stderr=full, check=False
        )
    assert done.returncode == 3 and done.stdout == b""


def test_what_the_terminal_cannot_show_is_written_as_an_escape(tmp_path: Path) -> None:
    """A file's name that is no text, on a terminal that knows ASCII only."""
    name = os.fsdecode(b"ni\xff.json")
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [*COMMAND, "list", name], cwd=tmp_path, env=environment, capture_output=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr == b"error: ni\\udcff.json: cannot be read: No such file or directory\n"

"""Output streams that cannot be written: reported in one line or not at all, never with a
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
def test_a_full_disk_is_reported_in_one_line(words: tuple[str, ...]) -> None:
    """`cosim list > /dev/full` reports the error of standard output and exits with code 3."""
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 3
    assert done.stderr == f"error: standard output cannot be written: {os.strerror(errno.ENOSPC)}\n"


@pytest.mark.parametrize("words", [("list", "reactive"), ("--help",)], ids="-".join)
def test_a_closed_pipe_ends_the_command_silently(words: tuple[str, ...]) -> None:
    """`cosim list reactive | head -1` prints no error and exits with the code of a closed pipe."""
    ours, theirs = os.pipe()
    os.close(ours)
    done = subprocess.run(
        [*COMMAND, *words], stdout=theirs, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(theirs)
    assert done.returncode == 128 + 13 and done.stderr == ""


def test_a_full_standard_error_ends_with_exit_code_3() -> None:
    """With standard error on a full disk, wrong use exits with 3, as other faults of the machine
    do."""
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, "list", "nowhere"], stdout=subprocess.PIPE, stderr=full, check=False
        )
    assert done.returncode == 3 and done.stdout == b""


def test_unprintable_characters_are_escaped(tmp_path: Path) -> None:
    """A file name that is no text is escaped on a terminal that shows only ASCII."""
    name = os.fsdecode(b"ni\xff.json")
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [*COMMAND, "list", name], cwd=tmp_path, env=environment, capture_output=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr == b"error: ni\\udcff.json: cannot be read: No such file or directory\n"

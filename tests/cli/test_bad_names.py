"""Impossible names of files and folders: one clear line and exit code 2 before any work."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import Cosim

LONG = "a" * 300
RUN = ("run", "reactive", "--policy", "straight", "--scenario", "obstructing-001")
WRITES: tuple[tuple[str, ...], ...] = (
    (*RUN, "--out", LONG),
    ("coordinator", "reactive", "--policy", "straight", "--episodes", "1", "--log-json", LONG),
    ("collect", "reactive", "--out", LONG, "--episodes", "1"),
    ("scenario", "draw", "mine.toml", "-o", f"{LONG}.png"),
    ("suite", "build", "unit", f"{LONG}.json", "--only", "straight-001"),
    ("city", "make", "--seed", "1", "--size", "300", LONG),
    ("map", "check", "sumo-fkk-in", "-o", f"{LONG}.png"),
    ("film", "run", "obstructing-001", "-o", f"{LONG}.mp4"),
    ("report", "run", "-o", f"{LONG}.html"),
    ("export", "obstructing-001", f"{LONG}.glb"),
    ("compare", "run", "run", "-o", f"{LONG}.csv"),
    ("train", "demos.npz", "-o", LONG),
    ("certs", "init", LONG),
)
READS: tuple[tuple[str, ...], ...] = (
    ("show", LONG),
    ("run", LONG),
    ("run", "reactive", "--policy", f"onnx:{LONG}"),
    ("map", "import", LONG),
    ("scenario", "check", LONG),
)


@pytest.mark.parametrize(
    "words", [*WRITES, *READS], ids=lambda words: " ".join(words).replace(LONG, "LONG")
)
def test_a_name_that_is_too_long_is_refused_in_one_line(
    tmp_path: Path, cosim: Cosim, words: tuple[str, ...]
) -> None:
    """Any too long name, read or written, gives exit code 2, no traceback, and leaves no file."""
    (tmp_path / "mine.toml").write_text(
        'name = "mine"\n[place]\ncity = 1\n[way]\nkind = "straight"\n'
    )
    result = cosim(*words, cwd=tmp_path)
    assert result.returncode == 2, result
    assert result.stderr.strip().splitlines()[-1].startswith("error: "), result
    assert {path.name for path in tmp_path.iterdir()} == {"mine.toml"}


FOLDERS: tuple[tuple[str, ...], ...] = (
    ("certs", "init", "file"),
    ("certs", "role", "file", "viewer"),
    ("certs", "show", "file"),
    ("collect", "reactive", "--out", "file", "--episodes", "1"),
    ("city", "make", "--seed", "1", "--size", "300", "file"),
    ("score", "file/below"),
)


@pytest.mark.parametrize("words", FOLDERS, ids=" ".join)
def test_a_file_in_the_place_of_a_folder_is_refused_in_one_line(
    tmp_path: Path, cosim: Cosim, words: tuple[str, ...]
) -> None:
    """A file in place of a folder of certificates, of a run or of data stays as it was."""
    (tmp_path / "file").write_text("mine")
    result = cosim(*words, cwd=tmp_path)
    assert result.returncode in (2, 3), result
    assert result.stderr.strip().splitlines()[-1].startswith("error: "), result
    assert {path.name for path in tmp_path.iterdir()} == {"file"} and (
        tmp_path / "file"
    ).read_text() == "mine"

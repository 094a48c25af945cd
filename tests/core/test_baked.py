"""Arrays that are kept: made once, never wrong, and done without where they cannot be kept."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest

from cosim.core import baked as module
from cosim.core import cache as kept
from cosim.core.baked import Arrays, baked, sources_hash
from tests.conftest import PATIENCE_S, ROOT

WANTED = {"ramp": np.arange(1000.0).reshape(10, 100), "bytes": np.arange(256, dtype=np.uint8)}


class Maker:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> Arrays:
        self.times += 1
        return WANTED


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of sources, and a cache of its own."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    kept._say_once.cache_clear()
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "maker.py").write_text("version = 1\n")
    return tmp_path / "room"


def same(arrays: Arrays) -> bool:
    return arrays.keys() == WANTED.keys() and all(
        (arrays[key] == WANTED[key]).all() for key in WANTED
    )


def test_what_was_made_is_made_once_and_mapped_into_memory(room: Path) -> None:
    """The second asking gives the same arrays out of the file, write-protected."""
    make = Maker()
    first, again = (baked("a", sources_hash(room), make) for _ in range(2))
    assert same(first) and same(again) and make.times == 1
    assert all(
        isinstance(array, np.memmap) and not array.flags.writeable for array in again.values()
    )


def test_other_sources_and_other_names_make_anew(room: Path) -> None:
    """What is kept of another source, or under another name, is not taken."""
    make = Maker()
    baked("a", sources_hash(room), make)
    baked("b", sources_hash(room), make)
    (room / "maker.py").write_text("version = 2\n")
    baked("a", sources_hash(room), make)
    assert make.times == 3


def test_sources_edited_under_a_running_process_do_not_get_what_it_makes(room: Path) -> None:
    """A process names what it makes by the sources it has imported; who imports the edited ones
    makes anew."""
    make = Maker()
    imported = sources_hash(room)
    (room / "maker.py").write_text("version = 2\n")
    baked("a", imported, make)
    baked("a", sources_hash(room), make)
    assert make.times == 2


def test_a_name_tells_every_package_that_what_is_kept_stands_on() -> None:
    """What the rooms of textures and motions import of others is in the list."""
    rooms = [ROOT / room for room in ("physics/textures", "physics/people", "cosim/people")]
    trees = [ast.parse(path.read_text()) for room in rooms for path in room.rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    froms = {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    tops = (
        {name.partition(".")[0] for name in froms | plain}
        - sys.stdlib_module_names
        - {"cosim", "physics"}
    )
    assert {package for top in tops for package in packages_distributions()[top]} <= set(
        module._MADE_WITH
    )


@pytest.mark.parametrize("damage", ["a bit", "cut off", "no seal", "no array", "not JSON"])
def test_damage_is_made_anew(room: Path, tmp_path: Path, damage: str) -> None:
    """Whatever became of the files, the arrays are right, and whole again afterwards."""
    make = Maker()
    baked("a", sources_hash(room), make)
    (folder,) = (tmp_path / "cache/baked").iterdir()
    array, seal = folder / "ramp.npy", folder / "seal.json"
    held = array.read_bytes()
    match damage:
        case "a bit":
            array.write_bytes(held[:-1] + bytes([held[-1] ^ 1]))
        case "cut off":
            array.write_bytes(held[: len(held) // 2])
        case "no seal":
            seal.unlink()
        case "no array":
            array.unlink()
        case "not JSON":
            seal.write_bytes(b"{")
    assert (
        same(baked("a", sources_hash(room), make))
        and same(baked("a", sources_hash(room), make))
        and make.times == 2
    )


def test_a_cache_that_cannot_be_written_is_done_without_and_said_once(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The arrays are right all the same; one line tells why the next process makes them anew."""
    (tmp_path / "cache").write_text("a file where a folder should be")
    make = Maker()
    assert (
        same(baked("a", sources_hash(room), make))
        and same(baked("a", sources_hash(room), make))
        and make.times == 2
    )
    told = capsys.readouterr().err
    assert told.startswith("note: ") and "not kept" in told and len(told.splitlines()) == 1


def test_a_full_disk_is_done_without_and_nothing_half_written_stays(
    room: Path, tmp_path: Path
) -> None:
    """Writing that ends in the middle of a file gives the right arrays, one line, and no folder
    that could be read."""
    code = (
        "import pathlib, resource, sys, numpy as np\nfrom cosim.core.baked import baked, "
        "sources_hash\nresource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\nmade = "
        "sources_hash(pathlib.Path(sys.argv[1]))\narrays = [baked(name, made, lambda: {'n': "
        "np.arange(200000)}) for name in 'ab']\nprint([int(kept['n'].sum()) for kept in arrays])"
    )
    done = subprocess.run(
        [sys.executable, "-B", "-c", code, str(room)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.stdout == f"[{sum(range(200000))}, {sum(range(200000))}]\n", done.stderr
    assert (
        done.stderr.startswith("note: ")
        and "not kept" in done.stderr
        and done.stderr.count("note: ") <= 2
    )
    assert list((tmp_path / "cache/baked").iterdir()) == []


def test_a_cache_that_may_only_be_read_is_read(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What lies there is mapped, and nothing is said."""
    make = Maker()
    baked("a", sources_hash(room), make)
    folders = [tmp_path / "cache", tmp_path / "cache/baked", *(tmp_path / "cache/baked").iterdir()]
    for folder in folders:
        folder.chmod(0o555)
    try:
        assert same(baked("a", sources_hash(room), make)) and make.times == 1
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert capsys.readouterr().err == ""


def test_who_makes_it_at_once_gets_the_same_and_leaves_nothing(room: Path, tmp_path: Path) -> None:
    """Processes that make the same at the same time all get it, also beside what a killed one left
    half made."""
    left = tmp_path / "cache/baked/.making-of-a-killed-one"
    left.mkdir(parents=True)
    (left / "ramp.npy").write_bytes(b"half")
    code = (
        "import sys, pathlib, numpy as np\nfrom cosim.core.baked import baked, "
        "sources_hash\nsys.stdin.readline()\nprint(int(baked('a', "
        "sources_hash(pathlib.Path(sys.argv[1])), lambda: {'n': np.arange(200000)})['n'].sum()))"
    )
    makers = [
        subprocess.Popen([sys.executable, "-c", code, str(room)], stdin=-1, stdout=-1, text=True)
        for _ in range(4)
    ]
    for maker in makers:
        assert maker.stdin is not None
        maker.stdin.write("\n")
        maker.stdin.flush()
    assert {maker.communicate(timeout=PATIENCE_S)[0] for maker in makers} == {
        f"{sum(range(200000))}\n"
    }
    (kept,) = (path for path in (tmp_path / "cache/baked").iterdir() if path != left)
    assert kept.name.startswith("a-")

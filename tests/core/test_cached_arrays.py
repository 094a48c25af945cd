"""Cached arrays: computed once, always correct, and recomputed where they cannot be cached."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import packages_distributions, version
from pathlib import Path

import numpy as np
import pytest

from cosim.core import cache as module
from cosim.core.cache import ArrayCache, Arrays, mapped_arrays, sources_hash
from tests.conftest import PATIENCE_S, ROOT

CORNERS = np.zeros(5, dtype=[("at", "f4", 3), ("label", "u1"), ("colour", "u1", (4,))])
CORNERS["at"] = np.arange(15.0).reshape(5, 3)
WANTED = {
    "corners": CORNERS,
    "heights": np.linspace(0.0, 1.0, 7).reshape(1, 7),
    "none": np.zeros((0, 3), dtype=np.int32),
    "bytes": np.arange(3, dtype=np.uint8),
}

Get = Callable[[str, str, Callable[[], Arrays]], Arrays]
"""Takes a key, a name and the function that makes the arrays."""


def one_of_many(key: str, name: str, make: Callable[[], Arrays]) -> Arrays:
    return ArrayCache("tiles", key).get(name, make)


def mapped(key: str, name: str, make: Callable[[], Arrays]) -> Arrays:
    return mapped_arrays(name, key, make)


both = pytest.mark.parametrize("get", [one_of_many, mapped])
SCRIPT = (
    "import sys\nfrom tests.core.test_cached_arrays import *\nget = {'one_of_many': one_of_many, "
    "'mapped': mapped}"
)
"""Begins the script of a process that makes arrays too."""


class Maker:
    """Counts its calls."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> Arrays:
        self.times += 1
        return WANTED


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    module._print_once.cache_clear()
    return tmp_path / "cache"


def files_in(cache: Path) -> list[Path]:
    """The finished files of the cache."""
    parts = (*cache.glob("tiles/*/*"), *cache.glob("baked/*"))
    return sorted(path for path in parts if not path.name.startswith(module.UNFINISHED_PREFIX))


def same(arrays: Arrays) -> bool:
    return [*arrays] == [*WANTED] and all(
        (array.dtype, array.shape, array.tobytes())
        == (wanted.dtype, wanted.shape, wanted.tobytes())
        and not array.flags.writeable
        for array, wanted in zip(arrays.values(), WANTED.values(), strict=True)
    )


@both
def test_arrays_are_made_once(get: Get) -> None:
    """Later calls return bit-identical, write-protected arrays of the same types and shapes."""
    make = Maker()
    assert same(get("a", "0_0", make)) and same(get("a", "0_0", make)) and make.times == 1


@both
def test_other_names_and_keys_are_other_arrays(get: Get, cache: Path) -> None:
    """Arrays cached under another name or key are not returned."""
    make = Maker()
    for key, name in (("a", "0_0"), ("a", "0_1"), ("b", "0_0")):
        assert same(get(key, name, make))
    assert make.times == 3 and len(files_in(cache)) == 3


def test_sets_without_a_key_are_not_cached(cache: Path) -> None:
    """Without known inputs the arrays are computed each time."""
    make = Maker()
    assert same(one_of_many("", "0_0", make)) and same(one_of_many("", "0_0", make))
    assert make.times == 2 and not files_in(cache)


@pytest.mark.parametrize("package", ["numpy", "scipy", "shapely"])
def test_a_hash_of_sources_includes_library_versions(
    monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    """Arrays of one version of a library are not returned for another."""
    before = sources_hash()
    monkeypatch.setattr(module, "version", lambda name: "0" if name == package else version(name))
    module._array_versions.cache_clear()
    try:
        assert sources_hash() != before
    finally:
        module._array_versions.cache_clear()


def test_a_hash_of_sources_covers_the_packages_that_they_import() -> None:
    """The hash includes the modules that textures and motions import from other packages."""
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
        module._ARRAY_PACKAGES
    )


@both
@pytest.mark.parametrize("damage", ["a bit", "its hash", "cut off", "empty", "other bytes"])
def test_damaged_files_are_made_again(get: Get, cache: Path, damage: str) -> None:
    """After any damage the arrays are correct, and the file is complete again."""
    make = Maker()
    get("a", "0_0", make)
    (file,) = files_in(cache)
    data = file.read_bytes()
    became = {
        "a bit": data[:-70] + bytes([data[-70] ^ 1]) + data[-69:],
        "its hash": bytes([data[0] ^ 1]) + data[1:],
        "cut off": data[: len(data) // 2],
        "empty": b"",
        "other bytes": data[:64] + b"\xff" * 50,
    }
    file.unlink()
    file.write_bytes(became[damage])
    assert same(get("a", "0_0", make)) and same(get("a", "0_0", make)) and make.times == 2


@both
def test_a_cache_that_cannot_be_written_is_reported_once(
    get: Get, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The arrays are correct, and one line says why the next process computes them again."""
    cache.write_text("a file where a folder should be")
    make = Maker()
    assert same(get("a", "0_0", make)) and same(get("a", "0_0", make)) and make.times == 2
    message = capsys.readouterr().err
    assert (
        message.startswith("note: ") and "not cached" in message and len(message.splitlines()) == 1
    )


@both
def test_a_read_only_cache_is_read(
    get: Get, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Entries of a cache without write permission are returned without a note."""
    make = Maker()
    get("a", "0_0", make)
    folders = [cache, *(path for path in cache.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    try:
        assert same(get("a", "0_0", make)) and make.times == 1
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert capsys.readouterr().err == ""


@both
def test_a_full_disk_leaves_no_file(get: Get, cache: Path) -> None:
    """An interrupted write gives correct arrays, a note, and no complete or partial file."""
    code = (
        f"{SCRIPT}[sys.argv[1]]\nimport resource\nresource.setrlimit(resource.RLIMIT_FSIZE, "
        f"(4096, 4096))\n"
        "print([int(get('a', n, lambda: {'n': np.arange(200000)})['n'].sum()) for n in 'xy'])"
    )
    command = [sys.executable, "-B", "-c", code, get.__name__]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=ROOT
    )
    assert done.stdout == f"[{sum(range(200000))}, {sum(range(200000))}]\n", done.stderr
    assert done.stderr.startswith("note: ") and done.stderr.count("note: ") <= 2
    assert not [path for path in cache.glob("[tb]*/**/*") if path.is_file()]

"""The cache folder: its contents, its limit, and eviction that spares entries in use."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cosim.core.cache import (
    ArrayCache,
    cache_entries,
    clean_up,
    clean_up_if_due,
    mapped_arrays,
)
from cosim.core.files import UNFINISHED_PREFIX
from tests.conftest import PATIENCE_S, Cosim

MB = 10**6


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own, with an entry of 1 MB of each kind, an hour apart, cities oldest."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("COSIM_CACHE", str(folder))
    monkeypatch.delenv("COSIM_CACHE_LIMIT", raising=False)
    for hours, name in enumerate(
        ("maps/town/net.xml", "baked/sky-1/sky.npy", "tiles/a/0_0", "read/a.map", "city-1.net.xml"),
        start=2,
    ):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x" * MB)
        used_s = time.time() - 3600.0 * hours
        for one in (path, path.parent) if path.parent != folder else (path,):
            os.utime(one, (used_s, used_s))
    return folder


def left(cache: Path) -> set[str]:
    return {entry.path.relative_to(cache).as_posix() for entry in cache_entries()}


@contextmanager
def user_of(entry: str) -> Iterator[subprocess.Popen[str]]:
    """A process that uses an entry and stays alive."""
    code = (
        "import sys\nfrom cosim.core.cache import cache_folder, use_entry\n"
        "use_entry(cache_folder() / sys.argv[1])\nprint('uses', flush=True)\nsys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, entry], stdin=-1, stdout=-1, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "uses\n"
        yield process


def test_least_recently_used_entries_are_evicted_beyond_the_limit(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Imported maps count and stay, whatever the limit; below it nothing is evicted."""
    assert len(left(cache)) == 5 and not clean_up().entries
    evicted = clean_up(limit_bytes=round(3.5 * MB))
    assert [entry.path.name for entry in evicted.entries] == ["a.map", "city-1.net.xml"]
    assert evicted.size_bytes == pytest.approx(2 * MB, rel=0.1)
    monkeypatch.setenv("COSIM_CACHE_LIMIT", "0")
    clean_up_if_due()
    assert left(cache) == {"maps/town"}


def test_entries_of_a_living_process_are_not_evicted(cache: Path) -> None:
    """The oldest entry stays, whatever the limit, until the process that uses it ends, however it
    ends."""
    with user_of("city-1.net.xml") as process:
        evicted = clean_up(limit_bytes=0)
        assert [entry.path.name for entry in evicted.in_use] == ["city-1.net.xml"]
        assert left(cache) == {"maps/town", "city-1.net.xml"}
        process.kill()
        process.wait(PATIENCE_S)
    assert [entry.path.name for entry in clean_up(limit_bytes=0).entries] == ["city-1.net.xml"]
    assert left(cache) == {"maps/town"} and not list((cache / ".in-use").iterdir())


def test_a_long_process_does_not_hold_entries_used_long_ago(cache: Path) -> None:
    """Entries used within the hour stay and older ones are evicted, so that a long process is
    bounded."""
    with user_of("city-1.net.xml"):
        long_ago_s = time.time() - 7200.0
        os.utime(cache / "city-1.net.xml", (long_ago_s, long_ago_s))
        clean_up(limit_bytes=0)
        assert left(cache) == {"maps/town"}


def test_concurrent_use_and_eviction_are_safe(cache: Path) -> None:
    """While four processes write and use entries and two evict, no used entry disappears and none
    is left unfinished."""
    keeps = (
        "import sys\nfrom cosim.core.cache import cache_folder, use_entry\nfor k in range(150):\n "
        "   entry = cache_folder() / 'read' / f'{sys.argv[1]}-{k}.map'\n    use_entry(entry)\n    "
        "part = entry.with_name(f'.making-{entry.name}')\n    part.write_bytes(b'x' * 100)\n    "
        "part.replace(entry)\n    use_entry(entry)\n    gone = [n for n in range(k) if not "
        "entry.with_name(f'{sys.argv[1]}-{n}.map').exists()]\n    assert not gone, gone\n"
    )
    forgets = "from cosim.core.cache import clean_up\nfor _ in range(40): clean_up(limit_bytes=0)"
    words = [(keeps, str(n)) for n in range(4)] + [(forgets, ""), (forgets, "")]
    processes = [
        subprocess.Popen([sys.executable, "-c", *word], stderr=subprocess.PIPE, text=True)
        for word in words
    ]
    for process in processes:
        output = process.communicate(timeout=PATIENCE_S)[1]
        assert process.returncode == 0, output
    clean_up(limit_bytes=0)
    assert left(cache) == {"maps/town"}
    assert {path.name for path in cache.iterdir()} <= {
        "maps",
        "read",
        "tiles",
        "baked",
        ".lock",
        ".in-use",
    }


@pytest.mark.parametrize(
    "keep",
    [lambda: ArrayCache("tiles", "b").get("0_0", dict), lambda: mapped_arrays("sky-2", "b", dict)],
    ids=["piece", "baked"],
)
def test_adding_an_entry_evicts_old_ones_first(
    cache: Path, monkeypatch: pytest.MonkeyPatch, keep: Callable[[], object]
) -> None:
    """Entries unused for a month are evicted, and a process checks at most once a minute."""
    os.utime(cache / "tiles/a", (0.0, 0.0))
    keep()
    assert "tiles/a" not in left(cache) and len(left(cache)) == 5
    os.utime(cache / "read/a.map", (0.0, 0.0))
    clean_up_if_due()
    assert "read/a.map" in left(cache)
    monkeypatch.setattr("cosim.core.cache._CLEANUP_INTERVAL_S", 0.0)
    clean_up_if_due()
    assert "read/a.map" not in left(cache)


def test_unfinished_entries_of_killed_processes_are_removed(cache: Path) -> None:
    """They are removed after an hour; younger ones may still be in progress."""
    for name in (
        f"baked/{UNFINISHED_PREFIX}x",
        f"tiles/a/{UNFINISHED_PREFIX}x",
        ".building-x",
        ".forgotten-x",
    ):
        for young in ("", "-young"):
            (cache / f"{name}{young}").mkdir()
        os.utime(cache / name, (0.0, 0.0))
    clean_up()
    found = sorted(path.name for path in cache.rglob(".*-x*"))
    assert found == [
        ".building-x-young",
        ".forgotten-x-young",
        f"{UNFINISHED_PREFIX}x-young",
        f"{UNFINISHED_PREFIX}x-young",
    ]


def test_the_cache_command_lists_and_prunes_entries(cache: Path, cosim: Cosim) -> None:
    """It prints a size for each kind, the sum and the limit; --prune removes entries unused for a
    month, some days, or all."""
    result = cosim("cache")
    assert result.returncode == 0 and result.stdout == cosim("cache", "--size").stdout
    rows = {line.split()[0]: line for line in result.stdout.splitlines() if line.split()}
    assert (
        "1 MB" in rows["cities"] and "6 h ago" in rows["cities"] and "never removed" in rows["maps"]
    )
    assert f"{cache}: 5" in result.stdout and "of at most 4 GB (COSIM_CACHE_LIMIT)" in result.stdout
    assert "Removed: 0 entries" in cosim("cache", "--prune").stdout
    os.utime(cache / "read/a.map", (0.0, 0.0))
    assert "Removed: 1 entry, 1 MB" in cosim(
        "cache", "--prune"
    ).stdout and "read/a.map" not in left(cache)
    assert "Removed: 1 entry" in cosim("cache", "--prune", "--unused-for", "0.22").stdout
    with user_of("tiles/a"):
        assert (
            "Removed: 1 entry, 1 MB; 1 in use stay"
            in cosim("cache", "--prune", "--unused-for", "0").stdout
        )
    assert left(cache) == {"maps/town", "tiles/a"}


@pytest.mark.parametrize("limit", ["much", "-1", "nan", "inf"])
def test_an_invalid_limit_is_refused(
    cosim: Cosim, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    """The variable is named, with its value and the valid form."""
    monkeypatch.setenv("COSIM_CACHE_LIMIT", limit)
    result = cosim("list")
    assert (
        result.returncode == 2
        and f"COSIM_CACHE_LIMIT is '{limit}': give a number of GB from 0 on" in result.stderr
    )
    monkeypatch.setenv("COSIM_CACHE_LIMIT", "0.5")
    assert "of at most 0.5 GB" in cosim("cache").stdout
    assert cosim("cache", "--unused-for", "3").returncode == 2

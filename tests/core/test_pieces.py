"""Pieces that are kept: made once, never wrong, and done without where they cannot be kept."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cosim.core import cache as kept
from cosim.core.baked import Arrays
from cosim.core.pieces import Pieces, _read
from tests.conftest import PATIENCE_S

CORNERS = np.zeros(5, dtype=[("at", "f4", 3), ("label", "u1"), ("colour", "u1", (4,))])
CORNERS["at"] = np.arange(15.0).reshape(5, 3)
WANTED = {
    "corners": CORNERS,
    "heights": np.linspace(0.0, 1.0, 7).reshape(1, 7),
    "none": np.zeros((0, 3), dtype=np.int32),
    "bytes": np.arange(3, dtype=np.uint8),
}


class Maker:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> Arrays:
        self.times += 1
        return WANTED


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    kept._say_once.cache_clear()
    return tmp_path / "cache"


def same(arrays: Arrays) -> bool:
    return [*arrays] == [*WANTED] and all(
        (held.dtype, held.shape, held.tobytes()) == (wanted.dtype, wanted.shape, wanted.tobytes())
        and not held.flags.writeable
        for held, wanted in zip(arrays.values(), WANTED.values(), strict=True)
    )


def test_a_piece_is_made_once() -> None:
    """Whoever asks later gets the same arrays, to the bit, of the same types and shapes,
    write-protected."""
    make = Maker()
    assert same(Pieces("tiles", "a").get("0_0", make)) and same(
        Pieces("tiles", "a").get("0_0", make)
    )
    assert make.times == 1


def test_other_pieces_and_other_makers_make_anew(cache: Path) -> None:
    """What is kept under another name, or of something else, is not taken; what hangs on unknown
    things is not kept."""
    make = Maker()
    for made_of, name in (("a", "0_0"), ("a", "0_1"), ("b", "0_0"), ("", "0_0"), ("", "0_0")):
        assert same(Pieces("tiles", made_of).get(name, make))
    assert make.times == 5 and sorted(path.name for path in (cache / "tiles").iterdir()) == [
        "a",
        "b",
    ]


@pytest.mark.parametrize("damage", ["a bit", "its seal", "cut off", "empty", "of another"])
def test_a_damaged_piece_is_made_anew(cache: Path, damage: str) -> None:
    """Whatever became of the file, the arrays are right, and the file whole again afterwards."""
    make = Maker()
    pieces = Pieces("tiles", "a")
    pieces.get("0_0", make)
    file = cache / "tiles/a/0_0"
    data = file.read_bytes()
    became = {
        "a bit": data[:-20] + bytes([data[-20] ^ 1]) + data[-19:],
        "its seal": bytes([data[0] ^ 1]) + data[1:],
        "cut off": data[: len(data) // 2],
        "empty": b"",
        "of another": data[:32] + b"\xff" * 50,
    }
    file.write_bytes(became[damage])
    assert same(pieces.get("0_0", make)) and same(pieces.get("0_0", make)) and make.times == 2


def test_where_nothing_can_be_kept_pieces_are_made_each_time_and_that_is_said_once(
    cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The arrays are right all the same; one line tells why the next process makes them anew."""
    cache.write_text("a file where a folder should be")
    make = Maker()
    pieces = Pieces("tiles", "a")
    assert same(pieces.get("0_0", make)) and same(pieces.get("0_0", make)) and make.times == 2
    told = capsys.readouterr().err
    assert told.startswith("note: ") and "not kept" in told and len(told.splitlines()) == 1


def test_pieces_that_may_only_be_read_are_read(
    cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What lies in a cache that is not to be written is taken, and nothing is said."""
    make = Maker()
    Pieces("tiles", "a").get("0_0", make)
    folders = [cache, cache / "tiles", cache / "tiles/a"]
    for folder in folders:
        folder.chmod(0o555)
    try:
        assert same(Pieces("tiles", "a").get("0_0", make)) and make.times == 1
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert capsys.readouterr().err == ""


def test_a_full_disk_leaves_no_half_a_piece(cache: Path) -> None:
    """Writing that ends in the middle gives the right arrays, one line, and no file."""
    code = (
        "import resource, numpy as np\nfrom cosim.core.pieces import Pieces\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "print([int(Pieces('tiles', 'a').get(n, lambda: {'n': "
        "np.arange(200000)})['n'].sum()) for n in 'xy'])"
    )
    done = subprocess.run(
        [sys.executable, "-B", "-c", code],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.stdout == f"[{sum(range(200000))}, {sum(range(200000))}]\n", done.stderr
    assert done.stderr.startswith("note: ") and done.stderr.count("note: ") <= 2
    assert [path.name for path in (cache / "tiles").rglob("*")] == ["a"]


def test_who_is_killed_while_making_leaves_nothing_wrong(cache: Path) -> None:
    """Of processes that keep the same pieces at once, and are killed at it, only whole files are
    left to be read."""
    code = (
        "import itertools, numpy as np\nfrom cosim.core.pieces import Pieces\npieces = "
        "Pieces('tiles', 'a')\nfor k in itertools.count():\n    pieces.get(str(k), lambda: {'n': "
        "np.full(300000, k)})\n    print(k, flush=True)"
    )
    makers = [
        subprocess.Popen([sys.executable, "-c", code], stdout=-1, text=True) for _ in range(3)
    ]
    for maker in makers:
        assert maker.stdout is not None
        while int(maker.stdout.readline()) < 5:
            pass
        maker.send_signal(signal.SIGKILL)
    for maker in makers:
        maker.communicate(timeout=PATIENCE_S)
    files = [*(cache / "tiles/a").iterdir()]
    assert len(files) > 5
    for file in files:
        (held,) = _read(file).values()
        assert len(held) == 300000 and (held == int(file.name)).all()

"""Packed demonstrations: arrays in one file."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import RunError
from cosim.core.packed_demos import Packed, read_packed


def some_rows(lengths: tuple[int, ...] = (3, 2)) -> Packed:
    """Two short episodes whose arrays are all different."""
    draws = np.random.default_rng(4)
    count = sum(lengths)
    return Packed(
        frames=draws.integers(0, 256, (count, 18, 32, 3), np.uint8),
        state=draws.random((count, 2), np.float32),
        goal=draws.random((count, 2), np.float32),
        command=draws.random((count, 2), np.float32),
        waypoints=draws.random((count, 8, 2), np.float32),
        driven=np.full(count, 8, np.int32),
        disturbed=np.zeros(count, bool),
        episode=np.repeat(np.arange(len(lengths), dtype=np.int32), lengths),
        frame=np.concatenate([np.arange(length, dtype=np.int32) for length in lengths]),
        meta={"rate_hz": 5.0, "goal": "route_point"},
    )


def test_a_packed_file_is_read_with_numpy_alone(tmp_path: Path) -> None:
    """The file has the saved arrays, the same bytes twice, and is read without any other package."""
    rows = some_rows()
    path = tmp_path / "rows.npz"
    again = tmp_path / "again.npz"
    rows.save(path)
    rows.save(again)
    read = read_packed(path)
    for one in fields(Packed):
        np.testing.assert_array_equal(getattr(read, one.name), getattr(rows, one.name))
    assert path.read_bytes() == again.read_bytes()
    code = (
        "import sys; from pathlib import Path; from cosim.core.packed_demos import read_packed; "
        "print(len(read_packed(Path(sys.argv[1]))), sorted({m.partition('.')[0] for m in "
        "sys.modules} & {'msgspec', 'pyarrow', 'pandas', 'av', 'scipy'}))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "5 []"


def test_a_history_does_not_reach_into_the_previous_episode() -> None:
    """Of four pictures, two rows apart, those before the episode are replaced by its first."""
    assert some_rows((5, 2)).history(4, 2).tolist()[4:] == [
        [0, 0, 2, 4],
        [5, 5, 5, 5],
        [5, 5, 5, 6],
    ]


@pytest.mark.parametrize("damage", ["no file", "no npz", "cut off"])
def test_an_invalid_packed_file_is_refused_by_name(tmp_path: Path, damage: str) -> None:
    """A missing file, one of another kind and one cut off are named, with the command that makes
    one."""
    path = tmp_path / "rows.npz"
    some_rows().save(path)
    if damage == "no file":
        path.unlink()
    else:
        path.write_bytes(b"frames" if damage == "no npz" else path.read_bytes()[:-400])
    with pytest.raises(
        RunError, match=r"rows\.npz: no packed demonstrations: .*cosim dataset pack"
    ):
        read_packed(path)

"""`cosim coordinator` takes what `cosim run` takes, and says what it cannot."""

from __future__ import annotations

from pathlib import Path

from tests.conftest import Cosim


def test_what_is_of_one_machine_is_refused_in_words(cosim: Cosim, tmp_path: Path) -> None:
    """Before anything is loaded, listened to or written; its help does not offer it."""
    for words in (
        ("--shared-renderer",),
        ("--real-time",),
        ("--pace", "1"),
        ("--live", "tcp/127.0.0.1:7448"),
        ("--director", "x"),
    ):
        said = cosim("coordinator", "reactive", *words, cwd=tmp_path)
        assert said.returncode == 2 and f"{words[0]} is of one machine" in said.stderr, said.stderr
        assert "leave it out, or use `cosim run`" in said.stderr
    assert "--live" not in (told := cosim("coordinator", "--help").stdout) and "--shard" in told
    assert not [*tmp_path.iterdir()]


def test_a_shard_of_a_coordinator_is_one_of_a_run(cosim: Cosim, tmp_path: Path) -> None:
    """It needs the run's seed, and there are no more shards than scenarios."""
    words = (
        "coordinator",
        "reactive",
        "--policy",
        "straight",
        "--episodes",
        "2",
        "--listen",
        "unixsock-stream/hub",
    )
    assert "--shard needs --seed" in cosim(*words, "--shard", "1/2", cwd=tmp_path).stderr
    assert (
        "the run has 2 scenarios"
        in cosim(*words, "--shard", "1/3", "--seed", "1", cwd=tmp_path).stderr
    )
    assert not [*tmp_path.iterdir()]

"""Shards of a run, and the run merged from them."""

from __future__ import annotations

import itertools
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from cosim.core.errors import RunError, UsageError
from cosim.core.progress import ignore
from cosim.results.merge import merge_runs
from cosim.results.run_folder import RunFolder, read_records, read_spec
from cosim.results.run_spec import RunSpec, Shard
from cosim.spec.scenario import Scenario, Suite
from tests.conftest import Cosim
from tests.run_specs import changed, spec_of
from tests.support.driven_runs import episode_of, run_of, short_way

WAYS = tuple(short_way(f"s-{i:03d}") for i in range(7))
SUITE = Suite(name="s", version="1", scenarios=WAYS)
SPEC = spec_of(SUITE, versions={"numpy": "2", "arithmetic": "1f"})
HOWS = {
    way.id: how
    for way, how in zip(
        WAYS, ("goal", "hit", "goal", "crashed", "goal", "invalid", "hit"), strict=True
    )
}


def finished_run(path: Path, spec: RunSpec, ways: Sequence[Scenario], wall_s: float = 1.0) -> Path:
    """A run folder with these finished scenarios, after so many seconds each."""
    with RunFolder.create(path, spec, SUITE) as folder:
        for way in reversed(ways):
            record, log = episode_of(way, SUITE.content_hash, HOWS[way.id])
            record = msgspec.structs.replace(record, clock={"wall_s": wall_s})
            folder.write_episode(record, log.encoded() if log is not None else b"")
    return path


def shards(folder: Path, of: int, **fields: object) -> list[Path]:
    """All shards of the run, each in its own folder; `fields` change run.json of all."""
    cut = [Shard(number, of) for number in range(1, of + 1)]
    return [
        finished_run(folder / f"{one.number}", changed(SPEC, shard=one, **fields), one.select(WAYS))
        for one in cut
    ]


def bytes_of(*folders: Path) -> dict[Path, bytes]:
    return {
        file: file.read_bytes()
        for folder in folders
        for file in folder.rglob("*")
        if file.is_file()
    }


def undivided_table(folder: Path) -> bytes:
    """Return results.csv of the same run without shards."""
    with RunFolder.resume(finished_run(folder / "whole", SPEC, WAYS), SPEC) as run:
        run.finish()
    return (folder / "whole/results.csv").read_bytes()


@pytest.mark.parametrize("of", [1, 3, 7])
def test_merged_shards_equal_the_undivided_run(tmp_path: Path, of: int) -> None:
    """For any division run.json, scenarios.json, results.csv and records are the same, and the
    shards are unchanged."""
    parts = shards(tmp_path, of)
    (parts[0] / "logs/worker-0.log").write_text("what it printed")
    before = bytes_of(*parts)
    merged = merge_runs(parts, tmp_path / "deep/merged", ignore)
    assert bytes_of(*parts) == before and (merged.missing, merged.twice) == ((), ())
    assert (tmp_path / "deep/merged/results.csv").read_bytes() == undivided_table(tmp_path)
    for name in (
        "run.json",
        "scenarios.json",
        "episodes/s-004/trajectory.npz",
        "episodes/s-003/record.json",
    ):
        assert (tmp_path / "deep/merged" / name).read_bytes() == (
            tmp_path / "whole" / name
        ).read_bytes()
    assert {r.scenario.id for r in read_records(tmp_path / "deep/merged")} == set(SPEC.scenarios)
    assert (tmp_path / "deep/merged/logs/1-1/worker-0.log").read_text() == "what it printed"
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["merged"]


def test_a_killed_shard_is_read_without_changes(tmp_path: Path) -> None:
    """A merge reads a killed shard completely and changes none of its bytes."""
    parts = shards(tmp_path, 2)
    with closing(sqlite3.connect(parts[0] / "results.sqlite")) as database:
        with database:
            database.execute("delete from episodes where scenario = 's-006'")
        killed = shutil.copytree(parts[0], tmp_path / "killed")
    before = bytes_of(killed)
    assert killed / "results.sqlite-wal" in before
    assert (
        merge_runs([killed, parts[1]], tmp_path / "merged", ignore).missing == ()
        and bytes_of(killed) == before
    )


def test_missing_scenarios_are_named_and_can_be_run(tmp_path: Path, cosim: Cosim) -> None:
    """A merge without one shard names its scenarios, writes no results.csv, and can be resumed."""
    parts = shards(tmp_path, 3)
    result = cosim("merge", str(parts[0]), str(parts[2]), "--out", str(tmp_path / "merged"))
    assert result.returncode == 1
    assert (
        "2 scenarios are missing: s-001, s-004: give the command of the run without --shard"
        in result.stderr
    )
    assert not (tmp_path / "merged/results.csv").exists()
    with RunFolder.resume(tmp_path / "merged", SPEC) as folder:
        assert folder.finished_ids() == set(SPEC.scenarios) - {"s-001", "s-004"}


def test_equal_episodes_are_merged_once(tmp_path: Path) -> None:
    """Wall times and compression may differ, and nothing else."""
    parts = [*shards(tmp_path, 2), finished_run(tmp_path / "again", SPEC, WAYS[2:5], wall_s=9.0)]
    merged = merge_runs(parts, tmp_path / "merged", ignore)
    assert merged.twice == ("s-002", "s-003", "s-004")
    assert (tmp_path / "merged/results.csv").read_bytes() == undivided_table(tmp_path)


@pytest.mark.parametrize("what", ["record", "trajectory"])
def test_different_episodes_of_a_scenario_are_a_conflict(
    tmp_path: Path, cosim: Cosim, what: str
) -> None:
    """Both folders, the scenario and the first difference are named, and nothing is written."""
    parts = shards(tmp_path, 2)
    other = tmp_path / "other"
    with RunFolder.create(other, SPEC, SUITE) as folder:
        record, log = episode_of(WAYS[2], SUITE.content_hash, "goal")
        assert log is not None
        if what == "record":
            record = msgspec.structs.replace(record, state_hash="f00")
        else:
            log.pose[0, 2] += 1e-16
        folder.write_episode(record, log.encoded())
    result = cosim("merge", *map(str, parts), str(other), "--out", str(tmp_path / "merged"))
    assert result.returncode == 2 and not (tmp_path / "merged").exists()
    assert f"CONFLICT: {other} and {parts[0]} have different episodes of 's-002'" in result.stderr
    assert (
        "state_hash is 'f00'" if what == "record" else "trajectory.npz is another one"
    ) in result.stderr


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("seed", 8, "its seed is 8, there it is 0"),
        ("policy", "q", "its policy is q, there it is p"),
        (
            "scenarios",
            SPEC.scenarios[:5],
            "its choice of scenarios is 5, there it is 7, with s-005",
        ),
        (
            "versions",
            {"numpy": "3", "arithmetic": "1f"},
            "{'numpy': '3'}, there it is {'numpy': '2'}",
        ),
        (
            "versions",
            {"numpy": "2", "arithmetic": "2e"},
            "processors or C libraries of the two machines round differently",
        ),
    ],
    ids=["seed", "policy", "scenarios", "package", "arithmetic"],
)
def test_folders_of_different_runs_are_refused(
    tmp_path: Path, cosim: Cosim, field: str, value: object, words: str
) -> None:
    """The field and both values are named, and nothing is written."""
    mine = finished_run(
        tmp_path / "mine", msgspec.structs.replace(SPEC, shard=Shard(1, 2)), WAYS[:1]
    )
    theirs = finished_run(
        tmp_path / "theirs", changed(SPEC, shard=Shard(2, 2), **{field: value}), WAYS[1:2]
    )
    result = cosim("merge", str(mine), str(theirs), "--out", str(tmp_path / "merged"))
    assert (
        result.returncode == 2
        and f"{theirs} is of another run than {mine}" in result.stderr
        and words in result.stderr
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "theirs"]


def test_damaged_busy_and_existing_folders_are_refused(tmp_path: Path) -> None:
    """They are a folder without a run, one in use, a truncated record, and an existing target."""
    parts = shards(tmp_path, 2)
    with pytest.raises(UsageError, match="unknown run"):
        merge_runs([*parts, tmp_path / "nothing"], tmp_path / "merged", ignore)
    with (
        RunFolder.resume(parts[1], read_spec(parts[1])),
        pytest.raises(RunError, match=r"in use by process \d+"),
    ):
        merge_runs(parts, tmp_path / "merged", ignore)
    with pytest.raises(RunError, match="exists already: choose another --out"):
        merge_runs(parts, parts[0], ignore)
    record = parts[1] / "episodes/s-001/record.json"
    record.write_bytes(record.read_bytes()[:200])
    with pytest.raises(RunError, match=r"1/record\.json: not an episode record.*--resume"):
        merge_runs(parts, tmp_path / "merged", ignore)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "2"]


def test_a_shard_is_resumed_as_that_shard(tmp_path: Path) -> None:
    """Another shard, or the whole run, is refused with the shards in the form of the option."""
    (first, _) = shards(tmp_path, 2)
    with pytest.raises(RunError, match="its shard is 1/2, and this command has 2/2"):
        RunFolder.resume(first, msgspec.structs.replace(SPEC, shard=Shard(2, 2)))
    with pytest.raises(RunError, match="its shard is 1/2, and this command has None"):
        RunFolder.resume(first, SPEC)


@pytest.mark.parametrize(
    "words", ["0/2", "3/2", "1", "1/0", "-1/2", "a/b", "1/2/3", "²/3"], ids=ascii
)
def test_an_invalid_shard_is_refused(words: str) -> None:
    """One line says how it is written."""
    with pytest.raises(UsageError, match="give i/n, with i from 1 to n"):
        Shard.parse(words, 100)


def test_every_scenario_is_in_exactly_one_shard() -> None:
    """This holds for any number of shards; more shards than scenarios are refused."""
    for of in range(1, 8):
        cut = [Shard.parse(f"{number}/{of}", 7).select(range(7)) for number in range(1, of + 1)]
        assert sorted(itertools.chain(*cut)) == list(range(7)) and all(cut)
    with pytest.raises(UsageError, match="the run has 7 scenarios"):
        Shard.parse("1/8", 7)


def test_a_shard_needs_the_seed_of_its_run(cosim: Cosim) -> None:
    """A seed drawn for each shard would give another run."""
    result = cosim("run", "reactive", "--policy", "straight", "--shard", "1/2")
    assert result.returncode == 2 and "--shard needs --seed: shards are of one run" in " ".join(
        result.stderr.split()
    )


def test_a_finished_run_is_a_shard_too(tmp_path: Path) -> None:
    """Parts of a run from two machines without shards are merged, too."""
    run = run_of(tmp_path / "a", ["goal", "hit"])
    merged = merge_runs([run], tmp_path / "merged", ignore)
    assert (
        merged.missing == ()
        and (tmp_path / "merged/results.csv").read_bytes() == (run / "results.csv").read_bytes()
    )

"""Run folders: rows, locks, resuming, and damage."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.errors import RunError, UsageError
from cosim.metrics import METRICS
from cosim.record import Log, Record
from cosim.results import summary_of, table_of
from cosim.runfolder import RunFolder, RunSpec, read_records
from cosim.scenario import City, Scenario, Suite


def scenario(name: str) -> Scenario:
    return Scenario(
        id=name, suite="s", place=City(seed=0), seed=0, start=(0.0, 0.0, 0.0), goal=(9.0, 0.0),
        route=((0.0, 0.0), (9.0, 0.0)),
    )  # fmt: skip


SUITE = Suite(name="s", version="1", scenarios=tuple(scenario(f"s-{i}") for i in range(3)))
SPEC = RunSpec(
    suite="s", suite_version="1", suite_hash=SUITE.content_hash, policy="p", policy_name="p", policy_version="1",
    scenarios=tuple(s.id for s in SUITE.scenarios), versions={"numpy": "2"},
)  # fmt: skip


def record(name: str, *, success: float = 1.0, status: str = "done", wall_s: float = 1.0) -> Record:
    measures: dict[str, float | None] = dict.fromkeys(METRICS, None) | {"success": success}
    return Record(
        scenario=name, scenario_hash="h", suite="s", suite_hash=SUITE.content_hash, seed=0, policy="p",
        policy_version="1", goal_protocol="none", renderer="none", versions={"numpy": "2"}, status=status,
        ended="goal", ticks=3, state_hash="abc", measures=measures, clock={"wall_s": wall_s},
    )  # type: ignore[arg-type]  # fmt: skip


def test_the_table_does_not_depend_on_the_order_in_which_episodes_end(tmp_path: Path) -> None:
    """Rows are sorted by scenario and hold no wall times, so two runs give the same bytes."""
    for name, order in (("a", (0, 1, 2)), ("b", (2, 0, 1))):
        with RunFolder.create(tmp_path / name, SPEC, SUITE) as folder:
            for i in order:
                folder.add(record(f"s-{i}", wall_s=float(np.random.default_rng().random())))
            folder.finish()
    assert (tmp_path / "a/results.csv").read_bytes() == (tmp_path / "b/results.csv").read_bytes()


def test_a_folder_that_holds_a_run_is_not_overwritten(tmp_path: Path) -> None:
    """A second run into a folder is refused, and so is a folder of other things; a run killed at once begins anew."""
    RunFolder.create(tmp_path / "run", SPEC, SUITE)
    with pytest.raises(RunError, match=r"already holds a run\. Add --resume"):
        RunFolder.create(tmp_path / "run", SPEC, SUITE)
    (tmp_path / "begun/episodes").mkdir(parents=True)
    RunFolder.create(tmp_path / "begun", SPEC, SUITE)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/photo.png").touch()
    with pytest.raises(RunError, match="is no run folder"):
        RunFolder.create(tmp_path / "other", SPEC, SUITE)


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    """While one run holds the folder a second one is told which process does."""
    with RunFolder.create(tmp_path / "run", SPEC, SUITE), pytest.raises(RunError, match=r"in use by process \d+"):
        RunFolder.resume(tmp_path / "run", SPEC).__enter__()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("policy", "q"),
        ("suite_version", "2-groups0.4"),
        ("suite_hash", "0"),
        ("versions", {"numpy": "1"}),
        ("counterfactual", True),
    ],
)
def test_resuming_with_something_else_is_refused(tmp_path: Path, field: str, value: object) -> None:
    """Another policy, suite or version would mix two runs: the difference is named."""
    RunFolder.create(tmp_path / "run", SPEC, SUITE)
    other = msgspec.structs.replace(SPEC, **{field: value})
    with pytest.raises(RunError, match=f"is of another run: its {field} is"):
        RunFolder.resume(tmp_path / "run", other)


def test_an_episode_whose_row_was_lost_to_a_kill_is_taken_in(tmp_path: Path) -> None:
    """A record on disk without a row counts as finished when the run is resumed; one with a row stays as it was."""
    folder = RunFolder.create(tmp_path / "run", SPEC, SUITE)
    with folder:
        folder.add(record("s-0", success=1.0))
        for name in ("s-0", "s-1"):
            folder.episode_folder(name).mkdir(parents=True)
            record(name, success=0.0).save(folder.episode_folder(name) / "record.json")
    with RunFolder.resume(tmp_path / "run", SPEC) as again:
        assert again.finished() == {"s-0", "s-1"}
    values = {r.scenario: r.measures["success"] for r in read_records(tmp_path / "run")}
    assert values == {"s-0": 1.0, "s-1": 0.0}


def test_a_crashed_episode_counts_as_a_failure(tmp_path: Path) -> None:
    """Crashed episodes stay in the mean of SR and RC as 0, and are absent where they have no value."""
    crashed = msgspec.structs.replace(record("s-1", status="crashed"), measures={}, reason="boom")
    table = table_of([record("s-0"), crashed])
    summary = summary_of(table)
    assert summary.loc["success", "mean"] == 0.5
    assert summary.loc["success", "n"] == 2
    assert summary.loc["velocity_mean_mps", "n"] == 0


def test_a_folder_without_a_run_is_named(tmp_path: Path) -> None:
    """What is no run folder is answered with the runs that lie beside it."""
    RunFolder.create(tmp_path / "mine", SPEC, SUITE)
    with pytest.raises(UsageError, match=r"unknown run .*other'\. Valid choices: mine"):
        read_records(tmp_path / "other")


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"scenario": 3}', b"\x80\x04pickle"], ids=["empty", "cut short", "of numbers", "pickled"]
)
def test_a_damaged_record_is_named(tmp_path: Path, content: bytes) -> None:
    """A record that is cut off or of another kind is refused with its path."""
    path = tmp_path / "record.json"
    path.write_bytes(content)
    with pytest.raises(RunError, match=r"record\.json: not an episode record"):
        Record.load(path)


def test_a_log_survives_the_disk(tmp_path: Path) -> None:
    """A saved trajectory reads back the same; a broken file is named."""
    arrays = {
        "pose": np.ones((2, 3)),
        "speed": np.ones((2, 2)),
        "command": np.ones((2, 2)),
        "people_xy": np.ones((1, 2)),
        "event_tracks": np.ones((1, 5)),
    }
    names = ("route_s_m", "travelled_m", "person_m", "reset_s_m", "waits_at_red", "on_carriageway", "vehicles_braked")
    vectors = {name: np.ones(2) for name in names}
    log = Log(
        tick_s=0.05,
        people_tick=np.ones(1, int),
        people_event=np.ones(1, bool),
        people_resident=np.ones(1, bool),
        **arrays,
        **vectors,
    )  # type: ignore[arg-type]
    log.save(tmp_path / "t.npz")
    again = Log.load(tmp_path / "t.npz")
    assert again.tick_s == 0.05 and np.array_equal(again.pose, log.pose)
    (tmp_path / "broken.npz").write_bytes((tmp_path / "t.npz").read_bytes()[:100])
    with pytest.raises(RunError, match=r"broken\.npz: not a trajectory"):
        Log.load(tmp_path / "broken.npz")

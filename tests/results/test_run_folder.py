"""Run folders: rows, locks, resuming, and damage."""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from cosim.core.errors import MachineError, RunError, UsageError
from cosim.results.log import COLUMNS, Log
from cosim.results.metrics import METRICS
from cosim.results.record import Record, ScanLook
from cosim.results.run_folder import RunFolder, read_records, read_spec, record_difference
from cosim.results.run_setup import RunSetup
from cosim.results.run_spec import RUN_FILE, Shard, decode_spec
from cosim.results.table import summary_of, table_of, table_row
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import WaypointRule
from cosim.spec.scenario import City, Scenario, Suite
from tests.conftest import Cosim
from tests.logs import log_with
from tests.run_specs import changed, spec_of
from tests.support.driven_runs import driven


def scenario(name: str) -> Scenario:
    return Scenario(
        id=name,
        suite="s",
        place=City(seed=0),
        seed=0,
        start=(0.0, 0.0, 0.0),
        goal=(9.0, 0.0),
        route=((0.0, 0.0), (9.0, 0.0)),
    )


SUITE = Suite(name="s", version="1", scenarios=tuple(scenario(f"s-{i}") for i in range(3)))
SPEC = spec_of(SUITE)


def record(name: str, *, success: float = 1.0, status: str = "done", wall_s: float = 1.0) -> Record:
    measures: dict[str, float | None] = dict.fromkeys(METRICS, None) | {"success": success}
    return msgspec.structs.replace(
        Record.begun(scenario(name), SPEC.manifest, SPEC.setup),
        status=status,
        ended="goal" if status == "done" else None,
        ticks=3,
        state_hash="abc",
        measures=measures,
        clock={"wall_s": wall_s},
    )  # type: ignore[arg-type]


LOG = driven(SUITE.scenarios[0], [1.0] * 3).encoded()
"""A log of three ticks, as in `record`."""


def write_files_of(folder: RunFolder, episode_record: Record, under: str = "") -> None:
    """Write the files of an episode without a row; `under` is the folder of another scenario."""
    place = folder.episode_folder(under or episode_record.scenario.id)
    place.mkdir(parents=True, exist_ok=True)
    (place / "trajectory.npz").write_bytes(LOG)
    episode_record.save(place / "record.json")


def test_the_table_does_not_depend_on_the_order_in_which_episodes_end(tmp_path: Path) -> None:
    """Rows are sorted by scenario without wall times, so that two runs give the same bytes."""
    for name, order in (("a", (0, 1, 2)), ("b", (2, 0, 1))):
        with RunFolder.create(tmp_path / name, SPEC, SUITE) as folder:
            for i in order:
                folder.add_row(record(f"s-{i}", wall_s=float(np.random.default_rng().random())))
            folder.finish()
    assert (tmp_path / "a/results.csv").read_bytes() == (tmp_path / "b/results.csv").read_bytes()


def test_a_folder_that_holds_a_run_is_not_overwritten(tmp_path: Path) -> None:
    """A second run and a folder of other files are refused, and a run that was killed at once
    starts again."""
    with RunFolder.create(tmp_path / "run", SPEC, SUITE):
        pass
    with pytest.raises(RunError, match=r"already holds a run\. Add --resume"):
        RunFolder.create(tmp_path / "run", SPEC, SUITE)
    (tmp_path / "begun/episodes").mkdir(parents=True)
    (tmp_path / "begun/lock").touch()
    with RunFolder.create(tmp_path / "begun", SPEC, SUITE) as folder:
        assert folder.finished_ids() == set()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/photo.png").touch()
    with pytest.raises(RunError, match="is no run folder"):
        RunFolder.create(tmp_path / "other", SPEC, SUITE)


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    """The refusal names the process of the run that holds the folder."""
    with (
        RunFolder.create(tmp_path / "run", SPEC, SUITE),
        pytest.raises(RunError, match=r"in use by process \d+"),
    ):
        RunFolder.resume(tmp_path / "run", SPEC).__enter__()


def test_a_folder_is_locked_before_it_is_written(tmp_path: Path) -> None:
    """Of two runs that find the same folder empty at once, the second writes nothing."""
    mine, other = (
        msgspec.structs.replace(SPEC, policy="p"),
        msgspec.structs.replace(SPEC, policy="q"),
    )
    first, second = (RunFolder.create(tmp_path / "run", spec, SUITE) for spec in (mine, other))
    with first, pytest.raises(RunError, match=r"in use by process \d+"):
        second.__enter__()
    with pytest.raises(RunError, match="already holds a run"):
        second.__enter__()
    assert read_spec(tmp_path / "run") == mine
    with RunFolder.resume(tmp_path / "run", mine):
        pass


def test_a_run_folder_stays_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A relative path means the folder it meant when the run began, wherever the process goes."""
    monkeypatch.chdir(tmp_path)
    with RunFolder.create(Path("run"), SPEC, SUITE) as folder:
        monkeypatch.chdir("/")
        folder.add_row(record("s-0"))
        assert (
            folder.finished_ids() == {"s-0"}
            and folder.episode_folder("s-0") == tmp_path / "run/episodes/s-0"
        )


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("policy", "q"),
        ("suite_version", "2-groups0.4"),
        ("suite_hash", "0"),
        ("renderer", "other"),
        ("versions", {"numpy": "1"}),
        ("counterfactual", True),
        ("waypoints", WaypointRule(rule="atan2")),
        ("seed", 8),
        ("camera", CameraSpec(512, 288)),
        ("rate_hz", 5.0),
        ("cameras", {"left": CameraSpec(mount="left")}),
        ("goal_protocol", "route_point"),
        ("odometry", "gps"),
    ],
)
def test_resuming_with_other_settings_is_refused(tmp_path: Path, field: str, value: object) -> None:
    """Another policy, suite or version would mix two runs, so the difference is named."""
    with RunFolder.create(tmp_path / "run", SPEC, SUITE):
        pass
    other = changed(SPEC, **{field: value})
    with pytest.raises(RunError, match=f"is of another run: its {field} is"):
        RunFolder.resume(tmp_path / "run", other)


def test_a_changed_camera_is_described(tmp_path: Path) -> None:
    """The description has mount, size, field of view and crop of both."""
    spec = changed(SPEC, camera=CameraSpec(512, 288, 60.0))
    with RunFolder.create(tmp_path / "run", spec, SUITE):
        pass
    other = changed(SPEC, camera=CameraSpec(512, 288, 60.0, "mast", crop=(0, 88, 512, 288)))
    with pytest.raises(RunError) as caught:
        RunFolder.resume(tmp_path / "run", other)
    assert (
        "its camera is front, 512 x 288 px, 60 deg, and this command has mast, 512 x 288 px, 60 deg, "
        "crop 0 88 512 288. Resume with the same command"
    ) in str(caught.value)
    with RunFolder.resume(tmp_path / "run", spec) as again:
        assert again.spec.manifest.camera == spec.manifest.camera


def test_every_row_has_the_waypoint_rule(tmp_path: Path) -> None:
    """The rule comes from the record."""
    scaled = changed(record("s-0"), waypoints=WaypointRule(index=4, unit_m=0.25))
    scaled.save(tmp_path / "record.json")
    saved = Record.load(tmp_path / "record.json")
    assert saved.manifest.waypoints == WaypointRule(index=4, unit_m=0.25)
    assert table_row(saved)["waypoints"] == "waypoint 4, units of 0.25 m, in 0.25 s, shipped"


def test_resuming_with_an_edited_policy_is_refused(tmp_path: Path) -> None:
    """The policy is named, also when its version is unchanged."""
    spec = changed(SPEC, policy_source="1111")
    with RunFolder.create(tmp_path / "run", spec, SUITE):
        pass
    with pytest.raises(
        RunError, match="is of another run: the source of policy 'p' was edited since it began"
    ):
        RunFolder.resume(tmp_path / "run", changed(SPEC, policy_source="2222"))
    with RunFolder.resume(tmp_path / "run", spec):
        pass


def garbage(database: Path) -> None:
    database.write_bytes(b"nothing that sqlite wrote" * 1000)


def cut_off(database: Path) -> None:
    database.write_bytes(database.read_bytes()[:5000])


def overwritten(database: Path) -> None:
    body = bytearray(database.read_bytes())
    body[4096:8192] = b"\xff" * 4096
    database.write_bytes(bytes(body))


def another_table(database: Path) -> None:
    database.unlink()
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("create table episodes (name text)")


def odd_rows(database: Path) -> None:
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("update episodes set record = '{'")


def deep_rows(path: Path) -> None:
    deep = '{"unknown": ' + "[" * 100_000 + "]" * 100_000 + "}"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("update episodes set record = ?", (deep,))


def null_rows(database: Path) -> None:
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("update episodes set record = null")


DAMAGES = {
    damage.__name__: damage
    for damage in (garbage, cut_off, overwritten, another_table, odd_rows, null_rows, deep_rows)
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_database_is_rebuilt_from_the_records(tmp_path: Path, name: str) -> None:
    """After any damage to results.sqlite, showing it gives the remedy, and resuming finds every
    record."""
    with RunFolder.create(tmp_path / "run", SPEC, SUITE) as folder:
        for i in (2, 0):
            folder.write_episode(record(f"s-{i}"), LOG)
            os.utime(folder.episode_folder(f"s-{i}") / "record.json", (0, 10 - i))
    DAMAGES[name](tmp_path / "run/results.sqlite")
    with pytest.raises(RunError, match=r"results\.sqlite is damaged .*--resume, which builds it"):
        read_records(tmp_path / "run")
    with RunFolder.resume(tmp_path / "run", SPEC) as again:
        assert again.finished_ids() == {"s-0", "s-2"}
        (note,) = again.notes
        assert "results.sqlite was damaged (" in note and "built again from 2 records" in note
    assert [r.scenario.id for r in read_records(tmp_path / "run")] == ["s-2", "s-0"]
    assert (tmp_path / "run/results.sqlite.damaged").exists()


def test_a_database_of_an_earlier_version_is_read_and_added_to(tmp_path: Path) -> None:
    """Its column `row`, which held the table's row of each record, is no longer read."""
    with RunFolder.create(tmp_path / "run", SPEC, SUITE) as folder:
        folder.write_episode(record("s-0"), LOG)
    with closing(sqlite3.connect(tmp_path / "run/results.sqlite")) as database, database:
        database.execute("alter table episodes rename to new")
        database.execute("create table episodes (scenario text primary key, row text, record text)")
        database.execute("insert into episodes select scenario, '{}', record from new")
        database.execute("drop table new")
    with RunFolder.resume(tmp_path / "run", SPEC) as again:
        again.write_episode(record("s-1"), LOG)
        assert again.notes == [] and [*again.finish()["scenario"]] == ["s-0", "s-1"]


def test_run_json_and_record_json_are_flat_and_tolerate_missing_keys(
    tmp_path: Path,
) -> None:
    """Facts are top-level keys and read back unchanged, also from an earlier version's file."""
    spec = changed(
        SPEC,
        camera=CameraSpec(64, 48),
        goal_protocol="route_point",
        latency_ms=50.0,
        shard=Shard(1, 2),
    )
    with RunFolder.create(tmp_path / "run", spec, SUITE) as folder:
        folder.write_episode(
            msgspec.structs.replace(record("s-0"), setup=spec.setup, manifest=spec.manifest), LOG
        )
    path = tmp_path / "run/episodes/s-0/record.json"
    files = [json.loads((tmp_path / "run/run.json").read_text()), json.loads(path.read_text())]
    assert read_spec(tmp_path / "run") == spec and Record.load(path).setup == spec.setup
    for file in files:
        assert (
            not file.keys() & {"setup", "manifest"}
            and file["camera"]["width"] == 64
            and file["latency_ms"] == 50.0
        )
    assert set(RunSetup.__struct_fields__) <= files[0].keys()
    assert (files[0]["seed"], files[0]["policy"], files[0]["policy_name"], files[1]["policy"]) == (
        0,
        "p",
        "p",
        "p",
    )
    later = {
        "camera",
        "cameras",
        "latency_ms",
        "real_time",
        "policy_runs",
        "odometry",
        "waypoints",
        "metric_schema",
    }
    (tmp_path / "run/run.json").write_text(
        json.dumps({key: files[0][key] for key in files[0].keys() - later})
    )
    path.write_text(json.dumps({key: files[1][key] for key in files[1].keys() - later}))
    old = Record.load(path)
    assert read_spec(tmp_path / "run").manifest.camera is old.manifest.camera is None
    assert (old.setup.latency_ms, old.setup.metric_schema, old.scenario) == (
        0.0,
        0,
        record("s-0").scenario,
    )
    path.write_text(json.dumps(files[1] | {"suite_hash": 5}))
    with pytest.raises(
        RunError,
        match=r"record\.json: not an episode record: Expected `str`, got `int` - at `\$\.suite_h",
    ):
        Record.load(path)


def test_a_database_without_its_write_ahead_log_is_rebuilt(tmp_path: Path) -> None:
    """When a killed run's write-ahead log, or everything, is deleted, the records count."""
    for lost in ("results.sqlite-wal", "results.sqlite"):
        path = tmp_path / lost
        code = (
            "import os, sys; from pathlib import Path; sys.path.insert(0, sys.argv[2]);from "
            "test_run_folder import *; held = RunFolder.create(Path(sys.argv[1]), SPEC, "
            "SUITE).__enter__();keep = sqlite3.connect(held.path / 'results.sqlite'); "
            "keep.execute('select * from episodes').fetchall();held.write_episode(record('s-1'), LOG); "
            "os.kill(os.getpid(), 9)"
        )
        killed = subprocess.run(
            [sys.executable, "-c", code, str(path), str(Path(__file__).parent)], check=False
        )
        assert killed.returncode == -9 and (path / "results.sqlite-wal").stat().st_size > 0
        (path / lost).unlink()
        with RunFolder.resume(path, SPEC) as again:
            assert again.finished_ids() == {"s-1"}
        assert [r.scenario.id for r in read_records(path)] == ["s-1"]


def _overwrite_database(run: Path) -> None:
    (run / "results.sqlite").write_bytes(b"no database" * 1000)


def _delete_database(run: Path) -> None:
    for path in run.glob("results.sqlite*"):
        path.unlink()


def _take_its_place(run: Path) -> None:
    run.rename(run.with_name("moved"))
    (run / "logs").mkdir(parents=True)
    (run / "logs" / "new.log").touch()


def _forge(run: Path) -> None:
    with sqlite3.connect(run / "results.sqlite") as database:
        database.execute("update episodes set record = replace(record, 'done', 'crashed')")
    (run / "episodes/s-0/record.json").write_text("{}")


HARM = {
    "overwritten-database": _overwrite_database,
    "deleted-database": _delete_database,
    "deleted": shutil.rmtree,
    "renamed": lambda run: run.rename(run.with_name("moved")),
    "renamed-and-replaced": _take_its_place,
    "forged": _forge,
}


@pytest.mark.parametrize("damage", HARM)
def test_a_run_folder_that_is_damaged_during_a_run_loses_no_row(
    tmp_path: Path, damage: str
) -> None:
    """Rows, records and spec are written again, and the run can be resumed."""
    run = tmp_path / "run"
    with RunFolder.create(run, SPEC, SUITE) as folder:
        folder.write_episode(record("s-0"), LOG)
        HARM[damage](run)
        folder.write_episode(record("s-1"), LOG)
        HARM[damage](run)
        assert folder.finish()["scenario"].tolist() == ["s-0", "s-1"]
    assert {one.scenario.id: one for one in read_records(run)} == {
        name: record(name) for name in ("s-0", "s-1")
    }
    assert Record.load(run / "episodes/s-0/record.json") == record("s-0")
    assert not (tmp_path / "moved").exists()
    with RunFolder.resume(run, SPEC) as again:
        assert again.finished_ids() >= ({"s-0", "s-1"} if damage != "deleted" else set())


def test_records_without_a_database_are_reported_with_the_remedy(tmp_path: Path) -> None:
    """`show` does not print an empty table."""
    with RunFolder.create(tmp_path / "run", SPEC, SUITE) as folder:
        folder.episode_folder("s-0").mkdir()
        record("s-0").save(folder.episode_folder("s-0") / "record.json")
    (tmp_path / "run/results.sqlite").unlink()
    with pytest.raises(RunError, match=r"results\.sqlite is gone: .*--resume"):
        read_records(tmp_path / "run")


def test_a_damaged_record_is_run_again(tmp_path: Path) -> None:
    """A broken record and one of another scenario do not count as finished, and are named."""
    with RunFolder.create(tmp_path / "run", SPEC, SUITE) as folder:
        for i in range(3):
            folder.episode_folder(f"s-{i}").mkdir()
        (folder.episode_folder("s-0") / "record.json").write_text("{")
        write_files_of(folder, record("s-2"), "s-1")
        write_files_of(folder, record("s-2"))
    with RunFolder.resume(tmp_path / "run", SPEC) as again:
        assert again.finished_ids() == {"s-2"}
        assert len(again.notes) == 2 and all(
            note.endswith("This episode is run again.") for note in again.notes
        )


def test_a_new_attempt_starts_with_an_empty_folder(tmp_path: Path) -> None:
    """The trajectory of a run killed before its record is removed."""
    with RunFolder.create(tmp_path / "run", SPEC, SUITE) as folder:
        folder.write_frame("s-0", 4, b"png")
        for name in ("trajectory.npz", "trajectory.npz.part", "record.json.part"):
            (folder.episode_folder("s-0") / name).write_bytes(b"of the first attempt")
    with RunFolder.resume(tmp_path / "run", SPEC) as again:
        again.delete_episode("s-0")
        again.write_episode(record("s-0", status="crashed"))
        assert [path.name for path in again.episode_folder("s-0").iterdir()] == ["record.json"]


def test_an_episode_whose_row_was_lost_is_recovered_on_resume(tmp_path: Path) -> None:
    """A record without a row counts as finished, and a record that contradicts its row does not."""
    folder = RunFolder.create(tmp_path / "run", SPEC, SUITE)
    with folder:
        folder.add_row(record("s-0", success=1.0))
        for name in ("s-0", "s-1"):
            write_files_of(folder, record(name, success=0.0))
    with RunFolder.resume(tmp_path / "run", SPEC) as again:
        assert (
            again.finished_ids() == {"s-1"}
            and "not what results.sqlite has of this episode" in again.notes[0]
        )
    assert {r.scenario.id: r.measures["success"] for r in read_records(tmp_path / "run")} == {
        "s-1": 0.0
    }


def test_a_crashed_episode_counts_as_a_failure(tmp_path: Path) -> None:
    """Crashes count as 0 in SR, RC, SPL and V, and make every other mean with a direction unknown."""
    crashed = msgspec.structs.replace(record("s-1", status="crashed"), measures={}, reason="boom")
    table = table_of([record("s-0"), crashed])
    summary = summary_of(table)
    assert summary.loc["success", "mean"] == 0.5
    assert summary.loc["success", "n"] == 2
    assert summary.loc["velocity_mean_mps", "mean"] == 0.0
    assert table.loc[1, ["pedestrian_collision", "other_collision", "left_lane"]].isna().all()
    assert not summary.loc[["pedestrian_collision", "stalled_time_s"], "n"].any()


def test_a_folder_without_a_run_is_named(tmp_path: Path) -> None:
    """The message lists what it lacks and the runs in and beside it; for a file it says what a run
    is."""
    for name in ("mine", "runs/theirs"):
        with RunFolder.create(tmp_path / name, SPEC, SUITE):
            pass
    (tmp_path / "file").touch()
    for name, expected in (
        ("other", "unknown run '{run}'. Valid choices: {beside}/mine. Did you mean"),
        (
            "runs",
            "{run} is no run folder: it holds no run.json. Runs in it and next to it: "
            "{beside}/mine, {run}/theirs",
        ),
        ("file", "{run} is no run folder: a file is there, and a run is a folder with run.json"),
    ):
        with pytest.raises(
            UsageError, match=re.escape(expected.format(run=tmp_path / name, beside=tmp_path))
        ):
            read_records(tmp_path / name)


@pytest.mark.parametrize("below", ["run", "runs/run"])
def test_a_run_path_through_a_file_is_refused_with_an_alternative(
    tmp_path: Path, below: str
) -> None:
    """That file is named, and a place beside it."""
    (tmp_path / "file").touch()
    path = tmp_path / "file" / below
    expected = (
        f"{path}: cannot be written: {tmp_path / 'file'} is a file, no folder: choose a path "
        f"next to it, like "
    )
    with pytest.raises(MachineError, match=re.escape(f"{expected}{tmp_path / below}")):
        RunFolder.create(path, SPEC, SUITE).__enter__()


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b'{"scenario": 3}', b"\x80\x04pickle"],
    ids=["empty", "cut short", "of numbers", "pickled"],
)
def test_a_damaged_record_is_named(tmp_path: Path, content: bytes) -> None:
    """A record that is cut off or of another kind is refused with its path."""
    path = tmp_path / "record.json"
    path.write_bytes(content)
    with pytest.raises(RunError, match=r"record\.json: not an episode record"):
        Record.load(path)


def test_a_saved_trajectory_reads_back_the_same(tmp_path: Path) -> None:
    """A broken file is named."""
    log = log_with(2, pose=np.ones((2, 3)), event_tracks=np.ones((1, 5)))
    (tmp_path / "t.npz").write_bytes(log.encoded())
    again = Log.load(tmp_path / "t.npz")
    assert again.tick_s == 0.05 and all(
        np.array_equal(getattr(again, name), getattr(log, name)) for name in COLUMNS
    )
    (tmp_path / "broken.npz").write_bytes((tmp_path / "t.npz").read_bytes()[:100])
    with pytest.raises(RunError, match=r"broken\.npz: not a trajectory"):
        Log.load(tmp_path / "broken.npz")


def test_a_crashed_episode_has_no_picture(tmp_path: Path, cosim: Cosim) -> None:
    """`cosim show` refuses the picture with the reason, and without one prints the episode's
    outcome."""
    with RunFolder.create(tmp_path / "run", SPEC, SUITE) as held:
        held.write_episode(record("s-0", status="crashed"))
    result = cosim("show", "run", "--episode", "s-0", "-o", "above.png", cwd=tmp_path)
    assert (
        result.returncode == 2
        and "episode 's-0' is crashed: it has no track to draw" in result.stderr
    )
    assert not (tmp_path / "above.png").exists()
    assert cosim("show", "run", "--episode", "s-0", cwd=tmp_path).returncode == 0


def test_records_differ_if_only_one_has_a_scan() -> None:
    """The difference is described in both orders."""
    plain = record("s-0")
    scanned = msgspec.structs.replace(plain, scan=ScanLook(appearance="splats"))
    assert record_difference(plain, scanned).startswith("scan is None, there {'appearance'")
    assert record_difference(scanned, plain).endswith("there None")


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        (
            {"camera": CameraSpec(width=-1)},
            "camera must have sides of 1 to 4096 pixels, not -1 x 96",
        ),
        ({"rate_hz": -1.0}, "rate_hz must be a positive number, not -1.0"),
    ],
    ids=["width", "rate"],
)
def test_recorded_cameras_and_rates_are_in_range(values: dict[str, Any], fault: str) -> None:
    """A record or a run file with a camera or a rate out of range is refused with the value."""
    with pytest.raises(RunError, match=re.escape(fault)):
        Record.decoded(changed(record("s-0"), **values).encoded(), Path("record.json"))
    with pytest.raises(msgspec.ValidationError, match=re.escape(fault)):
        decode_spec(RUN_FILE.encode(changed(SPEC, **values)), Path("run.json"))

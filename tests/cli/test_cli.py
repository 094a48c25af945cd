"""The command line as a user runs it: real engines, real processes, real signals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pandas as pd
import pytest

from cosim import run
from cosim.core.files import write_atomic
from cosim.place.walk_graph import WalkGraph
from cosim.spec.episode_id import episode_id_of
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import ROBOTS
from cosim.spec.scenario import City, CrowdSpec, Scenario, Suite, read_suite, write_suite
from tests.conftest import PATIENCE_S, WIDE, Cosim, seed_in_order, wait_until

pytestmark = pytest.mark.engine

POLICIES = """
import json, os, signal, time
from pathlib import Path
import numpy as np
from cosim.spec.manifest import Manifest
from cosim.core.state import Command

class Base:
    manifest = Manifest("base", camera=None)
    def reset(self, episode_id, seed):
        self.scenario, self.count = json.loads(Path("names.json").read_text())[episode_id], 0
    def act(self, observation):
        self.count += 1
        return Command(1.0, 0.0)

class Held(Base):
    # waits before a scenario while the file hold-SCENARIO exists
    def reset(self, episode_id, seed):
        super().reset(episode_id, seed)
        hold = Path(f"hold-{self.scenario}")
        if hold.exists():
            hold.with_name("waits").touch()
        while hold.exists():
            time.sleep(0.02)
class Unfinished: pass
"""


DRIVES = "schedule:sprint-1.6"
"""A policy without a camera, whose processes start fast."""
SEED = "2"
"""A seed with which runs keep the order of the suites."""


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder: a suite of three short scenarios, one of four, and a module with
    policies."""
    from scenarios.places.nets import place
    from scenarios.suites.long_horizon import build_long_horizon

    folder = tmp_path_factory.mktemp("workspace")
    city = City(seed=1, size_m=500.0)
    _, street_map = place(city)
    graph = WalkGraph(street_map)
    scenarios = []
    for i in range(4):
        long_way = build_long_horizon(city, street_map, graph, i, f"t-{i}")
        fields = {name: getattr(long_way, name) for name in Scenario.__struct_fields__}
        crowd = CrowdSpec(persons=8, radius_m=50.0, vehicles=2)
        scenarios.append(Scenario(**fields | {"crowd": crowd, "time_limit_s": 1.0}))
    for name, count in (("tiny", 3), ("four", 4)):
        write_suite(
            Suite(name=name, version="1", scenarios=tuple(scenarios[:count])),
            folder / f"{name}.json",
        )
    assert seed_in_order(scenarios) == int(SEED)
    names = {episode_id_of(int(SEED), scenario).episode: scenario.id for scenario in scenarios}
    (folder / "names.json").write_text(json.dumps(names))
    (folder / "mine.py").write_text(POLICIES)
    return folder


def rows(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "results.csv", index_col="scenario")


def hashes(folder: Path) -> dict[str, str]:
    return {
        p.parent.name: json.loads(p.read_text())["state_hash"]
        for p in folder.glob("episodes/*/record.json")
    }


@contextmanager
def running(workspace: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """A run in progress, which is killed at the end of the block."""
    command = [sys.executable, "-m", "cosim", "run", *words]
    run = subprocess.Popen(
        command,
        cwd=workspace,
        env=os.environ | WIDE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=accept_interrupts,
    )
    try:
        yield run
    finally:
        run.kill()
        run.communicate()


@contextmanager
def waits_before(workspace: Path, scenario: str) -> Iterator[Callable[[], bool]]:
    """Return whether the policy Held is already waiting before this scenario."""
    hold = workspace / f"hold-{scenario}"
    waits = workspace / "waits"
    hold.touch()
    try:
        yield waits.exists
    finally:
        hold.unlink()
        waits.unlink(missing_ok=True)


@pytest.fixture(scope="module")
def whole_run(workspace: Path, cosim: Cosim) -> Path:
    """The tiny suite, run without interruption by one process."""
    done = cosim(
        "run",
        "tiny.json",
        "--policy",
        DRIVES,
        "--seed",
        SEED,
        "--out",
        "whole",
        cwd=workspace,
    )
    assert done.returncode == 0, done.stderr
    return workspace / "whole"


HELD = ("tiny.json", "--policy", "mine:Held", "--episodes", "2", "--seed", SEED, "--out")


@pytest.fixture(scope="module")
def uninterrupted_table(workspace: Path, cosim: Cosim) -> bytes:
    """The table of an uninterrupted run of two episodes."""
    done = cosim("run", *HELD, "unbroken", cwd=workspace)
    assert done.returncode == 0, done.stderr
    return (workspace / "unbroken/results.csv").read_bytes()


def test_a_run_prints_its_table_and_leaves_its_folder(
    workspace: Path, cosim: Cosim, whole_run: Path
) -> None:
    """The folder has rows, records, trajectories and specs; `show` prints the table again, and
    `score` recomputes it."""
    table = rows(whole_run)
    assert list(table.index) == ["t-0", "t-1", "t-2"]
    assert set(table["status"]) == {"done"}
    assert set(table["renderer"]) == {json.loads((whole_run / "run.json").read_text())["renderer"]}
    for name in table.index:
        assert (whole_run / "episodes" / name / "trajectory.npz").exists()
    shown = cosim("show", "whole", cwd=workspace)
    assert (
        shown.returncode == 0
        and "t-2" in shown.stdout
        and "scheduled 3, scored 3, of these crashed 0" in shown.stdout
    )
    other = cosim(
        "run",
        "tiny.json",
        "--policy",
        DRIVES,
        "--episodes",
        "2",
        "--out",
        "whole",
        "--resume",
        cwd=workspace,
    )
    assert (
        other.returncode == 2
        and "is 3 of 3 (all), and this command has 2 of 3 (--episodes 2)." in other.stderr
    )
    again = cosim("score", "whole", cwd=workspace)
    assert (
        again.returncode == 0
        and "3 episodes" in again.stdout
        and "equal to the bit" in again.stdout
    )
    result = cosim("show", "whole", "--episode", "t-0", "-o", "above.png", cwd=workspace)
    assert result.returncode == 0, result.stderr
    assert (workspace / "above.png").stat().st_size > 5000


def test_the_same_run_gives_the_same_bits_on_any_number_of_processes(
    workspace: Path, cosim: Cosim, whole_run: Path
) -> None:
    """State hashes and rows are identical for one process and for two."""
    words = (
        "run",
        "tiny.json",
        "--policy",
        DRIVES,
        "--jobs",
        "2",
        "--seed",
        SEED,
        "--out",
        "two",
    )
    two = cosim(*words, cwd=workspace)
    assert two.returncode == 0
    assert (
        "\n3 episodes, " in two.stderr and f"episodes of '{DRIVES}' on this machine" in two.stderr
    )
    assert ": done, 3 of 3\n" in two.stderr
    assert hashes(workspace / "two") == hashes(whole_run)
    assert all(len(h) == 32 for h in hashes(whole_run).values())
    assert len(set(hashes(whole_run).values())) == 3
    assert (workspace / "two/results.csv").read_bytes() == (whole_run / "results.csv").read_bytes()


def test_merged_shards_equal_the_run(workspace: Path, cosim: Cosim, whole_run: Path) -> None:
    """Three episodes in two shards, one run from Python, merge to the same run; each shard says how
    to merge it."""
    words = ("run", "tiny.json", "--policy", DRIVES, "--seed", SEED)
    result = cosim(*words, "--shard", "1/2", "--out", "shard-1", cwd=workspace)
    assert result.returncode == 0 and "Shard 1/2 of the run: `cosim merge`" in result.stderr
    options = EpisodeOptions(seed=int(SEED))
    run(
        str(workspace / "tiny.json"),
        DRIVES,
        shard="2/2",
        out=workspace / "shard-2",
        options=options,
    )
    assert [*hashes(workspace / "shard-2")] == ["t-1"]
    assert cosim("merge", "shard-1", "shard-2", "--out", "merged", cwd=workspace).returncode == 0
    assert (workspace / "merged/results.csv").read_bytes() == (
        whole_run / "results.csv"
    ).read_bytes()
    assert (workspace / "merged/run.json").read_bytes() == (whole_run / "run.json").read_bytes()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=lambda how: how.name)
def test_an_interrupted_run_is_finished_by_resume(
    workspace: Path, cosim: Cosim, uninterrupted_table: bytes, how: signal.Signals
) -> None:
    """Killed or stopped in the middle, then resumed: no episode is run twice or lost, and the table
    is the same."""
    out = workspace / f"broken-{how.name}"
    with waits_before(workspace, "t-1") as waits, running(workspace, *HELD, out.name) as run:
        wait_until(waits)
        run.send_signal(how)
        stderr = run.communicate(timeout=PATIENCE_S)[1]
        if how != signal.SIGKILL:
            assert run.returncode == 130 and reports_stop(stderr, out.name), stderr
        written_ns = (out / "episodes/t-0/record.json").stat().st_mtime_ns
        wait_until(lambda: not alive(out))
    again = cosim("run", *HELD, out.name, "--resume", cwd=workspace)
    assert again.returncode == 0, again.stderr
    assert (out / "episodes/t-0/record.json").stat().st_mtime_ns == written_ns
    assert (out / "results.csv").read_bytes() == uninterrupted_table


def test_sigterm_stops_a_run_as_ctrl_c_does(workspace: Path, cosim: Cosim) -> None:
    """SIGTERM gives the same exit code and message, and no environment process is left."""
    out = workspace / "terminated"
    with waits_before(workspace, "t-1") as waits, ThreadPoolExecutor(1) as threads:

        def terminate() -> None:
            wait_until(waits)
            os.kill(os.getpid(), signal.SIGTERM)

        sent = threads.submit(terminate)
        result = cosim("run", *HELD, out.name, cwd=workspace)
        sent.result()
        assert result.returncode == 130 and reports_stop(result.stderr, out.name), result
        wait_until(lambda: not alive(out))


def reports_stop(stderr: str, out: str) -> bool:
    """Return whether the output says that a run stopped in its second episode, and the remedy."""
    return f"--out {out} --resume" in stderr and "1 of 2 episodes are finished and stored" in stderr


def test_a_run_killed_at_its_start_leaves_no_false_crash(
    workspace: Path, cosim: Cosim, uninterrupted_table: bytes
) -> None:
    """A kill during the start of the first environment process, or before its first answer, loses
    nothing on resume."""
    out = workspace / "killed-at-its-start"
    for when in ("its process starts", "its first episode starts"):
        more = ["--resume"] if out.exists() else []
        with (
            waits_before(workspace, "t-0") as waits,
            running(workspace, *HELD, out.name, *more) as run,
        ):
            wait_until(lambda: children(run.pid))
            left = children(run.pid)
            if when == "its first episode starts":
                wait_until(waits)
            run.kill()
            for pid in left:
                wait_until(lambda pid=pid: not Path(f"/proc/{pid}").exists())
        assert not list(out.glob("episodes/*/record.json")), when
    again = cosim("run", *HELD, out.name, "--resume", cwd=workspace)
    assert again.returncode == 0, again.stderr
    assert (out / "results.csv").read_bytes() == uninterrupted_table


def accept_interrupts() -> None:
    """Restore Ctrl-C, which background jobs of a shell ignore and a user's run does not."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def children(pid: int) -> list[int]:
    """Environment processes of a run."""
    task = Path(f"/proc/{pid}/task/{pid}/children")
    pids = [int(word) for word in task.read_text().split()] if task.exists() else []
    lines = {p: Path(f"/proc/{p}/cmdline") for p in pids}
    return [
        p
        for p, line in lines.items()
        if line.exists() and b"scenarios.ipc.supervisor" in line.read_bytes()
    ]


def test_a_full_disk_ends_the_run_with_the_reason(
    workspace: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When a record cannot be written, the run stops, gives the reason, and leaves finished
    episodes intact."""
    from cosim.results import run_folder

    def full(path: Path, data: bytes) -> None:
        if path.parent.name == "t-1":
            raise OSError(28, "No space left on device")
        write_atomic(path, data)

    out = workspace / "full"
    monkeypatch.setattr(run_folder, "write_atomic", full)
    run = cosim(
        "run",
        "tiny.json",
        "--policy",
        "schedule:stand",
        "--seed",
        SEED,
        "--out",
        out.name,
        cwd=workspace,
    )
    assert (
        run.returncode == 3 and "No space left on device" in run.stderr and "--resume" in run.stderr
    )
    assert "Traceback" not in run.stderr
    assert json.loads((out / "episodes/t-0/record.json").read_text())["status"] == "done"


def alive(out: Path) -> bool:
    """Return whether an environment process still writes to the logs of a run."""
    logs = {str(p.resolve()) for p in out.glob("logs/*")}
    for fd in Path("/proc").glob("[0-9]*/fd/1"):
        try:
            if str(fd.readlink()) in logs:
                return True
        except OSError:
            continue
    return False


def test_a_second_run_on_the_same_folder_is_refused(workspace: Path, cosim: Cosim) -> None:
    """The folder of a run in progress is locked, and that of a finished run is not overwritten."""
    with waits_before(workspace, "t-0") as waits, running(workspace, *HELD, "held") as run:
        wait_until(waits)
        second = cosim("run", *HELD, "held", "--resume", cwd=workspace)
        assert second.returncode == 2
        assert f"in use by process {run.pid}" in second.stderr
        third = cosim("run", *HELD, "held", cwd=workspace)
        assert third.returncode == 2 and "already holds a run. Add --resume" in third.stderr


def test_unknown_names_are_answered_with_the_valid_ones(
    workspace: Path, cosim: Cosim, whole_run: Path
) -> None:
    """Unknown suites, policies, scenarios, runs and episodes give exit code 2, the name, and the
    valid choices."""
    requests = {
        ("run", "short-horizon"): ("suite 'short-horizon'", "long-horizon"),
        ("run", "tiny.json", "--policy", "rout"): ("policy 'rout'", "social_force, stop, straight"),
        ("run", "tiny.json", "--policy", "mine:Hel"): ("'Hel'", "Held"),
        ("run", "tiny.json", "--policy", "nowhere:X"): (
            "module 'nowhere' cannot be imported",
            "ModuleNotFoundError",
        ),
        ("run", "tiny.json", "--policy", "mine:Unfinished"): (
            "'mine:Unfinished' has no attribute 'manifest'",
            "",
        ),
        ("run", "tiny.json", "--scenario", "t-9"): ("scenario 't-9'", "t-0, t-1, t-2"),
        ("run", "tiny.json", "--goal", "route"): (
            "goal protocol 'route'",
            "random_image, random_point, route_patch",
        ),
        ("run", "tiny.json", "--resume"): ("--resume needs --out", ""),
        ("show", "whole", "--episode", "t-9"): ("'t-9'", "t-0, t-1, t-2"),
        ("show", "nothing"): ("run 'nothing'", "whole"),
        ("list", "short-horizon"): ("suite 'short-horizon'", "long-horizon"),
    }
    for words, (name, choices) in requests.items():
        result = cosim(*words, cwd=workspace)
        assert result.returncode == 2, (words, result.stderr)
        assert name in result.stderr and choices in result.stderr, (words, result.stderr)
        assert "Traceback" not in result.stderr


def test_a_suite_without_scenarios_is_refused(workspace: Path, cosim: Cosim) -> None:
    """An empty suite is an error that names the file, not a successful run."""
    suite = json.loads((workspace / "tiny.json").read_text())
    (workspace / "empty.json").write_text(json.dumps(suite | {"scenarios": []}))
    result = cosim("run", "empty.json", "--out", "empty", cwd=workspace)
    assert result.returncode == 2 and "empty.json: suite 'tiny' has no scenarios" in result.stderr


def test_a_run_with_a_wrong_endpoint_leaves_no_folder(workspace: Path, cosim: Cosim) -> None:
    """A wrong endpoint is reported with the remedy, and the same command with a right one is
    accepted."""
    result = cosim(
        "run",
        "tiny.json",
        "--live",
        "tcp/192.0.2.1:7447",
        "--insecure",
        "--out",
        "air",
        cwd=workspace,
    )
    assert result.returncode == 3 and not (workspace / "air").exists()
    assert (
        "cannot listen at tcp/192.0.2.1:7447" in result.stderr
        and "Choose an address of this" in result.stderr
    )
    listening = cosim("listen", "--connect", "7447", cwd=workspace)
    assert (
        listening.returncode == 2
        and "--connect '7447': write it as PROTOCOL/ADDRESS:PORT" in listening.stderr
    )


def test_ctrl_c_during_the_imports_gives_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that is stopped before it begins exits with code 130."""
    from cosim.__main__ import main

    def stopped() -> None:
        raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "cosim.cli.app", SimpleNamespace(main=stopped))
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130


def test_a_suite_that_does_not_fit_its_place_is_refused(workspace: Path, cosim: Cosim) -> None:
    """All faults of a suite against its place are reported together before anything runs, and no
    folder is left."""
    suite = json.loads((workspace / "four.json").read_text())
    off, other, robot, unknown = suite["scenarios"]
    off["start"][:2] = off["route"][0] = [-50.0, -50.0]
    other["place"]["net_hash"] = "0" * 16
    robot["robot"] = "tank"
    unknown["place"] = {"kind": "map", "map": "atlantis"}
    (workspace / "odd.json").write_text(json.dumps(suite))
    result = cosim("run", "odd.json", "--policy", "stop", "--out", "odd", cwd=workspace)
    assert result.returncode == 2 and not (workspace / "odd").exists()
    head, *faults = result.stderr[result.stderr.index("error: ") :].splitlines()
    assert head == "error: suite 'four': 5 faults:" and len(faults) == 5
    for words in (
        "scenario 't-0': start is off the walkable area at (-50.00, -50.00)",
        "scenario 't-0': crossing ",
        "scenario 't-1': ",
        "the net's hash is ",
        f"scenario 't-2': unknown robot 'tank'. Valid choices: {', '.join(sorted(ROBOTS))}",
        "scenario 't-3': unknown map 'atlantis'",
    ):
        assert sum(words in fault for fault in faults) == 1, (words, faults)


def test_the_doctor_reports_every_engine_as_working(workspace: Path, cosim: Cosim) -> None:
    """`cosim doctor` draws a frame, moves pedestrians, queries a director, and reports success."""
    result = cosim("doctor", cwd=workspace)
    assert result.returncode == 0, result.stdout
    assert result.stdout.count("ok") >= 6 and "failed" not in result.stdout


def test_a_run_without_a_seed_draws_and_records_one(workspace: Path, cosim: Cosim) -> None:
    """The drawn seed is printed and is in run.json and every row; --resume uses it and refuses
    another."""
    words = ("run", "tiny.json", "--policy", "schedule:stand", "--episodes", "1", "--out", "one")
    run = cosim(*words, cwd=workspace)
    seed = json.loads((workspace / "one/run.json").read_text())["seed"]
    assert run.returncode == 0 and f"Seed {seed}: " in run.stderr
    assert list(rows(workspace / "one")["run_seed"]) == [seed]
    record = json.loads((workspace / "one/episodes/t-0/record.json").read_text())
    (scenario,) = read_suite(workspace / "one/scenarios.json").scenarios
    drawn = (seed, episode_id_of(seed, scenario).episode)
    assert (record["run_seed"], record["episode"]) == drawn
    assert f"Seed {seed}: " in cosim(*words, "--resume", cwd=workspace).stderr
    refused = cosim(*words, "--resume", "--seed", "3", cwd=workspace)
    assert refused.returncode == 2
    assert f"its seed is {seed}, and this command has 3" in refused.stderr


def test_a_record_has_its_inputs_and_versions(whole_run: Path) -> None:
    """Suite and scenario hash, seed, policy, renderer and the version of every engine are in each
    record."""
    record = msgspec.json.decode((whole_run / "episodes/t-0/record.json").read_bytes())
    assert {"libsumo", "pybullet", "eclipse-zenoh", "numpy"} <= set(record["versions"])
    for field in (
        "suite_hash",
        "scenario_hash",
        "seed",
        "policy",
        "policy_version",
        "renderer",
        "state_hash",
    ):
        assert record[field] not in ("", None)

"""Policies that do what no policy should, all in one run: every episode gets its row, and nothing
else breaks."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import uuid
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import msgspec
import pandas as pd
import pytest

from cosim.place.walk_graph import WalkGraph
from cosim.spec.episode_id import pseudonym_of
from cosim.spec.scenario import City, CrowdSpec, Scenario, Suite, write_suite
from scenarios.events import EVENT_KINDS
from tests.conftest import PATIENCE_S, WIDE, Cosim, Said, without_lines
from tests.support.hostile import ACTS, FLOOD_BYTES, RESETS

pytestmark = pytest.mark.engine

ANSWER_S = 3.0
START_S = 3.0
DONE = ""
"""Nothing to say: the episode is done, and simulated as if the policy had done nothing."""

EXPECTED: dict[str, str] = {
    "error": "policy 'hostile' raised KeyError: 'no such weight' (act at 0.50 s)",
    "exit": "raised SystemExit: enough (act at 0.50 s)",
    "exit-with-0": "raised SystemExit: 0",
    "exit-in-reset": "raised SystemExit: 3 (reset)",
    "error-in-reset": "raised FileNotFoundError: weights.pt (reset)",
    "ctrl-c": "raised KeyboardInterrupt (act",
    "generator-exit": "raised GeneratorExit (act",
    "stop-iteration": "raised StopIteration (act",
    "cancelled": "raised CancelledError (act",
    "too-much-memory": "raised MemoryError: Unable to allocate",
    "recursion": "raised RecursionError: maximum recursion depth",
    "mute": "raised Mute: (its message cannot be read)",
    "odd-text": "raised ValueError: ? ?[31m red ?",
    "long-text": "xxx ... (1000000 characters) (act",
    "pretends-to-be-an-engine": "policy 'hostile' raised EngineError: SUMO failed",
    "nothing": "policy 'hostile' answered None: neither a Command nor waypoints (act at 0.50 s)",
    "nan": "answered Command(v_mps=nan, w_radps=0.0): both must be finite",
    "infinity": "answered waypoints with NaN or infinity: [inf, 0.0]",
    "huge-integer": "answered Command(v_mps=an integer of 1329 bits, "
    "w_radps=0.0): both must be finite",
    "complex": "answered an array of complex128: waypoints are real numbers",
    "texts": "answered an array of str96: waypoints are real numbers",
    "truths": "answered an array of bool: waypoints are real numbers",
    "objects": "answered an array of object: waypoints are real numbers",
    "ragged": "answered [[1.0, 0.0], [1.0]]: neither a Command nor waypoints",
    "wrong-shape": "answered an array of shape (3, 7)",
    "no-waypoint": "answered an array of shape (0, 2)",
    "too-many-numbers": "policy 'hostile' answered an array of shape (50001, 2): 100002 numbers; "
    "an answer holds at most 100000 (act at 0.50 s)",
    "a-coroutine": "answered a coroutine: neither a Command nor waypoints",
    "an-unreal-float": "raised KeyboardInterrupt",
    "without-end": "policy 'hostile' ",
    "honest": DONE,
    "scribbles": DONE,
    "another-manifest": DONE,
    "elsewhere": DONE,
    "deletes-its-folder": DONE,
    "forges-its-record": DONE,
    "floods": DONE,
    "closes-its-output": DONE,
    "forks": DONE,
    "a-busy-thread": DONE,
    "closes-everything": "the environment process",
    "dies-and-leaves-processes": "the environment process ended with exit code 0 in the "
    "policy's act at 0.50 s",
    "kills-its-parent": "the environment process was killed by SIGKILL in the policy's act at "
    "0.50 s, 2 times",
    "hangs-with-the-lock": "policy 'hostile' gave no answer for 3 s in act at 0.50 s "
    "of hangs-with-the-lock",
    "stops-itself": "gave no answer for 3 s in act at 0.50 s of stops-itself",
    "hangs-in-reset": "gave no answer for 3 s in reset of hangs-in-reset",
}
SEED = "5"
TWICE = {"dies-and-leaves-processes", "kills-its-parent", "closes-everything"}
"""A process may have died of something else: these are tried again."""


class War(NamedTuple):
    """The one run of all of them. mark: what every process of it has in its environment."""

    folder: Path
    said: Said
    mark: str


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a suite that has one short scenario for each of them, and the policies."""
    from scenarios.places.nets import place
    from scenarios.suites.reactive import build_reactive

    folder = tmp_path_factory.mktemp("desk")
    city = City(seed=1, size_m=500.0)
    _, street_map = place(city)
    whole = build_reactive(
        EVENT_KINDS["obstructing"], city, street_map, WalkGraph(street_map), 0, "t"
    )
    crowd = CrowdSpec(persons=4, radius_m=50.0, vehicles=1)
    one = msgspec.structs.replace(whole, crowd=crowd, time_limit_s=1.0, events=())
    names: dict[str, str] = {}
    for name, scenarios in (("hostile", [*EXPECTED]), ("pictures", ["honest", "blackens"])):
        suite = Suite(
            name=name, version="1", scenarios=tuple(named(one, scenario) for scenario in scenarios)
        )
        write_suite(suite, folder / f"{name}.json")
        names |= {pseudonym_of(int(SEED), each).episode: each.id for each in suite.scenarios}
    (folder / "names.json").write_text(json.dumps(names))
    shutil.copy(Path(__file__).parents[1] / "support" / "hostile.py", folder)
    return folder


def named(scenario: Scenario, name: str) -> Scenario:
    return msgspec.structs.replace(scenario, id=name)


def with_mark(mark: str) -> list[int]:
    """Processes that have this in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return found


@pytest.fixture(scope="module")
def war(desk: Path, fresh_cosim: Cosim) -> War:
    """One run over all of them, by two processes at a time."""
    mark = f"hostile-{uuid.uuid4()}"
    times = ("--answer-timeout", f"{ANSWER_S:g}", "--start-timeout", f"{START_S:g}")
    words = (
        "--policy",
        "hostile:Hostile",
        "--jobs",
        "2",
        "--seed",
        SEED,
        "--out",
        "war",
        "--log-json",
        "log.jsonl",
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOSTILE_DESK", str(desk))
        patch.setenv("HOSTILE_MARK", mark)
        said = fresh_cosim("run", "hostile.json", *words, *times, cwd=desk)
    return War(desk / "war", said, mark)


def record(war: War, name: str) -> dict[str, object]:
    return json.loads((war.folder / "episodes" / name / "record.json").read_text())


def test_every_hostile_policy_is_expected() -> None:
    """The table names each function of tests/support/hostile.py, and they are many."""
    assert set(EXPECTED) == set(ACTS) | set(RESETS)
    assert len(EXPECTED) >= 45


@pytest.mark.parametrize("name", EXPECTED)
def test_a_hostile_policy_is_recorded_for_what_it_did(war: War, name: str) -> None:
    """A crash with the reason in words, once unless a process died; or an episode that nothing has
    changed."""
    told = record(war, name)
    began = Counter((war.folder.parent / "began.txt").read_text().split())
    if EXPECTED[name] == DONE and name not in TWICE:
        assert told["status"] == "done", told["reason"]
        assert told["state_hash"] == record(war, "honest")["state_hash"]
    else:
        assert told["status"] == "crashed"
        assert (
            EXPECTED[name] in without_lines(str(told["reason"])) and len(str(told["reason"])) < 700
        )
    assert began[name] == (2 if name in TWICE else 1)
    assert told["policy"] == "hostile"


def test_a_run_of_hostile_policies_ends_in_order(war: War) -> None:
    """A row for every episode, exit code 1, no traceback."""
    assert war.said.returncode == 1 and "Traceback" not in war.said.stderr, war.said.stderr
    assert f"scheduled {len(EXPECTED)}, scored {len(EXPECTED)}" in war.said.stdout
    assert "crashed error" in war.said.stdout and EXPECTED["error"] in without_lines(
        war.said.stdout
    )
    table = pd.read_csv(
        war.folder / "results.csv", index_col="scenario", keep_default_na=False, na_values=[""]
    )
    assert list(table.index) == sorted(EXPECTED)
    assert set(table["success"][table["status"] == "crashed"]) == {0.0}


def test_nobody_pays_for_what_another_did_to_the_process(war: War) -> None:
    """Processes end by what is expected to end them; else they go on, or leave in order with a
    closed output."""
    events = [
        json.loads(line) for line in (war.folder.parent / "log.jsonl").read_text().splitlines()
    ]
    lost = {one["scenario"]: one["why"] for one in events if one["event"] == "lost"}
    lost = {name: why for name, why in lost.items() if name not in TWICE}
    assert set(lost.values()) <= {"the environment process ended with exit code 0"}, lost


def test_pictures_are_kept_as_they_were_drawn(desk: Path, cosim: Cosim) -> None:
    """A policy that blackens the picture it is given does not blacken the one that is kept; and
    what a policy has not declared when it was loaded it does not come to know later."""
    words = (
        "--policy",
        "hostile:Painter",
        "--camera",
        "bullet",
        "--frames",
        "0.25",
        "--seed",
        SEED,
        "--out",
        "pictures",
    )
    run = cosim("run", "pictures.json", *words, cwd=desk)
    assert run.returncode == 0, run.stdout
    honest, blackened = (
        [
            path.read_bytes()
            for path in sorted((desk / "pictures/episodes" / name / "frames").glob("*.png"))
        ]
        for name in ("honest", "blackens")
    )
    assert len(honest) == 4 and honest == blackened


def test_a_flood_of_text_leaves_small_logs(war: War) -> None:
    """Of what a policy prints the beginning and the end are kept."""
    logs = [path.read_bytes() for path in (war.folder / "logs").iterdir()]
    assert max(map(len, logs)) < FLOOD_BYTES / 2
    assert any(
        b"the flood begins" in log and b"bytes were printed here and left out" in log
        for log in logs
    )
    assert any(b"the flood ends" in log for log in logs)


def test_nothing_is_left_of_a_run(war: War) -> None:
    """No process that any policy has started outlives its environment process."""
    assert with_mark(war.mark) == []


def test_a_run_is_not_finished_with_an_edited_policy(desk: Path, cosim: Cosim, war: War) -> None:
    """Also when the policy's version was left as it was: wrong use, and nothing is run."""
    source = desk / "hostile.py"
    kept = source.read_text()
    source.write_text(kept.replace("WALK = Command(1.0, 0.0)", "WALK = Command(2.0, 0.0)"))
    words = ("run", "hostile.json", "--policy", "hostile:Hostile", "--out", "war", "--resume")
    try:
        edited = cosim(*words, cwd=desk)
    finally:
        source.write_text(kept)
    assert edited.returncode == 2
    assert (
        "war is of another run: the source of policy 'hostile:Hostile' was edited since it began"
        in edited.stderr
    )
    assert cosim(*words, cwd=desk).returncode == 1  # as it was: every episode is finished


def test_nothing_is_left_of_a_run_that_is_killed(desk: Path) -> None:
    """Also the processes that a policy has started, in sessions of their own, end with the run."""
    mark = f"hostile-{uuid.uuid4()}"
    words = (
        "run",
        "hostile.json",
        "--scenario",
        "honest",
        "--policy",
        "hostile:Leaves",
        "--seed",
        SEED,
        "--out",
        "leaves",
    )
    run = subprocess.Popen(
        [sys.executable, "-m", "cosim", *words],
        cwd=desk,
        env=os.environ | WIDE | {"HOSTILE_DESK": str(desk), "HOSTILE_MARK": mark},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + PATIENCE_S
    while not (desk / "left").exists():
        assert run.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    # The run, the shepherd, the worker, and the two that were left: one that has just been started
    # has no environment.
    while len(with_mark(mark)) < 5:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    run.kill()
    run.wait()
    while with_mark(mark):
        assert time.monotonic() < deadline, "processes are left"
        time.sleep(0.02)

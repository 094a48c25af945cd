"""`cosim direct` beside `cosim run --director`: real processes, real kill -9."""

from __future__ import annotations

import ctypes
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from cosim.episode.control import Command
from cosim.episode.interfaces import Observation
from cosim.place.walk_graph import WalkGraph
from cosim.spec.connection import Connection
from cosim.spec.manifest import Manifest
from cosim.spec.run_config import LONGEST_WAIT_S
from cosim.spec.scenario import City, CrowdSpec, Scenario, Suite, write_suite
from scenarios.events import EVENT_KINDS
from tests.conftest import PATIENCE_S, Cosim

pytestmark = pytest.mark.engine

WORDS = [sys.executable, "-m", "cosim"]

KILLER = """
import os, signal
from pathlib import Path
from cosim.spec.manifest import Manifest
from cosim.core.state import Command

class Killer:
    manifest = Manifest("blind", camera=None)
    def reset(self, scenario_id, seed):
        self.tick = 0
    def act(self, observation):
        self.tick += 1
        if self.tick == 20:  # after 4 of 8 s: the event's pedestrian is on its way
            os.kill(int(Path("director.pid").read_text()), signal.SIGKILL)
        return Command(1.2, 0.0)
"""

BLIND = """
from cosim.spec.manifest import Manifest
from cosim.core.state import Command

class Blind:
    manifest = Manifest("blind", camera=None)
    def reset(self, scenario_id, seed): pass
    def act(self, observation): return Command(1.2, 0.0)
"""

LIAR = """
import sys, time
import msgspec
from bridge import keys
from bridge.codec import decode, encode
from bridge.director import decode_query, encode_versioned
from bridge.session import open_session
from cosim.spec.connection import Connection
from scenarios.events import react
from scenarios.episodes.director import behaviour_version

last = {}
def lie(payload):
    query = decode_query(payload, behaviour_version())
    reply, version, replace = react(query), behaviour_version(), msgspec.structs.replace
    before, last[query.episode] = last.get(query.episode, reply), reply
    if query.tick < 3 or query.episode == "honest":
        return encode_versioned(reply, version)
    match query.episode:
        case "late": return encode_versioned(before, version)
        case "many": return encode_versioned(replace(reply, states=reply.states * 1000), version)
        case "noise": return b"\\x93\\x01" * 100
        case "other-code": return encode_versioned(reply, "0" * 16)
        case "huge": return encode_versioned(reply, "x" * 10_000_000)
    raise RuntimeError("no idea")

with open_session(Connection(role="director", listen=sys.argv[1])) as hub:
    hub.serve(keys.EVERY_DIRECTOR, lie)
    print("lying", flush=True)
    time.sleep(3600)
"""


class Blind:
    """Drives straight on, like the one that kills."""

    manifest = Manifest("blind", camera=None)

    def reset(self, scenario_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Command:
        return Command(1.2, 0.0)


def frontal(scenario_id: str) -> Scenario:
    """A reactive scenario of a few seconds: a small city, few people, and a pedestrian who walks at
    the robot."""
    from scenarios.places.nets import place
    from scenarios.suites.reactive import build_reactive

    city = City(seed=1, size_m=500.0)
    _, street_map = place(city)
    scenario = build_reactive(
        EVENT_KINDS["frontal"], city, street_map, WalkGraph(street_map), 1, scenario_id
    )
    return msgspec.structs.replace(scenario, crowd=CrowdSpec(persons=4, radius_m=40.0, vehicles=0))


def started(folder: Path, *words: str) -> subprocess.Popen[str]:
    """A process that has printed its first line."""
    process = subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline()
    return process


def terminate_in_another_thread(pid: int) -> None:
    """Send SIGTERM so that it does not interrupt a system call of the main thread, as a signal
    that arrives just before that call."""
    thread = max(int(task.name) for task in Path(f"/proc/{pid}/task").iterdir())
    assert thread != pid and ctypes.CDLL(None).tgkill(pid, thread, signal.SIGTERM) == 0


def recorded(folder: Path, scenario_id: str) -> dict[str, Any]:
    return json.loads((folder / "run" / "episodes" / scenario_id / "record.json").read_bytes())


@contextmanager
def directing(folder: Path) -> Iterator[Callable[[], subprocess.Popen[str]]]:
    """Return a function that starts `cosim direct` in a folder; the policy Killer knows the last
    one started."""
    started_here: list[subprocess.Popen[str]] = []

    def start() -> subprocess.Popen[str]:
        started_here.append(started(folder, *WORDS, "direct", "--listen", at_socket(folder)))
        (folder / "director.pid").write_text(str(started_here[-1].pid))
        return started_here[-1]

    try:
        yield start
    finally:
        for process in started_here:
            process.kill()
            process.communicate()


def at_socket(folder: Path) -> str:
    return f"unixsock-stream/{folder}/director.sock"


def test_a_director_killed_in_mid_episode_leaves_no_trace(tmp_path: Path) -> None:
    """When the director is killed and started again, the episode has the state hash of an
    undisturbed one."""
    from scenarios.episodes.run_episode import run_episode

    write_suite(
        Suite(name="tiny", version="1", scenarios=(frontal("t-0"),)), tmp_path / "tiny.json"
    )
    (tmp_path / "killer.py").write_text(KILLER)
    words = (
        "run",
        "tiny.json",
        "--policy",
        "killer:Killer",
        "--out",
        "run",
        "--director",
        at_socket(tmp_path),
    )
    with directing(tmp_path) as direct:
        first = direct()
        run = subprocess.Popen(
            [*WORDS, *words, "--director-wait", str(LONGEST_WAIT_S)],
            cwd=tmp_path,
            stdout=subprocess.DEVNULL,
        )
        try:
            undisturbed = run_episode(frontal("t-0"), Blind()).record
            assert first.wait(timeout=PATIENCE_S) == -9
            direct()
            assert run.wait(timeout=PATIENCE_S) == 0
        finally:
            run.kill()
            run.wait()
    record = recorded(tmp_path, "t-0")
    assert (
        undisturbed.status == "done" and (undisturbed.events[0].triggered_at_s or PATIENCE_S) < 4.0
    )
    assert record["status"] == "done" and record["state_hash"] == undisturbed.state_hash


def test_a_director_that_does_not_return_is_reported(tmp_path: Path, cosim: Cosim) -> None:
    """When it is killed for good, the run says that it waits, and the episode becomes invalid."""
    write_suite(
        Suite(name="tiny", version="1", scenarios=(frontal("t-1"),)), tmp_path / "tiny.json"
    )
    (tmp_path / "killer.py").write_text(KILLER)
    words = (
        "run",
        "tiny.json",
        "--policy",
        "killer:Killer",
        "--out",
        "run",
        "--director",
        at_socket(tmp_path),
    )
    with directing(tmp_path) as direct:
        direct()
        run = cosim(*words, "--director-wait", "5", cwd=tmp_path)
    lost = recorded(tmp_path, "t-1")
    assert run.returncode == 1 and lost["status"] == "invalid"
    assert "no reply on 'cosim/run/env/t-1/director' within 5 s" in lost["reason"]
    assert "t-1: waits at tick" in run.stderr and "5 s at most" in run.stderr


def test_a_faulty_director_invalidates_only_its_own_episodes(tmp_path: Path, cosim: Cosim) -> None:
    """A stale answer, too many states, noise, other code and an exception each give a record with
    the reason."""
    says = {
        "late": "it answered tick 2 of 'late'",
        "many": "it answered with 1000 states for 1 events",
        "noise": "not a VersionedMessage message",
        "other-code": "run and director must be started from the same code",
        "huge": "Expected `str` of length <= 64",
        "raises": "RuntimeError: no idea",
    }
    scenarios = tuple(frontal(name) for name in ("honest", *says))
    write_suite(Suite(name="tiny", version="1", scenarios=scenarios), tmp_path / "tiny.json")
    (tmp_path / "liar.py").write_text(LIAR)
    (tmp_path / "blind.py").write_text(BLIND)
    at = f"unixsock-stream/{tmp_path}/liar.sock"
    liar = started(tmp_path, sys.executable, "liar.py", at)
    try:
        words = ("run", "tiny.json", "--policy", "blind:Blind", "--out", "run", "--director", at)
        run = cosim(*words, cwd=tmp_path)
    finally:
        liar.kill()
        liar.wait()
    assert run.returncode == 1 and recorded(tmp_path, "honest")["status"] == "done", run.stderr
    for name, words in says.items():
        record = recorded(tmp_path, name)
        assert (
            record["status"] == "invalid"
            and words in record["reason"]
            and len(record["reason"]) < 1000
        )
        assert f"director, tick 3 of '{name}'" in record["reason"]


def test_a_run_waits_for_a_director_that_is_started_after_it(tmp_path: Path, cosim: Cosim) -> None:
    """A run waits for its director and reports it, or ends with an error; SIGTERM ends a director."""
    from cosim.core.errors import DirectorLost
    from cosim.spec.events import EventQuery
    from cosim.spec.options import DirectorAddress
    from scenarios.episodes.director import remote_director

    at = f"unixsock-stream/{tmp_path}/director.sock"
    address = Connection(role="coordinator", connect=at)
    query = EventQuery(
        episode="e",
        tick=0,
        tick_ms=50,
        robot_x_m=0.0,
        robot_y_m=0.0,
        robot_heading_rad=0.0,
        robot_v_mps=0.0,
        robot_w_radps=0.0,
        route_s_m=0.0,
        robot_length_m=0.7,
        robot_width_m=0.55,
        events=(),
    )
    notes: list[str] = []
    with (
        pytest.raises(
            DirectorLost,
            match=r"no director at .*director\.sock within 0\.5 s: start one with `cosim direct",
        ),
        remote_director(
            DirectorAddress(connection=address, run="r", wait_s=0.5), notes.append, "e"
        ),
    ):
        pass
    directors: list[subprocess.Popen[str]] = []
    late = threading.Thread(
        target=lambda: directors.append(started(tmp_path, *WORDS, "direct", "--listen", at))
    )
    late.start()
    try:
        with remote_director(
            DirectorAddress(connection=address, run="r", wait_s=PATIENCE_S), notes.append, "e"
        ) as director:
            assert director.react(query).tick == 0
        late.join()
        second = cosim("direct", "--listen", at)
        assert second.returncode == 3 and f"cannot listen at {at}" in second.stderr
        terminate_in_another_thread(directors[0].pid)
        assert directors[0].wait(timeout=PATIENCE_S) == 130
    finally:
        late.join()
        for process in directors:
            process.kill()
            process.wait()
    bad = cosim("direct", "--listen", "7448")
    assert bad.returncode == 2 and "--listen '7448': write it as PROTOCOL/ADDRESS" in bad.stderr


def test_the_version_of_the_behaviours_covers_every_module_they_load() -> None:
    """The modules whose source is hashed include every module of the project that a fresh process
    loads with them."""
    from scenarios.episodes.director import behaviour_version, imported_sources

    code = "import sys, scenarios.events; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    ours = {name for name in loaded if name.startswith(("cosim.", "scenarios."))}
    assert (
        {"scenarios.events.frontal", "cosim.spec.events"}
        < ours
        <= set(imported_sources("scenarios.events"))
    )
    assert len(behaviour_version()) == 16 and behaviour_version() == behaviour_version()

"""Injected pedestrians: refusals, the order of steps, a running `cosim run`, and its replay."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest

from bridge.live import MAX_MESSAGE_B, answer_injection
from bridge.security.authority import issue, make_authority
from cosim.core.geometry import Polyline, Pose
from cosim.episode.interfaces import Director
from cosim.place.walk_graph import WalkGraph
from cosim.results.log import Log
from cosim.spec.events import EventQuery, EventReply
from cosim.spec.injection import Ack, Injected, Injection, InjectionRequest, RelativePoint
from cosim.spec.scenario import City, CrowdSpec, Suite, write_suite
from scenarios.episodes import injected
from scenarios.episodes.injected import MAX_INJECTED, InjectedPeople, RobotOnRoute
from tests.conftest import PATIENCE_S, Cosim
from tests.support.documents import blocks
from tests.support.plain import free_port

TICK_MS = 50


class EmptyDirector:
    """A director without events."""

    def react(self, query: EventQuery) -> EventReply:
        return EventReply(episode=query.episode, tick=query.tick, states=(), actors=())


ROUTE = Polyline([(90.0, 90.0), (90.0, 50.0), (10.0, 50.0)])
START = Pose(90.0, 90.0, -math.pi / 2)


def injected_people(*script: Injected, director: Director | None = None) -> InjectedPeople:
    """Injected people on a map that is a square of 100 m at the origin, walking along ROUTE."""

    def on_map(x_m: float, y_m: float) -> bool:
        return 0.0 <= x_m <= 100.0 and 0.0 <= y_m <= 100.0

    return InjectedPeople(director or EmptyDirector(), TICK_MS, on_map, ROUTE, START, script)


def query(tick: int, robot_x_m: float = 90.0) -> EventQuery:
    return EventQuery(
        episode="t",
        tick=tick,
        tick_ms=TICK_MS,
        robot_x_m=robot_x_m,
        robot_y_m=90.0,
        robot_heading_rad=0.0,
        robot_v_mps=0.0,
        robot_w_radps=0.0,
        route_s_m=0.0,
        robot_length_m=0.7,
        robot_width_m=0.55,
        events=(),
    )


def anna(**fields: object) -> Injection:
    known: dict[str, object] = {
        "id": "anna",
        "path": ((10.0, 10.0), (13.0, 10.0)),
        "speed_mps": 1.5,
        "stay_s": 1.0,
    }
    return Injection(**known | fields)  # type: ignore[arg-type]


def test_an_injected_person_enters_at_its_tick_walks_its_path_and_leaves() -> None:
    """Accepted between ticks 2 and 3 it appears at 3, stands after 3 m at 1.5 m/s, and is gone a
    second later."""
    pedestrians = injected_people()
    for tick in range(3):
        assert not pedestrians.react(query(tick)).actors
    ack = pedestrians.offer(anna(doing="look"))
    assert ack == Ack(id="anna", status="accepted", tick=3, time_s=0.15, x_m=10.0, y_m=10.0)
    seen = {tick: pedestrians.react(query(tick)).actors for tick in range(3, 80)}
    assert (seen[3][0].id, seen[3][0].x_m, seen[3][0].y_m) == ("ei-anna", 10.0, 10.0)
    assert seen[23][0].x_m == pytest.approx(11.5) and seen[23][0].speed_mps == pytest.approx(1.5)
    assert seen[43][0].x_m == pytest.approx(13.0) and seen[45][0].doing == "look"
    left_tick = min(tick for tick, actors in seen.items() if not actors)
    assert left_tick == pytest.approx(43 + 20, abs=1)
    assert pedestrians.log == (Injected(tick=3, injection=anna(doing="look")),)


def test_a_final_posture_is_shown_only_at_the_end_of_the_path() -> None:
    """A person who is to sit at its end is shown standing as it appears, then walking, and sits
    only at the end."""
    pedestrians = injected_people(Injected(tick=0, injection=anna(doing="sit")))
    shown = [actor for tick in range(60) for actor in pedestrians.react(query(tick)).actors]
    assert {actor.doing for actor in shown if actor.x_m < 13.0} == {"stand", "walk"}
    assert {actor.doing for actor in shown if actor.speed_mps == 0.0 and actor.x_m == 13.0} == {
        "sit"
    }


@pytest.mark.parametrize("off_m", [(0.0, 0.0), (0.4, 0.3), (-0.7, 0.0), (0.7, 0.0)])
def test_an_injected_person_whose_end_the_robot_blocks_stops_near_it(
    off_m: tuple[float, float],
) -> None:
    """It comes within a metre, stays for its time, and leaves, instead of walking round the robot
    for ever."""
    end = (90.0 + off_m[0], 90.0 + off_m[1])
    pedestrians = injected_people(
        Injected(tick=0, injection=anna(path=((84.0, 90.0), end), stay_s=2.0))
    )
    shown = [actor for tick in range(300) for actor in pedestrians.react(query(tick)).actors]
    assert len(shown) < 240
    assert {(actor.speed_mps, actor.doing) for actor in shown[-38:]} == {(0.0, "stand")}
    assert math.dist((shown[-1].x_m, shown[-1].y_m), end) < 1.0


def test_injected_people_are_replayed_from_the_log_alone() -> None:
    """A director that only has the log shows two people, injected at different ticks, at the same
    places tick by tick."""
    live = injected_people()
    shown = []
    for tick in range(60):
        if tick in (4, 20):
            live.offer(anna(id=f"p{tick}"))
        shown.append(live.react(query(tick)).actors)
    again = injected_people(*live.log)
    assert [again.react(query(tick)).actors for tick in range(60)] == shown
    assert [entry.tick for entry in live.log] == [4, 20]


def test_points_relative_to_the_robot_are_resolved_when_the_pedestrian_enters() -> None:
    """Points ahead and left of its pose at that tick mix with map points; the log holds map points
    only, and replays."""
    pedestrians = injected_people()
    robot = Pose(50.0, 50.0, math.pi / 2)
    pedestrians.react(query(0))
    pedestrians.set_robot(RobotOnRoute(1, robot, 40.0))
    ack = answer_injection(
        b'{"id":"a","path":[{"ahead":15,"left":1},[60,60],{"ahead":-2.5}]}', pedestrians.offer
    )
    assert (ack.status, ack.tick, ack.x_m, ack.y_m) == (
        "accepted",
        1,
        pytest.approx(49.0),
        pytest.approx(65.0),
    )
    shown = [pedestrians.react(query(tick)).actors for tick in range(1, 100)]
    (entry,) = msgspec.json.decode(msgspec.json.encode(pedestrians.log), type=tuple[Injected, ...])
    path = [(49.0, 65.0), (60.0, 60.0), (50.0, 47.5)]
    assert [number for point in entry.injection.path for number in point] == pytest.approx(
        sum(path, ())
    )
    again = injected_people(entry)
    again.react(query(0))
    assert [again.react(query(tick)).actors for tick in range(1, 100)] == shown


def test_a_hanging_tick_refuses_points_relative_to_the_robot(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """While an engine hangs, map points are accepted, and clients must send the others
    again."""
    monkeypatch.setattr(injected, "TICK_TIMEOUT_S", 0.01)
    pedestrians = injected_people()
    pedestrians.react(query(0))
    ack = pedestrians.offer(InjectionRequest(id="a", path=(RelativePoint(10.0),)))
    assert ack.status == "refused" and "send it again" in ack.reason
    assert pedestrians.offer(anna()).status == "accepted"


@pytest.mark.parametrize(
    "robot",
    [(90.0, 90.0, -1.6, 0.0), (88.0, 52.0, -3.0, 39.0), (11.0, 49.0, 2.0, 119.0)],
    ids=["start", "turn", "goal"],
)
@pytest.mark.parametrize(
    "path",
    ["[[10,10],[170,252]]", '[[10,10],{"ahead":-3,"left":-200}]'],
    ids=["of the map", "from the robot"],
)
def test_a_refusal_has_the_robots_place_and_a_valid_point(
    robot: tuple[float, float, float, float], path: str
) -> None:
    """At the start, in a turn and near the goal, either form of the suggested point is accepted."""
    pedestrians = injected_people()
    pedestrians.set_robot(RobotOnRoute(0, Pose(*robot[:3]), robot[3]))
    reason = answer_injection(f'{{"id":"a","path":{path}}}'.encode(), pedestrians.offer).reason
    assert reason.startswith("path[1] is ") and "not on this map" in reason
    assert f"The robot is at [{robot[0]:.1f}, {robot[1]:.1f}]" in reason
    found = re.search(
        r"A valid point on its route is (\[.*?\]), or (\{.*?\}) from the robot", reason
    )
    assert found is not None
    acks = [
        answer_injection(f'{{"id":"p{i}","path":[{found[i]}]}}'.encode(), pedestrians.offer)
        for i in (1, 2)
    ]
    assert [ack.status for ack in acks] == ["accepted", "accepted"]
    assert (
        math.dist(
            (acks[0].x_m or 0.0, acks[0].y_m or 0.0), (acks[1].x_m or 0.0, acks[1].y_m or 0.0)
        )
        < 0.2
    )


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b'{"id":"a","path":[[10,10]],"speed_mps":9}', "speed_mps must be above 0 and at most 3"),
        (b'{"id":"a","path":[[10,500]]}', "not on this map"),
        (b'{"id":"a","path":[]}', "path"),
        (b'{"id":"a b","path":[[1,1]]}', "id"),
        (
            b'{"id":"a","path":[[1,1]],"sped_mps":1}',
            "`sped_mps`. Valid choices: id, path, speed_mps, heading_rad",
        ),
        (b'{"id":"a","path":[[1,1]],"stay_s":-1}', "stay_s must be 0"),
        (b'{"id":"a","path":[[1,NaN]]}', "malformed"),
        (msgspec.msgpack.encode({"id": "a", "path": [[1.0, float("nan")]]}), "no number"),
        (msgspec.msgpack.encode({"id": "a", "path": [[1.0, float("inf")]]}), "no number"),
        (
            b'{"id":"a","path":[{"forward":15}]}',
            "field `forward` - at `$.path[0]`; a point is [x, y] on the map or {",
        ),
        (
            b'{"id":"a","ahead":15}',
            "`ahead`. Valid choices: id, path, speed_mps, heading_rad, doing, age, stay_s; a",
        ),
        (
            b'{"id":"a","path":[{"left":1}]}',
            "missing required field `ahead` - at `$.path[0]`; a point is",
        ),
        (
            b'{"id":"a","path":[{"ahead":1e9}]}',
            "<= 1000.0 - at `$.path[0].ahead`, found 1000000000.0; a point is",
        ),
        (
            b'{"id":"a","path":[[1,2,3]]}',
            "`array` of length 2 - at `$.path[0]`, found [1, 2, 3]; a point is",
        ),
        (
            msgspec.msgpack.encode({"id": "a", "path": [{"ahead": float("nan")}]}),
            "found nan; a point is",
        ),
        (
            b'{"id":"a","path":[[1,1]],"doing":"dance"}',
            "'dance' - at `$.doing`. Valid choices: walk, stand, look",
        ),
        (b"\x93\x01", ""),
        (b"[" * 60_000, ""),
        (b"x" * (MAX_MESSAGE_B + 1), f"at most {MAX_MESSAGE_B}"),
        (b"", ""),
    ],
    ids=[
        "fast",
        "off the map",
        "no path",
        "no name",
        "misspelt",
        "negative stay",
        "nan",
        "packed nan",
        "packed inf",
        "misspelt point",
        "point without a path",
        "half a point",
        "far",
        "three numbers",
        "relative nan",
        "dance",
        "cut short",
        "deep",
        "large",
        "empty",
    ],
)
def test_an_invalid_message_is_refused_with_a_reason(message: bytes, reason: str) -> None:
    """An invalid message is refused with its reason, and nothing of it reaches the simulation."""
    pedestrians = injected_people()
    ack = answer_injection(message, pedestrians.offer)
    assert ack.status == "refused" and ack.tick is None and reason in ack.reason
    assert not pedestrians.react(query(0)).actors and pedestrians.log == ()


def test_a_repeated_name_is_refused() -> None:
    """A name is refused the second time even after the first person left, because the log
    identifies people by name."""
    pedestrians = injected_people()
    assert pedestrians.offer(anna()).status == "accepted"
    assert "of this id" in pedestrians.offer(anna()).reason
    for tick in range(120):
        pedestrians.react(query(tick))
    assert (
        not pedestrians.react(query(120)).actors and pedestrians.offer(anna()).status == "refused"
    )


def test_a_flood_of_messages_is_bounded() -> None:
    """Of 100,000 messages as many are accepted as people may exist at once; the rest are refused
    with the reason."""
    pedestrians = injected_people()
    acks = [pedestrians.offer(anna(id=f"p{i}")) for i in range(100_000)]
    assert sum(ack.status == "accepted" for ack in acks) == MAX_INJECTED
    assert "are here already" in acks[-1].reason
    assert len(pedestrians.react(query(0)).actors) == MAX_INJECTED


def test_an_injected_person_does_not_walk_through_the_robot() -> None:
    """With the robot on its path the person walks round it and arrives."""
    pedestrians = injected_people()
    pedestrians.offer(anna(path=((80.0, 90.0), (99.0, 90.0)), stay_s=60.0))
    gaps = []
    for tick in range(400):
        actor = pedestrians.react(query(tick)).actors[0]
        gaps.append(max(abs(actor.x_m - 90.0) - 0.35, abs(actor.y_m - 90.0) - 0.275))
    assert min(gaps) > 0.2 and actor.x_m == pytest.approx(99.0)


SLOW = """
import time
from pathlib import Path
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.core.state import Command

class Slow:
    manifest = Manifest("slow", rate_hz=20.0, camera=CameraSpec(64, 64))
    def reset(self, scenario_id, seed):
        self.count = 0
    def act(self, observation):
        if Path("enough").exists():
            return Command(1.5, 0.6)  # off the sidewalk: that ends the episode
        time.sleep(0.05)
        self.count += 1
        return Command(0.3 if self.count // 40 % 2 else -0.3, 0.0)  # to and fro until it is ended
"""

CONNECTED = f"""
import json, sys, threading, zenoh
PATIENCE_S = {PATIENCE_S}
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
"""

LISTENER = """
ended, heard = threading.Event(), {}
def hear(sample):
    topic = str(sample.key_expr).split("/")[-1]
    heard.setdefault(topic, []).append(json.loads(sample.payload.to_string()))
    if topic == "events" and any(news.startswith("ended") for news in heard["events"][-1]):
        ended.set()
with zenoh.open(config) as session:
    subscriber = session.declare_subscriber("cosim/**", hear)
    print("listening", flush=True)
    ended.wait(PATIENCE_S)
print(json.dumps(heard))
"""

VANDAL = """
below, (x, y) = sys.argv[2], json.loads(sys.argv[3])
done = threading.Semaphore(0)
acks = []
with zenoh.open(config) as session:
    def ask(key, payload=b""):
        replies = session.get(key, payload=payload, timeout=PATIENCE_S)
        return next(((r.ok or r.err).payload.to_bytes() for r in replies), b"")
    def reply_to(message, key=f"{below}/inject"):
        return ask(key, message).decode(errors="replace")
    bad = {
        "10 MB": reply_to(b'{"id":"' + b"x" * 10_000_000 + b'"}'),
        "10 MB of nothing": reply_to(bytes(10_000_000)),
        "NaN": reply_to(b'{"id":"a","path":[[1,NaN]]}'),
        "outside": reply_to(b'{"id":"a","path":[[1e6,0]]}'),
        "too fast": reply_to(json.dumps({"id": "a", "path": [[x, y]], "speed_mps": 30}).encode()),
        "twice": reply_to(json.dumps({"id": "bob", "path": [[x, y]]}).encode()),
        "every run": reply_to(b"{}", "cosim/*/env/*/inject"),
        "wrong run": reply_to(b"{}", "cosim/other/env/t-0/inject"),
    }
    many = 2000
    for i in range(many):
        message = json.dumps({"id": f"p{i}", "path": [[x, y]]})
        took = zenoh.handlers.Callback(lambda r: acks.append(r.ok and r.ok.payload.to_string()), drop=done.release)
        session.get(f"{below}/inject", took, payload=message, timeout=PATIENCE_S)
    for _ in range(many):
        done.acquire()
    bad["flood"] = [json.loads(ack) for ack in acks if ack]
    bad["log"] = json.loads(ask(f"{below}/log"))
    bad["camera"] = ask(f"{below}/camera").hex()[:16]
print(json.dumps(bad))
"""


class LiveRun(NamedTuple):
    """A live run in a folder; `way` are points on its sidewalk."""

    run: subprocess.Popen[str]
    folder: Path
    at: str
    way: list[tuple[float, float]]

    def python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, *arguments]
        return subprocess.run(
            command,
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    def record(self) -> dict[str, Any]:
        """Return the record, after the episode was ended."""
        (self.folder / "enough").touch()
        assert self.run.wait(timeout=PATIENCE_S) == 0
        return json.loads((self.folder / "run" / "episodes" / "t-0" / "record.json").read_bytes())


def wait_for(what: Callable[[], bool]) -> None:
    """Wait until a condition holds; a busy run may not reply to the first query."""
    deadline = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.3)


@contextmanager
def live_run(folder: Path, at: str, *guard: str) -> Iterator[LiveRun]:
    """`cosim run --live` of an episode that lasts until it is ended."""
    from scenarios.places.nets import place
    from scenarios.suites.long_horizon import build_long_horizon

    city = City(seed=1, size_m=500.0)
    _, street_map = place(city)
    scenario = build_long_horizon(city, street_map, WalkGraph(street_map), 0, "t-0")
    crowd = CrowdSpec(persons=6, radius_m=50.0, vehicles=2)
    short = msgspec.structs.replace(
        scenario, crowd=crowd, time_limit_s=3600.0, ends_on_failure=True, events=()
    )
    write_suite(Suite(name="tiny", version="1", scenarios=(short,)), folder / "tiny.json")
    (folder / "slow.py").write_text(SLOW)
    words = [
        sys.executable,
        "-m",
        "cosim",
        "run",
        "tiny.json",
        "--policy",
        "slow:Slow",
        "--camera",
        "bullet",
    ]
    with subprocess.Popen(
        [*words, "--out", "run", "--live", at, *guard], cwd=folder, text=True
    ) as run:
        try:
            yield LiveRun(run, folder, at, [(x, y) for x, y in scenario.route[20:26]])
        finally:
            run.kill()


@pytest.mark.engine
def test_a_pedestrian_injected_from_another_process_is_in_the_record_and_replays(
    tmp_path: Path, cosim: Cosim
) -> None:
    """`cosim inject` and `listen` each use their own certificate; `cosim replay` with the injection
    has the same state hash."""
    certs = tmp_path / "certs"
    at = f"tls/localhost:{free_port()}"
    make_authority(certs, ["localhost"], 1)
    viewer, injector = (
        ("--tls", str(issue(certs, role, [], 1))) for role in ("viewer", "injector")
    )  # type: ignore[arg-type]
    with live_run(tmp_path, at, "--tls", "certs/coordinator") as live_session:
        connection = ("--connect", live_session.at, "--wait", str(PATIENCE_S))

        def fetch_log() -> dict[str, Any]:
            result = cosim("listen", "events", *connection, *viewer, "--seconds", "0")
            assert result.returncode == 0, result
            return dict(json.loads(result.stdout.splitlines()[0]))

        wait_for(lambda: fetch_log()["tick"] > 0)
        message = json.dumps(
            {
                "id": "anna",
                "path": [live_session.way[0], {"ahead": 4, "left": 0.5}],
                "doing": "stop",
            }
        )
        sent = cosim("inject", message, *connection, *injector)
        assert sent.returncode == 0 and "'anna' enters at tick" in sent.stdout, sent.stderr
        again = cosim("inject", message, *connection, *injector)
        assert again.returncode == 2 and "of this id" in again.stderr
        swapped = cosim("inject", message, *connection, *viewer)
        assert (
            swapped.returncode == 2
            and "is of the role viewer, and this needs injector" in swapped.stderr
        )
        elsewhere = ("inject", message, "--connect", live_session.at, "--env", "run/t-9", *injector)
        wait_for(
            lambda: (
                "Valid choices: run/t-0" in (result := cosim(*elsewhere)).stderr
                and result.returncode == 2
            )
        )
        wait_for(
            lambda: [entry["injection"]["id"] for entry in fetch_log()["injections"]] == ["anna"]
        )
        words = [sys.executable, "-m", "cosim", "listen", "robot", *connection, *viewer]
        for ends, code in (("SIGTERM", 130), ("closed pipe", 141)):
            with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as listener:
                assert listener.stdout is not None
                ticks = [json.loads(listener.stdout.readline()) for _ in range(4)]
                if code == 130:
                    listener.terminate()
                    listener.wait()
                listener.stdout.close()
            assert listener.returncode == code and all("x_m" in tick for tick in ticks), ends
        record = live_session.record()
    (entry,) = record["injections"]
    assert record["status"] == "done" and entry["injection"]["id"] == "anna"
    log = Log.load(tmp_path / "run" / "episodes" / "t-0" / "trajectory.npz")
    robot = Pose(*log.pose[entry["tick"] - 1])
    assert entry["tick"] > 0
    assert entry["injection"]["path"] == [
        list(live_session.way[0]),
        list(RelativePoint(4.0, 0.5).on_map(robot)),
    ]
    replayed = cosim("replay", "run", "t-0", cwd=tmp_path)
    assert replayed.returncode == 0 and record["state_hash"] in replayed.stdout, replayed.stderr
    assert "replaying t-0 ..." in replayed.stderr
    without = json.dumps(record | {"injections": []})
    (tmp_path / "run" / "episodes" / "t-0" / "record.json").write_text(without)
    differs = cosim("replay", "run", "t-0", cwd=tmp_path)
    assert differs.returncode == 2 and "not the same" in differs.stderr


@pytest.mark.engine
def test_plain_zenoh_scripts_inject_and_listen_without_harm(tmp_path: Path, cosim: Cosim) -> None:
    """The script of docs/viewing.md injects, a late listener gets all topics and the log, and
    floods are refused."""
    (script,) = blocks("python", "docs/viewing.md")
    with live_run(tmp_path, f"unixsock-stream/{tmp_path}/air.sock") as live_session:
        text = script.text.replace("tcp/127.0.0.1:7447", live_session.at)
        (tmp_path / "ten.py").write_text(text)
        assert (
            cosim(
                "listen", "--connect", live_session.at, "--wait", str(PATIENCE_S), "--seconds", "0"
            ).returncode
            == 0
        )
        bob = json.loads(live_session.python("ten.py").stdout)
        words = [sys.executable, "-c", CONNECTED + LISTENER, live_session.at]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as listener:
            assert listener.stdout is not None and listener.stdout.readline() == "listening\n"
            vandal = live_session.python(
                "-c",
                CONNECTED + VANDAL,
                live_session.at,
                "cosim/run/env/t-0",
                json.dumps(live_session.way[2]),
            )
            assert vandal.returncode == 0, vandal.stderr
            record = live_session.record()
            received = json.loads(listener.stdout.read())
    assert bob["status"] == "accepted" and bob["time_s"] == pytest.approx(0.05 * bob["tick"])
    replies = json.loads(vandal.stdout)
    for name, words in {
        "10 MB": f"at most {MAX_MESSAGE_B}",
        "10 MB of nothing": f"at most {MAX_MESSAGE_B}",
        "NaN": "malformed",
        "outside": "not on this map",
        "too fast": "at most 3, not 30",
        "twice": "of this id",
        "every run": "ask for exactly 'cosim/run/env/t-0/inject'",
    }.items():
        assert words in replies[name], replies[name]
    assert replies["wrong run"] == "" and replies["camera"] == b"\x89PNG\r\n\x1a\n".hex()
    taken_in = [entry["injection"]["id"] for entry in record["injections"]]
    for ack in replies["flood"]:
        assert (ack["id"] in taken_in) is (ack["status"] == "accepted"), ack
        assert ack["status"] == "accepted" or "are here already" in ack["reason"]
    assert len(replies["flood"]) <= 2000 and taken_in[0] == "bob"
    assert len(taken_in) == len(set(taken_in)) >= MAX_INJECTED
    assert [entry["injection"]["id"] for entry in replies["log"]["injections"]] == taken_in
    injected_people = [
        sum(person["kind"] == "injected" for person in crowd) for crowd in received["crowd"]
    ]
    assert MAX_INJECTED // 2 < max(injected_people) <= MAX_INJECTED
    assert (
        set(received) == {"clock", "robot", "crowd", "signals", "events"}
        and received["events"][-1][-1] == "ended: failure"
    )
    assert received["clock"][-1]["tick"] > bob["tick"]
    assert any(person["id"] == "ei-bob" for crowd in received["crowd"] for person in crowd)
    assert record["status"] == "done"
    replayed = cosim("replay", "run", "t-0", cwd=tmp_path)
    assert replayed.returncode == 0 and record["state_hash"] in replayed.stdout, replayed.stderr

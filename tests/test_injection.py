"""Injected pedestrians: refusals, the order of steps, a running `cosim run`, and its replay."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from bridge.live import LARGEST_B, taken
from cosim.events import EventQuery, EventReply
from cosim.injection import Ack, Injected, Injection
from cosim.scenario import City, CrowdSpec, Suite, write_suite
from cosim.walks import WalkGraph
from scenarios.guests import MOST_GUESTS, Guests

TICK_MS = 50


class Nobody:
    """A director without events."""

    def react(self, query: EventQuery) -> EventReply:
        return EventReply(episode=query.episode, tick=query.tick, states=(), actors=())


def guests(*script: Injected) -> Guests:
    """Guests on a map that is the square of 100 m at the origin."""
    return Guests(Nobody(), TICK_MS, lambda x, y: 0.0 <= x <= 100.0 and 0.0 <= y <= 100.0, script)


def query(tick: int, robot_x_m: float = 90.0) -> EventQuery:
    return EventQuery(
        episode="t", tick=tick, tick_ms=TICK_MS, robot_x_m=robot_x_m, robot_y_m=90.0, robot_heading_rad=0.0,
        robot_v_mps=0.0, robot_w_radps=0.0, route_s_m=0.0, robot_length_m=0.7, robot_width_m=0.55, events=(),
    )  # fmt: skip


def anna(**fields: object) -> Injection:
    known: dict[str, object] = {"id": "anna", "path": ((10.0, 10.0), (13.0, 10.0)), "speed_mps": 1.5, "stay_s": 1.0}
    return Injection(**known | fields)  # type: ignore[arg-type]


def test_a_guest_enters_at_the_tick_it_was_told_walks_its_path_and_leaves() -> None:
    """Accepted between ticks 2 and 3 it is there at 3, 3 m at 1.5 m/s later it stands, a second later it is gone."""
    one = guests()
    for tick in range(3):
        assert not one.react(query(tick)).actors
    ack = one.offer(anna(doing="look"))
    assert ack == Ack(id="anna", status="accepted", tick=3, time_s=0.15)
    seen = {tick: one.react(query(tick)).actors for tick in range(3, 80)}
    assert (seen[3][0].id, seen[3][0].x_m, seen[3][0].y_m) == ("ei-anna", 10.0, 10.0)
    assert seen[23][0].x_m == pytest.approx(11.5) and seen[23][0].speed_mps == pytest.approx(1.5)
    assert seen[43][0].x_m == pytest.approx(13.0) and seen[45][0].doing == "look"
    gone = min(tick for tick, actors in seen.items() if not actors)
    assert gone == pytest.approx(43 + 20, abs=1)
    assert one.log == (Injected(tick=3, injection=anna(doing="look")),)


def test_the_log_alone_replays_the_guests() -> None:
    """Two of them, injected at different ticks: a director that only has the log shows the same, tick by tick."""
    live, shown = guests(), []
    for tick in range(60):
        if tick in (4, 20):
            live.offer(anna(id=f"p{tick}"))
        shown.append(live.react(query(tick)).actors)
    again = guests(*live.log)
    assert [again.react(query(tick)).actors for tick in range(60)] == shown
    assert [entry.tick for entry in live.log] == [4, 20]


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b'{"id":"a","path":[[10,10]],"speed_mps":9}', "speed_mps must be above 0 and at most 3"),
        (b'{"id":"a","path":[[10,500]]}', "not on this map"),
        (b'{"id":"a","path":[]}', "path"),
        (b'{"id":"a b","path":[[1,1]]}', "id"),
        (b'{"id":"a","path":[[1,1]],"sped_mps":1}', "sped_mps"),
        (b'{"id":"a","path":[[1,1]],"stay_s":-1}', "stay_s must be 0"),
        (b'{"id":"a","path":[[1,NaN]]}', "malformed"),
        (msgspec.msgpack.encode({"id": "a", "path": [[1.0, float("nan")]]}), "no number"),
        (msgspec.msgpack.encode({"id": "a", "path": [[1.0, float("inf")]]}), "no number"),
        (b"\x93\x01", ""),
        (b"[" * 60_000, ""),
        (b"x" * (LARGEST_B + 1), f"at most {LARGEST_B}"),
        (b"", ""),
    ],
)  # fmt: skip
def test_a_message_that_makes_no_sense_is_refused_in_words(message: bytes, reason: str) -> None:
    """Nothing of it reaches the simulation."""
    one = guests()
    ack = taken(message, one.offer)
    assert ack.status == "refused" and ack.tick is None and reason in ack.reason
    assert not one.react(query(0)).actors and one.log == ()


def test_the_same_name_twice_is_refused() -> None:
    """Also when the first one is gone: the log knows everybody by name."""
    one = guests()
    assert one.offer(anna()).status == "accepted"
    assert "of this id" in one.offer(anna()).reason
    for tick in range(120):
        one.react(query(tick))
    assert not one.react(query(120)).actors and one.offer(anna()).status == "refused"


def test_a_flood_is_bounded() -> None:
    """Of 100,000 messages so many are taken as may be there at once; the rest is told why not."""
    one = guests()
    acks = [one.offer(anna(id=f"p{i}")) for i in range(100_000)]
    assert sum(ack.status == "accepted" for ack in acks) == MOST_GUESTS
    assert "are here already" in acks[-1].reason
    assert len(one.react(query(0)).actors) == MOST_GUESTS


def test_a_guest_does_not_walk_through_the_robot() -> None:
    """With the robot on its path it goes round and arrives."""
    one = guests()
    one.offer(anna(path=((80.0, 90.0), (99.0, 90.0)), stay_s=60.0))
    gaps = []
    for tick in range(400):
        actor = one.react(query(tick)).actors[0]
        gaps.append(max(abs(actor.x_m - 90.0) - 0.35, abs(actor.y_m - 90.0) - 0.275))
    assert min(gaps) > 0.2 and actor.x_m == pytest.approx(99.0)


@pytest.mark.engine
def test_a_pedestrian_injected_from_another_process_is_in_the_record_and_replays(tmp_path: Path) -> None:
    """`cosim inject` beside `cosim run --live`; `cosim replay` comes to the same state hash, given the injection."""
    from scenarios.assemble import place
    from scenarios.long_horizon import build

    city = City(seed=1, size_m=500.0)
    _, street_map = place(city)
    whole = build(city, street_map, WalkGraph(street_map), 0, "t-0")
    crowd = CrowdSpec(persons=6, radius_m=50.0, vehicles=2)
    short = msgspec.structs.replace(whole, crowd=crowd, time_limit_s=60.0)
    write_suite(Suite(name="tiny", version="1", scenarios=(short,)), tmp_path / "tiny.json")
    (tmp_path / "slow.py").write_text(
        "import time\n"
        "from cosim.ports import Manifest\n"
        "from cosim.state import Command\n"
        "class Slow:\n"
        "    manifest = Manifest('slow', rate_hz=20.0, camera=None)\n"
        "    def reset(self, scenario_id, seed): pass\n"
        "    def act(self, observation):\n"
        "        time.sleep(0.02)\n"
        "        return Command(0.3, 0.0)\n"
    )
    air = f"unixsock-stream/{tmp_path}/air.sock"
    x, y = whole.route[20]
    words = [sys.executable, "-m", "cosim"]
    environment = os.environ | {"COLUMNS": "160", "NO_COLOR": "1"}
    run = subprocess.Popen(
        [*words, "run", "tiny.json", "--policy", "slow:Slow", "--out", "run", "--live", air],
        cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip

    def cosim(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*words, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60
        )

    try:
        message = json.dumps({"id": "anna", "path": [[x, y], list(whole.route[25])], "doing": "stop"})
        for _ in range(30):
            sent = cosim("inject", message, "--connect", air)
            if sent.returncode == 0:
                break
            time.sleep(0.5)
        assert sent.returncode == 0 and "'anna' enters at tick" in sent.stdout, sent.stderr
        again = cosim("inject", message, "--connect", air)
        assert again.returncode == 1 and "of this id" in again.stderr
        elsewhere = cosim("inject", message, "--connect", air, "--env", "run/t-9")
        assert elsewhere.returncode == 2 and "Valid choices: run/t-0" in elsewhere.stderr
        told = cosim("listen", "events", "--connect", air, "--seconds", "0.5")
        assert json.loads(told.stdout.splitlines()[0])["injections"][0]["injection"]["id"] == "anna"
        heard = cosim("listen", "robot", "--connect", air, "--seconds", "1")
        assert len(heard.stdout.splitlines()) > 3 and "x_m" in json.loads(heard.stdout.splitlines()[0])
        run.wait(timeout=180)
    finally:
        run.kill()
        run.wait()
    record = json.loads((tmp_path / "run" / "episodes" / "t-0" / "record.json").read_bytes())
    assert record["status"] == "done" and record["injections"][0]["injection"]["id"] == "anna"
    replayed = cosim("replay", "run", "t-0")
    assert replayed.returncode == 0 and record["state_hash"] in replayed.stdout, replayed.stderr
    without = json.dumps(record | {"injections": []})
    (tmp_path / "run" / "episodes" / "t-0" / "record.json").write_text(without)
    differs = cosim("replay", "run", "t-0")
    assert differs.returncode == 1 and "not the same" in differs.stderr

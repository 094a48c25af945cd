"""Policies behind Zenoh: queries and replies over real sessions, without an engine of the street."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
import pytest

from bridge.policy_server import (
    ActReply,
    ActRequest,
    EpisodeReply,
    PolicyInfo,
    Refusal,
    ResetRequest,
    decode_reply,
    encode_message,
    policy_key,
    serve,
)
from bridge.session import QueryResult, Session, open_session
from cosim.core.errors import MachineError, PolicyError, PolicyServerLost, UsageError
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.episode.manifest_checks import calibration_of
from cosim.spec.camera import CameraSpec
from cosim.spec.connection import Connection
from cosim.spec.goal import ImageGoal, PointGoal
from cosim.spec.odometry import Odometry
from cosim.spec.options import PolicyHost
from cosim.spec.robot import COURIER
from scenarios.ipc.deadlines import ServerTimes
from scenarios.runs.policy_host import inspected_caller
from scenarios.runs.remote_policy import PolicyServers, RemoteCaller, remote_caller
from tests.conftest import PATIENCE_S, ROOT, Cosim, wait_until
from tests.support.plain import free_port

SPEC = CameraSpec(64, 40)
RGB = np.arange(40 * 64 * 3, dtype=np.uint8).reshape(40, 64, 3)


TIMES = ServerTimes()
SOON = ServerTimes(lost_after_s=0.3)
"""Times that count a server as lost after a short interruption."""
SIZES = {"most": (50_000, 2), "many": (50_001, 2), "far too many": (2_000_000, 2)}


class Counting:
    """A policy whose speed is the number of the query in its episode, in tenths; named episodes
    misbehave as their names say."""

    manifest: ClassVar = {
        "name": "counting",
        "rate_hz": 4.0,
        "camera": {"width": 64, "height": 40},
        "goal": "image",
    }

    def __init__(self) -> None:
        self.queried: list[str] = []

    def reset(self, episode_id: str, seed: int) -> None:
        self.count = 0

    def act(self, seen: Any) -> Any:
        self.count += 1
        self.queried.append(seen.episode)
        self.seen = seen
        if seen.episode == "raises":
            raise KeyError("no such weight")
        if seen.episode == "nan":
            return {"v_mps": float("nan"), "w_radps": 0.0}
        if seen.episode == "words":
            return "left"
        if seen.episode in SIZES:
            return np.zeros(SIZES[seen.episode])
        if seen.episode == "slow":
            time.sleep(0.6)
        return {"v_mps": self.count / 10.0, "w_radps": 0.0}


class Together(Counting):
    """The same for many episodes at once; records the batch sizes."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: dict[str, int] = {}
        self.batches: list[int] = []

    def reset(self, episode_id: str, seed: int) -> None:
        self.counts[episode_id] = 0

    def ended(self, episode_id: str) -> None:
        del self.counts[episode_id]

    def act_batch(self, observations: Any) -> Any:
        self.batches.append(len(observations))
        for one in observations:
            self.counts[one.episode] += 1
        return [np.full((3, 2), [self.counts[one.episode] / 40.0, 0.0]) for one in observations]


def observation_at(tick: int, episode: str = "k1") -> Observation:
    return Observation(
        tick,
        tick / 20.0,
        RGB,
        0.5,
        0.0,
        COURIER,
        episode=episode,
        goal=ImageGoal(RGB),
        odometry=Odometry(1.0, 2.0, None),
        camera=calibration_of(SPEC, COURIER),
    )


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Connection]:
    """Where servers and runs meet."""
    with open_session(
        Connection(role="policy", listen=f"unixsock-stream/{tmp_path}/hub")
    ) as session:
        yield session.inside


@contextmanager
def served(at: Connection, policy: Any, name: str = "counting", **more: Any) -> Iterator[None]:
    """A policy served by a thread of this process, until the block ends."""
    session = open_session(at)
    handlers: list[Any] = []

    class Ending:
        """The session, whose end ends the serving thread, too."""

        def declare_queryable(
            self, key: str, handler: Callable[[Any], None], complete: bool
        ) -> Any:
            handlers.append(handler)
            return session.zenoh_session.declare_queryable(key, handler, complete=complete)

    def run() -> None:
        with pytest.raises(AttributeError):
            serve(policy, name=name, session=Ending(), **more)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        wait_until(lambda: len(handlers) == 4)
        yield
    finally:
        handlers[1](None)  # no query: the end
        thread.join(PATIENCE_S)
        session.close()


@contextmanager
def driver_at(
    at: Connection, name: str = "counting", run: str = "run1", times: ServerTimes = TIMES
) -> Iterator[RemoteCaller]:
    driver = remote_caller(f"zenoh:{name}", PolicyHost(servers=(at,), run=run), times=times)
    try:
        yield driver
    finally:
        driver.close()


@pytest.mark.engine
def test_a_remote_policy_is_queried_like_a_local_one(hub: Connection) -> None:
    """Picture, goal and calibration arrive to the bit, exceptions and bad answers crash with the
    same messages, and durations are reported."""
    policy = Counting()
    with served(hub, policy), driver_at(hub) as driver:
        assert (driver.runs, driver.manifest.camera, driver.at_once) == ("remote", SPEC, 1)
        driver.reset("k1", 7)
        assert [driver.act(observation_at(tick)) for tick in (0, 5)] == [
            Command(0.1, 0.0),
            Command(0.2, 0.0),
        ]
        assert (
            (policy.seen.rgb == RGB).all()
            and (policy.seen.goal.rgb == RGB).all()
            and policy.seen.rgb.flags.writeable
        )
        assert (policy.seen.camera.on_robot == calibration_of(SPEC, COURIER).on_robot).all()
        assert (
            policy.seen.odometry.heading_rad is None
            and policy.seen.robot.v_max_mps == COURIER.v_max_mps
        )
        assert driver.clock.keys() == {"answer_median_ms", "answer_p95_ms"}
        expected = {
            "raises": r"'counting' raised KeyError: 'no such weight' in test_policy_server\.py:\d+ \(act at 0\.25 s\)",
            "nan": "answered Command.v_mps=nan, w_radps=0.0.: both must be finite",
            "words": "answered 'left': neither a Command nor waypoints",
            "many": r"answered an array of shape \(50001, 2\): 100002 numbers; an answer holds at most 100000 \(act at",
            "far too many": r"answered an array of shape \(2000000, 2\): 4000000 numbers; an answer holds at",
        }
        driver.ended()
        driver.reset("most", 7)
        assert driver.act(observation_at(5, "most")).v_mps == 0.0
        driver.ended()
        for name, words in expected.items():
            driver.reset(name, 7)
            with pytest.raises(PolicyError, match=words):
                driver.act(observation_at(5, name))
            driver.ended()


@pytest.mark.engine
def test_a_repeated_step_is_answered_from_the_cache(hub: Connection) -> None:
    """A repeated query of a step is answered from the cache."""
    policy = Counting()
    with served(hub, policy), driver_at(hub, times=ServerTimes(try_s=0.2)) as driver:
        driver.reset("slow", 7)
        assert [driver.act(observation_at(tick, "slow")) for tick in (0, 5)] == [
            Command(0.1, 0.0),
            Command(0.2, 0.0),
        ]
    assert policy.queried == ["slow", "slow"]


@pytest.mark.engine
def test_a_link_cut_during_a_long_query_is_waited_for(
    hub: Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server is lost a fixed time after its link was cut, however long its answer took before."""
    query_once = Session.query_once
    cuts = ["one"]

    def cut_once(session: Session, key: str, payload: bytes, *, timeout_s: float) -> QueryResult:
        if not cuts:
            return query_once(session, key, payload, timeout_s=timeout_s)
        cuts.clear()
        time.sleep(0.6)
        return QueryResult("unserved")

    with served(hub, Counting()), driver_at(hub, times=SOON) as driver:
        driver.reset("k1", 7)
        monkeypatch.setattr(Session, "query_once", cut_once)
        assert driver.act(observation_at(0)) == Command(0.1, 0.0)


@pytest.mark.engine
def test_several_episodes_at_once_are_answered_together(hub: Connection) -> None:
    """Eight environments share one policy with act_batch; each gets its own answers, some in one
    batch, and ended episodes are forgotten."""
    policy = Together()

    def drive(name: str, speeds_of: list[float]) -> None:
        with driver_at(hub, "together", run=name) as driver:
            driver.reset(name, 1)
            speeds_of += [driver.act(observation_at(tick, name)).v_mps for tick in range(6)]
            driver.ended()

    speeds_of: list[list[float]] = [[] for _ in range(8)]
    with served(hub, policy, "together"):
        threads = [threading.Thread(target=drive, args=(f"k{i}", speeds_of[i])) for i in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE_S)
    assert all(speeds == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]) for speeds in speeds_of)
    assert sum(policy.batches) == 48 and max(policy.batches) > 1 and not policy.counts


@pytest.mark.engine
def test_servers_of_one_name_share_the_episodes(hub: Connection) -> None:
    """The less busy of two servers takes the next episode; runs of one seed stay separate; a server
    of another policy is refused."""
    one, other = Together(), Together()
    with served(hub, one, "together"):
        with (
            served(hub, other, "together"),
            driver_at(hub, "together") as a,
            driver_at(hub, "together", "run2") as b,
        ):
            for driver in (a, b):
                driver.reset("k1", 1)
                driver.act(observation_at(0))
            assert (len(one.batches), len(other.batches)) == (1, 1)
            for driver in (a, b):
                driver.ended()
        with (
            served(hub, Counting(), "together"),
            pytest.raises(UsageError, match="are of two policies"),
        ):
            remote_caller("zenoh:together", PolicyHost(servers=(hub,)))


@pytest.mark.engine
def test_a_restarted_server_has_lost_its_episode(hub: Connection) -> None:
    """A restarted server has lost its episode, which starts again."""
    with driver_after(hub) as driver:
        with served(hub, Counting()):
            driver.reset("k1", 7)
            driver.act(observation_at(0))
        with pytest.raises(PolicyServerLost, match="is gone"):
            driver.act(observation_at(5))
        with served(hub, Counting()):
            with pytest.raises(PolicyServerLost, match="is gone"):
                driver.act(observation_at(5))
            driver.reset("k1", 7)
            assert driver.act(observation_at(0)) == Command(0.1, 0.0)


@pytest.mark.engine
def test_a_listening_server_is_lost_as_soon_as_another_takes_its_endpoint(
    tmp_path: Path,
) -> None:
    """The episode is lost at once, without waiting for the time that a cut link is allowed."""
    times = ServerTimes(lost_after_s=PATIENCE_S)
    address = Connection(role="policy", listen=f"unixsock-stream/{tmp_path}/hub")
    with ExitStack() as stack:
        with (
            open_session(address) as first,
            served(first.inside, Counting(), listen=address.listen),
        ):
            run = Connection(role="coordinator", connect=address.listen)
            driver = remote_caller(
                "zenoh:counting", PolicyHost(servers=(run,), run="run1"), times=times
            )
            stack.callback(driver.close)
            driver.reset("k1", 7)
            driver.act(observation_at(0))
        stack.enter_context(open_session(address))
        with pytest.raises(PolicyServerLost, match="is gone"):
            driver.act(observation_at(5))


@contextmanager
def driver_after(hub: Connection) -> Iterator[RemoteCaller]:
    """A driver that has seen a server that is now gone."""
    with served(hub, Counting()):
        driver = remote_caller("zenoh:counting", PolicyHost(servers=(hub,), run="run1"), times=SOON)
    try:
        yield driver
    finally:
        driver.close()


@pytest.mark.engine
def test_a_wrong_reply_of_a_server_is_a_policy_crash(hub: Connection) -> None:
    """Garbage, another step, attempt or kind of reply is reported with a reason, and never taken
    for an answer."""
    wrong: dict[str, Callable[[ActRequest], bytes]] = {
        "sent what is no answer": lambda one: b"\xc1 no message",
        "answered step 7 of 'k1' instead of step 0": lambda one: answer_to(one, step=7),
        "answered step 0 of 'k1' instead of step 0, in another attempt": lambda one: answer_to(
            one, attempt="0"
        ),
        "sent what is no answer: Invalid value 'info'": lambda one: encode_message(
            PolicyInfo("s", "wrong", {})
        ),
        "answered step -1 of 'k1' instead of step 0": begin,
    }
    for words, answer in wrong.items():
        with faulty_server(hub, answer), driver_at(hub, "wrong") as driver:
            driver.reset("k1", 7)
            with pytest.raises(PolicyError, match=f"policy 'wrong' {words}"):
                driver.act(observation_at(0))


def answer_to(request: ActRequest, **other: Any) -> bytes:
    return encode_message(
        msgspec.structs.replace(ActReply(*request.signature, request.step, 1.0, 0.0), **other)
    )


def begin(request: ActRequest | ResetRequest) -> bytes:
    return encode_message(EpisodeReply(*request.signature))


@contextmanager
def faulty_server(hub: Connection, answer: Callable[[ActRequest], bytes]) -> Iterator[Session]:
    """A server that begins correctly and then replies as given."""
    info = PolicyInfo("s", "wrong", {"name": "wrong"})
    below = policy_key("default", "wrong", "s")
    with open_session(hub) as session:
        session.serve(f"{below}/info", lambda _: encode_message(info), found=True)
        session.serve(
            f"{below}/reset",
            lambda payload: begin(msgspec.msgpack.decode(payload, type=ResetRequest)),
        )
        session.serve(
            f"{below}/act", lambda payload: answer(msgspec.msgpack.decode(payload, type=ActRequest))
        )
        yield session


@pytest.mark.engine
def test_foreign_messages_are_refused_and_change_nothing(hub: Connection) -> None:
    """Garbage, endless nesting, unknown episodes and wildcard queries are refused, and a run
    continues."""
    policy = Counting()
    with served(hub, policy), driver_at(hub) as driver, open_session(hub) as stranger:
        driver.reset("k1", 7)
        (key,) = stranger.query_all(
            f"{policy_key('default', 'counting', '*')}/info", timeout_s=PATIENCE_S
        )
        key = key.removesuffix("info") + "act"
        sign = ("other", "k9", "a")
        for payload in (
            b"",
            b"\xdf\xff\xff\xff\xff",
            b"\x91" * 100_000,
            encode_message(ActRequest(*sign, 0, 0, 0.0, 0.0, 0.0)),
        ):
            reply = stranger.query_once(key, payload, timeout_s=PATIENCE_S)
            assert reply.outcome == "refused" and isinstance(decode_reply(reply.payload), Refusal)
        everybody = key.rpartition("/")[0].rpartition("/")[0] + "/**"
        assert stranger.query_once(everybody, b"", timeout_s=PATIENCE_S).outcome in (
            "refused",
            "answered",
        )
        assert driver.act(observation_at(0)) == Command(0.1, 0.0) and policy.queried == ["k1"]


@pytest.mark.engine
def test_pictures_come_as_jpeg_on_request(hub: Connection) -> None:
    """Pixels are nearly the same, and every row records the compression."""
    policy = Counting()
    smooth = np.tile(np.linspace(0, 255, 64, dtype=np.uint8)[None, :, None], (40, 1, 3))
    with served(hub, policy, jpeg=True), driver_at(hub) as driver:
        driver.reset("k1", 7)
        driver.act(Observation(0, 0.0, smooth, 0.0, 0.0, COURIER, goal=PointGoal(1.0, 2.0)))
        assert driver.runs == "remote, jpeg" and policy.seen.goal.x_m == 1.0
        assert (
            np.abs(policy.seen.rgb.astype(int) - smooth).max() < 12
            and not (policy.seen.rgb == smooth).all()
        )


@pytest.mark.engine
def test_an_unusable_policy_server_is_refused_with_a_reason(hub: Connection) -> None:
    """No server, no endpoint, a privileged policy and too many jobs for an object are refused
    before anything starts."""
    at = PolicyHost(servers=(hub,))
    with pytest.raises(MachineError, match="no server of policy 'counting' at unixsock"):
        remote_caller("zenoh:counting", at, times=ServerTimes(first_found_s=0.2))
    with pytest.raises(UsageError, match="needs --policy-at ENDPOINT"):
        inspected_caller("zenoh:counting", PolicyHost())
    with pytest.raises(
        UsageError, match="--policy-at goes with --policy zenoh:NAME, not with 'route'"
    ):
        inspected_caller("route", at)
    with (
        served(hub, Counting()),
        pytest.raises(UsageError, match="answers for 1 episodes at a time, and there are 4 jobs"),
    ):
        inspected_caller("zenoh:counting", at, 4)
    knows = Counting.manifest | {"privileged": True}
    with (
        served(hub, Counting(), manifest=knows),
        pytest.raises(UsageError, match="a remote one gets only observations"),
    ):
        inspected_caller("zenoh:counting", at)
    wrong = Counting.manifest | {"camera": {"width": 64, "hight": 64}}
    with (
        served(hub, Counting(), manifest=wrong),
        pytest.raises(
            UsageError,
            match=r"unknown field of camera 'hight'\. Valid choices: .*Did you mean height",
        ),
    ):
        inspected_caller("zenoh:counting", at)
    large = Counting.manifest | {"camera": {"width": 2000, "height": 2000}}
    with (
        served(hub, Counting(), manifest=large),
        pytest.raises(UsageError, match="MiB of pictures a step"),
    ):
        inspected_caller("zenoh:counting", at)


def test_a_server_beyond_this_machine_needs_tls_or_insecure() -> None:
    """`serve` refuses open endpoints without either, no endpoint, two endpoints, and a name that
    does not fit a key."""
    with pytest.raises(
        ValueError, match="is beyond this machine and unguarded: anyone who can reach it may query"
    ):
        serve(Counting(), listen="tcp/0.0.0.0:7449")
    for ends in (
        {},
        {"listen": "tcp/127.0.0.1:1", "connect": "tcp/127.0.0.1:1"},
        {"listen": "udp/127.0.0.1:1"},
    ):
        with pytest.raises(ValueError, match="listen or connect, one of both"):
            serve(Counting(), **ends)
    with pytest.raises(ValueError, match="cannot stand in a key"):
        serve(Counting(), name="a/**", listen="tcp/127.0.0.1:1")


@pytest.mark.engine
def test_several_cosim_serve_processes_answer_for_one_policy(tmp_path: Path) -> None:
    """One process listens and another connects to it; a policy with privileged knowledge is
    refused."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    words = [
        sys.executable,
        "-m",
        "cosim",
        "serve",
        "tests.support.hostile:Honest",
        "--name",
        "both",
    ]
    at = Connection(role="coordinator", connect=endpoint)
    with (
        subprocess.Popen(
            [*words, "--listen", endpoint], cwd=ROOT, stdout=subprocess.PIPE, text=True
        ) as one,
        subprocess.Popen(
            [*words, "--connect", endpoint], cwd=ROOT, stdout=subprocess.PIPE, text=True
        ) as other,
    ):
        try:
            assert (
                one.stdout is not None
                and "policy 'both' answers at tcp/127.0.0.1:" in one.stdout.readline()
            )
            assert other.stdout is not None and "stop with Ctrl-C" in other.stdout.readline()
            servers = PolicyServers("both", PolicyHost(servers=(at,)))
            wait_until(lambda: len(servers.find_policy(PATIENCE_S)) == 2)
            servers.close()
            driver = remote_caller("zenoh:both", PolicyHost(servers=(at,), run="r"))
            driver.reset("k1", 1)
            assert driver.act(observation_at(0)).v_mps == pytest.approx(1.0 + RGB.mean() / 1e4)
            driver.close()
            one.send_signal(signal.SIGINT)
            assert one.wait(PATIENCE_S) == 130
        finally:
            one.kill()
            other.kill()


def test_a_privileged_policy_is_not_served(cosim: Cosim) -> None:
    """`serve` refuses it, and a run refuses an endpoint for a local policy, each in one line."""
    result = cosim("serve", "route")
    assert result.returncode == 2 and "a remote one gets only observations" in result.stderr
    result = cosim("run", "unit", "--policy", "stop", "--policy-at", "tcp/127.0.0.1:7449")
    assert (
        result.returncode == 2
        and "--policy-at goes with --policy zenoh:NAME, not with 'stop'" in result.stderr
    )
    result = cosim("serve", "stop", "--listen", "tcp/0.0.0.0:7449")
    assert result.returncode == 2 and "is beyond this machine and unguarded" in result.stderr

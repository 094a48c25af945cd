"""The policy `ros2:` against ROS 2 nodes over real sessions, without an engine of the street."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import pytest

from bridge.ros2 import messages, types
from bridge.ros2.commands import PATH, TWIST, TWIST_STAMPED
from bridge.ros2.node import Network
from bridge.session import open_session
from cosim.core.errors import PolicyError, UsageError
from cosim.core.state import Command, WaypointCommand
from cosim.episode.interfaces import Observation
from cosim.spec.connection import Connection
from cosim.spec.goal import PointGoal
from cosim.spec.odometry import Odometry
from cosim.spec.options import PolicyHost
from cosim.spec.robot import COURIER
from cosim.spec.ros2 import CMD_VEL, PLAN, Ros2Settings
from cosim.spec.run_config import RunConfig
from scenarios.runs import ros2_policy
from scenarios.runs.policy_host import policy_caller
from scenarios.runs.ros2_policy import Ros2Caller, ros2_caller
from tests.conftest import wait_until
from tests.support.plain import free_port
from tests.support.ros2_peer import Peer, Seen, answers, stamped, steer, twist

pytestmark = pytest.mark.engine


@pytest.fixture(autouse=True)
def short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes of a test start together, and a lost node is noticed quickly."""
    monkeypatch.setattr(ros2_policy, "JOINED_S", 0.2)
    monkeypatch.setattr(ros2_policy, "GONE_S", 0.3)
    monkeypatch.setattr(ros2_policy, "SETTLE_S", 0.1)
    monkeypatch.setattr(ros2_policy, "HINT_S", 0.3)


def observation_at(tick: int, **more: Any) -> Observation:
    values: dict[str, Any] = {
        "goal": PointGoal(10.0 - 0.1 * tick, 1.0),
        "odometry": Odometry(0.1 * tick, 0.0, 0.0),
    }
    return Observation(tick, tick / 20.0, None, 0.5, 0.0, COURIER, **(values | more))


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@contextmanager
def open_driver(endpoint: str, **more: Any) -> Iterator[Ros2Caller]:
    """The driver of `ros2:` that listens at an endpoint."""
    settings = Ros2Settings(
        connection=Connection(role="coordinator", listen=endpoint, guests=("ros2",)),
        **({"camera": "none", "start_s": 6.0, "answer_s": 2.0} | more),
    )
    driver = ros2_caller("ros2:", PolicyHost(ros2=settings))
    driver.policy._joined()  # type: ignore[attr-defined]  so that nodes find it
    try:
        yield driver
    finally:
        driver.close()


def test_a_node_drives_in_lockstep(endpoint: str) -> None:
    """Each observation is answered by the node's command for it; /clock rises every 50 ms before
    stamps of its time; a new episode sets it back and is announced."""
    with open_driver(endpoint) as driver, Peer(endpoint) as peer:
        for episode in ("k1", "k2"):
            driver.reset(episode, 7)
            for tick in (0, 2, 4):
                command = driver.act(observation_at(tick))
                assert command == steer(Seen(0, 0.1 * tick, 0.0, 0.0, (10.0, 1.0)))
        assert driver.runs == "ros2, next" and driver.clock["answer_median_ms"] > 0.0
        stamps = [messages.ns_of(one.header.stamp) for one in peer.seen["/odom"]]
        assert stamps == 2 * [10**9, 11 * 10**8, 12 * 10**8]
        clock = [messages.ns_of(one.clock) for one in peer.seen["/clock"]]
        assert clock == 2 * [10**9 + 5 * 10**7 * tick for tick in range(5)]
        announced = [msgspec.json.decode(one.data) for one in peer.seen["/cosim/episode"]]
        assert [(one["episode"], one["seed"], one["reset"]) for one in announced] == [
            ("k1", 7, False),
            ("k2", 7, False),
        ]
        driver.act(observation_at(6, reset=True))
        assert msgspec.json.decode(peer.seen["/cosim/episode"][-1].data)["reset"]


def test_a_monotonic_clock_never_goes_back(endpoint: str) -> None:
    """With --ros2-clock monotonic the next episode continues the time of the last one, also with a
    new driver, as after a crash."""
    clock = []
    for episodes in (("k1", "k2"), ("k3",)):
        with (
            open_driver(endpoint, clock="monotonic", domain=7) as driver,
            Peer(endpoint, network=Network(7)) as peer,
        ):
            for episode in episodes:
                driver.reset(episode, 7)
                for tick in (0, 2):
                    driver.act(observation_at(tick))
            clock += [messages.ns_of(one.clock) for one in peer.seen["/clock"]]
    assert clock == sorted(set(clock)) and len(clock) == 9


def test_stamped_waits_for_the_command_of_the_picture(endpoint: str) -> None:
    """A late answer to an older observation is skipped; a Twist and a wall clock never drive."""

    def late(peer: Peer, seen: Seen) -> None:
        now_ns = seen.time_ns
        for command, time_ns in (
            (Command(0.1, 0.0), now_ns - 10**8),
            (Command(0.2, 0.0), int(1.8e18)),
            (Command(0.3, 0.0), now_ns),
        ):
            peer.node.publish(CMD_VEL, stamped(command, time_ns))

    with (
        open_driver(endpoint, wait="stamped") as driver,
        Peer(endpoint, late, type_name=TWIST_STAMPED),
    ):
        driver.reset("k1", 7)
        assert [driver.act(observation_at(tick)).v_mps for tick in (0, 2)] == [0.3, 0.3]


def test_rate_holds_a_command_for_half_a_second(endpoint: str) -> None:
    """Without a command within two periods the last one is repeated, and after 0.5 s of simulated
    time the robot stops."""

    def once(peer: Peer, seen: Seen) -> None:
        if len(peer.seen["/odom"]) == 1:
            answers(peer, seen)

    with open_driver(endpoint, wait="rate", rate_hz=20.0) as driver, Peer(endpoint, once):
        driver.reset("k1", 7)
        first = next(k for k in range(60) if driver.act(observation_at(k)).v_mps == 1.0)
        speeds = [driver.act(observation_at(first + k)).v_mps for k in (5, 10, 11)]
        assert speeds == [1.0, 1.0, 0.0]


def test_rate_takes_the_newest_command(endpoint: str) -> None:
    """Of a burst, the last command drives; one that came before the observation is not lost."""

    def once(peer: Peer, seen: Seen) -> None:
        if len(peer.seen["/odom"]) == 1:
            answers(peer, seen)

    with open_driver(endpoint, wait="rate") as driver, Peer(endpoint, once) as peer:
        driver.reset("k1", 7)
        driver.act(observation_at(0))
        inbox = driver.policy._inbox  # type: ignore[attr-defined]
        for v_mps in (0.4, 0.5, 0.6):
            peer.node.publish(CMD_VEL, twist(Command(v_mps, 0.0)))
        wait_until(lambda: len(inbox) == 3)
        assert driver.act(observation_at(2)).v_mps == 0.6


def test_rate_waits_for_a_first_command_and_notices_that_a_node_left(endpoint: str) -> None:
    """The first command has the start timeout; a node that left is named before the timeout ends."""

    def slow(peer: Peer, seen: Seen) -> None:
        if seen.time_ns == 10**9 + 6 * 10**8:
            answers(peer, seen)

    more = {"wait": "rate", "answer_s": 0.4, "start_s": 30.0}
    with open_driver(endpoint, **more) as driver, Peer(endpoint, slow) as peer:
        driver.reset("k1", 7)
        assert [driver.act(observation_at(tick)).v_mps for tick in range(0, 14, 2)] == 6 * [0.0] + [
            1.0
        ]
        driver.policy.settings = msgspec.structs.replace(  # type: ignore[attr-defined]
            driver.policy.settings,  # type: ignore[attr-defined]
            answer_s=30.0,
        )
        peer.close()
        with pytest.raises(PolicyError, match="is gone: /driver published /cmd_vel"):
            for tick in range(14, 200, 2):
                driver.act(observation_at(tick))


@pytest.mark.parametrize(
    ("sends", "words"),
    [
        (lambda seen: twist(Command(math.nan, 0.0)), "finite"),
        (lambda seen: stamped(Command(1.0, 0.0), int(1.8e18)), "use_sim_time"),
    ],
    ids=["nan", "wall clock"],
)
def test_an_invalid_command_crashes_with_a_description(
    endpoint: str, sends: Any, words: str, capfd: Any
) -> None:
    """The episode crashes at its timeout; the message says what was sent, by which node, and is
    printed once."""
    type_name = TWIST if words == "finite" else TWIST_STAMPED
    with (
        open_driver(endpoint, start_s=4.0) as driver,  # a busy machine answers after seconds
        Peer(
            endpoint,
            lambda peer, seen: [peer.node.publish(CMD_VEL, sends(seen)) for _ in range(3)] and None,
            type_name=type_name,
        ),
    ):
        driver.reset("k1", 7)
        with pytest.raises(PolicyError, match=f"gave no command .* /driver .*{words}"):
            driver.act(observation_at(0))
        assert capfd.readouterr().err.count(words) == 1


@pytest.mark.parametrize(
    ("network", "type_name", "words"),
    [
        (Network(), "std_msgs/msg/String", "/driver publishes /cmd_vel as std_msgs/msg/String"),
        (Network(5), TWIST, "in domain 5, and this episode is in domain 0: set ROS_DOMAIN_ID=0"),
        (
            Network(namespace="/robot1"),
            TWIST,
            "/robot1/driver publishes /robot1/cmd_vel, not /cmd_vel",
        ),
        (Network(distro="humble"), TWIST, "run with --ros2-distro humble"),
    ],
    ids=["type", "domain", "namespace", "humble"],
)
def test_a_node_that_cannot_drive_is_described(
    endpoint: str, network: Network, type_name: str, words: str
) -> None:
    """The crash names a wrong type, domain, namespace or distribution, which is also shown while
    the run waits."""
    shown: list[str] = []
    with (
        open_driver(endpoint, start_s=1.2) as driver,
        Peer(endpoint, network=network, type_name=type_name),
        pytest.raises(PolicyError, match="is missing after") as error,
    ):
        driver.on_reason(shown.append)
        driver.reset("k1", 7)
    assert words in str(error.value)
    assert len(shown) == 1 and shown[0].startswith("waits for a node: ") and words in shown[0]


def test_without_a_node_the_crash_says_how_nodes_connect(endpoint: str) -> None:
    """Without a node, the message has the endpoint, the mode and the other dialect."""
    with (
        open_driver(endpoint, start_s=1.0) as driver,
        pytest.raises(
            PolicyError,
            match=f"no ROS 2 node is at {endpoint}.*mode client and this endpoint.*ros2dds",
        ),
    ):
        driver.reset("k1", 7)


ODOM_AS_TWIST = (
    "/driver subscribes to /odom as geometry_msgs/msg/Twist, it is nav_msgs/msg/Odometry"
)


@pytest.mark.parametrize(
    ("reads", "words"),
    [
        ({"/odom": TWIST}, ODOM_AS_TWIST),
        ({"/odom": TWIST, "/clock": "rosgraph_msgs/msg/Clock"}, ODOM_AS_TWIST),
        ({"/odom": "nav_msgs/msg/Odometry"}, "no message came on /cmd_vel"),
        (
            {"/plan": PATH},
            "/driver publishes /cmd_vel and subscribes only to /plan, and the run publishes none",
        ),
        ({}, "/driver publishes /cmd_vel and subscribes to no topic"),
        (
            {"/scan": "sensor_msgs/msg/LaserScan"},
            "/driver subscribes to /scan, and this run sends nothing there: see --ros2-scan",
        ),
    ],
    ids=["type", "one of two", "silent", "other topic", "none", "no scan"],
)
def test_a_node_without_commands_is_described(
    endpoint: str, reads: dict[str, str], words: str, monkeypatch: Any
) -> None:
    """A subscription of a wrong type, one to a silent topic, or none is in the crash message and
    shown while waiting."""
    monkeypatch.setattr(ros2_policy, "SETTLED_S", 0.6)
    shown: list[str] = []
    with open_driver(endpoint, start_s=1.6) as driver, Peer(endpoint, reads=False) as peer:
        for topic, name in reads.items():
            peer.node.subscribe(topic, (name,), lambda got: None)
        driver.on_reason(shown.append)
        driver.reset("k1", 7)
        with pytest.raises(PolicyError, match="gave no command for") as error:
            driver.act(observation_at(0))
    assert f"s: {words}" in str(error.value)
    assert len(shown) == 1 and f": {words}" in shown[0]


def test_humble_nodes_drive_with_their_distribution(endpoint: str) -> None:
    """With --ros2-distro humble the keys have no hash on either side."""
    with (
        open_driver(endpoint, distro="humble", domain=3, namespace="/env") as driver,
        Peer(endpoint, network=Network(3, "/env", "humble")),
    ):
        driver.reset("k1", 7)
        assert driver.act(observation_at(0)).v_mps == 1.0


def test_nodes_behind_the_dds_bridge_drive(endpoint: str) -> None:
    """With --ros2-dialect ros2dds the keys are bare topic names, and commands need no attachment."""
    with (
        open_driver(endpoint, dialect="ros2dds") as driver,
        Peer(endpoint, network=Network(dialect="ros2dds")),
    ):
        driver.reset("k1", 7)
        assert [driver.act(observation_at(tick)).v_mps for tick in (0, 2)] == [1.0, 1.0]


def test_a_lost_node_is_a_crash_and_a_new_one_drives_the_next_episode(endpoint: str) -> None:
    """A node that ends in an episode is named, its tokens are gone, and the next episode waits for
    another."""

    def silent(peer: Peer, seen: Seen) -> None:
        if seen.time_ns == 10**9:
            answers(peer, seen)

    with open_driver(endpoint, answer_s=30.0) as driver:
        with Peer(endpoint, silent) as peer:
            driver.reset("k1", 7)
            driver.act(observation_at(0))
            threading.Timer(0.3, peer.close).start()
            with pytest.raises(
                PolicyError, match="is gone: /driver published /cmd_vel, and has left"
            ):
                driver.act(observation_at(2))
        with Peer(endpoint):
            driver.reset("k2", 7)
            assert driver.act(observation_at(0)).v_mps == 1.0


def test_two_nodes_do_not_drive_together(endpoint: str, capfd: Any) -> None:
    """Two publishers are reported and shown at the start; their commands crash the episode."""
    both = r"two publishers of /cmd_vel, /(one|two) and /(one|two): stop one"
    shown: list[str] = []
    with open_driver(endpoint) as driver, Peer(endpoint, name="one"), Peer(endpoint, name="two"):
        driver.on_reason(shown.append)
        driver.reset("k1", 7)
        assert len(shown) == 1 and re.match(f"there are {both}", shown[0])
        assert re.search(f"there are {both}", capfd.readouterr().err)
        with pytest.raises(PolicyError, match=f"is {both}"):
            for tick in range(0, 100, 2):
                driver.act(observation_at(tick))


def test_two_nodes_behind_dds_bridges_do_not_drive(endpoint: str, monkeypatch: Any) -> None:
    """Without attachments an episode does not start with two publishers, and a second one, even
    without a command, crashes it."""
    monkeypatch.setattr(ros2_policy, "SETTLED_S", 0.5)
    network = Network(dialect="ros2dds")
    with open_driver(endpoint, dialect="ros2dds") as driver, Peer(endpoint, network=network):
        driver.reset("k1", 7)
        driver.act(observation_at(0))
        with Peer(endpoint, lambda *_: None, network=network):
            wait_until(lambda: len(driver.policy._node.publishers_of(CMD_VEL)) == 2)  # type: ignore
            for call in (lambda: driver.act(observation_at(2)), lambda: driver.reset("k2", 7)):
                with pytest.raises(PolicyError, match="is two publishers of /cmd_vel, a node of"):
                    call()
        wait_until(lambda: len(driver.policy._node.publishers_of(CMD_VEL)) == 1)  # type: ignore
        driver.reset("k3", 7)
        assert driver.act(observation_at(0)).v_mps == 1.0


@pytest.mark.parametrize(
    ("dialect", "words"),
    [
        ("rmw_zenoh", r"is gone: /driver left and came back at 0\.\d0 s\."),
        ("ros2dds", "is gone: a node of .* has left, and a node of .* publishes it now"),
    ],
    ids=["rmw_zenoh", "ros2dds"],
)
@pytest.mark.parametrize("when", ["between", "waits"])
def test_a_restarted_node_is_not_two_nodes(
    endpoint: str, dialect: Any, words: str, when: str, monkeypatch: Any
) -> None:
    """A node that restarts in an episode is reported at once as restarted, even without the
    observation; the next episode uses the new one."""
    monkeypatch.setattr(ros2_policy, "GONE_S", 30.0)
    network = Network(dialect=dialect)

    def once(peer: Peer, seen: Seen) -> None:
        if when == "between" or seen.time_ns == 10**9:
            answers(peer, seen)

    with open_driver(endpoint, dialect=dialect, answer_s=60.0) as driver:
        old = Peer(endpoint, once, network=network)
        driver.reset("k1", 7)
        driver.act(observation_at(0))
        node = driver.policy._node  # type: ignore[attr-defined]

        def restart() -> None:
            if when == "waits":
                wait_until(lambda: len(old.seen["/odom"]) == 2)
            old.close()
            new.append(Peer(endpoint, network=network))

        new: list[Peer] = []
        restarts = threading.Thread(target=restart)
        restarts.start()
        if when == "between":
            restarts.join()
            wait_until(lambda: node.has_subscriber("/odom") and node.subscriptions_arrived())
        began_s = time.monotonic()
        with pytest.raises(PolicyError, match=words):
            driver.act(observation_at(2, goal=PointGoal(5.0, 1.0)))
        assert time.monotonic() - began_s < 30.0, "it waited for the timeout"
        restarts.join()
        with new[0]:
            driver.reset("k2", 7)
            assert driver.act(observation_at(0)).v_mps == 1.0


def test_a_kind_of_fault_is_reported_once_in_an_episode(endpoint: str, capfd: Any) -> None:
    """Messages with one kind of fault make one line and a count, in each episode again."""
    bad = iter(range(1000))

    def sends(peer: Peer, seen: Seen) -> None:
        for _ in range(20):
            peer.node.publish(CMD_VEL, twist(Command(math.inf, float(next(bad)))))
        answers(peer, seen)

    with open_driver(endpoint) as driver, Peer(endpoint, sends):
        for episode in ("k1", "k2"):
            driver.reset(episode, 7)
            for tick in (0, 2):
                driver.act(observation_at(tick))
            lines = capfd.readouterr().err.splitlines()
            assert sum("both must be finite" in line for line in lines) == 1 + (episode == "k2")
        assert "40 messages in the episode: /driver sends /cmd_vel" in lines[0]


def test_a_long_plan_is_recorded_and_one_too_long_is_reported(endpoint: str, capfd: Any) -> None:
    """A plan of 200 KiB is read; the length of one above 1 MiB is reported while the node continues
    to drive."""
    where = types.message("geometry_msgs/msg/Point", 3.0, 0.0, 0.0)
    turn = types.message("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    pose = types.message("geometry_msgs/msg/Pose", where, turn)

    def plan(poses: int) -> Any:
        header = messages.header(10**9, "odom")
        stamped_pose = types.message("geometry_msgs/msg/PoseStamped", header, pose)
        return types.message(PATH, header, poses * [stamped_pose])

    plans = iter((plan(2500), plan(20_000)))

    def sends(peer: Peer, seen: Seen) -> None:
        if (one := next(plans, None)) is not None:
            peer.node.publish(PLAN, one)
        answers(peer, seen)

    with open_driver(endpoint, answer_s=30.0) as driver, Peer(endpoint, sends) as peer:
        peer.node.advertise(PLAN, PATH)
        driver.reset("k1", 7)
        ticks = iter(range(0, 2000, 2))
        wait_until(lambda: isinstance(driver.act(observation_at(next(ticks))), WaypointCommand))
        driver.act(observation_at(next(ticks)))  # the node sends its second plan
        wait_until(lambda: driver.policy._remarks.words)  # type: ignore[attr-defined]
        assert not isinstance(driver.act(observation_at(next(ticks))), WaypointCommand)
    assert capfd.readouterr().err.count("a message has at most 1048576") == 1


def test_an_episode_starts_when_a_node_reads(endpoint: str) -> None:
    """A node that publishes first and subscribes later does not miss the first observation."""
    with open_driver(endpoint, start_s=30.0) as driver, Peer(endpoint, reads=False) as peer:
        threading.Timer(1.0, peer.subscribe).start()
        driver.reset("k1", 7)
        assert driver.act(observation_at(0)).v_mps == 1.0


def test_a_flood_of_commands_and_long_messages_does_not_stop_the_drive(endpoint: str) -> None:
    """A thousand commands after each answer, and megabytes: the drive continues."""

    def flood(peer: Peer, seen: Seen) -> None:
        answers(peer, seen)
        for _ in range(1000):
            answers(peer, seen)
        for size_b in (1 << 20, 3 << 20):
            peer.session.publish(peer.node._publishers[CMD_VEL].key, bytes(size_b))

    with open_driver(endpoint) as driver, Peer(endpoint, flood):
        driver.reset("k1", 7)
        assert {driver.act(observation_at(tick)).v_mps for tick in range(0, 20, 2)} == {1.0}


def test_a_late_node_gets_the_latched_topics(endpoint: str) -> None:
    """Constant transforms, goal and episode reach a node that requests the history within a second."""
    late: dict[str, bytes] = {}
    with open_driver(endpoint) as driver, Peer(endpoint):
        driver.reset("k1", 7)
        driver.act(observation_at(0))
        with open_session(Connection(role="worker", connect=endpoint)) as session:
            began_s = time.monotonic()
            for topic in (messages.STATIC, messages.GOAL, messages.EPISODE):
                session.subscribe(
                    f"0{topic}/*/*",
                    lambda key, payload, _: late.update({key: payload}),
                    history=True,
                )
            wait_until(lambda: len(late) == 3)
            assert time.monotonic() - began_s < 30.0


def test_settings_are_checked_before_anything_opens() -> None:
    """ROS 2 options without the policy, two endpoints, a domain beyond the last and bad values are
    refused with a remedy."""
    wrong: dict[str, dict[str, Any]] = {
        "--ros2-wait goes with --policy ros2:": {"policy": "orca", "ros2_wait": "rate"},
        "listens or connects, not both": {
            "ros2_at": "tcp/h:1",
            "ros2_listen": "tcp/127.0.0.1:7448",
        },
        "the last is 232": {"ros2_domain": 232, "jobs": 2},
        "it has one name": {"ros2_dialect": "ros2dds", "ros2_namespace": "/a/b"},
        "has no domains": {"ros2_dialect": "ros2dds", "jobs": 2},
        "write it as 512x288": {"ros2_camera": "big"},
        "write it as 360, 360@20": {"ros2_scan": "0"},
        "letters, digits and _": {"ros2_namespace": "env-1"},
        "needs a camera": {"ros2_camera": "none", "ros2_depth": True},
        "is beyond this machine": {"ros2_listen": "tcp/0.0.0.0:7447"},
    }
    for words, fields in wrong.items():
        with pytest.raises(UsageError, match=words):
            RunConfig(**({"policy": "ros2:"} | fields))
    config = RunConfig(
        policy="ros2:mine", ros2_scan="1024x16@50", ros2_camera="320x240@60", ros2_domain=4
    )
    driver = policy_caller("ros2:mine", PolicyHost(ros2=config.ros2))
    assert driver.manifest.name == "mine" and driver.manifest.scan is not None
    assert (driver.manifest.scan.rings, driver.manifest.scan.range_m) == (16, 50.0)
    assert PolicyHost(ros2=config.ros2).of_job(2).ros2.domain == 6  # type: ignore[union-attr]
    with pytest.raises(UsageError, match="--isolated out"):
        policy_caller("ros2:", PolicyHost(ros2=config.ros2, isolated="auto"))

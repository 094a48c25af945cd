"""What the role `ros2` may do at a run's hub: plain Zenoh tries each act over TLS on loopback."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from bridge.ros2.types import HASHES
from bridge.ros2.wire import Endpoint, rmw_key, rmw_token
from bridge.security.authority import issue, make_authority
from bridge.session import Session, open_session
from cosim.core.errors import AccessError, EngineError
from cosim.spec.connection import Connection
from cosim.spec.ros2 import COMMAND_TOPICS, MAX_MESSAGE_B, PUBLISHED_TOPICS
from tests.conftest import wait_until
from tests.support.plain import free_port, plain_zenoh

pytestmark = pytest.mark.engine


def key(topic: str, name: str) -> str:
    return rmw_key(3, topic, name, HASHES[name])


OUT = {topic: key(topic, name) for topic, name in PUBLISHED_TOPICS.items()}
IN = {topic: key(topic, names[0]) for topic, names in COMMAND_TOPICS.items()}
FOREIGN = (
    "3/other/std_msgs::msg::dds_::String_/RIHS01_0",
    "cosim/r/env/e/inject",
    "cosim/r/jobs/claim",
)
GIVEN_UP_S = 0.5
"""Time in seconds after which a refused message counts as not delivered."""
TOKEN = rmw_token(Endpoint("NN", 3, "ab", "driver"))


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tls") / "certs"
    make_authority(folder, ["localhost"], 365)
    for role in ("ros2", "viewer"):
        issue(folder, role, [], 365)  # type: ignore[arg-type]
    return folder


class Hub:
    """A run's hub and its own process; `received` are the keys of messages from outside that reached
    them."""

    def __init__(self, certs: Path, stack: ExitStack) -> None:
        self.at = f"tls/localhost:{free_port()}"
        end = Connection(
            role="coordinator", listen=self.at, tls=str(certs / "coordinator"), guests=("ros2",)
        )
        self.session = stack.enter_context(open_session(end))
        self.run: Session = stack.enter_context(open_session(self.session.inside))
        self.received: list[tuple[str, int]] = []
        self.tokens: list[str] = []
        for topic, name in OUT.items():
            self.run.advertise(name, latched=int(topic == "/tf_static"))
        self.run.declare_token(rmw_token(Endpoint("NN", 3, "cd", "cosim")))
        self.run.subscribe(
            "**", lambda name, payload, _: self.received.append((name, len(payload)))
        )
        for tokens in ("@ros2_lv/**", "cosim/**"):
            self.run.watch_tokens(tokens, lambda name, alive: self.tokens.append(name))


@pytest.fixture(scope="module")
def hub(certs: Path) -> Iterator[Hub]:
    with ExitStack() as stack:
        yield Hub(certs, stack)


def test_a_node_receives_topics_and_sends_only_commands_and_plans(certs: Path, hub: Hub) -> None:
    """A node gets every published topic and sees the run's token; of its messages only commands,
    plans and tokens arrive."""
    with plain_zenoh(hub.at, certs, "ros2") as guest:
        received: list[str] = []
        guest.declare_subscriber("3/**", lambda sample: received.append(str(sample.key_expr)))
        for name in OUT.values():
            guest.declare_subscriber(name, lambda sample: received.append(str(sample.key_expr)))
        queried: list[str] = []
        for name in (*IN.values(), *FOREIGN):
            guest.declare_queryable(name, lambda query: queried.append(str(query.key_expr)))
        token = guest.liveliness().declare_token(TOKEN)
        foreign = guest.liveliness().declare_token("cosim/r/workers/one")
        wait_until(lambda: TOKEN in hub.tokens)
        assert "cosim/r/workers/one" not in hub.tokens
        seen = [str(one.ok.key_expr) for one in guest.liveliness().get("@ros2_lv/**") if one.ok]
        assert rmw_token(Endpoint("NN", 3, "cd", "cosim")) in seen

        def all_arrived() -> bool:
            for name in OUT.values():
                hub.run.publish(name, b"x")
            time.sleep(0.05)
            return set(OUT.values()) <= set(received)

        wait_until(all_arrived)
        hub.run.publish_lossy("cosim/r/env/e/robot", b"x")
        hub.received.clear()
        for name in (*FOREIGN, *OUT.values(), IN["/plan"], IN["/cmd_vel"]):
            guest.put(name, b"x")
            guest.delete(name)
        guest.put(IN["/plan"], bytes(MAX_MESSAGE_B))
        guest.put(IN["/cmd_vel"], b"last")
        wait_until(lambda: (IN["/cmd_vel"], 4) in hub.received)
        own = {(name, 1) for name in OUT.values()} | {("cosim/r/env/e/robot", 1)}
        assert set(hub.received) - own == {
            (IN["/plan"], 1),
            (IN["/plan"], MAX_MESSAGE_B),
            (IN["/cmd_vel"], 1),
            (IN["/cmd_vel"], 4),
        }
        for name in (*IN.values(), *FOREIGN):
            assert hub.run.query_all(name, timeout_s=GIVEN_UP_S) == {}
        assert queried == []
        del token, foreign


def test_nodes_do_not_reach_each_other_through_the_run(certs: Path, hub: Hub) -> None:
    """Commands and private topics of one node are not passed to another."""
    with plain_zenoh(hub.at, certs, "ros2") as one, plain_zenoh(hub.at, certs, "ros2") as other:
        received: list[str] = []
        for name in (IN["/cmd_vel"], FOREIGN[0]):
            other.declare_subscriber(name, lambda sample: received.append(str(sample.key_expr)))
        hub.received.clear()
        one.put(FOREIGN[0], b"x")
        one.put(IN["/cmd_vel"], b"x")
        wait_until(lambda: (IN["/cmd_vel"], 1) in hub.received)
        time.sleep(GIVEN_UP_S)
        assert received == []


def test_without_a_node_certificate_nothing_is_received(certs: Path, hub: Hub) -> None:
    """Without a certificate there is no link; a certificate of another role gives a link that
    carries nothing."""
    with plain_zenoh(hub.at, certs, "viewer") as viewer:
        received: list[str] = []
        for name in (*OUT.values(), "**"):
            viewer.declare_subscriber(name, lambda sample: received.append(str(sample.key_expr)))
        hub.received.clear()
        viewer.put(IN["/cmd_vel"], b"forged")
        for name in OUT.values():
            hub.run.publish(name, b"x")
        time.sleep(GIVEN_UP_S)
        assert (IN["/cmd_vel"], 6) not in hub.received
        assert [name for name in received if not name.endswith(IN["/cmd_vel"])] == []
        assert list(viewer.liveliness().get("@ros2_lv/**", timeout=GIVEN_UP_S)) == []
    with pytest.raises((AccessError, EngineError)):
        open_session(Connection(role="worker", connect=hub.at.replace("tls/", "tcp/")))


def test_zenoh_opens_a_session_with_the_configuration_for_nodes(certs: Path, hub: Hub) -> None:
    """`session.json5` of the role connects to the run's machine once its port is set, with the
    timestamps that history needs."""
    path = certs / "ros2" / "session.json5"
    path.write_text(path.read_text().replace(":7447", f":{hub.at.rpartition(':')[2]}"))
    config = zenoh.Config.from_file(path)
    assert config.get_json("timestamping/enabled") == "true"
    with zenoh.open(config) as guest:
        assert [str(one.ok.key_expr) for one in guest.liveliness().get("@ros2_lv/**") if one.ok]


@pytest.mark.parametrize("host", ["fd00::7", ""])
def test_the_configuration_for_nodes_always_names_a_host(tmp_path: Path, host: str) -> None:
    """An IPv6 address has brackets; without a coordinator's certificate there is a placeholder to
    replace."""
    make_authority(tmp_path / "certs", [host or "localhost"], 365)
    if not host:
        (tmp_path / "certs" / "coordinator" / "key.pem").unlink()
    text = (issue(tmp_path / "certs", "ros2", [], 365) / "session.json5").read_text()
    assert f'"tls/{f"[{host}]" if host else "HOST"}:7447"' in text

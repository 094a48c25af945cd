"""What each role may do on a hub: plain Zenoh tries it over TLS on loopback; a refused act has no
effect."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import get_args

import pytest
import zenoh

from bridge.live import MAX_MESSAGE_B
from bridge.security.authority import issue, make_authority
from bridge.session import open_session
from cosim.core.errors import EngineError
from cosim.spec.connection import Connection, Role
from tests.conftest import PATIENCE_S, wait_until
from tests.support.plain import free_port, plain_zenoh
from tests.support.session_pair import listening_at

pytestmark = pytest.mark.engine

ENV = "cosim/r/env/e"
POLICY = "cosim/r/policy/ours/act"
PUBLISHED = tuple(f"{ENV}/{topic}" for topic in ("clock", "robot", "crowd", "signals", "events"))
JOBS = tuple(f"cosim/r/jobs/{act}" for act in ("claim", "report"))
SEEN = (f"{ENV}/status", f"{ENV}/log", f"{ENV}/camera", "cosim/r/status")
QUERIED = (*JOBS, *SEEN, "cosim/r/nets/0", f"{ENV}/inject", f"{ENV}/director", POLICY)
OWN = b"query of the guest"
GIVEN_UP_S = 2.0
"""Time in seconds after which a refused message counts as not delivered."""
MAY_ASK: dict[str, tuple[str, ...]] = {
    "worker": (*JOBS, "cosim/r/status", "cosim/r/nets/0", f"{ENV}/director", POLICY),
    "viewer": SEEN,
    "injector": (f"{ENV}/inject", f"{ENV}/status"),
    "policy": (),
    "coordinator": (f"{ENV}/director", POLICY),
    "director": (),
    "ros2": (),
}
"""Keys that each role may query at a coordinator's hub. Directors have their own hub."""


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of all roles; those of roles that listen are for localhost."""
    folder = tmp_path_factory.mktemp("tls") / "certs"
    make_authority(folder, ["localhost"], 365)
    for role in get_args(Role):
        if role != "coordinator":
            issue(folder, role, ["localhost"] if role in ("director", "policy") else [], 365)
    return folder


def replies(session: zenoh.Session, key: str) -> list[str]:
    """Return all replies to a query, errors included."""
    answers = session.get(
        key, payload=OWN, timeout=PATIENCE_S, consolidation=zenoh.ConsolidationMode.NONE
    )
    return [
        answer.payload.to_string() for one in answers if (answer := one.ok or one.err) is not None
    ]


class Peers:
    """A hub, its run's own process, and a policy server; `seen` are keys of queries and messages,
    `alive` those of tokens."""

    def __init__(self, certs: Path | None, stack: ExitStack) -> None:
        protocol, tls = ("tcp", "") if certs is None else ("tls", str(certs / "coordinator"))
        self.certs = certs
        self.at = f"{protocol}/localhost:{free_port()}"
        self.hub = stack.enter_context(
            open_session(Connection(role="coordinator", listen=self.at, tls=tls))
        )
        self.run = stack.enter_context(open_session(self.hub.inside))
        self.inside = stack.enter_context(plain_zenoh(self.hub.inside.connect, None, ""))
        self.policy = stack.enter_context(plain_zenoh(self.at, certs, "policy"))
        self.seen: list[str] = []
        for key in QUERIED:
            if key != POLICY:
                end = self.run if key.startswith(ENV) else self.hub
                end.serve(key, lambda _, key=key: self._saw(key), found=key == f"{ENV}/status")  # type: ignore[misc]
        self.policy.declare_queryable(POLICY, self._answer)
        self.hub.subscribe("cosim/**", lambda key, *_: self.seen.append(key))
        self.run.subscribe("cosim/**", lambda key, *_: self.seen.append(key))
        wait_until(lambda: self.hub.query(POLICY, b"", timeout_s=PATIENCE_S) == POLICY.encode())

    def _saw(self, key: str) -> bytes:
        self.seen.append(key)
        return key.encode()

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, self._saw(str(query.key_expr)))

    def settle(self) -> None:
        """Wait until everything routed before has arrived, by sending messages of the run and of
        the hub after it."""
        for end in (self.run, self.hub):
            mark = f"{ENV}/mark{time.monotonic_ns()}"
            end.publish_lossy(mark, b"")
            wait_until(lambda mark=mark: self.seen.count(mark) == 2)  # type: ignore[misc]


class Guest:
    """A client that tries everything; `received` are keys of queries and messages that it did not send
    itself."""

    def __init__(self, peers: Peers, role: str, stack: ExitStack) -> None:
        self.air = peers
        self.session = stack.enter_context(plain_zenoh(peers.at, peers.certs, role))
        self.received: list[str] = []
        self.session.declare_queryable("cosim/r/policy/theirs/info", self._answer)
        everything = [] if role in ("policy", "") else [POLICY, "cosim/*/policy/**", "cosim/**"]
        for key in (*JOBS, *SEEN, *PUBLISHED, f"{ENV}/inject", f"{ENV}/director", *everything):
            self.session.declare_queryable(key, self._answer)
        for key in (*PUBLISHED, *JOBS, POLICY, "cosim/r/policy/**", "cosim/**", "**"):
            self.session.declare_subscriber(key, self._hear)
        self.token = self.session.liveliness().declare_token("cosim/r/workers/one")

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if query.payload is None or query.payload.to_bytes() != OWN:
                self.received.append(str(query.key_expr))
            query.reply(query.key_expr, b"FORGED")

    def _hear(self, sample: zenoh.Sample) -> None:
        # No other client deletes; its own deletion arrives when its thread runs.
        if sample.kind == zenoh.SampleKind.PUT and sample.payload.to_string() != "FORGED":
            self.received.append(str(sample.key_expr))

    def passed(self, may_ask: tuple[str, ...]) -> None:
        """Wait until all that it sent before is at the hub, by sending a query after it."""
        if may_ask:
            wait_until(lambda: may_ask[0] in replies(self.session, may_ask[0]))
        else:
            self.answers()
        self.air.settle()

    def answers(self) -> bool:
        """Whether its replies as a policy are received."""
        try:
            return self.air.hub.query("cosim/r/policy/theirs/info", b"", timeout_s=0.5) == b"FORGED"
        except (TimeoutError, EngineError):
            return False


@pytest.fixture(scope="module")
def peers(certs: Path) -> Iterator[Peers]:
    with ExitStack() as stack:
        yield Peers(certs, stack)


def try_all(
    peers: Peers,
    guest: Guest,
    may_ask: tuple[str, ...],
    *,
    watches: bool,
    answers: bool,
    shows: bool,
) -> None:
    """Try all acts; permitted ones work, and no other has any effect."""
    guest.passed(may_ask)
    # queries
    peers.seen.clear()
    for key in QUERIED:
        if key in may_ask:
            wait_until(lambda key=key: key in replies(guest.session, key))  # type: ignore[misc]
        else:
            assert [one for one in replies(guest.session, key) if one != "FORGED"] == [], key
    wide = [
        one
        for key in ("cosim/**", "cosim/*/jobs/*", f"{ENV}/*", "**")
        for one in replies(guest.session, key)
    ]
    assert [one for one in wide if one != "FORGED" and "ask for exactly" not in one] == []
    assert {key for key in peers.seen if "/mark" not in key} == set(may_ask)
    # publications and deletions
    peers.seen.clear()
    for key in (
        *PUBLISHED,
        *JOBS,
        f"{ENV}/inject",
        POLICY,
        "cosim/r/status",
        f"{ENV}/*",
        "cosim/**",
    ):
        guest.session.put(key, b"FORGED")
        guest.session.delete(key)
    guest.passed(may_ask)
    assert {key for key in peers.seen if "/mark" not in key} <= set(may_ask[:1])
    # subscriptions to the run's messages and to queries of a policy
    guest.received.clear()
    for key in PUBLISHED:
        peers.run.publish_lossy(key, b"true")
    peers.hub.query(POLICY, b"secret", timeout_s=PATIENCE_S)
    if watches:
        wait_until(lambda: set(PUBLISHED) <= set(guest.received))
    guest.passed(may_ask)
    foreign = {"cosim/r/policy/theirs/info"} if answers else set()
    assert {key for key in guest.received if key not in PUBLISHED} - foreign == set()
    assert watches == bool(set(PUBLISHED) & set(guest.received))
    # replies in place of others, and as a policy
    for key in (*JOBS, *SEEN, f"{ENV}/inject"):
        assert peers.hub.query(key, b"", timeout_s=PATIENCE_S) == key.encode()
    assert guest.answers() is answers
    # a token as a worker
    alive = [
        str(one.ok.key_expr)
        for one in peers.inside.liveliness().get("cosim/*/workers/*", timeout=PATIENCE_S)
    ]
    assert (alive == ["cosim/r/workers/one"]) is shows


@pytest.mark.parametrize("role", MAY_ASK)
def test_a_role_has_its_own_rights_and_no_others(peers: Peers, role: str) -> None:
    """Each role, with its certificate, tries to query, publish, subscribe, reply, declare tokens
    and use wildcards."""
    with ExitStack() as stack:
        guest = Guest(peers, role, stack)
        try_all(
            peers,
            guest,
            MAY_ASK[role],
            watches=role == "viewer",
            answers=role == "policy",
            shows=role == "worker",
        )


def test_without_certificates_no_client_speaks_for_the_run() -> None:
    """On loopback a client has the rights of all roles together, but not those of the run or its
    hub."""
    with ExitStack() as stack:
        peers = Peers(None, stack)
        may = tuple(key for key in QUERIED if any(key in theirs for theirs in MAY_ASK.values()))
        try_all(peers, Guest(peers, "", stack), may, watches=True, answers=True, shows=True)


@pytest.mark.parametrize(("hub", "key"), [("director", f"{ENV}/director"), ("policy", POLICY)])
def test_only_runs_may_query_directors_and_policy_servers(certs: Path, hub: Role, key: str) -> None:
    """At the hub of a director or a policy server only workers and coordinators may query, and no
    client may reply."""
    at = f"tls/localhost:{free_port()}"
    queries: list[bytes] = []
    with ExitStack() as stack:
        session = stack.enter_context(
            open_session(Connection(role=hub, listen=at, tls=str(certs / hub)))
        )
        session.serve(key, lambda payload: queries.append(payload) or b"honest")  # type: ignore[func-returns-value]
        guests = {
            role: stack.enter_context(plain_zenoh(at, certs, role)) for role in get_args(Role)
        }
        for role, guest in guests.items():
            if role != "policy" or hub != "policy":  # several policy servers may answer
                guest.declare_queryable(key, lambda query: query.reply(query.key_expr, b"FORGED"))
        for role in ("worker", "coordinator"):
            wait_until(lambda role=role: "honest" in replies(guests[role], key))  # type: ignore[misc]
        queries.clear()
        for role in ("director", "policy", "viewer", "injector"):
            assert set(replies(guests[role], key)) <= {"FORGED"}, "only its own answer"
        assert queries == []
        assert session.query(key, b"x", timeout_s=PATIENCE_S) == b"honest"


COPIED = """
import sys
from bridge.policy_server import serve

class Mine:
    manifest = {"name": "mine", "rate_hz": 5.0}
    def reset(self, episode_id, seed): print(f"reset of {episode_id}", flush=True)

serve(Mine, listen=sys.argv[1], tls=sys.argv[2])
"""


def test_only_runs_may_query_the_copied_policy_server(certs: Path) -> None:
    """At `serve` of a copied policy_server.py only workers and coordinators may query, and wildcard
    queries are refused."""
    at = f"tls/localhost:{free_port()}"
    words = [sys.executable, "-c", COPIED, at, str(certs / "policy")]
    with ExitStack() as stack:
        server = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
        stack.callback(server.kill)
        assert server.stdout is not None and "answers at" in server.stdout.readline()
        guests = {
            role: stack.enter_context(plain_zenoh(at, certs, role)) for role in get_args(Role)
        }
        info = "cosim/default/policy/mine/*/info"
        for role in ("worker", "coordinator"):
            wait_until(lambda role=role: len(list(guests[role].get(info))) == 1)  # type: ignore[misc]
        for role in ("director", "policy", "viewer", "injector"):
            assert list(guests[role].get(info)) == [], role
        guests["viewer"].declare_queryable(
            "cosim/**", lambda query: query.reply(query.key_expr, b"FORGED")
        )
        begin = b"\x85\xa4type\xa5reset\xa3run\xa1r\xa7episode\xa1e\xa7attempt\xa1a\xa4seed\x00"
        (wide,) = guests["worker"].get(info.replace("info", "reset"), payload=begin)
        assert b"not a question" in wide.err.payload.to_bytes()
        (reply,) = guests["worker"].get(info)
        (begun,) = guests["worker"].get(
            str(reply.ok.key_expr).replace("info", "reset"), payload=begin
        )
        assert (
            b"begun" in begun.ok.payload.to_bytes() and server.stdout.readline() == "reset of e\n"
        )


@pytest.mark.parametrize(
    "written", ["application/python-serialized-object", "application/x-unheard-of"]
)
def test_pickled_and_unknown_messages_are_refused(tmp_path: Path, written: str) -> None:
    """A message with a pickled Python object or an unknown type is refused with the types that are
    read."""
    claims: list[bytes] = []
    at = f"unixsock-stream/{tmp_path}/hub.sock"
    with listening_at(at) as hub, plain_zenoh(at, None, "") as guest:
        hub.serve("cosim/r/jobs/claim", lambda payload: claims.append(payload) or b"taken")  # type: ignore[func-returns-value]
        refusals = [
            one.err.payload.to_string()
            for one in guest.get("cosim/r/jobs/claim", payload=b"x", encoding=written)
        ]
        assert (
            refusals
            == [f"'{written}' is not read here: send application/msgpack or application/json"]
            and not claims
        )
        for fine in ("application/json", "application/msgpack", None):
            (one,) = guest.get("cosim/r/jobs/claim", payload=b"x", encoding=fine)
            assert one.ok.payload.to_bytes() == b"taken"


def test_a_too_long_message_is_dropped(certs: Path) -> None:
    """A message longer than 64 KiB is dropped, and one of a role without rights ends no link."""
    at = f"tls/localhost:{free_port()}"
    lengths: list[int] = []
    with ExitStack() as stack:
        hub = stack.enter_context(
            open_session(Connection(role="coordinator", listen=at, tls=str(certs / "coordinator")))
        )
        for key in (f"{ENV}/inject", f"{ENV}/status"):
            hub.serve(key, lambda payload: lengths.append(len(payload)) or b"taken")  # type: ignore[func-returns-value]
        guest = stack.enter_context(plain_zenoh(at, certs, "injector"))
        wait_until(lambda: replies(guest, f"{ENV}/status") == ["taken"])
        lengths.clear()
        for length in (MAX_MESSAGE_B, MAX_MESSAGE_B + 1, 1 << 20, 20 << 20):
            list(guest.get(f"{ENV}/inject", payload=bytes(length), timeout=GIVEN_UP_S))
        wait_until(lambda: replies(guest, f"{ENV}/status") == ["taken"])
        assert lengths == [MAX_MESSAGE_B, len(OWN)]

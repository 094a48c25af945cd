"""Zenoh sessions: the only module that imports zenoh.

A session uses one explicit endpoint, or none, without discovery and shared memory. A handler that
raises sends an error reply. `open_session` opens sessions to other processes.
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Literal, NamedTuple, Self

import zenoh
import zenoh.ext

from bridge.security.settings import local_settings, session_settings
from cosim.core.errors import AccessError, EngineError
from cosim.spec.connection import Connection

Handler = Callable[[bytes], bytes]
Publisher = zenoh.Publisher | zenoh.ext.AdvancedPublisher
_Subscriber = zenoh.Subscriber["zenoh.Handler[zenoh.Sample]"]

_SOURCE_LINE = re.compile(r" at /\S+\.rs:\d+\.?")
"""Source location in Zenoh's errors."""

_ANSWER = "answer"
"""Last chunk of the key of replies in a `LocalSession`."""
_ENCODINGS = (
    "zenoh/bytes",
    "application/msgpack",
    "application/json",
    "text/json",
    "text/plain",
    "zenoh/string",
)
"""Accepted encodings of messages: none creates arbitrary objects."""
_LONGEST_FOLDER = 70
"""Longest folder name in characters: the path of a Unix socket has at most 107."""
_FIRST_RETRY_S = 0.005
"""First pause in seconds between retries; it doubles with each retry."""
_LONGEST_RETRY_S = 0.2
"""Longest pause in seconds between retries."""
_HEARTBEAT_MS = 500
"""Period of the heartbeats of a latched publisher in ms, as rmw_zenoh's."""


class Query:
    """Query that can be answered once, from any thread.

    key: Key expression of the query.
    payload: Bytes of the query.
    """

    def __init__(self, query: zenoh.Query) -> None:
        self.key = str(query.key_expr)
        self.payload = bytes(query.payload.to_bytes()) if query.payload is not None else b""
        self._query: zenoh.Query | None = query

    def answer(self, payload: bytes) -> None:
        """Send the reply; without effect if the querier has left."""
        query = self._query
        self._query = None
        if query is not None:
            with suppress(zenoh.ZError), query:
                query.reply(self.key, payload)

    def refuse(self, words: str) -> None:
        """Send an error reply."""
        query = self._query
        self._query = None
        if query is not None:
            with suppress(zenoh.ZError), query:
                query.reply_err(words.encode())


QueryOutcome = Literal["answered", "refused", "timeout", "unserved"]
"""Outcome of a query: reply, error reply, timeout, or no queryable on its key."""


class QueryResult(NamedTuple):
    """Result of a query with the payload of its reply."""

    outcome: QueryOutcome
    payload: bytes = b""


class Session:
    """Open Zenoh session. Use as a context manager: an open session keeps the process alive.

    inside: For a listening session, the connection of its own processes on this machine, by a
        private socket. They have all rights; other processes have those of their role.
    """

    in_process: ClassVar[bool] = False
    """Whether queries are answered in the calling thread."""

    def __init__(
        self, session: zenoh.Session, inside: Connection | None = None, folder: Path | None = None
    ) -> None:
        self._session = session
        self._inside = inside
        self._folder = folder
        self._queryables: list[zenoh.Queryable[None]] = []
        self._subscribers: list[zenoh.Subscriber[Any] | zenoh.ext.AdvancedSubscriber[Any]] = []
        self._tokens: list[zenoh.LivelinessToken] = []
        self._publishers: dict[str, Publisher] = {}

    @property
    def id(self) -> str:
        """Id of the session in hexadecimal digits."""
        return str(self._session.info.zid())

    @property
    def zenoh_session(self) -> zenoh.Session:
        """Zenoh's session, for `bridge.policy_server` only."""
        return self._session

    @property
    def inside(self) -> Connection:
        """Connection of processes on this machine."""
        assert self._inside is not None, "this session does not listen"
        return self._inside

    @property
    def hub(self) -> str:
        """Ids of the connected routers; "" for none."""
        return ", ".join(str(one) for one in self._session.info.routers_zid())

    def serve(self, key: str, handler: Handler, *, found: bool = False) -> None:
        """Answer queries on `key` with `handler(payload)`; its exceptions become error replies.

        key: May have wildcards; then queries on every matching key are answered.
        found: Also answer queries on key expressions that include `key`.
        """

        def answer(query: zenoh.Query) -> None:
            with query:
                if objection := _objection(query, key, found=found):
                    query.reply_err(objection.encode())
                    return
                payload = query.payload.to_bytes() if query.payload is not None else b""
                queried = str(query.key_expr)
                try:
                    query.reply(key if "*" in queried else queried, handler(payload))
                except Exception as error:  # noqa: BLE001  a silent callback would look like a lost peer
                    query.reply_err(f"{type(error).__name__}: {error}".encode())

        self._queryables.append(self._session.declare_queryable(key, answer, complete=True))

    def serve_later(self, key: str, take: Callable[[Query], None], *, found: bool = False) -> None:
        """Pass queries on `key` to `take`, which answers them later from any thread.

        take: Called in a thread of Zenoh that must not block.
        found: See `serve`; such a query is answered on `key`.
        """

        def collected(query: zenoh.Query) -> None:
            pending = Query(query)
            if objection := _objection(query, key, found=found):
                pending.refuse(objection)
                return
            pending.key = key if "*" in pending.key else pending.key
            take(pending)

        self._queryables.append(self._session.declare_queryable(key, collected, complete=True))

    def send_query(
        self,
        key: str,
        payload: bytes,
        replied: Callable[[bytes | None, str], None],
        *,
        timeout_s: float,
    ) -> None:
        """Send a query without waiting.

        replied: Called once, in a thread of Zenoh that must not block, with the reply and ""; or
            with None and the error reply, "" on timeout.
        """
        found: list[bytes] = []
        errors: list[str] = []

        def received(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                found.append(bytes(reply.ok.payload.to_bytes()))
            elif reply.err is not None and (words := reply.err.payload.to_string()) != "Timeout":
                errors.append(words)

        def finished() -> None:
            replied(found[0] if found else None, errors[0] if errors else "")

        self._session.get(
            key,
            zenoh.handlers.Callback(received, finished, indirect=False),
            payload=payload,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    def declare_token(self, key: str) -> Callable[[], None]:
        """Declare a liveliness token at `key`; return a function that removes it."""
        token = self._session.liveliness().declare_token(key)
        self._tokens.append(token)

        def leave() -> None:
            self._tokens.remove(token)
            token.undeclare()  # type: ignore[no-untyped-call]

        return leave

    def watch_tokens(
        self, key: str, changed: Callable[[str, bool], None], *, ordered: bool = False
    ) -> None:
        """Call `changed(key, alive)` for every liveliness token at a key, now and later.

        ordered: See `subscribe`.
        """

        def received(sample: zenoh.Sample) -> None:
            changed(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._subscribers.append(
            self._session.liveliness().declare_subscriber(
                key, _handler(received, ordered), history=True
            )
        )

    def query_all(self, key: str, *, timeout_s: float) -> dict[str, bytes]:
        """Return all replies to an empty query on a key expression by key, without errors."""
        replies = self._session.get(key, timeout=timeout_s)
        return {
            str(r.ok.key_expr): bytes(r.ok.payload.to_bytes()) for r in replies if r.ok is not None
        }

    def publish_lossy(self, key: str, payload: bytes) -> None:
        """Publish a message that slow subscribers may miss."""
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def publish(self, key: str, payload: bytes, attachment: bytes = b"") -> None:
        """Publish on an advertised key. Slow subscribers delay the call and miss nothing."""
        self._publishers[key].put(payload, attachment=attachment or None)

    def advertise(self, key: str, *, latched: int = 0) -> None:
        """Declare a reliable publisher of a key.

        A subscriber that connects at the same moment may miss the first messages.

        latched: Number of messages that later subscribers also get, if they query the history.
        """
        self._publishers[key] = self._publisher(key, latched)

    def _publisher(self, key: str, latched: int) -> Publisher:
        block = zenoh.CongestionControl.BLOCK
        reliable = zenoh.Reliability.RELIABLE
        if not latched:
            return self._session.declare_publisher(
                key, congestion_control=block, reliability=reliable, express=True
            )
        return zenoh.ext.declare_advanced_publisher(
            self._session,
            key,
            congestion_control=block,
            reliability=reliable,
            express=True,  # as the others: a batch would arrive later than what follows it
            cache=zenoh.ext.CacheConfig(latched),
            publisher_detection=True,
            sample_miss_detection=zenoh.ext.MissDetectionConfig(
                heartbeat=None, sporadic_heartbeat=_HEARTBEAT_MS / 1000.0
            ),
        )

    def has_subscriber(self, key: str) -> bool:
        """Return whether a subscription has arrived for an advertised key without a history."""
        publisher = self._publishers[key]
        if not isinstance(publisher, zenoh.Publisher):
            return False
        status: Any = publisher.matching_status  # a bool in Zenoh's stubs
        return bool(status.matching)

    def subscribe(
        self,
        key: str,
        handler: Callable[[str, bytes, bytes], None],
        *,
        history: bool = False,
        ordered: bool = False,
    ) -> None:
        """Call `handler(key, payload, attachment)` for every publication on a key expression.

        history: Query latched messages too.
        ordered: Call in the thread of Zenoh that receives, which must not block, in the order of
            arrival of all keys and tokens. Otherwise each subscription has a thread of its own.
        """

        def received(sample: zenoh.Sample) -> None:
            attached = sample.attachment
            handler(
                str(sample.key_expr),
                sample.payload.to_bytes(),
                b"" if attached is None else attached.to_bytes(),
            )

        if history:
            self._subscribers.append(
                zenoh.ext.declare_advanced_subscriber(
                    self._session,
                    key,
                    received,
                    history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
                )
            )
        else:
            self._subscribers.append(
                self._session.declare_subscriber(key, _handler(received, ordered))
            )

    def query_once(self, key: str, payload: bytes, *, timeout_s: float) -> QueryResult:
        """Send one query and return its first result."""
        began_s = time.monotonic()
        # Consolidation would delay a reply until all other queryables have finished.
        unconsolidated = zenoh.ConsolidationMode.NONE
        for reply in self._session.get(
            key, payload=payload, timeout=timeout_s, consolidation=unconsolidated
        ):
            if reply.ok is not None:
                return QueryResult("answered", bytes(reply.ok.payload.to_bytes()))
            message = bytes(reply.err.payload.to_bytes()) if reply.err is not None else b""
            if message != b"Timeout":
                return QueryResult("refused", message)
        # If both ends time out at once, a query may end without that message.
        return QueryResult("timeout" if time.monotonic() - began_s >= timeout_s else "unserved")

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Return the reply to a query, with retries until the timeout.

        Raises TimeoutError without a reply, EngineError for an error reply.
        """
        deadline = time.monotonic() + timeout_s
        pause_s = _FIRST_RETRY_S
        while (left_s := deadline - time.monotonic()) > 0:
            result = self.query_once(key, payload, timeout_s=left_s)
            if result.outcome == "answered":
                return result.payload
            if result.outcome == "refused":
                raise EngineError(f"'{key}' answered: {result.payload.decode(errors='replace')}")
            time.sleep(min(pause_s, max(deadline - time.monotonic(), 0.0)))
            pause_s = min(2 * pause_s, _LONGEST_RETRY_S)
        raise TimeoutError(f"no reply on '{key}' within {timeout_s:g} s")

    def close(self) -> None:
        """Close the session; safe to call twice."""
        with suppress(zenoh.ZError):
            for queryable in self._queryables:
                queryable.undeclare()  # type: ignore[no-untyped-call]
            self._queryables.clear()
            for subscriber in self._subscribers:
                subscriber.undeclare()  # type: ignore[no-untyped-call]
            self._subscribers.clear()
            for token in self._tokens:
                token.undeclare()  # type: ignore[no-untyped-call]
            self._tokens.clear()
            for publisher in self._publishers.values():
                publisher.undeclare()  # type: ignore[no-untyped-call]
            self._publishers.clear()
            self._session.close()  # type: ignore[no-untyped-call]
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _handler(received: Callable[[zenoh.Sample], None], ordered: bool) -> Any:
    """Return Zenoh's handler of a subscription.

    ordered: See `Session.subscribe`.
    """
    return zenoh.handlers.Callback(received, indirect=False) if ordered else received


def _objection(query: zenoh.Query, key: str, *, found: bool) -> str:
    """Return why a query is refused, "" if valid: several keys at once, or an unsafe encoding.

    found: Whether several keys are allowed.
    """
    queried = str(query.key_expr)
    encoding = str(query.encoding or _ENCODINGS[0])
    if "*" in queried and not (found and query.key_expr.includes(zenoh.KeyExpr(key))):
        return f"ask for exactly '{key}', not '{queried}'"
    if encoding not in _ENCODINGS:
        return f"'{encoding[:64]}' is not read here: send {_ENCODINGS[1]} or {_ENCODINGS[2]}"
    return ""


class LocalSession(Session):
    """Session within one thread, without a socket: `query` runs the handler itself.

    Query and reply are publications, because Zenoh's queries use a timer thread that adds latency
    on a busy machine. An interrupt of the calling thread interrupts the handler.
    """

    in_process = True

    def __init__(self) -> None:
        super().__init__(
            _open(local_settings(), "cannot open a session", "Has this machine threads to spare?")
        )
        self._served: list[tuple[_Subscriber, _Subscriber, Handler]] = []

    def serve(self, key: str, handler: Handler, *, found: bool = False) -> None:
        """Answer queries on `key` in `query`."""
        # Only the newest message: an interrupted `query` may have left an older one.
        question = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        answer = self._session.declare_subscriber(f"{key}/{_ANSWER}", zenoh.handlers.RingChannel(1))
        self._subscribers += [question, answer]
        self._served.append((question, answer, handler))

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Return the reply of the handler.

        Raises TimeoutError at once if the key is not served, EngineError if its handler raised.
        """
        self._session.put(key, payload)
        for question, answer, handler in self._served:
            if (received := question.try_recv()) is not None:
                self._answer(f"{key}/{_ANSWER}", handler, received.payload.to_bytes())
                reply = answer.try_recv()
                assert reply is not None  # it was put in this thread
                if reply.attachment is not None:
                    raise EngineError(f"'{key}' answered: {reply.payload.to_string()}")
                return bytes(reply.payload.to_bytes())
        raise TimeoutError(f"'{key}' is not served in this session")

    def _answer(self, key: str, handler: Handler, payload: bytes) -> None:
        try:
            answer = handler(payload)
        except Exception as error:  # noqa: BLE001  as over a query
            self._session.put(key, f"{type(error).__name__}: {error}", attachment=b"error")
        else:
            self._session.put(key, answer)


def open_session(connection: Connection, warn: Callable[[str], None] = lambda _: None) -> Session:
    """Open one end of a session: a hub if it listens, else a client of the hub it connects to.

    warn: Called with each warning once the session is open: insecure settings, expiring
        certificates.
    Raises AccessError for invalid certificates on either side (a retry is useless), EngineError if
    the endpoint is in use or does not answer.

    >>> from cosim.spec.connection import Connection
    >>> with open_session(Connection(role="coordinator", listen="tcp/127.0.0.1:7461")) as hub:
    ...     with open_session(hub.inside) as one:
    ...         hub.serve("cosim/r/status", lambda payload: payload.upper())
    ...         one.query("cosim/r/status", b"well?", timeout_s=60.0)
    b'WELL?'
    """
    notices = connection_warnings(connection)
    session = _listening(connection) if connection.listen else _connected(connection)
    for line in notices:
        warn(line)
    return session


def connection_warnings(connection: Connection) -> list[str]:
    """Return warnings about insecure settings and expiring certificates. Raises AccessError."""
    soon = ""
    if connection.tls:
        from bridge.security.identity import checked_identity

        soon = checked_identity(connection)
    return [line for line in (connection.warning, soon) if line]


def _listening(connection: Connection) -> Session:
    remedy = "Choose an address of this machine and a free port, like tcp/127.0.0.1:7450."
    failure = f"cannot listen at {connection.listen}"
    if connection.listen.startswith("unixsock-stream/"):
        inside = Connection(role=connection.role, connect=connection.listen)
        return Session(_open(session_settings(connection), failure, remedy), inside)
    short = tempfile.gettempdir() if len(tempfile.gettempdir()) < _LONGEST_FOLDER else "/tmp"
    folder = Path(tempfile.mkdtemp(prefix="cosim-", dir=short))
    inside = Connection(role=connection.role, connect=f"unixsock-stream/{folder}/hub.sock")
    try:
        return Session(
            _open(session_settings(connection, [inside.connect]), failure, remedy), inside, folder
        )
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _connected(connection: Connection) -> Session:
    remedy = "Is a process started that listens there, by the same protocol and port?"
    try:
        return Session(
            _open(session_settings(connection), f"no hub answers at {connection.connect}", remedy)
        )
    except EngineError as error:
        if connection.tls:
            from bridge.security.identity import refusal_reason

            if why := refusal_reason(connection):
                raise AccessError(why) from error
        raise


def _open(settings: Mapping[str, object], failure: str, remedy: str) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise EngineError(
            f"Zenoh: {failure} ({_SOURCE_LINE.sub('', str(error)).rstrip('.')}). {remedy}"
        ) from error

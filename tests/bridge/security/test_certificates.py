"""Certificates: created once, readable by their owner alone, shown with their end, and refused with
a reason."""

from __future__ import annotations

import shutil
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh

from bridge.security import identity, settings
from bridge.security.authority import issue, make_authority
from bridge.security.identity import checked_identity, identity_in
from bridge.session import open_session
from cosim.core.errors import AccessError, EngineError, UsageError
from cosim.spec.connection import Connection, Role
from tests.conftest import Cosim
from tests.support.plain import free_port, plain_zenoh

NOW = datetime.now(UTC)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority with a coordinator of localhost and a worker."""
    folder = tmp_path_factory.mktemp("authority") / "certs"
    make_authority(folder, ["localhost"], 365)
    issue(folder, "worker", [], 365)
    return folder


def open_end(folder: Path, role: Role) -> Connection:
    """Open an end of a session with the files of a folder; no peer is needed."""
    end = "listen" if role == "coordinator" else "connect"
    return Connection(role=role, tls=str(folder / role), **{end: "tls/localhost:7447"})  # type: ignore[arg-type]


def test_the_command_creates_shows_and_never_overwrites(tmp_path: Path, cosim: Cosim) -> None:
    """Keys are readable by their owner alone; files stay until --renew, which keeps the hosts; the
    end is shown."""
    folder = tmp_path / "certs"
    first = cosim(
        "certs", "init", str(folder), "--host", "hub.lan", "--host", "10.0.0.7", "--days", "90"
    )
    assert first.returncode == 0 and "reached by hub.lan, 10.0.0.7" in first.stdout, first.stderr
    assert cosim("certs", "role", str(folder), "viewer").returncode == 0
    for key in (
        folder / "ca.key",
        folder / "coordinator" / "key.pem",
        folder / "viewer" / "key.pem",
    ):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    before = (folder / "coordinator" / "cert.pem").read_bytes()
    for words, expected in {
        ("init", str(folder)): "is not empty",
        ("role", str(folder), "coordinator"): "--renew replaces it",
        ("role", str(folder), "guest"): "Valid choices: coordinator, director",
        ("role", str(folder), "director"): "--host NAME",
        ("role", str(folder), "worker", "--host", "a b"): "a name or address of a machine",
        ("role", str(folder), "worker", "--host", "w.lan"): "the role worker connects",
        ("role", str(tmp_path / "none"), "worker"): "holds no authority",
        ("show", str(tmp_path)): "holds no certificate",
    }.items():
        refused = cosim("certs", *words)
        assert refused.returncode == 2 and expected in refused.stderr, refused.stderr
    assert (folder / "coordinator" / "cert.pem").read_bytes() == before
    assert cosim("certs", "role", str(folder), "coordinator", "--renew").returncode == 0
    assert (folder / "coordinator" / "cert.pem").read_bytes() != before
    shown = cosim("certs", "show", str(folder)).stdout
    assert (
        "hub.lan, 10.0.0.7" in shown
        and "watch" in shown
        and f"{NOW + timedelta(days=365):%Y-%m}" in shown
    )
    assert sorted(path.name for path in folder.iterdir()) == [
        "ca.key",
        "ca.pem",
        "coordinator",
        "viewer",
    ]


def test_each_kind_of_unusable_file_is_named(certificates: Path, tmp_path: Path) -> None:
    """A missing or damaged file, another's key, another authority, a readable key and another role
    are each named."""
    other = tmp_path / "other"
    make_authority(other, ["localhost"], 365)
    copies = iter(range(100))

    def refused(change: str, role: Role = "worker") -> str:
        folder = tmp_path / str(next(copies))
        shutil.copytree(certificates, folder)
        place = folder / "worker"
        match change:
            case "missing":
                (place / "key.pem").unlink()
            case "damaged":
                (place / "cert.pem").write_text("-----BEGIN CERTIFICATE-----\nno\n")
            case "no key":
                (place / "key.pem").write_text("-----BEGIN PRIVATE KEY-----\nno\n")
            case "another's key":
                shutil.copy(folder / "coordinator" / "key.pem", place / "key.pem")
            case "another authority":
                shutil.copy(other / "ca.pem", place / "ca.pem")
            case "everybody's key":
                (place / "key.pem").chmod(0o644)
        with pytest.raises(AccessError) as error:
            checked_identity(Connection(role=role, connect="tls/localhost:1", tls=str(place)))
        return str(error.value)

    for change, words in {
        "missing": "key.pem: cannot be read: No such file",
        "damaged": "cert.pem: holds no certificate",
        "no key": "key.pem: holds no private key",
        "another's key": "key.pem is not the key of",
        "another authority": "was not issued by",
        "everybody's key": "chmod 600",
    }.items():
        assert words in refused(change), change
    assert "is of the role worker, and this needs viewer" in refused("", "viewer")


def test_the_end_of_a_certificate_is_announced_30_days_before(certificates: Path) -> None:
    """Within 30 days the day and the remedy are shown; an expired or not yet valid certificate is
    refused."""
    for role in ("coordinator", "worker"):
        end = open_end(certificates, role)  # type: ignore[arg-type]
        assert checked_identity(end, NOW) == ""
        assert (
            "expires on" in (warning := checked_identity(end, NOW + timedelta(days=350)))
            and "--renew" in warning
        )
        with pytest.raises(AccessError, match=r"has expired on .*--renew"):
            checked_identity(end, NOW + timedelta(days=366))
        with pytest.raises(AccessError, match="is this machine's clock right"):
            checked_identity(end, NOW - timedelta(days=3))
    assert checked_identity(open_end(certificates, "worker"), NOW - timedelta(hours=20)) == "", (
        "a clock that is behind"
    )


@pytest.mark.engine
def test_a_hub_that_does_not_fit_is_refused_with_a_reason(
    certificates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another authority on either end, another name, an expired hub, no TLS and no hub are refused;
    a valid hub connects."""
    other = tmp_path / "other"
    make_authority(other, ["localhost"], 365)
    issue(other, "worker", [], 365)
    trusting = tmp_path / "trusting"  # trusts the hub, but is not trusted by it
    shutil.copytree(other / "worker", trusting)
    (trusting / "ca.pem").write_bytes(
        (other / "ca.pem").read_bytes() + (certificates / "ca.pem").read_bytes()
    )
    old = tmp_path / "old"
    make_authority(old, ["localhost"], 5, NOW - timedelta(days=10))
    issue(old, "worker", [], 365)

    def refusal_of(at: str, folder: Path) -> str:
        with (
            pytest.raises(AccessError) as error,
            open_session(Connection(role="worker", connect=at, tls=str(folder))),
        ):
            pass
        return str(error.value)

    at = f"tls/localhost:{free_port()}"
    listening = Connection(role="coordinator", listen=at, tls=str(certificates / "coordinator"))
    with open_session(listening) as session:
        session.serve("cosim/r/jobs/claim", bytes.upper)
        with open_session(
            Connection(role="worker", connect=at, tls=str(certificates / "worker"))
        ) as worker:
            assert worker.query("cosim/r/jobs/claim", b"mine", timeout_s=60.0) == b"MINE"
        monkeypatch.setattr(
            settings, "CONNECTS_WITHIN_S", 0.1
        )  # a refused client stays refused for the whole wait
        assert (
            "the certificate of tls/localhost" in (reason := refusal_of(at, other / "worker"))
            and "another authority" in reason
        )
        assert (
            "refused us" in (reason := refusal_of(at, trusting))
            and "than the one there trusts" in reason
        )
        assert "is not for the address 127.0.0.1" in refusal_of(
            at.replace("localhost", "127.0.0.1"), certificates / "worker"
        )
    plain = f"tls/localhost:{free_port()}".replace("tls", "tcp")
    with (
        open_session(Connection(role="coordinator", listen=plain)),
        monkeypatch.context() as patch,
        pytest.raises(EngineError, match="by the same protocol"),
    ):
        patch.setattr(identity, "_PATIENCE_S", 0.2)  # a peer without TLS never answers
        open_session(
            Connection(
                role="worker", connect=plain.replace("tcp", "tls"), tls=str(certificates / "worker")
            )
        )
    expired = Connection(
        role="coordinator", listen=f"tls/localhost:{free_port()}", tls=str(old / "coordinator")
    )
    with pytest.raises(AccessError, match="has expired on"):
        open_session(expired)
    monkeypatch.setattr(
        "bridge.session.connection_warnings", lambda _: []
    )  # a hub that listened before its certificate expired
    (trusting / "ca.pem").write_bytes(
        (other / "ca.pem").read_bytes() + (old / "ca.pem").read_bytes()
    )
    with open_session(expired):
        assert "has expired" in refusal_of(expired.listen, trusting)
    with pytest.raises(EngineError, match="no hub answers at"):
        open_session(
            Connection(
                role="worker",
                connect=f"tls/localhost:{free_port()}",
                tls=str(certificates / "worker"),
            )
        )


@pytest.mark.engine
def test_plain_zenoh_without_our_certificate_cannot_connect(
    certificates: Path, tmp_path: Path
) -> None:
    """No, foreign and self-signed certificates give no link; the same client with ours gets one."""
    other = tmp_path / "other"
    make_authority(other, ["localhost"], 365)
    issue(other, "worker", [], 365)
    shutil.copy(certificates / "ca.pem", other / "ca.pem")
    (tmp_path / "none").mkdir()
    shutil.copy(certificates / "ca.pem", tmp_path / "none" / "ca.pem")
    at = f"tls/localhost:{free_port()}"
    with open_session(
        Connection(role="coordinator", listen=at, tls=str(certificates / "coordinator"))
    ):
        for folder in (other, tmp_path / "none"):
            with pytest.raises(zenoh.ZError), plain_zenoh(at, folder, "worker", wait_ms=400):
                pass
        with (
            pytest.raises(zenoh.ZError),
            plain_zenoh(at.replace("tls", "tcp"), None, "", wait_ms=400),
        ):
            pass
        with plain_zenoh(at, certificates, "worker"):
            pass


def test_an_invalid_host_is_refused(tmp_path: Path) -> None:
    """An invalid host is refused before any file is written."""
    with pytest.raises(UsageError, match="a name or address of a machine"):
        make_authority(tmp_path / "certs", ["hub lan"], 1)
    assert not (tmp_path / "certs").exists()
    make_authority(tmp_path / "certs", ["hub.lan", "::1"], 1)
    assert identity_in(tmp_path / "certs" / "coordinator").hosts == ("hub.lan", "::1")

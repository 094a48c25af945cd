"""Create a private certificate authority and issue a certificate for each role.

A folder has the authority's `ca.pem` and `ca.key`, and a subfolder for each role to copy to its
machine. A listening role is issued for its host names, so no other role can impersonate it.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ec import (
    SECP256R1,
    EllipticCurvePrivateKey,
    generate_private_key,
)
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from bridge.security.identity import CA, CERTIFICATE, KEY, format_time, identity_in
from cosim.core.errors import AccessError, UsageError, unwritable
from cosim.core.files import atomic_folder
from cosim.spec.connection import HUBS, Role

_CA_KEY: Final = "ca.key"
ROS2_CONFIG: Final = "session.json5"
"""Zenoh configuration in the folder of the role `ros2`."""
_AUTHORITY_DAYS: Final = 3650
"""Validity of an authority in days."""
_SKEW: Final = timedelta(days=1)
"""Validity before the issue, because clocks of other machines may be behind."""
_HOST: Final = re.compile(
    r"(?=.{1,253}$)[A-Za-z0-9]([A-Za-z0-9-]{0,62})(\.[A-Za-z0-9]([A-Za-z0-9-]{0,62}))*"
)
"""Valid host names."""


def make_authority(
    folder: Path, hosts: Sequence[str], days: int, now: datetime | None = None
) -> None:
    """Create a folder with an authority and a coordinator's certificate.

    Raises UsageError if the folder exists.
    """
    names = [_name(host) for host in hosts]
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file: name a folder that is not there yet, like certs")
    if folder.exists() and any(folder.iterdir()):
        raise UsageError(
            f"{folder} is not empty: `cosim certs role {folder} ROLE` adds to an authority "
            f"that is there"
        )
    now = datetime.now(UTC) if now is None else now
    key = generate_private_key(SECP256R1())
    subject = x509.Name(
        [x509.NameAttribute(NameOID.COMMON_NAME, f"cosim authority {secrets.token_hex(4)}")]
    )
    builder = _builder(subject, subject, key, now, now + timedelta(days=_AUTHORITY_DAYS))
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=True), critical=True)
    with _whole_folder(folder) as made:
        _write(made / CA, builder.sign(key, SHA256()).public_bytes(Encoding.PEM))
        _write(made / _CA_KEY, _pem(key))
        _issue(made, "coordinator", names, days, now)


def issue(
    folder: Path, role: Role, hosts: Sequence[str], days: int, *, renew: bool = False
) -> Path:
    """Issue the certificate of a role and return its folder.

    renew: Replace an existing certificate; its hosts are reused if none are given.
    Raises UsageError, AccessError.
    """
    names = [_name(host) for host in hosts]
    place = folder / role
    if place.exists():
        if not renew:
            ends = format_time(identity_in(place).ends)
            raise UsageError(f"{place} is there, and valid until {ends}: --renew replaces it")
        names = names or [_name(host) for host in identity_in(place).hosts]
    if role in ("coordinator", "director") and not names:
        raise UsageError(
            f"others connect to a {role}: say by which names or addresses, --host NAME"
        )
    if role not in HUBS and names:
        raise UsageError(
            f"--host is for roles that listen, and the role {role} connects: leave out --host"
        )
    _issue(folder, role, names, days, datetime.now(UTC))
    return place


def _issue(
    folder: Path, role: Role, hosts: list[x509.GeneralName], days: int, now: datetime
) -> None:
    authority, signing_key = _authority(folder)
    key = generate_private_key(SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, role)])
    ends = min(now + timedelta(days=days), authority.not_valid_after_utc)
    builder = _builder(subject, authority.subject, key, now, ends)
    builder = builder.add_extension(
        x509.BasicConstraints(ca=False, path_length=None), critical=True
    )
    builder = builder.add_extension(_usage(signs_certificates=False), critical=True)
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
    builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(signing_key.public_key())
    builder = builder.add_extension(issuer, critical=False)
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName(hosts), critical=False)
    with _whole_folder(folder / role) as made:
        _write(made / CA, authority.public_bytes(Encoding.PEM))
        _write(made / CERTIFICATE, builder.sign(signing_key, SHA256()).public_bytes(Encoding.PEM))
        _write(made / KEY, _pem(key))
        if role == "ros2":
            config = _ros2_session_config(folder / role, _host_of_runs(folder))
            _write(made / ROS2_CONFIG, config.encode())


def _host_of_runs(folder: Path) -> str:
    """Return the coordinator's first host for an endpoint, "HOST" if it is unknown."""
    try:
        host = (*identity_in(folder / "coordinator").hosts, "HOST")[0]
    except AccessError:
        return "HOST"
    return f"[{host}]" if ":" in host else host


def _ros2_session_config(folder: Path, host: str) -> str:
    """Return a Zenoh configuration for ROS 2 nodes, for $ZENOH_SESSION_CONFIG_URI.

    folder: Where the certificate is.
    host: Machine of the run.
    """
    at = folder.absolute()
    return f"""\
// For nodes of rmw_zenoh: export ZENOH_SESSION_CONFIG_URI={at / ROS2_CONFIG}
// Change host, port and paths where they differ.
{{
  mode: "client",
  connect: {{ endpoints: ["tls/{host}:7447"], timeout_ms: -1 }},
  scouting: {{ multicast: {{ enabled: false }} }},
  timestamping: {{ enabled: true }},
  transport: {{
    link: {{
      tls: {{
        root_ca_certificate: "{at / CA}",
        connect_certificate: "{at / CERTIFICATE}",
        connect_private_key: "{at / KEY}",
        enable_mtls: true,
        verify_name_on_connect: true,
      }},
    }},
  }},
}}
"""


def _authority(folder: Path) -> tuple[x509.Certificate, EllipticCurvePrivateKey]:
    try:
        key = load_pem_private_key((folder / _CA_KEY).read_bytes(), None)
        certificate = x509.load_pem_x509_certificate((folder / CA).read_bytes())
    except OSError as error:
        raise AccessError(
            f"{folder} holds no authority ({error.strerror}): `cosim certs init` makes one"
        ) from error
    except (ValueError, TypeError) as error:
        raise AccessError(
            f"{folder}: {CA} or {_CA_KEY} cannot be read: they are damaged"
        ) from error
    if not isinstance(key, EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise AccessError(f"{folder}: {_CA_KEY} is not the key of {CA}")
    return certificate, key


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: EllipticCurvePrivateKey,
    now: datetime,
    ends: datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _SKEW)
        .not_valid_after(ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        if not _HOST.fullmatch(host):
            raise UsageError(
                f"--host '{host}': a name or address of a machine, like hub.lan or 10.0.0.7"
            ) from None
        return x509.DNSName(host)


def _pem(key: EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


@contextmanager
def _whole_folder(folder: Path) -> Iterator[Path]:
    """Yield a folder that replaces `folder` at the end of the block."""
    try:
        with atomic_folder(folder) as made:
            made.chmod(0o700)
            yield made
    except OSError as error:
        raise unwritable(folder, error, "choose another place, or make room") from error


def _write(path: Path, data: bytes) -> None:
    """Write a file. A key is never readable by other users."""
    mode = 0o644 if path.suffix == ".pem" and path.name != KEY else 0o600
    with open(path, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())

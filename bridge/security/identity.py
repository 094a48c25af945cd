"""Check the certificate files of `--tls`: role, validity and consistency.

Zenoh rejects wrong files without a reason, so they are checked before a session is opened. If a
connection is refused, a second handshake finds the reason.
"""

from __future__ import annotations

import socket
import ssl
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple, get_args

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import NameOID

from cosim.core.errors import AccessError
from cosim.spec.connection import Connection, Role

CA = "ca.pem"
CERTIFICATE = "cert.pem"
KEY = "key.pem"
SOON: Final = timedelta(days=30)
"""Time before its end from which a certificate counts as expiring."""


class Identity(NamedTuple):
    """Certificate of a role.

    hosts: Names by which others may connect.
    begins, ends: Validity, limited by the authority's.
    """

    role: Role
    hosts: tuple[str, ...]
    begins: datetime
    ends: datetime


def identity_in(folder: Path) -> Identity:
    """Read the files of a folder. Raises AccessError if one is missing or they do not match."""
    certificate, authority = (_certificate(folder / name) for name in (CERTIFICATE, CA))
    key = folder / KEY
    try:
        matches = load_pem_private_key(_read(key), None).public_key() == certificate.public_key()
    except (ValueError, TypeError) as error:
        raise AccessError(f"{key}: holds no private key without a password") from error
    if not matches:
        raise AccessError(
            f"{key} is not the key of {folder / CERTIFICATE}: copy the whole folder from "
            f"where it was made"
        )
    if key.stat().st_mode & stat.S_IRWXO:
        raise AccessError(f"{key} can be read by everybody on this machine: chmod 600 {key}")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise AccessError(
            f"{folder / CERTIFICATE} was not issued by {folder / CA}, but by another authority: "
            "copy the whole folder from where it was made"
        ) from error
    names = [
        str(name.value) for name in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    ]
    role = next((role for role in get_args(Role) if [role] == names), None)
    if role is None:
        raise AccessError(
            f"{folder / CERTIFICATE} is of '{', '.join(names)}', which is no role. Valid choices: "
            f"{', '.join(get_args(Role))}."
        )
    return Identity(
        role,
        _hosts(certificate),
        max(certificate.not_valid_before_utc, authority.not_valid_before_utc),
        min(certificate.not_valid_after_utc, authority.not_valid_after_utc),
    )


def checked_identity(connection: Connection, now: datetime | None = None) -> str:
    """Check the files for a connection; return a warning if they expire soon, else "".

    Raises AccessError.
    """
    folder = Path(connection.tls)
    found = identity_in(folder)
    now = datetime.now(UTC) if now is None else now
    if found.role != connection.role:
        raise AccessError(
            f"{folder} is of the role {found.role}, and this needs {connection.role}: see "
            f"`cosim certs`"
        )
    if connection.listen and not found.hosts:
        raise AccessError(f"{folder / CERTIFICATE} names no host: issue another with --host")
    renew = f"`cosim certs role ... {found.role} --renew` makes another"
    if now > found.ends:
        raise AccessError(
            f"{folder} has expired on {format_time(found.ends)} "
            f"(here it is {format_time(now)}): {renew}"
        )
    if now < found.begins:
        raise AccessError(
            f"{folder} is valid from {format_time(found.begins)}, and here it is "
            f"{format_time(now)}: is this machine's clock right?"
        )
    return (
        f"{folder} expires on {format_time(found.ends)}: {renew}."
        if found.ends - now < SOON
        else ""
    )


def time_left(identity: Identity) -> str:
    """Return the end of validity and the days left as text."""
    days = (identity.ends - datetime.now(UTC)).days
    return f"{identity.ends:%Y-%m-%d} ({f'{days} days' if days >= 0 else 'expired'})"


def format_time(moment: datetime) -> str:
    """Format a time."""
    return f"{moment:%Y-%m-%d %H:%M} UTC"


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(_read(path))
    except ValueError as error:
        raise AccessError(f"{path}: holds no certificate") from error


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise AccessError(
            f"{path}: cannot be read: {error.strerror}: `cosim certs` makes such a folder"
        ) from error


def _hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    addresses = [str(address) for address in names.get_values_for_type(x509.IPAddress)]
    return (*names.get_values_for_type(x509.DNSName), *addresses)


_PATIENCE_S: Final = 3.0
"""Timeout of the handshake in seconds."""
_OTHER_AUTHORITY: Final = (
    "was issued by another authority than {folder}/ca.pem: both need `cosim certs` of one authority"
)
_OF_THE_HUB: Final = {
    9: "is not valid yet: are the clocks of both machines right?",
    10: "has expired: `cosim certs role ... --renew` makes another, there",
    18: _OTHER_AUTHORITY,
    19: _OTHER_AUTHORITY,
    20: _OTHER_AUTHORITY,
    26: "is not of a role that listens: a coordinator, a director or a policy server",
    62: "is not for the name {host}: connect to a name of it, or issue another with --host {host}",
    64: "is not for the address {host}: connect to a name of it, or issue another with --host "
    "{host}",
}
"""Faults of the hub's certificate by OpenSSL's error numbers (X509_V_ERR_...)."""
_OF_OURS: Final = {
    "UNKNOWN_CA": "was issued by another authority than the one there trusts",
    "DECRYPT_ERROR": "was issued by another authority of the same name",
    "CERTIFICATE_EXPIRED": "has expired there: are the clocks of both machines right?",
    "CERTIFICATE_REQUIRED": "was not shown",
    "BAD_CERTIFICATE": "was not accepted there",
    "UNSUPPORTED_CERTIFICATE": "is not of a role that connects",
}
"""Faults of our certificate by the end of the TLS alert's name."""


def refusal_reason(connection: Connection) -> str:
    """Return why the handshake fails; "" if it succeeds or there is no answer."""
    host, _, port = connection.connect.partition("/")[2].rpartition(":")
    host = host.strip("[]")
    folder = Path(connection.tls)
    try:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(folder / CA)
        context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
        with (
            socket.create_connection((host, int(port)), timeout=_PATIENCE_S) as plain,
            context.wrap_socket(plain, server_hostname=host) as guarded,
        ):
            guarded.recv(1)  # TLS 1.3 rejects a client's certificate after the handshake
    except ssl.SSLCertVerificationError as error:
        words = _OF_THE_HUB.get(error.verify_code, f"was refused: {error.verify_message}")
        return f"the certificate of {connection.connect} {words.format(host=host, folder=folder)}"
    except ssl.SSLError as error:
        for name, words in _OF_OURS.items():
            if (error.reason or "").endswith(name):
                return f"{connection.connect} refused us: the certificate in {folder} {words}"
        return (
            f"{connection.connect} does not answer as TLS does ({error.reason}): is it there as "
            f"tls/...?"
        )
    except OSError:
        return ""
    return ""

"""Find out why a TLS connection was refused with a second handshake: Zenoh only reports a
timeout."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path
from typing import Final

from bridge.security.identity import CA, CERTIFICATE, KEY
from cosim.spec.connection import Connection

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
    26: "is not of one who listens: a coordinator, a director or a policy server",
    62: "is not for the name {host}: connect to a name of it, or make it anew with --host {host}",
    64: "is not for the address {host}: connect to a name of it, or make it anew with --host "
    "{host}",
}
"""Faults of the hub's certificate by OpenSSL's error numbers (X509_V_ERR_...)."""
_OF_OURS: Final = {
    "UNKNOWN_CA": "was issued by another authority than the one there trusts",
    "DECRYPT_ERROR": "was issued by another authority of the same name",
    "CERTIFICATE_EXPIRED": "has expired there: are the clocks of both machines right?",
    "CERTIFICATE_REQUIRED": "was not shown",
    "BAD_CERTIFICATE": "was not accepted there",
    "UNSUPPORTED_CERTIFICATE": "is not of one who connects",
}
"""Faults of our certificate by the end of the TLS alert's name."""


def why_refused(connection: Connection) -> str:
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

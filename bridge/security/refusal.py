"""Why a TLS connection was refused: by another handshake, because Zenoh only says that it timed
out."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path
from typing import Final

from bridge.security.identity import CA, CERTIFICATE, KEY
from cosim.spec.connection import Connection

_PATIENCE_S: Final = 3.0
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
"""By OpenSSL's numbers (X509_V_ERR_...)."""
_OF_OURS: Final = {
    "UNKNOWN_CA": "was issued by another authority than the one there trusts",
    "DECRYPT_ERROR": "was issued by another authority of the same name",
    "CERTIFICATE_EXPIRED": "has expired there: are the clocks of both machines right?",
    "CERTIFICATE_REQUIRED": "was not shown",
    "BAD_CERTIFICATE": "was not accepted there",
    "UNSUPPORTED_CERTIFICATE": "is not of one who connects",
}
"""By the ends of TLS alerts' names."""


def why_refused(connection: Connection) -> str:
    """Why the other side and this one do not agree; "" where nobody answers, or they do agree."""
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
            guarded.recv(
                1
            )  # what TLS 1.3 has against a client's certificate is said after the handshake
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

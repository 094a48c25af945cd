"""Commands that listen or connect: only this machine by default, anything else is checked before
work begins."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridge.session import open_session
from cosim.spec.connection import Connection
from tests.conftest import Cosim
from tests.support.plain import free_port

ENDPOINT_COMMANDS = {
    "run --live": ("run", "no-such-suite", "--live"),
    "run --director": ("run", "no-such-suite", "--director"),
    "coordinator": ("coordinator", "no-such-suite", "--listen"),
    "run --policy-at": ("run", "no-such-suite", "--policy", "zenoh:mine", "--policy-at"),
    "coordinator --policy-at": (
        "coordinator",
        "no-such-suite",
        "--policy",
        "zenoh:mine",
        "--policy-at",
    ),
    "serve": ("serve", "stop", "--listen"),
    "worker": ("worker", "--connect"),
    "status": ("status", "--connect"),
    "direct": ("direct", "--listen"),
    "inject": ("inject", "{}", "--connect"),
    "listen": ("listen", "--connect"),
}


@pytest.mark.parametrize("command", ENDPOINT_COMMANDS)
def test_no_endpoint_is_open_to_other_machines_by_default(
    command: str, cosim: Cosim, tmp_path: Path
) -> None:
    """Beyond this machine an endpoint is refused without TLS, with TLS but no files, with files but
    no TLS, and with missing files."""
    words = ENDPOINT_COMMANDS[command]
    beyond = "tcp/10.0.0.7:7447"
    guarded = "tls/10.0.0.7:7447"
    files = str(tmp_path / "none")
    for more, expected in {
        (beyond,): f"Use {guarded} with --tls FOLDER (`cosim certs` makes it), or say --insecure",
        (
            guarded,
        ): f"{guarded} needs --tls FOLDER, which holds ca.pem, cert.pem and key.pem of the role",
        (
            "tcp/127.0.0.1:7447",
            "--tls",
            files,
        ): "--tls goes with tls/ADDRESS:PORT, not with tcp/127.0.0.1:7447",
        (
            guarded,
            "--tls",
            files,
        ): f"{files}/cert.pem: cannot be read: No such file or directory: `cosim certs` makes",
        (guarded, "--tls", files, "--insecure"): "--tls guards and --insecure does not",
    }.items():
        refused = cosim(*words, *more)
        assert refused.returncode == 2 and expected in refused.stderr, refused.stderr


@pytest.mark.engine
def test_insecure_explains_itself_in_one_line(cosim: Cosim) -> None:
    """Both the listening and the connecting command print the meaning of --insecure on standard
    error."""
    port = free_port()
    lines = list[str]()
    open_to_all = Connection(role="coordinator", listen=f"tcp/0.0.0.0:{port}", insecure=True)
    with open_session(open_to_all, lines.append):
        (line,) = lines
        assert line.startswith(
            f"--insecure: anyone who can reach tcp/0.0.0.0:{port} may watch, inject pedestrians, take"
        )
        at = f"tcp/127.1:{port}"
        tried = cosim("listen", "--connect", at, "--insecure")
    (line,) = [line for line in tried.stderr.splitlines() if line.startswith("--insecure: ")]
    assert f"anyone between here and {at} may read and change all that is sent" in line
    assert tried.returncode == 3 and "none of its episodes is on the air" in tried.stderr


def test_security_options_without_an_endpoint_are_refused(cosim: Cosim, tmp_path: Path) -> None:
    """--tls and --insecure are refused for a run that has no endpoint."""
    for more in (("--tls", str(tmp_path)), ("--insecure",)):
        refused = cosim("run", "no-such-suite", *more)
        assert (
            refused.returncode == 2
            and f"{more[0]} goes with --live, --director, --policy-at or --policy ros2:"
            in refused.stderr
        )

"""The ways to step into a live run, as docs/viewing.md, `--help` and the run itself print them, on
one scenario."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.cli.options import connect_options
from cosim.spec.connection import Connection
from tests.conftest import PATIENCE_S, Cosim
from tests.support.documents import text_of
from tests.support.plain import free_port

SECTION = re.search(r"\n## Live injection\n(.*?)\n## ", text_of("docs/viewing.md"), re.DOTALL)
WRITTEN = "tcp/127.0.0.1:7447"
"""The address in the examples, which the test replaces with a free one."""


def examples_in(text: str, name: str, at: str) -> list[list[str]]:
    """Return the commands `cosim NAME` of a text with the address `at`, without those over a
    network."""
    lines = re.findall(rf"^ *(?:\.venv/bin/)?cosim ({name} .*)$", text, re.MULTILINE)
    found = [
        shlex.split(line.replace(WRITTEN, at), comments=True)
        for line in lines
        if "--tls" not in line
    ]
    return [words if at in words else [*words, "--connect", at] for words in found]


@pytest.mark.engine
def test_the_documented_examples_work_on_the_first_scenario(tmp_path: Path, cosim: Cosim) -> None:
    """Commands of the page, the help and the run, and the Python script of the page, are accepted
    with only the address changed."""
    assert SECTION is not None
    at = f"tcp/127.0.0.1:{free_port()}"
    (script,) = re.findall(r"```python\n(.*?)```", SECTION[1], re.DOTALL)
    (tmp_path / "bob.py").write_text(script.replace(WRITTEN, at))
    (tmp_path / "pedestrian.json").write_text('{"id": "emil", "path": [{"ahead": 8}]}')
    (run,) = (words for words in examples_in(SECTION[1], "run", at) if "--live" in words)
    accepted = []
    stderr = ""
    with subprocess.Popen(
        [sys.executable, "-m", "cosim", *run], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    ) as running:
        try:
            assert running.stderr is not None
            while "cosim inject" not in stderr:
                stderr += (line := running.stderr.readline())
                assert line, stderr
            waits = cosim(
                "listen", "events", "--connect", at, "--wait", str(PATIENCE_S), "--seconds", "0"
            )
            assert waits.returncode == 0, waits.stderr
            texts = SECTION[1], cosim("inject", "--help").stdout, stderr
            examples = [words for text in texts for words in examples_in(text, "inject", at)]
            assert len(examples) >= 5
            for example in examples:
                sent = cosim(*example, cwd=tmp_path)
                assert sent.returncode == 0 and "enters at tick" in sent.stdout, (
                    example,
                    sent.stderr,
                )
                accepted += re.findall(r"'(\w+)' enters", sent.stdout)
            python = subprocess.run(
                [sys.executable, "bob.py"],
                cwd=tmp_path,
                capture_output=True,
                text=True,
                timeout=PATIENCE_S,
            )
            assert json.loads(python.stdout)["status"] == "accepted", python
            (listen,) = examples_in(SECTION[1], "listen", at)
            with subprocess.Popen(
                [sys.executable, "-m", "cosim", *listen], stdout=subprocess.PIPE, text=True
            ) as listening:
                assert listening.stdout is not None and "x_m" in json.loads(
                    listening.stdout.readline()
                )
                listening.kill()
            result = cosim("listen", "events", "--connect", at, "--seconds", "0").stdout
        finally:
            running.kill()
    injected = [one["injection"] for one in json.loads(result.splitlines()[0])["injections"]]
    assert {one["id"] for one in injected} == {*accepted, "bob"}
    assert all(
        isinstance(number, float) for one in injected for point in one["path"] for number in point
    )
    assert "held to 1 x real time" in stderr and f"On the air at {at}" in stderr


@pytest.mark.parametrize(
    ("listen", "how", "words"),
    [
        ("tcp/127.0.0.1:7447", {}, "--connect tcp/127.0.0.1:7447"),
        ("unixsock-stream//tmp/a b.sock", {}, "--connect 'unixsock-stream//tmp/a b.sock'"),
        ("tcp/0.0.0.0:7447", {"insecure": True}, "--connect tcp/127.0.0.1:7447"),
        ("tcp/10.0.0.5:7447", {"insecure": True}, "--connect tcp/10.0.0.5:7447 --insecure"),
        (
            "tls/hub.lan:7447",
            {"tls": "certs/coordinator"},
            "--connect tls/hub.lan:7447 --tls certs/injector",
        ),
    ],
    ids=["this machine", "a socket", "all addresses", "another address", "tls"],
)
def test_the_printed_command_reaches_the_run(
    listen: str, how: dict[str, object], words: str
) -> None:
    """The printed command has an address to connect to and the certificates of its role."""
    hub = Connection(role="coordinator", listen=listen, **how)  # type: ignore[arg-type]
    assert connect_options(hub, "injector") == f" {words}"


def test_the_printed_command_names_the_host_of_the_certificate(tmp_path: Path) -> None:
    """A hub that listens at all addresses with TLS is reached by the first name in its
    certificate."""
    from bridge.security.authority import make_authority

    make_authority(tmp_path / "certs", ["hub.lan", "10.0.0.7"], 1)
    hub = Connection(
        role="coordinator", listen="tls/0.0.0.0:7447", tls=str(tmp_path / "certs" / "coordinator")
    )
    assert (
        connect_options(hub, "viewer")
        == f" --connect tls/hub.lan:7447 --tls {tmp_path}/certs/viewer"
    )

"""Help and versions of the command line, which start no engine."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from cosim.cli.app import app
from cosim.core.errors import UsageError
from cosim.spec.connection import checked_endpoint
from tests.conftest import PATIENCE_S


def commands(group: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every command below a group, with the words that call it."""
    for name, command in getattr(group, "commands", {}).items():
        if hasattr(command, "commands"):
            yield from commands(command, (*words, name))
        else:
            yield (*words, name), command


COMMANDS = dict(commands(get_command(app)))


def output_of(*words: str) -> str:
    """Return what `cosim WORDS` prints in a terminal of 80 columns."""
    result = CliRunner().invoke(
        app, list(words), terminal_width=80, color=False, env={"COLUMNS": "80"}
    )
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_has_an_example_of_itself(words: tuple[str, ...]) -> None:
    """The help ends with an example that begins with the command and uses only existing options."""
    epilog = COMMANDS[words].epilog or ""
    examples = re.findall(r"`(cosim [^`]+)`", epilog)
    own = [example for example in examples if example.startswith(" ".join(("cosim", *words)))]
    assert own, f"no example in the help of {' '.join(words)}"
    options = {option for parameter in COMMANDS[words].params for option in parameter.opts}
    for example in own:
        assert set(re.findall(r"(?<!\S)--?[a-z][a-z0-9-]*", example)) <= options, example


@pytest.mark.parametrize("words", [(), ("city",), ("map",), *COMMANDS], ids=" ".join)
def test_help_fits_80_columns(words: tuple[str, ...]) -> None:
    """No line is longer, nothing is cut, and no list of choices is broken within a word."""
    lines = output_of(*words, "--help").splitlines()
    assert max(map(len, lines)) <= 80
    assert not any("…" in line for line in lines)
    assert not re.findall(r"<[a-z0-9_|-]*[|][a-z0-9_|-]*(?![a-z0-9_|>-])", "\n".join(lines))


def test_maps_in_examples_exist_or_are_imported_by_them() -> None:
    """Every map in an example comes with SUMO or is imported by an example."""
    examples = "\n".join(command.epilog or "" for command in COMMANDS.values())
    named = re.findall(r"(?:--map|map check|map endure) ([a-z][\w-]*)", examples)
    imported = re.findall(r"map import ([\w-]+)[.]", COMMANDS["map", "import"].epilog)
    assert named and imported
    assert [name for name in named if name not in imported and not name.startswith("sumo-")] == []


def test_the_version_is_printed_without_an_engine() -> None:
    """`cosim --version` names the project, Python and the engines without importing any engine or
    pandas."""
    code = (
        "import sys\nfrom typer.testing import CliRunner\nfrom cosim.cli.app import "
        "app\nprint(CliRunner().invoke(app, ['--version']).output)\nslow = {'libsumo', "
        "'pybullet', 'zenoh', 'moderngl', 'pandas', 'scipy', 'shapely', 'cv2'}\nprint(sorted(slow "
        "& set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    *lines, imported = done.stdout.strip().splitlines()
    assert imported == "[]"
    text = "\n".join(lines)
    assert (
        f"cosim {version('sidewalk-cosim')}" in text and f"Python {sys.version.split()[0]}" in text
    )
    for name, package in (
        ("SUMO", "libsumo"),
        ("PyBullet", "pybullet"),
        ("Zenoh", "eclipse-zenoh"),
    ):
        assert f"{name} {version(package)}" in text


def test_the_version_of_a_missing_engine_is_shown_as_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`cosim --version` also works on a broken machine."""
    from importlib.metadata import PackageNotFoundError

    from cosim.core import versions

    def without(package: str) -> str:
        if package == "pybullet":
            raise PackageNotFoundError(package)
        return "1.2"

    monkeypatch.setattr(versions, "version", without)
    assert "PyBullet missing" in output_of("--version") and "SUMO 1.2" in output_of("--version")


@pytest.mark.parametrize(
    "endpoint",
    [
        "7447",
        "tcp/",
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:99999",
        "tcp/127.0.0.1:0",
        "tcp/:x",
        "ftp/a:1",
    ],
)
def test_an_invalid_endpoint_is_refused_with_an_example(endpoint: str) -> None:
    """An endpoint needs a protocol, an address, and a port from 1 to 65535, which is checked first."""
    with pytest.raises(UsageError, match=r"like tcp/127\.0\.0\.1:7447"):
        checked_endpoint(endpoint, "--connect")


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:7447", "tcp/[::1]:1", "tls/host:65535", "unixsock-stream//tmp/a"]
)
def test_a_valid_endpoint_is_accepted(endpoint: str) -> None:
    """Names, IPv4 and IPv6 addresses, and sockets in the file system are accepted."""
    assert checked_endpoint(endpoint, "--connect") == endpoint

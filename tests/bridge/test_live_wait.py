"""`cosim listen` and `cosim inject` before an episode is live: real Zenoh, no simulator."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bridge.live import serve_injections
from bridge.security import settings
from bridge.session import Session
from cosim.spec.injection import Ack
from tests.conftest import PATIENCE_S, Cosim
from tests.support.session_pair import listening_at

pytestmark = pytest.mark.engine

PEDESTRIAN = json.dumps({"id": "anna", "path": [[1, 2], [3, 4]]})


def started(*words: str) -> subprocess.Popen[str]:
    """A command of `cosim` that has printed on standard error that it waits."""
    command = subprocess.Popen(
        [sys.executable, "-m", "cosim", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert command.stderr is not None
    assert "waiting" in command.stderr.readline()
    return command


def declare_live_episode(hub: Session, name: str) -> None:
    """Answer as an episode of a run does."""
    serve_injections(
        hub,
        f"cosim/r/env/{name}/inject",
        lambda one: Ack(id=one.id, status="accepted", tick=3, time_s=0.15),
    )
    hub.serve(f"cosim/r/env/{name}/log", lambda _: b'{"tick":7}')
    hub.serve(f"cosim/r/env/{name}/status", lambda _: b"{}", found=True)


def test_listen_waits_until_an_episode_is_live(tmp_path: Path) -> None:
    """`cosim listen` waits for an episode, says so, and then prints its messages."""
    at = f"unixsock-stream/{tmp_path}/air.sock"
    words = ("listen", "events", "--connect", at, "--seconds", "0", "--wait", str(PATIENCE_S))
    with started(*words) as listening, listening_at(at) as hub:
        declare_live_episode(hub, "t-0")
        out, err = listening.communicate()
    assert listening.returncode == 0 and out == '{"tick":7}\n'
    assert "r/t-0 is on the air" in err


def test_inject_waits_for_the_named_episode(tmp_path: Path) -> None:
    """Another live episode of the same run does not end the wait."""
    at = f"unixsock-stream/{tmp_path}/air.sock"
    with listening_at(at) as hub:
        declare_live_episode(hub, "t-0")
        words = ("inject", PEDESTRIAN, "--connect", at, "--env", "r/t-1", "--wait", str(PATIENCE_S))
        with started(*words) as injecting:
            declare_live_episode(hub, "t-1")
            out, err = injecting.communicate()
    assert injecting.returncode == 0 and "'anna' enters at tick 3" in out
    assert "r/t-1 is on the air" in err


def test_a_refusal_without_or_after_a_wait_has_a_remedy(
    tmp_path: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A missing run, a run without an episode and another episode are distinguished, each with its
    remedy."""
    monkeypatch.setattr(settings, "CONNECTS_WITHIN_S", 0.1)
    at = f"unixsock-stream/{tmp_path}/air.sock"
    refused = cosim("listen", "--connect", at)
    assert (
        refused.returncode == 3
        and f"no run is on the air at {at}: start one with" in refused.stderr
    )
    assert f"--live {at}`" in refused.stderr and "--wait 60 waits" in refused.stderr
    waited = cosim("inject", PEDESTRIAN, "--connect", at, "--wait", "0.1")
    assert (
        waited.returncode == 3
        and f"no run is on the air at {at}" in waited.stderr
        and "waited 0.1 s" in waited.stderr
    )
    monkeypatch.undo()
    with listening_at(at) as hub:
        early = cosim("listen", "--connect", at)
        assert (
            early.returncode == 3
            and "none of its episodes" in early.stderr
            and "--wait 60 waits" in early.stderr
        )
        declare_live_episode(hub, "t-0")
        (tmp_path / "long.json").write_text(json.dumps({"id": "anna", "path": [[1, 2]] * 20_000}))
        too_long = cosim("inject", f"@{tmp_path}/long.json", "--connect", at)
        assert too_long.returncode == 2 and "an injection has at most 65536" in too_long.stderr
        other = cosim("listen", "--connect", at, "--env", "r/t-9", "--wait", "0.1")
        assert (
            other.returncode == 2
            and "unknown running episode 'r/t-9'. Valid choices: r/t-0." in other.stderr
        )

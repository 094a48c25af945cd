"""Transports: results do not depend on how jobs and results are carried."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

import cosim
from cosim.core.errors import MachineError
from cosim.core.state import Command
from cosim.episode.interfaces import Policy
from cosim.episode.policy_caller import PolicyCaller
from cosim.results.log import Log
from cosim.results.run_folder import read_records
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Suite
from scenarios.ipc.messages import Done, Hello, Job, Message, MessageHandler
from scenarios.runs import run as suite_run
from scenarios.runs.local import InProcess, LocalProcesses
from scenarios.tools.verify.doctor import small_scenario
from tests.support.equality import thirty_scenarios


class Ahead:
    """Drives straight ahead with a camera."""

    manifest = Manifest("ahead", rate_hz=4.0, camera=CameraSpec(32, 24))

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: object) -> Command:
        return Command(0.8, 0.0)


class Fails(Ahead):
    """Raises an error."""

    def act(self, observation: object) -> Command:
        raise LookupError("no answer")


def done_here(policy: Policy, handle: MessageHandler) -> None:
    """Run one short scenario in this process."""
    driver = PolicyCaller.of(policy)
    worker = InProcess(driver).start(Hello("mine", driver.manifest, driver.source_hash))
    worker.give(Job(msgspec.structs.replace(small_scenario(), time_limit_s=1.0)))
    assert worker.poll(handle) is None


@pytest.mark.engine
def test_a_full_disk_ends_the_run_in_this_process(tmp_path: Path) -> None:
    """An error while writing ends the run instead of crashing the episode, as with processes."""
    messages: list[Message] = []

    def handle(message: Message) -> None:
        messages.append(message)
        raise MachineError("cannot be written: no space left on device")

    with pytest.raises(MachineError, match="no space left"):
        done_here(Ahead(), handle)
    assert len(messages) == 1 and not isinstance(messages[0], Done)


@pytest.mark.engine
def test_the_traceback_of_a_crash_is_printed_in_this_process(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """A record has only the message, and its traceback is printed, as in a worker's log."""
    messages: list[Message] = []
    done_here(Fails(), messages.append)
    assert (
        isinstance(done := messages[-1], Done)
        and done.status == "crashed"
        and b"no answer" in done.record
    )
    errors = capfd.readouterr().err
    assert errors.startswith("--- ") and 'raise LookupError("no answer")' in errors


@pytest.mark.engine
def test_a_suite_has_the_same_results_over_every_transport(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process and in another one, state hashes, tables, logs and camera frames are equal to
    the byte."""
    used = []
    for kind in (InProcess, LocalProcesses):
        monkeypatch.setattr(
            suite_run, kind.__name__, lambda *of, kind=kind: (used.append(kind), kind(*of))[1]
        )
    one = msgspec.structs.replace(small_scenario(), time_limit_s=1.0)
    suite = Suite(
        name="two", version="1", scenarios=(one, msgspec.structs.replace(one, id="other", seed=5))
    )
    options = EpisodeOptions(seed=7, camera="bullet", frames_every_s=0.5)
    cosim.run(suite, Ahead(), out=tmp_path / "here", options=options)
    cosim.run(suite, f"{__name__}:Ahead", out=tmp_path / "there", options=options)
    assert used == [InProcess, LocalProcesses]
    assert len({(tmp_path / name / "results.csv").read_bytes() for name in ("here", "there")}) == 1
    hashes = [
        [record.state_hash for record in read_records(tmp_path / name)]
        for name in ("here", "there")
    ]
    assert hashes[0] == hashes[1] and len(set(hashes[0])) == 2
    files = [
        sorted(p for p in tmp_path.glob(f"{name}/episodes/*/frames/*.png"))
        for name in ("here", "there")
    ]
    assert [p.read_bytes() for p in files[0]] == [p.read_bytes() for p in files[1]] and len(
        files[0]
    ) == 4
    logs = [
        Log.load(tmp_path / name / "episodes" / "other" / "trajectory.npz")
        for name in ("here", "there")
    ]
    assert logs[0].pose.tobytes() == logs[1].pose.tobytes() and len(logs[0]) == 20


def test_equality_runs_thirty_scenarios() -> None:
    """The script that compares all mechanisms selects thirty scenarios, without decoys."""
    chosen = thirty_scenarios().scenarios
    assert len(chosen) == 30 and not any(one.decoy_of for one in chosen)

"""Hostile policies: one behaviour for each episode, and what must come of it in each hosting.

`names.json` in the folder HOSTILE_DESK maps the names of a run's episodes to behaviours.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosim.core.errors import EngineError, PolicyServerLost
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest, WaypointRule

DESK = "HOSTILE_DESK"
ANSWER_S = 3.0
FLOOD_BYTES = 16 << 20
ENGINES = ("libsumo", "pybullet", "moderngl", "zenoh", "sumo_nets", "physics")


class Honest:
    """Drives straight ahead, by the brightness of its picture."""

    manifest = Manifest(
        "honest", rate_hz=4.0, camera=CameraSpec(64, 40), goal="route_patch", odometry="wheel"
    )

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, seen: Observation) -> Command:
        assert seen.rgb is not None and seen.rgb.shape == (40, 64, 3) and seen.camera is not None
        return Command(1.0 + float(seen.rgb.mean()) / 1e4, 0.0)


class Hanging(Honest):
    """Is never made."""

    def __init__(self) -> None:
        time.sleep(3600)


class Hostile(Honest):
    """Does in its second answer, or in another call, what its episode is named for."""

    def reset(self, episode_id: str, seed: int) -> None:
        self.name = json.loads((_desk() / "names.json").read_text())[episode_id]
        self.deed = DEEDS[self.name]
        self.count = 0
        with (_desk() / "began.txt").open("a") as began:
            began.write(f"{self.name}\n")
        if self.deed.call == "reset":
            self.deed.does(self, None)

    def ended(self, episode_id: str) -> None:
        if self.deed.call == "ended":
            self.deed.does(self, None)

    def act_batch(self, observations: Sequence[Observation]) -> list[object]:
        return [self.act(seen) for seen in observations]

    def act(self, seen: Observation) -> Any:
        self.count += 1
        command = super().act(seen)
        if self.count == 2 and self.deed.call == "act":
            answer = self.deed.does(self, seen)
            return command if answer is None else answer
        return command


class Leaves(Honest):
    """Leaves processes behind that outlive it, and hangs."""

    def act(self, seen: Observation) -> Command:
        _leave_processes()
        (_desk() / "left").touch()
        time.sleep(3600)
        return super().act(seen)


class Endless:
    """A sequence without end."""

    def __len__(self) -> int:
        return 1 << 62

    def __getitem__(self, index: int) -> float:
        return 0.0


def _desk() -> Path:
    return Path(os.environ[DESK])


def _raise(error: BaseException) -> Any:
    raise error


def _leave_processes() -> None:
    """Start one process in its own session, and fork one that ignores SIGTERM."""
    subprocess.Popen(["sleep", "3600"], start_new_session=True)
    if os.fork() == 0:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            time.sleep(3600)


def _patches(self: Hostile, seen: Any) -> None:
    from cosim.results import metrics
    from cosim.results.record import Record
    from cosim.results.referee import Referee, Verdict

    Referee.judge = lambda self, step: Verdict(ended="goal")
    Record.encoded = lambda self: b"{}"
    metrics.METRICS = {}


def _peeks(self: Hostile, seen: Any) -> None:
    """Note which engines are in this process, and what of the street; then query SUMO."""
    found = [name for name in ENGINES if name in sys.modules]
    known = [
        one for one in gc.get_objects() if type(one).__name__ in ("Street", "People", "Scenario")
    ]
    found += [type(one).__name__ for one in known if type(one).__name__ != "People" or len(one)]
    import libsumo

    with suppress(libsumo.TraCIException, libsumo.FatalTraCIError):
        found += libsumo.person.getIDList()
    (_desk() / "peeked.json").write_text(json.dumps(found))


def _scribbles(self: Hostile, seen: Any) -> None:
    seen.rgb[:] = 0
    np.asarray(seen.camera.matrix).setflags(write=True)
    seen.camera.matrix[:] = 0.0
    object.__setattr__(seen, "tick", -1)
    object.__setattr__(seen.robot, "v_max_mps", 1e9)


def _changes_its_manifest(self: Hostile, seen: Any) -> None:
    self.manifest = Manifest("somebody", rate_hz=20.0, privileged=True)
    type(self).manifest = Manifest("somebody", rate_hz=20.0, waypoints=WaypointRule(dt_s=1e-6))


def _deletes_its_folder(self: Hostile, seen: Any) -> None:
    for folder in _desk().glob(f"*/episodes/{self.name}"):
        shutil.rmtree(folder)


def _forges_its_record(self: Hostile, seen: Any) -> None:
    for folder in _desk().glob("*/episodes"):
        (folder / self.name).mkdir(exist_ok=True)
        forged = '{"status": "done", "measures": {"success": 1.0}}'
        (folder / self.name / "record.json").write_text(forged)


def _floods(self: Hostile, seen: Any) -> None:
    print("the flood begins", flush=True)
    for _ in range(FLOOD_BYTES >> 20):
        os.write(1, b"flood\n" * ((1 << 20) // 6))
    print("the flood ends", flush=True)


def _forks(self: Hostile, seen: Any) -> None:
    if os.fork() == 0:
        if os.fork() == 0:
            os.setsid()
            time.sleep(3600)
        return  # answers a second time


def _writes_garbage(self: Hostile, seen: Any) -> None:
    for descriptor in range(3, 64):
        with suppress(OSError):
            os.write(descriptor, b"\xff" * 4096)


def _closes_its_output(self: Hostile, seen: Any) -> None:
    os.close(1)
    os.close(2)


def _starts_a_thread(self: Hostile, seen: Any) -> None:
    threading.Thread(target=lambda: [time.sleep(0.01) for _ in range(10**6)]).start()


def _dies_and_leaves_processes(self: Hostile, seen: Any) -> None:
    _leave_processes()
    os._exit(0)


def _kills_its_parent(self: Hostile, seen: Any) -> None:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(3600)


DONE = "done"
"""Status of an episode that is simulated as that of `honest`."""


class Deed(NamedTuple):
    """A behaviour.

    does: what it does; an answer that is None is that of `honest`
    here: DONE or a part of the crash's reason in the simulator's process; None: not run there
    isolated: the same with --isolated
    call: the call of the policy in which it happens
    attempts: how often the episode is run in the simulator's process
    """

    does: Callable[[Hostile, Any], Any]
    here: str | None
    isolated: str | None
    call: str = "act"
    attempts: int = 1


def _no_answer(call: str, name: str) -> str:
    return f"policy 'honest' gave no answer for {ANSWER_S:g} s in {call} of {name}"


_TOO_MANY = "100002 numbers; an answer holds at most 100000 (act at 0.25 s)"
_ENDED = "gave no answer: the policy process ended with exit code"
DEEDS = {
    "honest": Deed(lambda self, seen: None, DONE, DONE),
    "error": Deed(
        lambda self, seen: _raise(KeyError("no such weight")),
        "policy 'honest' raised KeyError: 'no such weight' (act at 0.25 s)",
        "policy 'honest' raised KeyError: 'no such weight' (act at 0.25 s)",
    ),
    "exits": Deed(lambda self, seen: sys.exit("enough"), "raised SystemExit: enough", None),
    "pretends-to-be-an-engine": Deed(
        lambda self, seen: _raise(EngineError("SUMO failed")), "EngineError: SUMO failed", None
    ),
    "pretends-to-be-lost": Deed(
        lambda self, seen: _raise(PolicyServerLost("the server is gone")),
        None,
        "policy 'honest' raised PolicyServerLost: the server is gone (act at 0.25 s)",
    ),
    "without-end": Deed(lambda self, seen: Endless(), "policy 'honest' ", None),
    "too-many-numbers": Deed(lambda self, seen: np.zeros((50_001, 2)), _TOO_MANY, _TOO_MANY),
    "far-too-many-numbers": Deed(
        lambda self, seen: np.zeros((1_000_000, 4)), None, "an answer holds at most 100000"
    ),
    "patches-the-referee": Deed(_patches, None, DONE),
    "peeks": Deed(_peeks, None, DONE),
    "scribbles": Deed(_scribbles, DONE, DONE),
    "changes-its-manifest": Deed(_changes_its_manifest, DONE, None),
    "goes-elsewhere": Deed(lambda self, seen: os.chdir("/"), DONE, DONE),
    "deletes-its-folder": Deed(_deletes_its_folder, DONE, None),
    "forges-its-record": Deed(_forges_its_record, DONE, None),
    "floods": Deed(_floods, DONE, DONE),
    "closes-its-output": Deed(_closes_its_output, DONE, None),
    "forks": Deed(_forks, DONE, DONE),
    "starts-a-thread": Deed(_starts_a_thread, DONE, None),
    "writes-garbage": Deed(_writes_garbage, None, "gave no answer: the policy process"),
    "closes-descriptors": Deed(
        lambda self, seen: os.closerange(0, 1024), "the environment process", _ENDED, attempts=2
    ),
    "dies-and-leaves-processes": Deed(
        _dies_and_leaves_processes,
        "the environment process ended with exit code 0 in the policy's act at 0.25 s",
        f"{_ENDED} 0 (act at 0.25 s)",
        attempts=2,
    ),
    "kills-its-parent": Deed(
        _kills_its_parent,
        "the environment process was killed by SIGKILL in the policy's act at 0.25 s, 2 times",
        None,
        attempts=2,
    ),
    "hangs-with-the-lock": Deed(
        lambda self, seen: ctypes.PyDLL(None).sleep(3600),
        _no_answer("act at 0.25 s", "hangs-with-the-lock"),
        None,
    ),
    "stops-itself": Deed(
        lambda self, seen: os.kill(os.getpid(), signal.SIGSTOP),
        _no_answer("act at 0.25 s", "stops-itself"),
        _no_answer("act at 0.25 s", "stops-itself"),
    ),
    "hangs-in-reset": Deed(
        lambda self, seen: time.sleep(3600), _no_answer("reset", "hangs-in-reset"), None, "reset"
    ),
    "ends-afterwards": Deed(lambda self, seen: os._exit(0), None, DONE, "ended"),
    "hangs-afterwards": Deed(
        lambda self, seen: time.sleep(3600), None, _no_answer("ended", "hangs-afterwards"), "ended"
    ),
}

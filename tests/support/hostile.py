"""Policies that do what no policy should: each a function, called in place of the third answer of
an episode.

One class drives all of them: `names.json` says which scenario an episode is, for runs of one seed.
Run by test_hostile.py in real processes.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cosim.core.errors import EngineError
from cosim.core.state import Command, Signal
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest, WaypointRule

HERE = Path(os.environ.get("HOSTILE_DESK", ".")).absolute()
WALK = Command(1.0, 0.0)
FLOOD_BYTES = 16 << 20
Act = Callable[["Hostile", Observation], object]
ACTS: dict[str, Act] = {}
RESETS: dict[str, Callable[[], None]] = {}


def act(does: Act) -> Act:
    ACTS[does.__name__.strip("_").replace("_", "-")] = does
    return does


def reset(does: Callable[[], None]) -> Callable[[], None]:
    RESETS[does.__name__.replace("_", "-")] = does
    return does


class Hostile:
    """Walks straight on, and does something once."""

    manifest = Manifest("hostile", camera=None, privileged=True)

    def reset(self, episode_id: str, seed: int) -> None:
        self.name = json.loads((HERE / "names.json").read_text())[episode_id]
        self.count = 0
        with (HERE / "began.txt").open("a") as began:
            began.write(f"{self.name}\n")
        RESETS.get(self.name, lambda: None)()

    def act(self, observation: Observation) -> object:
        self.count += 1
        return ACTS[self.name](self, observation) if self.count == 3 and self.name in ACTS else WALK


class Painter(Hostile):
    """Blackens what it sees, and declares later than it should that it is privileged."""

    manifest = Manifest("painter", camera=CameraSpec(16, 16))

    def act(self, observation: Observation) -> object:
        self.manifest = Manifest("painter", camera=None, privileged=True)
        if observation.privileged is not None:
            raise ValueError("knows everything")
        if self.name == "blackens":
            observation.rgb[:] = 0  # type: ignore[index]
        return WALK


class Leaves(Hostile):
    """Leaves processes behind that outlive it, and hangs."""

    manifest = Manifest("leaves", camera=None)

    def act(self, observation: Observation) -> object:
        leave_processes()
        (HERE / "left").touch()
        time.sleep(3600)
        return WALK


def leave_processes() -> None:
    """One in a session of its own, and a forked one that holds every descriptor and forgets its
    parent."""
    subprocess.Popen(["sleep", "3600"], start_new_session=True)
    if os.fork() == 0:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            time.sleep(3600)


class Mute(Exception):
    def __str__(self) -> str:
        raise SystemExit(1)


class Unreal(float):
    def __float__(self) -> float:
        raise KeyboardInterrupt


class Endless:
    """A sequence without end."""

    def __len__(self) -> int:
        return 1 << 62

    def __getitem__(self, index: int) -> float:
        return 0.0


# What a policy may raise.


@reset
def exit_in_reset() -> None:
    sys.exit(3)


@reset
def error_in_reset() -> None:
    raise FileNotFoundError("weights.pt")


@act
def error(self: Hostile, seen: Observation) -> object:
    raise KeyError("no such weight")


@act
def too_many_numbers(self: Hostile, seen: Observation) -> object:
    return np.zeros((50_001, 2))


@act
def exit_(self: Hostile, seen: Observation) -> object:
    sys.exit("enough")


@act
def exit_with_0(self: Hostile, seen: Observation) -> object:
    raise SystemExit(0)


@act
def ctrl_c(self: Hostile, seen: Observation) -> object:
    raise KeyboardInterrupt


@act
def generator_exit(self: Hostile, seen: Observation) -> object:
    raise GeneratorExit


@act
def stop_iteration(self: Hostile, seen: Observation) -> object:
    return next(iter(()))


@act
def cancelled(self: Hostile, seen: Observation) -> object:
    raise asyncio.CancelledError


@act
def too_much_memory(self: Hostile, seen: Observation) -> object:
    return np.ones((1 << 50, 2))


@act
def recursion(self: Hostile, seen: Observation) -> object:
    return recursion(self, seen)


@act
def mute(self: Hostile, seen: Observation) -> object:
    raise Mute


@act
def odd_text(self: Hostile, seen: Observation) -> object:
    raise ValueError("\ud800 \x1b[31m red \x00")


@act
def long_text(self: Hostile, seen: Observation) -> object:
    raise ValueError("x" * 1_000_000)


@act
def pretends_to_be_an_engine(self: Hostile, seen: Observation) -> object:
    raise EngineError("SUMO failed")


# What a policy may answer.


@act
def nothing(self: Hostile, seen: Observation) -> object:
    return None


@act
def nan(self: Hostile, seen: Observation) -> object:
    return Command(float("nan"), 0.0)


@act
def infinity(self: Hostile, seen: Observation) -> object:
    return [[float("inf"), 0.0]] * 3


@act
def huge_integer(self: Hostile, seen: Observation) -> object:
    return Command(10**400, 0.0)


@act
def complex_(self: Hostile, seen: Observation) -> object:
    return np.array([[1.0 + 2.0j, 0.0]])


@act
def texts(self: Hostile, seen: Observation) -> object:
    return [["1.0", "0.0"]]


@act
def truths(self: Hostile, seen: Observation) -> object:
    return np.array([[True, False]])


@act
def objects(self: Hostile, seen: Observation) -> object:
    return np.array([[1.0, self]], dtype=object)


@act
def ragged(self: Hostile, seen: Observation) -> object:
    return [[1.0, 0.0], [1.0]]


@act
def wrong_shape(self: Hostile, seen: Observation) -> object:
    return np.zeros((3, 7))


@act
def no_waypoint(self: Hostile, seen: Observation) -> object:
    return np.zeros((0, 2))


@act
def a_coroutine(self: Hostile, seen: Observation) -> object:
    async def later() -> Command:
        return WALK

    self.kept = later()
    return self.kept


@act
def an_unreal_float(self: Hostile, seen: Observation) -> object:
    return Command(Unreal(1.0), 0.0)


@act
def without_end(self: Hostile, seen: Observation) -> object:
    return Endless()


# What a policy may touch.


@act
def honest(self: Hostile, seen: Observation) -> object:
    return WALK


@act
def scribbles(self: Hostile, seen: Observation) -> object:
    known = seen.privileged
    assert known is not None
    arrays = (
        known.people.xy,
        known.people.heading,
        known.vehicles.xy,
        known.vehicles.heading,
        known.route.points,
    )
    for array in (*arrays, known.route.s_m):
        array.setflags(write=True)
        array += 50.0
    object.__setattr__(known.robot, "v_mps", 50.0)
    for name in list(known.signals):
        known.signals[name] = Signal(True)  # type: ignore[index]
    return WALK


@act
def another_manifest(self: Hostile, seen: Observation) -> object:
    self.manifest = Manifest("somebody", rate_hz=20.0, waypoints=WaypointRule(dt_s=1e-6))
    type(self).manifest = self.manifest
    return WALK


@act
def elsewhere(self: Hostile, seen: Observation) -> object:
    os.chdir("/")
    return WALK


@act
def deletes_its_folder(self: Hostile, seen: Observation) -> object:
    for folder in HERE.glob(f"*/episodes/{self.name}"):
        shutil.rmtree(folder)
    return WALK


@act
def forges_its_record(self: Hostile, seen: Observation) -> object:
    for folder in HERE.glob("*/episodes"):
        (folder / self.name).mkdir(exist_ok=True)
        (folder / self.name / "record.json").write_text(
            '{"status": "done", "measures": {"success": 1.0}}'
        )
    return WALK


# What a policy may do to processes.


@act
def floods(self: Hostile, seen: Observation) -> object:
    print("the flood begins", flush=True)
    for _ in range(FLOOD_BYTES >> 20):
        os.write(1, b"flood\n" * ((1 << 20) // 6))
    print("the flood ends", flush=True)
    return WALK


@act
def closes_its_output(self: Hostile, seen: Observation) -> object:
    os.close(1)
    os.close(2)
    return WALK


@act
def closes_everything(self: Hostile, seen: Observation) -> object:
    os.closerange(0, 1024)
    return WALK


@act
def forks(self: Hostile, seen: Observation) -> object:
    os.fork()
    return WALK


@act
def a_busy_thread(self: Hostile, seen: Observation) -> object:
    threading.Thread(target=lambda: [time.sleep(0.01) for _ in range(10**6)]).start()
    return WALK


@act
def dies_and_leaves_processes(self: Hostile, seen: Observation) -> object:
    leave_processes()
    os._exit(0)


@act
def kills_its_parent(self: Hostile, seen: Observation) -> object:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(3600)
    return WALK


@act
def hangs_with_the_lock(self: Hostile, seen: Observation) -> object:
    ctypes.PyDLL(None).sleep(3600)  # a PyDLL keeps the interpreter's lock
    return WALK


@act
def stops_itself(self: Hostile, seen: Observation) -> object:
    os.kill(os.getpid(), signal.SIGSTOP)
    return WALK


@reset
def hangs_in_reset() -> None:
    time.sleep(3600)

"""Hostile policies: one behaviour for each episode, with its expected outcome in each hosting. A
test copies this file to a separate folder, whose `names.json` maps the names of a run's episodes to
behaviours. In the simulator's process, each attempt is noted in `began.txt` outside."""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import gc
import json
import locale
import os
import resource
import shutil
import signal
import sqlite3
import stat
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

ANSWER_S = 4.0
"""Timeout of answers and of ticks in runs of hanging behaviours."""
START_S = 12.0
"""Timeout of loading and of reset in the runs of those that hang: a slow machine loads a policy in it."""
FLOOD_BYTES = 16 << 20
ENGINES = ("libsumo", "pybullet", "moderngl", "zenoh", "sumo_nets", "physics")
_FORKS = 40
_PTRACE_ATTACH = 16


class Honest:
    """Drives straight ahead, by the brightness of its picture."""

    manifest = Manifest(
        "honest", rate_hz=4.0, camera=CameraSpec(64, 40), goal="route_patch", odometry="wheel"
    )

    def reset(self, episode_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, seen: Observation) -> Command:
        assert seen.rgb is not None and seen.rgb.shape == (40, 64, 3) and seen.camera is not None
        return Command(1.0 + float(seen.rgb.mean()) / 1e4, 0.0)


class Hanging(Honest):
    """A policy whose construction never ends."""

    def __init__(self) -> None:
        time.sleep(3600)


class Hostile(Honest):
    """Does what its episode is named for in its second answer or in another call. It drives without
    a camera, so that its processes start fast."""

    manifest = Manifest("honest", rate_hz=4.0, camera=None, odometry="wheel")

    def reset(self, episode_id: str, seed: int) -> None:
        self.name = json.loads(_HERE.with_name("names.json").read_text())[episode_id]
        self.behaviour = BEHAVIOURS[self.name]
        self.count = 0
        self.undo: Callable[[], object] = lambda: None
        with (
            suppress(OSError),
            (_test_folder() / "began.txt").open("a") as began,
        ):  # not from a sandbox
            began.write(f"{self.name}\n")
        if self.behaviour.call == "reset":
            self.behaviour.act(self, None)

    def ended(self, episode_id: str) -> None:
        self.undo()
        if self.behaviour.call == "ended":
            self.behaviour.act(self, None)

    def act_batch(self, observations: Sequence[Observation]) -> list[object]:
        return [self.act(seen) for seen in observations]

    def act(self, seen: Observation) -> Any:
        self.count += 1
        command = self.honest_command(seen)
        if self.behaviour.call == "every act" or (self.count == 2 and self.behaviour.call == "act"):
            answer = self.behaviour.act(self, seen)
            return command if answer is None else answer
        return command

    def honest_command(self, seen: Observation) -> Command:
        return Command(1.0, 0.0)


class SeeingHostile(Hostile):
    """A hostile policy with a camera."""

    manifest = Honest.manifest

    def honest_command(self, seen: Observation) -> Command:
        return Honest.act(self, seen)


class Leaves(Honest):
    """Starts processes that outlive it, and hangs."""

    def act(self, seen: Observation) -> Command:
        _leave_processes()
        (_test_folder() / "left").touch()
        time.sleep(3600)
        return super().act(seen)


class Endless:
    """A sequence without end."""

    def __len__(self) -> int:
        return 1 << 62

    def __getitem__(self, index: int) -> float:
        return 0.0


class Unprintable(Exception):
    """An error that cannot be converted to text."""

    def __str__(self) -> str:
        raise ValueError("no words")


class HostileArray:
    """Raises an error when it is converted to an array."""

    def __array__(self, *_: object, **__: object) -> Any:
        raise SystemExit("no array")


class HostileFloat(float):
    """Is no number, and cannot be compared or printed."""

    def __float__(self) -> float:
        raise KeyboardInterrupt

    def __eq__(self, other: object) -> bool:
        raise MemoryError

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        raise GeneratorExit


_HERE = Path(__file__).resolve()


def _test_folder() -> Path:
    return _HERE.parents[1]


def _run_folder() -> Path:
    return _test_folder() / "run"


def _raise(error: BaseException) -> Any:
    raise error


def _recurses(self: Hostile, seen: Any) -> Any:
    return _recurses(self, seen)


def _soon(does: Callable[[], object], after_s: float = 0.01) -> None:
    """Call a function a moment later, in another thread."""
    threading.Timer(after_s, does).start()


def _leave_processes() -> None:
    """Start one process in its own session, and fork one that ignores SIGTERM."""
    subprocess.Popen(["sleep", "3600"], start_new_session=True)
    if os.fork() == 0:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            time.sleep(3600)


def _patches_the_referee(self: Hostile, seen: Any) -> None:
    """Win until the episode has ended; the patch would stay for the next episode."""
    from cosim.results.referee import Referee, Verdict

    judge = Referee.judge
    Referee.judge = lambda self, step: Verdict(ended="goal")
    self.undo = lambda: setattr(Referee, "judge", judge)


def _patches_the_director(self: Hostile, seen: Any) -> None:
    """Let the director of this process fail, as an alarm at an unlucky moment does."""
    from bridge import director

    before = director.decode_query
    director.decode_query = lambda *_: _raise(OSError("alarm"))
    self.undo = lambda: setattr(director, "decode_query", before)


def _patches_numpy(self: Hostile, seen: Any) -> None:
    names = ("hypot", "column_stack", "asarray")
    before = {name: getattr(np, name) for name in names}
    for name in names:
        setattr(np, name, None)
    self.undo = lambda: [setattr(np, name, it) for name, it in before.items()]


def _patches_time(self: Hostile, seen: Any) -> None:
    before = time.perf_counter
    time.perf_counter = None
    self.undo = lambda: setattr(time, "perf_counter", before)


def _empties_sys_modules(self: Hostile, seen: Any) -> None:
    before = dict(sys.modules)
    self.undo = lambda: sys.modules.update(before)
    for name in before:
        if name.startswith(("cosim", "scenarios", "physics", "numpy")):
            sys.modules[name] = None


def _peeks(self: Hostile, seen: Any) -> None:
    """Find the engines and the street in this process; then query SUMO."""
    found = [name for name in ENGINES if name in sys.modules]
    known = [
        one for one in gc.get_objects() if type(one).__name__ in ("Street", "People", "Scenario")
    ]
    found += [type(one).__name__ for one in known if type(one).__name__ != "People" or len(one)]
    with suppress(Exception):
        import libsumo

        found += libsumo.person.getIDList()
    if found:
        raise LookupError(f"found {found}")


def _scribbles(self: Hostile, seen: Any) -> None:
    seen.rgb[:] = 0
    np.asarray(seen.camera.matrix).setflags(write=True)
    seen.camera.matrix[:] = 0.0
    object.__setattr__(seen, "tick", -1)
    object.__setattr__(seen.robot, "v_max_mps", 1e9)

    def scribble() -> None:
        for _ in range(100):
            seen.rgb[:] = 0
            time.sleep(0.001)

    _soon(scribble)


def _changes_its_manifest(self: Hostile, seen: Any) -> None:
    self.manifest = Manifest("somebody", rate_hz=20.0, privileged=True)
    type(self).manifest = Manifest("somebody", rate_hz=20.0, waypoints=WaypointRule(dt_s=1e-6))


def _changes_its_surroundings(self: Hostile, seen: Any) -> None:
    locale.setlocale(locale.LC_ALL, "C")
    os.umask(0o777)
    os.chdir("/")
    kept = {name: os.environ[name] for name in ("PATH", "LC_HOSTILE_MARK")}
    os.environ.clear()
    os.environ.update(kept, TMPDIR="/nowhere", HOME="/nowhere", LANG="xx")


def _renames_the_run(self: Hostile, seen: Any) -> None:
    with suppress(OSError):  # the sandbox has no run folder
        _run_folder().chmod(0)
        _run_folder().rename(_test_folder() / "elsewhere")


def _forges_its_results(self: Hostile, seen: Any) -> None:
    with suppress(sqlite3.Error), sqlite3.connect(_run_folder() / "results.sqlite") as database:
        database.execute("delete from episodes")
        database.execute("insert into episodes values (?, '{}')", (self.name,))
    for record in _run_folder().glob("episodes/*/record.json"):
        record.write_text('{"status": "done", "measures": {"success": 1.0}}')


def _exceeds_the_size_of_files(self: Hostile, seen: Any) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
    with os.fdopen(os.memfd_create("large"), "wb") as large:
        large.write(bytes(1 << 16))


def _limit_memory(more: int) -> None:
    """Limit the memory of this process to some more bytes than it has; to 1 GiB without /proc."""
    room = 1 << 30
    with suppress(OSError):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        room = pages * resource.getpagesize() + more
    resource.setrlimit(resource.RLIMIT_AS, (room, resource.getrlimit(resource.RLIMIT_AS)[1]))


def _takes_all_memory(self: Hostile, seen: Any) -> None:
    """Use all memory of this process, and answer."""
    _limit_memory(32 << 20)
    for size in (1 << 20, 1 << 16, 1 << 10, 64):
        with suppress(MemoryError):
            while True:
                _held.append(bytearray(size))


_held: list[bytearray] = []


def _limits(*which: tuple[int, int]) -> Callable[[Hostile, Any], None]:
    def limit(self: Hostile, seen: Any) -> None:
        for limit, most in which:
            resource.setrlimit(limit, (most, most))

    return limit


def _exhausts_memory(self: Hostile, seen: Any) -> None:
    _limit_memory(64 << 20)
    bytearray(1 << 40)


def _fills_its_descriptors(self: Hostile, seen: Any) -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, 256))
    with suppress(OSError):
        while True:
            os.open("/dev/null", os.O_RDONLY)


def _floods(self: Hostile, seen: Any) -> None:
    print("the flood begins", flush=True)
    for _ in range(FLOOD_BYTES >> 20):
        os.write(1, b"flood\n" * ((1 << 20) // 6))
    print("the flood ends", flush=True)


def _floods_and_dies(self: Hostile, seen: Any) -> None:
    print("the other flood begins", flush=True)
    for _ in range(FLOOD_BYTES >> 20):
        os.write(2, b"flood\n" * ((1 << 20) // 6))
    print("the other flood ends", flush=True)
    os._exit(5)


def _answers_twice(self: Hostile, seen: Any) -> None:
    if os.fork() == 0:
        if os.fork() == 0:
            os.setsid()
            time.sleep(3600)
        return  # answers a second time


def _forks_many(self: Hostile, seen: Any) -> None:
    for _ in range(_FORKS):
        if os.fork() == 0:
            time.sleep(3600)


def _writes_garbage(self: Hostile, seen: Any) -> None:
    for descriptor in range(3, 64):
        with suppress(OSError):
            if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                os.write(descriptor, b"\xff" * 4096)


def _overwrites_shared_memory(self: Hostile, seen: Any) -> None:
    """Write to every memory file that is open in this process."""
    for descriptor in range(3, 64):
        with suppress(OSError, ValueError):
            if "memfd" in Path(f"/proc/self/fd/{descriptor}").readlink().name:
                os.pwrite(descriptor, b"\xff" * 256, 0)
                fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)


def _closes_its_output(self: Hostile, seen: Any) -> None:
    os.close(1)
    os.close(2)


def _freezes_later(self: Hostile, seen: Any) -> None:
    """Hold the interpreter's lock after the answer."""
    main = threading.main_thread().ident or 0

    def freeze() -> None:
        frame = sys._current_frames()[main]
        while frame is not None:
            if frame.f_code.co_name == "act":
                time.sleep(0.001)
                frame = sys._current_frames()[main]
            else:
                frame = frame.f_back
        ctypes.PyDLL(None).sleep(3600)

    _soon(freeze, 0.0)


def _interrupts_later(self: Hostile, seen: Any) -> None:
    main = ctypes.c_ulong(threading.main_thread().ident or 0)
    error = ctypes.py_object(KeyboardInterrupt)
    _soon(lambda: ctypes.pythonapi.PyThreadState_SetAsyncExc(main, error))


def _stops_later(self: Hostile, seen: Any) -> None:
    """Stop this process from a child, repeatedly."""
    parent = os.getpid()
    if os.fork() == 0:
        for _ in range(20):
            time.sleep(0.01)
            os.kill(parent, signal.SIGSTOP)
        os._exit(0)


def _handles_alarms(self: Hostile, seen: Any) -> None:
    signal.signal(signal.SIGALRM, lambda number, frame: _raise(OSError("alarm")))
    signal.setitimer(signal.ITIMER_REAL, 0.01, 0.01)


def _traces_calls(self: Hostile, seen: Any) -> None:
    def trace(frame: Any, event: str, argument: Any) -> None:
        if "advance" in frame.f_code.co_name:
            raise OverflowError("traced")

    sys.settrace(trace)
    self.undo = lambda: sys.settrace(None)


def _outlives_its_process(self: Hostile, seen: Any) -> None:
    """Ignore signals, keep a thread, and hang when Python ends."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGCHLD):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=lambda: [time.sleep(0.01) for _ in range(10**6)]).start()
    atexit.register(time.sleep, 3600)


def _dies_and_leaves_processes(self: Hostile, seen: Any) -> None:
    _leave_processes()
    os._exit(0)


def _sends(number: signal.Signals, process_of: Callable[[], int]) -> Callable[[Hostile, Any], None]:
    """Send a signal to a process, and wait for its effect. A sandbox may deny it."""

    def send(self: Hostile, seen: Any) -> None:
        with suppress(PermissionError):
            os.kill(process_of(), number)
            time.sleep(0.5)

    return send


def _traces_its_parent(self: Hostile, seen: Any) -> None:
    ctypes.CDLL(None).ptrace(_PTRACE_ATTACH, os.getppid(), 0, 0)


def _slower(self: Hostile, seen: Any) -> None:
    time.sleep(0.02 * self.count)


def _calls(function: Callable[[], object]) -> Callable[[Hostile, Any], Any]:
    return lambda self, seen: function()


DONE = "done"
"""The episode equals that of `honest` to the bit."""
FORGED = "forged"
"""Not preventable in the simulator's process: the policy forges its record. Only
`--isolated` prevents it (docs/hosting.md)."""
BLAMED = "the policy is at fault, because the simulator survives its commands without it"


class Behaviour(NamedTuple):
    """A behaviour.

    act: what it does; an answer that is None is that of `honest`. What it patches is restored by
        `undo` when the episode has ended, because a policy may harm its own later episodes.
    in_process: DONE, FORGED or a part of the crash's reason in the simulator's process
    isolated: the same with --isolated
    call: the call of the policy in which it happens
    attempts: how often the episode is run in the simulator's process
    harms_folder: whether it harms the run folder, so that it has a run of its own
    sees: whether it needs a picture, so that its run has a camera
    hangs: whether a timeout ends it, so that its run has short ones
    """

    act: Callable[[Hostile, Any], Any]
    in_process: str
    isolated: str
    call: str = "act"
    attempts: int = 1
    harms_folder: bool = False
    sees: bool = False
    hangs: bool = False


def _no_answer(call: str, name: str, within_s: float = ANSWER_S) -> str:
    return f"policy 'honest' gave no answer for {within_s:g} s in {call} of {name}"


def _both(words: str) -> tuple[str, str]:
    return words, words


_ACT = "act at 0.25 s"
_TOO_MANY = f"100002 numbers; an answer holds at most 100000 ({_ACT})"
_ENDED = "gave no answer: the policy process"
_ITSELF = "the environment process"
BEHAVIOURS = {
    "honest": Behaviour(_calls(lambda: None), DONE, DONE),
    # It raises.
    "raises-an-error": Behaviour(
        _calls(lambda: _raise(KeyError("no such weight"))),
        *_both(f"policy 'honest' raised KeyError: 'no such weight' ({_ACT})"),
    ),
    "exits": Behaviour(_calls(lambda: sys.exit("enough")), *_both("raised SystemExit: enough")),
    "raises-keyboard-interrupt": Behaviour(
        _calls(lambda: _raise(KeyboardInterrupt())), *_both("raised KeyboardInterrupt")
    ),
    "raises-generator-exit": Behaviour(
        _calls(lambda: _raise(GeneratorExit())), *_both("raised GeneratorExit")
    ),
    "recurses": Behaviour(_recurses, *_both("raised RecursionError")),
    "raises-engine-error": Behaviour(
        _calls(lambda: _raise(EngineError("SUMO failed"))), *_both("EngineError: SUMO failed")
    ),
    "raises-server-lost": Behaviour(
        _calls(lambda: _raise(PolicyServerLost("the server is gone"))),
        *_both(f"policy 'honest' raised PolicyServerLost: the server is gone ({_ACT})"),
    ),
    "raises-unprintable": Behaviour(
        _calls(lambda: _raise(Unprintable())), *_both("raised Unprintable")
    ),
    # It answers nonsense.
    "answers-nan": Behaviour(
        _calls(lambda: Command(float("nan"), 0.0)), *_both("both must be finite numbers")
    ),
    "answers-without-end": Behaviour(_calls(Endless), *_both("policy 'honest' ")),
    "answers-too-many-numbers": Behaviour(_calls(lambda: np.zeros((50_001, 2))), *_both(_TOO_MANY)),
    "answers-hostile-array": Behaviour(_calls(HostileArray), *_both("raised SystemExit: no array")),
    "answers-hostile-float": Behaviour(
        _calls(lambda: Command(HostileFloat(1.0), 0.0)), *_both("raised KeyboardInterrupt")
    ),
    "answers-twice": Behaviour(_answers_twice, DONE, DONE),
    # It changes what is in its process.
    "scribbles": Behaviour(_scribbles, DONE, DONE, sees=True),
    "changes-its-manifest": Behaviour(_changes_its_manifest, DONE, DONE, sees=True),
    "patches-the-referee": Behaviour(_patches_the_referee, FORGED, DONE),
    "patches-the-director": Behaviour(_patches_the_director, BLAMED, DONE, attempts=2),
    "patches-numpy": Behaviour(_patches_numpy, BLAMED, DONE, attempts=2),
    "patches-time": Behaviour(_patches_time, BLAMED, DONE, attempts=2),
    "empties-sys-modules": Behaviour(_empties_sys_modules, DONE, DONE),
    "changes-its-surroundings": Behaviour(_changes_its_surroundings, DONE, DONE),
    "peeks": Behaviour(_peeks, "raised LookupError: found ['pybullet'", DONE),
    "traces-calls": Behaviour(_traces_calls, BLAMED, DONE, attempts=2),
    "handles-alarms": Behaviour(_handles_alarms, BLAMED, _ENDED, attempts=2),
    "interrupts-later": Behaviour(_interrupts_later, BLAMED, _ENDED, attempts=2),
    "outlives-its-process": Behaviour(_outlives_its_process, DONE, DONE),
    # It harms files.
    "deletes-the-run": Behaviour(
        _calls(lambda: shutil.rmtree(_run_folder(), ignore_errors=True)),
        DONE,
        DONE,
        harms_folder=True,
    ),
    "renames-the-run": Behaviour(_renames_the_run, DONE, DONE, harms_folder=True),
    "forges-its-results": Behaviour(_forges_its_results, DONE, DONE, harms_folder=True),
    "exceeds-the-size-of-files": Behaviour(
        _exceeds_the_size_of_files, *_both("raised OSError: [Errno 27] File too large")
    ),
    # It takes what the simulator needs.
    "limits-descriptors": Behaviour(_limits((resource.RLIMIT_NOFILE, 4)), DONE, DONE),
    "fills-its-descriptors": Behaviour(_fills_its_descriptors, DONE, DONE),
    "takes-all-memory": Behaviour(_takes_all_memory, BLAMED, _ENDED, attempts=2),
    "exhausts-memory": Behaviour(_exhausts_memory, *_both("raised MemoryError")),
    # It harms outputs and connections.
    "floods": Behaviour(_floods, DONE, DONE),
    "floods-and-dies": Behaviour(_floods_and_dies, f"{_ITSELF} ended with exit code 5", _ENDED),
    "closes-its-output": Behaviour(_closes_its_output, DONE, DONE),
    "writes-garbage": Behaviour(_writes_garbage, _ITSELF, _ENDED, attempts=2),
    "overwrites-shared-memory": Behaviour(_overwrites_shared_memory, DONE, DONE, sees=True),
    "closes-descriptors": Behaviour(
        _calls(lambda: os.closerange(0, 1024)), _ITSELF, _ENDED, attempts=2
    ),
    # It ends, stops or multiplies processes.
    "dies-and-leaves-processes": Behaviour(
        _dies_and_leaves_processes,
        f"{_ITSELF} ended with exit code 0 in the policy's {_ACT}",
        f"{_ENDED} ended with exit code 0 ({_ACT})",
    ),
    "kills-itself": Behaviour(
        _sends(signal.SIGKILL, os.getpid),
        f"{_ITSELF} was killed by SIGKILL in the policy's {_ACT}, 2 times: {BLAMED}",
        f"{_ENDED} was killed by SIGKILL",
        attempts=2,
    ),
    "segfaults": Behaviour(
        _calls(lambda: ctypes.string_at(0)),
        f"{_ITSELF} was killed by SIGSEGV in the policy's {_ACT}",
        f"{_ENDED} was killed by SIGSEGV",
    ),
    "stops-itself": Behaviour(_sends(signal.SIGSTOP, os.getpid), DONE, DONE),
    "stops-later": Behaviour(_stops_later, DONE, DONE),
    "kills-its-parent": Behaviour(
        _sends(signal.SIGKILL, os.getppid),
        f"{_ITSELF} was killed by SIGKILL in the policy's {_ACT}, 2 times: {BLAMED}",
        DONE,
        attempts=2,
    ),
    "ends-its-parent": Behaviour(
        _sends(signal.SIGTERM, os.getppid),
        f"{_ITSELF} was killed by SIGTERM in the policy's {_ACT}, 2 times: {BLAMED}",
        DONE,
        attempts=2,
    ),
    "stops-its-parent": Behaviour(_sends(signal.SIGSTOP, os.getppid), DONE, DONE),
    "kills-its-group": Behaviour(
        _calls(lambda: os.killpg(0, signal.SIGKILL)),
        f"{_ITSELF} was killed by SIGKILL in the policy's {_ACT}, 2 times: {BLAMED}",
        f"{_ENDED} was killed by SIGKILL",
        attempts=2,
    ),
    "traces-its-parent": Behaviour(_traces_its_parent, DONE, DONE),
    "forks-many": Behaviour(_forks_many, DONE, DONE),
    # It is slow, or gives no answer.
    "hangs-in-reset": Behaviour(
        _calls(lambda: time.sleep(3600)),
        *_both(_no_answer("reset", "hangs-in-reset", START_S)),
        "reset",
        hangs=True,
    ),
    "hangs-in-act": Behaviour(
        _calls(lambda: time.sleep(3600)), *_both(_no_answer(_ACT, "hangs-in-act")), hangs=True
    ),
    "holds-the-lock": Behaviour(
        _calls(lambda: ctypes.PyDLL(None).sleep(3600)),
        *_both(_no_answer(_ACT, "holds-the-lock")),
        hangs=True,
    ),
    "freezes-later": Behaviour(
        _freezes_later,
        f"{_ITSELF} showed no sign of life, 2 times: {BLAMED}",
        _no_answer("act at 0.50 s", "freezes-later"),
        attempts=2,
        hangs=True,
    ),
    "hangs-afterwards": Behaviour(
        _calls(lambda: time.sleep(3600)),
        *_both(_no_answer("ended", "hangs-afterwards")),
        "ended",
        hangs=True,
    ),
    "dies-afterwards": Behaviour(
        _calls(lambda: os._exit(0)),
        f"{_ITSELF} ended with exit code 0 in the policy's ended",
        DONE,
        "ended",
    ),
    "grows-slower": Behaviour(_slower, DONE, DONE, "every act"),
}
"""The behaviours by name, with `honest`, which does nothing."""

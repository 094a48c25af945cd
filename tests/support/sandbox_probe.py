"""A policy that tries to leave its sandbox, and prints the result of each attempt. The test copies
this file to a separate folder, beside `neighbour.py`, `beside.txt` and `targets.json`, which names
the targets."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import resource
import signal
import socket
import stat
import struct
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from neighbour import WORDS  # type: ignore[import-not-found]

from cosim.core.state import Command
from cosim.spec.manifest import Manifest
from scenarios.ipc import seccomp

HERE = Path(__file__).parent
MARK = "PROBED "
_LIBC = ctypes.CDLL(None, use_errno=True)
_COLUMN = seccomp.MACHINES[os.uname().machine][0]


class Probe:
    """Makes all attempts when it is reset."""

    manifest = Manifest("probe", rate_hz=4.0)

    def reset(self, episode_id: str, seed: int) -> None:
        given = json.loads((HERE / "targets.json").read_text())
        print(MARK + json.dumps({name: tried(does, given) for name, does in ATTEMPTS.items()}))

    def act(self, observation: object) -> Command:
        return Command(1.0, 0.0)


class Lost(Probe):
    """Reads a file that it is not permitted to read."""

    def __init__(self) -> None:
        Path(json.loads((HERE / "targets.json").read_text())["outside"]).read_text()


def tried(does: Callable[[dict[str, Any]], object], given: dict[str, Any]) -> object:
    """Return what an attempt returned, or the name of its error."""
    try:
        return does(given)
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, str(error))
    except MemoryError:
        return "MemoryError"


def called(name: str, *given: int) -> str:
    """Return "done", or the name of the error of a system call."""
    number = seccomp.NUMBERS[name][_COLUMN]
    if number is None:
        return "EPERM"
    made = _LIBC.syscall(*map(ctypes.c_long, (number, *given, *[0] * (6 - len(given)))))
    return "done" if made >= 0 else errno.errorcode[ctypes.get_errno()]


def reads(path: str) -> str:
    Path(path).read_bytes()
    return "done"


def _listed(folder: str) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir())


def _writes(path: str) -> str:
    with Path(path).open("a") as file:
        file.write("was here")
    return "done"


def _changes(path: Path) -> str:
    path.chmod(0o600)
    return "done"


def _connects(kind: int, to: Any, how: int = socket.SOCK_STREAM) -> str:
    with socket.socket(kind, how) as end:
        end.settimeout(2.0)
        end.connect(to)
        return "done"


def _sends_to(address: str) -> str:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        ours.sendto(b"here", address)
    return "done"


def _kills(process: int, number: int) -> str:
    os.kill(process, number)
    return "done"


def _vm_reads(process: int) -> str:
    remote = ctypes.create_string_buffer(struct.pack("PN", 0x400000, 8))
    return called("process_vm_readv", process, ctypes.addressof(remote), 1, 1, 1)


def _descriptors(_: object) -> list[str]:
    found = []
    for descriptor in range(1024):
        with suppress(OSError):
            kind = stat.S_IFMT(os.fstat(descriptor).st_mode)
            found.append({stat.S_IFSOCK: "socket", stat.S_IFREG: "memory"}.get(kind, "other"))
    return sorted(found)


def _forks(_: object) -> str:
    """Fork until it fails; the children end when this process closes its pipe."""
    waits, ends = os.pipe()
    children = []
    try:
        for _ in range(1000):
            child = os.fork()
            if child == 0:
                os.close(ends)
                os.read(waits, 1)
                os._exit(0)
            children.append(child)
        return "done"
    finally:
        os.close(ends)
        os.close(waits)
        for child in children:
            os.waitpid(child, 0)


def _opens(_: object) -> str:
    with ExitStack() as stack:
        for _ in range(2000):
            stack.enter_context(Path("/dev/null").open())
        return "done"


def _grows(_: object) -> str:
    with Path("big").open("wb") as file:
        file.truncate(2 << 30)
    return "done"


def _effective(_: object) -> int:
    head = ctypes.create_string_buffer(struct.pack("Ii", 0x20080522, 0))
    sets = ctypes.create_string_buffer(24)
    _LIBC.capget(head, sets)
    return int(struct.unpack("6I", sets.raw)[0])


def _watches(path: str) -> str:
    end = _LIBC.inotify_init()
    made = _LIBC.inotify_add_watch(end, path.encode(), 0xFFF)
    os.close(end)
    return "done" if made >= 0 else errno.errorcode[ctypes.get_errno()]


ATTEMPTS: dict[str, Callable[[dict[str, Any]], object]] = {
    "neighbour": lambda given: WORDS,
    "file beside": lambda given: (HERE / "beside.txt").read_text(),
    "policy data": lambda given: Path(given["data"]).read_text(),
    "working folder": lambda given: _listed("."),
    "write there": lambda given: _writes("mine.txt"),
    "run.json": lambda given: reads(given["run"] + "/run.json"),
    "run folder": lambda given: _listed(given["run"]),
    "watch run folder": lambda given: _watches(given["run"]),
    "suite": lambda given: reads(given["suite"]),
    "shadow": lambda given: reads("/etc/shadow"),
    "outside": lambda given: reads(given["outside"]),
    "parent's folder": lambda given: " ".join(_listed(given["cwd"])),
    "tests": lambda given: reads(given["tests"]),
    "write policy": lambda given: _writes(str(HERE / "beside.txt")),
    "write data": lambda given: _writes(given["data"]),
    "write outside": lambda given: _writes(given["outside"]),
    "write run": lambda given: _writes(given["run"] + "/forged.json"),
    "write /usr": lambda given: _writes("/usr/forged"),
    "chmod policy": lambda given: _changes(HERE / "beside.txt"),
    "chmod outside": lambda given: _changes(Path(given["outside"])),
    "truncate outside": lambda given: os.truncate(given["outside"], 0),
    "delete run": lambda given: str(Path(given["run"]).rename(given["run"] + "-away")),
    "environ": lambda given: reads(f"/proc/{given['victim']}/environ"),
    "cmdline": lambda given: reads(f"/proc/{given['victim']}/cmdline"),
    "mem": lambda given: reads(f"/proc/{given['victim']}/mem"),
    "parent cmdline": lambda given: reads(f"/proc/{given['parent']}/cmdline"),
    "parent's cwd": lambda given: _listed(f"/proc/{given['parent']}/cwd"),
    "first process": lambda given: reads("/proc/1/cmdline"),
    "processes": lambda given: len([one for one in _listed("/proc") if one.isdigit()]),
    "tcp": lambda given: _connects(socket.AF_INET, ("127.0.0.1", given["port"])),
    "tcp6": lambda given: _connects(socket.AF_INET6, ("::1", given["port"])),
    "udp": lambda given: _connects(socket.AF_INET, ("127.0.0.1", 7447), socket.SOCK_DGRAM),
    "netlink": lambda given: _connects(socket.AF_NETLINK, (0, 0), socket.SOCK_RAW),
    "abstract socket": lambda given: _connects(socket.AF_UNIX, "\0" + given["abstract"]),
    "unix socket": lambda given: _connects(socket.AF_UNIX, given["socket"]),
    "datagram": lambda given: _sends_to(given["datagram"]),
    "signal parent": lambda given: _kills(given["parent"], 0),
    "signal victim": lambda given: _kills(given["victim"], signal.SIGKILL),
    "signal first": lambda given: _kills(1, signal.SIGKILL),
    "stop itself": lambda given: _kills(os.getpid(), signal.SIGSTOP),
    "signal group": lambda given: _kills(-given["parent"], 0),
    "limit victim": lambda given: called("prlimit64", given["victim"], 7, 0, 0),
    "slow victim": lambda given: called("setpriority", 0, given["victim"], 19),
    "ptrace": lambda given: called("ptrace", 16, given["victim"]),
    "read memory": lambda given: _vm_reads(given["victim"]),
    "denied calls": lambda given: sorted(
        {called(one.name) for one in seccomp.EVERYWHERE if not one.test and one.name != "clone3"}
    ),
    "new user": lambda given: called("clone", 0x10000000 | signal.SIGCHLD),
    "clone3": lambda given: called("clone3"),
    "environment": lambda given: sorted(name for name in os.environ if name in given["secrets"]),
    "descriptors": _descriptors,
    "user": lambda given: os.getuid() == given["user"] != 0,
    "capabilities": lambda given: _effective(None) & ~(1 << 2),
    "new privileges": lambda given: _LIBC.prctl(39, 0, 0, 0, 0),
    "memory": lambda given: len(bytearray(3 * 10**9)),
    "files": _opens,
    "file size": _grows,
    "processes of one": _forks,
    "core": lambda given: resource.getrlimit(resource.RLIMIT_CORE)[1],
    "signal all": lambda given: _kills(-1, signal.SIGKILL),
}

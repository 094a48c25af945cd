"""Sandbox of a policy's process: namespaces, or Landlock, and in both a filter of system calls.

supervisor -> watcher (`start`) -> set-up -> Python with the policy
                                   in namespaces: -> first process -> Python with the policy

The watcher is outside: it reports a step of the set-up that fails, and ends as the policy ended.
Python starts inside, by exec, so that nothing of this process's memory comes with it.

It imports only the standard library: a supervisor starts fast.
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import select
import shutil
import socket
import stat
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

from scenarios.ipc import seccomp

KINDS: Final = ("namespaces", "landlock")
"""Kinds of sandboxes, the stronger first."""
PROCESSES: Final = 512
"""Limit of a sandbox's processes and threads."""
_LIMITS: Final = {
    resource.RLIMIT_NOFILE: 1024,
    resource.RLIMIT_FSIZE: 1 << 30,
    resource.RLIMIT_CORE: 0,
    resource.RLIMIT_MEMLOCK: 64 << 20,
    resource.RLIMIT_MSGQUEUE: 1 << 20,
}
"""Further limits of each process: open files, bytes of a file, of a core dump, of locked memory and
of message queues."""
_MOST_FILES: Final = 1 << 20
"""Number above all descriptors."""
_SCRATCH: Final = "size=1g"
"""Size of each of the folders in memory that may be written."""
_USERS: Final = range(61184, 65520)
"""User ids for sandboxes that root starts, which no account has (systemd's dynamic users)."""
_PASSED: Final = ("LANG", "LANGUAGE", "TZ", "PATH", "LD_LIBRARY_PATH", "PYTHONHASHSEED")
_PASSED_BEGINNINGS: Final = (
    *("LC_", "OMP_", "MKL_", "OPENBLAS_", "NPY_", "GOTO_", "BLIS_", "KMP_", "GLIBC_TUNABLES"),
    *("CUDA_", "CUBLAS_", "CUDNN_", "NVIDIA_"),
)
"""Environment variables that a policy gets, by name and by the beginning of the name."""
_DEVICES: Final = ("null", "zero", "full", "random", "urandom")
_OF_GPU: Final = ("nvidia", "dri")
"""Beginnings of the names of a GPU's devices."""
_BELOW_GPU: Final = ("/sys/bus/pci", "/sys/devices/pci*", "/sys/module/nvidia*")
_OF_SYSTEM: Final = ("/sys/devices/system/cpu", "/sys/devices/system/node")
_PROC: Final = ("/proc/cpuinfo", "/proc/meminfo", "/proc/devices", "/proc/driver/nvidia")
"""What may be read of /proc under Landlock, where no process may have a private one."""


class Sandbox(NamedTuple):
    """A sandbox, in plain values.

    kind: of `KINDS`.
    reads: paths that may be read, each with paths below it that may not.
    imports: folders from which Python imports.
    memory_bytes: limit of each process's memory.
    """

    kind: str
    reads: tuple[tuple[str, tuple[str, ...]], ...]
    imports: tuple[str, ...]
    memory_bytes: int


class SandboxError(Exception):
    """A step of the set-up that failed, with its reason."""


def has_gpu() -> bool:
    """Return whether this machine has an NVIDIA GPU's device."""
    return Path("/dev/nvidiactl").exists()


# --- system calls

_LIBC: Final = ctypes.CDLL(None, use_errno=True)
_NEW_USER, _NEW_MOUNTS, _NEW_IPC, _NEW_PIDS, _NEW_NET = (
    *(0x10000000, 0x00020000, 0x08000000),
    *(0x20000000, 0x40000000),
)
_PRIVATE, _RECURSIVE, _DETACH = 1 << 18, 1 << 14, 2
_NO_SETUID, _NO_DEVICES, _NO_EXEC = 2, 4, 8
"""Flags of `mount`, and of `mount_setattr`."""
_READ_ONLY: Final = 1
_HERE, _EMPTY_PATH, _ALL_BELOW, _CLONE, _CLOSE_ON_EXEC = -100, 0x1000, 0x8000, 1, 0o2000000
_DEATH_SIGNAL, _DUMPABLE, _KEEP_CAPABILITIES, _DROP_BOUND, _NO_PRIVILEGES, _AMBIENT = (
    *(1, 4, 8),
    *(24, 38, 47),
)
"""Operations of `prctl`."""
_READ_ANY: Final = 2
"""The capability to read files of any user."""


def _call(step: str, name: str, *given: Any) -> int:
    """Make a system call. Raises SandboxError that names the step."""
    numbers = seccomp.NUMBERS[name]
    number = numbers[seccomp.MACHINES[platform.machine()][0]]
    sent = [ctypes.c_long(one) if isinstance(one, int) else one for one in given]
    made: int = _LIBC.syscall(ctypes.c_long(number or -1), *sent)
    if made < 0:
        raise SandboxError(f"{step}: {os.strerror(ctypes.get_errno())}")
    return made


def _prctl(step: str, *given: int) -> None:
    if _LIBC.prctl(*map(ctypes.c_ulong, (*given, *[0] * (5 - len(given))))) != 0:
        raise SandboxError(f"{step}: {os.strerror(ctypes.get_errno())}")


def _mount(kind: str, at: str, flags: int, options: str = "") -> None:
    step = f"mount {kind} at {at}"
    _call(step, "mount", kind.encode(), at.encode(), kind.encode(), flags, options.encode())


# --- outside


def work_folder(sandbox: Sandbox) -> str:
    """Create the folder of a sandbox outside of it, if its kind needs one; else return ""."""
    return tempfile.mkdtemp(prefix="cosim-policy-") if sandbox.kind == "landlock" else ""


def remove_work_folder(folder: str) -> None:
    """Remove what `work_folder` created."""
    if folder:
        shutil.rmtree(folder, ignore_errors=True)


def start(
    sandbox: Sandbox,
    serves: str,
    descriptors: tuple[int, ...],
    folder: str,
    refuse: Callable[[socket.socket, str], None],
) -> int:
    """Run Python with the policy in a sandbox, in this forked child of the supervisor.

    Returns the wait status of the policy's process.

    serves: function that it runs, as module:name.
    descriptors: its arguments, first the socket, all that it inherits but its output.
    folder: of `work_folder`.
    refuse: reports on a socket that the sandbox cannot be set up, and why.
    """
    heard, status = os.pipe()
    waits, goes = os.pipe()
    child = os.fork()
    if child == 0:
        for descriptor in (heard, goes):
            os.close(descriptor)
        _set_up(sandbox, _Inside(serves, descriptors, folder, status), waits)
    for descriptor in (status, waits, *descriptors[1:]):
        os.close(descriptor)
    ended = _watched(child, heard, goes, descriptors[0], refuse)
    code = os.waitpid(child, 0)[1]
    return code if ended is None else ended


def _watched(
    child: int, heard: int, goes: int, connection: int, refuse: Callable[[socket.socket, str], None]
) -> int | None:
    """Follow the set-up and then the policy, until its pipe is closed. Returns the wait status that
    was reported."""
    ended = None
    with open(heard, "rb") as said, socket.socket(fileno=connection) as ours:
        for line in said:
            word, _, rest = line.decode(errors="replace").strip().partition(" ")
            if word == "maps":
                with suppress(OSError):  # without maps, the set-up fails
                    _write_maps(child)
                    os.write(goes, b"!")
                os.close(goes)
            elif word == "failed":
                refuse(ours, rest)
            elif word == "started":  # only the policy's process may hold the connection
                ours.close()
            elif word == "ended":
                ended = int(rest)
    return ended


def _write_maps(child: int) -> None:
    """Give the user namespace of a process the ids of this process's: all of root's, else one."""
    if os.geteuid() != 0:
        Path(f"/proc/{child}/setgroups").write_text("deny")
    for kind, own in (("uid", os.geteuid()), ("gid", os.getegid())):
        lines = [f"{own} {own} 1"]
        if os.geteuid() == 0:
            table = Path(f"/proc/self/{kind}_map").read_text().splitlines()
            lines = ["{0} {0} {2}".format(*line.split()) for line in table]
        Path(f"/proc/{child}/{kind}_map").write_text("\n".join(lines))


# --- inside


class _Inside(NamedTuple):
    """What the set-up needs beside the sandbox.

    status: pipe to the watcher.
    begun: pipe that closes when Python starts, -1 for none.
    """

    serves: str
    descriptors: tuple[int, ...]
    folder: str
    status: int
    begun: int = -1

    def say(self, words: str) -> None:
        os.write(self.status, f"{words}\n".encode())


def _set_up(sandbox: Sandbox, inside: _Inside, waits: int) -> NoReturn:
    """Set the sandbox up, and end or become the policy."""
    try:
        os.setsid()
        if platform.machine() not in seccomp.MACHINES:
            raise SandboxError(f"no table of system calls for {platform.machine()}")
        if sandbox.kind == "namespaces":
            _enter_namespaces(sandbox, inside, waits)
        else:
            _enter_landlock(sandbox, inside)
    except BaseException as error:  # noqa: BLE001  the process must end here
        words = str(error) or type(error).__name__
        with suppress(OSError):
            inside.say("failed " + " ".join(words.split()))
    finally:
        os._exit(1)


def _end_with_parent(inside: _Inside) -> None:
    """Let this process be killed when its parent dies. The parent's end of the pipe is checked."""
    _prctl("set the signal of the parent's death", _DEATH_SIGNAL, 9)
    poll = select.poll()
    poll.register(inside.status, 0)
    if poll.poll(0):
        os._exit(1)


def _enter_namespaces(sandbox: Sandbox, inside: _Inside, waits: int) -> None:
    """Create the namespaces, and fork their first process."""
    user = _user()
    flags = _NEW_USER | _NEW_MOUNTS | _NEW_IPC | _NEW_PIDS | _NEW_NET
    _call("create user, mount, PID, IPC and network namespaces", "unshare", flags)
    _end_with_parent(inside)
    inside.say("maps")
    if not os.read(waits, 1):
        raise SandboxError("map the user into the namespace: not permitted")
    first = os.fork()
    if first:
        _close_all_but({0, 1, 2})
        os.waitpid(first, 0)
        return
    _end_with_parent(inside)
    _build_root(sandbox, user)
    _drop_privileges(user, reads_any=user is not None)
    _end_with_parent(inside)
    rules = [*seccomp.EVERYWHERE, *seccomp.IN_NAMESPACES]
    _filter_calls(rules)
    # The policy may not see or trace the first process, which has this program's memory.
    _prctl("forbid to be traced", _DUMPABLE, 0)
    waits, begun = os.pipe()
    policy = os.fork()
    if policy == 0:
        os.setsid()
        _limit(sandbox, PROCESSES)
        _exec(sandbox, sandbox.imports, inside._replace(begun=begun), "/tmp/policy")
    os.close(begun)
    os.read(waits, 1)
    inside.say("started")
    _close_all_but({inside.status})
    while True:
        ended, code = os.wait()
        if ended == policy:
            inside.say(f"ended {code}")
            os._exit(0)


def _build_root(sandbox: Sandbox, user: int | None) -> None:
    """Replace the root folder by one in memory that has only what may be read."""
    _call("make mounts private", "mount", b"none", b"/", None, _RECURSIVE | _PRIVATE, None)
    held = [(path, _opened_tree(path)) for path in _devices()]
    root = "/dev"  # where all sources but the devices can be reached while the root is built
    _mount("tmpfs", root, _NO_SETUID | _NO_DEVICES, "mode=755,size=16m")
    for folder, options in (("/tmp", "mode=1777"), ("/dev/shm", "mode=1777"), ("/proc", "")):
        os.makedirs(root + folder)
        if options:
            _mount("tmpfs", root + folder, _NO_SETUID | _NO_DEVICES, f"{options},{_SCRATCH}")
    # Without a private /proc, which container runtimes may forbid, there is none.
    with suppress(SandboxError):
        flags = _READ_ONLY | _NO_SETUID | _NO_DEVICES | _NO_EXEC
        _mount("proc", f"{root}/proc", flags, "hidepid=2")
    leaves, links = _visible(sandbox)
    for path in leaves:
        _attach(_opened_tree(path), path, root)
    for path, tree in held:
        _attach(tree, path, root, device=True)
    for path, target in links.items():
        os.makedirs(os.path.dirname(root + path), exist_ok=True)
        os.symlink(target, root + path)
    os.mkdir(f"{root}/tmp/policy", 0o700)
    if user is not None:
        os.chown(f"{root}/tmp/policy", user, user)
    os.chdir(root)
    _call("change the root folder", "pivot_root", b".", b".")
    _call("unmount the former root folder", "umount2", b".", _DETACH)
    os.chdir("/")
    _restrict_mount(_HERE, "/", _READ_ONLY, 0)


def _opened_tree(path: str) -> int:
    """Return a copy of the mounts at a path, which are attached elsewhere."""
    flags = _CLONE | _CLOSE_ON_EXEC | _ALL_BELOW
    return _call(f"copy the mount of {path}", "open_tree", _HERE, path.encode(), flags)


def _attach(tree: int, path: str, root: str, *, device: bool = False) -> None:
    """Show what is at a path at the same path below another root, read-only."""
    at = root + path
    os.makedirs(os.path.dirname(at), exist_ok=True)
    if stat.S_ISDIR(os.fstat(tree).st_mode):
        os.makedirs(at, exist_ok=True)
    else:
        os.close(os.open(at, os.O_CREAT | os.O_WRONLY, 0o600))
    flags = _NO_SETUID | (0 if device else _READ_ONLY | _NO_DEVICES)
    _restrict_mount(tree, "", flags, _EMPTY_PATH | _ALL_BELOW)
    moved = (tree, b"", _HERE, at.encode(), 4)
    _call(f"show {path}", "move_mount", *moved)
    os.close(tree)


def _restrict_mount(folder: int, path: str, attributes: int, flags: int) -> None:
    given = ctypes.create_string_buffer(struct.pack("QQQQ", attributes, 0, 0, 0))
    step = f"restrict the mount {path}"
    _call(step, "mount_setattr", folder, path.encode(), flags, given, 32)


def _enter_landlock(sandbox: Sandbox, inside: _Inside) -> None:
    """Restrict this process, and become the policy."""
    user = _user()
    version = _landlock_version()
    work = f"{inside.folder}/work"
    os.mkdir(work, 0o700)
    leaves, _ = _visible(sandbox)
    imports = _linked_imports(sandbox, leaves, f"{inside.folder}/imports")
    os.chmod(inside.folder, 0o755)
    if user is not None:
        os.chown(work, user, user)
    rules = _landlock_rules(
        [*leaves, *_PROC, f"{inside.folder}/imports"], [*_devices(), work], version
    )
    threads = 0 if user is not None else _threads_of_user()
    _drop_privileges(user, reads_any=user is not None)
    _end_with_parent(inside)
    _limit(sandbox, PROCESSES + threads)
    _call("restrict files (Landlock)", "landlock_restrict_self", rules, 0)
    os.close(rules)
    calls = [*seccomp.EVERYWHERE, *seccomp.UNDER_LANDLOCK]
    _filter_calls(calls + (seccomp.without_signals(os.getpid()) if version < 6 else []))
    _exec(sandbox, imports, inside, work)


_EXECUTE, _WRITE, _READ, _LIST, _TRUNCATE, _DEVICE_CALLS = 1, 2, 4, 8, 1 << 14, 1 << 15
"""Rights of Landlock."""
_LEAST_LANDLOCK: Final = 3
"""Oldest version of Landlock that is used; older ones let files be emptied."""


def _landlock_version() -> int:
    version = _call("find Landlock", "landlock_create_ruleset", None, 0, 1)
    if version < _LEAST_LANDLOCK:
        raise SandboxError(f"Landlock has version {version} here, and {_LEAST_LANDLOCK} is needed")
    return version


def _landlock_rules(reads: list[str], writes: list[str], version: int) -> int:
    """Return a set of rules that denies all else: files, TCP, and from version 6 on signals and
    abstract sockets."""
    every = (1 << (16 if version >= 5 else 15)) - 1
    handled = [every, 3 if version >= 4 else 0, 3 if version >= 6 else 0]
    given = struct.pack("QQQ", *handled)[: 24 if version >= 6 else 16 if version >= 4 else 8]
    rules = _call("make Landlock's rules", "landlock_create_ruleset", given, len(given), 0)
    of_file = (_EXECUTE | _WRITE | _READ | _TRUNCATE | _DEVICE_CALLS) & every
    for path, rights in (
        *((path, _EXECUTE | _READ | _LIST) for path in reads),
        *((path, every) for path in writes),
    ):
        try:
            opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
        except OSError:  # a link without a target
            continue
        if not stat.S_ISDIR(os.fstat(opened).st_mode):
            rights &= of_file
        rule = struct.pack("=Qi", rights, opened)
        _call(f"allow {path} (Landlock)", "landlock_add_rule", rules, 1, rule, 0)
        os.close(opened)
    return rules


def _linked_imports(sandbox: Sandbox, leaves: list[str], folder: str) -> tuple[str, ...]:
    """Replace import folders that may not be read as a whole by folders of links."""
    found = []
    os.mkdir(folder)
    shown = set(leaves)
    for number, entry in enumerate(sandbox.imports):
        real = os.path.realpath(entry)
        if not _below(real, shown):
            farm = os.path.join(folder, str(number))
            for leaf in leaves:
                if leaf.startswith(f"{real.rstrip('/')}/"):
                    link = os.path.join(farm, os.path.relpath(leaf, real))
                    os.makedirs(os.path.dirname(link), exist_ok=True)
                    os.symlink(leaf, link)
            entry = farm
        found.append(entry)
    return tuple(found)


def _threads_of_user() -> int:
    """Return how many threads this user has, which the kernel counts with those of the policy."""
    count = 0
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if process.stat().st_uid == os.geteuid():
                count += len(os.listdir(process / "task"))  # noqa: PTH208  faster
    return count


# --- both kinds


def _visible(sandbox: Sandbox) -> tuple[list[str], dict[str, str]]:
    """Return the paths that may be read with all below them, and the links on the way to them."""
    leaves: set[str] = set()
    links: dict[str, str] = {}
    gpu = _globbed(_BELOW_GPU) if has_gpu() else []
    for path, without in (*sandbox.reads, *((one, ()) for one in (*_OF_SYSTEM, *gpu))):
        if not os.path.exists(path):
            continue
        links |= _links_to(path)
        for leaf in _leaves(os.path.realpath(path), without):
            if os.path.islink(leaf):
                links[leaf] = os.readlink(leaf)
            leaves.add(leaf)
    leaves -= links.keys()
    outer = sorted(one for one in leaves if not _below(os.path.dirname(one), leaves))
    shown = set(outer)
    return outer, {at: to for at, to in links.items() if not _below(at, shown)}


def _below(path: str, among: set[str]) -> bool:
    """Return whether a path or a folder above it is among some."""
    while path not in among:
        path, above = os.path.dirname(path), path
        if path == above:
            return False
    return True


def _leaves(path: str, without: tuple[str, ...]) -> Iterator[str]:
    """Yield a path, or where something below it may not be read, what is left of it."""
    if _below(path, set(without)):
        return
    if not any(one.startswith(f"{path.rstrip('/')}/") for one in without):
        yield path
        return
    for child in sorted(entry.path for entry in os.scandir(path)):
        if os.path.islink(child):
            yield child
        else:
            yield from _leaves(child, without)


def _links_to(path: str) -> dict[str, str]:
    """Return the symbolic links on the way to a path, with their targets."""
    found: dict[str, str] = {}
    at = "/"
    for part in Path(path).parts[1:]:
        step = os.path.join(at, part)
        if os.path.islink(step):
            found[step] = os.readlink(step)
            found |= _links_to(os.path.normpath(os.path.join(at, found[step])))
            step = os.path.realpath(step)
        at = step
    return found


def _devices() -> list[str]:
    """Return the devices that a policy may use."""
    names = [*_DEVICES]
    if has_gpu():
        names += [name for name in os.listdir("/dev") if name.startswith(_OF_GPU)]
    return [f"/dev/{name}" for name in names if os.path.exists(f"/dev/{name}")]


def _globbed(patterns: tuple[str, ...]) -> list[str]:
    return [str(path) for one in patterns for path in Path("/").glob(one.removeprefix("/"))]


def _user() -> int | None:
    """Return the user id of a sandbox that root starts; None for other users, who keep theirs."""
    return _USERS[os.getpid() % len(_USERS)] if os.geteuid() == 0 else None


def _drop_privileges(user: int | None, *, reads_any: bool) -> None:
    """Give up all rights of this process, for good. Root becomes a user without an account, who may
    read files of any user where the sandbox shows them, if root may."""
    kept = 0
    if user is not None:
        kept = (1 << _READ_ANY) & _permitted() if reads_any else 0
    for capability in range(64):
        if not kept >> capability & 1:
            with suppress(SandboxError):  # of an older kernel, or not root's
                _prctl("drop capabilities", _DROP_BOUND, capability)
    if user is not None:
        _prctl("keep a capability", _KEEP_CAPABILITIES, 1)
        os.setgroups([])
        os.setresgid(user, user, user)
        os.setresuid(user, user, user)
    head = ctypes.create_string_buffer(struct.pack("Ii", 0x20080522, 0))
    sets = ctypes.create_string_buffer(struct.pack("6I", kept, kept, kept, 0, 0, 0))
    if _LIBC.capset(head, sets) != 0:
        raise SandboxError(f"drop capabilities: {os.strerror(ctypes.get_errno())}")
    if kept:
        _prctl("keep a capability", _AMBIENT, 2, _READ_ANY)
    _prctl("forbid new privileges", _NO_PRIVILEGES, 1)


def _permitted() -> int:
    """Return the lower 32 permitted capabilities of this process, as bits."""
    head = ctypes.create_string_buffer(struct.pack("Ii", 0x20080522, 0))
    sets = ctypes.create_string_buffer(24)
    return int(struct.unpack("6I", sets.raw)[1]) if _LIBC.capget(head, sets) == 0 else 0


def _filter_calls(rules: list[seccomp.Rule]) -> None:
    try:
        seccomp.installed(rules, platform.machine())
    except OSError as error:
        raise SandboxError(f"filter system calls (seccomp): {error.strerror}") from None


def _limit(sandbox: Sandbox, processes: int) -> None:
    """Limit this process and all that it starts. A GPU's driver reserves addresses without memory,
    so that there only the memory that is written counts."""
    memory = resource.RLIMIT_DATA if has_gpu() else resource.RLIMIT_AS
    for what, most in {
        **_LIMITS,
        memory: sandbox.memory_bytes,
        resource.RLIMIT_NPROC: processes,
    }.items():
        _, hard = resource.getrlimit(what)
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (least, least))


def _close_all_but(kept: set[int]) -> None:
    last = -1
    for descriptor in sorted(kept):
        if descriptor > last + 1:  # closerange takes an empty range for an endless one
            os.closerange(last + 1, descriptor)
        last = descriptor
    os.closerange(last + 1, _MOST_FILES)


def _environment(work: str) -> dict[str, str]:
    passed = {
        name: value
        for name, value in os.environ.items()
        if name in _PASSED or name.startswith(_PASSED_BEGINNINGS)
    }
    own = dict.fromkeys(("HOME", "TMPDIR", "PWD"), work) | dict.fromkeys(
        ("USER", "LOGNAME"), "policy"
    )
    return passed | own | {"PYTHONDONTWRITEBYTECODE": "1"}


def _exec(sandbox: Sandbox, imports: tuple[str, ...], inside: _Inside, work: str) -> NoReturn:
    """Become Python with the policy, with no descriptors but its output and its connection."""
    module, _, function = inside.serves.partition(":")
    given = inside.descriptors
    code = (
        f"import sys; sys.path[:] = {[work, *imports]!r}; from {module} import {function}; "
        f"{function}{given!r}"
    )
    kept = {0, 1, 2, *given}
    _close_all_but({*kept, inside.status, inside.begun} - {-1})
    for descriptor in kept:
        os.set_inheritable(descriptor, True)
    os.chdir(work)
    python = sys.executable
    try:
        os.execve(python, [python, "-P", "-c", code], _environment(work))
    except OSError as error:
        raise SandboxError(f"start {python}: {error.strerror}") from None

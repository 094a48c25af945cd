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
import signal
import socket
import stat
import struct
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple, NoReturn

from scenarios.ipc import seccomp
from scenarios.ipc.kernel_calls import (
    DEATH_SIGNAL,
    DUMPABLE,
    SandboxError,
    call,
    drop_privileges,
    filter_calls,
    prctl,
)
from scenarios.ipc.sandbox_files import devices, has_gpu, linked_imports, visible

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
_MAX_FILES: Final = 1 << 20
"""Number above all descriptors."""
_SCRATCH: Final = "size=1g"
"""Size of each of the folders in memory that may be written."""
_WORK: Final = Path("/tmp/policy")
"""Working folder in namespaces."""
_USERS: Final = range(61184, 65520)
"""User ids for sandboxes that root starts, which no account has (systemd's dynamic users)."""
_PROC: Final = [Path("/proc", one) for one in ("cpuinfo", "meminfo")]
"""What may be read of /proc under Landlock, where no process may have a private one."""


class Sandbox(NamedTuple):
    """A sandbox, in plain values.

    kind: of `KINDS`.
    reads: paths that may be read, each with paths below it that may not.
    imports: folders from which Python imports.
    environment: names and values of environment variables.
    memory_bytes: limit of each process's memory.
    """

    kind: str
    reads: tuple[tuple[str, tuple[str, ...]], ...]
    imports: tuple[str, ...]
    environment: tuple[tuple[str, str], ...]
    memory_bytes: int


_NEW_USER, _NEW_MOUNTS, _NEW_IPC, _NEW_PIDS, _NEW_NET = (
    *(0x10000000, 0x00020000, 0x08000000),
    *(0x20000000, 0x40000000),
)
_PRIVATE, _RECURSIVE, _DETACH = 1 << 18, 1 << 14, 2
_NO_SETUID, _NO_DEVICES, _NO_EXEC = 2, 4, 8
"""Flags of `mount`, and of `mount_setattr`."""
_READ_ONLY: Final = 1
_HERE, _EMPTY_PATH, _ALL_BELOW, _CLONE, _CLOSE_ON_EXEC = -100, 0x1000, 0x8000, 1, 0o2000000
_FROM_DESCRIPTOR: Final = 4
"""Flags of calls about copied mounts."""


def _mount(kind: str, at: Path, flags: int, options: str = "") -> None:
    step = f"mount {kind} at {at}"
    call(step, "mount", kind.encode(), os.fsencode(at), kind.encode(), flags, options.encode())


# --- outside of the sandbox


def work_folder(sandbox: Sandbox) -> str:
    """Create the folder of a sandbox outside of it, if its kind needs one; else return ""."""
    return tempfile.mkdtemp(prefix="cosim-policy-") if sandbox.kind == "landlock" else ""


def remove_work_folder(folder: str) -> None:
    """Remove what `work_folder` created."""
    if folder:
        shutil.rmtree(folder, ignore_errors=True)


def start(
    sandbox: Sandbox,
    entry_point: str,
    descriptors: tuple[int, ...],
    folder: str,
    refuse: Callable[[socket.socket, str], None],
) -> int:
    """Run Python with the policy in a sandbox, in this forked child of the supervisor.

    Returns the wait status of the policy's process.

    entry_point: function that it runs, as module:name.
    descriptors: its arguments, first the socket, all that it inherits but its output.
    folder: of `work_folder`.
    refuse: reports on a socket that the sandbox cannot be set up, and why.
    """
    status_reader, status_writer = os.pipe()
    go_reader, go_writer = os.pipe()
    child = os.fork()
    if child == 0:
        for descriptor in (status_reader, go_writer):
            os.close(descriptor)
        _set_up(sandbox, _Inside(entry_point, descriptors, folder, status_writer), go_reader)
    for descriptor in (status_writer, go_reader, *descriptors[1:]):
        os.close(descriptor)
    ended = _watched(child, status_reader, go_writer, descriptors[0], refuse)
    code = _status_of(child)
    return code if ended is None else ended


def _status_of(child: int) -> int:
    """Wait for a child, and reap others; return its wait status. Stopped ones are continued."""
    while True:
        ended, code = os.waitpid(-1, os.WUNTRACED)
        if os.WIFSTOPPED(code):
            with suppress(ProcessLookupError):
                os.kill(ended, signal.SIGCONT)
        elif ended == child:
            return code


def _watched(
    child: int,
    status_reader: int,
    go_writer: int,
    connection: int,
    refuse: Callable[[socket.socket, str], None],
) -> int | None:
    """Follow the set-up and then the policy, until its pipe is closed.

    Returns the reported wait status; None if none was reported.
    """
    ended = None
    with open(status_reader, "rb") as lines, socket.socket(fileno=connection) as ours:
        for line in lines:
            word, _, rest = line.decode(errors="replace").strip().partition(" ")
            if word == "maps":
                with suppress(OSError):  # without maps, the set-up fails
                    _write_maps(child)
                    os.write(go_writer, b"!")
                os.close(go_writer)
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


# --- inside of the sandbox


class _Inside(NamedTuple):
    """Needs of the set-up in addition to the sandbox.

    status: pipe to the watcher.
    begun: pipe that closes when Python starts, -1 for none.
    """

    entry_point: str
    descriptors: tuple[int, ...]
    folder: str
    status: int
    begun: int = -1

    def say(self, words: str) -> None:
        os.write(self.status, f"{words}\n".encode())


def _set_up(sandbox: Sandbox, inside: _Inside, go_reader: int) -> NoReturn:
    """Set the sandbox up, and end or become the policy."""
    try:
        os.setsid()
        if platform.machine() not in seccomp.MACHINES:
            raise SandboxError(f"no table of system calls for {platform.machine()}")
        if sandbox.kind == "namespaces":
            _enter_namespaces(sandbox, inside, go_reader)
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
    prctl("set the signal of the parent's death", DEATH_SIGNAL, signal.SIGKILL)
    poll = select.poll()
    poll.register(inside.status, 0)
    if poll.poll(0):
        os._exit(1)


def _enter_namespaces(sandbox: Sandbox, inside: _Inside, go_reader: int) -> None:
    """Create the namespaces, and fork their first process."""
    user = _user()
    flags = _NEW_USER | _NEW_MOUNTS | _NEW_IPC | _NEW_PIDS | _NEW_NET
    call("create user, mount, PID, IPC and network namespaces", "unshare", flags)
    _end_with_parent(inside)
    inside.say("maps")
    if not os.read(go_reader, 1):
        raise SandboxError("map the user into the namespace: not permitted")
    first = os.fork()
    if first:
        _close_all_but({0, 1, 2})
        os.waitpid(first, 0)
        return
    _end_with_parent(inside)
    _build_root(sandbox, user)
    drop_privileges(user)
    _end_with_parent(inside)
    rules = [*seccomp.EVERYWHERE, *seccomp.IN_NAMESPACES]
    filter_calls(rules)
    # The policy may not see or trace the first process, which has this program's memory.
    prctl("forbid to be traced", DUMPABLE, 0)
    exec_reader, begun = os.pipe()
    policy = os.fork()
    if policy == 0:
        os.setsid()
        _limit(sandbox, PROCESSES)
        _exec(sandbox, sandbox.imports, inside._replace(begun=begun), _WORK)
    os.close(begun)
    os.read(exec_reader, 1)
    inside.say("started")
    _close_all_but({inside.status})
    inside.say(f"ended {_status_of(policy)}")
    os._exit(0)


def _build_root(sandbox: Sandbox, user: int | None) -> None:
    """Replace the root folder by one in memory that has only what may be read."""
    call("make mounts private", "mount", b"none", b"/", None, _RECURSIVE | _PRIVATE, None)
    device_trees = [(path, _opened_tree(path)) for path in devices(gpu=True)]
    root = Path("/dev")  # where all sources but the devices can be reached meanwhile
    _mount("tmpfs", root, _NO_SETUID | _NO_DEVICES, "mode=755,size=16m")
    for folder in ("tmp", "dev/shm", "proc"):
        (root / folder).mkdir(parents=True)
    for folder in ("tmp", "dev/shm"):
        _mount("tmpfs", root / folder, _NO_SETUID | _NO_DEVICES, f"mode=1777,{_SCRATCH}")
    # Without a private /proc, which container runtimes may forbid, there is none.
    with suppress(SandboxError):
        flags = _READ_ONLY | _NO_SETUID | _NO_DEVICES | _NO_EXEC
        _mount("proc", root / "proc", flags, "hidepid=2")
    leaves, links = visible(sandbox.reads)
    for path in leaves:
        _attach(_opened_tree(path), path, root)
    for path, tree in device_trees:
        _attach(tree, path, root, device=True)
    for path, target in links.items():
        _below(path, root).parent.mkdir(parents=True, exist_ok=True)
        _below(path, root).symlink_to(target)
    work = _below(_WORK, root)
    work.mkdir(0o700)
    if user is not None:
        os.chown(work, user, user)
    os.chdir(root)
    call("change the root folder", "pivot_root", b".", b".")
    call("unmount the former root folder", "umount2", b".", _DETACH)
    os.chdir("/")
    _restrict_mount(_HERE, "/", _READ_ONLY, 0)


def _below(path: Path, root: Path) -> Path:
    """Return a path below another root."""
    return root / path.relative_to("/")


def _opened_tree(path: Path) -> int:
    """Return a copy of the mounts at a path, which are attached elsewhere."""
    flags = _CLONE | _CLOSE_ON_EXEC | _ALL_BELOW
    return call(f"copy the mount of {path}", "open_tree", _HERE, os.fsencode(path), flags)


def _attach(tree: int, path: Path, root: Path, *, device: bool = False) -> None:
    """Show what is at a path at the same path below another root, read-only."""
    at = _below(path, root)
    at.parent.mkdir(parents=True, exist_ok=True)
    if stat.S_ISDIR(os.fstat(tree).st_mode):
        at.mkdir(exist_ok=True)
    else:
        at.touch()
    flags = _NO_SETUID | (0 if device else _READ_ONLY | _NO_DEVICES)
    _restrict_mount(tree, "", flags, _EMPTY_PATH | _ALL_BELOW)
    call(f"show {path}", "move_mount", tree, b"", _HERE, os.fsencode(at), _FROM_DESCRIPTOR)
    os.close(tree)


def _restrict_mount(folder: int, path: str, attributes: int, flags: int) -> None:
    values = ctypes.create_string_buffer(struct.pack("QQQQ", attributes, 0, 0, 0))
    step = f"restrict the mount {path}"
    call(step, "mount_setattr", folder, path.encode(), flags, values, 32)


def _enter_landlock(sandbox: Sandbox, inside: _Inside) -> None:
    """Restrict this process, and become the policy."""
    user = _user()
    version = _landlock_version()
    folder = Path(inside.folder)
    work, links = folder / "work", folder / "imports"
    work.mkdir(0o700)
    links.mkdir()
    leaves, _ = visible(sandbox.reads)
    imports = linked_imports(sandbox.imports, leaves, links)
    folder.chmod(0o755)
    if user is not None:
        os.chown(work, user, user)
    # CUDA does not start under Landlock.
    rules = _landlock_rules([*leaves, *_PROC, links], [*devices(gpu=False), work], version)
    threads = 0 if user is not None else _threads_of_user()
    drop_privileges(user)
    _end_with_parent(inside)
    _limit(sandbox, PROCESSES + threads)
    call("restrict files (Landlock)", "landlock_restrict_self", rules, 0)
    os.close(rules)
    calls = [*seccomp.EVERYWHERE, *seccomp.UNDER_LANDLOCK]
    filter_calls(calls + (seccomp.without_signals(os.getpid()) if version < 6 else []))
    _exec(sandbox, imports, inside, work)


_EXECUTE, _WRITE, _READ, _LIST, _TRUNCATE, _DEVICE_CALLS = 1, 2, 4, 8, 1 << 14, 1 << 15
"""Rights of Landlock."""
_MIN_LANDLOCK: Final = 3
"""Oldest version of Landlock that is used; older ones let files be emptied."""


def _landlock_version() -> int:
    version = call("find Landlock", "landlock_create_ruleset", None, 0, 1)
    if version < _MIN_LANDLOCK:
        raise SandboxError(f"Landlock has version {version} here, and {_MIN_LANDLOCK} is needed")
    return version


def _landlock_rules(reads: list[Path], writes: list[Path], version: int) -> int:
    """Return a set of rules that denies all else: files, TCP, and from version 6 on signals and
    abstract sockets."""
    every = (1 << (16 if version >= 5 else 15)) - 1
    handled = [every, 3 if version >= 4 else 0, 3 if version >= 6 else 0]
    attributes = struct.pack("QQQ", *handled)[: 24 if version >= 6 else 16 if version >= 4 else 8]
    rules = call("make Landlock's rules", "landlock_create_ruleset", attributes, len(attributes), 0)
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
        call(f"allow {path} (Landlock)", "landlock_add_rule", rules, 1, rule, 0)
        os.close(opened)
    return rules


def _threads_of_user() -> int:
    """Return how many threads this user has, which the kernel counts with those of the policy."""
    count = 0
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if process.stat().st_uid == os.geteuid():
                count += len(os.listdir(process / "task"))  # noqa: PTH208  faster
    return count


# --- for both kinds of sandboxes


def _user() -> int | None:
    """Return the user id of a sandbox that root starts; None for other users, who keep theirs."""
    return _USERS[os.getpid() % len(_USERS)] if os.geteuid() == 0 else None


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


def _close_all_but(exceptions: set[int]) -> None:
    last = -1
    for descriptor in sorted(exceptions):
        if descriptor > last + 1:  # closerange takes an empty range for an endless one
            os.closerange(last + 1, descriptor)
        last = descriptor
    os.closerange(last + 1, _MAX_FILES)


def _environment(sandbox: Sandbox, work: Path) -> dict[str, str]:
    own = dict.fromkeys(("HOME", "TMPDIR", "PWD"), str(work)) | dict.fromkeys(
        ("USER", "LOGNAME"), "policy"
    )
    return dict(sandbox.environment) | own | {"PYTHONDONTWRITEBYTECODE": "1"}


def _exec(sandbox: Sandbox, imports: tuple[str, ...], inside: _Inside, work: Path) -> NoReturn:
    """Become Python with the policy, with no descriptors but its output and its connection."""
    module, _, function = inside.entry_point.partition(":")
    arguments = inside.descriptors
    code = (
        f"import sys; sys.path[:] = {[str(work), *imports]!r}; from {module} import {function}; "
        f"{function}{arguments!r}"
    )
    inherited = {0, 1, 2, *arguments}
    _close_all_but({*inherited, inside.status, inside.begun} - {-1})
    for descriptor in inherited:
        os.set_inheritable(descriptor, True)
    os.chdir(work)
    python = sys.executable
    try:
        os.execve(python, [python, "-P", "-c", code], _environment(sandbox, work))
    except OSError as error:
        raise SandboxError(f"start {python}: {error.strerror}") from None

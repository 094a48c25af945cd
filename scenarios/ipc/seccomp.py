"""The system calls that a sandboxed policy may not make, as a filter for the kernel (seccomp).

Everything else is allowed: files are the subject of `scenarios.ipc.sandbox`. The numbers are those
of x86-64 and of 64-bit ARM; a filter ends a process that calls by another architecture's numbers.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
from collections.abc import Iterator
from typing import Final, Literal, NamedTuple

MACHINES: Final = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
"""Column of the numbers in `NUMBERS`, and the kernel's name of the architecture, by machine."""
NUMBERS: Final[dict[str, tuple[int | None, int | None]]] = {
    # mounts
    "mount": (165, 40),
    "umount2": (166, 39),
    "pivot_root": (155, 41),
    "chroot": (161, 51),
    "open_tree": (428, 428),
    "move_mount": (429, 429),
    "fsopen": (430, 430),
    "fsconfig": (431, 431),
    "fsmount": (432, 432),
    "fspick": (433, 433),
    "mount_setattr": (442, 442),
    "open_tree_attr": (467, 467),
    # namespaces and processes
    "unshare": (272, 97),
    "setns": (308, 268),
    "clone": (56, 220),
    "clone3": (435, 435),
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "process_madvise": (440, 440),
    "process_mrelease": (448, 448),
    "kcmp": (312, 272),
    "pidfd_getfd": (438, 438),
    # the kernel
    "bpf": (321, 280),
    "keyctl": (250, 219),
    "add_key": (248, 217),
    "request_key": (249, 218),
    "perf_event_open": (298, 241),
    "kexec_load": (246, 104),
    "kexec_file_load": (320, 294),
    "userfaultfd": (323, 282),
    "io_uring_setup": (425, 425),
    "io_uring_enter": (426, 426),
    "io_uring_register": (427, 427),
    "init_module": (175, 105),
    "finit_module": (313, 273),
    "delete_module": (176, 106),
    "open_by_handle_at": (304, 265),
    "name_to_handle_at": (303, 264),
    "fanotify_init": (300, 262),
    "lookup_dcookie": (212, 18),
    "syslog": (103, 116),
    # the machine
    "acct": (163, 89),
    "swapon": (167, 224),
    "swapoff": (168, 225),
    "reboot": (169, 142),
    "settimeofday": (164, 170),
    "clock_settime": (227, 112),
    "adjtimex": (159, 171),
    "clock_adjtime": (305, 266),
    "sethostname": (170, 161),
    "setdomainname": (171, 162),
    "quotactl": (179, 60),
    "quotactl_fd": (443, 443),
    "vhangup": (153, 58),
    "iopl": (172, None),
    "ioperm": (173, None),
    "ioctl": (16, 29),
    # sockets
    "socket": (41, 198),
    "socketpair": (53, 199),
    "connect": (42, 203),
    # settings of other processes
    "prlimit64": (302, 261),
    "sched_setaffinity": (203, 122),
    "sched_setscheduler": (144, 119),
    "sched_setparam": (142, 118),
    "sched_setattr": (314, 274),
    "setpriority": (141, 140),
    "ioprio_set": (251, 30),
    "migrate_pages": (256, 238),
    "move_pages": (279, 239),
    # memory and queues that all processes of a user share
    "shmget": (29, 194),
    "shmat": (30, 196),
    "shmctl": (31, 195),
    "semget": (64, 190),
    "semop": (65, 193),
    "semctl": (66, 191),
    "semtimedop": (220, 192),
    "msgget": (68, 186),
    "msgsnd": (69, 189),
    "msgrcv": (70, 188),
    "msgctl": (71, 187),
    "mq_open": (240, 180),
    "mq_unlink": (241, 181),
    # properties of files, which Landlock does not restrict
    "chmod": (90, None),
    "fchmod": (91, 52),
    "fchmodat": (268, 53),
    "fchmodat2": (452, 452),
    "chown": (92, None),
    "lchown": (94, None),
    "fchown": (93, 55),
    "fchownat": (260, 54),
    "utime": (132, None),
    "utimes": (235, None),
    "futimesat": (261, None),
    "utimensat": (280, 88),
    "setxattr": (188, 5),
    "lsetxattr": (189, 6),
    "fsetxattr": (190, 7),
    "removexattr": (197, 14),
    "lremovexattr": (198, 15),
    "fremovexattr": (199, 16),
    "setxattrat": (463, 463),
    "removexattrat": (466, 466),
    "file_setattr": (469, 469),
    "inotify_add_watch": (254, 27),
    # signals
    "kill": (62, 129),
    "tkill": (200, 130),
    "tgkill": (234, 131),
    "rt_sigqueueinfo": (129, 138),
    "rt_tgsigqueueinfo": (297, 240),
    "pidfd_send_signal": (424, 424),
    # set-up of a sandbox
    "seccomp": (317, 277),
    "landlock_create_ruleset": (444, 444),
    "landlock_add_rule": (445, 445),
    "landlock_restrict_self": (446, 446),
}
"""Numbers of the system calls named here, on x86-64 and on ARM; None where there is no such
call."""


class Rule(NamedTuple):
    """A denied system call.

    Without a test the call is always denied; else by its argument number `argument`:
    "is": if it is `value`. "unless": unless it is. "any of": if it has one of the bits of `value`.
    "type": if its lowest four bits are `value`.
    error: what the call fails with.
    """

    name: str
    test: Literal["", "is", "unless", "any of", "type"] = ""
    argument: int = 0
    value: int = 0
    error: int = errno.EPERM


_NEW_NAMESPACES: Final = 0x7E020000
"""Flags of `clone` that create namespaces."""
_TIOCSTI: Final = 0x5412
"""Request of `ioctl` that types into a terminal."""


def _always(first: str, last: str) -> list[Rule]:
    """Deny the calls of the table from one to another."""
    names = list(NUMBERS)
    return [Rule(name) for name in names[names.index(first) : names.index(last) + 1]]


EVERYWHERE: Final = [
    *_always("mount", "setns"),
    *_always("ptrace", "ioperm"),
    # The C library takes `clone` where there is no `clone3`, whose flags cannot be filtered.
    Rule("clone3", error=errno.ENOSYS),
    Rule("clone", "any of", 0, _NEW_NAMESPACES),
    Rule("ioctl", "is", 1, _TIOCSTI),
]
"""Denied in every sandbox."""
IN_NAMESPACES: Final = [Rule("socket", "unless", 0, socket.AF_UNIX)]
"""Further calls that are denied in namespaces, which no socket can leave."""
UNDER_LANDLOCK: Final = [
    Rule("socket"),
    Rule("connect"),
    Rule("socketpair", "type", 1, socket.SOCK_DGRAM),  # these send to any address
    *(
        Rule(name, "unless", 0, 0)
        for name in (
            "prlimit64",
            "sched_setaffinity",
            "sched_setscheduler",
            "sched_setparam",
            "sched_setattr",
            "migrate_pages",
            "move_pages",
        )
    ),
    *_always("setpriority", "ioprio_set"),
    *_always("shmget", "inotify_add_watch"),
]
"""Further calls that are denied under Landlock, where other processes can be reached."""


def without_signals(process: int) -> list[Rule]:
    """Deny signals to all processes but this one, for a kernel whose Landlock does not."""
    own = [Rule(name, "unless", 0, process) for name in ("kill", "tgkill")]
    return [*own, Rule("tkill"), *_always("rt_sigqueueinfo", "pidfd_send_signal")]


_LOAD, _AND, _IS, _HAS, _AT_LEAST, _RETURN = 0x20, 0x54, 0x15, 0x45, 0x35, 0x06
"""Instructions of the kernel's filter machine."""
_NUMBER_AT, _MACHINE_AT, _ARGUMENTS_AT = 0, 4, 16
"""Places in what a filter is given."""
_ALLOW, _FAIL, _KILL = 0x7FFF0000, 0x00050000, 0x80000000
_OTHER_NUMBERS: Final = 0x40000000
"""First number of x86-64's second table, which is denied as a whole."""
_SET_FILTER, _KEEP_SPEED = 1, 4


def installed(rules: list[Rule], machine: str) -> None:
    """Install a filter for this process and all that it starts. Raises OSError.

    machine: of `MACHINES`. The process must have given up new privileges, or be root.
    """
    column, _ = MACHINES[machine]
    program = b"".join(_program(rules, machine))
    code = ctypes.create_string_buffer(program)
    head = struct.pack("HxxxxxxP", len(program) // 8, ctypes.addressof(code))
    number = NUMBERS["seccomp"][column]
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.syscall(number, _SET_FILTER, _KEEP_SPEED, ctypes.create_string_buffer(head)) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _program(rules: list[Rule], machine: str) -> Iterator[bytes]:
    column, name = MACHINES[machine]
    yield _step(_LOAD, _MACHINE_AT)
    yield _step(_IS, name, 1, 0)
    yield _step(_RETURN, _KILL)
    yield _step(_LOAD, _NUMBER_AT)
    yield _step(_AT_LEAST, _OTHER_NUMBERS, 0, 1)
    yield _step(_RETURN, _FAIL | errno.ENOSYS)
    for rule in rules:
        number = NUMBERS[rule.name][column]
        if number is not None:
            yield from _steps(rule, number)
    yield _step(_RETURN, _ALLOW)


def _steps(rule: Rule, number: int) -> Iterator[bytes]:
    """Yield the steps of a rule, after which the loaded value is again the call's number."""
    fails = _step(_RETURN, _FAIL | rule.error)
    test = {
        "": [],
        "is": [_step(_IS, rule.value, 0, 1)],
        "unless": [_step(_IS, rule.value, 1, 0)],
        "any of": [_step(_HAS, rule.value, 0, 1)],
        "type": [_step(_AND, 0xF), _step(_IS, rule.value, 0, 1)],
    }[rule.test]
    if not test:
        yield _step(_IS, number, 0, 1)
        yield fails
        return
    body = [_step(_LOAD, _ARGUMENTS_AT + 8 * rule.argument), *test, fails]
    yield _step(_IS, number, 0, len(body))
    yield from body
    yield _step(_LOAD, _NUMBER_AT)


def _step(code: int, value: int, then: int = 0, otherwise: int = 0) -> bytes:
    """Return an instruction; `then` and `otherwise` are how many are left out after a test."""
    return struct.pack("HBBI", code, then, otherwise, value)

"""The sandbox of isolated policies, attacked from inside, in both kinds."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import psutil
import pytest

from cosim.core.errors import UsageError
from cosim.policies.load import load_policy
from cosim.spec.options import PolicyHost
from cosim.spec.run_config import Isolation
from scenarios.ipc.sandbox import KINDS
from scenarios.runs.isolated_policy import isolated_caller, sandbox_lacks
from tests.conftest import ROOT, Cosim
from tests.support.graphs import bundle, tiny_graph

NO_FILE = {"ENOENT", "EACCES"}
NO_WRITE = {"ENOENT", "EACCES", "EROFS", "EPERM"}
OWN_FILE = {"done", None}
"""If the same user has made the folder: a file of that name in the sandbox's own /tmp."""
NO_PROCESS = {"ESRCH", "EPERM"}
NO_SOCKET = {"EPERM"}
DENIED = {"EPERM"}
OUTCOMES: dict[str, object] = {
    "neighbour": "beside",
    "file beside": "a file",
    "policy data": "weights",
    "working folder": [],
    "write there": "done",
    "run.json": NO_FILE,
    "run folder": NO_FILE,
    "watch run folder": {"ENOENT", "EPERM"},
    "suite": NO_FILE,
    "shadow": NO_FILE,
    "outside": NO_FILE,
    "parent's folder": {"EACCES", "data.txt own"},  # in namespaces, what else it may read
    "tests": NO_FILE,
    "write policy": NO_WRITE,
    "write data": NO_WRITE,
    "write outside": NO_WRITE | OWN_FILE,
    "write run": NO_WRITE,
    "write /usr": NO_WRITE,
    "chmod policy": NO_WRITE,
    "chmod outside": NO_WRITE | OWN_FILE,
    "truncate outside": NO_WRITE | OWN_FILE,
    "delete run": NO_WRITE,
    "environ": NO_FILE,
    "cmdline": NO_FILE,
    "mem": NO_FILE,
    "parent cmdline": NO_FILE,
    "parent's cwd": NO_FILE,
    "first process": NO_FILE,
    "processes": {1, "EACCES"},  # its own
    "tcp": NO_SOCKET,
    "tcp6": NO_SOCKET,
    "udp": NO_SOCKET,
    "netlink": NO_SOCKET,
    "abstract socket": NO_SOCKET | {"ECONNREFUSED"},  # of another network namespace
    "unix socket": NO_SOCKET | {"ENOENT"},
    "datagram": NO_SOCKET | {"ENOENT"},
    "signal parent": NO_PROCESS,
    "signal victim": NO_PROCESS,
    "signal first": DENIED | {"done"},  # in namespaces its own first one, which ignores it
    "stop itself": "done",  # and it is continued
    "signal group": NO_PROCESS,
    "limit victim": NO_PROCESS,
    "slow victim": NO_PROCESS,
    "ptrace": DENIED,
    "read memory": DENIED,
    "denied calls": ["EPERM"],
    "new user": DENIED,
    "clone3": "ENOSYS",
    "environment": [],
    "descriptors": ["memory", "other", "other", "other", "socket"],
    "user": True,
    "capabilities": 0,
    "new privileges": 1,
    "memory": "MemoryError",
    "files": "EMFILE",
    "file size": "EFBIG",
    "processes of one": "EAGAIN",
    "core": 0,
    "signal all": {"done", "ESRCH"},
}
"""Expected result of each attempt of `tests/support/sandbox_probe.py`: a value, or the set of
results that either kind of sandbox may give."""

_FILLS = """
from cosim.core.state import Command
from cosim.spec.manifest import Manifest

class Fills:
    manifest = Manifest("fills", rate_hz=4.0)

    def reset(self, episode_id, seed):
        self.held = [open("/dev/null") for _ in range(seed)]

    def act(self, seen):
        return Command(0.0, 0.0)
"""
"""A policy that opens as many files as its seed."""


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> Isolation:
    """Return a kind of sandbox that the kernel offers."""
    one: Isolation = request.param
    if why := sandbox_lacks(one):
        pytest.skip(f"this kernel offers no {one}: {why}")
    return one


@pytest.fixture
def policy_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with the probe policy, a run inside, and adjacent files."""
    own = tmp_path / "own"
    (own / "runs/now").mkdir(parents=True)
    (own / "runs/now/run.json").write_text("{}")
    (own / "neighbour.py").write_text("WORDS = 'beside'")
    (own / "beside.txt").write_text("a file")
    shutil.copy(ROOT / "tests/support/sandbox_probe.py", own / "probe.py")
    for name, words in (("outside", "a secret"), ("data", "weights")):
        (tmp_path / f"{name}.txt").write_text(words)
    targets = {"outside": str(tmp_path / "outside.txt")}
    (own / "targets.json").write_text(json.dumps(targets))
    monkeypatch.syspath_prepend(own)
    monkeypatch.chdir(tmp_path)
    for secret in ("COSIM_CACHE", "SECRET_TOKEN"):
        monkeypatch.setenv(secret, str(tmp_path))
    return tmp_path


@pytest.fixture
def listeners(policy_folder: Path) -> Iterator[dict[str, object]]:
    """Open sockets that a policy must not reach."""
    with ExitStack() as stack:
        tcp = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        for how, address in (
            (socket.SOCK_STREAM, str(policy_folder / "stream")),
            (socket.SOCK_DGRAM, str(policy_folder / "datagram")),
            (socket.SOCK_STREAM, f"\0cosim-{os.getpid()}"),
        ):
            end = stack.enter_context(socket.socket(socket.AF_UNIX, how))
            end.bind(address)
            if how == socket.SOCK_STREAM:
                end.listen()
            if not address.startswith("\0"):
                Path(address).chmod(0o777)
        yield {
            "port": tcp.getsockname()[1],
            "socket": str(policy_folder / "stream"),
            "datagram": str(policy_folder / "datagram"),
            "abstract": f"cosim-{os.getpid()}",
        }


def users_of_policies() -> set[int]:
    """Return the user ids of this process's descendants."""
    return {one.uids().real for one in psutil.Process().children(recursive=True)}


def test_a_policy_in_a_sandbox_reaches_nothing_outside(
    kind: Isolation,
    policy_folder: Path,
    listeners: dict[str, object],
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Every attempt on files, processes, sockets, signals, memory and limits fails as the table
    says, and nothing outside changes."""
    data = policy_folder / "data.txt"
    host = PolicyHost(
        isolated=kind,
        data=(str(data),),
        hidden=(str(policy_folder / "own/runs/now"),),
        memory_gb=2.0,
    )
    mode = (policy_folder / "outside.txt").stat().st_mode
    driver = isolated_caller("probe:Probe", host=host)
    user = max(users_of_policies())
    victim = subprocess.Popen(["sleep", "600"], user=user if os.getuid() == 0 else None)
    targets = {
        "outside": str(policy_folder / "outside.txt"),
        "data": str(data),
        "run": str(policy_folder / "own/runs/now"),
        "suite": str(ROOT / "scenarios/suites/reactive.json"),
        "tests": str(ROOT / "tests/conftest.py"),
        "cwd": str(policy_folder),
        "parent": os.getpid(),
        "victim": victim.pid,
        "secrets": ["COSIM_CACHE", "SECRET_TOKEN", "PYTEST_CURRENT_TEST"],
        "user": user,
        **listeners,
    }
    (policy_folder / "own/targets.json").write_text(json.dumps(targets))
    try:
        driver.reset("e1", 1)
        assert driver.runs == f"isolated: {kind}"
    finally:
        driver.close()
        alive = victim.poll() is None
        victim.kill()
        victim.wait()
    errors = capfd.readouterr().err
    (line,) = (one for one in errors.splitlines() if one.startswith("PROBED "))
    found = json.loads(line.removeprefix("PROBED "))
    wrong = {
        name: found.get(name)
        for name, one in OUTCOMES.items()
        if not (found.get(name) in one if isinstance(one, set) else found.get(name) == one)
    }
    assert not wrong and found.keys() == OUTCOMES.keys()
    outside = policy_folder / "outside.txt"
    assert alive and (outside.read_text(), outside.stat().st_mode) == ("a secret", mode)
    assert [path.name for path in (policy_folder / "own/runs/now").iterdir()] == ["run.json"]


def test_the_error_of_a_missing_file_names_the_remedy(kind: Isolation, policy_folder: Path) -> None:
    """The error names `--policy-data`, with which the policy loads."""
    host = PolicyHost(isolated=kind)
    with pytest.raises(UsageError, match=r"outside\.txt.*--policy-data PATH"):
        isolated_caller("probe:Lost", host=host)
    given = msgspec.structs.replace(host, data=(str(policy_folder / "outside.txt"),))
    isolated_caller("probe:Lost", host=given).close()


def test_a_policy_that_fills_its_descriptors_gets_a_new_process(
    kind: Isolation, policy_folder: Path
) -> None:
    """Its process ends after the episode, also where /proc cannot be read."""
    (policy_folder / "own/fills.py").write_text(_FILLS)
    driver = isolated_caller("fills:Fills", host=PolicyHost(isolated=kind))
    spent = []
    for files in (0, 600):
        driver.reset("e1", files)
        driver.ended()
        spent.append(driver.has_exited)
    driver.close()
    assert spent == [False, True]


def test_a_bundle_loads_in_a_sandbox(
    kind: Isolation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An ONNX bundle with a relative name has the same graph as outside."""
    monkeypatch.chdir(tmp_path)
    bundle(tmp_path / "net", tiny_graph())
    driver = isolated_caller("onnx:net", host=PolicyHost(isolated=kind))
    driver.close()
    assert driver.source_hash == load_policy("onnx:net").source_hash


def test_a_policy_in_a_shared_folder_is_refused(
    policy_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy in the home folder would see all files there."""
    monkeypatch.setenv("HOME", str(policy_folder / "own"))
    with pytest.raises(UsageError, match="put it in a folder of its own"):
        isolated_caller("probe:Probe")


@pytest.mark.parametrize(
    ("denied", "message"),
    [
        (("unshare",), "isolated: landlock"),
        (("unshare", "landlock_create_ruleset"), "--isolated=weak runs the policy in another"),
    ],
    ids=["no namespaces", "no sandbox"],
)
def test_without_namespaces_a_policy_runs_under_landlock_or_not_at_all(
    denied: tuple[str, ...], message: str
) -> None:
    """Where the kernel denies both kinds, the message names the steps and the remedy."""
    code = f"""
from cosim.core.errors import MachineError
from scenarios.ipc.kernel_calls import drop_privileges, filter_calls, prctl
from scenarios.ipc.seccomp import Rule
from scenarios.runs.isolated_policy import isolated_caller
prctl("forbid new privileges", 38, 1)
filter_calls([Rule(name) for name in {denied}])
try:
    print(isolated_caller("straight").runs)
except MachineError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    if "landlock: find Landlock" in done.stdout and len(denied) == 1:
        pytest.skip(done.stdout)
    assert message in done.stdout, done
    if len(denied) == 2:
        assert "namespaces: create user, mount, PID, IPC and network namespaces" in done.stdout
        assert "landlock: find Landlock: Operation not permitted" in done.stdout


def test_without_landlocks_scope_a_process_signals_only_itself() -> None:
    """Under the rules for older kernels a signal to the parent fails, and abort works."""
    code = """
import os
from scenarios.ipc.kernel_calls import filter_calls, prctl
from scenarios.ipc.seccomp import without_signals
prctl("forbid new privileges", 38, 1)
filter_calls(without_signals(os.getpid()))
try:
    os.kill(os.getppid(), 0)
except PermissionError:
    print("denied", flush=True)
os.abort()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert (done.stdout, done.returncode) == ("denied\n", -signal.SIGABRT)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--policy-data", "."), "--policy-data goes with --isolated"),
        (("--isolated=weak", "--policy-memory", "2"), "--policy-memory goes with --isolated"),
        (("--isolated", "--policy-data", "nowhere"), "--policy-data nowhere: there is no such"),
        (("--isolated=strong",), "'strong' is not one of"),
        (("--isolated",), "an isolated one gets only observations"),
    ],
    ids=["alone", "weak", "missing", "kind", "privileged"],
)
def test_options_of_isolation_are_checked(
    words: tuple[str, ...], message: str, cosim: Cosim, tmp_path: Path
) -> None:
    """Invalid combinations are refused before anything runs, and `--isolated` takes a value only
    after "="."""
    done = cosim("run", *words, "reactive", "--policy", "route", cwd=tmp_path)
    assert done.returncode == 2 and message in done.stderr, done.stderr

"""A run across network namespaces with TLS, while links fail. Usage: python -m tests.support.across
--episodes 60. The coordinator, two workers and a viewer have separate addresses. The results must
equal those of an undisturbed run on one machine to the byte."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import msgspec

from bridge.security.authority import issue, make_authority
from cosim.results.run_folder import read_records
from cosim.spec.connection import Role
from cosim.spec.scenario import Suite, write_suite
from scenarios.runs.status import CONFLICT, LOG_FILE
from scenarios.tools.verify.doctor import small_scenario
from tests.support.namespaces import Network, network

_OUTAGE_S: Final = 6.0
"""Longer than a session's lease (2 s), which expires, and shorter than a job's lease."""
FAULTS: dict[str, Callable[[Network], None]] = {
    "link of worker one down": lambda net: net.cut("one"),
    "what worker two sends is lost": lambda net: net.lose("two", sent=True),
    "what is sent to worker one is lost": lambda net: net.lose("one", sent=False),
    "link of the coordinator down": lambda net: net.cut("hub"),
}
_RUN: Final = ("suite.json", "--policy", "blind:Blind", "--seed", "7")
_BLIND: Final = """
from cosim.spec.manifest import Manifest
from cosim.core.state import Command

class Blind:
    manifest = Manifest("blind", camera=None)
    def reset(self, episode_id, seed): pass
    def act(self, observation): return Command(0.8, 0.0)
"""
_VIEWER: Final = """
import sys
from pathlib import Path
from tests.support.plain import plain_zenoh

with plain_zenoh(sys.argv[1], Path(sys.argv[2]), "viewer") as session:
    (status,) = [str(one.ok.key_expr) for one in session.get("cosim/*/status", timeout=600.0)]
    acts = ("claim", "report")
    asked = [list(session.get(status.replace("status", f"jobs/{act}"), payload=b"mine", timeout=600.0)) for act in acts]
    print(status.split("/")[2], sum(map(len, asked)), "answers about its jobs")
"""


def prepare(folder: Path, net: Network, episodes: int, limit_s: float) -> None:
    """Write certificates, a policy, and a suite of tiny episodes."""
    make_authority(folder / "certs", [net.address("hub")], 365)
    roles: tuple[Role, ...] = ("worker", "viewer")
    for role in roles:
        issue(folder / "certs", role, [], 365)
    (folder / "blind.py").write_text(_BLIND)
    one = small_scenario()
    scenarios = tuple(
        msgspec.structs.replace(one, id=f"tiny-{i:03d}", seed=i, time_limit_s=limit_s)
        for i in range(episodes)
    )
    write_suite(Suite(name="tiny", version="1", scenarios=scenarios), folder / "suite.json")


def run_across(
    folder: Path, net: Network, faults: Sequence[str], every: int, tell: Callable[[str], None]
) -> int:
    """Run the suite in a folder by two workers, into the run folder `run`, with a fault whenever
    `every` more episodes are finished. Return the exit code of the coordinator."""
    at = _hub(net)
    with ExitStack() as stack:

        def start(host: str, *words: str) -> subprocess.Popen[bytes]:
            role = "worker" if "worker" in words else "coordinator"
            words = (sys.executable, "-m", "cosim", *words, "--tls", f"certs/{role}")
            log = stack.enter_context((folder / f"{host}.log").open("wb"))
            process = subprocess.Popen(net.on(host, *words), cwd=folder, stdout=log, stderr=log)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        coordinator = start(
            "hub", "coordinator", *_RUN, "--out", "run", "--listen", "tls/0.0.0.0:7447"
        )
        for host in ("one", "two"):
            start(host, "worker", "--connect", at)
        for number, fault in enumerate(faults, 1):
            while (done := len(list(folder.glob("run/episodes/*/record.json")))) < every * number:
                assert coordinator.poll() is None, (folder / "hub.log").read_text()
                time.sleep(0.05)
            FAULTS[fault](net)
            tell(f"{done} episodes, {_OUTAGE_S:g} s: {fault}")
            time.sleep(_OUTAGE_S)
            for host in ("hub", "one", "two"):
                net.mend(host)
        return coordinator.wait()


def viewer_output(folder: Path, net: Network) -> str:
    """Return the output of a viewer on a separate host that looks for the run and queries its
    jobs."""
    words = net.on("viewer", sys.executable, "-c", _VIEWER, _hub(net), "certs")
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    return subprocess.run(
        words, cwd=folder, env=env, stdout=subprocess.PIPE, text=True, check=True
    ).stdout


def _hub(net: Network) -> str:
    return f"tls/{net.address('hub')}:7447"


def faults_of_run(folder: Path, scenarios: int) -> list[str]:
    """Return the faults of the run, one line each."""
    records = [record.scenario.id for record in read_records(folder / "run")]
    wrong = (
        []
        if len(set(records)) == len(records) == scenarios
        else [f"{len(records)} records of {scenarios}"]
    )
    if lost := [
        record.scenario.id for record in read_records(folder / "run") if record.status != "done"
    ]:
        wrong.append(f"without a result: {', '.join(lost)}")
    log = (folder / "run" / LOG_FILE).read_text()
    return wrong + [line for line in log.splitlines() if CONFLICT in line]


def _main() -> int:
    parser = argparse.ArgumentParser(
        description="A run across network namespaces, with TLS and faults."
    )
    parser.add_argument("--episodes", type=int, default=60)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="cosim-across-"))
    with network("hub", "one", "two", "viewer") as net:
        prepare(folder, net, given.episodes, 2.0)
        words = [sys.executable, "-m", "cosim", "run", *_RUN, "--out", "quiet", "--jobs", "2"]
        subprocess.run(words, cwd=folder, check=True, capture_output=True)
        began_s = time.monotonic()

        def tell(line: str) -> None:
            print(line, flush=True)
            if "coordinator" not in line:
                print(f"a viewer sees: {viewer_output(folder, net).strip()}", flush=True)

        code = run_across(folder, net, list(FAULTS), given.episodes // (len(FAULTS) + 1), tell)
    wrong = faults_of_run(folder, given.episodes)
    quiet, across = ((folder / run / "results.csv").read_bytes() for run in ("quiet", "run"))
    wrong += [] if quiet == across else ["results.csv differs from that of a quiet run"]
    ends = "; ".join(wrong) or "as in the quiet run to the byte"
    print(
        f"{given.episodes} episodes in {time.monotonic() - began_s:.0f} s, exit code {code}: "
        f"{ends} ({folder})"
    )
    return int(bool(wrong) or code != 0)


if __name__ == "__main__":
    sys.exit(_main())

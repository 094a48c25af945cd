"""Users' gaits in runs: recorded and replayed, or crashed with the reason; and a published gait."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import Command
from cosim.policies.baselines import Straight
from cosim.results.run_folder import read_records
from cosim.results.run_setup import RunSetup
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import DOG
from cosim.spec.run_config import RunConfig
from cosim.spec.scenario import CrowdSpec, Scenario, Suite, write_suite
from physics.dynamics.drive import SUBSTEP_S
from physics.dynamics.drives import gait_drive
from physics.dynamics.legs.gait_file import user_gait
from scenarios.episodes.run_episode import run_episode
from scenarios.tools.bench.legs import FLAT, mean_speeds, stand, straight, walking
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import ROOT, Cosim
from tests.support.gaits import JOINTS, layers_graph, robot_lab_gait, written_gait

pytestmark = pytest.mark.engine

START = Pose(-40.0, 0.0, 0.0)
PUBLISHED = (
    Path(os.environ.get("COSIM_WEIGHTS") or ROOT.parent / "shared" / "weights")
    / "rl_sar_go2_robot_lab"
)


def second(name: str) -> Scenario:
    """Return a scenario of one second, without people."""
    empty = CrowdSpec(persons=0, radius_m=40.0, vehicles=0)
    return msgspec.structs.replace(
        small_scenario(), id=name, time_limit_s=1.0, crowd=empty, robot="dog"
    )


def test_a_run_records_its_gait_and_replays_with_it(tmp_path: Path, cosim: Cosim) -> None:
    """The record has name and hash; with changed files neither a replay nor a resumed run is
    possible."""
    write_suite(Suite(name="s", version="1", scenarios=(second("a"),)), tmp_path / "s.json")
    gait = written_gait(tmp_path)
    run = tmp_path / "run"
    line = f"run {tmp_path}/s.json --policy straight --gait onnx:{gait} --out {run}".split()
    done = cosim(*line)
    assert done.returncode == 0, done.stderr
    (record,) = read_records(run)
    assert record.status == "done" and record.setup.gait == f"onnx:{gait}"
    assert len(record.setup.gait_hash) == 32
    own = run_episode(second("a"), Straight()).record
    assert own.state_hash != record.state_hash and own.setup.gait == ""
    assert "as recorded" in cosim("replay", str(run), "a").stdout
    written_gait(tmp_path, layers_graph(seed=1))
    done = cosim("replay", str(run), "a")
    assert done.returncode == 2 and "and recorded is" in done.stderr
    done = cosim(*line, "--resume")
    assert done.returncode == 2 and "gait_hash" in done.stderr


def test_a_single_episode_records_its_gait(tmp_path: Path) -> None:
    """The record has hash and absolute path; an episode whose files have changed is invalid, with
    both hashes."""
    options = EpisodeOptions(gait=f"onnx:{written_gait(tmp_path)}")
    with contextlib.chdir(tmp_path):
        record = run_episode(second("a"), Straight(), EpisodeOptions(gait="onnx:tiny.onnx")).record
    found = user_gait(options.gait, DOG, SUBSTEP_S).digest
    assert (record.setup.gait, record.setup.gait_hash) == (options.gait, found)
    assert EpisodeOptions.from_config(RunConfig(suite="s", gait="onnx:tiny.onnx")).gait == (
        f"onnx:{Path('tiny.onnx').absolute()}"
    )
    setup = RunSetup.of(options, gait_hash="0" * 32)
    record = run_episode(second("a"), Straight(), options, setup=setup).record
    assert record.status == "invalid" and f"have hash {found}, and recorded is 000" in record.reason


@pytest.mark.parametrize(
    ("scale", "kp", "why"),
    [(1e30, 20, "gait 'tiny' answered "), (0.1, 2000, "Nm; its limit is 23.7 Nm")],
    ids=["nan", "torque"],
)
def test_a_gait_that_fails_crashes_the_episode_with_the_reason(
    scale: float, kp: float, why: str, tmp_path: Path
) -> None:
    """NaN answers and torques far beyond the limits crash the episode."""
    joints = {name: row | {"kp": kp, "scale": 1000} for name, row in JOINTS.items()}
    gait = written_gait(tmp_path, layers_graph(scale=scale), joints=joints)
    with np.errstate(all="ignore"):
        record = run_episode(second("a"), Straight(), EpisodeOptions(gait=f"onnx:{gait}")).record
    assert record.status == "crashed" and why in record.reason


def test_a_published_network_walks_as_a_gait_of_the_dog(tmp_path: Path) -> None:
    """The Go2 network of rl_sar walks 10 m at 1 m/s in 12 s on the line, turns, and stands."""
    if not (PUBLISHED / "policy.pt").is_file():
        pytest.skip(f"the published network {PUBLISHED}/policy.pt is missing (COSIM_WEIGHTS)")
    gait = robot_lab_gait(tmp_path, PUBLISHED)
    with walking(
        DOG, FLAT, START, gait_drive(DOG, user_gait(f"onnx:{gait}", DOG, SUBSTEP_S))
    ) as walk:
        found = straight(walk, 1.0)
        assert found.time_s < 12.0 and found.aside_m < 0.3 and not found.fallen
        drift_m, turned_deg = stand(walk, 10.0)
        assert drift_m < 0.05 and turned_deg < 3.0
        walk.drive(Command(0.0, 0.65), 2.0)
        assert mean_speeds(walk.drive(Command(0.0, 0.65), 3.0))[1] == pytest.approx(0.65, rel=0.15)

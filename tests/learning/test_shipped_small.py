"""The small shipped policies, trained by `cosim train`; without any there is nothing to test."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cosim.policies.load import shipped_bundles
from cosim.results.run_folder import read_records
from tests.conftest import Cosim

SMALL = [name for name in shipped_bundles() if name.startswith("small")]


@pytest.mark.parametrize("name", SMALL)
def test_a_shipped_small_policy_is_small_and_answers_without_pytorch(name: str) -> None:
    """Its folder is at most 8 MB, and it is loaded by name and queried without PyTorch in the
    process."""
    assert sum(path.stat().st_size for path in shipped_bundles()[name].iterdir()) < 8_000_000
    code = (
        "import sys, cosim; from cosim.policies.onnx.policy import example_observation; "
        "policy = cosim.load_policy(sys.argv[1]); policy.reset('one', 1); "
        "print(policy.act(example_observation(policy.manifest)).v_mps >= 0.0, 'torch' in sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, name], capture_output=True, text=True, check=True
    )
    assert result.stdout.split() == ["True", "False"]


@pytest.mark.engine
@pytest.mark.parametrize("name", SMALL)
def test_a_shipped_small_policy_drives_to_a_goal(name: str, tmp_path: Path, cosim: Cosim) -> None:
    """By its name it crosses a crosswalk of the test split, in a city that it was not trained on."""
    result = cosim(
        "run",
        "unit",
        "--policy",
        name,
        "--scenario",
        "crosswalk-7013",
        "--out",
        "run",
        cwd=tmp_path,
    )
    (record,) = read_records(tmp_path / "run")
    assert result.returncode == 0 and record.ended == "goal" and not record.manifest.privileged, (
        result.stderr
    )

"""The commands that build the graphs of published networks from their authors' files."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import MachineError
from cosim.policies.load import load_policy, shipped_bundles
from cosim.policies.onnx.converting import Converter
from cosim.policies.onnx.manifest import file_facts, read_bundle_manifest
from cosim.policies.onnx.policy import OnnxPolicy, example_differences
from cosim.policies.published.dronet.graph import (
    DRONET,
    read_keras_weights,
)
from cosim.policies.published.openbot.graph import OPENBOT
from cosim.policies.published.openbot.lite_file import (
    read_lite_file,
)

WEIGHTS = Path(os.environ.get("COSIM_WEIGHTS") or Path(__file__).parents[3] / "shared" / "weights")
UPSTREAM = {"dronet": "dronet_model_weights.h5", "openbot": "autopilot_float.tflite"}
"""Names of the files in WEIGHTS."""
PACKAGES = {"dronet": "h5py", "openbot": "flatbuffers"}
"""The package that each command imports besides onnx."""
NETWORKS = [
    pytest.param(network, id=network.module.rpartition(".")[2]) for network in (DRONET, OPENBOT)
]


def name_of(network: Converter) -> str:
    """Return the name of the network's policy."""
    return network.module.rpartition(".")[2]


def upstream_file(network: Converter) -> Path:
    """Return the file upstream; where it or a package is missing, the test is skipped."""
    policy = name_of(network)
    for package in ("onnx", PACKAGES[policy]):
        pytest.importorskip(package)
    path = WEIGHTS / UPSTREAM[policy]
    if not path.is_file():
        pytest.skip(f"the published file {path.name} is not in {WEIGHTS} (COSIM_WEIGHTS)")
    return path


def accepting(network: Converter, data: bytes) -> Converter:
    """Return the network with the hash of other weights upstream."""
    return replace(network, weights=replace(network.weights, facts=file_facts(data)))


@pytest.mark.parametrize("network", NETWORKS)
def test_the_command_makes_the_graph_that_runs_accept(
    network: Converter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is the manifest's file byte for byte, and the policy loads and reproduces its example."""
    command = [sys.executable, "-m", network.module, upstream_file(network), "-o", tmp_path]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    folder = shipped_bundles()[name_of(network)]
    bundle = read_bundle_manifest(folder)
    made = tmp_path / bundle.model
    assert result.stdout == f"{made}: {bundle.files[bundle.model].bytes} bytes\n"
    assert file_facts(made.read_bytes()).blake2b == bundle.files[bundle.model].blake2b
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path))
    assert load_policy(name_of(network)).manifest.name == name_of(network)
    off = example_differences(OnnxPolicy(folder))
    assert off.keys() == set(bundle.output.outputs) and max(off.values()) < 1e-4


@pytest.mark.parametrize("network", NETWORKS)
def test_another_file_makes_no_graph(
    network: Converter, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line has its size, hash and origin and the required ones, and nothing is written."""
    (tmp_path / "other").write_bytes(b"not weights")
    for path, expected in (
        (tmp_path / "other", "other: 11 bytes, BLAKE2b"),
        (tmp_path / "none", "none: cannot be read"),
    ):
        with pytest.raises(SystemExit) as ended:
            network.command([str(path), "-o", str(tmp_path / "out")])
        assert str(ended.value).startswith(f"error: {tmp_path / expected}")
        assert network.weights.source in str(ended.value) and "\n" not in str(ended.value)
    assert not (tmp_path / "out").exists() and not capsys.readouterr().out


@pytest.mark.parametrize("network", NETWORKS)
def test_a_missing_package_is_named_with_its_install_command(
    network: Converter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command needs packages that a run does not, and names the command that installs them."""
    (tmp_path / "file").write_bytes(b"\x20\0\0\0TFL3")
    monkeypatch.setitem(sys.modules, PACKAGES[name_of(network)], None)
    monkeypatch.setitem(sys.modules, "flatbuffers.table", None)
    with pytest.raises(MachineError, match=r"pip install -e '\.\[convert\]' in the checkout$"):
        accepting(network, b"\x20\0\0\0TFL3").write(tmp_path / "file", tmp_path)


def test_a_graph_that_runs_would_refuse_is_not_written(tmp_path: Path) -> None:
    """Where another version of onnx writes other bytes, the command reports it before a run would."""
    (tmp_path / "file").write_bytes(b"weights")
    other = replace(accepting(DRONET, b"weights"), make=lambda _: b"another graph")
    with pytest.raises(
        MachineError, match=r"dronet_200x200\.onnx: would be 13 bytes, .*pip install 'onnx<1\.24'"
    ):
        other.write(tmp_path / "file", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_file_that_is_no_hdf5_is_refused(tmp_path: Path) -> None:
    """Files with another beginning or cut off are refused; all arrays of a complete one are read by
    path."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "w.h5", "w") as file:
        file["layer/layer/kernel:0"] = np.arange(4, dtype=np.float32)
    data = (tmp_path / "w.h5").read_bytes()
    assert read_keras_weights(data)["layer/layer/kernel:0"].tolist() == [0.0, 1.0, 2.0, 3.0]
    for wrong in (b"", b"no weights", data[: len(data) // 2]):
        with pytest.raises(ValueError, match="is no whole HDF5 file"):
            read_keras_weights(wrong)


def test_a_file_that_is_no_lite_file_is_refused() -> None:
    """A file that begins otherwise or is cut off is refused."""
    pytest.importorskip("flatbuffers")
    for wrong in (b"", b"no weights", b"\x20\0\0\0TFL3" + b"\xff" * 300):
        with pytest.raises(ValueError, match=r"is no (whole )?TensorFlow Lite file"):
            read_lite_file(wrong)

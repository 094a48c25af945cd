"""The commands that make the graphs of published networks, of the files that their authors
publish."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.errors import MachineError
from cosim.policies.load import load_policy, shipped_bundles
from cosim.policies.onnx.converting import Converter
from cosim.policies.onnx.manifest import file_facts, read_bundle_manifest
from cosim.policies.onnx.policy import OnnxPolicy, example_differences
from cosim.policies.published.dronet.graph import (
    DRONET,
    KerasWeights,
    dronet_graph,
    read_keras_weights,
)
from cosim.policies.published.openbot.graph import OPENBOT, openbot_graph
from cosim.policies.published.openbot.lite_file import (
    LiteModel,
    LiteOperator,
    LiteTensor,
    read_lite_file,
)

WEIGHTS = Path(os.environ.get("COSIM_WEIGHTS") or Path(__file__).parents[3] / "shared" / "weights")
UPSTREAM = {"dronet": "dronet_model_weights.h5", "openbot": "autopilot_float.tflite"}
"""What the files are called in WEIGHTS."""
PACKAGES = {"dronet": "h5py", "openbot": "flatbuffers"}
"""What each command imports besides onnx."""
NETWORKS = [
    pytest.param(network, id=network.module.rpartition(".")[2]) for network in (DRONET, OPENBOT)
]
BLOCKS = ((1, 32, 32), (2, 32, 64), (3, 64, 128))
"""Of DroNet: their numbers, and channels before and after."""


def name_of(network: Converter) -> str:
    """Its policy's name."""
    return network.module.rpartition(".")[2]


def given(network: Converter) -> Path:
    """The file upstream; where it or a package is missing, the test is skipped."""
    policy = name_of(network)
    for package in ("onnx", PACKAGES[policy]):
        pytest.importorskip(package)
    path = WEIGHTS / UPSTREAM[policy]
    if not path.is_file():
        pytest.skip(f"the published file {path.name} is not in {WEIGHTS} (COSIM_WEIGHTS)")
    return path


def taking(network: Converter, data: bytes) -> Converter:
    """The same, of other weights upstream."""
    return replace(network, weights=replace(network.weights, facts=file_facts(data)))


@pytest.mark.parametrize("network", NETWORKS)
def test_the_command_makes_the_graph_that_runs_take(
    network: Converter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Byte for byte the file that the manifest names, with which the policy loads and tells what
    its example expects; so the same every time."""
    command = [sys.executable, "-m", network.module, given(network), "-o", tmp_path]
    told = subprocess.run(command, capture_output=True, text=True, check=True)
    folder = shipped_bundles()[name_of(network)]
    bundle = read_bundle_manifest(folder)
    made = tmp_path / bundle.model
    assert told.stdout == f"{made}: {bundle.files[bundle.model].bytes} bytes\n"
    assert file_facts(made.read_bytes()).blake2b == bundle.files[bundle.model].blake2b
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path))
    assert load_policy(name_of(network)).manifest.name == name_of(network)
    off = example_differences(OnnxPolicy(folder))
    assert off.keys() == set(bundle.output.outputs) and max(off.values()) < 1e-4


@pytest.mark.parametrize("network", NETWORKS)
def test_another_file_makes_no_graph(
    network: Converter, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line its size and hash, and those wanted, of which file of whom; nothing is
    written."""
    (tmp_path / "other").write_bytes(b"not weights")
    for path, said in (
        (tmp_path / "other", "other: 11 bytes, BLAKE2b"),
        (tmp_path / "none", "none: cannot be read"),
    ):
        with pytest.raises(SystemExit) as ended:
            network.command([str(path), "-o", str(tmp_path / "out")])
        assert str(ended.value).startswith(f"error: {tmp_path / said}")
        assert network.weights.source in str(ended.value) and "\n" not in str(ended.value)
    assert not (tmp_path / "out").exists() and not capsys.readouterr().out


@pytest.mark.parametrize("network", NETWORKS)
def test_a_package_that_is_missing_is_named_with_what_installs_it(
    network: Converter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command needs packages that a run does not."""
    (tmp_path / "file").write_bytes(b"\x20\0\0\0TFL3")
    monkeypatch.setitem(sys.modules, PACKAGES[name_of(network)], None)
    monkeypatch.setitem(sys.modules, "flatbuffers.table", None)
    with pytest.raises(MachineError, match=r"pip install 'sidewalk-cosim\[convert\]'$"):
        taking(network, b"\x20\0\0\0TFL3").write(tmp_path / "file", tmp_path)


def test_a_graph_that_runs_would_refuse_is_not_written(tmp_path: Path) -> None:
    """Where another version of onnx writes other bytes, the command says so, not the run after
    it."""
    (tmp_path / "file").write_bytes(b"weights")
    other = replace(taking(DRONET, b"weights"), make=lambda _: b"another graph")
    with pytest.raises(
        MachineError, match=r"dronet_200x200\.onnx: would be 13 bytes, .*pip install 'onnx<1\.24'"
    ):
        other.write(tmp_path / "file", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def dronet_weights() -> KerasWeights:
    """Weights of its shapes, all 0."""
    shapes: dict[str, tuple[int, ...]] = {}

    def conv(number: int, *kernel: int) -> None:
        shapes.update({f"conv2d_{number}/kernel": kernel, f"conv2d_{number}/bias": kernel[3:]})

    conv(1, 5, 5, 1, 32)
    for i, planes, more in BLOCKS:
        conv(3 * i - 1, 3, 3, planes, more)
        conv(3 * i, 3, 3, more, more)
        conv(3 * i + 1, 1, 1, planes, more)
        for norm, channels in ((2 * i - 1, planes), (2 * i, more)):
            for field in ("gamma", "beta", "moving_mean", "moving_variance"):
                shapes[f"batch_normalization_{norm}/{field}"] = (channels,)
    for dense in (1, 2):
        shapes.update({f"dense_{dense}/kernel": (6272, 1), f"dense_{dense}/bias": (1,)})
    return {
        f"{name.partition('/')[0]}/{name}:0": np.zeros(shape, np.float32)
        for name, shape in shapes.items()
    }


def test_every_number_of_the_file_has_its_place_in_dronet() -> None:
    """An array more, one less, and one of another shape or type are refused; the graph is the same
    every time."""
    pytest.importorskip("onnx")
    arrays = dronet_weights()
    assert dronet_graph(arrays) == dronet_graph(dict(reversed(arrays.items())))
    name = "conv2d_9/conv2d_9/kernel:0"
    with pytest.raises(ValueError, match="holds 'more', and 0 more, of which there is no place"):
        dronet_graph({**arrays, "more": np.zeros(1, np.float32)})
    with pytest.raises(ValueError, match=f"has no '{name}'"):
        dronet_graph({key: array for key, array in arrays.items() if key != name})
    for other in (np.zeros((3, 3, 128, 64), np.float32), arrays[name].astype(np.float64)):
        with pytest.raises(
            ValueError, match=rf"'{name}' is float\d\d \(.*wanted is float32 \(3, 3, 128, 128\)"
        ):
            dronet_graph({**arrays, name: other})  # type: ignore[dict-item]


def test_a_file_that_is_no_hdf5_is_refused(tmp_path: Path) -> None:
    """What begins otherwise, and what is cut off; of a whole one all arrays are read by their
    paths."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "w.h5", "w") as file:
        file["layer/layer/kernel:0"] = np.arange(4, dtype=np.float32)
    data = (tmp_path / "w.h5").read_bytes()
    assert read_keras_weights(data)["layer/layer/kernel:0"].tolist() == [0.0, 1.0, 2.0, 3.0]
    for wrong in (b"", b"no weights", data[: len(data) // 2]):
        with pytest.raises(ValueError, match="is no whole HDF5 file"):
            read_keras_weights(wrong)


def lite_file(code: int = 9, activation: int = 1) -> bytes:
    """A model of one operator, by default a product of x (1, 2) with int8 numbers, [[-1, 0]] less
    1, in halves."""
    builder: Any = pytest.importorskip("flatbuffers").Builder(0)

    def table(**fields: int) -> int:
        """Of fields by kind and number: b0 is a byte in the field 0, i an int32, o what lies
        elsewhere."""
        builder.StartObject(1 + max(int(name[1:]) for name in fields))
        put = {
            "b": builder.PrependInt8Slot,
            "i": builder.PrependInt32Slot,
            "o": builder.PrependUOffsetTRelativeSlot,
        }
        for name, value in fields.items():
            put[name[0]](int(name[1:]), value, 0)
        return int(builder.EndObject())

    def tables(*held: int) -> int:
        builder.StartVector(4, len(held), 4)
        for one in reversed(held):
            builder.PrependUOffsetTRelative(one)
        return int(builder.EndVector())

    def numbers(*held: float, dtype: str = "<i4") -> int:
        return int(builder.CreateNumpyVector(np.array(held, dtype)))

    def tensor(name: str, buffer: int, *shape: int, **more: int) -> int:
        return table(o0=numbers(*shape), i2=buffer, o3=builder.CreateString(name), **more)

    halves = table(o2=numbers(0.5, dtype="<f4"), o3=numbers(1, dtype="<i8"))
    tensors = (
        tensor("x", 0, 1, 2),
        tensor("kernel", 1, 1, 2, b1=9, o4=halves),
        tensor("bias", 2, 1),
        tensor("y", 0, 1, 1),
    )
    operator = table(o1=numbers(0, 1, 2), o2=numbers(3), o4=table(b0=activation))
    graph = table(o0=tables(*tensors), o1=numbers(0), o2=numbers(3), o3=tables(operator))
    held = (
        table(b1=0),
        table(o0=numbers(-1, 0, dtype="i1")),
        table(o0=numbers(0, 0, 128, 63, dtype="u1")),
    )
    builder.Finish(
        table(o1=tables(table(b0=code)), o2=tables(graph), o4=tables(*held)),
        file_identifier=b"TFL3",
    )
    return bytes(builder.Output())


def test_a_lite_file_is_read_with_its_int8_multiplied_out() -> None:
    """Tensors, the operator between them, and the numbers that bytes and a scale stand for."""
    model = read_lite_file(lite_file())
    assert [(one.name, one.shape) for one in model.tensors] == [
        ("x", (1, 2)),
        ("kernel", (1, 2)),
        ("bias", (1,)),
        ("y", (1, 1)),
    ]
    assert model.tensors[0].numbers is None and model.tensors[3].numbers is None
    assert model.tensors[1].numbers is not None and model.tensors[1].numbers.tolist() == [
        [-1.0, -0.5]
    ]
    assert model.tensors[2].numbers is not None and model.tensors[2].numbers.tolist() == [1.0]
    assert (model.inputs, model.outputs) == ((0,), (3,))
    assert model.operators == (LiteOperator("dense", (0, 1, 2), 3, True, (1, 1)),)


def test_a_file_that_is_no_lite_file_is_refused() -> None:
    """What begins otherwise, what is cut off, and operators of which nothing is known here."""
    data = lite_file()
    for wrong in (b"", b"no weights", data[:100], data[:8] + b"\xff" * 300):
        with pytest.raises(ValueError, match=r"is no (whole )?TensorFlow Lite file"):
            read_lite_file(wrong)
    with pytest.raises(ValueError, match=r"has an operator of kind 4\. Known are 0, 2, 3, 9, 18"):
        read_lite_file(lite_file(code=4))
    with pytest.raises(
        ValueError, match="has an operator with the activation 3, which is not known"
    ):
        read_lite_file(lite_file(activation=3))


def small_openbot(**other: LiteTensor) -> LiteModel:
    """A model with OpenBot's inputs and outputs whose wheels are the command, and the command and
    1."""
    tensors = {
        "img_input": LiteTensor("img_input", (1, 96, 256, 3), None),
        "cmd_input": LiteTensor("cmd_input", (1, 1), None),
        "kernel": LiteTensor("kernel", (2, 1), np.ones((2, 1), np.float32)),
        "bias": LiteTensor("bias", (2,), np.array([0.0, 1.0], np.float32)),
        "wheels": LiteTensor("wheels", (1, 2), None),
    }
    dense = LiteOperator("dense", (1, 2, 3), 4, False, (1, 1))
    return LiteModel(tuple({**tensors, **other}.values()), (0, 1), (4,), (dense,))


def test_a_model_with_other_inputs_outputs_or_shapes_is_not_openbots() -> None:
    """The graph of a fitting one tells what the model would."""
    pytest.importorskip("onnx")
    import onnxruntime

    session = onnxruntime.InferenceSession(openbot_graph(small_openbot()))
    asked = {
        "img": np.zeros((2, 96, 256, 3), np.float32),
        "cmd": np.array([[-1.0], [1.0]], np.float32),
    }
    assert session.run(["left_right"], asked)[0].tolist() == [[-1.0, 0.0], [1.0, 2.0]]
    for name, shape in (("img_input", (1, 3, 96, 256)), ("cmd_input", (1, 2)), ("wheels", (1, 3))):
        with pytest.raises(ValueError, match=r"has inputs .* and outputs .*; wanted are"):
            openbot_graph(small_openbot(**{name: LiteTensor(name, shape, None)}))
    with pytest.raises(ValueError, match="operator 0: is a dense without weights"):
        openbot_graph(small_openbot(kernel=LiteTensor("kernel", (2, 1), None)))
    with pytest.raises(ValueError, match="makes no graph: "):
        openbot_graph(
            small_openbot(kernel=LiteTensor("kernel", (2, 3), np.ones((2, 3), np.float32)))
        )
    model = small_openbot()
    with pytest.raises(ValueError, match="takes tensor 4 before it is made"):
        openbot_graph(replace(model, operators=()))

"""Malicious bundles: refused before they are read, without a traceback or a hang."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest

from cosim.core.errors import UsageError
from cosim.policies.load import load_policy
from cosim.policies.onnx.policy import OnnxPolicy, example_differences
from scenarios.tools.policy_check.answer_checks import example
from tests.support.graphs import MANIFEST, bundle, tiny_graph

OBS = np.ones((1, 6, 4, 8), np.float32)
GOAL = np.array([[1, 0]], np.float32)
HUGE = 4 << 30


def save_npz(path: Path, **arrays: np.ndarray[Any, Any]) -> None:
    np.savez(
        path,
        **{"obs": OBS, "goal": GOAL, "expected.action": np.zeros((1, 5, 2), np.float32)} | arrays,
    )


def cut_off(path: Path) -> None:
    save_npz(path)
    path.write_bytes(path.read_bytes()[:-100])


def flipped(path: Path) -> None:
    save_npz(path)
    data = bytearray(path.read_bytes())
    data[200] ^= 0xFF
    path.write_bytes(bytes(data))


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(HUGE)


def zip_bomb(path: Path) -> None:
    """A few bytes that claim to unpack to gigabytes."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("obs.npy", bytes(64))
        archive.infolist()[0].file_size = HUGE


def long_header(path: Path) -> None:
    """An array of a few bytes that claims 10**15 numbers."""
    with zipfile.ZipFile(path, "w") as archive, archive.open("obs.npy", "w") as out:
        np.lib.format.write_array_header_1_0(
            out, {"descr": "<f4", "fortran_order": False, "shape": (10**15,)}
        )
        out.write(bytes(64))


EXAMPLES: dict[str, tuple[Callable[[Path], None], str]] = {
    "cut off": (cut_off, "cannot be read as .npz"),
    "a bit flipped": (flipped, "cannot be read as .npz"),
    "empty": (lambda path: path.write_bytes(b"") and None, "cannot be read as .npz"),
    "no zip": (
        lambda path: path.write_text("once upon a time") and None,
        "cannot be read as .npz: File is not a zip",
    ),
    "objects": (
        lambda path: save_npz(path, obs=np.array([{}], object)),
        "'obs' holds objects of Python",
    ),
    "other type": (
        lambda path: save_npz(path, obs=OBS.astype(float)),
        "'obs' is float64 (1, 6, 4, 8), and the graph",
    ),
    "texts": (
        lambda path: save_npz(path, **{"expected.action": np.array(["a"])}),
        "'expected.action' is str32 (1,), and",
    ),
    "other shape": (
        lambda path: save_npz(path, goal=GOAL[0]),
        "'goal' is float32 (2,), and the graph takes float32",
    ),
    "no arrays": (lambda path: np.savez(path), "has no array 'goal'; it has none"),
    "4 GB": (sparse, "holds 4294967296 bytes; at most 536870912 are read"),
    "a bomb": (
        zip_bomb,
        "unpacks to 1 arrays of 4294967296 bytes; at most 536870912 bytes are read",
    ),
    "a long header": (
        long_header,
        "'obs' should hold (1000000000000000,) of float32, and has 64 bytes",
    ),
    "a pipe": (lambda path: os.mkfifo(path), "is no regular file"),
    "a folder": (lambda path: path.mkdir(), "is no regular file"),
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_that_cannot_be_used_is_refused_before_it_is_read(
    tmp_path: Path, name: str
) -> None:
    """One line has its file, what was found and what is required."""
    place = bundle(tmp_path / "net", tiny_graph())
    make, expected = EXAMPLES[name]
    make(place / "example.npz")
    with pytest.raises(UsageError) as caught:
        example_differences(OnnxPolicy(place))
    assert str(caught.value).startswith(f"{place}/example.npz: ") and expected in str(
        caught.value
    ), caught.value
    assert "\n" not in str(caught.value)


def test_a_bad_example_fails_its_check_alone(tmp_path: Path) -> None:
    """`policy check` prints it with the outcomes of all other checks."""
    place = bundle(tmp_path / "net", tiny_graph())
    cut_off(place / "example.npz")
    outcome, words = example(SimpleNamespace(policy=OnnxPolicy(place)))  # type: ignore[arg-type]
    assert outcome == "failed" and "example.npz: cannot be read as .npz" in words


def linked(place: Path) -> None:
    (place.parent / "elsewhere").write_bytes(tiny_graph())
    (place / "model.onnx").unlink()
    (place / "model.onnx").symlink_to(place.parent / "elsewhere")


def with_weights_in(name: str) -> bytes:
    """A graph whose weights lie in a file of this name."""
    model = onnx.load_from_string(tiny_graph())
    for tensor in model.graph.initializer:
        onnx.external_data_helper.set_external_data(tensor, name)
        tensor.ClearField("raw_data")
    data: bytes = model.SerializeToString()
    return data


def in_a_function(place: Path) -> None:
    """A graph whose own function has a constant that names the file."""
    far = onnx.TensorProto(
        name="far", data_type=onnx.TensorProto.FLOAT, dims=[1], raw_data=bytes(4)
    )
    onnx.external_data_helper.set_external_data(far, "../secret")
    far.ClearField("raw_data")
    model = onnx.load_from_string(tiny_graph())
    node = onnx.helper.make_node("Constant", [], ["out"])
    node.attribute.append(onnx.helper.make_attribute("value", far))
    model.functions.append(
        onnx.helper.make_function("own", "F", [], ["out"], [node], model.opset_import)
    )
    bundle(place, model.SerializeToString())


FACTS = {"bytes": 7, "blake2b": "0" * 64}
PLACES: dict[str, tuple[Callable[[Path], object], str]] = {
    "NUL": (
        lambda place: bundle(place, with_weights_in("a\0b")),
        "has weights in a file beside it: 'a\\x00b' is no name of",
    ),
    "weights above": (
        lambda place: bundle(place, with_weights_in("../secret")),
        "'../secret' is no name of a file",
    ),
    "weights above, in a function": (in_a_function, "'../secret' is no name of a file"),
    "weights without a name": (
        lambda place: bundle(place, with_weights_in("")),
        "'' is no name of a file",
    ),
    "weights that are a folder": (
        lambda place: (bundle(place, with_weights_in("d")), (place / "d").mkdir()),
        "is no regular",
    ),
    "a key above": (
        lambda place: bundle(place, tiny_graph(), files={"../x": FACTS}),
        "files: '../x' is no name",
    ),
    "an absolute key": (
        lambda place: bundle(place, tiny_graph(), files={"/etc/passwd": FACTS}),
        "'/etc/passwd' is no",
    ),
    "a key with NUL": (
        lambda place: bundle(place, tiny_graph(), files={"a\0": FACTS}),
        "'a\\x00' is no name of a file",
    ),
    "a link": (linked, "model.onnx: is a link that leads out of its bundle"),
}


@pytest.mark.parametrize("name", PLACES)
def test_a_bundle_reads_no_file_outside_its_folder(tmp_path: Path, name: str) -> None:
    """A key of `files`, a name in the graph and a link to an outside file are named and refused."""
    place = bundle(tmp_path / "net", tiny_graph(), MANIFEST)
    make, expected = PLACES[name]
    make(place)
    with pytest.raises(UsageError) as caught:
        load_policy(f"onnx:{place}")
    assert expected in str(caught.value), caught.value


def test_a_graph_of_gigabytes_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """A graph above 2 GiB, the limit of ONNX files, is refused."""
    place = bundle(tmp_path / "net", tiny_graph())
    sparse(place / "model.onnx")
    with pytest.raises(UsageError, match="holds 4294967296 bytes; at most 2147483648 are read"):
        load_policy(f"onnx:{place}")

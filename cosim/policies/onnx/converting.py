"""Convert published weights of another format to an ONNX graph with a command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import CosimError, MachineError, UsageError, unwritable
from cosim.core.files import write_atomic
from cosim.policies.onnx.manifest import file_facts, read_bundle_manifest
from cosim.policies.onnx.weights import NetworkFile, weight_folders

PortShapes = Mapping[str, tuple[int | str, ...]]
"""Shapes of tensors by their names; a named axis may have any length."""


class GraphWriter:
    """Collects the operators and constants of an ONNX graph with float32 inputs and outputs.

    A tensor is identified by its name. The same calls give the same bytes.
    """

    def __init__(self, name: str) -> None:
        import onnx

        self._onnx = onnx
        self._name = name
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, name: str, numbers: NDArray[Any]) -> str:
        """Add a constant; return its name."""
        self._constants.append(
            self._onnx.numpy_helper.from_array(np.ascontiguousarray(numbers), name)
        )
        return name

    def operator(self, kind: str, out: str, *inputs: str, **attributes: Any) -> str:
        """Add an operator with one output; return the output's name."""
        self._nodes.append(self._onnx.helper.make_node(kind, list(inputs), [out], **attributes))
        return out

    def serialized(self, inputs: PortShapes, outputs: PortShapes) -> bytes:
        """Serialize the graph. Raises ValueError if it is invalid."""
        make = self._onnx.helper
        graph = make.make_graph(
            self._nodes, self._name, self._ports(inputs), self._ports(outputs), self._constants
        )
        model = make.make_model(graph, opset_imports=[make.make_opsetid("", 13)], ir_version=8)
        try:
            self._onnx.checker.check_model(model, full_check=True)
        except (
            self._onnx.checker.ValidationError,
            self._onnx.shape_inference.InferenceError,
        ) as error:
            raise ValueError(f"makes no graph: {' '.join(str(error).split())}") from error
        data: bytes = model.SerializeToString(deterministic=True)
        return data

    def _ports(self, shapes: PortShapes) -> list[Any]:
        number = self._onnx.TensorProto.FLOAT
        return [
            self._onnx.helper.make_tensor_value_info(name, number, list(shape))
            for name, shape in shapes.items()
        ]


class PublishedArrays:
    """Arrays of a published file by name; each must be used by the graph."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._arrays = arrays
        self._unused = set(arrays)

    def __contains__(self, name: str) -> bool:
        return name in self._arrays

    def take(self, name: str, shape: tuple[int, ...] | None = None) -> NDArray[Any]:
        """Return an array. Raises ValueError if it is missing or has another shape or type."""
        if name not in self._arrays:
            raise ValueError(f"has no '{name}'")
        numbers = self._arrays[name]
        if shape is not None and (numbers.shape != shape or numbers.dtype != np.float32):
            raise ValueError(
                f"'{name}' is {numbers.dtype} {numbers.shape}; expected float32 {shape}"
            )
        self._unused.discard(name)
        return numbers

    def check_all_used(self, ignored: Callable[[str], bool] = lambda _: False) -> None:
        """Raise ValueError for arrays that were neither taken nor ignored."""
        if left := [name for name in self._unused if not ignored(name)]:
            raise ValueError(
                f"holds '{min(left)}', and {len(left) - 1} more, of which there is no place"
            )


def graph_of_bundle(folder: Path) -> NetworkFile:
    """Return the graph named by a bundle's manifest, with the size and hash required in a run."""
    manifest = read_bundle_manifest(folder)
    return NetworkFile(manifest.model, manifest.source, manifest.files[manifest.model])


@dataclass(frozen=True)
class Converter:
    """Command `python -m MODULE FILE [-o FOLDER]` that writes the graph of a network.

    Without a folder it writes into $COSIM_WEIGHTS or, if that is not set, into the user's data
    folder.

    weights: Published file.
    make: Converts the file's bytes to the graph's bytes.
    graph: Returns the graph's file; its facts are None if any version may be written.
    versions: Packages that write the graph as required, and how to install them.
    """

    module: str
    weights: NetworkFile
    make: Callable[[bytes], bytes]
    graph: Callable[[], NetworkFile]
    versions: str = (
        "this onnx writes it otherwise than versions 1.19 to 1.23: pip install 'onnx<1.24'"
    )

    def write(self, path: Path, folder: Path) -> Path:
        """Convert the file at `path` and write the graph into a folder; return its path.

        Raises UsageError for a wrong file, MachineError if a package is missing, the graph would
        differ from the required one, or it cannot be written.
        """
        graph = self.graph()
        data = self._made(path)
        found = file_facts(data)
        if graph.facts is not None and found.blake2b != graph.facts.blake2b:
            raise MachineError(
                f"{graph.name}: would be {found.bytes} bytes, BLAKE2b {found.blake2b}, and a run "
                f"takes {graph.facts.in_words}: {self.versions}"
            )
        out = folder / graph.name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_atomic(out, data)
        except OSError as error:
            raise unwritable(out, error) from error
        return out

    def _made(self, path: Path) -> bytes:
        try:
            data = path.read_bytes()
        except OSError as error:
            raise UsageError(
                f"{path}: cannot be read: {error.strerror}; it is from {self.weights.source}"
            ) from error
        self.weights.check(path, data)
        try:
            return self.make(data)
        except ImportError as error:
            raise MachineError(
                f"{path}: its graph cannot be made: {error}: pip install -e '.[convert]' in "
                "the checkout"
            ) from error

    def command(self, arguments: Sequence[str]) -> None:
        """Run the command; errors of this project are printed on one line."""
        parser = argparse.ArgumentParser(f"python -m {self.module}")
        parser.add_argument("file", type=Path, help=f"{self.weights.name} of {self.weights.source}")
        parser.add_argument(
            "-o",
            "--output",
            type=Path,
            metavar="FOLDER",
            default=weight_folders()[0],
            help="where to write the graph; %(default)s by default",
        )
        given = parser.parse_args(arguments)
        try:
            out = self.write(given.file, given.output)
        except CosimError as error:
            sys.exit(f"error: {error}")
        print(f"{out}: {out.stat().st_size} bytes")

"""An ONNX graph made of weights that were published in another form: from file to file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from cosim.core.errors import MachineError, UsageError, unwritable
from cosim.core.files import write_atomic
from cosim.policies.onnx.weights import NetworkFile


def make_graph(
    weights: NetworkFile,
    path: Path,
    make: Callable[[bytes], bytes],
    packages: tuple[str, ...] = ("onnx",),
) -> bytes:
    """What `make` makes of the file at `path`. packages: those that it imports.

    Raises UsageError for another file than these weights; MachineError where a package is missing.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be read: {error.strerror}; it is from {weights.source}"
        ) from error
    weights.check(path, data)
    try:
        return make(data)
    except ImportError as error:
        wanted = " ".join(packages)
        raise MachineError(
            f"{path}: its graph cannot be made: {error}: pip install {wanted}"
        ) from error


def write_graph(out: Path, graph: bytes) -> None:
    """Write it, whole or not at all, and say so. Raises MachineError where it cannot be written."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(out, graph)
    except OSError as error:
        raise unwritable(out, error) from error
    print(f"{out}: {len(graph)} bytes")

"""Run an ONNX graph with onnxruntime in one thread, and describe its inputs and outputs."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MachineError, UsageError

PROVIDERS_VARIABLE: Final = "COSIM_ONNX_PROVIDERS"
"""Environment variable with comma-separated onnxruntime providers; the CPU by default."""
_CPU: Final = "CPUExecutionProvider"

_PLACES: Final = re.compile(
    r"\[ONNXRuntimeError\] : \d+ : \w+ : |Load model from .*? failed: ?|"
    r"/onnxruntime_src/\S+:\d+ [^()]*\((?:[^()]|\([^()]*\))*\)(?: const)? "
)
"""Error codes and source locations in messages of onnxruntime."""
_MAX_SAID: Final = 400
"""Largest number of characters of a runtime's message that is shown."""

Tensor = NDArray[Any]
NUMBERS: Final = "biuf"
"""Kinds of numpy types allowed for tensors."""

_TYPES: Final[Mapping[str, Any]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
    "tensor(int8)": np.int8,
    "tensor(int32)": np.int32,
    "tensor(int64)": np.int64,
    "tensor(bool)": np.bool_,
}


@dataclass(frozen=True)
class TensorPort:
    """Input or output of a graph.

    shape: None for a dynamic axis, such as a batch.
    """

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int | None, ...]

    def takes(self, array: Tensor) -> bool:
        """Return whether an array has this type and shape."""
        fits = len(array.shape) == len(self.shape) and all(
            mine in (None, theirs) for mine, theirs in zip(self.shape, array.shape, strict=True)
        )
        return fits and array.dtype == self.dtype

    @property
    def in_words(self) -> str:
        """Type and shape, as in "float32 (1, 18, 64, 85)"."""
        axes = ", ".join("any" if side is None else str(side) for side in self.shape)
        return f"{self.dtype.name} ({axes}{',' * (len(self.shape) == 1)})"


class RunnableGraph(Protocol):
    """Graph that can be run: in this process (`Graph`) or in a child (`TrialGraph`)."""

    path: Path
    inputs: Mapping[str, TensorPort]
    outputs: Mapping[str, TensorPort]

    def run(self, tensors: Mapping[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
        """Run the graph and return the named outputs. Errors of the runtime are passed on."""


class Graph:
    """Graph loaded in this process.

    Raises UsageError if the runtime rejects it; MachineError without a runtime.
    """

    def __init__(self, path: Path) -> None:
        onnxruntime = import_runtime()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = 4  # errors are raised
        self.providers = _providers(onnxruntime.get_available_providers())
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=list(self.providers), enable_fallback=0
            )
            inputs, outputs = (
                [*map(_port_facts, ports)]
                for ports in (self._session.get_inputs(), self._session.get_outputs())
            )
        except Exception as error:
            raise UsageError(f"{path}: {_refusal(error, onnxruntime.__version__)}") from error
        self.path = path
        self.inputs: Mapping[str, TensorPort] = {one[0]: self._port(*one) for one in inputs}
        self.outputs: Mapping[str, TensorPort] = {one[0]: self._port(*one) for one in outputs}

    @property
    def on_cpu(self) -> bool:
        """Whether the graph runs on the CPU only."""
        return self.providers == (_CPU,)

    def _port(self, name: str, kind: str, sides: Sequence[Any]) -> TensorPort:
        if kind not in _TYPES:
            raise UsageError(
                f"{self.path}: '{name}' is a {kind}: inputs and outputs are tensors of numbers"
            )
        shape = tuple(side if isinstance(side, int) and side >= 0 else None for side in sides)
        return TensorPort(name, np.dtype(_TYPES[kind]), shape)

    def run(self, tensors: Mapping[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
        """Run the graph and return the named outputs. Errors of the runtime are passed on."""
        return dict(zip(names, self._session.run(list(names), dict(tensors)), strict=True))


def import_runtime() -> Any:
    """Import onnxruntime. Raises MachineError if it is missing."""
    try:
        import onnxruntime
    except ImportError as error:
        raise MachineError(
            f"onnxruntime cannot be imported: {error}: pip install onnxruntime"
        ) from error
    return onnxruntime


def runs_on_cpu() -> bool:
    """Return whether graphs run on the CPU only."""
    return _providers(import_runtime().get_available_providers()) == (_CPU,)


def _port_facts(port: Any) -> tuple[str, str, Sequence[Any]]:
    """Return name, type and shape of a port. Fails for some graphs that the runtime loads."""
    return port.name, port.type, port.shape


def _providers(available: Sequence[str]) -> tuple[str, ...]:
    """Return the providers of the environment variable.

    Raises UsageError for an unavailable provider.
    """
    asked = [
        name.strip() for name in os.environ.get(PROVIDERS_VARIABLE, _CPU).split(",") if name.strip()
    ]
    if lacking := [name for name in asked if name not in available]:
        raise UsageError(
            f"{PROVIDERS_VARIABLE}: onnxruntime has no {lacking[0]} here. Valid choices: "
            f"{', '.join(available)}"
        )
    return tuple(asked) or (_CPU,)


def _refusal(error: Exception, version: str) -> str:
    """Describe why the runtime does not load a graph."""
    said = runtime_message(error)
    lacks = any(
        part in said
        for part in ("is not a registered function", "Could not find an implementation")
    )
    remedy = (
        "export it with other operators, or a lower opset"
        if lacks or "opset" in said.lower()
        else "export it again"
    )
    what = "has an operator that onnxruntime lacks" if lacks else "is refused by onnxruntime"
    return f"{what} ({version}): {said}; {remedy}"


def runtime_message(error: Exception) -> str:
    """Return a runtime's message on one line, without codes and source locations."""
    said = _PLACES.sub("", " ".join(str(error).split()))
    return said if len(said) <= _MAX_SAID else f"{said[:_MAX_SAID]}..."

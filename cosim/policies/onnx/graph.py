"""A graph that can be asked: a session of onnxruntime, one thread, and what its inputs and outputs
are."""

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
"""Names of onnxruntime's providers, with commas between them; without it the CPU's."""
_CPU: Final = "CPUExecutionProvider"

_PLACES: Final = re.compile(
    r"\[ONNXRuntimeError\] : \d+ : \w+ : |Load model from .*? failed: ?|"
    r"/onnxruntime_src/\S+:\d+ [^()]*\((?:[^()]|\([^()]*\))*\)(?: const)? "
)
_MOST_SAID: Final = 400

Tensor = NDArray[Any]
NUMBERS: Final = "biuf"
"""The kinds of numpy that the tensors of a graph may be."""

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
    """An input or output of a graph. shape: None for an axis of any length, such as that of a
    batch."""

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int | None, ...]

    def takes(self, array: Tensor) -> bool:
        """Whether an array has this type and shape."""
        fits = len(array.shape) == len(self.shape) and all(
            mine in (None, theirs) for mine, theirs in zip(self.shape, array.shape, strict=True)
        )
        return fits and array.dtype == self.dtype

    @property
    def in_words(self) -> str:
        """Type and shape, as in "float32 (1, 18, 64, 85)"."""
        axes = ", ".join("any" if side is None else str(side) for side in self.shape)
        return f"{self.dtype.name} ({axes}{',' * (len(self.shape) == 1)})"


class AskedGraph(Protocol):
    """A graph that can be asked: in this process (`Graph`), or on trial in another
    (`cosim.policies.onnx.trial`)."""

    path: Path
    inputs: Mapping[str, TensorPort]
    outputs: Mapping[str, TensorPort]

    def ask(self, tensors: Mapping[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
        """The outputs of these names. Whatever the runtime raises is raised."""


class Graph:
    """A graph, loaded. Raises UsageError for one that the runtime refuses; MachineError where there
    is no runtime."""

    def __init__(self, path: Path) -> None:
        onnxruntime = import_runtime()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = 4  # what is wrong is raised
        self.providers = _providers(onnxruntime.get_available_providers())
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=list(self.providers), enable_fallback=0
            )
            inputs, outputs = (
                [*map(_told, ports)]
                for ports in (self._session.get_inputs(), self._session.get_outputs())
            )
        except Exception as error:
            raise UsageError(f"{path}: {_refusal(error, onnxruntime.__version__)}") from error
        self.path = path
        self.inputs: Mapping[str, TensorPort] = {one[0]: self._port(*one) for one in inputs}
        self.outputs: Mapping[str, TensorPort] = {one[0]: self._port(*one) for one in outputs}

    @property
    def on_cpu(self) -> bool:
        """Whether it is asked on the CPU alone."""
        return self.providers == (_CPU,)

    def _port(self, name: str, kind: str, sides: Sequence[Any]) -> TensorPort:
        if kind not in _TYPES:
            raise UsageError(
                f"{self.path}: '{name}' is a {kind}: inputs and outputs are tensors of numbers"
            )
        shape = tuple(side if isinstance(side, int) and side >= 0 else None for side in sides)
        return TensorPort(name, np.dtype(_TYPES[kind]), shape)

    def ask(self, tensors: Mapping[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
        """The outputs of these names. What the runtime raises is raised."""
        return dict(zip(names, self._session.run(list(names), dict(tensors)), strict=True))


def import_runtime() -> Any:
    """The module onnxruntime. Raises MachineError where there is none."""
    try:
        import onnxruntime
    except ImportError as error:
        raise MachineError(
            f"onnxruntime cannot be imported: {error}: pip install onnxruntime"
        ) from error
    return onnxruntime


def runs_on_cpu() -> bool:
    """Whether graphs are asked on the CPU alone."""
    return _providers(import_runtime().get_available_providers()) == (_CPU,)


def _told(port: Any) -> tuple[str, str, Sequence[Any]]:
    """Name, type and shape of an input or output, which the runtime cannot tell of every graph that
    it loads."""
    return port.name, port.type, port.shape


def _providers(available: Sequence[str]) -> tuple[str, ...]:
    """Those that the environment asks for. Raises UsageError for one that onnxruntime does not have
    here."""
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
    """Why the runtime does not load a graph, in words."""
    said = said_by_runtime(error)
    lacks = any(
        part in said
        for part in ("is not a registered function", "Could not find an implementation")
    )
    remedy = (
        "export it with other operators, or a lower opset"
        if lacks or "opset" in said.lower()
        else "export it anew"
    )
    what = "has an operator that onnxruntime lacks" if lacks else "is refused by onnxruntime"
    return f"{what} ({version}): {said}; {remedy}"


def said_by_runtime(error: Exception) -> str:
    """What the runtime has to say, on one line, without its codes, its own source's places, and the
    file's."""
    said = _PLACES.sub("", " ".join(str(error).split()))
    return said if len(said) <= _MOST_SAID else f"{said[:_MOST_SAID]}..."

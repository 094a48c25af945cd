"""Read the weights of PyTorch files without PyTorch, and without running their code.

Files of `torch.save` and of TorchScript are read. Only classes of tensors and, in TorchScript,
names of modules are known; all other classes are rejected.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

_MAGIC: Final = 0x1950A86A20F9469CFC6C
"""First pickled number of a file from before 2020."""
_KINDS: Final = {"FloatStorage": "<f4", "LongStorage": "<i8"}
"""Types of numbers by storage class."""
_TAGS: Final = ("restore_type_tag", "build_tensorlist", "build_intlist")
"""Functions that TorchScript applies to lists and dictionaries."""
_SCRIPT: Final = "__torch__."
"""Begin of the names of modules of classes in TorchScript."""
_MAX_BYTES: Final = 2 << 30
"""Largest size of an unpacked file in bytes."""
_Stored = tuple[str, str]
"""Type and key of a block of numbers."""


class _Tensor(NamedTuple):
    """Tensor as a part of a block of numbers."""

    stored: _Stored
    offset: int
    shape: tuple[int, ...]
    steps: tuple[int, ...]


def read_torch_file(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of a PyTorch file by name, such as "memory.weight_ih_l0".

    Raises ValueError for an invalid file.
    """
    try:
        if data.startswith(b"PK"):
            return _read_zip(io.BytesIO(data))
        return _read_old(io.BytesIO(data))
    except (
        pickle.UnpicklingError,
        EOFError,
        AttributeError,
        IndexError,
        KeyError,
        TypeError,
        NotImplementedError,
        zipfile.BadZipFile,
    ) as error:
        raise ValueError(f"is no PyTorch file of weights: {error}") from None


def _read_old(file: io.BytesIO) -> dict[str, NDArray[Any]]:
    """Read a file from before 2020: pickles, then the blocks of numbers."""
    if _Pickle(file).load() != _MAGIC:
        raise ValueError("is no PyTorch file of weights: it begins otherwise")
    _version, _system = _Pickle(file).load(), _Pickle(file).load()
    tensors = dict(_tensors(_Pickle(file).load()))
    kinds = {key: kind for (kind, key), *_ in tensors.values()}
    stored: dict[str, NDArray[Any]] = {}
    for key in _Pickle(file).load():
        count = int.from_bytes(file.read(8), "little")
        dtype = np.dtype(kinds[key])
        numbers = file.read(count * dtype.itemsize)
        if len(numbers) != count * dtype.itemsize:
            raise ValueError("ends too early")
        stored[key] = np.frombuffer(numbers, dtype)
    return {
        name: _array(name, tensor, stored[tensor.stored[1]]) for name, tensor in tensors.items()
    }


def _read_zip(file: io.BytesIO) -> dict[str, NDArray[Any]]:
    """Read a zip archive: a pickle, and a file for each block of numbers."""
    with zipfile.ZipFile(file) as held:
        if sum(one.file_size for one in held.infolist()) > _MAX_BYTES:
            raise ValueError(f"unpacks to more than {_MAX_BYTES} bytes")
        pickles = [name for name in held.namelist() if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ValueError("is no PyTorch file of weights: it has no data.pkl")
        folder = pickles[0].removesuffix("data.pkl")
        tensors = dict(_tensors(_Pickle(io.BytesIO(held.read(pickles[0]))).load()))
        stored = {
            key: np.frombuffer(held.read(f"{folder}data/{key}"), kind)
            for kind, key in {tensor.stored for tensor in tensors.values()}
        }
    return {
        name: _array(name, tensor, stored[tensor.stored[1]]) for name, tensor in tensors.items()
    }


def _tensors(value: Any, name: str = "") -> Iterator[tuple[str, _Tensor]]:
    """Yield the tensors of dictionaries and modules, with their joined names."""
    if isinstance(value, _Tensor):
        yield name, value
    parts = vars(value) if isinstance(value, _Module) else value
    if isinstance(parts, Mapping):
        for key, part in parts.items():
            yield from _tensors(part, f"{name}.{key}" if name else f"{key}")


def _array(name: str, tensor: _Tensor, stored: NDArray[Any]) -> NDArray[Any]:
    whole = np.ones(tensor.shape, np.bool_).strides
    size = int(np.prod(tensor.shape))
    if (size > 1 and tuple(tensor.steps) != whole) or tensor.offset + size > stored.size:
        raise ValueError(f"'{name}' is not laid out row by row")
    return stored[tensor.offset : tensor.offset + size].reshape(tensor.shape)


class _Module:
    """Module of TorchScript; its attributes are parts, parameters and settings."""


class _Pickle(pickle.Unpickler):
    """Unpickler that knows tensors and modules, and rejects all other classes."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if module == "torch.jit._pickle" and name in _TAGS:
            return _untagged
        if module == "torch" and name in _KINDS:
            return _KINDS[name]
        if module.startswith(_SCRIPT):
            return _Module
        raise ValueError(f"holds a {module}.{name}: weights alone are read")

    def persistent_load(self, identifier: Any) -> _Stored:
        return identifier[1], identifier[2]


def _tensor(stored: _Stored, offset: int, shape: Any, steps: Any, *_: Any) -> _Tensor:
    return _Tensor(stored, offset, shape, steps)


def _untagged(value: Any, *_: Any) -> Any:
    """Return a list or dictionary of TorchScript without its type."""
    return value

"""Read arrays of a PyTorch file from before 2020 without PyTorch: pickles followed by raw numbers.

No code of the file is run: only the classes of tensors are known.
"""

from __future__ import annotations

import io
import pickle
from collections import OrderedDict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_MAGIC: Final = 0x1950A86A20F9469CFC6C
"""First pickled number of such a file."""
_KINDS: Final = {"FloatStorage": "<f4", "LongStorage": "<i8"}
"""Types of numbers by their storage class."""
_Stored = tuple[str, str]
"""Type and key of a block of numbers."""


def read_torch_file(data: bytes) -> dict[str, NDArray[Any]]:
    """Return arrays by name. Raises ValueError for an invalid file or other objects."""
    try:
        return _read_torch(io.BytesIO(data))
    except (
        pickle.UnpicklingError,
        EOFError,
        AttributeError,
        IndexError,
        KeyError,
        TypeError,
    ) as error:
        raise ValueError(
            f"no PyTorch file of weights in the form of before 2020: {error}"
        ) from None


def _read_torch(file: io.BytesIO) -> dict[str, NDArray[Any]]:
    if _Pickle(file).load() != _MAGIC:
        raise ValueError(
            "no PyTorch file of weights in the form of before 2020: it begins otherwise"
        )
    _version, _system = _Pickle(file).load(), _Pickle(file).load()
    tensors: dict[str, tuple[_Stored, int, tuple[int, ...], tuple[int, ...]]] = _Pickle(file).load()
    kinds = {key: kind for (kind, key), _, _, _ in tensors.values()}
    stored: dict[str, NDArray[Any]] = {}
    for key in _Pickle(file).load():
        count = int.from_bytes(file.read(8), "little")
        dtype = np.dtype(kinds[key])
        numbers = file.read(count * dtype.itemsize)
        if len(numbers) != count * dtype.itemsize:
            raise ValueError("ends too early")
        stored[key] = np.frombuffer(numbers, dtype)
    arrays: dict[str, NDArray[Any]] = {}
    for name, ((_, key), offset, shape, steps) in tensors.items():
        whole = np.ones(shape, np.bool_).strides
        size = int(np.prod(shape))
        if (size > 1 and tuple(steps) != whole) or offset + size > stored[key].size:
            raise ValueError(f"'{name}' is not laid out row by row")
        arrays[name] = stored[key][offset : offset + size].reshape(shape)
    return arrays


class _Pickle(pickle.Unpickler):
    """Unpickler that knows tensors and rejects all other classes."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _stored_tensor
        if module == "torch" and name in _KINDS:
            return _KINDS[name]
        raise ValueError(f"holds a {module}.{name}: weights alone are read")

    def persistent_load(self, identifier: Any) -> _Stored:
        return identifier[1], identifier[2]


def _stored_tensor(stored: _Stored, offset: int, shape: Any, steps: Any, *_: Any) -> Any:
    return stored, offset, shape, steps

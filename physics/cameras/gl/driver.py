"""Functions of the graphics driver that moderngl lacks."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final

from cosim.core.errors import EngineError

_KINDS: Final = {
    "u": ctypes.c_uint,
    "i": ctypes.c_int,
    "l": ctypes.c_ssize_t,
    "q": ctypes.c_uint64,
    "p": ctypes.c_void_p,
}


@lru_cache(maxsize=32)
def function(name: str, kinds: str, result: str = "") -> Callable[..., Any]:
    """Return a function of the current context.

    kinds, result: one letter for each argument and for the result: u and i for 32 bits, l for a
        size, q for 64 bits, p for a pointer
    Raises EngineError where the driver lacks the function.
    """
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    address = egl.eglGetProcAddress(name.encode())
    if not address:
        raise EngineError(
            f"the graphics driver has no function {name}: install a driver with OpenGL 4.4, or use "
            "--camera bullet"
        )
    returns = _KINDS[result] if result else None
    called = ctypes.CFUNCTYPE(returns, *(_KINDS[kind] for kind in kinds))
    return called(address)


def flush() -> None:
    """Start all queued commands, while the processor prepares the next ones."""
    function("glFlush", "")()

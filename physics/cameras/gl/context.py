"""The OpenGL context of this process: EGL without a window, on a GPU or on Mesa's llvmpipe."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import moderngl

from cosim.core.errors import EngineError

VERSION: Final = 430
"""OpenGL 4.3: draws whose counts lie in a buffer."""
PACKAGES: Final = "libegl1 libgl1 libegl-mesa0 libgl1-mesa-dri"


@lru_cache(maxsize=1)
def context() -> moderngl.Context:
    """The one context of this process, made when first asked for. Use it in a `with` block around
    GL calls.

    Raises EngineError with the system packages to install.
    """
    try:
        options: dict[str, Any] = {"standalone": True, "require": VERSION, "backend": "egl"}
        made: Any = moderngl.create_context(**options)
    except Exception as error:
        raise EngineError(
            f"the gl camera needs OpenGL {VERSION // 100}.{VERSION // 10 % 10} through EGL, and "
            f"there is none here ({error}). Install it (Debian, Ubuntu: apt-get install "
            f"{PACKAGES}; with a GPU its driver's EGL library), or use --camera bullet."
        ) from error
    made.__exit__(
        None, None, None
    )  # no thread holds it: whoever draws takes it for the time of a drawing
    held: moderngl.Context = made
    return held


@lru_cache(maxsize=1)
def available() -> bool:
    """Can the gl camera draw here?"""
    try:
        context()
    except EngineError:
        return False
    return True


@lru_cache(maxsize=1)
def is_card(context: moderngl.Context) -> bool:
    """Whether a graphics card draws, not the processor in its place."""
    return not any(
        name in context.info["GL_RENDERER"] for name in ("llvmpipe", "softpipe", "swrast", "SWR")
    )


@lru_cache(maxsize=1)
def renderer() -> str:
    """The renderer as it is named in records: pictures are the same bits on the same renderer
    only."""
    with context() as gl:
        info = gl.info
    return f"gl: {info['GL_RENDERER']}, {info['GL_VERSION']}"
